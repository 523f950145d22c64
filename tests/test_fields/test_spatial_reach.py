"""Reach in space: the planar one at the height of each table, and in between what lies in between."""

import pytest
import torch

from rumi.errors import UsageError
from rumi.robot.reach import Reach, SpatialReach
from rumi.robot.reach_table import ReachSettings, ReachTable, table_shape

SETTINGS = ReachSettings(radius_step_m=0.02, yaw_steps=20)
HEIGHTS = (0.03, 0.115, 0.20)
BASE = (-0.45, 0.1, 0.2)


@pytest.fixture(scope="module")
def tables():
    generator = torch.Generator().manual_seed(0)
    shape = table_shape(SETTINGS)
    return [ReachTable(*torch.rand(2, *shape, generator=generator)) for _ in HEIGHTS]


@pytest.fixture
def reach(tables):
    return SpatialReach(tables, HEIGHTS, SETTINGS, BASE)


def places(generator, count=200):
    q = torch.rand(count, 4, generator=generator)
    return q * torch.tensor([1.4, 1.0, 0.2, 6.0]) - torch.tensor([0.2, 0.5, 0.0, 3.0])


@pytest.mark.parametrize("index", range(3))
def test_is_planar_at_a_tables_height(reach, tables, index, generator):
    q = places(generator)
    q[:, 2] = HEIGHTS[index]
    planar = Reach(tables[index], SETTINGS, BASE)
    flat = torch.cat((q[:, :2], q[:, 3:]), -1)
    torch.testing.assert_close(reach.residual(q), planar.residual(flat), atol=1e-5, rtol=0)
    torch.testing.assert_close(reach.errors(q)[1], planar.errors(flat)[1], atol=1e-5, rtol=0)
    torch.testing.assert_close(reach.field(q[:, :3]), planar.field(q[:, :3]), atol=1e-5, rtol=0)


def test_is_linear_in_height_between_and_constant_beyond(reach, generator):
    q = places(generator)
    low, high, middle = (q.clone() for _ in range(3))
    low[:, 2], high[:, 2], middle[:, 2] = HEIGHTS[0], HEIGHTS[1], 0.75 * HEIGHTS[0] + 0.25 * HEIGHTS[1]
    mixed = 0.75 * reach.residual(low) + 0.25 * reach.residual(high)
    torch.testing.assert_close(reach.residual(middle), mixed, atol=1e-5, rtol=0)
    beyond = low.clone()
    beyond[:, 2] = -1.0
    torch.testing.assert_close(reach.residual(beyond), reach.residual(low))


def test_refuses_heights_that_do_not_rise_evenly(tables):
    for heights in ((0.03, 0.1, 0.2), (0.2, 0.115, 0.03), (0.03, 0.2)):
        with pytest.raises(UsageError, match="rise evenly"):
            SpatialReach(tables, heights, SETTINGS)
