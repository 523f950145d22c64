"""RUMI's policy: plans that gather information and keep the object within reach."""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from kmppi import MPPI, ControlPlan
from rumi import seeding
from rumi.belief.particles import PoseBelief, subsample
from rumi.clock import Now, Stopwatch
from rumi.dynamics.base import PushDefaults, RolloutModel
from rumi.dynamics.registry import PushModels
from rumi.fields.information import WorkspaceFields, information_field
from rumi.planning.objective import Objective, TrajectoryCost, gathering, sensing_points, without
from rumi.planning.plan_budget import PlanBudget
from rumi.planning.planning_model import PlanningModel
from rumi.planning.policy import Plan, PlanRequest, Scene
from rumi.planning.rummaging_settings import RummagingSettings
from sdf import gpu, skipped_work
from sdf.check import may_look

__all__ = ["PlanProposals", "RummagingPolicy", "RummagingSettings"]

PlanProposals = Callable[[PlanRequest, WorkspaceFields], Float[Tensor, "P S A"]]
"""Knots of nominal plans beside the previous one, by the request and the fields of its belief."""

# control sequences that are rolled out at once: the memory for more is not needed
_SAMPLES = 4096
# samples that are rolled out in full, at least
_LEAST_KEPT = 16
# particles of the rough view of the scene that a plan with a deadline begins with, where it knows no pace yet
_FEW = 8
# of the time that is left, what fields and push model may take
_VIEW_SHARE = 0.4
# particles that would take as long as what of them does not depend on the number of particles
_VIEW_FIXED = 10
# times that a plan which stands still is made anew, and what becomes of the weight on reach each time
_RELAXED, _EASED = 3, 0.25


class RummagingPolicy:
    """RUMI: information field, push model, KMPPI. A `Policy`; holds settings and the reachability map only.

    Args:
        reachability: r(x) of every workspace point in [0, 1] (Eq 30); may be None where reachability_scale is 0.
        settings: of sampling, costs and the push model.
        proposals: further nominal plans, such as a trained network's; the best is sampled around. None for none.
        now: the clock that budgets are held against.
    """

    objective_stage = "costs"
    """What making the objective counts as, in the seconds of a plan."""

    def __init__(
        self,
        reachability: Float[Tensor, "V"] | None = None,
        settings: RummagingSettings | None = None,
        *,
        proposals: PlanProposals | None = None,
        now: Now = time.perf_counter,
    ) -> None:
        self.now = now
        self.proposals = proposals
        self.settings = settings or RummagingSettings()
        self.reachability = reachability
        self.push_models = PushModels(self.settings)
        self._planners: dict[tuple[int, torch.dtype, torch.device], MPPI] = {}

    @torch.no_grad()
    def act(self, request: PlanRequest) -> Plan:
        """Plan from the belief; see `rumi.planning.policy.Policy`.

        A plan that gathers next to nothing, since all else would cost reach, is made anew with less weight on reach: a
        run that is not over gains nothing by standing still.
        """
        suited = self.suited(request.belief, request.scene)
        plan = self.planned(request, suited)
        for relaxed in range(_RELAXED if self._weighs_both(suited) and request.budget_s is None else 0):
            if sum(plan.info["predicted_information"]) >= suited.least_share * plan.info["information_total"]:
                break
            scale = _EASED ** (relaxed + 1) * suited.reachability_scale
            before, plan = plan, self.planned(request, suited._replace(reachability_scale=scale))
            spent = {stage: s + plan.timings_s.get(stage, 0.0) for stage, s in before.timings_s.items()}
            plan = replace(plan, timings_s=spent)
        return plan

    def _weighs_both(self, suited: PushDefaults) -> bool:
        """Whether plans weigh information against reach, so that reach may be eased."""
        return self.reachability is not None and suited.reachability_scale > 0 and self.settings.information_scale > 0

    def planned(self, request: PlanRequest, suited: PushDefaults) -> Plan:
        """The plan by what suits the scene, such as the weight on reach.

        A first plan starts from noise and takes the warm-up iterations; a later one starts from the previous plan,
        `executed` controls further on.

        With a budget the plan is the same where there is time for all of it. Where there is not, it is made with fewer
        particles, fewer samples in the last iteration, or fewer iterations; and where there is no time even for a few
        of each, the plan is the previous one, later. Only a first plan is made with a few of each all the same. How
        long things take is known from the plan before (`info["pace"]`), of a first plan from a view of a few particles.

        On a GPU the host waits once before it begins, to see how the particles stand, and once at the end, for what is
        told of the plan; with a budget at every look at the clock, too. The seconds by stage are the host's then.
        """
        belief, scene, previous = request.belief, request.scene, request.previous
        executed = request.executed
        poses = belief.world_T_object
        with skipped_work.account() as work, gpu.no_waits(poses.device):
            now = gpu.after_all(poses.device, self.now) if request.budget_s is not None else self.now
            budget = PlanBudget(request.budget_s, now, None if previous is None else previous.info.get("pace"))
            watch = Stopwatch(now)
            configuration, count = scene.configuration.to(scene.workspace.points), suited.rollouts
            generator = seeding.on_device(request.generator, configuration.device)
            mppi = self._mppi(configuration)
            start, iterations = self._start(mppi, previous, executed, generator)
            if previous is not None and previous.warm_start is not None and self._too_late(budget):
                return self._carried_on(previous, start, executed, scene, budget)
            view = self._view_in_time(belief, scene, previous, budget, watch, poses, suited)
            if not budget.open and not budget.knows("finish"):
                budget.timed("finish", 1.0, lambda: view.predicted(configuration, start, watch))

            coarse, few = view.model.coarse(), min(self.settings.screen_rollouts, count)

            def costs_of(controls: Float[Tensor, "K H A"]) -> Float[Tensor, "K"]:
                kept = max(_LEAST_KEPT, math.ceil(self.settings.screen_kept * len(controls)))
                if kept >= len(controls) or few == count:
                    return in_parts(controls, lambda part: cost_of(view.model, part, count))
                budget.reserve(kept)
                costs = in_parts(controls, lambda part: cost_of(coarse, part, few))
                if may_look(costs):
                    kept = min(kept, int(costs.isfinite().sum()))
                least = costs.topk(kept, largest=False, sorted=True)
                fine = in_parts(controls[least.indices], lambda part: cost_of(view.model, part, count), "kept")
                finite = (fine + least.values).abs() < math.inf
                return costs.index_copy(0, least.indices, torch.where(finite, fine, least.values))

            def in_parts(
                controls: Float[Tensor, "K H A"], do: Callable[[Tensor], Tensor], kind: str = "sample"
            ) -> Float[Tensor, "K"]:
                if budget.open:
                    done = [do(part) for part in controls.split(_SAMPLES)]
                    return done[0] if len(done) == 1 else torch.cat(done)
                return budget.in_parts(controls, do, kind)

            def cost_of(model: RolloutModel, controls: Float[Tensor, "K H A"], rollouts: int) -> Float[Tensor, "K"]:
                rolled = model.rollout(configuration, controls, rollouts=rollouts, generator=generator)
                watch.lap("dynamics")
                costs = view.objective.cost(rolled)
                watch.lap("costs")
                return costs

            should_stop = None if budget.open else budget.no_more_samples
            further = None if self.proposals is None else self.proposals(request, view.fields)
            nominal, samples = mppi.plan(
                start, costs_of, proposals=further, iterations=iterations, should_stop=should_stop, generator=generator
            )
            watch.lap("planner")
            ending = budget.now()
            unseen = () if may_look(poses) else (poses.sum(), belief.log_weights.amax(), configuration.sum())
            predicted, gathered = view.predicted(configuration, nominal, watch)
            told = _fetched(view.told(samples, predicted, gathered), unseen, work)
            plan = view.plan(scene.tool, configuration, nominal, samples, predicted, told, watch)
            budget.took("finish", 1.0, budget.now() - ending)
            if not budget.open:
                made = {"pace": budget.pace, "particles": view.particles, "samples": budget.samples}
                plan = replace(plan, info=plan.info | made)
        return replace(plan, skipped=work.skipped() | view.objective.skipped)

    def _view_in_time(
        self,
        belief: PoseBelief,
        scene: Scene,
        previous: Plan | None,
        budget: PlanBudget,
        watch: Stopwatch,
        poses: Float[Tensor, "N 4 4"] | None = None,
        suited: PushDefaults | None = None,
    ) -> PlanningModel:
        """All that motions are judged by, of as many particles as there is time for.

        The belief's poses and what suits it are worked out where they are not given.
        """
        whole, used = len(belief.log_weights), belief
        sure = budget.open or budget.knows("view")
        if not sure:
            used = subsample(belief, _FEW)
            fields, model = self._fields(used, used.world_T_object, scene, budget, watch)
        count = budget.affordable("view", whole + _VIEW_FIXED, _VIEW_SHARE) - _VIEW_FIXED
        if sure or (used is not belief and (count > 2 * _FEW or count == whole)):
            used = subsample(belief, max(count, _FEW))
            own = poses if used is belief and poses is not None else used.world_T_object
            fields, model = self._fields(used, own, scene, budget, watch)
        begun = budget.now()
        objective = self.objective(used, scene, fields, previous, budget, suited)
        budget.took("objective", 1.0, budget.now() - begun)
        watch.lap(self.objective_stage)
        return PlanningModel(len(used.log_weights), fields, model, objective)

    def _fields(
        self,
        belief: PoseBelief,
        poses: Float[Tensor, "N 4 4"],
        scene: Scene,
        budget: PlanBudget,
        watch: Stopwatch,
    ) -> tuple[WorkspaceFields, RolloutModel]:
        workspace, sdf, log_weights = scene.workspace, scene.model.sdf, belief.log_weights
        begun = budget.now()
        fields = information_field(sdf, poses, log_weights, workspace.points, self.settings.information)
        watch.lap("fields")
        known = (scene.model, poses, log_weights, scene.tool, workspace, fields)
        model = self.push_models.rollouts(*known, pushes=scene.pushes)
        watch.lap("push_model")
        budget.took("view", len(log_weights) + _VIEW_FIXED, budget.now() - begun)
        return fields, model

    def _too_late(self, budget: PlanBudget) -> bool:
        """Whether there is no time for a view of few particles and an iteration of few samples."""
        if budget.open:
            return False
        view = budget.expected("view", _FEW + _VIEW_FIXED)
        return view + self._least_objective(budget) + budget.few_samples() >= budget.left()

    def _least_objective(self, budget: PlanBudget) -> float:
        """Seconds that `objective` is expected to take at least."""
        return budget.expected("objective")

    def _carried_on(self, previous: Plan, start: ControlPlan, executed: int, scene: Scene, budget: PlanBudget) -> Plan:
        """The previous plan, `executed` controls later, as it is."""
        configuration = scene.configuration.to(start.controls)
        free = scene.tool.free_path(configuration[None], start.controls[None], 1)[0]
        path = torch.cat((configuration[None], free))
        info: dict[str, Any] = {"iterations": 0, "samples": 0, "particles": 0, "pace": budget.eased()}
        for name in ("predicted_information", "predicted_displacement"):
            told = torch.tensor(previous.info[name])
            later = torch.zeros_like(told)
            later[: max(len(told) - executed, 0)] = told[executed:]
            info[name] = later.tolist()
        info["displacement"] = torch.tensor(info["predicted_displacement"]).sum(0).tolist()
        kept = {name: value for name, value in previous.info.items() if name.startswith("gp_")}
        return Plan(start.controls, path, warm_start=start, fields=previous.fields, info=kept | info)

    def suited(self, belief: PoseBelief, scene: Scene) -> PushDefaults:
        """What is set, or else suits the push model of a scene."""
        return self.settings.suited(self.push_models.chosen(belief.world_T_object, scene.tool))

    def objective(
        self,
        belief: PoseBelief,
        scene: Scene,
        fields: WorkspaceFields,
        previous: Plan | None,
        budget: PlanBudget | None = None,
        suited: PushDefaults | None = None,
    ) -> Objective:
        """What motions are worth: information gathered and kept within reach (Eq 31).

        Args:
            belief: one scene's.
            scene: what else is known.
            fields: of the belief on the scene's workspace.
            previous: the last plan, None at the start.
            budget: of the plan; None for no limit.
            suited: what `suited` says of the belief, where that is known.
        """
        settings, workspace = self.settings, scene.workspace
        scale = (suited or self.suited(belief, scene)).reachability_scale
        reachability = None
        if scale > 0 and self.reachability is not None:
            reachability = workspace.grid(self.reachability.to(fields.information))
        sensing = sensing_points(scene.tool, fields.information)
        information = workspace.grid(fields.information)
        if settings.sensed_here:
            information = without(information, scene.tool.info_points(scene.configuration.to(fields.information)))
        cost = TrajectoryCost(
            information,
            reachability,
            sensing,
            information_scale=settings.information_scale,
            reachability_scale=scale,
            push_scale=settings.push_scale or 0.0,
            information_discount=settings.information_discount,
            normalise=settings.normalise_information,
            displaced_information=settings.displaced_information,
            spatial=scene.tool.spatial,
        )

        def gathered(configurations: Float[Tensor, "R H Q"], displacements: Float[Tensor, "R H 3"]) -> Tensor:
            own = cost.information
            # undiscounted of the same cells, which the costs have found by now
            whole = gathering(information, scene.tool, sensing) if own is None else own.undiscounted()
            return -whole(configurations, displacements)

        return Objective(
            cost,
            gathered,
            {} if reachability is None else {"reachability": reachability.values.flatten()},
            skipped={
                "information_cost": float(settings.information_scale == 0),
                "reachability_cost": float(scale == 0),
            },
        )

    def _mppi(self, like: Float[Tensor, "Q"]) -> MPPI:
        """The sampler of controls of a tool's configuration; its matrices are made once."""
        key = len(like), like.dtype, like.device
        if key not in self._planners:
            self._planners[key] = MPPI(self.settings.mppi, *key)
        return self._planners[key]

    def _start(
        self, mppi: MPPI, previous: Plan | None, executed: int, generator: torch.Generator
    ) -> tuple[ControlPlan, int]:
        if previous is None or previous.warm_start is None:
            return mppi.initial(generator=generator), max(1, self.settings.mppi.warmup_iterations)
        return mppi.shift(previous.warm_start, executed), self.settings.mppi.iterations


def _fetched(told: Sequence[Tensor], unseen: Sequence[Tensor], work: skipped_work.Account) -> list[Tensor]:
    """What is told of a plan, on the host, once what nobody looked at before is seen to be finite."""
    found = gpu.fetched(*told, *unseen, *work.pending())
    kept, seen, pending = found[: len(told)], found[len(told) :][: len(unseen)], found[len(told) + len(unseen) :]
    if not all(math.isfinite(float(number)) for number in (kept[0], *seen)):
        raise ValueError("Expected finite poses, weights, configuration and costs, got NaN or infinity among them")
    work.settle([float(number) for number in pending])
    return kept
