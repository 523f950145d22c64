"""Information and reachability cost, of tools in a plane and in space, against golden numbers and sums spelt out."""

import pytest
import torch
from torch import Tensor

from rumi.dynamics.base import Paths, PushRollouts
from rumi.planning.costs import InformationCost, information_cost
from rumi.planning.objective import TrajectoryCost, gathered_by_action, pushed_way, without
from rumi.planning.reach_cost import ReachabilityCost
from sdf import backend, se3
from sdf.voxel_grid import VoxelGrid
from tests.fixtures.sparse_fields import DOUBLE, sparse_field

# every test of this file holds for all versions
pytestmark = [
    pytest.mark.usefixtures("version"),
    pytest.mark.parametrize("version", ["torch", "numba", "warp"], indirect=True),
]


def sensing_points(generator: torch.Generator, count: int = 25) -> Tensor:
    return (torch.rand(count, 3, generator=generator, **DOUBLE) - 0.5) * torch.tensor([0.3, 0.2, 0.0], **DOUBLE) + (
        torch.tensor([0.0, 0.0, 0.05], **DOUBLE)
    )


def paths(generator: torch.Generator, count: int = 300, horizon: int = 4) -> tuple[Tensor, Tensor]:
    q = torch.randn(count, horizon, 3, generator=generator, **DOUBLE) * torch.tensor([0.3, 0.3, 2.0], **DOUBLE)
    d = 0.1 * torch.randn(count, horizon, 3, generator=generator, **DOUBLE) * torch.tensor([1.0, 1.0, 0.0], **DOUBLE)
    q[::3, 2] = q[::3, 1]  # some steps that repeat the one before
    d[::3, 2] = d[::3, 1]
    d[::7] = 0
    return q, d


def solid_field(generator: torch.Generator, share: float = 0.3) -> VoxelGrid:
    values = torch.rand(14, 12, 6, generator=generator, **DOUBLE)
    kept = torch.rand(14, 12, 6, generator=generator, **DOUBLE) < share
    return VoxelGrid(values * kept, torch.tensor([0.1, -0.1, 0.0], **DOUBLE), 0.02)


def solid_points(generator: torch.Generator) -> Tensor:
    return (torch.rand(20, 3, generator=generator, **DOUBLE) - 0.5) * torch.tensor([0.08, 0.06, 0.05], **DOUBLE)


def paths_in_space(generator: torch.Generator, count: int = 120, horizon: int = 4) -> tuple[Tensor, Tensor]:
    low, span = torch.tensor([0.0, -0.2, -0.05, -3.0], **DOUBLE), torch.tensor([0.5, 0.45, 0.25, 6.0], **DOUBLE)
    q = low + span * torch.rand(count, horizon, 4, generator=generator, **DOUBLE)
    d = 0.05 * torch.randn(count, horizon, 3, generator=generator, **DOUBLE)
    q[1::3, 2], d[1::3, 2] = q[1::3, 1], d[1::3, 1]  # some stand still
    return q, d


def met_cells(field: VoxelGrid, points: Tensor, q: Tensor, d: Tensor) -> set[tuple[int, ...]]:
    """Cells of the lattice that the points of one path meet, one point after the other; objects move level."""
    cells, spatial = set(), q.shape[-1] == 4
    poses = se3.from_planar(q[:, [0, 1, 3]], q[:, 2]) if spatial else se3.from_planar(q)
    for pose, shift in zip(poses, d * d.new_tensor([1.0, 1.0, 0.0 if spatial else 1.0]), strict=True):
        world = se3.apply(pose, points) - shift
        index, inside = field.nearest_index(world)
        cells |= {tuple(cell) for cell, held in zip(index.tolist(), inside.tolist(), strict=True) if held}
    return cells


@pytest.mark.parametrize("shape", [(14, 12, 1), (9, 10, 4), (1, 12, 1), (1, 1, 1)])
@pytest.mark.parametrize("normalise", [False, True])
def test_information_cost_is_the_sum_over_the_set_of_cells(
    shape: tuple[int, int, int], normalise: bool, generator: torch.Generator
) -> None:
    field = sparse_field(shape, generator, 0.3 if max(shape) > 1 else 2.0)
    points = sensing_points(generator)
    q, d = paths(generator)
    cost = information_cost(field, points, q, d, normalise=normalise)
    expected = []
    for k in range(0, len(q), 4):
        expected.append(-sum(float(field.values[cell]) for cell in met_cells(field, points, q[k], d[k])))
    expected = torch.tensor(expected, **DOUBLE) / (field.values.sum() if normalise else 1.0)
    torch.testing.assert_close(cost[::4], expected)
    assert float(cost.min()) < 0
    if normalise:
        assert float(cost.min()) >= -1.0


@pytest.mark.parametrize(("discount", "spatial"), [(0.5, False), (0.9, False), (1.0, True), (0.8, True)])
def test_discount_counts_from_the_first_meeting(discount: float, spatial: bool, generator: torch.Generator) -> None:
    if spatial:
        field, points, (q, d) = solid_field(generator), solid_points(generator), paths_in_space(generator)
    else:
        field, points, (q, d) = sparse_field((14, 12, 1), generator), sensing_points(generator), paths(generator)
    cost = information_cost(field, points, q, d, discount=discount)
    for k in range(0, len(q), 1 if spatial else 4):
        expected, met = 0.0, set()
        for action in range(q.shape[1]):
            cells = met_cells(field, points, q[k, action : action + 1], d[k, action : action + 1]) - met
            expected -= discount**action * sum(float(field.values[cell]) for cell in cells)
            met |= cells
        assert float(cost[k]) == pytest.approx(expected, abs=1e-9)
    if spatial:
        assert float(cost.min()) < -1.0 and float((cost == 0).double().mean()) < 0.9
        return
    # worth less than without a discount, but for paths that gather all in their first action
    assert bool((cost >= information_cost(field, points, q, d)).all())
    assert bool((cost > information_cost(field, points, q, d)).any())


def test_undiscounted_is_the_cost_of_the_whole_path(generator: torch.Generator) -> None:
    """Whether the cells were known before or not."""
    field, points, (q, d) = sparse_field((14, 12, 1), generator), sensing_points(generator), paths(generator)
    cost, expected = InformationCost(field, points, discount=0.5, normalise=True), information_cost(field, points, q, d)
    assert torch.equal(cost.undiscounted()(q, d), expected)
    assert not torch.equal(cost(q, d), expected)
    assert torch.equal(cost.undiscounted()(q, d), expected)


def test_moving_along_with_the_object_gathers_nothing_new(generator: torch.Generator) -> None:
    field, points = sparse_field((30, 30, 1), generator, 1.0), sensing_points(generator)
    start = torch.tensor([0.2, 0.2, 0.7], **DOUBLE)
    steps = torch.arange(5, **DOUBLE)[:, None] * torch.tensor([[0.031, -0.017, 0.0]], **DOUBLE)
    alone = information_cost(field, points, start.expand(1, 1, 3), torch.zeros(1, 1, 3, **DOUBLE))
    stuck = information_cost(field, points, (start + steps)[None], steps[None])
    torch.testing.assert_close(stuck, alone)
    passing = information_cost(field, points, (start + steps)[None], torch.zeros(1, 5, 3, **DOUBLE))
    assert float(passing) < 1.2 * float(alone) < 0


@pytest.mark.parametrize("normalise", [False, True])
def test_no_information_costs_nothing(normalise: bool, generator: torch.Generator) -> None:
    field = sparse_field((8, 8, 1), generator, 0.0)
    q, d = paths(generator, 5)
    assert information_cost(field, sensing_points(generator), q, d, normalise=normalise).tolist() == [0.0] * 5
    full = sparse_field((8, 8, 1), generator)
    assert information_cost(full, torch.zeros(0, 3, **DOUBLE), q, d).tolist() == [0.0] * 5
    assert information_cost(full, sensing_points(generator), q + 50.0, d).tolist() == [0.0] * 5
    assert information_cost(full, sensing_points(generator), q[:0], d[:0]).shape == (0,)


def test_no_information_in_space_costs_nothing(generator: torch.Generator) -> None:
    q, d = paths_in_space(generator, 5)
    assert information_cost(solid_field(generator, 0.0), solid_points(generator), q, d).tolist() == [0.0] * 5
    far = q + torch.tensor([0.0, 0.0, 2.0, 0.0], **DOUBLE)
    assert information_cost(solid_field(generator), solid_points(generator), far, d).tolist() == [0.0] * 5


def test_points_above_or_below_the_lattice_meet_nothing(generator: torch.Generator) -> None:
    field = sparse_field((9, 10, 4), generator, 1.0)
    q, d = paths(generator, 5)
    high = sensing_points(generator) + torch.tensor([0.0, 0.0, 0.5], **DOUBLE)
    assert information_cost(field, high, 0.1 * q, d).tolist() == [0.0] * 5


def test_refuses_maps_of_different_workspaces(generator: torch.Generator) -> None:
    with pytest.raises(ValueError, match="one workspace"):
        ReachabilityCost(sparse_field((4, 5, 1), generator), sparse_field((5, 4, 1), generator))
    with pytest.raises(ValueError, match="set reachability_scale to 0"):
        TrajectoryCost(sparse_field((4, 5, 1), generator), None, sensing_points(generator))


def made_up_rollouts(generator: torch.Generator) -> PushRollouts:
    """Rollouts of which some touch nothing and hence agree."""
    samples, count, horizon = 12, 4, 5
    free = 0.2 * torch.randn(samples, 1, horizon + 1, 3, generator=generator, **DOUBLE)
    contact = torch.rand(samples, count, horizon, generator=generator) < 0.15
    contact[0], contact[1] = True, False
    touched = contact.any(-1)[..., None, None]
    other = 0.2 * torch.randn(samples, count, horizon + 1, 3, generator=generator, **DOUBLE)
    moved = 0.05 * torch.randn(samples, count, horizon + 1, 3, generator=generator, **DOUBLE)
    states = torch.where(touched, other, free.expand_as(other))
    untouched = ~contact.any(-1)
    duplicate_of = torch.where(untouched, untouched.to(torch.uint8).argmax(-1, keepdim=True), torch.arange(count))
    return PushRollouts(states, torch.where(touched, moved, 0.0), contact, 1.0, duplicate_of)


@pytest.mark.parametrize(("beta_i", "beta_r"), [(1.0, 1.0), (0.5, 200.0), (1.0, 0.0), (0.0, 3.0)])
def test_trajectory_cost_is_the_mean_of_every_rollouts_own(
    beta_i: float, beta_r: float, generator: torch.Generator
) -> None:
    information, reachability = (sparse_field((12, 11, 1), generator) for _ in range(2))
    points, rollouts = sensing_points(generator), made_up_rollouts(generator)
    cost = TrajectoryCost(
        information, reachability, points, information_scale=beta_i, reachability_scale=beta_r, normalise=False
    )(rollouts)
    q, d = rollouts.configurations[:, :, 1:], rollouts.displacements[:, :, 1:]
    gathered = torch.stack([information_cost(information, points, q[k], d[k]) for k in range(len(q))])
    reached = ReachabilityCost(information, reachability)(d)
    torch.testing.assert_close(cost, (beta_i * gathered + beta_r * reached).mean(-1))


def test_what_a_push_costs_is_its_way_there_and_back(generator: torch.Generator) -> None:
    moved = torch.zeros(2, 2, 4, 3)
    moved[0, 0, 1:, 0] = torch.tensor([0.03, 0.03, 0.01])  # there, nothing, and back
    moved[0, 1, 3] = torch.tensor([0.0, 0.06, 0.08])
    still = torch.zeros(2, 2, 4, 4)
    rollouts = PushRollouts(still, moved, torch.zeros(2, 2, 3, dtype=torch.bool), 1.0, torch.arange(2).expand(2, 2))
    torch.testing.assert_close(pushed_way(rollouts), torch.tensor([0.5 * (0.05 + 0.10), 0.0]))
    expected = torch.tensor([0.5 * (0.03 + 0.25 * 0.02 + 0.25 * 0.10), 0.0])
    torch.testing.assert_close(pushed_way(rollouts, 0.5), expected)
    grid = VoxelGrid(torch.rand(4, 4, 4, generator=generator), torch.zeros(3), 0.02)
    points, weight = 0.01 * torch.rand(5, 3, generator=generator), {"information_discount": 0.5, "spatial": True}
    free, dear = (TrajectoryCost(grid, grid, points, push_scale=scale, **weight)(rollouts) for scale in (0.0, 3.0))
    torch.testing.assert_close(dear - free, 3.0 * expected)


def test_cells_of_points_are_left_out_of_a_field(generator: torch.Generator) -> None:
    grid = VoxelGrid(1.0 + torch.rand(3, 4, 5, generator=generator), torch.zeros(3), 0.02)
    left = without(grid, torch.tensor([[0.021, 0.0, 0.079], [0.019, 0.001, 0.081], [9.0, 0.0, 0.0]]))
    assert (left.values == 0).nonzero().tolist() == [[1, 0, 4]]
    kept = left.values > 0
    assert torch.equal(left.values[kept], grid.values[kept]) and float(grid.values.min()) >= 1.0


def test_information_that_does_not_follow_the_object(generator: torch.Generator) -> None:
    """Without displacement the cost is that of an object that stays (Eq 28), and pushing along seems to gather."""
    field = sparse_field((14, 12, 1), generator)
    points = sensing_points(generator)
    q, d = paths(generator, 40)
    still = torch.zeros_like(d)
    expected = information_cost(field, points, q, still)

    def cost(follow: bool) -> Tensor:
        states, moved = (torch.nn.functional.pad(x, (0, 0, 1, 0))[:, None] for x in (q, d))
        duplicate_of = torch.zeros(len(q), 1, dtype=torch.long)
        rollouts = PushRollouts(states, moved, torch.zeros(len(q), 1, 4, dtype=torch.bool), 1.0, duplicate_of)
        whole = TrajectoryCost(
            field, None, points, reachability_scale=0.0, normalise=False, displaced_information=follow
        )
        return whole(rollouts)

    torch.testing.assert_close(cost(False), expected)
    torch.testing.assert_close(cost(True), information_cost(field, points, q, d))
    assert float((cost(True) - cost(False)).abs().max()) > 0.1


def test_what_each_action_gathers_anew(generator: torch.Generator) -> None:
    field = sparse_field((14, 12, 1), generator)
    points = sensing_points(generator)
    q, d = (x[0] for x in paths(generator, 1))
    whole = InformationCost(field, points)
    states, moved = (torch.nn.functional.pad(x, (0, 0, 1, 0))[None, None] for x in (q, d))
    likely = PushRollouts(
        states, moved, torch.zeros(1, 1, 4, dtype=torch.bool), 1.0, torch.zeros(1, 1, dtype=torch.long)
    )
    by_action = gathered_by_action(lambda *path: -whole(*path), likely)
    seen: set[tuple[int, ...]] = set()
    for h in range(4):
        here = met_cells(field, points, q[h : h + 1], d[h : h + 1])
        new = sum(float(field.values[cell]) for cell in here - seen)
        assert float(by_action[h]) == pytest.approx(new, abs=1e-9)
        seen |= here
    assert float(by_action.sum()) == pytest.approx(-float(whole(q[None], d[None])))


def turning_rollouts(generator: torch.Generator) -> PushRollouts:
    made = made_up_rollouts(generator)
    turns = torch.where(made.touched[..., None], torch.randn(made.displacements.shape[:-1], generator=generator), 0.0)
    return made._replace(turns=turns.double(), pivot=torch.tensor([0.1, -0.05], **DOUBLE))


def test_information_turns_with_the_object(generator: torch.Generator) -> None:
    """What the tool meets of a moved object is what it meets of an unmoved one from the place moved back."""
    rollouts = turning_rollouts(generator)
    points = torch.cat((sensing_points(generator)[:, :2], torch.ones(len(sensing_points(generator)), 1, **DOUBLE)), -1)
    seen, _ = Paths(rollouts.configurations, rollouts.displacements, rollouts.turns, rollouts.pivot).in_object_frame()
    for k, m, t in ((0, 1, 2), (0, 3, 4), (1, 0, 1)):
        turn, pivot = rollouts.turns[k, m, t], rollouts.pivot
        object_moved = se3.from_planar(torch.cat((pivot + rollouts.displacements[k, m, t, :2], turn[None])))
        object_before = se3.from_planar(torch.cat((pivot, torch.zeros(1, **DOUBLE))))
        from_object = se3.inverse(object_moved) @ se3.from_planar(rollouts.configurations[k, m, t])
        expected = se3.apply(object_before @ from_object, points)
        torch.testing.assert_close(se3.apply(se3.from_planar(seen[k, m, t]), points), expected)


def test_trajectory_cost_of_turning_objects(generator: torch.Generator) -> None:
    information, reachability = (sparse_field((12, 11, 1), generator) for _ in range(2))
    points, rollouts = sensing_points(generator), turning_rollouts(generator)
    cost = TrajectoryCost(information, reachability, points, normalise=False)(rollouts)
    q, d = rollouts.configurations[:, :, 1:], rollouts.displacements[:, :, 1:]
    seen, _ = Paths(q, d, rollouts.turns[:, :, 1:], rollouts.pivot).in_object_frame()
    gathered = torch.stack(
        [information_cost(information, points, seen[k], torch.zeros_like(d[k])) for k in range(len(q))]
    )
    reached = ReachabilityCost(information, reachability)(d, rollouts.turns[:, :, 1:], rollouts.pivot)
    torch.testing.assert_close(cost, (gathered + reached).mean(-1))
    # without turns it is the cost of displacements
    still = rollouts._replace(turns=torch.zeros_like(rollouts.turns))
    plain = rollouts._replace(turns=None, pivot=None)
    cost_of = TrajectoryCost(information, reachability, points)
    torch.testing.assert_close(cost_of(still), cost_of(plain))


def test_information_turns_with_the_object_in_space(generator: torch.Generator) -> None:
    """Height stays, and the rest is as in the plane."""
    rollouts = turning_rollouts(generator)
    q = rollouts.configurations
    planar, moved = Paths(q, rollouts.displacements, rollouts.turns, rollouts.pivot).in_object_frame()
    raised = torch.cat((q[..., :2], torch.randn(q[..., :1].shape, generator=generator, **DOUBLE), q[..., 2:]), -1)
    seen, still = Paths(raised, rollouts.displacements, rollouts.turns, rollouts.pivot).in_object_frame()
    assert torch.equal(seen[..., [0, 1, 3]], planar)
    assert torch.equal(seen[..., 2], raised[..., 2])
    assert torch.equal(still, moved)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_versions_agree_in_space(dtype: torch.dtype, generator: torch.Generator) -> None:
    field, points = solid_field(generator).to(dtype), solid_points(generator).to(dtype)
    for count, horizon in ((200, 6), (1, 1), (0, 3)):
        q, d = (part.to(dtype) for part in paths_in_space(generator, max(count, 1), max(horizon, 3)))
        q, d = q[:count, :horizon], d[:count, :horizon]
        with backend.force("torch"):
            plain = information_cost(field, points, q, d, discount=0.9)
        result = information_cost(field, points, q, d, discount=0.9)
        # in single precision a point on the border of two cells may fall into either
        near = (result - plain).abs() < 1e-5
        assert count == 0 or float(near.double().mean()) > (0.97 if dtype == torch.float32 else 0.999)
