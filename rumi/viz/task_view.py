"""View of a task: what a viewer shows of its steps and decisions, beside the belief that all tasks have."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rumi.registration.pose_summary import PoseSummary
from rumi.viz.primitives import Shape

_PLANE = (0, 1, 5)  # x, y and yaw of a pose's covariance
_LEAST = 1e-12  # added to variances, so that a belief of one pose has a density

ENTROPY = "nats, of a normal belief over x, y and yaw"
"""What the curve of the entropy is, for every task."""


@dataclass(frozen=True, eq=False)
class StepView:
    """What a viewer shows of a step.

    Attributes:
        scene: shapes by name, world frame; one that was shown before stays until it is shown anew.
        curves: values by plot and name, such as "nll/true".
        remarks: lines on what is odd about it.
    """

    scene: Mapping[str, Shape] = field(default_factory=dict)
    curves: Mapping[str, float] = field(default_factory=dict)
    remarks: Sequence[str] = ()


@dataclass(frozen=True, eq=False)
class DecisionView:
    """What a viewer shows of a decision, at the step at which it was made.

    Attributes:
        scene: the chosen action and the rejected ones by name, world frame.
        words: why this action, in Markdown.
        curves: values by plot and name.
    """

    scene: Mapping[str, Shape]
    words: str
    curves: Mapping[str, float] = field(default_factory=dict)


@runtime_checkable
class TaskView(Protocol):
    """View of a task.

    Attributes:
        plots: what each plot of curves shows, by its name.
        bounds: (2, 3), least and greatest corner of where things happen; None looks where the viewer likes.
    """

    plots: Mapping[str, str]
    bounds: Float[Tensor, "2 3"] | None

    def fixed(self) -> Mapping[str, Shape]:
        """Shapes that no step changes, world frame."""
        ...

    def body(self) -> Mapping[str, Shape]:
        """The object's shapes, object frame."""
        ...

    def outline(self, world_T_object: Float[Tensor, "4 4"]) -> list[np.ndarray]:
        """Lines (M, 3) of the object at a pose, world frame."""
        ...

    def step(self, records: Sequence[Any], pose: PoseSummary | None) -> StepView:
        """The last of some steps.

        Args:
            records: of the steps up to it, of the task's own kind.
            pose: what its belief knows of the object's pose; None where it knows nothing yet.
        """
        ...

    def decision(self, records: Sequence[Any]) -> DecisionView | None:
        """The decision that led to the last of some steps; None where none did."""
        ...


def planar_entropy(pose: PoseSummary) -> float:
    """Differential entropy, nats, of the normal belief over x, y and yaw (m, rad) of a summary's covariance."""
    return 0.5 * float(torch.logdet(2 * math.pi * math.e * _planar(pose)))


def planar_nll(pose: PoseSummary, truth: Float[Tensor, "3"], period: float = 2 * math.pi) -> float:
    """Negative log-density, nats, of a true (x, y, yaw) in the normal belief of a summary's best pose and covariance.

    Args:
        pose: the summary.
        truth: (3,), metres and radians.
        period: turn after which the object looks the same; the nearest such yaw counts.
    """
    best = pose.world_T_object
    yaw = math.atan2(float(best[1, 0]), float(best[0, 0]))
    turn = math.remainder(float(truth[2]) - yaw, period)
    apart = torch.cat((truth[:2].double() - best[:2, 3], torch.tensor([turn], dtype=torch.float64)))
    covariance = _planar(pose)
    squared = float(apart @ torch.linalg.solve(covariance, apart))
    return 0.5 * (squared + float(torch.logdet(2 * math.pi * covariance)))


def _planar(pose: PoseSummary) -> Float[Tensor, "3 3"]:
    return pose.covariance[list(_PLANE)][:, list(_PLANE)] + _LEAST * torch.eye(3, dtype=torch.float64)
