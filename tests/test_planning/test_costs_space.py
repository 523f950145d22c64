"""The information that a tool in space gathers, against sets of cells."""

import math

import pytest
import torch
from torch import Tensor

from rumi.planning.costs import information_cost
from sdf import backend
from sdf.voxel_grid import VoxelGrid

DOUBLE = {"dtype": torch.float64}


# every test of this file holds for the plain and for the compiled version
pytestmark = pytest.mark.usefixtures("version")


def solid_field(generator: torch.Generator, share: float = 0.3) -> VoxelGrid:
    values = torch.rand(14, 12, 6, generator=generator, **DOUBLE)
    kept = torch.rand(14, 12, 6, generator=generator, **DOUBLE) < share
    return VoxelGrid(values * kept, torch.tensor([0.1, -0.1, 0.0], **DOUBLE), 0.02)


def sensing_points(generator: torch.Generator) -> Tensor:
    return (torch.rand(20, 3, generator=generator, **DOUBLE) - 0.5) * torch.tensor([0.08, 0.06, 0.05], **DOUBLE)


def paths(generator: torch.Generator, count: int = 120, horizon: int = 4) -> tuple[Tensor, Tensor]:
    low, span = torch.tensor([0.0, -0.2, -0.05, -3.0], **DOUBLE), torch.tensor([0.5, 0.45, 0.25, 6.0], **DOUBLE)
    q = low + span * torch.rand(count, horizon, 4, generator=generator, **DOUBLE)
    d = 0.05 * torch.randn(count, horizon, 3, generator=generator, **DOUBLE)
    q[1::3, 2], d[1::3, 2] = q[1::3, 1], d[1::3, 1]  # some stand still
    return q, d


def met_cells(field: VoxelGrid, points: Tensor, q: Tensor, d: Tensor) -> set[tuple[int, ...]]:
    yaw = float(q[3])
    turn = torch.tensor(
        [[math.cos(yaw), -math.sin(yaw), 0.0], [math.sin(yaw), math.cos(yaw), 0.0], [0, 0, 1]], **DOUBLE
    )
    places = points @ turn.T + q[:3] - d * d.new_tensor([1.0, 1.0, 0.0])
    cells = torch.floor((places - field.origin) / field.spacing + 0.5).long()
    inside = ((cells >= 0) & (cells < torch.tensor(field.shape))).all(-1)
    return {tuple(cell) for cell in cells[inside].tolist()}


@pytest.mark.parametrize("discount", [1.0, 0.8])
def test_is_the_sum_over_the_set_of_cells(discount: float, generator: torch.Generator) -> None:
    field, points = solid_field(generator), sensing_points(generator)
    q, d = paths(generator)
    cost = information_cost(field, points, q, d, discount=discount)
    for k in range(len(q)):
        expected, met = 0.0, set[tuple[int, ...]]()
        for action in range(q.shape[1]):
            cells = met_cells(field, points, q[k, action], d[k, action]) - met
            expected -= discount**action * sum(float(field.values[cell]) for cell in cells)
            met |= cells
        assert float(cost[k]) == pytest.approx(expected, abs=1e-9)
    assert float(cost.min()) < -1.0 and float((cost == 0).double().mean()) < 0.9


def test_no_information_costs_nothing(generator: torch.Generator) -> None:
    q, d = paths(generator, 5)
    assert information_cost(solid_field(generator, 0.0), sensing_points(generator), q, d).tolist() == [0.0] * 5
    far = q + torch.tensor([0.0, 0.0, 2.0, 0.0], **DOUBLE)
    assert information_cost(solid_field(generator), sensing_points(generator), far, d).tolist() == [0.0] * 5


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_versions_agree(dtype: torch.dtype, generator: torch.Generator) -> None:
    field, points = solid_field(generator).to(dtype), sensing_points(generator).to(dtype)
    for count, horizon in ((200, 6), (1, 1), (0, 3)):
        q, d = (part.to(dtype) for part in paths(generator, max(count, 1), max(horizon, 3)))
        q, d = q[:count, :horizon], d[:count, :horizon]
        with backend.force("torch"):
            plain = information_cost(field, points, q, d, discount=0.9)
        result = information_cost(field, points, q, d, discount=0.9)
        # in single precision a point on the border of two cells may fall into either
        near = (result - plain).abs() < 1e-5
        assert count == 0 or float(near.double().mean()) > (0.97 if dtype == torch.float32 else 0.999)
