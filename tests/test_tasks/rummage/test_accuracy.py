"""Widths of the sensors of trajectories, by what the robot is stated to be off by."""

import math
from dataclasses import replace

import pytest

from rumi.belief.trajectory_settings import PoseTrajectorySettings
from rumi.sim.settings import SimSettings
from rumi.tasks.rummage.build import build
from rumi.tasks.rummage.motions import as_accurate
from rumi.tasks.rummage.settings import preset

OWN = PoseTrajectorySettings()


def test_an_exact_robot_changes_no_width():
    assert as_accurate(OWN, SimSettings()) == OWN


def test_widths_add_in_quadrature():
    simulator = SimSettings(tool_off_m=0.002)
    simulator = replace(simulator, build=replace(simulator.build, worn_m=0.003))
    simulator = replace(simulator, sensors=replace(simulator.sensors, calibration_m=0.006))
    found = as_accurate(OWN, simulator)
    camera, tool = math.sqrt(0.006**2 / 3.0 + 3.0e-6), math.sqrt(0.002**2 / 2.0 + 3.0e-6)
    assert found.seen_sd_m == pytest.approx(math.hypot(OWN.seen_sd_m, camera))
    assert found.free_sd_m == pytest.approx(math.hypot(OWN.free_sd_m, camera))
    assert found.felt_sd_m == pytest.approx(math.hypot(OWN.felt_sd_m, tool))
    # a logistic border of width s has a variance of (pi s)^2 / 3
    variance = (math.pi * OWN.pad_slope_m) ** 2 / 3.0 + tool**2
    assert (math.pi * found.pad_slope_m) ** 2 / 3.0 == pytest.approx(variance)
    assert replace(found, **{name: getattr(OWN, name) for name in WIDTHS}) == OWN


WIDTHS = ("seen_sd_m", "free_sd_m", "felt_sd_m", "pad_slope_m")


@pytest.mark.usefixtures("at_home")
def test_the_filter_of_a_run_is_as_wide(cache):
    settings = preset(task="mug", conditions="lab")
    with build(settings, cache_dir=cache) as (_, agent):
        assert agent.filter.settings.trajectories == as_accurate(OWN, settings.simulator) != OWN
