"""Registration of points alone: of one mode, of several, and of nothing."""

import math

import pytest
import torch

from rumi.registration.descent import DescentSettings, descend
from rumi.registration.register import RegisterSettings, net, register, uniform_starts
from scripts.bench import box_view as patch
from scripts.bench.modes import lost_modes, plausible_modes
from sdf import se3, so3
from sdf.grid_sdf import GridSDF
from sdf.primitives import Box
from sensors.discrepancy import Discrepancy
from sensors.observation import Observation, concatenate
from sensors.semantics import Semantics

EDGES = (0.03, 0.05, 0.08)
TABLE = GridSDF.from_sdf(Box(EDGES), 0.005)
MODULE = Discrepancy(TABLE, 0.1, free_scale=20.0)
SETTINGS = RegisterSettings(starts=600, polished=200)


def box_view(count: int, sides: tuple[tuple[int, float], ...], seed: int = 0) -> torch.Tensor:
    """Points of some sides (axis, sign) of the box."""
    random = torch.Generator().manual_seed(seed)
    points = (2 * torch.rand(count, 3, generator=random) - 1) * torch.tensor(EDGES)
    for n, (axis, sign) in enumerate(sides):
        points[n :: len(sides), axis] = sign * EDGES[axis]
    return points


ALL = tuple((axis, sign) for axis in range(3) for sign in (-1.0, 1.0))
SYMMETRIES = torch.diag_embed(torch.tensor([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]))


def truth(seed: int) -> torch.Tensor:
    random = torch.Generator().manual_seed(seed)
    return se3.make(so3.exp(2 * torch.randn(3, generator=random)), 0.3 * torch.randn(3, generator=random))


def test_modes_are_the_poses_that_explain_the_points_and_are_missed_where_none_is_near():
    world_T_object = truth(4)
    points = se3.apply(world_T_object, box_view(150, ALL))
    observation = Observation.of(points - points.mean(0), Semantics.SURFACE)
    random = torch.Generator().manual_seed(0)
    modes = plausible_modes(MODULE, observation, 20.0, starts=600, generator=random)
    assert len(modes.mode.unique()) == 4
    assert float(modes.weight.max()) == 1.0
    found = register(MODULE, observation, 20.0, SETTINGS, generator=random).frame_T_object
    assert lost_modes(modes, found, torch.zeros(3)) == []
    assert len(lost_modes(modes, found[:1], torch.zeros(3))) == 3


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_box_is_found_in_all_four_of_its_poses(seed):
    world_T_object = truth(seed)
    inside = Observation.of(se3.apply(world_T_object, 0.6 * box_view(60, ALL)), Semantics.OCCUPIED)
    outside = Observation.of(se3.apply(world_T_object, 1.3 * box_view(60, ALL)), Semantics.FREE)
    seen = Observation.of(se3.apply(world_T_object, box_view(150, ALL)), Semantics.SURFACE)
    observation = concatenate([outside, inside, seen])
    found = register(MODULE, observation, 20.0, SETTINGS, generator=torch.Generator().manual_seed(seed))
    assert len(found.frame_T_object) == SETTINGS.kept
    torch.testing.assert_close(MODULE(found.frame_T_object, observation), found.discrepancy)
    offset = (found.frame_T_object[:, :3, 3] - world_T_object[:3, 3]).norm(dim=-1)
    turn = so3.angle(found.frame_T_object[:, None, :3, :3].mT @ (world_T_object[:3, :3] @ SYMMETRIES))
    assert float(offset.max()) < 0.005
    assert float(turn.amin(-1).max()) < 0.1
    assert turn.argmin(-1).unique().tolist() == [0, 1, 2, 3]


def test_a_view_of_one_side_keeps_every_side_it_may_be():
    """Points of a plane and free space in front of it: any of the six sides, turned anyhow about its normal."""
    grid = torch.linspace(-0.02, 0.02, 5)
    x, y = torch.meshgrid(grid, grid, indexing="ij")
    plane = torch.stack((x, y, torch.zeros_like(x)), -1).reshape(-1, 3)
    above = torch.cat([plane + torch.tensor([0.0, 0.0, h]) for h in (0.004, 0.02, 0.05)])
    observation = concatenate([Observation.of(above, Semantics.FREE), Observation.of(plane, Semantics.SURFACE)])
    found = register(MODULE, observation, 200.0, SETTINGS, generator=torch.Generator().manual_seed(0))
    up = found.frame_T_object[:, 2, :3]
    side = up.abs().argmax(-1) * 2 + (torch.gather(up, 1, up.abs().argmax(-1)[:, None])[:, 0] > 0)
    assert float((up.abs().amax(-1) > 0.98).float().mean()) > 0.95
    assert side.unique().tolist() == [0, 1, 2, 3, 4, 5]


def test_starts_are_spread_and_hold_the_points(generator):
    points = torch.tensor([0.4, 0.1, 0.2]) + 0.01 * torch.randn(50, 3, generator=generator)
    observation = Observation.of(points, Semantics.SURFACE)
    starts = uniform_starts(observation, TABLE.bounds, 2000, generator=generator)
    middle = 0.5 * (points.amin(0) + points.amax(0))
    local = se3.apply(se3.inverse(starts), middle.expand(2000, 1, 3))[:, 0]
    assert (local.abs() <= torch.tensor(EDGES) + 1e-5).all()
    directions = torch.cat((torch.eye(3), -torch.eye(3)))
    reached = (starts[:, :3, :3] @ directions[2] @ directions.T).acos()
    assert float(reached.amin(0).max()) < 0.15
    other = uniform_starts(observation, TABLE.bounds, 2000, generator=generator)
    assert float(so3.angle(starts[:, :3, :3].mT @ other[:, :3, :3]).min()) > 1e-3


def test_nothing_to_register(generator):
    with pytest.raises(ValueError, match="points to register"):
        uniform_starts(Observation.empty(), TABLE.bounds, 10, generator=generator)


def test_given_starts_are_what_is_searched_from():
    world_T_object = truth(3)
    observation = Observation.of(se3.apply(world_T_object, box_view(150, ALL)), Semantics.SURFACE)
    near = world_T_object.repeat(5, 1, 1)
    near[:, :3, 3] += 0.004 * torch.randn(5, 3, generator=torch.Generator().manual_seed(0))
    settings = RegisterSettings(kept=5, coarse=DescentSettings(iterations=0))
    found = register(MODULE, observation, 2.0, settings, starts=near, generator=torch.Generator().manual_seed(0))
    best = descend(MODULE, near, observation, "SE(3)", settings.fine)
    assert float(found.discrepancy.min()) == pytest.approx(float(MODULE(best, observation).min()), rel=1e-4)
    assert float((found.frame_T_object[:, :3, 3] - world_T_object[:3, 3]).norm(dim=-1).max()) < 0.003


def test_few_poses_are_spread_over_all_that_is_plausible() -> None:
    """Of a box a patch is seen that fits three pairs of its faces, at far more turns than poses are kept."""
    view = patch.box_view()
    cost = Discrepancy(GridSDF.from_sdf(view.model.exact, 0.004), view.model.radius, free_scale=80.0, tolerance=0.001)
    settings = RegisterSettings(
        kept=20, starts=1200, polished=800, coarse_free=0, bin_rad=math.radians(5.0), bin_m=math.inf
    )
    generator = torch.Generator().manual_seed(1000)
    found = register(cost.double(), view.observation, 2.0, settings, generator=generator)
    assert patch.face_up(found.frame_T_object).unique().tolist() == [0, 1, 2]


def test_a_net_leaves_no_pose_far_from_those_it_chooses(generator):
    """Poses along a line and turned about it: as near to the net as so few of them can be."""
    along = torch.linspace(0.0, 1.0, 401)
    poses = se3.make(
        so3.exp(torch.stack((along, 0 * along, 0 * along), -1)), torch.stack((along, 0 * along, 0 * along), -1)
    )
    settings = RegisterSettings(kept=10, bin_m=0.02, bin_rad=1.0)
    cost = torch.rand(401, generator=generator)
    region = net(poses, cost, torch.zeros(3), settings)
    assert region.unique().tolist() == list(range(int(region.max()) + 1))
    assert 6 <= len(region.unique()) <= settings.kept
    centres = [int(torch.where(region == k, cost, 2.0).argmin()) for k in region.unique()]
    assert region[centres].tolist() == region.unique().tolist()
    reach = (along - along[centres][region]).abs().max()
    # ten intervals could reach 0.05 at best; chosen in the order of their cost, at most twice as far
    assert 0.05 <= float(reach) <= 0.1
    # where orientation alone counts, place does not
    turned = net(poses, cost, torch.zeros(3), RegisterSettings(kept=3, bin_m=math.inf, bin_rad=0.35))
    assert len(turned.unique()) <= 3
