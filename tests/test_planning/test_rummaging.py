"""The policy in small: what it is told it keeps to, and what it plans serves its ends."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from kmppi import MPPI, MPPISettings
from rumi.belief.particles import PoseBelief
from rumi.clock import Stopwatch
from rumi.dynamics.base import PushDefaults
from rumi.dynamics.displacement_rollouts import DisplacementSettings
from rumi.dynamics.quasi_static import QuasiStaticSettings
from rumi.fields.information import InformationSettings, WorkspaceFields
from rumi.fields.workspace import Workspace
from rumi.planning.plan_budget import PlanBudget
from rumi.planning.policy import Plan, PlanRequest, Scene
from rumi.planning.registry import POLICIES
from rumi.planning.rummaging import RummagingPolicy, RummagingSettings
from rumi.robot.tool import Tool
from rumi.tasks.rummage.settings import preset
from sdf import se3
from sdf.object_model import ObjectModel, object_model
from sdf.primitives import Mug
from sdf.symmetry import Symmetries

HEIGHT = 0.045
BOUNDS = torch.tensor([[0.0, -0.4, 0.0], [0.8, 0.4, 0.2]])
SMALL = RummagingSettings(
    push_model="displacement",
    mppi=MPPISettings(horizon=6, knots=4, samples=60, warmup_iterations=4, temperature=0.1, cost_scale="std"),
    push=DisplacementSettings(mini_steps=2),
    rollouts=2,
)

pytestmark = pytest.mark.outcome


@pytest.fixture(scope="module")
def mug() -> ObjectModel:
    return object_model("mug", Mug(), Symmetries.none(), spacing=0.004, points=20)


@pytest.fixture
def scene(mug: ObjectModel) -> Scene:
    workspace = Workspace.from_bounds(BOUNDS, 0.02, planar_height=HEIGHT)
    tool = Tool(BOUNDS[:, :2], height_m=HEIGHT, body_spacing_m=0.02, info_spacing_m=0.01)
    return Scene(mug, workspace, tool, torch.tensor([0.2, 0.0, 0.0]))


def belief(count: int = 20, yaw: float = 1.0, at: tuple[float, float] = (0.4, 0.0)) -> PoseBelief:
    random = torch.Generator().manual_seed(3)
    place = torch.cat((torch.tensor(at).expand(count, 2), yaw * torch.randn(count, 1, generator=random)), -1)
    return PoseBelief.uniform(se3.from_planar(place))


def falling(scene: Scene) -> Tensor:
    """Reach that falls away from the origin along x."""
    return (1.0 - scene.workspace.points[:, 0]).clamp(0, 1)


def plan(
    policy: RummagingPolicy, scene: Scene, believed: PoseBelief, previous: Plan | None = None, seed: int = 0
) -> Plan:
    random = torch.Generator().manual_seed(seed)
    return policy.act(PlanRequest(believed, scene, previous, executed=2, generator=random))


def test_a_plan_has_all_that_it_should(scene: Scene) -> None:
    made = plan(RummagingPolicy(falling(scene), SMALL), scene, belief())
    assert made.controls.shape == (6, 3)
    assert float(made.controls.abs().max()) <= 1
    assert made.path.shape == (7, 3)
    assert torch.equal(made.path[0], scene.configuration)
    assert set(made.fields) == {"information", "p_free", "reachability"}
    assert all(values.shape == (len(scene.workspace),) for values in made.fields.values())
    assert float(made.fields["information"].max()) > 0.3
    assert float(made.fields["p_free"].min()) < 0.1
    assert torch.equal(made.fields["reachability"], falling(scene))
    assert torch.equal(made.samples.paths[:, 0], scene.configuration.expand(len(made.samples.costs), 3))
    assert float(made.samples.costs[0]) == made.info["least_cost"]
    assert bool((made.samples.costs.diff() >= 0).all())
    assert len(made.samples.costs) == 16
    works = {"workspace_points", "normals", "contact_checks", "rollouts_valued", "reachability_sums"}
    assert set(made.skipped) == works | {"information_cost", "reachability_cost"}
    assert all(0 <= share <= 1 for share in made.skipped.values())
    assert 0.2 < made.skipped["workspace_points"] < 1
    assert 0.3 < made.skipped["contact_checks"] <= 1
    assert set(made.timings_s) == {"fields", "push_model", "dynamics", "costs", "planner"}
    assert made.info["iterations"] == 4
    assert made.warm_start is not None


def test_a_later_plan_goes_on_from_the_previous_one(scene: Scene) -> None:
    policy = RummagingPolicy(falling(scene), SMALL)
    first = plan(policy, scene, belief())
    later = plan(policy, scene, belief(), first)
    assert later.info["iterations"] == SMALL.mppi.iterations == 1
    # without noise it is the previous plan, two controls later
    quiet = replace(SMALL, mppi=replace(SMALL.mppi, noise_variance=1e-12))
    later = plan(RummagingPolicy(falling(scene), quiet), scene, belief(), first)
    expected = MPPI(SMALL.mppi, 3).shift(first.warm_start, 2)
    torch.testing.assert_close(later.controls, expected.controls, atol=1e-4, rtol=0)
    assert float((later.controls - first.controls).abs().max()) > 0.1


def test_a_plan_that_stands_still_for_the_sake_of_reach_is_made_anew(scene: Scene) -> None:
    """Reach that falls off ahead of the tool, at a great weight: nothing is gathered unless that counts for less."""
    near = replace(scene, configuration=torch.tensor([0.25, 0.0, 0.0]))
    asked: list[float] = []

    class Asked(RummagingPolicy):
        def planned(self, request: PlanRequest, suited: PushDefaults) -> Plan:
            asked.append(suited.reachability_scale / 3000.0)
            return super().planned(request, suited)

    def gathered(settings: RummagingSettings, **budget: float) -> float:
        asked.clear()
        random = torch.Generator().manual_seed(0)
        made = Asked(falling(near), settings).act(PlanRequest(belief(), near, generator=random, **budget))
        return sum(made.info["predicted_information"]) / made.info["information_total"]

    heavy = replace(SMALL, reachability_scale=3000.0)
    still = gathered(replace(heavy, least_share=0.0))
    assert asked == [1.0] and still < 0.03
    eased = gathered(replace(heavy, least_share=0.03))
    assert asked[:2] == [1.0, 0.25] and len(asked) <= 4 and eased > still
    gathered(replace(heavy, least_share=1.0))
    assert asked == [1.0, 0.25, 0.0625, 0.015625]
    # what does not weigh reach, or has a budget, is planned once
    gathered(replace(heavy, least_share=1.0), budget_s=100.0)
    assert asked == [1.0]
    gathered(replace(heavy, least_share=1.0, reachability_scale=0.0))
    assert asked == [0.0]


def test_goes_where_the_information_is(scene: Scene) -> None:
    """The best sample meets informative cells, and the plan brings the pads closer to the object."""
    settings = preset(planner=replace(SMALL, mppi=replace(SMALL.mppi, samples=200)))
    policy = POLICIES["info-only"](settings, falling(scene))
    start = replace(scene, configuration=torch.tensor([0.1, 0.3, 0.0]))
    made = plan(policy, start, belief())
    assert made.info["least_cost"] < -0.05
    way = (made.path[:, :2] - torch.tensor([0.4, 0.0])).norm(dim=-1)
    assert float(way.min()) < float(way[0]) - 0.1
    assert made.skipped["reachability_cost"] == 1.0
    assert "reachability_sums" not in made.skipped
    assert "reachability" not in made.fields


def test_reach_alone_does_not_push_away_what_is_reachable(scene: Scene) -> None:
    settings = preset(planner=replace(SMALL, reachability_scale=1.0))
    made = plan(POLICIES["reach-only"](settings, falling(scene)), scene, belief())
    assert made.skipped["information_cost"] == 1.0
    assert made.info["displacement"][0] <= 0.0
    assert -1.0 <= made.info["least_cost"] <= -0.5


@pytest.mark.parametrize("settings", [SMALL, replace(SMALL, normalise_information=False)])
def test_nothing_to_learn_gives_a_plan_all_the_same(scene: Scene, settings: RummagingSettings) -> None:
    """All particles agree: no information anywhere, all costs are zero."""
    made = plan(RummagingPolicy(falling(scene), settings), scene, belief(count=5, yaw=0.0))
    assert float(made.fields["information"].sum()) < 1e-3
    assert bool(made.controls.isfinite().all())
    assert bool(made.path.isfinite().all())


@pytest.mark.parametrize("mode", ["surrogate", "reverse_kl", "forward_kl", "sensor_mi"])
def test_every_field_can_be_planned_on(scene: Scene, mode: str) -> None:
    settings = replace(SMALL, information=InformationSettings(mode=mode))
    assert bool(plan(RummagingPolicy(falling(scene), settings), scene, belief()).controls.isfinite().all())


def test_smallest_problem(scene: Scene) -> None:
    """One step, one knot, and a workspace of one cell."""
    settings = replace(SMALL, mppi=MPPISettings(horizon=1, knots=1, samples=3, warmup_iterations=0), rollouts=1)
    lattice = Workspace.from_bounds(torch.tensor([[0.4, 0.0, HEIGHT], [0.4, 0.0, HEIGHT]]), 0.01)
    made = plan(RummagingPolicy(torch.ones(1), settings), replace(scene, workspace=lattice), belief())
    assert made.controls.shape == (1, 3)
    assert bool(made.path.isfinite().all())


def test_refuses_what_it_cannot_plan_for(scene: Scene) -> None:
    with pytest.raises(ValueError, match="Expected reachability"):
        plan(RummagingPolicy(None, SMALL), scene, belief())
    with pytest.raises(ValueError, match="one row a workspace point"):
        plan(RummagingPolicy(torch.ones(7), SMALL), scene, belief())


def test_the_quasi_static_model_plans_too(scene: Scene) -> None:
    settings = replace(SMALL, push_model="quasi-static", quasi_static=QuasiStaticSettings(mini_steps=2, spacing_m=0.01))
    policy = RummagingPolicy(falling(scene), settings)
    made = plan(policy, scene, belief())
    assert "pushes" in made.skipped
    assert "normals" not in made.skipped
    # nothing holds the tool up: the path is the free one
    free = scene.tool.free_path(scene.configuration[None], made.controls[None], 1)[0]
    torch.testing.assert_close(made.path[1:], free)
    again = plan(RummagingPolicy(falling(scene), settings), scene, belief())
    assert torch.equal(made.controls, again.controls)


def test_weight_and_rollouts_suit_the_push_model(scene: Scene) -> None:
    settings = RummagingSettings()
    assert settings.suited("displacement") == (2.0, 5, 0.0)
    assert settings.suited("quasi-static") == (4.0, 8, 0.03)
    assert replace(settings, rollouts=1, reachability_scale=0.0).suited("quasi-static") == (0.0, 1, 0.03)
    # which one pushes is seen from the belief: upright particles slide and turn, tilted ones are carried along
    believed, policy = belief(), RummagingPolicy(torch.ones(1), settings)
    assert policy.suited(believed, scene) == settings.suited("quasi-static")
    tilted = replace(
        believed, attached_T_object=believed.attached_T_object @ se3.exp(torch.tensor([0, 0, 0, 0.2, 0, 0]))
    )
    assert policy.suited(tilted, scene) == settings.suited("displacement")


def test_what_suits_the_push_model_is_what_is_planned_with(scene: Scene) -> None:
    few = MPPISettings(horizon=3, knots=2, samples=20, warmup_iterations=2)
    spoken = RummagingSettings(mppi=few, push_model="displacement", reachability_scale=2.0, rollouts=5)
    left = replace(spoken, reachability_scale=None, rollouts=None)
    one, other = (plan(RummagingPolicy(falling(scene), own), scene, belief()) for own in (spoken, left))
    assert torch.equal(one.controls, other.controls)
    third = plan(RummagingPolicy(falling(scene), replace(left, rollouts=8)), scene, belief())
    assert third.info["least_cost"] != other.info["least_cost"]


class Counted:
    """A push model that notes how many control sequences it rolls out, and how often each."""

    def __init__(self, model: Any, seen: list[tuple[str, Tensor, int]], kind: str = "full") -> None:
        self.model, self.seen, self.kind = model, seen, kind

    def rollout(self, configuration: Tensor, controls: Tensor, *, rollouts: int, **rest: Any) -> Any:
        self.seen.append((self.kind, controls, rollouts))
        return self.model.rollout(configuration, controls, rollouts=rollouts, **rest)

    def nominal_rollout(self, configuration: Tensor, controls: Tensor) -> Any:
        return self.model.nominal_rollout(configuration, controls)

    def coarse(self) -> "Counted":
        return Counted(self.model.coarse(), self.seen, "coarse")


@pytest.mark.parametrize("push_model", ["displacement", "quasi-static"])
def test_only_samples_of_little_coarse_cost_are_rolled_out_in_full(scene: Scene, push_model: str) -> None:
    settings = replace(SMALL, push_model=push_model, rollouts=4, mppi=replace(SMALL.mppi, samples=160))
    policy, seen = RummagingPolicy(falling(scene), settings), list[tuple[str, Tensor, int]]()
    made = policy.push_models.rollouts
    policy.push_models.rollouts = lambda *a, **k: Counted(made(*a, **k), seen)  # type: ignore[method-assign]
    plan(policy, scene, belief(at=(0.32, 0.0)))
    assert [(kind, len(controls), rollouts) for kind, controls, rollouts in seen] == [
        ("coarse", 160, 2),
        ("full", 20, 4),
    ] * 4
    # those that were kept are told from the rest by what they are found to cost
    alone = RummagingPolicy(falling(scene), replace(settings, screen_kept=1.0))
    view = alone._view_in_time(belief(at=(0.32, 0.0)), scene, None, PlanBudget(None, float), Stopwatch(float))
    random = torch.Generator().manual_seed(0)
    costs = view.objective.cost(
        view.model.coarse().rollout(scene.configuration, seen[0][1], rollouts=2, generator=random)
    )
    assert torch.equal(seen[1][1], seen[0][1][costs.topk(20, largest=False).indices])


def test_few_samples_are_all_rolled_out_in_full(scene: Scene) -> None:
    settings = replace(SMALL, rollouts=4, mppi=replace(SMALL.mppi, samples=16))
    screened = plan(RummagingPolicy(falling(scene), settings), scene, belief())
    whole = plan(RummagingPolicy(falling(scene), replace(settings, screen_kept=1.0)), scene, belief())
    assert torch.equal(screened.controls, whole.controls)


def test_a_proposal_better_than_noise_is_what_a_plan_starts_from(scene: Scene) -> None:
    thorough = replace(SMALL, mppi=replace(SMALL.mppi, warmup_iterations=30, samples=200))
    best = plan(RummagingPolicy(falling(scene), thorough), scene, belief())
    assert best.warm_start is not None
    knots, asked = best.warm_start.knots, []

    def proposals(request: PlanRequest, fields: WorkspaceFields) -> Tensor:
        asked.append((request.belief, fields.information.shape))
        return knots[None]

    little = replace(SMALL, mppi=replace(SMALL.mppi, warmup_iterations=1))
    believed = belief()
    helped = plan(RummagingPolicy(falling(scene), little, proposals=proposals), scene, believed)
    alone = plan(RummagingPolicy(falling(scene), little), scene, believed)
    assert asked == [(believed, (len(scene.workspace),))]
    assert helped.info["least_cost"] < alone.info["least_cost"] - 0.01
