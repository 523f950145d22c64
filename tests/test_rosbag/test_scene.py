"""What a mapping asks for is what its rummager has, or is refused in words."""

from dataclasses import replace

import pytest
import torch

from rumi.belief.particles import PoseBelief
from rumi.errors import UsageError
from rumi.rosbag.mapping_file import mapping_of
from rumi.rosbag.scene import rummager_of_map, settings_of
from sensors.observation import Observation
from sensors.reading import Reading
from sensors.semantics import Semantics

MAP = """
schema = 1
[topics]
[frames]
world = "base"
tool = "gripper"
[scene]
builtin = "mug"
within = [[0.30, -0.25, 0.0], [0.70, 0.25, 0.25]]
"""
PLACES = torch.tensor([[0.25, 0.0, 0.045]])


def rummager_of(settings="", places=PLACES, **changes):
    mapping = mapping_of(f"{MAP}[settings]\n{settings}")
    return rummager_of_map(mapping, replace(settings_of(mapping), **changes), places)


def test_every_setting_is_honoured():
    found = rummager_of(
        'method = "info-only"\nfilter.motion = "measured"\nplanner.push_model = "quasi-static"\nsteps = 7'
    )
    assert found.filter.settings.motion == "measured"
    assert found.policy.settings.reachability_scale == 0.0  # information alone
    assert found.policy.settings.push_model == "quasi-static" and found.steps == 7


def test_what_nobody_measures_is_not_taken_for_measured():
    assert rummager_of().filter.settings.motion == "corrected"
    assert rummager_of('filter.motion = "auto"').filter.settings.motion == "corrected"
    assert rummager_of('filter.unmeasured = "sticking"').filter.settings.motion == "sticking"


def test_a_reading_without_the_motion_that_is_relied_on_is_refused():
    rummager = rummager_of('filter.motion = "measured"')
    seen = Observation.of(torch.tensor([[0.5, 0.0, 0.05]]), Semantics.SURFACE)
    poses, belief = torch.eye(4)[None], PoseBelief.uniform(torch.eye(4)[None])
    reading = Reading(seen, torch.zeros(1).long(), poses, torch.zeros(1).bool(), None, torch.zeros(3), torch.zeros(()))
    with pytest.raises(UsageError, match=r"object_motion.*choose .*'corrected'"):
        rummager.filter(belief, seen, reading, generator=torch.Generator())


def test_what_the_recording_had_is_what_the_run_relies_on():
    text = MAP.replace("[scene]", "[scene]\nlooks_again = true")
    mapping = mapping_of(text)
    rummager = rummager_of_map(mapping, settings_of(mapping), PLACES)
    assert "motion: not measured" in rummager.relies_on and "looks after every action" in rummager.relies_on
    assert rummager_of("tool_height_m = 0.05").tool.height_m == pytest.approx(0.05)


def test_a_tool_that_is_lifted_between_touches_does_not_make_an_object_too_low():
    lifted = torch.tensor([[0.5, 0.0, 0.3], [0.5, 0.1, 0.04]])
    rummager = rummager_of(places=lifted)
    assert 0.0 < rummager.tool.height_m < float(rummager.model.exact.bounds[1, 2])


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ("simulator.action_s = 2.0", "simulator"),
        ("object.mass_kg = 2.0", "object"),
        ('task = "mug-0"', "task"),
    ],
)
def test_what_nothing_here_could_follow_is_refused(settings, said):
    with pytest.raises(UsageError, match=said):
        rummager_of(settings)


ROD = "radius_m = 0.005\nrod_m = [[0.0, 0.0, 0.0], [0.0, 0.0, 0.1]]\n"


def test_a_rod_is_a_tool_and_a_sensors_surface():
    mapping = mapping_of(f"{MAP}[tool]\n{ROD}[wrench]\n{ROD}")
    body = mapping.tool.shape().body
    touched = torch.tensor([[0.005, 0.0, 0.05], [0.0, 0.0, -0.005], [0.0, 0.0, 0.105]])
    torch.testing.assert_close(body.distance(touched), torch.zeros(3), atol=1e-6, rtol=0.0)
    assert mapping.wrench is not None and len(mapping.wrench.tool().planes) > 4
    assert mapping.tool.links()[0] is not None


@pytest.mark.parametrize(
    "table",
    [
        "[tool]\nradius_m = 0.005\n",
        "[tool]\nrod_m = [[0.0, 0.0, 0.0], [0.0, 0.0, 0.1]]\n",
        f'[tool]\n{ROD}mesh = "tool.stl"\n',
        "[tool]\nradius_m = 0.005\nrod_m = [[0.0, 0.0, 0.1], [0.0, 0.0, 0.1]]\n",
        "[tool]\nradius_m = -0.005\nrod_m = [[0.0, 0.0, 0.0], [0.0, 0.0, 0.1]]\n",
        '[wrench]\nmesh = "tool.stl"\nrod_m = [[0.0, 0.0, 0.0], [0.0, 0.0, 0.1]]\n',
    ],
)
def test_half_a_rod_is_refused(table):
    with pytest.raises(UsageError, match=r"rod_m|radius_m"):
        mapping_of(MAP + table)
