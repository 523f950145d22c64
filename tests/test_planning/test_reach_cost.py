"""Reachability cost, of objects that move and that turn, against golden numbers and sums spelt out."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from rumi.fields.workspace import Workspace
from rumi.planning.reach_cost import CrossCorrelation, ReachabilityCost, turned_information
from sdf import backend
from sdf.voxel_grid import VoxelGrid
from tests.fixtures.sparse_fields import DOUBLE, sparse_field

# every test of this file holds for all versions
pytestmark = [
    pytest.mark.usefixtures("version"),
    pytest.mark.parametrize("version", ["torch", "numba", "warp"], indirect=True),
]


@pytest.mark.parametrize("name", ["zero", "lattice", "out", "zero_info"])
def test_golden_reachability(golden: Callable[[str], dict[str, Any]], name: str) -> None:
    case = golden(f"rumi.C_R.{name}")
    values = [torch.tensor(case["inputs"][k], **DOUBLE)[..., None] for k in "Ir"]
    maps = [VoxelGrid(v, torch.zeros(3, **DOUBLE), 1.0) for v in values]
    moved = torch.nn.functional.pad(torch.tensor(case["inputs"]["d"], **DOUBLE), (0, 1))
    cost = ReachabilityCost(maps[0], maps[1])(moved)
    torch.testing.assert_close(cost, torch.tensor(case["expected"]["C_R"], **DOUBLE), atol=case["atol"], rtol=0)


@pytest.mark.parametrize("shape", [(7, 6, 1), (5, 4, 3), (1, 6, 1), (1, 1, 1)])
def test_reachability_cost_is_the_direct_sum(shape: tuple[int, int, int], generator: torch.Generator) -> None:
    information, reachability = sparse_field(shape, generator, 1.0), sparse_field(shape, generator, 1.0)
    moved = 0.2 * torch.randn(20, 5, 3, generator=generator, **DOUBLE)
    moved[0] = 0
    centres = information.centers().reshape(-1, 3)
    direct = torch.stack(
        [
            torch.stack([(reachability.values.flatten() * information.interpolate(centres - d)).sum() for d in path])
            for path in moved
        ]
    )
    expected = -direct.mean(-1) / information.values.sum()
    cost = ReachabilityCost(information, reachability)(moved)
    torch.testing.assert_close(cost, expected)
    assert float(cost.min()) >= -1
    assert float(cost.max()) <= 0
    single = ReachabilityCost(
        VoxelGrid(information.values.float(), information.origin.float(), 0.04),
        VoxelGrid(reachability.values.float(), information.origin.float(), 0.04),
    )
    torch.testing.assert_close(single(moved.float()).double(), expected, atol=1e-5, rtol=0)


def test_cross_correlation_is_its_definition(generator: torch.Generator) -> None:
    r, information = torch.rand(2, 3, 4, 1, generator=generator, **DOUBLE)
    table = CrossCorrelation(r)(information)
    assert table.shape == (5, 7, 1)
    for i in range(-2, 3):
        for j in range(-3, 4):
            total = sum(
                float(r[x, y, 0] * information[x - i, y - j, 0])
                for x in range(3)
                for y in range(4)
                if 0 <= x - i < 3 and 0 <= y - j < 4
            )
            assert float(table[i + 2, j + 3, 0]) == pytest.approx(total)


def test_pushing_information_out_of_reach_costs() -> None:
    """Reach falls with x, so a push along +x costs (the printed sign, checked against W + d)."""
    lattice = Workspace.from_bounds(torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 0.0]], **DOUBLE), 0.1)
    information = lattice.zeros()
    information.values[5, 5] = 2.0
    cost = ReachabilityCost(information, lattice.grid(1.0 - lattice.points[:, 0]))
    pushes = torch.tensor([[[-0.2, 0.0, 0.0]], [[0.0, 0.0, 0.0]], [[0.25, 0.0, 0.0]], [[0.9, 0.0, 0.0]]], **DOUBLE)
    torch.testing.assert_close(cost(pushes), torch.tensor([-0.7, -0.5, -0.25, 0.0], **DOUBLE))


def test_reachability_of_turned_information_is_the_direct_sum(generator: torch.Generator) -> None:
    """A smooth reach and a patch of information that stays inside: turned, moved, and summed point by point."""
    low = torch.tensor([[-0.5, -0.5, 0.0], [0.5, 0.5, 0.0]], **DOUBLE)
    lattice = VoxelGrid.from_bounds(low, 0.02)
    nodes = lattice.centers().reshape(*lattice.shape, 3)
    pivot = torch.tensor([0.03, -0.06], **DOUBLE)
    arm = nodes[..., :2] - pivot
    information = VoxelGrid(
        torch.rand(lattice.shape, generator=generator, **DOUBLE) * ((arm - 0.06).norm(dim=-1) < 0.08),
        lattice.origin,
        lattice.spacing,
    )
    reachability = VoxelGrid((0.5 + nodes[..., 0] - 0.7 * nodes[..., 1] ** 2).clamp(0, 1), lattice.origin, 0.02)
    displacements = 0.08 * torch.randn(5, 3, 3, generator=generator, **DOUBLE)
    turns = 3.0 * torch.randn(5, 3, generator=generator, **DOUBLE)
    cost = ReachabilityCost(information, reachability)(displacements, turns, pivot)
    total = torch.zeros(5, 3, **DOUBLE)
    for i in range(5):
        for j in range(3):
            cos, sin = turns[i, j].cos(), turns[i, j].sin()
            away = arm @ torch.stack((torch.stack((cos, sin)), torch.stack((-sin, cos))))
            place = torch.cat((away + pivot + displacements[i, j, :2], torch.zeros_like(away[..., :1])), -1)
            total[i, j] = (reachability.interpolate(place.reshape(-1, 3)) * information.values.reshape(-1)).sum()
    expected = -(total / information.values.sum()).mean(-1)
    torch.testing.assert_close(cost, expected, atol=5e-3, rtol=0)
    finer = ReachabilityCost(information, reachability, turn_step=0.02)(displacements, turns, pivot)
    torch.testing.assert_close(finer, expected, atol=5e-4, rtol=0)


def test_reachability_of_turned_layers_is_that_of_each(generator: torch.Generator) -> None:
    """What turns stays at its height: the layers' own costs, weighed by what each holds."""
    information, reachability = sparse_field((9, 8, 3), generator), sparse_field((9, 8, 3), generator, 0.8)
    displacements = 0.1 * torch.randn(4, 2, 3, generator=generator, **DOUBLE) * torch.tensor([1.0, 1.0, 0.0], **DOUBLE)
    turns, pivot = torch.randn(4, 2, generator=generator, **DOUBLE), torch.tensor([0.02, 0.03], **DOUBLE)
    expected = torch.zeros(4, **DOUBLE)
    for k in range(3):
        one, two = (VoxelGrid(f.values[:, :, k : k + 1], f.origin, f.spacing) for f in (information, reachability))
        share = one.values.sum() / information.values.sum()
        expected += share * ReachabilityCost(one, two)(displacements, turns, pivot)
    torch.testing.assert_close(ReachabilityCost(information, reachability)(displacements, turns, pivot), expected)
    assert float(expected.min()) < -0.01


@pytest.mark.parametrize(("dtype", "close"), [(torch.float32, 1e-6), (torch.float64, 1e-12)])
def test_turned_reach_is_the_look_up_in_transformed_tables(
    dtype: torch.dtype, close: float, generator: torch.Generator
) -> None:
    """Within the lattice, at its ends and beyond, whole turns and none, whole shifts and none, at once and again."""
    information, reachability = (
        VoxelGrid(field.values.to(dtype), field.origin.to(dtype), field.spacing)
        for field in (sparse_field((9, 7, 3), generator), sparse_field((9, 7, 3), generator, 0.8))
    )
    moved = 0.2 * torch.randn(40, 5, 3, generator=generator, dtype=dtype)
    turns = torch.where(moved[..., 2] > 0, 5.0 * torch.randn(40, 5, generator=generator, dtype=dtype), 0.0)
    turns[0, :3] = torch.tensor([2.0, -1.0, 7.0], dtype=dtype) * 2.0 * torch.pi / 24
    moved[1] = torch.tensor([0.08, -0.12, 0.0], dtype=dtype)
    moved[2, :, :2], moved[3:5], moved[5, 2:] = 0.0, 50.0, moved[5, 1]
    # the last shift of which something is left, the one after it, and next to both
    ends = torch.tensor([[8.0, 6.0], [9.0, 7.0], [8.999, -6.999], [-8.001, 6.001], [-9.0, 0.0]], dtype=dtype)
    moved[6, :, :2], moved[7, :, :2] = 0.04 * ends, -0.04 * ends
    turns[8] = 2.0 * torch.pi * torch.tensor([1.0, -1.0, 3.0, 1e-9, -1e-9], dtype=dtype)
    pivot = torch.tensor([0.02, 0.03], dtype=dtype)
    cost = ReachabilityCost(information, reachability)
    angles = [number * cost.turn_step for number in range(cost.steps)]
    tables = cost.turned_tables(torch.stack([turned_information(cost, angle, pivot) for angle in angles]))
    origin = torch.tensor([-8 * 0.04, -6 * 0.04, 0.0], dtype=dtype)
    shares = torch.stack(
        [
            VoxelGrid(table[..., None], origin, 0.04).interpolate(moved.reshape(-1, 3), outside=0.0).view(40, 5)
            for table in tables
        ]
    )
    place = turns / cost.turn_step
    low = place.floor()
    ends = [shares.gather(0, ((low + up).long() % cost.steps)[None])[0] for up in (0, 1)]
    expected = -(ends[0] + (place - low) * (ends[1] - ends[0]))
    assert float(expected.min()) < -0.1
    alone = torch.stack([cost(row[:, None], turn[:, None], pivot) for row, turn in zip(moved, turns, strict=True)])
    torch.testing.assert_close(alone, expected, atol=close, rtol=0)
    together = cost(moved.reshape(-1, 1, 3), turns.reshape(-1, 1), pivot).view(40, 5)
    other = ReachabilityCost(information, reachability)(moved.reshape(-1, 1, 3), turns.reshape(-1, 1), pivot)
    assert torch.equal(together, other.view(40, 5))
    assert torch.equal(together, alone)


@pytest.mark.parametrize("shape", [(6, 5, 2), (1, 6, 1), (1, 1, 1)])
def test_turned_reach_of_nothing_and_of_lone_nodes(shape: tuple[int, int, int], generator: torch.Generator) -> None:
    """Without information nothing is reached; after a whole turn all is as before it."""
    field, reachability = sparse_field(shape, generator, 1.0), sparse_field(shape, generator, 1.0)
    moved, turns = 0.03 * torch.randn(7, 4, 3, generator=generator, **DOUBLE), torch.ones(7, 4, **DOUBLE)
    moved *= torch.tensor([float(n > 1) for n in shape[:2]] + [0.0], **DOUBLE)  # a lone node, unturned, is everywhere
    pivot = field.origin[:2] + 0.01
    nothing = ReachabilityCost(field.with_values(torch.zeros(shape, **DOUBLE)), reachability)
    assert torch.equal(nothing(moved, turns, pivot), torch.zeros(7, **DOUBLE))
    cost = ReachabilityCost(field, reachability)
    torch.testing.assert_close(cost(moved, 2.0 * torch.pi * turns, pivot), cost(moved))
    turned = cost(moved, turns, pivot)
    assert bool(((turned >= -1.0) & (turned <= 0.0)).all())


def test_turned_reach_has_its_slope_along_information(generator: torch.Generator) -> None:
    field, reachability = sparse_field((5, 4, 1), generator, 1.0), sparse_field((5, 4, 1), generator, 1.0)
    moved, turns = torch.zeros(2, 2, 3, **DOUBLE), torch.tensor([[0.3, -0.2], [0.0, 2.0]], **DOUBLE)

    def cost(values: Tensor) -> Tensor:
        return ReachabilityCost(VoxelGrid(values, field.origin, 0.02), reachability)(moved, turns, field.origin[:2])

    with backend.force("torch"):
        assert torch.autograd.gradcheck(cost, (0.1 + field.values).requires_grad_())
