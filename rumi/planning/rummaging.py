"""RUMI's policy: plan motions that gather information and keep the object within reach."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import NamedTuple, Self

import torch
from jaxtyping import Float
from torch import Tensor

from kmppi import MPPI, ControlPlan, MPPISettings
from rumi.belief.particles import PoseBelief
from rumi.dynamics.displacement import DisplacementSettings
from rumi.dynamics.family import PUSH_MODELS, EngineSettings, PushChoice, PushModels
from rumi.dynamics.planar import world_height
from rumi.dynamics.quasi_static import QuasiStaticSettings
from rumi.fields.information import (
    InformationSettings,
    WorkspaceFields,
    information_field,
)
from rumi.planning.trajectory_cost import TrajectoryCost
from rumi.planning.types import Plan, Scene
from rumi.planning.worth import Worth, gathered_by_action, gathering
from sdf import savings

# control sequences that are rolled out at once: the memory for more is not needed
_SAMPLES = 4096


class Suited(NamedTuple):
    """What depends on the push model.

    Attributes:
        reachability_scale: weight of the reachability cost (beta_R).
        rollouts: of each control sequence.
    """

    reachability_scale: float
    rollouts: int


SUITED = {"displacement": Suited(2.0, 5), "quasi-static": Suited(4.0, 8), "mujoco": Suited(4.0, 8)}
"""What was found best for each push model; the physics was not tuned by itself."""


def _scale_free() -> MPPISettings:
    # near the arg-min of the samples: a warmer mean of plans that go round either side of the object stands still
    return MPPISettings(temperature=0.03, cost_scale="std", iterations=2)


@dataclass(frozen=True)
class RummagingSettings:
    """Settings of the policy. The defaults do not depend on the unit of the information; `paper()` has the paper's.

    Attributes:
        information: the field that is to be gathered.
        push_model: how the object is expected to move: "displacement" carries it with the point that touches it, as
            in the paper; "quasi-static" pushes single poses of the belief, which slide and turn; "mujoco" does so with
            the simulator's physics (slow: ask for few samples). "auto" is the quasi-static model where it can be, with
            upright particles and a level tool, and the displacement model elsewhere.
        push: settings of the displacement model.
        quasi_static: settings of the quasi-static model.
        engine: settings of the physics.
        mppi: the planner; its iterations are `warmup_iterations` for the first plan.
        information_scale: weight of the information cost (beta_I); 0 leaves it out.
        reachability_scale: weight of the reachability cost (beta_R); 0 leaves it out. None for what suits the push
            model, `SUITED`.
        information_discount: factor by which information is worth less with each action until it is gathered. At 1,
            the paper's, a plan may put its touches off to the end of the horizon, and so may the next plan.
        normalise_information: count information as a share of all there is, so that both costs are in [-1, 0].
        displaced_information: count information where the object will have been moved to (Eq 29); False is the ablation
            that counts it where it is now (Eq 28).
        rollouts: how often each control sequence is rolled out; its cost is the mean. None for as many as suit the
            push model, `SUITED`.
    """

    information: InformationSettings = field(default_factory=InformationSettings)
    push_model: PushChoice = "auto"
    push: DisplacementSettings = field(default_factory=DisplacementSettings)
    quasi_static: QuasiStaticSettings = field(default_factory=QuasiStaticSettings)
    engine: EngineSettings = field(default_factory=EngineSettings)
    mppi: MPPISettings = field(default_factory=_scale_free)
    information_scale: float = 1.0
    reachability_scale: float | None = None
    information_discount: float = 0.9
    normalise_information: bool = True
    displaced_information: bool = True
    rollouts: int | None = None

    def __post_init__(self) -> None:
        """Refuse what gives nothing to plan for."""
        if self.rollouts is not None and self.rollouts < 1:
            raise ValueError(f"Expected rollouts to be 1 or more, got {self.rollouts}")
        if self.push_model not in PUSH_MODELS:
            raise ValueError(f"Expected push_model to be one of {', '.join(PUSH_MODELS)}, got {self.push_model!r}")
        reach = self.reachability_scale
        scales = (self.information_scale, math.inf if reach is None else reach)
        if not 0 < self.information_discount <= 1:
            raise ValueError(f"Expected information_discount in (0, 1], got {self.information_discount}")
        if min(scales) < 0 or max(scales) == 0:
            raise ValueError(
                "Expected information_scale and reachability_scale to be 0 or more and not both 0, "
                f"got {scales[0]} and {scales[1]}"
            )

    def suited(self, push_model: str) -> Suited:
        """What is set, or else suits a push model other than "auto"."""
        best, reach, rollouts = SUITED[push_model], self.reachability_scale, self.rollouts
        return Suited(
            best.reachability_scale if reach is None else reach, best.rollouts if rollouts is None else rollouts
        )

    @classmethod
    def paper(cls) -> Self:
        """The paper's settings (Table IV)."""
        return cls(
            information=InformationSettings(mode="surrogate"),
            push_model="displacement",
            push=DisplacementSettings(hazard="per_mini_step"),
            mppi=MPPISettings(temperature=0.01, cost_scale="raw"),
            reachability_scale=200.0,
            rollouts=5,
            information_discount=1.0,
            normalise_information=False,
        )


class RummagingPolicy:
    """RUMI: information field, push model, KMPPI. A `Policy`; holds settings and the reachability map only.

    Args:
        reachability: r(x) of every workspace point in [0, 1] (Eq 30); may be None where reachability_scale is 0.
        settings: see there.
    """

    worth_stage = "costs"
    """What making `worth` counts as, in the seconds of a plan."""

    def __init__(
        self, reachability: Float[Tensor, "V"] | None = None, settings: RummagingSettings | None = None
    ) -> None:
        self.settings = settings or RummagingSettings()
        self.reachability = reachability
        own = self.settings
        self.push_models = PushModels(own.push_model, own.push, own.quasi_static, own.engine)

    @torch.no_grad()
    def act(
        self,
        belief: PoseBelief,
        scene: Scene,
        previous: Plan | None,
        *,
        executed: int,
        budget_s: float | None,
        generator: torch.Generator,
    ) -> Plan:
        """Plan from the belief; see `rumi.planning.types.Policy`.

        A first plan starts from noise and takes the warm-up iterations; a later one starts from the previous plan,
        `executed` controls further on. With a budget, no iteration is begun that would likely end after it; one is
        always done.
        """
        with savings.account() as work:
            watch = _Stopwatch()
            settings, workspace, tool = self.settings, scene.workspace, scene.tool
            count = self.suited(belief, scene).rollouts
            sdf, poses, log_weights = scene.model.sdf, belief.world_T_object, belief.log_weights
            fields = information_field(sdf, poses, log_weights, workspace.points, settings.information)
            watch.lap("fields")
            model = self.push_models.of_belief(scene.model, poses, log_weights, tool, workspace, fields)
            watch.lap("push_model")
            worth = self.worth(belief, scene, fields, previous)
            watch.lap(self.worth_stage)

            configuration = scene.configuration.to(fields.information)

            def objective(controls: Float[Tensor, "K H A"]) -> Float[Tensor, "K"]:
                return torch.cat([cost_of(part) for part in controls.split(_SAMPLES)])

            def cost_of(controls: Float[Tensor, "K H A"]) -> Float[Tensor, "K"]:
                rollouts = model.rollout(configuration, controls, rollouts=count, generator=generator)
                watch.lap("dynamics")
                costs = worth.cost(rollouts)
                watch.lap("costs")
                return costs

            mppi = MPPI(settings.mppi, len(configuration), configuration.dtype, configuration.device)
            start, iterations = self._start(mppi, previous, executed, generator)
            nominal, samples = mppi.plan(
                start, objective, iterations=iterations, should_stop=watch.stopper(budget_s), generator=generator
            )
            watch.lap("planner")
            predicted = model.likely(configuration, nominal.controls)
            watch.lap("dynamics")
            gathered = gathered_by_action(worth.gathered, predicted)
            watch.lap("costs")
            moves = predicted.displacements[0, 0]
            plan = Plan(
                controls=nominal.controls,
                path=predicted.configurations[0, 0],
                warm_start=nominal,
                fields={"information": fields.information, "p_free": fields.semantics[..., 0]} | worth.maps,
                timings_s=watch.laps,
                info={
                    "ess": float(samples.ess),
                    "iterations": samples.iterations,
                    "least_cost": float(samples.costs.min()),
                    "information_total": float(fields.information.sum()),
                    "displacement": moves[-1].tolist(),
                    "predicted_information": gathered.tolist(),
                    "predicted_displacement": torch.diff(moves, dim=0).tolist(),
                }
                | worth.info,
            )
        return replace(plan, skipped=work.skipped() | worth.skipped)

    def suited(self, belief: PoseBelief, scene: Scene) -> Suited:
        """What is set, or else suits the push model of a scene."""
        return self.settings.suited(self.push_models.chosen(belief.world_T_object, scene.tool))

    def worth(self, belief: PoseBelief, scene: Scene, fields: WorkspaceFields, previous: Plan | None) -> Worth:
        """What motions are worth: information gathered and kept within reach (Eq 31).

        Args:
            belief: one scene's.
            scene: what else is known.
            fields: of the belief on the scene's workspace.
            previous: the last plan, None at the start.
        """
        settings, workspace = self.settings, scene.workspace
        scale = self.suited(belief, scene).reachability_scale
        reachability = None
        if scale > 0 and self.reachability is not None:
            reachability = workspace.grid(self.reachability.to(fields.information))
        sensing = world_height(scene.tool.info, scene.tool.height_m).to(fields.information)
        information = workspace.grid(fields.information)
        cost = TrajectoryCost(
            information,
            reachability,
            sensing,
            information_scale=settings.information_scale,
            reachability_scale=scale,
            information_discount=settings.information_discount,
            normalise=settings.normalise_information,
            displaced_information=settings.displaced_information,
            spatial=scene.tool.spatial,
        )
        whole = gathering(information, scene.tool)
        return Worth(
            cost,
            lambda configurations, displacements: -whole(configurations, displacements),
            {} if reachability is None else {"reachability": reachability.values.flatten()},
            skipped={
                "information_cost": float(settings.information_scale == 0),
                "reachability_cost": float(scale == 0),
            },
        )

    def _start(
        self, mppi: MPPI, previous: Plan | None, executed: int, generator: torch.Generator
    ) -> tuple[ControlPlan, int]:
        if previous is None or previous.warm_start is None:
            return mppi.initial(generator=generator), max(1, self.settings.mppi.warmup_iterations)
        return mppi.shift(previous.warm_start, executed), self.settings.mppi.iterations


class _Stopwatch:
    """Seconds by stage since it was made."""

    def __init__(self) -> None:
        self.laps: dict[str, float] = {}
        self._begun = self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.laps[name] = self.laps.get(name, 0.0) + now - self._last
        self._last = now

    def stopper(self, budget_s: float | None) -> Callable[[], bool] | None:
        """Whether another iteration as long as the longest so far would end after the budget."""
        if budget_s is None:
            return None
        last, longest = time.perf_counter(), 0.0

        def stop() -> bool:
            nonlocal last, longest
            now = time.perf_counter()
            last, longest = now, max(longest, now - last)
            return now - self._begun + longest > budget_s

        return stop
