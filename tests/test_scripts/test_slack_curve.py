"""The curve over slack: scenes that get harder by one knob, a bound that is told the truth, and the table."""

import math
from typing import Any

import pytest
import torch
from torch import Tensor

from rumi.dynamics.registry import PushModels, PushSettings
from rumi.tasks.registry import TASKS
from scripts.slack_curve import KNOB, METHODS, Figure, ToldPushes, figure, scene, settings_of, show
from scripts.store import Store


def ended(method: str, knob: int, seed: int, **changes: Any) -> dict[str, Any]:
    run = {"stopped_by": "sure", "right": True, "lost": False, "mm": 1.0, "deg": 2.0, "steps": 7, "contacts": 3}
    return {"method": method, "knob": knob, "seed": seed} | run | {"away_mm": 900.0, "cpu_s": 3.0} | changes


def test_the_knob_takes_slack_and_hides_the_handle():
    drawn = {knob: [scene(knob).drawn(seed) for seed in range(20)] for knob in KNOB}
    away = [math.hypot(specs[0].start[0] + 0.45, specs[0].start[1]) for specs in drawn.values()]
    assert away == pytest.approx([0.89, 0.93, 0.97, 1.01, 1.05])
    for knob, specs in drawn.items():
        for spec in specs:
            assert spec.camera is not None
            x, y, yaw = spec.start
            behind = math.atan2(y - spec.camera.position[1], x - spec.camera.position[0])
            assert abs(math.remainder(yaw - behind, 2 * math.pi)) <= math.radians(KNOB[knob][1]) + 1e-9
    assert {spec.physics.mass_kg for spec in drawn[0]} == {spec.physics.mass_kg for spec in drawn[100]}  # paired


def test_told_pushes_the_object_from_where_it_is(monkeypatch):
    asked: list[tuple[Tensor, Tensor]] = []

    def rollouts(models: PushModels, model: None, poses: Tensor, weights: Tensor, *rest: None, pushes: None) -> None:
        asked.append((poses, weights))

    monkeypatch.setattr(PushModels, "rollouts", rollouts)
    truth = torch.eye(4, dtype=torch.float64)
    truth[0, 3] = 0.5
    told: Any = ToldPushes(PushSettings(), lambda: truth)
    told.rollouts(None, torch.eye(4).expand(7, 4, 4), torch.zeros(7), None, None, None)
    ((poses, weights),) = asked
    assert poses.dtype == torch.float32 and torch.equal(poses, truth.float()[None]) and weights.tolist() == [0.0]


@pytest.mark.parametrize("method", METHODS)
def test_no_method_is_told_the_motion(method):
    settings = settings_of(method, 50, 3)
    assert settings.filter.motion == "trajectory" and not settings.simulator.measures_motion
    assert not TASKS[settings.task].check(settings)


def test_the_table_is_paired_by_seed(tmp_path):
    lines = [ended("rumi", 0, 1), ended("rumi", 0, 2, steps=9), ended("slide", 0, 1, steps=5)]
    lines += [ended("slide", 0, 2, right=False), ended("slide", 0, 3, stopped_by="steps")]
    own, slide = (row.split(" | ") for row in show(lines, {}).splitlines()[2:])
    assert own[0] == "| 160 mm, 100 deg" and own[2].startswith("2/2") and own[4].startswith("8.0")
    assert slide[2].startswith("1/3") and slide[3].startswith("1/3") and slide[5].startswith("0; 1")
    assert slide[6].startswith("2.0")
    store = Store(tmp_path / "runs.jsonl")
    for line in lines:
        store.add({name: line[name] for name in ("method", "knob", "seed")}, line)
    figure(Figure(tmp_path / "slack.png", tmp_path / "runs.jsonl"))
    assert (tmp_path / "slack.png").stat().st_size > 10_000
