"""Quick look-ups and the contact bound against the plain interpolation."""

import pytest
import torch
from torch import Tensor

from rumi.dynamics.contact import ContactBound
from rumi.dynamics.tool_lookup import FieldSampler, ToolField, at_height, placement, planar_features
from sdf import backend, gpu
from sdf.voxel_grid import VoxelGrid

DOUBLE = {"dtype": torch.float64}


# every test of this file holds for the plain and for the compiled version
pytestmark = pytest.mark.usefixtures("version")


def tool_points(count: int, generator: torch.Generator, *, uneven: bool = False) -> Tensor:
    points = 0.2 * torch.rand(count, 3, generator=generator, **DOUBLE) - 0.1
    points[:, 2] = 0.02 + (0.02 * torch.rand(count, generator=generator, **DOUBLE) if uneven else 0.0)
    return points


def placed(points: Tensor, configurations: Tensor, displacements: Tensor) -> Tensor:
    x, y, yaw = configurations.unbind(-1)
    c, s = yaw.cos()[:, None], yaw.sin()[:, None]
    world = (
        c * points[:, 0] - s * points[:, 1] + x[:, None],
        s * points[:, 0] + c * points[:, 1] + y[:, None],
        points[:, 2].expand(len(x), -1),
    )
    return torch.stack(world, -1) - displacements[:, None] * torch.tensor([1.0, 1.0, 0.0], **DOUBLE)


def configurations(generator: torch.Generator, count: int = 200) -> tuple[Tensor, Tensor]:
    q = torch.rand(count, 3, generator=generator, **DOUBLE) * torch.tensor([0.8, 0.8, 6.0], **DOUBLE) - 0.4
    return q, 0.1 * torch.randn(count, 3, generator=generator, **DOUBLE)


@pytest.mark.parametrize("shape", [(11, 13, 1), (9, 8, 7), (1, 13, 1), (6, 1, 1), (1, 1, 1), (5, 6, 7, 3)])
def test_tied_look_up_is_the_grids_interpolation(shape: tuple[int, ...], generator: torch.Generator) -> None:
    grid = VoxelGrid(torch.rand(shape, generator=generator, **DOUBLE), torch.tensor([-0.2, -0.3, -0.1], **DOUBLE), 0.05)
    points = tool_points(30, generator, uneven=True)
    q, d = configurations(generator)
    features = planar_features(q, d)
    expected = grid.interpolate(placed(points, q, d))
    expected = expected[..., None] if len(shape) == 3 else expected
    field = ToolField(grid, points)
    torch.testing.assert_close(field(features), expected.movedim(-1, 0), atol=1e-9, rtol=0)
    index = torch.randint(30, (len(q),), generator=generator)
    one = expected[torch.arange(len(q)), index]
    torch.testing.assert_close(field.at(features, index), one.T, atol=1e-9, rtol=0)
    sampler = FieldSampler(grid)
    points_w = placed(points, q, d)
    torch.testing.assert_close(sampler(sampler.place(points_w)), expected.movedim(-1, 0), atol=1e-9, rtol=0)


@pytest.mark.parametrize("height", [-0.13, -0.1, -0.06, 0.03, 0.2, 0.23, 0.9])
def test_a_layer_of_a_solid_field_is_its_interpolation_there(height: float, generator: torch.Generator) -> None:
    grid = VoxelGrid(torch.rand(4, 5, 7, generator=generator, **DOUBLE), torch.tensor([0.0, 0.0, -0.1], **DOUBLE), 0.05)
    points = 0.3 * torch.rand(50, 3, generator=generator, **DOUBLE) - 0.05
    points[:, 2] = height
    torch.testing.assert_close(at_height(grid, height).interpolate(points), grid.interpolate(points))


def test_placement_is_scale_and_offset_of_placed_points(generator: torch.Generator) -> None:
    points = tool_points(5, generator)
    q, d = configurations(generator, 7)
    scale, offset = torch.rand(2, 3, generator=generator, **DOUBLE)
    result = torch.einsum("ef,fma->ema", planar_features(q, d), placement(points, scale, offset))
    torch.testing.assert_close(result, placed(points, q, d) * scale + offset)


@pytest.mark.parametrize("shape", [(15, 17, 1), (9, 8, 5), (1, 13, 1), (6, 1, 1), (1, 1, 1)])
@pytest.mark.parametrize("radius", [0.004, 0.06, 0.3])
@pytest.mark.parametrize("dtype_", [torch.float32, torch.float64])
def test_bound_is_never_below_a_points_probability(
    shape: tuple[int, ...], radius: float, dtype_: torch.dtype, generator: torch.Generator
) -> None:
    values = torch.rand(shape, generator=generator, **DOUBLE) * (torch.rand(shape, generator=generator) < 0.1)
    grid = VoxelGrid(values, torch.tensor([-0.3, -0.35, -0.05], **DOUBLE), 0.045)
    centres = 0.2 * torch.rand(3, 2, generator=generator, **DOUBLE) - 0.1
    around = torch.randn(3, 60, 2, generator=generator, **DOUBLE)
    around = around / around.norm(dim=-1, keepdim=True) * radius * torch.rand(3, 60, 1, generator=generator) ** 0.25
    flat = (centres[:, None] + around).reshape(-1, 2)
    points = torch.cat((flat, torch.full((len(flat), 1), 0.02, **DOUBLE)), -1)
    q, d = configurations(generator, 400)
    # also right on and beside nodes, where rounding decides
    q[:50, :2] = (q[:50, :2] / 0.045).round() * 0.045
    d[:50] = 0
    most = grid.interpolate(placed(points, q, d)).amax(-1)
    narrow = VoxelGrid(grid.values.to(dtype_), grid.origin.to(dtype_), grid.spacing)
    bound = ContactBound(narrow, centres.to(dtype_), radius)(planar_features(q, d).to(dtype_)).double()
    assert bool((bound >= most - 1e-6).all())
    if min(shape[:2]) > 1:
        assert bool((most > 0).any())


def test_bound_is_close_enough_to_settle_most_checks(generator: torch.Generator) -> None:
    values = torch.zeros(81, 81, 1, **DOUBLE)
    values[40, 40] = 1.0
    grid = VoxelGrid(values, torch.zeros(3, **DOUBLE), 0.01)
    bound = ContactBound(grid, torch.zeros(1, 2, **DOUBLE), 0.03)
    away = torch.linspace(0, 0.2, 400, **DOUBLE)[:, None] * torch.tensor([[1.0, 0.3, 0.0]], **DOUBLE)
    near = bound(planar_features(away + torch.tensor([0.4, 0.4, 0.0], **DOUBLE))) > 0
    distance = away.norm(dim=-1)
    assert bool(near[distance < 0.03].all())
    assert not bool(near[distance > 0.03 + 2.2 * 0.01 + 0.002].any())


@pytest.mark.parametrize("version", ["torch"], indirect=True)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("shape", [(15, 17, 1), (40, 31, 3), (1, 13, 1), (6, 1, 1), (1, 1, 1)])
@pytest.mark.parametrize("radius", [0.0, 0.06, 0.3, 2.0])
def test_versions_agree(dtype: torch.dtype, shape: tuple[int, ...], radius: float, generator: torch.Generator) -> None:
    values = torch.rand(shape, generator=generator) * (torch.rand(shape, generator=generator) < 0.1)
    grid = VoxelGrid(values.to(dtype).mT.contiguous().mT, torch.zeros(3, dtype=dtype), 0.045)
    plain = ContactBound(grid, torch.zeros(1, 2, dtype=dtype), radius).grid
    for version in ("numba", *[gpu.VERSION] * gpu.available()):
        with backend.force(version):
            found = ContactBound(grid, torch.zeros(1, 2, dtype=dtype), radius).grid
        assert torch.equal(found.values, plain.values)
        assert torch.equal(found.origin, plain.origin)
