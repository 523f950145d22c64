"""Memory: all points that a run has observed, in the world."""

from collections.abc import Sequence

import torch

from rumi.records import StepRecord
from sdf import se3
from sensors.observation import Observation, concatenate


def memory(steps: Sequence[StepRecord]) -> Observation:
    """All points observed up to the last step, in the world as it is then."""
    points = concatenate([step.added for step in steps])
    moved = se3.apply(steps[-1].belief.world_T_attached.to(points.points), points.points)
    world = torch.where(points.attached[:, None], moved, points.points)
    return Observation(world, points.semantics, points.attached, points.valid)
