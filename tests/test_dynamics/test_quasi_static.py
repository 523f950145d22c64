"""The quasi-static push model: both versions, and what a pushed object must do."""

import math

import pytest
import torch
from torch import Tensor

from rumi.dynamics.base import Stance, representatives
from rumi.dynamics.outline import GridOutline, Support, support_of
from rumi.dynamics.push_posterior import PushPosterior
from rumi.dynamics.quasi_static import QuasiStaticRollouts, QuasiStaticSettings
from rumi.dynamics.registry import PushModels, PushSettings
from rumi.dynamics.sliding import push, rotated
from rumi.fields.information import information_field
from rumi.fields.workspace import Workspace
from rumi.planning.objective import mean_over_rollouts
from rumi.robot.reach import Reach
from rumi.robot.reach_table import ReachTable
from rumi.robot.tool import Tool
from sdf import backend, se3, so3
from sdf.object_model import object_model
from sdf.primitives import Mug
from sdf.symmetry import Symmetries

HEIGHT = 0.045
FREE = torch.tensor([[-5.0, -5.0], [5.0, 5.0]])
COARSE = QuasiStaticSettings(mini_steps=4, spacing_m=0.01)


# every test of this file holds for the plain and for the compiled versions
pytestmark = [
    pytest.mark.usefixtures("version"),
    pytest.mark.parametrize("version", ["torch", "numba", "warp"], indirect=True),
]


@pytest.fixture(scope="module")
def shape() -> tuple[GridOutline, Support]:
    mug = Mug().double()
    return GridOutline.of_slice(mug, HEIGHT, spacing=0.002), support_of(mug, spacing=0.004)


def make(
    shape: tuple[GridOutline, Support],
    poses: Tensor,
    weights: Tensor | None = None,
    settings: QuasiStaticSettings = COARSE,
    *,
    reaching: bool = False,
    posterior: PushPosterior | None = None,
) -> QuasiStaticRollouts:
    """With a tool that flies freely, or one that must stay within 0.35 m of the origin."""
    radius = torch.arange(141.0)[:, None].expand(141, 61) * 0.01
    reach = Reach(ReachTable((radius - 0.35).clamp_min(0), torch.zeros(141, 61))) if reaching else None
    tool = Tool(FREE, reach, height_m=HEIGHT).to(poses)
    log_weights = torch.zeros(len(poses), dtype=poses.dtype) if weights is None else weights.log()
    return QuasiStaticRollouts(*shape, tool, se3.from_planar(poses), log_weights.log_softmax(-1), settings, posterior)


def scattered(generator: torch.Generator, count: int, dtype: torch.dtype = torch.float64) -> Tensor:
    noise = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    return (torch.tensor([0.4, 0.0, 0.3]) + noise * torch.tensor([0.01, 0.01, 0.8])).to(dtype)


def walks(generator: torch.Generator, samples: int, horizon: int, dtype: torch.dtype = torch.float64) -> Tensor:
    way = torch.rand(samples, horizon, 3, generator=generator, dtype=torch.float64) * 2 - 1
    return (way + torch.tensor([0.5, 0.0, 0.0])).clamp(-1, 1).to(dtype)


START = torch.tensor([0.25, 0.0, 0.0], dtype=torch.float64)


def test_rollouts_are_single_pushes_in_a_row(shape: tuple[GridOutline, Support], generator: torch.Generator) -> None:
    model = make(shape, scattered(generator, 9))
    controls = walks(generator, 6, 4)
    found = model.rollout(START, controls, rollouts=3)
    assert found.contact.any()
    path = model.tool.free_path(START.expand(6, 3), controls, 1)
    starts, mini = model.representatives(3), COARSE.mini_steps
    for k in range(6):
        for m in range(3):
            now, tool = starts[m][None], START[None]
            for h in range(4):
                way, met = (path[k, h] - tool) / mini, False
                for part in range(mini):
                    now, touched = push(
                        now,
                        tool + part * way,
                        tool + (part + 1) * way,
                        model.points,
                        model.outline,
                        model.sliding.expand(1),
                    )
                    met |= bool(touched)
                tool = path[k, h][None]
                torch.testing.assert_close(found.configurations[k, m, h + 1], path[k, h])
                assert bool(found.contact[k, m, h]) == met
                # the pivot rides with the object
                local = rotated(model.pivot - starts[m, :2], -starts[m, 2])
                moved = now[0, :2] + rotated(local, now[0, 2]) - model.pivot
                torch.testing.assert_close(found.displacements[k, m, h + 1, :2], moved, atol=1e-9, rtol=0)
                assert float(found.turns[k, m, h + 1]) == pytest.approx(float(now[0, 2] - starts[m, 2]), abs=1e-9)


@pytest.mark.parametrize(("reaching", "believed"), [(False, False), (True, False), (False, True)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_versions_agree(
    shape: tuple[GridOutline, Support], dtype: torch.dtype, reaching: bool, believed: bool, generator: torch.Generator
) -> None:
    posterior = PushPosterior.prior(8) if believed else None
    model = make(shape, scattered(generator, 20, dtype), reaching=reaching, posterior=posterior)
    controls = walks(generator, 30, 5, dtype)
    found = model.rollout(START.to(dtype), controls, rollouts=4)
    with backend.force("torch"):
        plain = model.rollout(START.to(dtype), controls, rollouts=4)
    # rounding may decide which of two points is the deeper
    off = (found.displacements - plain.displacements).abs().amax((-1, -2)) > (1e-4 if dtype == torch.float32 else 1e-9)
    assert float(off.double().mean()) <= (0.1 if dtype == torch.float32 else 0.0)
    torch.testing.assert_close(found.turns[~off], plain.turns[~off], atol=1e-3, rtol=0)
    torch.testing.assert_close(found.configurations, plain.configurations, atol=1e-5, rtol=1e-5)
    assert torch.equal(found.contact[~off], plain.contact[~off])
    assert torch.equal(found.duplicate_of[~off], plain.duplicate_of[~off])
    assert 0 < found.checked <= plain.checked <= 1


@pytest.mark.parametrize("case", ["no contact", "one particle", "inside", "far", "standing still", "held by the arm"])
def test_versions_agree_also_where_it_is_odd(
    shape: tuple[GridOutline, Support], case: str, generator: torch.Generator
) -> None:
    poses, start, controls = scattered(generator, 5), START, walks(generator, 8, 4)
    if case == "no contact":
        start = START + torch.tensor([-1.0, 0.5, 0.0], dtype=torch.float64)
    if case == "one particle":
        poses = poses[:1]
    if case == "inside":
        start = poses[0]
    if case == "far":
        shift = torch.tensor([1e3, -400.0, 30.0], dtype=torch.float64)
        poses, start = poses + shift, start + shift
    if case == "standing still":
        controls = torch.zeros_like(controls)
    model = make(shape, poses, reaching=case == "held by the arm")
    model.tool.bounds *= 1e3 if case == "far" else 1.0
    found = model.rollout(start, controls, rollouts=4)
    with backend.force("torch"):
        plain = model.rollout(start, controls, rollouts=4)
    assert bool(plain.touched.any()) == (case not in ("no contact", "standing still"))
    for name in ("configurations", "displacements", "turns", "contact", "duplicate_of", "pivot"):
        torch.testing.assert_close(getattr(found, name), getattr(plain, name), atol=1e-8, rtol=0)


def test_each_rollout_has_its_own_draw_of_how_the_object_slides(
    shape: tuple[GridOutline, Support], generator: torch.Generator
) -> None:
    pose, controls = torch.tensor([[0.4, 0.0, 0.3]], dtype=torch.float64), walks(generator, 12, 4)
    found = make(shape, pose, posterior=PushPosterior.prior(16)).rollout(START, controls, rollouts=4)
    assert float(found.displacements[found.touched.all(-1)].std(1).amax()) > 1e-3
    # a posterior without doubt is the settings' own, but for the limit surface
    sure = PushPosterior(torch.tensor([[math.log(0.5), math.log(1.5), *[0.0] * 6]]).double(), torch.zeros(1).double())
    one, fixed = (make(shape, pose, posterior=own).rollout(START, controls, rollouts=2) for own in (sure, None))
    torch.testing.assert_close(one.displacements, fixed.displacements, atol=1e-7, rtol=0)


@pytest.mark.parametrize("sizes", [(0, 3, 2), (2, 3, 1)])
def test_empty_and_single(shape: tuple[GridOutline, Support], sizes: tuple[int, int, int]) -> None:
    samples, horizon, rollouts = sizes
    model = make(shape, torch.tensor([[0.4, 0.0, 0.3]], dtype=torch.float64))
    found = model.rollout(START, torch.zeros(samples, horizon, 3, dtype=torch.float64), rollouts=rollouts)
    assert found.configurations.shape == (samples, rollouts, horizon + 1, 3)
    assert found.displacements.shape == (samples, rollouts, horizon + 1, 3)
    assert not found.contact.any()


def test_a_push_at_the_middle_goes_straight_and_one_beside_it_turns(shape: tuple[GridOutline, Support]) -> None:
    """Handle away from the tool, so that centre of mass and axis are in line."""
    fine = QuasiStaticSettings(mini_steps=40)
    model = make(shape, torch.tensor([[0.4, 0.0, 0.0]], dtype=torch.float64), settings=fine)
    ahead = torch.tensor([[[1.0, 0.0, 0.0]] * 2], dtype=torch.float64)
    straight = model.rollout(torch.tensor([0.2, 0.0, 0.0], dtype=torch.float64), ahead, rollouts=1)
    beside = model.rollout(torch.tensor([0.2, 0.045, 0.0], dtype=torch.float64), ahead, rollouts=1)
    assert beside.turns is not None
    assert bool(straight.contact.any())
    assert abs(float(straight.turns[0, 0, -1])) < 0.02
    assert abs(float(straight.displacements[0, 0, -1, 1])) < 0.002
    assert float(straight.displacements[0, 0, -1, 0]) > 0.02
    # pushed on its left, it leaves the tool to the right
    assert float(beside.displacements[0, 0, -1, 1]) < -0.004


def test_a_pull_at_the_handle_brings_it(shape: tuple[GridOutline, Support]) -> None:
    """From behind a handle that points aside, the mug comes along and swings."""
    model = make(shape, torch.tensor([[0.4, 0.0, math.pi / 2]], dtype=torch.float64), settings=QuasiStaticSettings())
    behind = torch.tensor([0.475, 0.085, -math.pi / 2], dtype=torch.float64)
    back = torch.tensor([[[-0.5, 0.0, 0.0]] * 4], dtype=torch.float64)
    found = model.rollout(behind, back, rollouts=1)
    assert float(found.displacements[0, 0, -1, 0]) < -0.01
    assert float(found.turns[0, 0, -1]) > 0.2


def test_representatives_are_equal_shares_of_the_weight(generator: torch.Generator) -> None:
    yaw = torch.tensor([0.4, 0.2, 0.3, 0.1], dtype=torch.float64)
    weights = torch.tensor([0.1, 0.6, 0.2, 0.1], dtype=torch.float64)
    assert representatives(yaw, weights, 3).tolist() == [1, 1, 2]
    assert representatives(yaw, weights, 1).tolist() == [1]
    many = torch.rand(2000, generator=generator, dtype=torch.float64)
    chosen = many[representatives(many, torch.full((2000,), 1 / 2000, dtype=torch.float64), 4)]
    torch.testing.assert_close(chosen, torch.tensor([0.125, 0.375, 0.625, 0.875]).double(), atol=0.03, rtol=0)
    # a belief about the seam is one heap
    seam = torch.remainder(many + math.pi - 0.5 + math.pi, 2 * math.pi) - math.pi
    again = seam[representatives(seam, torch.full((2000,), 1 / 2000, dtype=torch.float64), 4)]
    torch.testing.assert_close(torch.remainder(again - math.pi + 0.5, 2 * math.pi), chosen, atol=1e-9, rtol=0)


def test_the_likely_rollout_pushes_the_likeliest_pose(shape: tuple[GridOutline, Support]) -> None:
    poses = torch.tensor([[0.4, 0.3, 0.0], [0.4, 0.0, 0.0]], dtype=torch.float64)
    model = make(shape, poses, torch.tensor([0.4, 0.6], dtype=torch.float64))
    ahead = torch.tensor([[1.0, 0.0, 0.0]] * 2, dtype=torch.float64)
    assert bool(model.nominal_rollout(START, ahead).contact.any())


def test_the_family_refuses_tilted_particles() -> None:
    workspace = Workspace.from_bounds(torch.tensor([[0.0, -0.4, 0.0], [0.8, 0.4, 0.2]]), 0.02, planar_height=HEIGHT)
    tool = Tool(FREE, height_m=HEIGHT)
    mug = object_model("mug", Mug(), Symmetries.none(), spacing=0.004, points=20)
    poses = se3.from_planar(torch.tensor([[0.4, 0.0, 0.3], [0.4, 0.0, 0.5]]))
    weights = torch.zeros(2).log_softmax(-1)
    fields = information_field(mug.sdf, poses, weights, workspace.points)
    family = PushModels(PushSettings("quasi-static"))
    assert isinstance(family.rollouts(mug, poses, weights, tool, workspace, fields), QuasiStaticRollouts)
    tilted = se3.exp(torch.tensor([0.0, 0.0, 0.0, 0.2, 0.0, 0.0])) @ poses
    with pytest.raises(ValueError, match="upright"):
        family.rollouts(mug, tilted, weights, tool, workspace, fields)


def test_the_family_chooses_by_what_the_particles_do() -> None:
    standing = se3.from_planar(torch.tensor([[0.3, 0.0, 0.1], [0.31, 0.01, 2.0]]))
    tilted = standing.clone()
    tilted[1] = tilted[1] @ se3.make(so3.exp(torch.tensor([0.1, 0.0, 0.0])), torch.zeros(3))
    raised = standing.clone()
    raised[0, 2, 3] += 0.01
    assert [Stance.of(poses).rests for poses in (standing, standing[:1], tilted, raised)] == [True, True, False, False]


def test_the_outline_is_nowhere_steeper_than_it_says() -> None:
    outline = GridOutline.of_slice(Mug(), 0.045)
    random = torch.Generator().manual_seed(0)
    low, size = outline.origin, outline.spacing * torch.tensor(outline.values.shape)
    first = low + torch.rand(20000, 2, generator=random) * (size - outline.spacing)
    second = first + 0.002 * torch.randn(20000, 2, generator=random)
    second = torch.minimum(torch.maximum(second, low), low + size - outline.spacing)
    here, there = outline(first).distance, outline(second).distance
    way = (second - first).norm(dim=-1)
    # who goes by a border cannot be nearer it at one end than at the other by more
    apart = (here > way * outline.steepness) & (there > 0)
    assert int(apart.sum()) > 1000
    assert bool((here - there <= outline.steepness * way + 1e-6)[apart].all())
    assert outline.steepness < 1.5


def test_scenes_in_one_call_are_each_what_they_are_alone(
    shape: tuple[GridOutline, Support], generator: torch.Generator
) -> None:
    scenes = torch.stack([scattered(generator, 9) for _ in range(3)])
    weights = torch.rand(3, 9, generator=generator, dtype=torch.float64)
    controls = torch.stack([walks(generator, 6, 4) for _ in range(3)])
    start = START + torch.tensor([[0.0, 0.0, 0.0], [0.02, 0.01, 0.3], [0.0, -0.03, 0.1]], dtype=torch.float64)
    together = make(shape, scenes, weights, posterior=PushPosterior.prior(8))
    found = together.rollout(start, controls, rollouts=3)
    shown = together.nominal_rollout(start, controls[:, 0])
    cost = mean_over_rollouts(found, lambda paths: paths.in_object_frame()[0].sum((-2, -1)))
    assert found.contact.any() and found.contact.shape == (3, 6, 3, 4) and shown.contact.shape == (3, 1, 1, 4)
    for row in range(3):
        alone = make(shape, scenes[row], weights[row], posterior=PushPosterior.prior(8))
        single = alone.rollout(start[row], controls[row], rollouts=3)
        for name in ("configurations", "displacements", "contact", "duplicate_of", "turns", "pivot"):
            torch.testing.assert_close(getattr(found, name)[row], getattr(single, name), rtol=0, atol=1e-10)
        likely = alone.nominal_rollout(start[row], controls[row, 0])
        torch.testing.assert_close(shown.displacements[row], likely.displacements, rtol=0, atol=1e-10)
        own = mean_over_rollouts(single, lambda paths: paths.in_object_frame()[0].sum((-2, -1)))
        torch.testing.assert_close(cost[row], own, rtol=0, atol=1e-10)
