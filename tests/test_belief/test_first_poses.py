"""Trajectories in the plane of an object that no view shows: draws of a prior, which moves keep."""

import math

import pytest
import torch

from rumi.belief.particles import PoseBelief
from rumi.belief.pose_filter import FilterSettings
from rumi.belief.pose_trajectory_filter import PoseTrajectoryFilter
from rumi.belief.prior import PosePrior
from rumi.belief.pushed_object import PushedObject
from rumi.belief.trajectory_settings import PoseTrajectorySettings
from rumi.errors import UsageError
from rumi.robot.tool_shape import SolidTool
from sdf import se3
from sdf.grid_sdf import GridSDF
from sdf.primitives import Box, Capsule
from sensors.discrepancy import Discrepancy
from sensors.observation import Observation
from sensors.reading import Reading

ROD = SolidTool([Capsule((0.0, 0.0, 0.0), (0.0, 0.0, 0.1), 0.005)])
OWN = PoseTrajectorySettings(
    particles=100,
    first_particles=2000,
    lone=True,
    felt_m=0.005,
    fresh_m=0.003,
    pad_m=0.0,
    pad_slope_m=0.001,
    missed=0.2,
)
YAW = (0.3, math.radians(4.0))


@pytest.fixture(scope="module")
def block():
    return GridSDF.from_sdf(Box([0.05, 0.05, 0.03]), 0.004)


def followed_by(block, yaw=YAW):
    model = PushedObject.of(block, ROD, height_m=0.02, resting_m=0.03, spacing_m=0.002, pad_spacing_m=0.0025)
    settings = FilterSettings(motion="trajectory", trajectories=OWN)
    prior = PosePrior.of((0.5, 0.0), 0.01, block.bounds, yaw=yaw)
    return PoseTrajectoryFilter(settings, Discrepancy(block, 0.08, free_scale=80.0, tolerance=1e-3), model, prior)


def begun(followed, seed=0):
    none = Observation.empty()
    poses = followed.prior.spread_poses(50, generator=torch.Generator().manual_seed(seed))
    return followed.begin(PoseBelief.uniform(poses), none, generator=torch.Generator().manual_seed(seed)), none


def reading_of(y, touched, z=0.02):
    tool = se3.from_planar(torch.stack((torch.full_like(y, 0.5), y, 0 * y), -1), z)
    return Reading(
        Observation.empty(), torch.zeros(0).long(), tool, touched, None, torch.zeros(3), torch.zeros(()), 0.0, {}
    )


def test_the_first_belief_is_as_wide_as_the_prior(block):
    now = begun(followed_by(block))[0].trajectories.pose
    assert float(now[:, :2].std(0).mean()) == pytest.approx(0.01, rel=0.2)
    assert float(now[:, 2].mean()) == pytest.approx(YAW[0], abs=0.03)
    assert float(now[:, 2].std()) == pytest.approx(YAW[1], rel=0.3)
    anyhow = begun(followed_by(block, None))[0].trajectories.pose[:, 2]
    assert float(anyhow.std()) == pytest.approx(2.0 * math.pi / math.sqrt(12.0), rel=0.2)


def test_a_touch_tells_where_its_surface_is_and_the_prior_the_rest(block):
    """A rod that goes along y meets the block 4 mm nearer than where it is expected, and pushes it."""
    followed = followed_by(block, (0.0, math.radians(4.0)))
    belief, memory = begun(followed)
    y = torch.linspace(-0.109, -0.049, 10)
    touched = y > -0.0595  # it pushes on for a centimetre
    belief, memory, info = followed(belief, memory, reading_of(y, touched), generator=torch.Generator().manual_seed(1))
    now = belief.trajectories.pose
    assert bool(info.moved)
    assert float(now[:, 1].mean()) == pytest.approx(-0.049 + 0.055, abs=0.003) and float(now[:, 1].std()) < 0.004
    assert float(now[:, 0].std()) == pytest.approx(0.01, rel=0.35)
    assert float(now[:, 2].std()) == pytest.approx(math.radians(4.0), rel=0.45)


def test_a_tool_that_is_lifted_over_it_pushes_nothing(block):
    followed = followed_by(block)
    belief, memory = begun(followed)
    y = torch.linspace(-0.1, 0.1, 10)
    after, _, info = followed(
        belief, memory, reading_of(y, torch.zeros(10).bool(), 0.2), generator=torch.Generator().manual_seed(1)
    )
    assert not bool(info.moved)
    torch.testing.assert_close(after.trajectories.pose, belief.trajectories.pose)


def test_a_yaw_is_of_an_object_that_lies_in_one_way(block):
    with pytest.raises(UsageError, match="one way"):
        PosePrior.of((0.5, 0.0), 0.01, block.bounds, up=("x", "z"), yaw=YAW)
    prior = PosePrior.of((0.5, 0.0), 0.01, block.bounds, yaw=YAW)
    planar = torch.tensor([[0.51, 0.0, 0.3], [0.5, 0.0, 0.3 + 2.0 * YAW[1]]], dtype=torch.float64)
    torch.testing.assert_close(prior.planar_log_density(planar), torch.tensor([-0.5, -2.0], dtype=torch.float64))
    in_space = prior.negative_log_density(se3.from_planar(planar.float(), 0.03))
    torch.testing.assert_close(in_space, torch.tensor([0.5, 2.0]), atol=1e-3, rtol=0)
