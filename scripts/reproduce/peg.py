"""The peg task as a piece of work: where to touch next under a deadline (time allocation), run by run."""

import json
import time
from collections.abc import Sequence
from typing import Any

from rumi import loop
from rumi.errors import UsageError
from rumi.runs.json_settings import dataclass_of
from rumi.tasks.peg.agent import build_peg
from rumi.tasks.peg.settings import PegSettings

_LIST = "contact_s"


def carry_out(overrides: Sequence[str], seed: int) -> dict[str, Any]:
    """Do the task once.

    Args:
        overrides: settings on top of the task's own, such as "t_max_s=20".
        seed: of all randomness.

    Returns:
        `figures`: how it ended, of `rumi.tasks.peg.records.PegRun.as_dict`; `timings`: seconds that the run took here;
        `curves`: when each side was touched, and the probability that both holes are where they are thought to be.
    """
    begun = time.perf_counter()
    run = loop.run_to_end(*build_peg(settings_of(overrides)), seed=seed)
    figures = run.as_dict()
    contact = figures.pop(_LIST)
    for name in ("truth", "holes_m", "inserted_m"):
        del figures[name]
    return {
        "figures": figures,
        "timings": {"wall_s": time.perf_counter() - begun},
        "curves": {"contact_s": contact, "probability": [float(f"{p:.4g}") for p in run.probabilities]},
    }


def settings_of(overrides: Sequence[str]) -> PegSettings:
    """The task's settings with some changed.

    Raises:
        UsageError: one is no setting, has no value, or cannot be.
    """
    values: dict[str, Any] = {}
    for override in overrides:
        name, equals, text = override.partition("=")
        if not equals:
            raise UsageError(f"Expected a setting of peg and its value, such as t_max_s=20, got {override!r}")
        try:
            value = json.loads(text)
        except json.JSONDecodeError:
            value = text
        values[name] = value
    return dataclass_of(PegSettings, values)
