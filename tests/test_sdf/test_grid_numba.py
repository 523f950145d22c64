"""The fused look-ups of one point against the plain table, at every kind of place and in both float types."""

import math

import pytest
import torch

from sdf.compiled import Kernel
from sdf.grid_numba import (
    grid_arguments,
    lattice_of,
    layer_arguments,
    layer_value,
    layer_value_and_gradient,
    value,
    value_and_gradient,
)
from sdf.grid_sdf import GridSDF
from sdf.part_numba import indices
from sdf.primitives import Mug


def _look_up(points, flat, numbers, sizes, result, part):
    lattice = lattice_of(numbers, sizes)
    for i in indices(part, len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        result[i, 0] = value(x, y, z, flat, lattice)
        result[i, 1], result[i, 2], result[i, 3], result[i, 4] = value_and_gradient(x, y, z, flat, lattice)


def _look_up_layer(points, layer, rise, level, numbers, sizes, result, part):
    lattice = lattice_of(numbers, sizes)
    for i in indices(part, len(points)):
        x, y = points[i, 0], points[i, 1]
        result[i, 0] = layer_value(x, y, layer, lattice, level)
        result[i, 1], result[i, 2], result[i, 3], result[i, 4] = layer_value_and_gradient(
            x, y, layer, rise, lattice, level
        )


look_up, look_up_layer = Kernel(_look_up, fast=True), Kernel(_look_up_layer, fast=True)


@pytest.fixture(params=[torch.float32, torch.float64], ids=["single", "double"])
def dtype(request) -> torch.dtype:
    return request.param


@pytest.fixture(params=[0.0, 0.25])
def table(request, dtype) -> GridSDF:
    return GridSDF.from_sdf(Mug().to(dtype), spacing=0.004, outer=request.param)


def places(table: GridSDF, generator) -> torch.Tensor:
    """Points within, around and far beyond the table, on nodes and faces of it, and not finite."""
    clouds = [scale * torch.randn(2000, 3, dtype=torch.float64, generator=generator) for scale in (0.03, 0.2, 2.0)]
    sizes = torch.tensor(table.values.shape) - 1 - 2 * table.outer
    nodes = torch.rand(500, 3, dtype=torch.float64, generator=generator).mul(sizes + 1).floor() * table.spacing
    special = torch.tensor([[math.nan] * 3, [0.0, math.inf, 0.0], [-math.inf, 0.0, 0.0], [0.0] * 3, [1e9] * 3])
    cloud = torch.cat((*clouds, nodes + torch.tensor(table.origin), special.double()))
    return cloud.to(table.values)


def agree(found: torch.Tensor, distance: torch.Tensor, gradient: torch.Tensor) -> None:
    single = found.dtype == torch.float32
    close = {"atol": 2e-6 if single else 1e-14, "rtol": 1e-6 if single else 1e-13}
    torch.testing.assert_close(found[:, 0], distance, **close)
    torch.testing.assert_close(found[:, 1], distance, **close)
    torch.testing.assert_close(found[:, 2:], gradient, atol=1e-4 if single else 1e-12, rtol=0)


def test_point(table, generator):
    points = places(table, generator)
    found = points.new_empty(len(points), 5)
    look_up(points.numpy(), *grid_arguments(table, points.dtype), found.numpy())
    agree(found, *table(points))


@pytest.mark.parametrize("z", [0.045, 0.0451, -0.2, 1.5, math.nan])
def test_point_of_one_height(table, z, generator):
    points = places(table, generator)
    found = points.new_empty(len(points), 5)
    layer, rise, level = layer_arguments(table, z, points.dtype)
    look_up_layer(points.numpy(), layer, rise, level, *grid_arguments(table, points.dtype)[1:], found.numpy())
    agree(found, *table.query_at_height(points[:, :2], z))


def test_table_of_another_type_is_converted(generator):
    table = GridSDF.from_sdf(Mug(), spacing=0.004)
    points = places(table.double(), generator)
    found = points.new_empty(len(points), 5)
    look_up(points.numpy(), *grid_arguments(table.float(), points.dtype), found.numpy())
    agree(found, *table.double()(points))
