"""Simulation-based calibration in the plane and in space: where all is drawn from the model, truths rank evenly."""

import math
from dataclasses import replace

import pytest
import torch

from rumi.belief.bootstrap_filter import BootstrapFilter
from rumi.belief.particles import PoseBelief
from rumi.belief.pose_filter import FilterSettings
from rumi.belief.pose_trajectories import Trajectories
from rumi.belief.pose_trajectory_filter import PoseTrajectoryFilter
from rumi.belief.prior import PosePrior
from rumi.belief.pushed_object import PushedObject
from rumi.belief.systematic_errors import SystematicErrors
from rumi.belief.toppled_object import ToppledObject
from rumi.belief.trajectory_history import History
from rumi.belief.trajectory_settings import PoseTrajectorySettings
from rumi.bench.drawn_segments import drawn_push, drawn_truth, drawn_view
from rumi.metrics.calibration import rank_test
from rumi.robot.gripper import GripperShape
from rumi.seeding import generator
from sdf import se3
from sdf.grid_sdf import GridSDF
from sdf.primitives import Box
from sdf.symmetry import Symmetries
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
OFF = replace(OWN, tool_off_m=0.003, view_off_m=0.003)
ERRORS = {"tool x": 0, "tool y": 1, "view x": 4, "view y": 5}
PADS = torch.tensor([[0.035, y, 0.0] for y in (-0.045, -0.03, 0.03, 0.045)], **DOUBLE)


def path_along(angle: float, along: torch.Tensor, aside_m: float, *height: float) -> torch.Tensor:
    """A tool's way at its own yaw, by how far along that it is, and how far beside the origin."""
    way = torch.tensor([math.cos(angle), math.sin(angle)], **DOUBLE)
    aside = torch.tensor([-way[1], way[0]], **DOUBLE)
    place = along[:, None] * way + aside_m * aside
    tool = torch.cat((place, place.new_tensor((angle, *height)).expand(len(place), -1)), -1)
    return torch.stack((tool[:-1], tool[1:]), 1)


def episode(seed: int, own: PoseTrajectorySettings) -> dict[str, float]:
    """Ranks after a view of ten points and three pushes of a block, from three sides."""
    random = generator(seed)
    sdf = GridSDF.from_sdf(Box([0.04, 0.06, 0.03]), 0.003)
    model = PushedObject.of(sdf, GripperShape(), height_m=0.03, resting_m=0.03, spacing_m=0.008, pad_spacing_m=0.008)
    spread = torch.tensor([0.02, 0.02, 0.5], **DOUBLE)
    pose = spread * torch.randn(3, generator=random, **DOUBLE)
    truth = drawn_truth(pose, random, systematic=own.systematic)
    seen = taken_by_the_camera(truth, own)
    view = drawn_view(model, own, seen, SEEN, random)
    points = view.points + torch.tensor([0.0, 0.0, 0.03], **DOUBLE)
    # of poses about the one that was seen, of which the filter draws its own and weighs them
    about = seen + 0.05 * spread * torch.randn(20, 3, generator=random, **DOUBLE)
    fitted = PoseBelief.uniform(se3.from_planar(about.float(), 0.03))
    settings = replace(FilterSettings(motion="trajectory"), trajectories=own)
    followed = PoseTrajectoryFilter(settings, Discrepancy(sdf, 0.08, free_scale=80.0, tolerance=0.001), model)
    belief = followed.begin(fitted, Observation.of(points.float(), Semantics.SURFACE), generator=random)
    now, flat = belief.trajectories, belief.log_weights.double()
    for angle in (0.0, 2.0, 4.2):
        # the same way wherever the truth is: it says nothing of it
        path = path_along(angle, torch.linspace(-0.115, -0.075, 9, **DOUBLE), 0.012)
        segment, truth = drawn_push(model, own, truth, path, PADS, random)
        now = followed.absorbed(now, flat, segment, random, opens=True, closes=True)
    apart = now.pose - truth.pose
    return {
        **{name: float((apart[:, k] < 0).double().mean()) for k, name in enumerate(("x", "y", "turn"))},
        "friction": float((now.physics[:, 0] < truth.physics[:, 0]).double().mean()),
        "lever": float((now.physics[:, 1] < truth.physics[:, 1]).double().mean()),
        **{
            name: float((now.systematic[:, k] < truth.systematic[:, k]).double().mean())
            for name, k in ERRORS.items()
            if own.systematic
        },
    }


def taken_by_the_camera(truth: Trajectories, own: PoseTrajectorySettings) -> torch.Tensor:
    """Where a camera has the object at first."""
    return SystematicErrors.of(own, truth.systematic).seen(truth.pose)[0] if own.systematic else truth.pose[0]


@pytest.mark.parametrize("own", [OWN, OFF], ids=["noise alone", "systematic errors"])
@pytest.mark.parametrize("episodes", [30, pytest.param(150, marks=pytest.mark.slow)])
def test_the_truth_ranks_evenly_among_the_particles(episodes, own):
    found = [episode(seed, own) for seed in range(episodes)]
    bins = 5 if episodes < 100 else 10
    for name in found[0]:
        assert rank_test([ranks[name] for ranks in found], bins=bins) > 0.01 / len(found[0]), name


IN_SPACE = PoseTrajectorySettings(
    unseen_particles=3000,
    fewest_particles=300,
    sampling_error=0.05,
    outliers=1e-3,
    pad_slope_m=0.003,
    along=0.05,
    across=0.05,
    turn_rad_per_m=0.5,
)
TOUCHES = [(0.02, 0.4), (0.08, 0.3), (0.09, 3.4)]  # heights and angles: the first slides it, the others may tip it


def episode_in_space(seed: int) -> dict[str, float]:
    """Ranks after three pushes of an upright block, of a pose of the prior, some of which tip it."""
    random = generator(100_000 + seed)
    block = Box([0.036, 0.07, 0.12])
    sdf = GridSDF.from_sdf(block, 0.004)
    prior = PosePrior.of((0.0, 0.0), 0.02, block.bounds, ("z",))
    model = ToppledObject.of(
        sdf, GripperShape(), prior.ways, Symmetries.none(), spacing_m=0.012, pad_spacing_m=0.012, wide=2.0
    )
    followed = BootstrapFilter(
        replace(FilterSettings(motion="trajectory"), trajectories=IN_SPACE),
        Discrepancy(sdf, 0.08, free_scale=80.0, tolerance=0.001),
        model,
        prior,
        "SE(3)",
    )
    spread = torch.tensor([0.02, 0.02, 0.4], **DOUBLE)

    def drawn(count: int) -> torch.Tensor:
        planar = spread * torch.randn(count, 3, generator=random, **DOUBLE)
        return torch.cat((planar, torch.tensor([[0.0, -1.0, 0.0]], **DOUBLE).expand(count, 3)), -1)

    truth = drawn_truth(drawn(1)[0], random)
    now = Trajectories.drawn(drawn(IN_SPACE.unseen_particles), History.empty(4), random)
    heavy = torch.zeros(len(now), **DOUBLE).log_softmax(-1)
    for height, angle in TOUCHES:
        path = path_along(angle, torch.linspace(-0.1, -0.05, 9, **DOUBLE), 0.008, height)
        segment, truth = drawn_push(model, IN_SPACE, truth, path, PADS, random)
        now, heavy = followed.with_segment(now, heavy, segment, random, opens=True, closes=True)
    told = {name: (now.pose[:, k], truth.pose[0, k]) for name, k in (("x", 0), ("y", 1), ("turn", 2), ("tilt", 5))}
    told |= {name: (now.physics[:, k], truth.physics[0, k]) for k, name in enumerate(("friction", "lever"))}
    lot = torch.rand(1, generator=random, **DOUBLE)  # of what is the same, as what stands is level
    shares = heavy.exp()
    return {name: float(shares @ ((own < true) + lot * (own == true))) for name, (own, true) in told.items()}


@pytest.mark.parametrize("episodes", [30, pytest.param(150, marks=pytest.mark.slow)])
def test_the_truth_ranks_evenly_among_the_particles_in_space(episodes):
    found = [episode_in_space(seed) for seed in range(episodes)]
    bins = 5 if episodes < 100 else 10
    for name in found[0]:
        assert rank_test([ranks[name] for ranks in found], bins=bins) > 0.01 / len(found[0]), name
