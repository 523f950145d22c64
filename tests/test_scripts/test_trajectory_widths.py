"""Volumes of a belief's regions: that of a normal one, in its units, across the seam of the yaw; and their table."""

import math
from contextlib import nullcontext
from types import SimpleNamespace

import pytest
import torch

from scripts import trajectory_widths
from scripts.trajectory_widths import Record, record, show, volume


def normal(count: int, x_mm: float = 2.0) -> torch.Tensor:
    random = torch.Generator().manual_seed(0)
    scale = torch.tensor([1e-3 * x_mm, 1e-3, math.radians(1.5)], dtype=torch.float64)
    return torch.randn(count, 3, generator=random, dtype=torch.float64) * scale


def test_the_volume_is_that_of_the_ellipsoid() -> None:
    """Of a normal density of three numbers 90 % are within 2.5003 deviations."""
    expected = 4.0 / 3.0 * math.pi * 2.5003**3 * 2.0
    assert volume(normal(3000)) == pytest.approx(expected, rel=0.15)
    few = [volume(part) for part in normal(3000).split(150)]
    assert sum(few) / len(few) == pytest.approx(expected, rel=0.5)  # wider of few, as the reference's is


def test_it_goes_by_length_and_across_the_seam() -> None:
    poses = normal(400)
    turned = poses.clone()
    turned[:, 2] = torch.remainder(poses[:, 2] + 2.0 * math.pi, 2.0 * math.pi) - math.pi
    assert volume(turned) == pytest.approx(volume(poses), rel=1e-6)
    assert volume(poses * torch.tensor([2.0, 2.0, 2.0])) == pytest.approx(8.0 * volume(poses), rel=1e-6)


def test_the_table_divides_volumes_and_deviations() -> None:
    own = {"belief": [8.0, 18.0], "reference": [[8.0, 12.0], [20.0, 20.0]], "action": 5}
    own |= {"deviations": [[1.0, 2.0, 3.0]] * 2, "of": [[2.0, 2.0, 2.0]] * 2}
    said = show([{"particles": 150, "rounds": 2, "seed": 1, "updates": [own]}], {})
    assert (
        "| 150 | 2 | 1 | 0.80 [0.80, 0.80] | 0.80, 0.80, 0.80 | 100 % | 0.50, 1.00, 1.50 | 0.50, 0.50, 0.50 |" in said
    )


def test_readings_of_a_seed_are_recorded_once(tmp_path, monkeypatch):
    begun = []

    def run(task, agent, *, seed, on_step):
        begun.append(seed)
        for reading in (10 * seed, 10 * seed + 1):
            on_step(SimpleNamespace(reading=reading))

    monkeypatch.setattr(trajectory_widths, "EPISODES", tmp_path / "runs" / "readings")
    monkeypatch.setattr(trajectory_widths, "build", lambda settings, cache_dir: nullcontext((None, None)))
    monkeypatch.setattr(trajectory_widths, "run_to_end", run)
    for _ in range(2):
        record(Record(seeds="3-4"))
    assert begun == [3, 4]
    assert torch.load(tmp_path / "runs" / "readings" / "mug-4.pt", weights_only=False) == [40, 41]
