"""Simulation-based calibration: where truth and readings are drawn from the model, the truth's ranks are even."""

import math
from dataclasses import replace

import pytest
import torch

from rumi.belief.drawn_segments import drawn_push, drawn_truth, drawn_view
from rumi.belief.particles import PoseBelief
from rumi.belief.pose_filter import FilterSettings
from rumi.belief.pose_trajectory_filter import PoseTrajectoryFilter
from rumi.belief.pushed_object import PushedObject
from rumi.belief.trajectory_settings import PoseTrajectorySettings
from rumi.metrics.calibration import rank_test
from rumi.robot.gripper import GripperShape
from rumi.seeding import generator
from sdf import se3
from sdf.grid_sdf import GridSDF
from sdf.primitives import Box
from sensors.discrepancy import Discrepancy
from sensors.observation import Observation
from sensors.semantics import Semantics

DOUBLE = {"dtype": torch.float64}
SEEN = 10
OWN = PoseTrajectorySettings(
    particles=100,
    seen_points=float(SEEN),
    seen_sd_m=0.003,
    outliers=1e-5,
    pad_slope_m=0.002,
    along=0.1,
    across=0.2,
    turn_rad_per_m=2.0,
)
PADS = torch.tensor([[0.035, y, 0.0] for y in (-0.045, -0.03, 0.03, 0.045)], **DOUBLE)


def episode(seed: int) -> dict[str, float]:
    """Ranks after a view of ten points and three pushes of a block, from three sides."""
    random = generator(seed)
    sdf = GridSDF.from_sdf(Box([0.04, 0.06, 0.03]), 0.003)
    model = PushedObject.of(sdf, GripperShape(), height_m=0.03, resting_m=0.03, spacing_m=0.008, pad_spacing_m=0.008)
    spread = torch.tensor([0.02, 0.02, 0.5], **DOUBLE)
    pose = spread * torch.randn(3, generator=random, **DOUBLE)
    truth = drawn_truth(pose, random)
    view = drawn_view(model, OWN, pose, SEEN, random)
    points = view.points + torch.tensor([0.0, 0.0, 0.03], **DOUBLE)
    # of poses about the truth, of which the filter draws its own and weighs them
    about = pose + 0.05 * spread * torch.randn(20, 3, generator=random, **DOUBLE)
    fitted = PoseBelief.uniform(se3.from_planar(about.float(), 0.03))
    settings = replace(FilterSettings(motion="trajectory"), trajectories=OWN)
    followed = PoseTrajectoryFilter(settings, Discrepancy(sdf, 0.08, free_scale=80.0, tolerance=0.001), model)
    belief = followed.begin(fitted, Observation.of(points.float(), Semantics.SURFACE), generator=random)
    now, flat = belief.trajectories, belief.log_weights.double()
    for angle in (0.0, 2.0, 4.2):
        way = torch.tensor([math.cos(angle), math.sin(angle)], **DOUBLE)
        aside = torch.tensor([-way[1], way[0]], **DOUBLE)
        back = torch.linspace(-0.115, -0.075, 9, **DOUBLE)[:, None]
        # the same way wherever the truth is: it says nothing of it
        place = back * way + 0.012 * aside
        tool = torch.cat((place, torch.full_like(back, angle)), -1)
        path = torch.stack((tool[:-1], tool[1:]), 1)
        segment, truth = drawn_push(model, OWN, truth, path, PADS, random)
        now = followed.absorbed(now, flat, segment, random, opens=True, closes=True)
    apart = now.pose - truth.pose
    return {
        **{name: float((apart[:, k] < 0).double().mean()) for k, name in enumerate(("x", "y", "turn"))},
        "friction": float((now.physics[:, 0] < truth.physics[:, 0]).double().mean()),
        "lever": float((now.physics[:, 1] < truth.physics[:, 1]).double().mean()),
    }


@pytest.mark.parametrize("episodes", [30, pytest.param(150, marks=pytest.mark.slow)])
def test_the_truth_ranks_evenly_among_the_particles(episodes):
    found = [episode(seed) for seed in range(episodes)]
    bins = 5 if episodes < 100 else 10
    for name in found[0]:
        assert rank_test([ranks[name] for ranks in found], bins=bins) > 0.01 / len(found[0]), name
