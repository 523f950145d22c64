"""Predicted against realised: what single actions were expected to do, and what they did.

Two predictions are kept apart. What a plan said when it was made is in its own unit (nats of RUMI's field, or GPVR's
variance). What a field and a push model would have said of the same action in the same situation can be worked out
afterwards for any of them, so that all are judged on the same actions.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rumi.belief.particles import PoseBelief
from rumi.belief.pose_filter import PoseFilter
from rumi.dynamics.registry import PushModels
from rumi.fields.information import InformationSettings, information_field
from rumi.fields.workspace import Workspace
from rumi.planning.objective import gathering
from rumi.records import StepRecord
from rumi.robot.tool import Tool
from scripts.reproduce.correlation import rank_correlations
from sdf import se3
from sdf.object_model import ObjectModel
from sensors.evidence import in_attached_frame


@dataclass(frozen=True)
class Predicted:
    """What was expected of one action.

    Attributes:
        information: what it would gather that the plan had not gathered before, in the unit of its field.
        displacement_m: how far it would move the object, along the world's axes.
    """

    information: float
    displacement_m: tuple[float, float, float]


@dataclass(frozen=True)
class Realised:
    """What one action did.

    Attributes:
        gained: nats that its readings said about the pose: KL divergence from the belief before it to the same
            particles weighed by the new points too (RUMI's information is its expectation, Eq 12).
        drop: nats by which the nll that the belief expects of itself went down.
        displacement_m: how far the object's frame really moved; where the truth is unknown, by the measured motion at
            the belief's mean.
        touched: whether the sensors felt the object.
    """

    gained: float
    drop: float
    displacement_m: tuple[float, float, float]
    touched: bool


def from_plan(steps: Sequence[StepRecord], index: int) -> Predicted | None:
    """What the plan said of the action that led to step `index`; None of policies that predict nothing.

    Args:
        steps: of a run, from the first view on.
        index: 1 or more.
    """
    plan, place = steps[index].plan, 0
    if plan is None or "predicted_information" not in plan.info:
        return None
    while steps[index - place - 1].plan is plan:
        place += 1
    x, y, z = plan.info["predicted_displacement"][place]
    return Predicted(float(plan.info["predicted_information"][place]), (x, y, z))


def realised(steps: Sequence[StepRecord], index: int, follower: PoseFilter) -> Realised:
    """What the action that led to step `index` did.

    Args:
        steps: of a run, from the first view on.
        index: 1 or more.
        follower: that made the beliefs; its discrepancy is the new points' likelihood.
    """
    before, after = steps[index - 1], steps[index]
    moved: Tensor
    if before.truth is not None and after.truth is not None:
        moved = after.truth[:3, 3] - before.truth[:3, 3]
    else:
        motion = after.belief.world_T_attached @ se3.inverse(before.belief.world_T_attached)
        mean = before.belief.mean()
        moved = (motion @ mean - mean)[:3, 3]
    x, y, z = moved.tolist()
    return Realised(
        information_gained(before.belief, after, follower),
        before.expected_nll - after.expected_nll,
        (x, y, z),
        bool(after.reading.in_contact.any()),
    )


@torch.no_grad()
def information_gained(before: PoseBelief, after: StepRecord, follower: PoseFilter) -> float:
    """KL divergence, nats, from a belief to the same particles weighed by the points that a step added as well.

    The particles ride with the object, so that its motion does not count; nor does what resampling does to them.
    """
    points = in_attached_frame(after.added, after.belief.world_T_attached)
    if len(points) == 0:
        return 0.0
    change = -follower.settings.peakiness * follower.discrepancy(before.attached_T_object, points)
    posterior = torch.log_softmax((before.log_weights + change).double(), -1)
    prior = torch.log_softmax(before.log_weights.double(), -1)
    weights = posterior.exp()
    terms = torch.where(weights > 0, weights * (posterior - prior), torch.zeros_like(weights))
    return max(0.0, float(terms.sum()))


class Situation:
    """One belief before one action, from which fields and push models predict.

    Args:
        before: the step before the action.
        model: the object.
        workspace: the lattice of the fields.
        tool: the gripper.
    """

    def __init__(self, before: StepRecord, model: ObjectModel, workspace: Workspace, tool: Tool) -> None:
        self.before, self.model, self.workspace, self.tool = before, model, workspace, tool

    @torch.no_grad()
    def predict(
        self,
        control: Float[Tensor, "A"],
        information: InformationSettings,
        push: PushModels,
        *,
        rollouts: int = 0,
        generator: torch.Generator | None = None,
    ) -> Predicted:
        """What a field and a push model expect of an action.

        Raises:
            ValueError: the push model cannot do with this belief.

        Args:
            control: of the action.
            information: the field.
            push: makes the push model.
            rollouts: to take the mean over, as a planner's cost does; 0 for the likeliest one.
            generator: of the rollouts.
        """
        fields, field = self._fields(information)
        belief = self.before.belief
        model = push.rollouts(self.model, belief.world_T_object, belief.log_weights, self.tool, self.workspace, fields)
        start, controls = self.before.reading.configuration.to(fields.information), control[None].to(fields.information)
        if rollouts == 0:
            done = model.nominal_rollout(start, controls)
        else:
            if generator is None:
                raise ValueError("Expected a generator for rollouts, got None: give one, or 0 rollouts")
            done = model.rollout(start, controls[None], rollouts=rollouts, generator=generator)
        x, y, z = done.displacements[0, :, -1].mean(0).tolist()
        seen = done.paths(torch.ones_like(done.touched)).in_object_frame()
        return Predicted(-float(gathering(field, self.tool)(*seen).mean()), (x, y, z))

    @torch.no_grad()
    def swept(self, after: StepRecord, information: InformationSettings) -> float | None:
        """What a field would have promised, had the tool's and the object's true motion been known beforehand.

        The tool's way as the object saw it: each pose carried back by the measured motion up to its instant. None
        where no motion was measured.
        """
        motion = after.reading.object_motion
        if motion is None:
            return None
        _, field = self._fields(information)
        ridden = se3.inverse(motion) @ after.reading.tool_pose
        way = se3.to_planar(ridden)
        if len(self.tool.scale) == 4:
            way = torch.cat((way[:, :2], ridden[:, 2:3, 3], way[:, 2:]), -1)
        way = way[None].to(field.values)
        return -float(gathering(field, self.tool)(way, torch.zeros_like(way[..., :3])))

    def _fields(self, information: InformationSettings) -> Any:  # noqa: ANN401  (fields and one of them as a grid)
        belief = self.before.belief
        fields = information_field(
            self.model.sdf, belief.world_T_object, belief.log_weights, self.workspace.points, information
        )
        return fields, self.workspace.grid(fields.information)


def run_spearman(
    runs: Sequence[tuple[Sequence[float], Sequence[float]]], *, seed: int = 0, resamples: int = 500
) -> tuple[float, float, float]:
    """Rank correlation over the actions of all runs, with its 95 % bootstrap interval.

    Whole runs are drawn, since the actions of one hang together. NaN where a quantity never changes.

    Args:
        runs: both quantities of the actions of each run, finite.
        seed: of the resampling.
        resamples: how many.
    """
    if not runs:
        raise ValueError("Expected one or more runs, got none")
    pairs = [np.array(run, dtype=float).reshape(2, -1) for run in runs]
    first, second = np.concatenate(pairs, axis=1)
    drawn = np.random.default_rng(seed).integers(0, len(pairs), (resamples, len(pairs)))
    times = np.array([np.bincount(row, minlength=len(pairs)) for row in (*drawn, range(len(pairs)))])
    times = times.repeat([pair.shape[1] for pair in pairs], axis=1).astype(float)
    *found, middle = rank_correlations(first, second, times)
    known = [value for value in found if math.isfinite(value)]
    low, high = np.quantile(known, [0.025, 0.975]) if known else (math.nan, math.nan)
    return float(middle), float(low), float(high)


@dataclass(frozen=True)
class Agreement:
    """How well some actions were predicted.

    Attributes:
        actions, runs: number of each.
        information: rank correlation of the information predicted and gained, with its interval.
        distance: rank correlation of the lengths of the displacement predicted and true, with its interval.
        error_m: median length of their difference, over actions for which either is a move; NaN for none.
        pushes: share of the true moves that were predicted as a move; NaN for none.
        false_pushes: share of the actions without a move that were predicted as a move; NaN for none.
    """

    actions: int
    runs: int
    information: tuple[float, float, float]
    distance: tuple[float, float, float]
    error_m: float
    pushes: float
    false_pushes: float

    def as_dict(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self)


def agreement(
    runs: Sequence[Sequence[tuple[Predicted, Realised]]], *, still_m: float = 1e-3, resamples: int = 500
) -> Agreement:
    """How well the actions of some runs were predicted.

    Args:
        runs: predicted and realised of each run's actions, runs without any left out.
        still_m: a displacement of less is no move.
        resamples: of the intervals.
    """
    runs = [run for run in runs if run]
    every = [pair for run in runs for pair in run]
    if not every:
        none = (math.nan, math.nan, math.nan)
        return Agreement(0, 0, none, none, math.nan, math.nan, math.nan)
    expected = np.array([p.displacement_m for p, _ in every])
    true = np.array([r.displacement_m for _, r in every])
    moves, expected_moves = (np.linalg.norm(d, axis=-1) > still_m for d in (true, expected))
    either = moves | expected_moves
    errors = np.linalg.norm(expected - true, axis=-1)[either]

    def length(action: Predicted | Realised) -> float:
        return math.hypot(*action.displacement_m)

    return Agreement(
        len(every),
        len(runs),
        run_spearman(
            [([p.information for p, _ in run], [r.gained for _, r in run]) for run in runs], resamples=resamples
        ),
        run_spearman([([length(p) for p, _ in run], [length(r) for _, r in run]) for run in runs], resamples=resamples),
        float(np.median(errors)) if len(errors) else math.nan,
        float(expected_moves[moves].mean()) if moves.any() else math.nan,
        float(expected_moves[~moves].mean()) if (~moves).any() else math.nan,
    )


def predicted_of(values: Mapping[str, Any]) -> Predicted:
    """A prediction from its plain values."""
    return Predicted(float(values["information"]), tuple(values["displacement_m"]))


def realised_of(values: Mapping[str, Any]) -> Realised:
    """What an action did, from its plain values."""
    return Realised(values["gained"], values["drop"], tuple(values["displacement_m"]), values["touched"])


def actions(steps: Sequence[StepRecord]) -> Iterator[int]:
    """Indices of the steps that an action led to and whose belief before it is known."""
    yield from (index for index in range(1, len(steps)) if steps[index].control is not None)
