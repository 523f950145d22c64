"""The tool: where commands take it short of the arm's limit."""

import copy
import math

import pytest
import torch

from rumi.robot.limited_step import LEGS
from rumi.robot.reach import Reach, SpatialReach
from rumi.robot.reach_table import ReachSettings, ReachTable, table_shape
from rumi.robot.tool import CHORD_M, Tool
from sdf import backend

BOUNDS = torch.tensor([[0.0, -0.4], [0.8, 0.4]], dtype=torch.float64)
SPACE = torch.tensor([[0.0, -0.4, 0.03], [0.8, 0.4, 0.2]], dtype=torch.float64)


# every test of this file holds for the plain and for the compiled versions
pytestmark = [
    pytest.mark.usefixtures("version"),
    pytest.mark.parametrize("version", ["torch", "numba", "warp"], indirect=True),
]


@pytest.fixture(scope="module")
def reach():
    """A made-up arm: the wrist, 0.25 m behind the tool, must be between 0.35 and 0.8 m from the base."""
    settings = ReachSettings(radius_step_m=0.01, yaw_steps=60)
    rows, columns = table_shape(settings)
    radius = torch.arange(rows, dtype=torch.float64)[:, None] * settings.radius_step_m
    yaw = torch.linspace(0, math.pi, columns, dtype=torch.float64)[None]
    wrist = torch.sqrt((radius - 0.25 * yaw.cos()) ** 2 + (0.25 * yaw.sin()) ** 2)
    outside = torch.maximum(wrist - 0.8, 0.35 - wrist).clamp_min(0.0)
    return Reach(ReachTable(outside, 0.5 * outside), settings, (-0.45, 0.0, 0.0)).double()


@pytest.fixture(scope="module")
def tool(reach):
    return Tool(BOUNDS, reach)


@pytest.fixture(scope="module")
def free():
    return Tool(BOUNDS)


@pytest.fixture(scope="module")
def flying():
    """Its tip must stay within 1.05 m of the base on the floor, 10 cm less at a height of 20 cm."""
    settings = ReachSettings(radius_step_m=0.01, yaw_steps=20)
    rows, columns = table_shape(settings)
    radius = torch.arange(rows, dtype=torch.float64)[:, None].expand(rows, columns) * settings.radius_step_m
    tables = [
        ReachTable((radius - most).clamp_min(0.0), torch.zeros(rows, columns).double()) for most in (1.05, 1.0, 0.95)
    ]
    reach = SpatialReach(tables, (0.03, 0.115, 0.2), settings, (-0.45, 0.0, 0.0)).double()
    return Tool(SPACE, reach, body_spacing_m=0.012, info_spacing_m=0.010)


def controls(*shape, seed=0):
    return torch.rand(*shape, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) * 2 - 1


def reachable_starts(tool, count, seed=1):
    u = torch.rand(20 * count, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    q = u * torch.tensor([0.8, 0.8, 2 * math.pi], dtype=torch.float64) - torch.tensor([0.0, 0.4, math.pi])
    return q[tool.reach.reachable(q)][:count]


def test_free_motion_is_the_scaled_control(free):
    q = torch.tensor([0.3, 0.0, 0.4], dtype=torch.float64)
    control = torch.tensor([0.5, -1.0, 1.0], dtype=torch.float64)
    reached, refused = free.free_step(q, control)
    torch.testing.assert_close(reached, q + control * torch.tensor([0.08, 0.08, 0.5], dtype=torch.float64))
    assert float(refused) == 0.0


def test_bounds_stop_each_axis(free):
    q = torch.tensor([0.78, 0.0, 0.0], dtype=torch.float64)
    reached, refused = free.free_step(q, torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64))
    torch.testing.assert_close(reached, torch.tensor([0.8, 0.08, 0.0], dtype=torch.float64))
    assert float(refused) == pytest.approx(0.06)


@pytest.mark.parametrize("seed", [1, 4, 20])
def test_path_is_repeated_steps(tool, seed):
    q = reachable_starts(tool, 40)
    u = controls(40, 6, seed=seed)
    path = tool.free_path(q, u, 1)
    assert path.shape == (40, 6, 3)
    now = q
    for index in range(6):
        now, _ = tool.free_step(now, u[:, index])
        torch.testing.assert_close(path[:, index], now, atol=1e-9, rtol=0)
    moved_freely = q[:, None] + (u * tool.scale).cumsum(1)
    blocked = ~tool.within_limits(moved_freely).all(-1)
    assert 5 < int(blocked.sum()) < 40  # the case is worth its name: some paths meet a limit, some do not


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_rows_of_a_batch_equal_single_paths(tool, dtype):
    """To the bit, as do parts of the batch: on the way they meet limits at different steps, or none."""
    tool = copy.deepcopy(tool).to(dtype)
    q, u = reachable_starts(tool, 40).to(dtype), controls(40, 5, seed=3).to(dtype)
    batch = tool.free_path(q, u, 2)
    held = ~tool.within_limits(q[:, None] + (u * tool.scale).cumsum(1)).all(-1)
    assert 10 < int(held.sum()) < 40
    for row in range(0, 40, 3):
        assert torch.equal(tool.free_path(q[row], u[row], 2), batch[row])
    for size in (2, 7, 16, 33):
        parts = zip(q.split(size), u.split(size), strict=True)
        assert torch.equal(torch.cat([tool.free_path(*part, 2) for part in parts]), batch)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_rows_of_a_batch_equal_single_steps_at_the_limit(tool, dtype):
    """To the bit, also round the limit, by angles of which a processor may work out several at once."""
    tool = copy.deepcopy(tool).to(dtype)
    q = reachable_starts(tool, 2000).to(dtype)
    u = (q * torch.tensor([2.0, 2.0, 0.0], dtype=dtype) + 0.3 * controls(2000, seed=4).to(dtype)).clamp(-1, 1)
    held = ~tool.within_limits(q + u * tool.scale)
    q, u = q[held][:120], u[held][:120]
    batch, _ = tool.free_step(q, u)
    turned = ((batch[:, 2] - q[:, 2] - u[:, 2] * tool.scale[2]).abs() > 1e-3).sum()
    assert len(q) == 120 and int(turned) > 20
    for row in range(0, 120, 12):
        assert torch.equal(tool.free_step(q[row], u[row])[0], batch[row])
    for size in (2, 3, 7, 16, 33, 100):
        parts = zip(q.split(size), u.split(size), strict=True)
        assert torch.equal(torch.cat([tool.free_step(*part)[0] for part in parts]), batch)


def test_batches_keep_their_shape(tool):
    q, u = reachable_starts(tool, 8), controls(8, 5, seed=3)
    batch = tool.free_path(q, u, 4)
    nested = tool.free_path(q.reshape(2, 4, 3), u.reshape(2, 4, 5, 3), 4)
    torch.testing.assert_close(nested, batch.reshape(2, 4, 20, 3))
    # one start for many control sequences
    torch.testing.assert_close(tool.free_path(q[0], u, 4), tool.free_path(q[:1].expand(8, 3), u, 4))


def test_never_leaves_reach_or_bounds(tool):
    path = tool.free_path(reachable_starts(tool, 100), controls(100, 10, seed=4), 4)
    assert bool((tool.reach.residual(path) <= tool.reach.settings.tolerance_m + CHORD_M).all())
    assert bool(((path[..., :2] >= BOUNDS[0]) & (path[..., :2] <= BOUNDS[1])).all())


def test_straight_out_stops_at_the_limit_and_is_refused(tool):
    q = torch.tensor([0.55, 0.0, 0.0], dtype=torch.float64)
    reached, refused = tool.free_step(q, torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64))
    # the limit of the residual: 5 mm of position with half as much rotation
    limit = 0.6 + 0.005 / 1.05
    assert float(reached[0]) == pytest.approx(limit, abs=0.006)
    assert float(reached[0]) <= limit + 1e-6
    assert float(refused) == pytest.approx(0.63 - float(reached[0]))


def test_slides_along_the_limit(tool):
    """Pushed out and sideways at the limit, the tool goes on sideways: it does not freeze."""
    now = torch.tensor([0.6, 0.0, 0.0], dtype=torch.float64)
    control = torch.tensor([1.0, 0.5, 0.0], dtype=torch.float64)
    for _ in range(4):
        before = now
        now = tool.free_path(now, control[None], 4)[-1]
        assert float(now[1] - before[1]) > 0.02


def test_an_action_ends_at_the_same_place_by_any_number_of_mini_steps(tool):
    """A planner of whole actions and a robot that is sent along their parts, at the limit too."""
    q, u = reachable_starts(tool, 400), controls(400, 3, seed=5)
    whole, fine = tool.free_path(q, u, 1), tool.free_path(q, u, 20)
    aim = q + u[:, 0] * tool.scale
    aim[:, :2] = aim[:, :2].clamp(BOUNDS[0], BOUNDS[1])
    refused = ~tool.reach.reachable(aim)
    assert int(refused.sum()) > 30
    # all but what would go through the arm's base
    assert int(((fine[:, -1] - whole[:, -1]).abs() > 1e-9).any(-1).sum()) < 10
    legs = tool.free_path(q, u[:, :1], LEGS)
    torch.testing.assert_close(legs[refused], _legs(tool, q, u)[refused], atol=1e-9, rtol=0)


def _legs(tool, q, controls):
    """An action leg by leg; a leg that meets the limit ends as a whole action does of which it is all."""
    ends, settings = [], tool.reach.settings
    for _ in range(LEGS):
        aim = q + controls[:, 0] * tool.scale / LEGS
        aim[:, :2] = aim[:, :2].clamp(BOUNDS[0], BOUNDS[1])
        limit = tool.reach.residual(q).clamp_min(settings.tolerance_m) + 1e-6
        rows = []
        for start, end, most in zip(q, aim, limit, strict=True):
            rows.append(_leg(tool, start, end, float(most)))
        q = torch.stack(rows)
        ends.append(q)
    return torch.stack(ends, 1)


def _leg(tool, q, aim, most):
    def allowed(at):
        return float(tool.reach.residual(at)) <= most

    if allowed(aim):
        return aim
    passed = 0
    while passed < 15 and allowed(q + (passed + 1) / 16 * (aim - q)):
        passed += 1
    q = q + passed / 16 * (aim - q)
    base = tool.reach.base[:2]
    now, then = q[:2] - base, aim[:2] - base
    circle = torch.maximum(torch.minimum(base + then * (now.norm() / then.norm()), BOUNDS[1]), BOUNDS[0])
    swing = torch.atan2(now[0] * then[1] - now[1] * then[0], now @ then)
    for way in (torch.cat((aim[:2], q[2:])), torch.cat((circle, aim[2:])), torch.cat((circle, q[2:] + swing))):
        if allowed(way):
            return way
    return q


def test_pushed_out_along_the_limit_it_comes_as_near_as_it_can(tool):
    """Action by action, no farther from the limit than a part of a leg."""
    now = torch.tensor([0.58, 0.0, 0.0], dtype=torch.float64)
    for _ in range(4):
        now, _ = tool.free_step(now, torch.tensor([1.0, 0.3, 0.0], dtype=torch.float64))
    farther = now + torch.tensor([now[0] + 0.45, now[1], 0.0]) / float((now[:2] - tool.reach.base[:2]).norm()) * 0.002
    assert bool(tool.reach.reachable(now)) and not bool(tool.reach.reachable(farther))


def test_from_out_of_reach_it_may_come_back(tool):
    q = torch.tensor([0.7, 0.0, 0.0], dtype=torch.float64)
    assert not bool(tool.reach.reachable(q))
    inward, _ = tool.free_step(q, torch.tensor([-0.5, 0.0, 0.0], dtype=torch.float64))
    assert float(inward[0]) == pytest.approx(0.66)
    outward, refused = tool.free_step(q, torch.tensor([0.5, 0.0, 0.0], dtype=torch.float64))
    torch.testing.assert_close(outward, q)
    assert float(refused) == pytest.approx(0.04)


def test_moves_to_another_dtype(tool):
    q, u = reachable_starts(tool, 20), controls(20, 3, seed=6)
    single = copy.deepcopy(tool).to(torch.float32)
    path = single.free_path(q.float(), u.float(), 4)
    assert path.dtype == torch.float32
    gap = (path.double() - tool.free_path(q, u, 4)).norm(dim=-1).amax(-1)
    assert float(gap.median()) < 1e-5  # where a path just meets the limit the two may part


def test_bad_arguments(free, no_shape_check):
    with pytest.raises(ValueError, match="mini_steps"):
        free.free_path(torch.zeros(3), torch.zeros(1, 3), 0)
    with pytest.raises(ValueError, match="count"):
        free.covering_discs(0)
    with pytest.raises(ValueError, match=r"bounds.*\(2, 2\)"):
        Tool(torch.zeros(3, 2))


def test_versions_agree(tool):
    """On the way to and round every limit, also from places that are out of reach already."""
    start = torch.cat((reachable_starts(tool, 300), reachable_starts(tool, 300, seed=2) + 0.1))
    sequences = controls(len(start), 8, seed=3)
    with backend.force("torch"):
        plain = tool.free_path(start, sequences, 1)
    torch.testing.assert_close(tool.free_path(start, sequences, 1), plain, atol=1e-9, rtol=0)
    assert not torch.allclose(Tool(BOUNDS).free_path(start, sequences, 1), plain, atol=1e-3)


def test_free_motion_and_bounds_in_space(flying):
    q = torch.tensor([0.3, 0.0, 0.06, 0.4], dtype=torch.float64)
    reached, refused = flying.free_step(q, torch.tensor([0.5, -1.0, 0.5, 1.0], dtype=torch.float64))
    torch.testing.assert_close(reached, q + torch.tensor([0.04, -0.08, 0.04, 0.5], dtype=torch.float64))
    assert float(refused) == 0.0
    down, refused = flying.free_step(q, torch.tensor([0.0, 0.0, -1.0, 0.0], dtype=torch.float64))
    assert float(down[2]) == pytest.approx(0.03) and float(refused) == pytest.approx(0.05)


def test_in_space_it_never_leaves_reach_or_bounds_and_is_repeated_steps(flying, generator):
    start = torch.tensor([0.45, 0.0, 0.1, 0.0], dtype=torch.float64)
    controls = torch.rand(40, 6, 4, generator=generator, dtype=torch.float64) * 2 - 0.8
    path = flying.free_path(start, controls, 4)
    assert bool((flying.reach.residual(path) <= flying.reach.settings.tolerance_m + 1e-5).all())
    assert bool(((path[..., :3] >= SPACE[0]) & (path[..., :3] <= SPACE[1])).all())
    ends, now = flying.free_path(start, controls, 1), start.expand(40, 4)
    for index in range(6):
        now, _ = flying.free_step(now, controls[:, index])
        torch.testing.assert_close(ends[:, index], now, atol=1e-9, rtol=0)
    free = start + (controls * flying.scale).cumsum(1)
    assert int((~flying.within_limits(free).all(-1)).sum()) > 5


def test_in_space_it_slides_along_the_limit_and_rises_no_farther_than_it_reaches(flying):
    now = torch.tensor([0.59, 0.0, 0.03, 0.0], dtype=torch.float64)
    for _ in range(4):
        before = now
        now, _ = flying.free_step(now, torch.tensor([1.0, 0.5, 0.0, 0.0], dtype=torch.float64))
        assert float(now[1] - before[1]) > 0.02
    # the reach shrinks upward: straight up from the limit is refused, up and back is not
    radius = math.hypot(float(now[0]) + 0.45, float(now[1]))
    up, _ = flying.free_step(now, torch.tensor([0.0, 0.0, 1.0, 0.0], dtype=torch.float64))
    assert float(up[2] - now[2]) < 0.02 and radius > 1.04
    back, _ = flying.free_step(now, torch.tensor([-1.0, 0.0, 1.0, 0.0], dtype=torch.float64))
    assert float(back[2] - now[2]) == pytest.approx(0.08)
