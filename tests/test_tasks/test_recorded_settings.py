"""Settings on record load, also those whose keys had another name."""

import json
from dataclasses import fields
from pathlib import Path

import pytest

from rumi.runs.json_settings import FORMER_KEYS, dataclass_of
from rumi.tasks.handle.settings import HandleSettings
from rumi.tasks.peg.settings import PegSettings
from rumi.tasks.rummage.settings import Settings, from_dict
from rumi.tasks.touch_box.entry import TouchBoxSettings
from scripts.reproduce.jobs import overridden, preset, to_dict
from scripts.reproduce.peg import settings_of

RESULTS = Path(__file__).resolve().parents[2] / "scripts/results"
CLASSES = {kind.__name__: kind for kind in (Settings, HandleSettings, PegSettings, TouchBoxSettings)}


def on_record():
    """What runs on record were asked for: kind, preset and overrides, each once."""
    lines = (json.loads(line) for path in sorted(RESULTS.glob("*.jsonl")) for line in path.open(encoding="utf-8"))
    asked = [(line["kind"], line["preset"], tuple(line["overrides"])) for line in lines if "overrides" in line]
    return sorted({one for one in asked if one[0] != "toy"})


def test_overrides_on_record_load():
    found = on_record()
    assert len(found) > 40
    for kind, name, overrides in found:
        if kind.startswith("peg"):
            settings_of(overrides)
        else:
            from_dict(overridden(to_dict(preset(name)), overrides))


@pytest.mark.parametrize("name", FORMER_KEYS)
def test_a_former_key_stands_for_a_setting(name):
    kind = CLASSES[name]
    for former, now in FORMER_KEYS[name].items():
        assert now in {part.name for part in fields(kind)} and former not in {part.name for part in fields(kind)}
        assert dataclass_of(kind, {former: 7.0}) == kind(**{now: 7.0})
