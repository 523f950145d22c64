import math

import pytest
import torch

from sdf.grid_sdf import GridSDF
from sdf.primitives import Box, Mug, Sphere


@pytest.fixture(scope="module")
def mug() -> Mug:
    return Mug()


@pytest.fixture(scope="module")
def grid(mug) -> GridSDF:
    return GridSDF.from_sdf(mug)


def around(sdf, margin: float, count: int, generator: torch.Generator, dtype=torch.float64) -> torch.Tensor:
    low, high = sdf.bounds.to(dtype)
    return low - margin + (high - low + 2 * margin) * torch.rand(count, 3, generator=generator, dtype=dtype)


def test_nodes_are_exact_and_the_axes_are_fine_inside_and_wide_outside(mug, grid):
    assert grid.values.shape == (106, 88, 95)
    assert grid.outer == 13
    first = torch.tensor(grid.origin, dtype=torch.float64)
    fine = first + 0.002 * torch.tensor([[0.0, 0, 0], [10, 20, 30], [79, 61, 68]], dtype=torch.float64)
    index = torch.tensor([[13, 13, 13], [23, 33, 43], [92, 74, 81]])
    wide = first - 0.02 * torch.tensor([[13.0, 13, 13], [0, 1, 2]], dtype=torch.float64)
    index = torch.cat((index, torch.tensor([[0, 0, 0], [13, 12, 11]])))
    nodes = torch.cat((fine, wide))
    values = grid.values[tuple(index.T)].double()
    assert torch.allclose(values, mug.distance(nodes), atol=1e-7)
    assert torch.allclose(grid.distance(nodes), values, atol=1e-6)


def test_accuracy_near_the_object_and_in_the_wide_cells(mug, grid, generator):
    near = around(mug, 0.02, 20000, generator)
    error = (grid.distance(near) - mug.distance(near)).abs()
    assert error.mean() < 0.05e-3 and error.max() < 1.2e-3
    wide = around(mug, 0.25, 20000, generator)
    error = (grid.distance(wide) - mug.distance(wide)).abs()
    assert error.mean() < 0.2e-3 and error.max() < 2.5e-3


def test_no_point_is_deeper_than_the_box_of_the_table_has_it(mug, grid, generator):
    low, high = grid.box_of()
    torch.testing.assert_close(low, mug.bounds[0].double(), atol=1e-4, rtol=0)
    torch.testing.assert_close(high, mug.bounds[1].double(), atol=1e-4, rtol=0)
    for margin in (0.0, 0.02, 0.25, 1.0):
        points = around(mug, margin, 5000, generator)
        deepest = torch.minimum(points - low, high - points).amin(-1)
        assert (-grid.distance(points) <= deepest.clamp_min(-0.25) + 1e-6).all()


def test_beyond_the_lattice_a_lower_bound_that_grows_with_the_distance(mug, grid, generator):
    far = around(mug, 3.0, 20000, generator)
    far = far[mug.distance(far) > 0.3]
    found, exact = grid.distance(far), mug.distance(far)
    assert (found < exact + 1.5e-3).all()  # interpolation alone lifts it
    assert (found > 0.9 * exact).all()
    assert (exact - found).mean() < 0.02
    # without wide cells: the bound begins at the padding
    bare = GridSDF.from_sdf(mug, outer=0.0)
    near = around(mug, 0.3, 20000, generator)
    found, exact = bare.distance(near), mug.distance(near)
    assert (found < exact + 1e-3).all()
    assert (exact - found).mean() < 0.016  # less than the box distance (31 mm) and than the clamped value (16 mm)


@pytest.mark.parametrize("outer", [0.0, 0.25])
def test_continuous_where_spacing_changes_and_where_the_lattice_ends(mug, outer, generator):
    grid = GridSDF.from_sdf(mug, spacing=0.004, outer=outer).double()
    last = torch.tensor(grid.values.shape, dtype=torch.float64) - 1 - 2 * grid.outer
    low = torch.tensor(grid.origin, dtype=torch.float64)
    high = low + grid.spacing * last
    reach = grid.outer * grid.outer_spacing
    for margin in {0.0, reach}:
        box_low, box_high = low - margin, high + margin
        inside = box_low + (box_high - box_low) * torch.rand(300, 3, dtype=torch.float64, generator=generator)
        axis = torch.arange(300) % 3
        face = torch.where(torch.arange(300) % 2 == 0, box_low[axis], box_high[axis])
        inside[torch.arange(300), axis] = face
        step = 1e-9 * torch.nn.functional.one_hot(axis, 3).double()
        jump = grid.distance(inside + step) - grid.distance(inside - step)
        assert jump.abs().max() < 1e-8


def test_slope_at_most_one_beyond_the_lattice(mug, grid, generator):
    far = around(mug, 2.0, 20000, generator)
    far = far[mug.distance(far) > 0.5]
    # more than 1 only by what interpolation errs at the lattice's end
    assert grid(far).gradient.norm(dim=-1).max() < 1.01


@pytest.mark.parametrize("outer", [0.0, 0.1])
def test_gradient_is_that_of_the_distance(mug, outer, generator):
    grid = GridSDF.from_sdf(mug, spacing=0.0047, outer=outer, outer_spacing=0.0213).double()
    points = torch.cat([around(mug, margin, 300, generator) for margin in (0.0, 0.1, 0.5)]).requires_grad_()
    query = grid(points)
    distance = grid.distance(points)
    (expected,) = torch.autograd.grad(distance.sum(), points)
    assert torch.equal(query.distance, distance)
    assert torch.allclose(query.gradient, expected, atol=1e-11)
    few = torch.cat([around(mug, margin, 4, generator) for margin in (0.0, 0.08, 0.3)]).requires_grad_()
    assert torch.autograd.gradcheck(lambda p: tuple(grid(p)), few, eps=1e-7, atol=1e-4)
    assert torch.autograd.gradgradcheck(grid.distance, few, eps=1e-7, atol=1e-3)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradient_where_fine_and_wide_cells_meet(dtype, generator):
    """At their common node and a rounding error beside it: that of one of the two cells, never a mixture."""
    sphere = Sphere(0.05)
    grid = GridSDF.from_sdf(sphere, spacing=0.005, outer=0.1).to(dtype)
    low = torch.tensor(grid.origin, dtype=dtype)
    high = low + grid.spacing * (torch.tensor(grid.values.shape) - 1 - 2 * grid.outer)
    points = low + (high - low) * torch.rand(600, 3, dtype=dtype, generator=generator)
    rows, axis = torch.arange(600), torch.arange(600) % 3
    points[rows, axis] = torch.where(rows % 2 == 0, low[axis], high[axis])
    up, down = (torch.full_like(points, side * math.inf) for side in (1, -1))
    for shifted in (points, torch.nextafter(points, up), torch.nextafter(points, down)):
        shifted = shifted.clone().requires_grad_()
        gradient = grid(shifted).gradient
        (automatic,) = torch.autograd.grad(grid.distance(shifted).sum(), shifted)
        assert torch.allclose(gradient, automatic, atol=1e-5)
        assert (gradient - torch.nn.functional.normalize(shifted, dim=-1)).abs().max() < 0.12


def test_gradient_to_the_values():
    grid = GridSDF.from_sdf(Sphere(0.05), spacing=0.03, padding=0.03, outer=0.03, outer_spacing=0.03).double()
    points = torch.tensor([[0.01, 0.02, 0.03], [0.07, 0.0, -0.01], [0.3, 0.2, 0.1]], dtype=torch.float64)

    def distance(values):
        return torch.func.functional_call(grid, {"values": values}, (points,)).distance

    assert torch.autograd.gradcheck(distance, grid.values.clone().requires_grad_())


def test_one_height_is_the_same_interpolation(grid, generator):
    for height in (-0.5, -0.1, 0.0, 0.0475, 0.05, 0.2, 0.9):
        xy = 2 * torch.rand(2000, 2, dtype=torch.float64, generator=generator) - 1
        xy[:500] *= 0.05
        points = torch.cat((xy, torch.full_like(xy[:, :1], height)), dim=-1)
        query, flat = grid(points), grid.query_at_height(xy, height)
        assert torch.allclose(grid.distance_at_height(xy, height), query.distance, atol=1e-12)
        assert torch.allclose(flat.distance, query.distance, atol=1e-12)
        assert torch.allclose(flat.gradient, query.gradient, atol=1e-10)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("outer", [0.0, 0.25])
@pytest.mark.parametrize("beyond", [0, 1, 2, None])
def test_points_within_the_lattice_are_looked_up_the_same_whatever_else_is_asked(mug, outer, beyond, dtype, generator):
    grid = GridSDF.from_sdf(mug.to(dtype), spacing=0.004, outer=outer)
    points = around(mug, outer, 500, generator, dtype)
    points[0] = grid.origin[0] - outer * 0.999
    # one point beyond the lattice, along one axis, or all axes clamped and joined
    far = torch.full((1, 3), math.nan, dtype=dtype)
    if beyond is not None:
        far = points[1:2].clone()
        far[0, beyond] = 5.0
    alone, together = grid(points), grid(torch.cat((points, far)))
    close = {"rtol": 0, "atol": 1e-6 if dtype == torch.float32 else 1e-14}
    torch.testing.assert_close(together.distance[:-1], alone.distance, **close)
    torch.testing.assert_close(grid.distance(points), alone.distance, **close)
    torch.testing.assert_close(together.gradient[:-1], alone.gradient, rtol=0, atol=100 * close["atol"])


@pytest.mark.filterwarnings("ignore:Dynamo detected a call to a `functools.lru_cache`:UserWarning")
def test_compiled_look_up_equals_eager(no_shape_check, grid, generator):
    points = around(grid, 0.4, 100, generator, torch.float32)
    compiled = torch.compile(grid.distance, fullgraph=True, backend="eager")
    assert torch.equal(compiled(points), grid.distance(points))


def test_impossible_lattices_are_refused():
    box = Box((0.1, 0.1, 0.1))
    with pytest.raises(ValueError, match="spacing > 0, padding >= 0"):
        GridSDF.from_sdf(box, spacing=0.0)
    with pytest.raises(ValueError, match="within the fine lattice"):
        GridSDF(torch.zeros(3, 3, 3), (0.0, 0.0, 0.0), 0.1, box.bounds)
    with pytest.raises(ValueError, match="Expected at least 2 nodes along each axis"):
        GridSDF(torch.zeros(3, 1, 3), (0.0, 0.0, 0.0), 0.1, box.bounds)
    with pytest.raises(ValueError, match="0 < spacing <= outer_spacing"):
        GridSDF(torch.zeros(5, 5, 5), (-0.1, -0.1, -0.1), 0.1, box.bounds, outer=1, outer_spacing=0.05)
