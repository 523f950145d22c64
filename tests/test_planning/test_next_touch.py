"""Next-touch selection: what it chooses is what tells two poses apart, and the laws that every policy keeps."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from rumi.belief.particles import PoseBelief
from rumi.errors import UsageError
from rumi.fields.workspace import Workspace
from rumi.planning.first_contact import TouchingSurface
from rumi.planning.next_touch import NextTouchPolicy, NextTouchSettings
from rumi.planning.policy import Plan, PlanRequest, Scene
from rumi.planning.touch_candidates import CandidateSettings, candidate_touches
from rumi.robot.tool import Tool
from rumi.robot.tool_shape import SolidTool
from rumi.tasks.rummage.build import _policy_of
from rumi.tasks.rummage.motions import planned
from rumi.tasks.rummage.scenes import find_task
from rumi.tasks.rummage.settings import preset
from sdf import se3
from sdf.object_model import ObjectModel, object_model
from sdf.primitives import Box
from sdf.symmetry import Symmetries

HALF = (0.03, 0.09, 0.04)
BOUNDS = torch.tensor([[0.0, -0.4, 0.03], [0.8, 0.4, 0.2]])
FEW = NextTouchSettings(candidates=CandidateSettings(count=24), particles=40)


@pytest.fixture(scope="module")
def box() -> ObjectModel:
    return object_model("box", Box(list(HALF)), Symmetries.parse("x2,y2"), spacing=0.004, points=200)


@pytest.fixture(scope="module")
def scene(box: ObjectModel) -> Scene:
    workspace = Workspace.from_bounds(torch.tensor([[0.0, -0.4, 0.0], [0.8, 0.4, 0.2]]), 0.04)
    tool = Tool(BOUNDS, body_spacing_m=0.02, info_spacing_m=0.01)
    return Scene(box, workspace, tool, torch.tensor([0.25, 0.0, 0.04, 0.0]))


def at(*places: tuple[float, float, float]) -> Tensor:
    poses = se3.from_planar(torch.tensor(places))
    poses[:, 2, 3] = HALF[2]
    return poses


def act(scene: Scene, belief: PoseBelief, previous: Plan | None = None, seed: int = 0, **more: float) -> Plan:
    generator = torch.Generator().manual_seed(seed)
    request = PlanRequest(belief, scene, previous, executed=1, generator=generator, **more)
    return NextTouchPolicy(FEW).act(request)


@pytest.mark.parametrize("seed", range(4))
def test_it_tells_two_poses_apart(scene: Scene, seed: int) -> None:
    """Two poses with one face in common: a touch on that face tells nothing, one where they end tells all."""
    belief = PoseBelief.uniform(at((0.4, 0.0, 0.0), (0.4, 0.05, 0.0)).repeat(20, 1, 1))
    plan = act(scene, belief, seed=seed)
    assert sum(plan.info["predicted_information"]) == pytest.approx(math.log(2.0), abs=0.05)
    assert 1 <= plan.info["actions"] <= len(plan.controls) + 1e-3


def test_a_sure_belief_has_nothing_to_gain(scene: Scene) -> None:
    plan = act(scene, PoseBelief.uniform(at((0.4, 0.0, 0.0)).repeat(10, 1, 1)))
    assert sum(plan.info["predicted_information"]) == pytest.approx(0.0, abs=1e-5)
    assert 1 <= len(plan.controls) <= 4  # of up to 8


def test_what_is_left_of_the_last_plan_is_followed_where_it_tells_more(scene: Scene) -> None:
    """Two poses that differ where one way alone touches: gone on with, from where it was to be."""
    belief = PoseBelief.uniform(at((0.4, 0.0, 0.0), (0.4, 0.05, 0.0)).repeat(20, 1, 1))
    policy = NextTouchPolicy(replace(FEW, candidates=replace(FEW.candidates, count=1), least_nats=0.0))
    first = next(plan for plan in map(lambda seed: act(scene, belief, seed=seed), range(20)) if len(plan.controls) > 1)
    here = replace(scene, configuration=first.path[1])

    def later(where: Scene, previous: Plan | None, seed: int) -> Plan:
        random = torch.Generator().manual_seed(seed)
        return policy.act(PlanRequest(belief, where, previous, executed=1, generator=random))

    rest = first.controls[1:]
    poor = [seed for seed in range(30) if sum(later(here, None, seed).info["predicted_information"]) < 0.1]
    assert poor
    for seed in poor:
        kept = later(here, first, seed)
        assert torch.equal(kept.controls, rest)
        assert sum(kept.info["predicted_information"]) == pytest.approx(math.log(2.0), abs=0.05)
        astray = replace(here, configuration=first.path[1] + torch.tensor([0.0, 0.02, 0.0, 0.0]))
        assert later(astray, first, seed).info["samples"] == 1


def test_a_loss_is_no_better_for_taking_long() -> None:
    """Where little is to be gained the shortest way to most of it is taken; else what gains most an action."""
    policy = NextTouchPolicy(NextTouchSettings(overhead=2.0, least_nats=0.1, unfelt=1.5))
    flat = torch.zeros(3)
    little = policy._worth(torch.tensor([0.0, 0.0, 0.08]), flat, torch.tensor([1.0, 8.0, 4.0]))
    assert little.argsort(descending=True).tolist() == [2, 0, 1]
    gains = policy._worth(torch.ones(3), torch.tensor([0.0, 0.0, 0.9]), torch.tensor([1.0, 8.0, 1.0]))
    assert gains.tolist() == pytest.approx([0.9 / 3.0, 0.09, -0.45 * 3.0])


def test_a_touch_at_once_is_news_and_one_that_there_is_already_is_none(scene: Scene, box: ObjectModel) -> None:
    """By outcomes: touching in the first millimetres of a way is no touch that was there before it."""
    before, within = 0.4 - HALF[0] - 0.035 - 0.003, 0.4 - HALF[0] - 0.035 + 0.002
    belief = PoseBelief.uniform(at((0.4, 0.0, 0.0), (0.5, 0.0, 0.0)).repeat(10, 1, 1))
    ahead = torch.tensor([[0.5, 0.0, 0.0, 0.0]])
    policy = NextTouchPolicy(replace(FEW, candidates=replace(FEW.candidates, count=1)))
    found = []
    for x in (before, within):
        here = torch.tensor([x, 0.0, 0.04, 0.0])
        last = Plan(torch.cat((ahead, ahead)), torch.stack((here, here, here)))
        request = PlanRequest(belief, replace(scene, configuration=here), last, executed=1)
        steps = policy.act(request)
        found.append(steps.info["unfelt"] if torch.equal(steps.controls, ahead) else None)
    assert found[0] == 0.0
    assert found[1] is None or found[1] == pytest.approx(0.5)


def test_candidates_stay_within_what_a_control_may_ask(scene: Scene, box: ObjectModel) -> None:
    surface = TouchingSurface.of(scene.tool.shape, pad_spacing_m=0.01, palm_spacing_m=0.02, patch_m=0.015)  # type: ignore[arg-type]
    for seed in range(5):
        controls, lengths = candidate_touches(
            at((0.6, 0.2, 1.0), (0.3, -0.2, 0.4)),
            box,
            scene.tool,
            surface,
            scene.configuration,
            CandidateSettings(count=30),
            generator=torch.Generator().manual_seed(seed),
        )
        assert 1 <= controls.shape[0] == len(lengths) <= 30
        assert float(controls.abs().max()) <= 1.0
        assert 1 <= int(lengths.min()) <= int(lengths.max()) <= 8
        beyond = torch.arange(controls.shape[1])[None] >= lengths[:, None]
        assert not bool(controls[beyond].any())
        ends = scene.configuration + (controls * scene.tool.scale).cumsum(1)
        assert bool(((ends[..., :3] >= BOUNDS[0] - 1e-5) & (ends[..., :3] <= BOUNDS[1] + 1e-5)).all())


def test_the_same_seed_gives_the_same_plan_and_no_time_gives_one_too(scene: Scene) -> None:
    random = torch.Generator().manual_seed(3)
    noise = torch.randn(30, 3, generator=random) * torch.tensor([0.02, 0.02, 0.5])
    belief = PoseBelief.uniform(at(*(torch.tensor([0.45, 0.05, 0.0]) + noise).tolist()))
    first, again = (act(scene, belief, seed=7) for _ in range(2))
    assert torch.equal(first.controls, again.controls)
    hurried = act(scene, belief, seed=7, budget_s=0.0)
    assert hurried.info["samples"] < first.info["samples"]
    assert len(hurried.controls) >= 1


def test_other_tools_are_refused(scene: Scene) -> None:
    belief = PoseBelief.uniform(at((0.4, 0.0, 0.0)))
    level = Tool(BOUNDS[:, :2], height_m=0.04, body_spacing_m=0.02, info_spacing_m=0.01)
    with pytest.raises(ValueError, match="moves in space"):
        act(replace(scene, tool=level, configuration=torch.tensor([0.2, 0.0, 0.0])), belief)


def test_a_tool_without_pads_is_refused(scene: Scene) -> None:
    rod = Tool(BOUNDS, shape=SolidTool([Box([0.01, 0.01, 0.03])]), body_spacing_m=0.02, info_spacing_m=0.01)
    with pytest.raises(UsageError, match="palm and two pads"):
        act(replace(scene, tool=rod), PoseBelief.uniform(at((0.4, 0.0, 0.0))))


def test_it_is_chosen_on_the_cpu_wherever_plans_are_made() -> None:
    settings = preset(task="box", device="cuda", conditions="lab")
    known = replace(settings, planner=planned(find_task("box"), settings))
    assert isinstance(_policy_of(known, torch.ones(3)), NextTouchPolicy)


def test_bad_numbers_are_refused(scene: Scene) -> None:
    poses = at((0.4, 0.0, 0.0), (0.41, 0.0, 0.0))
    poses[1, 0, 3] = math.nan
    with pytest.raises(ValueError, match="finite"):
        act(scene, PoseBelief.uniform(poses))
    with pytest.raises(ValueError, match="finite"):
        act(
            replace(scene, configuration=torch.tensor([math.nan, 0.0, 0.04, 0.0])),
            PoseBelief.uniform(at((0.4, 0.0, 0.0))),
        )


def test_a_plane_has_no_next_touch() -> None:
    settings = preset(task="mug", conditions="lab", **{"planner.next_touch": True})
    with pytest.raises(UsageError, match="moves in space"):
        planned(find_task("mug"), settings)
    asked = preset(task="box", conditions="lab", **{"planner.push_model": "displacement"})
    assert planned(find_task("box"), asked).next_touch is False
