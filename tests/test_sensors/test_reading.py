"""Readings that cannot be are refused where they come in, with the name of what is wrong."""

import math
from dataclasses import replace

import pytest
import torch

from sdf import se3
from sensors.observation import Observation
from sensors.reading import Reading
from sensors.semantics import Semantics
from tests.fixtures.readings import make_reading


def reading() -> Reading:
    points = torch.rand(5, 3, generator=torch.Generator().manual_seed(0))
    identity, instant = se3.identity((2,)), torch.tensor([0, 0, 1, 1, 1])
    return make_reading(Observation.of(points, Semantics.FREE), tool=identity, motion=identity, instant=instant)


@pytest.mark.parametrize("value", [math.nan, math.inf])
@pytest.mark.parametrize("name", ["tool_pose", "object_motion", "configuration", "clipped", "stamp"])
def test_values_that_are_not_finite_are_refused(name, value):
    good = reading()
    bad = torch.as_tensor(getattr(good, name)).clone()
    bad[(0,) * bad.ndim] = value
    with pytest.raises(ValueError, match=f"Expected {name} to be finite"):
        replace(good, **{name: bad})


def test_points_must_be_finite_unless_they_are_padding():
    good = reading()
    points = good.observation.points.clone()
    points[2, 1] = math.nan
    valid = torch.tensor([True, True, False, True, True])
    replace(good, observation=replace(good.observation, points=points, valid=valid))
    with pytest.raises(ValueError, match=r"observation.points.*index \(2, 1\)"):
        replace(good, observation=replace(good.observation, points=points))


@pytest.mark.parametrize("instant", [-1, 2])
def test_points_have_an_instant_that_is(instant):
    good = reading()
    wrong = good.instant.clone()
    wrong[1] = instant
    with pytest.raises(ValueError, match=f"Expected instant to be 0 to 1.*got {instant}"):
        replace(good, instant=wrong)


def test_a_motion_may_be_unknown():
    assert replace(reading(), object_motion=None).object_motion is None
