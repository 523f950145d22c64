"""What several filters are tried by: a box of which only a prior tells, and a block that a gripper pushes."""

from collections.abc import Iterator

import pytest

from rumi.belief.prior import PosePrior
from rumi.belief.pushed_object import PushedObject
from rumi.robot.gripper import GripperShape
from sdf import backend
from sdf.grid_sdf import GridSDF
from sdf.object_model import ObjectModel, box_model
from sdf.primitives import Box


@pytest.fixture(scope="module")
def box() -> ObjectModel:
    return box_model(spacing=0.003)


@pytest.fixture(scope="module")
def prior(box) -> PosePrior:
    return PosePrior.of((0.0, 0.0), 0.02, box.exact.bounds, ("x", "z"))


@pytest.fixture(scope="module")
def model() -> PushedObject:
    block = GridSDF.from_sdf(Box([0.04, 0.06, 0.03]), 0.003)
    return PushedObject.of(block, GripperShape(), height_m=0.03, resting_m=0.03, spacing_m=0.006, pad_spacing_m=0.006)


@pytest.fixture
def by_numba() -> Iterator[None]:
    """The compiled versions, also where tensors are so few that the plain ones would run."""
    with backend.force("numba"):
        yield
