import itertools
import math

import pytest
import torch

from sdf.lookup import interpolate, interpolate_with_slopes

SPACING = 0.5


def lattice(generator: torch.Generator, shape=(4, 5, 3), dtype=torch.float64) -> tuple[torch.Tensor, torch.Tensor]:
    values = torch.randn(shape, dtype=dtype, generator=generator)
    return values, torch.tensor([-1.0, 0.5, 2.0], dtype=dtype)


def inner_points(count: int, values: torch.Tensor, origin: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
    extent = SPACING * (torch.tensor(values.shape, dtype=origin.dtype) - 1)
    return origin + extent * torch.rand(count, 3, dtype=origin.dtype, generator=generator)


def value_at(values: torch.Tensor, origin: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
    return interpolate(values, cells(values, origin, points))


def slopes_at(values: torch.Tensor, origin: torch.Tensor, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Value and gradient to the points, which are within the lattice."""
    value, slopes = interpolate_with_slopes(values, cells(values, origin, points))
    return value, torch.stack(slopes, -1) / SPACING


def cells(values: torch.Tensor, origin: torch.Tensor, points: torch.Tensor) -> list[torch.Tensor]:
    planes = ((points - origin) / SPACING).unbind(-1)
    return [plane.clamp(0.0, n - 1.0) for plane, n in zip(planes, values.shape, strict=True)]


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
    assert torch.allclose(value_at(values, origin, points), expected, atol=1e-12)
    assert torch.allclose(slopes_at(values, origin, points)[0], expected, atol=1e-12)


def test_affine_fields_are_exact(generator):
    _, origin = lattice(generator)
    slope = torch.tensor([0.3, -2.0, 0.7], dtype=torch.float64)
    axes = [origin[i] + SPACING * torch.arange(n, dtype=torch.float64) for i, n in enumerate((4, 5, 3))]
    nodes = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1)
    values = nodes @ slope + 1.0
    points = inner_points(200, values, origin, generator)
    value, gradient = slopes_at(values, origin, points)
    assert torch.allclose(value, points @ slope + 1.0, atol=1e-13)
    assert torch.allclose(gradient, slope.expand(200, 3), atol=1e-12)


@pytest.mark.parametrize("shape", [(4, 5, 3), (4, 5, 1)])
def test_gradient_is_that_of_the_value(shape, generator):
    values, origin = lattice(generator, shape)
    points = inner_points(300, values, origin, generator).requires_grad_()
    (expected,) = torch.autograd.grad(value_at(values, origin, points).sum(), points)
    _, gradient = slopes_at(values, origin, points)
    assert torch.allclose(gradient, expected, atol=1e-12)


def test_autograd_to_points_and_values_twice(generator):
    values, origin = lattice(generator, (3, 4, 3))
    values.requires_grad_()
    points = inner_points(6, values, origin, generator).requires_grad_()

    for look_up in (value_at, slopes_at):
        function = lambda v, p, look_up=look_up: look_up(v, origin, p)  # noqa: E731
        assert torch.autograd.gradcheck(function, (values, points))
        assert torch.autograd.gradgradcheck(function, (values, points))


def test_memory_layout_does_not_matter(generator):
    values, origin = lattice(generator)
    points = inner_points(50, values, origin, generator)
    planes = points.T.contiguous().T
    for one, other in zip(*(slopes_at(values, origin, p) for p in (planes, points)), strict=True):
        assert torch.equal(one, other)
