"""What a plan made with cheaper settings loses, judged by fine rollouts on a fine lattice."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property, partial

import torch
from jaxtyping import Float
from torch import Tensor

from kmppi import MPPI, MPPISettings
from rumi.belief.particles import PoseBelief
from rumi.cache import cache_folder
from rumi.dynamics.contact import ContactField
from rumi.dynamics.displacement import DisplacementPush
from rumi.dynamics.displacement_rollouts import DisplacementRollouts, DisplacementSettings
from rumi.dynamics.tool_lookup import world_height
from rumi.fields.information import information_field
from rumi.planning.objective import TrajectoryCost
from rumi.planning.policy import Plan, PlanRequest, Scene
from rumi.planning.rummaging import RummagingPolicy, RummagingSettings
from rumi.resampling import systematic
from rumi.robot.reach import Reach
from rumi.robot.reach_table import ReachSettings
from rumi.robot.tool import Tool
from rumi.seeding import split
from scripts.bench.estimates import workspace
from scripts.bench.situations import Situation, follow
from scripts.store import Figures, Store, clock, median_seconds
from sdf.object_model import ObjectModel

_FINE_M = 0.004
_FINE_PARTICLES = 1000
_FINE_PUSH = DisplacementSettings(mini_steps=8)
_FINE_ROLLOUTS = 25


@dataclass(frozen=True)
class PlanSettings:
    """What a plan under the displacement model is made with; the rest is the default's.

    Attributes:
        particles: of the belief that is planned from.
        samples: control sequences an iteration.
        rollouts: of each.
        mini_steps: of an action.
        warmup_iterations: of a first plan.
        iterations: of a later one.
        lattice_m: spacing of the workspace.
    """

    particles: int = 100
    samples: int = MPPISettings.samples
    rollouts: int = DisplacementPush.defaults.rollouts
    mini_steps: int = DisplacementSettings.mini_steps
    warmup_iterations: int = MPPISettings.warmup_iterations
    iterations: int = 2
    lattice_m: float = 0.010

    @property
    def policy(self) -> RummagingSettings:
        """As settings of the policy."""
        base = RummagingSettings(push_model="displacement")
        mppi = replace(
            base.mppi,
            samples=self.samples,
            warmup_iterations=self.warmup_iterations,
            iterations=self.iterations,
        )
        push = replace(base.push, mini_steps=self.mini_steps)
        return replace(base, mppi=mppi, push=push, rollouts=self.rollouts)


def plan_settings(quick: bool) -> list[PlanSettings]:
    """The settings that are compared."""
    if quick:
        return [PlanSettings(), PlanSettings(samples=50, rollouts=1)]
    found = [PlanSettings()]
    found += [PlanSettings(rollouts=count) for count in (1, 3, 9)]
    found += [PlanSettings(samples=count) for count in (50, 100, 200, 1000)]
    found += [PlanSettings(mini_steps=count) for count in (1, 2, 8)]
    found += [PlanSettings(particles=count) for count in (10, 30, 300)]
    found += [PlanSettings(lattice_m=spacing) for spacing in (0.005, 0.020)]
    found += [PlanSettings(samples=samples, rollouts=count) for samples in (100, 200) for count in (1, 3)]
    found += [PlanSettings(warmup_iterations=20), PlanSettings(samples=200, rollouts=3, particles=50)]
    return list(dict.fromkeys(found))


@dataclass(eq=False)
class PlanBench:
    """One belief to plan from, and the fine objective that plans are judged by.

    Args:
        here: the situation.
        seed: of the belief.
    """

    here: Situation
    seed: int

    @cached_property
    def model(self) -> ObjectModel:
        """The object as the planner has it."""
        return self.here.spec.object_factory()

    @cached_property
    def belief(self) -> PoseBelief:
        """The filter's, with many particles."""
        return follow(self.here, self.model.sdf, particles=_FINE_PARTICLES, seed=self.seed).belief  # type: ignore[arg-type]

    def tool(self, info_spacing_m: float = 0.005) -> Tool:
        """The task's tool, its information points as far apart as asked."""
        spec = self.here.spec
        reach = Reach.of_arm(spec.base, ReachSettings(height_m=spec.height_m), cache_dir=cache_folder())
        return Tool(torch.tensor(spec.bounds), reach, height_m=spec.height_m, info_spacing_m=info_spacing_m)

    def scene(self, spacing: float, info_spacing_m: float = 0.005) -> Scene:
        """The scene on a lattice of some spacing."""
        configuration = self.here.readings[-1].configuration
        return Scene(self.model, workspace(self.here, spacing), self.tool(info_spacing_m), configuration)

    @cached_property
    def objective(self) -> "FineObjective":
        """The fine objective; made at its first use."""
        return FineObjective(self.belief, self.scene(_FINE_M, 0.5 * _FINE_M))

    def fewer(self, count: int) -> PoseBelief:
        """The belief with fewer particles, evenly by weight."""
        belief = self.belief
        index = systematic(belief.log_weights, 0.5, count)
        return replace(
            belief,
            attached_T_object=belief.attached_T_object[index],
            log_weights=torch.log_softmax(belief.log_weights.new_zeros(count), -1),
            discrepancy=belief.discrepancy[index],
        )

    def planner(self, settings: PlanSettings, seed: int) -> Callable[[Plan | None], Plan]:
        """What makes a plan from an earlier one, or a first one from none."""
        scene, belief = self.scene(settings.lattice_m), self.fewer(settings.particles)
        reach = scene.tool.reach
        assert reach is not None
        policy = RummagingPolicy(reach.field(scene.workspace.points), settings.policy)

        def act(previous: Plan | None) -> Plan:
            noise = split(seed, "plan")
            return policy.act(PlanRequest(belief, scene, previous, generator=noise))

        return act


class FineObjective:
    """The policy's cost, displacement model: 25 rollouts of 8 mini steps, a 4 mm lattice, 1000 particles.

    Args:
        belief: fine.
        scene: fine.
    """

    def __init__(self, belief: PoseBelief, scene: Scene) -> None:
        settings, space = RummagingSettings(), scene.workspace
        poses, sdf, reach = belief.world_T_object, scene.model.sdf, scene.tool.reach
        fields = information_field(sdf, poses, belief.log_weights, space.points, settings.information)
        contact = ContactField.from_belief(sdf, poses, belief.log_weights, space, fields)
        self.configuration = scene.configuration.to(fields.information)
        self._model = DisplacementRollouts(contact, scene.tool, _FINE_PUSH)
        assert reach is not None
        self._cost = TrajectoryCost(
            space.grid(fields.information),
            space.grid(reach.field(space.points)),
            world_height(scene.tool.info, scene.tool.height_m),
            information_scale=settings.information_scale,
            reachability_scale=DisplacementPush.defaults.reachability_scale,
            information_discount=settings.information_discount,
            normalise=settings.normalise_information,
        )

    @torch.no_grad()
    def __call__(self, controls: Float[Tensor, "K H A"]) -> Float[Tensor, "K"]:
        """Cost of control sequences."""
        costs = []
        for part in controls.split(64):  # the marks of more would not fit a small machine
            rollouts = self._model.rollout(
                self.configuration, part, rollouts=_FINE_ROLLOUTS, generator=split(0, "unused")
            )
            costs.append(self._cost(rollouts))
        return torch.cat(costs)


def best_plan(bench: PlanBench, *, quick: bool) -> Figures:
    """Least fine cost that a large budget finds, and that of standing still."""
    starts, polish = (1, 2) if quick else (3, 8)
    wide = PlanSettings(samples=200 if quick else 1000, warmup_iterations=5 if quick else 20)
    plans = [bench.planner(wide, seed)(None) for seed in range(starts)]
    costs = bench.objective(torch.stack([plan.controls for plan in plans]))
    least, mppi = float(costs.min()), None
    for index in costs.argsort()[:2].tolist():
        mppi = MPPI(replace(RummagingSettings().mppi, samples=192, noise_variance=0.1), 3)
        warm = plans[index].warm_start
        assert warm is not None
        for iteration in range(polish):
            warm, samples = mppi.plan(warm, bench.objective, iterations=1, generator=split(iteration, "polish"))
            least = min(least, float(samples.costs.min()))
    still = float(bench.objective(torch.zeros_like(plans[0].controls)[None])[0])
    return {"least": least, "still": still}


def plan_figures(bench: PlanBench, settings: PlanSettings) -> Figures:
    """Fine cost of a first plan."""
    plan = bench.planner(settings, bench.seed)(None)
    return {"cost": float(bench.objective(plan.controls[None])[0])}


def plan_seconds(bench: PlanBench, settings: PlanSettings) -> Figures:
    """Time of a first plan and of a later one."""
    act = bench.planner(settings, bench.seed)
    act(None)  # warms up
    begun = clock()
    first = act(None)
    first_s = clock() - begun
    return {"first_s": first_s, "pass_s": median_seconds(lambda: act(first), budget_s=2.0)}


def measure_plans(store: Store, bench: PlanBench, *, quick: bool) -> Iterator[bool]:
    """Do what is missing for one belief, one measurement at a time."""
    about = {"situation": bench.here.name, "points": bench.here.digest, "seed": bench.seed}
    yield store.measure({"part": "best-plan", **about}, partial(best_plan, bench, quick=quick))
    for settings in plan_settings(quick):
        yield store.measure({"part": "plan", **about, **vars(settings)}, partial(plan_figures, bench, settings))


def time_plans(store: Store, bench: PlanBench, *, quick: bool) -> Iterator[bool]:
    """Take the times that are missing; meant for a machine with nothing else to do."""
    about = {"situation": bench.here.name, "threads": torch.get_num_threads()}
    for settings in plan_settings(quick):
        yield store.measure({"part": "plan-time", **about, **vars(settings)}, partial(plan_seconds, bench, settings))
