"""Plans by a budget, on a clock that is told how long their parts take."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from kmppi import MPPISettings
from rumi.belief.particles import PoseBelief
from rumi.clock import SimulatedClock
from rumi.dynamics.displacement_rollouts import DisplacementSettings
from rumi.fields.workspace import Workspace
from rumi.planning.plan_budget import PlanBudget
from rumi.planning.policy import Plan, PlanRequest, Scene
from rumi.planning.rummaging import RummagingPolicy, RummagingSettings
from rumi.robot.tool import Tool
from sdf import se3
from sdf.object_model import object_model
from sdf.primitives import Mug
from sdf.symmetry import Symmetries

HEIGHT = 0.045
BOUNDS = torch.tensor([[0.0, -0.4, 0.0], [0.8, 0.4, 0.2]])
SETTINGS = RummagingSettings(
    mppi=MPPISettings(horizon=5, knots=3, samples=200, warmup_iterations=6, temperature=0.1, cost_scale="std"),
    push_model="displacement",
    push=DisplacementSettings(mini_steps=2),
    rollouts=1,
)

pytestmark = pytest.mark.outcome


@pytest.fixture(scope="module")
def scene() -> Scene:
    mug = object_model("mug", Mug(), Symmetries.none(), spacing=0.004, points=20)
    workspace = Workspace.from_bounds(BOUNDS, 0.02, planar_height=HEIGHT)
    tool = Tool(BOUNDS[:, :2], height_m=HEIGHT, body_spacing_m=0.02, info_spacing_m=0.01)
    return Scene(mug, workspace, tool, torch.tensor([0.2, 0.0, 0.0]))


def belief(count: int = 60) -> PoseBelief:
    random = torch.Generator().manual_seed(3)
    place = torch.cat((torch.tensor([[0.4, 0.0]]).expand(count, 2), torch.randn(count, 1, generator=random)), -1)
    return PoseBelief.uniform(se3.from_planar(place))


class Slow:
    """A push model on a simulated clock."""

    def __init__(self, model: Any, clock: SimulatedClock, sample_s: Callable[[], float], finish_s: float) -> None:
        self.model, self.clock, self.sample_s, self.finish_s = model, clock, sample_s, finish_s

    def rollout(self, configuration: Tensor, controls: Tensor, **rest: Any) -> Any:
        self.clock.advance(len(controls) * self.sample_s())
        return self.model.rollout(configuration, controls, **rest)

    def coarse(self) -> "Slow":
        return self

    def nominal_rollout(self, configuration: Tensor, controls: Tensor) -> Any:
        self.clock.advance(self.finish_s)
        return self.model.nominal_rollout(configuration, controls)


def slow_policy(
    clock: SimulatedClock,
    *,
    particle_s: float = 0.0002,
    sample_s: Callable[[], float] = lambda: 0.0001,
    finish_s: float = 0.001,
) -> RummagingPolicy:
    """RUMI, each part of whose work takes a known time: 60 particles 12 ms, an iteration 20 ms, the end 1 ms."""
    policy = RummagingPolicy(None, replace(SETTINGS, reachability_scale=0.0), now=clock)
    made = policy.push_models.rollouts

    def rollouts(model: Any, poses: Tensor, *rest: Any, **told: Any) -> Any:
        clock.advance(len(poses) * particle_s)
        return Slow(made(model, poses, *rest, **told), clock, sample_s, finish_s)

    policy.push_models.rollouts = rollouts  # type: ignore[method-assign]
    return policy


def act(
    policy: RummagingPolicy, scene: Scene, clock: SimulatedClock, budget_s: float | None, previous: Plan | None = None
) -> tuple[Plan, float]:
    """A plan, and the seconds it took."""
    begun = clock()
    random = torch.Generator().manual_seed(0)
    made = policy.act(PlanRequest(belief(), scene, previous, executed=1, budget_s=budget_s, generator=random))
    return made, clock() - begun


@pytest.mark.parametrize("budget_s", [0.02, 0.03, 0.05, 0.1, 0.2])
def test_first_and_later_plans_are_in_time(scene: Scene, budget_s: float) -> None:
    clock = SimulatedClock()
    policy = slow_policy(clock)
    plan, took = act(policy, scene, clock, budget_s)
    assert took <= budget_s
    assert took > 0.4 * min(budget_s, 0.13)  # all of it takes 0.133 s
    for _ in range(4):
        plan, took = act(policy, scene, clock, budget_s, plan)
        assert took <= budget_s
        assert bool(plan.controls.isfinite().all())
        assert plan.path.shape == (6, 3)


def test_more_time_is_more_work(scene: Scene) -> None:
    clock = SimulatedClock()
    policy = slow_policy(clock)
    made = [act(policy, scene, clock, budget)[0].info for budget in (0.01, 0.02, 0.05, 0.1, 0.2)]
    samples = [info["samples"] for info in made]
    particles = [info["particles"] for info in made]
    assert samples == sorted(samples)
    assert particles == sorted(particles)
    assert particles[0] < 30
    assert particles[-1] == 60
    assert samples[-1] == 1200


def test_little_time_is_spent_on_fewer_particles_first(scene: Scene) -> None:
    clock = SimulatedClock()
    policy = slow_policy(clock, particle_s=0.002)
    plan, took = act(policy, scene, clock, 0.1)
    assert took <= 0.1
    assert 8 <= plan.info["particles"] < 30
    assert plan.info["samples"] >= 100


def test_no_time_is_the_previous_plan_later(scene: Scene) -> None:
    clock = SimulatedClock()
    policy = slow_policy(clock)
    first, _ = act(policy, scene, clock, 1.0)
    plan, took = act(policy, scene, clock, 0.001, first)
    assert took == 0.0
    assert plan.info["iterations"] == 0
    assert first.warm_start is not None
    assert plan.warm_start is not None
    told, later = first.info["predicted_information"], plan.info["predicted_information"]
    assert later == pytest.approx([*told[1:], 0.0])
    torch.testing.assert_close(plan.controls[:-1], first.controls[1:], atol=0.3, rtol=0)
    assert torch.equal(plan.path[0], scene.configuration)


def test_the_first_plan_has_a_few_samples_all_the_same(scene: Scene) -> None:
    clock = SimulatedClock()
    plan, _ = act(slow_policy(clock), scene, clock, 0.0)
    assert plan.info["samples"] == 32
    assert plan.info["particles"] == 8


def test_a_stall_does_not_end_all_planning(scene: Scene) -> None:
    clock = SimulatedClock()
    pace = {"sample": 0.0001}
    policy = slow_policy(clock, sample_s=lambda: pace["sample"])
    plan, _ = act(policy, scene, clock, 0.05)
    pace["sample"] = 0.1
    plan, took = act(policy, scene, clock, 0.05, plan)
    assert took > 0.05  # nobody could have known
    pace["sample"] = 0.0001
    iterations = []
    for _ in range(25):
        plan, took = act(policy, scene, clock, 0.05, plan)
        assert took <= 0.05
        iterations.append(plan.info["iterations"])
    assert iterations[0] == 0
    assert iterations[-1] == 1


def test_slow_noisy_work_is_seldom_late(scene: Scene) -> None:
    random = torch.Generator().manual_seed(1)
    clock = SimulatedClock()

    def sample_s() -> float:
        return 0.0001 * float(torch.empty(()).log_normal_(0.0, 0.1, generator=random))

    policy, plan, late = slow_policy(clock, sample_s=sample_s), None, 0
    for _ in range(40):
        plan, took = act(policy, scene, clock, 0.05, plan)
        late += took > 0.055
    assert late == 0


def test_pace_is_the_slowest_of_late() -> None:
    budget = PlanBudget(1.0, SimulatedClock())
    assert budget.affordable("view", 100, 0.5) == 100
    budget.took("view", 10, 0.1)
    assert budget.pace["view"] == pytest.approx(0.01)
    budget.took("view", 10, 0.05)
    assert budget.pace["view"] == pytest.approx(0.007)
    budget.took("view", 10, 0.2)
    assert budget.pace["view"] == pytest.approx(0.02)
    assert budget.affordable("view", 100, 0.5) == 20
    assert budget.eased()["view"] == pytest.approx(0.014)
    assert not budget.has_time_for("view", 100)


def test_without_a_budget_there_is_always_time() -> None:
    budget = PlanBudget(None, SimulatedClock(), {"view": 1e9})
    assert budget.open
    assert budget.has_time_for("view", 1e9)
    assert budget.affordable("view", 100, 0.5) == 100


def test_parts_grow_with_the_time_there_is() -> None:
    clock = SimulatedClock()
    sizes: list[int] = []

    def costs_of(controls: Tensor) -> Tensor:
        sizes.append(len(controls))
        clock.advance(0.001 * len(controls))
        return controls[:, 0, 0]

    controls = torch.arange(1000.0)[:, None, None]
    budget = PlanBudget(0.3, clock)
    costs = budget.in_parts(controls, costs_of)
    assert clock() <= 0.3
    done = sum(sizes)
    assert sizes[0] == 32
    assert 200 < done < 300
    assert torch.equal(costs[:done], controls[:done, 0, 0])
    assert bool(torch.isinf(costs[done:]).all())
    assert budget.no_more_samples()
    # the least there is to follow is worked out even so: who calls asks `no_more_samples` first
    sizes.clear()
    late = budget.in_parts(controls, costs_of)
    assert sizes == [16]
    assert torch.equal(late[:16], controls[:16, 0, 0])
    assert bool(torch.isinf(late[16:]).all())


def test_a_slower_iteration_is_not_late() -> None:
    """Samples of a later iteration push more: they take five times as long, which its first few tell."""
    clock = SimulatedClock()
    budget, controls = PlanBudget(0.05, clock), torch.zeros(200, 5, 3)
    for each_s in (0.0001, 0.0005):

        def costs_of(part: Tensor, each_s: float = each_s) -> Tensor:
            clock.advance(len(part) * each_s)
            return torch.zeros(len(part))

        costs = budget.in_parts(controls, costs_of)
        assert int(torch.isfinite(costs).sum()) > 40
    assert 0.045 < clock() <= 0.05
