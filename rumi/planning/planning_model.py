"""Model of one plan: the fields, rollouts and costs that it evaluates motions by, and what it tells of the best."""

from collections.abc import Sequence
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

    def told(
        self, samples: Rollouts, predicted: PushRollouts, gathered: Float[Tensor, "H"]
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """What is told of a plan, where it was worked out: the ESS of its samples first."""
        return samples.ess, samples.costs, self.fields.information.sum(), predicted.displacements[0, 0], gathered

    def plan(
        self,
        tool: Tool,
        configuration: Float[Tensor, "Q"],
        nominal: ControlPlan,
        samples: Rollouts,
        predicted: PushRollouts,
        told: Sequence[Tensor],
        watch: Stopwatch,
    ) -> Plan:
        """The plan that controls are.

        Args:
            tool: that is moved.
            configuration: where it begins.
            nominal: the controls.
            samples: of the last iteration.
            predicted: what they are expected to do.
            told: what `told` has of them, on the host.
            watch: of the stages.
        """
        ess, costs, information, moves, gathered = told
        fields, objective = self.fields, self.objective
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
