"""Table II in small: scores spelt out, and what the comparison must show."""

import math

import pytest
import torch

from rumi.belief.trajectory_belief import TrajectoryBelief
from rumi.seeding import split
from scripts.bench.touch_filters import PushSetup, Variant, compare, score, truth_of, wide

SMALL = PushSetup(readings=20)
OURS: tuple[Variant, ...] = ("binary", "smooth", "smooth+replay")


def test_scores_are_what_they_say() -> None:
    pose = torch.tensor([[[0.01, 0.0, 0.1], [0.0, 0.03, -0.2], [0.3, 0.4, 3.0]]], dtype=torch.float64)
    weights = torch.tensor([[0.6, 0.4 - 5e-5, 5e-5]], dtype=torch.float64)
    flat = torch.zeros(1, 3, dtype=torch.float64)
    belief = TrajectoryBelief(pose, flat, flat, (), pose, weights.log(), flat)
    found = score(belief, torch.zeros(1, 3, dtype=torch.float64), top=2)
    assert float(found.top_m) == pytest.approx(0.02)
    assert float(found.top_rad) == pytest.approx(0.15)
    assert float(found.mean_m) == pytest.approx(math.hypot(0.006, 0.012), abs=1e-4)
    assert float(found.mean_rad) == pytest.approx(0.02, abs=1e-3)
    assert float(found.active) == pytest.approx(2 / 3)


def test_signals_are_the_truth() -> None:
    pose, exact = truth_of(SMALL, 300, generator=split(0, "truth"))
    signals = torch.cat([action.contact for action in exact], -1)
    assert pose.shape == (300, 3)
    # once touched, a push keeps touching, but for those that slip off
    assert float(signals[:, 0].double().mean()) < 0.02
    assert 0.8 < float(signals[:, -1].double().mean()) <= 1.0


def test_more_particles_stay_active_from_variant_to_variant() -> None:
    found = compare(wide(SMALL, 0.015, 0.15), runs=40, exact_count=300, variants=OURS)
    columns = found["variants"]
    assert list(columns) == ["binary", "smooth", "smooth+replay", "smooth, 300 particles"]
    active = [columns[name]["active"][0] for name in ("binary", "smooth", "smooth+replay")]
    assert active == sorted(active)
    difference = found["differences"]["smooth+replay - smooth"]["active"]
    assert difference[0] - difference[1] > 0
    assert difference[0] == pytest.approx(active[2] - active[1], abs=1e-6)
    assert columns["binary"]["resampled"] == 0
    assert columns["smooth+replay"]["resampled"] > 0.5
    # all of them know better than the prior, sqrt(2) times 15 mm times the mean of a Rayleigh variable
    assert columns["smooth"]["mean_m"][0] < 0.03


@pytest.mark.slow
def test_the_mean_s_error_falls_from_binary_to_smooth_to_replay() -> None:
    """Table II's order, paired over the runs: each step's whole interval is below nothing, in metres and in radians.

    The error of the ten heaviest particles does not show it.
    """
    found = compare(runs=1000, variants=OURS, seed=1)
    for pair in ("smooth - binary", "smooth+replay - smooth"):
        for name in ("mean_m", "mean_rad"):
            apart, half = found["differences"][pair][name]
            assert apart + half < 0, (pair, name)
