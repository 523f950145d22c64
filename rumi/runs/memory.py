"""Memory: all points that a run has observed, in the world."""

from collections.abc import Sequence

from rumi.records import StepRecord
from sensors.observation import Observation, concatenate, in_world


def memory(steps: Sequence[StepRecord]) -> Observation:
    """All points observed up to the last step, in the world as it is then."""
    return in_world(concatenate([step.added for step in steps]), steps[-1].belief.world_T_attached)
