import itertools
import math

import pytest
import torch

from sdf.check import FAR
from sdf.lookup import trilinear, trilinear_value

SPACING = 0.5


def lattice(generator: torch.Generator, shape=(4, 5, 3), dtype=torch.float64) -> tuple[torch.Tensor, torch.Tensor]:
    values = torch.randn(shape, dtype=dtype, generator=generator)
    return values, torch.tensor([-1.0, 0.5, 2.0], dtype=dtype)


def inner_points(count: int, values: torch.Tensor, origin: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
    extent = SPACING * (torch.tensor(values.shape, dtype=origin.dtype) - 1)
    return origin + extent * torch.rand(count, 3, dtype=origin.dtype, generator=generator)


def reference(values: torch.Tensor, origin: torch.Tensor, point: torch.Tensor) -> float:
    """Eight corners, one at a time, straight from the definition."""
    total = 0.0
    place = ((point - origin) / SPACING).tolist()
    place = [min(max(p, 0.0), n - 1.0) for p, n in zip(place, values.shape, strict=True)]
    lower = [min(math.floor(p), max(n - 2, 0)) for p, n in zip(place, values.shape, strict=True)]
    for corner in itertools.product((0, 1), repeat=3):
        weight, index = 1.0, []
        for p, low, step, n in zip(place, lower, corner, values.shape, strict=True):
            fraction = p - low
            weight *= fraction if step else 1.0 - fraction
            index.append(min(low + step, n - 1))
        total += weight * float(values[tuple(index)])
    return total


@pytest.mark.parametrize("shape", [(4, 5, 3), (4, 5, 1), (1, 2, 1), (1, 1, 1), (2, 1, 2)])
def test_value_equals_the_definition(shape, generator):
    values, origin = lattice(generator, shape)
    points = torch.randn(60, 3, dtype=torch.float64, generator=generator) * 2 + origin
    nodes = origin + SPACING * torch.tensor(list(itertools.product(*map(range, shape))), dtype=torch.float64)
    points = torch.cat((points, nodes))
    expected = torch.tensor([reference(values, origin, p) for p in points], dtype=torch.float64)
    assert torch.allclose(trilinear_value(values, origin, SPACING, points), expected, atol=1e-12)
    assert torch.allclose(trilinear(values, origin, SPACING, points).distance, expected, atol=1e-12)


def test_affine_fields_are_exact(generator):
    _, origin = lattice(generator)
    slope = torch.tensor([0.3, -2.0, 0.7], dtype=torch.float64)
    axes = [origin[i] + SPACING * torch.arange(n, dtype=torch.float64) for i, n in enumerate((4, 5, 3))]
    nodes = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1)
    values = nodes @ slope + 1.0
    points = inner_points(200, values, origin, generator)
    query = trilinear(values, origin, SPACING, points)
    assert torch.allclose(query.distance, points @ slope + 1.0, atol=1e-13)
    assert torch.allclose(query.gradient, slope.expand(200, 3), atol=1e-12)


@pytest.mark.parametrize("shape", [(4, 5, 3), (4, 5, 1)])
def test_gradient_is_that_of_the_value(shape, generator):
    values, origin = lattice(generator, shape)
    points = torch.randn(300, 3, dtype=torch.float64, generator=generator) * 2 + origin  # most are outside
    points.requires_grad_()
    (expected,) = torch.autograd.grad(trilinear_value(values, origin, SPACING, points).sum(), points)
    gradient = trilinear(values, origin, SPACING, points).gradient
    assert torch.allclose(gradient, expected, atol=1e-12)


def test_autograd_to_points_and_values_twice(generator):
    values, origin = lattice(generator, (3, 4, 3))
    values.requires_grad_()
    points = inner_points(6, values, origin, generator).requires_grad_()

    def value(v, p):
        return trilinear_value(v, origin, SPACING, p)

    def query(v, p):
        return tuple(trilinear(v, origin, SPACING, p))

    for function in (value, query):
        assert torch.autograd.gradcheck(function, (values, points))
        assert torch.autograd.gradgradcheck(function, (values, points))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_clamped_at_the_border_and_never_nan(dtype, generator):
    values, origin = lattice(generator, dtype=dtype)
    nan, inf = math.nan, math.inf
    points = torch.tensor(
        [[nan, nan, nan], [inf, 0, 0], [0, -inf, 0], [1e30, -1e30, 1e30], [-FAR, FAR, -FAR]], dtype=dtype
    )
    query = trilinear(values, origin, SPACING, points)
    assert torch.isfinite(query.distance).all()
    assert query.distance[0] == query.distance[0] == values[-1, -1, -1]
    assert torch.equal(query.distance[3:], torch.stack((values[-1, 0, -1], values[0, -1, 0])))
    assert (query.gradient[[0, 3, 4]] == 0).all()


@pytest.mark.parametrize("batch", [(), (0,), (2, 3), (2, 0, 3)])
def test_batch_axes_and_dtype(batch, generator):
    values, origin = lattice(generator, dtype=torch.float32)
    points = torch.randn(*batch, 3, dtype=torch.float64, generator=generator)
    query = trilinear(values, origin, SPACING, points)
    assert query.distance.shape == batch
    assert query.gradient.shape == (*batch, 3)
    assert query.distance.dtype == query.gradient.dtype == torch.float64


def test_memory_layout_does_not_matter(generator):
    values, origin = lattice(generator)
    points = inner_points(50, values, origin, generator)
    planes = points.T.contiguous().T
    for one, other in zip(*(trilinear(values, origin, SPACING, p) for p in (planes, points)), strict=True):
        assert torch.equal(one, other)


def test_function_transforms(no_shape_check, generator):
    values, origin = lattice(generator)
    points = inner_points(8, values, origin, generator)
    query = trilinear(values, origin, SPACING, points)

    def single(p):
        return trilinear_value(values, origin, SPACING, p)

    assert torch.allclose(torch.func.vmap(single)(points), query.distance)
    assert torch.allclose(torch.func.vmap(torch.func.grad(single))(points), query.gradient)


def test_shape_errors(no_shape_check, generator):
    values, origin = lattice(generator)
    with pytest.raises(ValueError, match=r"Expected points to have shape \(\*b, 3\), got \(4, 2\)"):
        trilinear_value(values, origin, SPACING, torch.zeros(4, 2))
    with pytest.raises(ValueError, match=r"Expected values to have shape \(X, Y, Z\), got \(4, 4\)"):
        trilinear(torch.zeros(4, 4), origin, SPACING, torch.zeros(4, 3))
