"""Model of one plan: the fields, rollouts and costs that it evaluates motions by, and what it tells of the best."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from kmppi import ControlPlan, Rollouts
from rumi.clock import Stopwatch
from rumi.dynamics.base import PushRollouts, RolloutModel
from rumi.fields.information import WorkspaceFields
from rumi.planning.objective import Objective, gathered_by_action
from rumi.planning.policy import Plan
from rumi.planning.sampled_paths import sampled_paths
from rumi.robot.tool import Tool
from sdf import gpu, skipped_work


class PlanningModel(NamedTuple):
    """The fields, rollouts and costs that one plan evaluates motions by.

    Attributes:
        particles: that it is made of.
        fields: of them on the workspace.
        model: how the object is pushed.
        objective: what a motion is worth.
    """

    particles: int
    fields: WorkspaceFields
    model: RolloutModel
    objective: Objective

    def predicted(
        self, configuration: Float[Tensor, "Q"], nominal: ControlPlan, watch: Stopwatch
    ) -> tuple[PushRollouts, Float[Tensor, "H"]]:
        """What a plan is expected to do, and what each of its actions gathers."""
        predicted = self.model.nominal_rollout(configuration, nominal.controls)
        watch.lap("dynamics")
        gathered = gathered_by_action(self.objective.gathered, predicted)
        watch.lap("costs")
        return predicted, gathered

    def plan(
        self,
        tool: Tool,
        configuration: Float[Tensor, "Q"],
        nominal: ControlPlan,
        samples: Rollouts,
        unseen: tuple[Tensor, ...],
        work: skipped_work.Account,
        watch: Stopwatch,
    ) -> Plan:
        """The plan that controls are, and what is told of it.

        Args:
            tool: that is moved.
            configuration: where it begins.
            nominal: the controls.
            samples: of the last iteration.
            unseen: sums of what was not looked at, since a GPU would have to be waited for; finite, like the rest.
            work: account of what was skipped.
            watch: of the stages.

        Raises:
            ValueError: some number is not finite.
        """
        predicted, gathered = self.predicted(configuration, nominal, watch)
        fields, objective = self.fields, self.objective
        told = (samples.ess, samples.costs, fields.information.sum(), predicted.displacements[0, 0], gathered)
        ess, costs, information, moves, gathered, *rest = gpu.fetched(*told, *unseen, *work.pending())
        if not all(math.isfinite(float(number)) for number in (ess, *rest[: len(unseen)])):
            raise ValueError("Expected finite poses, weights, configuration and costs, got NaN or infinity among them")
        work.settle([float(number) for number in rest[len(unseen) :]])
        return Plan(
            controls=nominal.controls,
            path=predicted.configurations[0, 0],
            warm_start=nominal,
            fields={"information": fields.information, "p_free": fields.semantics[..., 0]} | objective.maps,
            timings_s=watch.laps,
            info={
                "ess": float(ess),
                "iterations": samples.iterations,
                "least_cost": float(costs.min()),
                "information_total": float(information),
                "displacement": moves[-1].tolist(),
                "predicted_information": gathered.tolist(),
                "predicted_displacement": torch.diff(moves, dim=0).tolist(),
            }
            | objective.info,
            samples=sampled_paths(tool, configuration, samples, costs),
        )
