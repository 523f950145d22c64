"""Cover of regions and the tables of closed loops on drawn scenes."""

import pytest
import torch

from rumi.belief.particles import PoseBelief
from scripts import trajectory_runs
from scripts.trajectory_runs import Options, calibration, level, settings_of, tables
from sdf import se3


def test_truths_drawn_as_the_particles_lie_in_the_regions_as_often_as_they_should():
    random = torch.Generator().manual_seed(0)
    scale = torch.tensor([0.002, 0.001, 0.05])
    found = []
    for _ in range(200):
        centre = torch.tensor([0.6, -0.1, 3.1])  # yaws on either side of half a turn
        poses = centre + scale * torch.randn(100, 3, generator=random)
        truth = centre + scale * torch.randn(3, generator=random)
        found.append(level(PoseBelief.uniform(se3.from_planar(poses)), se3.from_planar(truth)))
    held = [sum(x <= p for x in found) / len(found) for p in (0.5, 0.9)]
    assert held == pytest.approx([0.5, 0.9], abs=0.08)
    assert level(PoseBelief.uniform(se3.from_planar(poses)), se3.from_planar(centre + 20 * scale)) == 1.0


def step(**changes):
    own = {"contacts": 1, "touched": True, "mm": 1.0, "deg": 1.0, "p": 0.97, "level": 0.5, "expected": 2.0, "nll": 3.0}
    return own | {"cpu_s": 0.1} | changes


def test_the_tables_tell_right_from_sure_and_wrong():
    lines = [
        {
            "part": "mug",
            "motion": "trajectory",
            "set": [],
            "stopped_by": "sure",
            "steps": [step(contacts=0), step(p=0.5), step()],
        },
        {
            "part": "mug",
            "motion": "trajectory",
            "set": [],
            "stopped_by": "sure",
            "steps": [step(contacts=0), step(mm=9.0)],
        },
        {
            "part": "mug",
            "motion": "corrected",
            "set": [],
            "stopped_by": "steps",
            "steps": [step(contacts=0), step(mm=9.0, level=1.0)],
        },
    ]
    said = tables(lines)
    assert "| trajectory | P(right) >= .95 | 2 | 1 | 1 | 0 | 1.5 |" in said
    assert "| trajectory | P(right) >= .98 | 2 | 1 | 0 | 2 |" in said
    assert "| corrected | as it is | 1 | 0 | 0 | 1 |" in said
    assert "| corrected | 1 | 0.00 | 0.00 | 0.00 | 0.00 |" in said
    assert calibration([step(p=1.0), step(p=1.0, mm=9.0)]) == pytest.approx(0.5)


def test_settings_of_a_run():
    options = Options(set=("filter.trajectories.across=0.4", "filter.trajectories.rounds=1"))
    chosen = settings_of(options, "trajectory", 7)
    assert (chosen.filter.trajectories.across, chosen.filter.trajectories.rounds, chosen.seed) == (0.4, 1, 7)
    assert chosen.stop.rule == "compared" and not chosen.simulator.measures_motion
    assert settings_of(options, "measured", 7).simulator.measures_motion
    assert trajectory_runs.RESULTS.name == "trajectories.jsonl"
