"""The tool's measured force on its way into a segment: its mean, what it is worth, and where it tells nothing."""

from dataclasses import replace

import pytest
import torch

from rumi.belief.pushed_object import PushedObject
from rumi.belief.segments import felt_pads, path_of, pushed
from rumi.belief.trajectory_settings import PoseTrajectorySettings
from rumi.robot.gripper import GripperShape
from sdf import se3
from sdf.grid_sdf import GridSDF
from sdf.primitives import Box
from sensors.observation import Observation
from sensors.reading import FORCE, Reading

DOUBLE = {"dtype": torch.float64}
OWN = PoseTrajectorySettings(force_rad=0.2, force_n=0.3, force_per_m=50.0)
ON_TOOL = torch.tensor([[9.0, 9.0, 9.0], [-2.0, 0.0, 0.5], [0.0, -2.0, 0.5], [torch.nan] * 3])
WAYS = (0.0, 0.004, 0.012, 0.004)  # of the tool to each instant
TOUCHED = torch.tensor([False, True, True, True])


@pytest.fixture(scope="module")
def model() -> PushedObject:
    block = GridSDF.from_sdf(Box([0.04, 0.06, 0.03]), 0.004)
    return PushedObject.of(block, GripperShape(), height_m=0.03, resting_m=0.03, spacing_m=0.02, pad_spacing_m=0.01)


def force_of(model, on_tool=ON_TOOL, own=OWN, touched=TOUCHED):
    x = -0.5 + torch.tensor(WAYS).cumsum(0)
    tool = se3.from_planar(torch.stack((x, 0 * x, 0 * x), -1), 0.03)
    measured = {} if on_tool is None else {FORCE: on_tool}
    still = torch.zeros(0, dtype=torch.long)
    reading = Reading(Observation.empty(), still, tool, touched, None, torch.zeros(3), torch.zeros(()), 0.0, measured)
    path, tracks = path_of(reading, model), torch.zeros(2, 4, 3, **DOUBLE)
    return pushed(reading, torch.arange(4), path, felt_pads(reading, model, own), tracks, model, own).force


def test_it_is_the_mean_over_the_way_in_contact_on_the_object(model):
    """Of instants without contact, or without a number, nothing counts; 2 N over 4 mm and 2 N across over 12 mm."""
    force = force_of(model)
    torch.testing.assert_close(force[:2], torch.tensor([0.5, 1.5], **DOUBLE), atol=1e-6, rtol=0)
    sure = 1.0 / (1.0 + (OWN.force_n / (2.5**0.5 * OWN.force_rad)) ** 2)
    assert float(force[2]) == pytest.approx(OWN.force_per_m * 0.016 * sure, rel=1e-4)


def test_a_faint_force_is_worth_little(model):
    worth = [float(force_of(model, size * ON_TOOL)[2]) for size in (0.01, 0.1, 1.0, 100.0)]
    assert worth == sorted(worth) and worth[0] < 1e-3 * worth[-1]
    assert worth[-1] == pytest.approx(OWN.force_per_m * 0.016, rel=1e-3)


@pytest.mark.parametrize("on_tool", [None, 0.0 * ON_TOOL[:1].expand(4, 3), torch.full((4, 3), torch.nan)])
def test_no_force_tells_nothing(model, on_tool):
    assert force_of(model, on_tool) is None


def test_it_may_be_left_out(model):
    assert force_of(model, own=replace(OWN, force_per_m=0.0)) is None
    assert force_of(model, touched=torch.zeros(4, dtype=torch.bool)) is None
