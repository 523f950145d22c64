"""Readings of a tool that feels: felt points are surface, what it swept is free, as far as that is known."""

import pytest
import torch

from sdf import se3
from sensors.observation import Observation
from sensors.semantics import Semantics
from sensors.touch.touch_readings import TouchReadings

BODY = torch.tensor([[0.0, 0.0, 0.0025], [-0.03, 0.0, 0.0025]])
REGION = torch.tensor([[0.0, -0.1, -0.1], [0.5, 0.1, 0.1]])
POSES = se3.from_planar(torch.stack((torch.linspace(0.1025, 0.3025, 5), torch.full((5,), 0.0025), torch.zeros(5)), -1))
NONE = torch.zeros(0, 3)


def reading(felt, motion=None, **options):
    made = TouchReadings(BODY, REGION, **options)
    made.first(Observation.empty(), POSES[0])
    return made.reading(POSES, felt, motion, stamp=1.0)


def free_at(found, instant):
    free = found.observation.of_class(Semantics.FREE)
    return found.observation.points[free & (found.instant == instant)]


def test_felt_points_are_surface_at_their_instants():
    found = reading([NONE, NONE, POSES[2, None, :3, 3], NONE, POSES[4, None, :3, 3]])
    felt = found.observation.of_class(Semantics.SURFACE)
    assert found.instant[felt].tolist() == [2, 4] and found.in_contact.tolist() == [False, False, True, False, True]
    torch.testing.assert_close(found.observation.points[felt], POSES[[2, 4], :3, 3])
    torch.testing.assert_close(found.configuration, torch.tensor([0.3025, 0.0025, 0.0]))
    # what is near to a felt point is not known to be free, the tool's other end is
    assert float((free_at(found, 2) - POSES[2, :3, 3]).norm(dim=-1).min()) > 0.01


def test_of_a_touch_that_nobody_knows_the_place_of_nothing_is_free():
    found = reading([NONE, None, NONE, NONE, NONE])
    assert found.in_contact[1] and len(free_at(found, 1)) == 0 and len(free_at(found, 0)) > 0
    assert not bool(found.observation.of_class(Semantics.SURFACE).any())


@pytest.mark.parametrize("tracked", [True, False])
def test_what_was_free_rides_with_an_object_whose_motion_is_known(tracked):
    """The object goes along with the tool: where the tool is in its frame stays one place, told once."""
    along = POSES @ se3.inverse(POSES[:1]) if tracked else None
    touch = torch.tensor([[0.0, 0.09, 0.0]])  # far from the body
    found = reading([se3.apply(pose, touch) for pose in POSES], along)
    counts = [len(free_at(found, k)) for k in range(5)]
    assert counts == ([2, 0, 0, 0, 0] if tracked else [2] * 5)
    again = TouchReadings(BODY, REGION)
    again.first(Observation.empty(), POSES[0])
    if tracked:
        again.reading(POSES, [NONE] * 5, along)
        still = again.reading(POSES[-1:], [NONE], se3.identity((1,)))
        # the object has gone on since the run's start: the region has gone with it
        assert still.object_motion is not None and len(free_at(still, 0)) == 2


def test_a_tool_in_space_has_its_height_in_the_configuration():
    found = reading([NONE] * 5, spatial=True)
    torch.testing.assert_close(found.configuration, torch.tensor([0.3025, 0.0025, 0.0, 0.0]))
