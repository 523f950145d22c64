import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from sdf.voxel_grid import VoxelGrid, lattice_keys


def tensor(value: object) -> torch.Tensor:
    return torch.tensor(value, dtype=torch.float64)


coordinates = st.lists(st.tuples(*[st.floats(-30, 30)] * 3), min_size=1, max_size=20)


@given(coordinates, st.sampled_from([0.002, 0.01, 0.5]))
def test_keys_name_cells_one_to_one(points, spacing):
    points = tensor(points)
    keys = lattice_keys(points, spacing)
    assert (keys >= 0).all() and (keys < 1 << 51).all()
    cells = [tuple(cell) for cell in torch.floor(points / spacing).tolist()]
    assert len(set(keys.tolist())) == len(set(cells))
    assert [k == keys[0] for k in keys.tolist()] == [c == cells[0] for c in cells]


def test_lattice_is_the_worlds_and_keys_know_nothing_of_other_points():
    keys = lattice_keys(tensor([[0.001, 0.001, 0.001], [0.0019, 0.0, 0.0], [-0.0001, 0.0, 0.0]]), 0.002)
    assert keys[0] == keys[1] != keys[2]
    assert lattice_keys(tensor([[-0.0001, 0.0, 0.0]]), 0.002)[0] == keys[2]


def test_one_spacing_a_point():
    points = tensor([[0.015, 0.0, 0.0], [0.015, 0.0, 0.0]])
    spacing = tensor([0.01, 0.02])
    keys = lattice_keys(points, spacing)
    assert keys[0] == lattice_keys(points, 0.01)[0]
    assert keys[1] == lattice_keys(points, 0.02)[1]
    assert lattice_keys(torch.zeros(2, 0, 3), torch.ones(2, 0)).shape == (2, 0)


@pytest.mark.parametrize("bad", [math.nan, math.inf, 1e9, -1e9])
def test_keys_refuse_what_they_cannot_name(bad):
    with pytest.raises(ValueError, match="Expected points within 65536 lattice cells of the origin"):
        lattice_keys(tensor([[0.0, bad, 0.0]]), 0.002)
    lattice_keys(tensor([[65535.5, -65536.0, 0.0]]), 1.0)


def test_workspaces_of_the_paper():
    planar = VoxelGrid.from_bounds(tensor([[0.0, -0.4, 0.045], [0.8, 0.4, 0.045]]), 0.01)
    assert planar.shape == (81, 81, 1)
    assert math.prod(planar.shape) == 6561
    solid = VoxelGrid.from_bounds(tensor([[0.0, -0.4, 0.0], [0.8, 0.4, 0.2]]).float(), 0.02)
    assert math.prod(solid.shape) == 18491
    assert torch.allclose(solid.centers()[0, 0, 0], torch.tensor([0.0, -0.4, 0.0]))
    assert torch.allclose(solid.centers()[-1, -1, -1], torch.tensor([0.8, 0.4, 0.2]))
    # an extent that is no whole number of spacings is covered
    assert VoxelGrid.from_bounds(tensor([[0.0, 0, 0], [0.25, 0.1, 0.0]]), 0.1).shape == (4, 2, 1)
    with pytest.raises(ValueError, match="swap them"):
        VoxelGrid.from_bounds(tensor([[0.0, 0, 1], [1, 1, 0]]), 0.1)


def grid(generator, shape=(4, 5, 3), channels=()) -> VoxelGrid:
    values = torch.randn(*shape, *channels, dtype=torch.float64, generator=generator)
    return VoxelGrid(values, tensor([-1.0, 0.5, 2.0]), 0.5)


@pytest.mark.parametrize("shape", [(4, 5, 3), (4, 5, 1), (1, 1, 1)])
@pytest.mark.parametrize("channels", [(), (3,), (2, 2)])
@pytest.mark.parametrize("outside", [0.0, -1.5, None])
def test_nodes_and_index_agree(shape, channels, outside, generator):
    field = grid(generator, shape, channels)
    centers = field.centers()
    assert centers.shape == (*shape, 3)
    assert torch.allclose(field.interpolate(centers, outside), field.values)
    index, inside = field.nearest_index(centers + 0.24)
    assert inside.all()
    assert torch.equal(field.values[tuple(index.unbind(-1))], field.values)
    if outside is not None and shape[0] > 1:
        away = centers + tensor([0.5 * shape[0], 0.0, 0.0])
        assert torch.allclose(field.interpolate(away, outside), torch.full_like(field.values, outside))


def test_outside_constant_is_the_lattice_continued_with_it(generator):
    field = grid(generator)
    wide = torch.full((8, 9, 7), 2.0, dtype=torch.float64)
    wide[2:-2, 2:-2, 2:-2] = field.values
    continued = VoxelGrid(wide, field.origin - 1.0, 0.5)
    points = field.origin - 0.9 + torch.rand(500, 3, dtype=torch.float64, generator=generator) * tensor([3.3, 3.8, 2.8])
    assert torch.allclose(field.interpolate(points, 2.0), continued.interpolate(points, None))
    assert torch.allclose(field.interpolate(points, tensor(2.0)), continued.interpolate(points, None))


def test_channels_have_their_own_outside_and_own_answers(generator):
    field = grid(generator, channels=(3,))
    free = tensor([1.0, 0.0, 0.0])
    assert torch.equal(field.interpolate(tensor([[5.0, 5.0, 5.0]]), free), free[None])
    points = field.origin + torch.rand(40, 3, dtype=torch.float64, generator=generator)
    for channel in range(3):
        single = field.with_values(field.values[..., channel])
        assert torch.allclose(field.interpolate(points)[:, channel], single.interpolate(points))


def test_golden_outside(golden):
    case = golden("rumi.outside")
    point = tensor(case["inputs"]["x"])[None]
    ones = VoxelGrid(torch.ones(3, 3, 3, dtype=torch.float64), tensor([0.0, 0, 0]), 0.1)
    assert ones.interpolate(point).item() == case["expected"]["I"]
    free = tensor(case["expected"]["p"])
    classes = ones.with_values(torch.full((3, 3, 3, 3), 1 / 3, dtype=torch.float64))
    assert torch.equal(classes.interpolate(point, free)[0], free)


def test_axis_of_one_node_carries_no_extent(generator):
    field = grid(generator, (4, 5, 1))
    points = field.origin + torch.rand(20, 3, dtype=torch.float64, generator=generator)
    lifted = points + tensor([0.0, 0.0, 7.0])
    assert torch.equal(field.interpolate(points), field.interpolate(lifted))
    assert field.nearest_index(lifted)[1].all()


def test_not_finite_is_outside(generator):
    field = grid(generator)
    bad = tensor([[math.nan, 1.0, 2.0], [0.0, math.inf, 2.0]])
    assert (field.interpolate(bad, 4.0) == 4.0).all()
    assert torch.isfinite(field.interpolate(bad, None)).all()
    assert not field.nearest_index(bad)[1].any()


@pytest.mark.parametrize("outside", [0.3, None])
def test_autograd(outside, generator):
    field = grid(generator, (3, 3, 2), (2,))
    points = field.origin + 1.4 * torch.rand(5, 3, dtype=torch.float64, generator=generator) - 0.2

    def look_up(values, p):
        return field.with_values(values).interpolate(p, outside)

    inputs = (field.values.clone().requires_grad_(), points.requires_grad_())
    assert torch.autograd.gradcheck(look_up, inputs)
    assert torch.autograd.gradgradcheck(look_up, inputs)


def test_module_manners(generator):
    field = grid(generator)
    assert set(field.state_dict()) == {"values", "origin"}
    moved = VoxelGrid(field.values, field.origin, field.spacing).to(torch.float32)
    assert moved.interpolate(torch.zeros(0, 3)).shape == (0,)
    assert moved.centers().dtype == moved.interpolate(torch.zeros(1, 3)).dtype == torch.float32
    with pytest.raises(ValueError, match="positive number of metres, got 0"):
        VoxelGrid(field.values, field.origin, 0.0)
