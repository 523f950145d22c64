"""Free points as RUMI's Alg 6 has them: at rest in the world, and gone once they may be occupied."""

from dataclasses import replace

from jaxtyping import Float
from torch import Tensor

from sdf.base import SDF
from sdf.posed import posed_distance
from sensors.observation import Observation, compact, in_world
from sensors.semantics import Semantics


def stationary(observation: Observation, world_T_attached: Float[Tensor, "*b 4 4"]) -> Observation:
    """The observation with its free points fixed in the world where they are now (Alg 6, line 2)."""
    if len(observation) == 0:
        return observation
    riding = observation.of_class(Semantics.FREE) & observation.attached
    there = in_world(observation, world_T_attached).points
    points = there.where(riding[..., None], observation.points)
    return replace(observation, points=points, attached=observation.attached & ~riding)


def possible(observation: Observation, sdf: SDF, world_T_object: Float[Tensor, "*b N 4 4"]) -> Observation:
    """The observation without world-fixed free points that are not outside of every pose (Alg 6, line 3)."""
    if len(observation) == 0:
        return observation
    outside = (posed_distance(sdf, world_T_object, observation.points) > 0.0).all(-2)
    lost = observation.of_class(Semantics.FREE) & ~observation.attached & ~outside
    return compact(replace(observation, valid=observation.valid & ~lost))
