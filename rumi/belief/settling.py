"""Poses drawn anew settle by all that is known, where their descent followed the points alone."""

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.belief.pose_filter import PoseFilter
from rumi.registration.descent import retract
from rumi.registration.register import thinned
from rumi.seeding import Generators, normal
from sdf import se3
from sensors.evidence import Evidence
from sensors.observation import Observation, concatenate
from sensors.semantics import Semantics

_FREE = 4000  # points that are no surface, by which poses settle
_STEPS = [(0.005 * 0.8**k, 0.1 * 0.8**k) for k in range(12)]
"""Metres and radians of the steps by which poses settle, one after the other."""


def settled(
    pose_filter: PoseFilter,
    attached_T_object: Float[Tensor, "N 4 4"],
    here: Observation,
    evidence: Evidence | None,
    *,
    generator: Generators,
) -> Float[Tensor, "N 4 4"]:
    """Poses after steps at random, as free as the filter's search, that are kept where all evidence together gains.

    Points leave poses free along some ways, where a touch's normal or a signal asks for a place to the millimetre.
    Where nothing was evidence beside points they stay as they are.

    Args:
        pose_filter: says what a pose costs.
        attached_T_object: (N, 4, 4), after their descent on points.
        here: points in the attached frame.
        evidence: what is no points, in the same frame.
        generator: of the steps.
    """
    if evidence is None:
        return attached_T_object
    surface = here.of_class(Semantics.SURFACE)
    here = concatenate([here[surface], thinned(here[here.valid & ~surface], _FREE)])
    poses, cost = attached_T_object, pose_filter.cost(attached_T_object, here, evidence)
    shifts, turns = (2, 1) if pose_filter.search == "SE(2)" else (3, 3)
    for shift_m, turn_rad in _STEPS:
        sigma = torch.tensor([shift_m] * shifts + [turn_rad] * turns).to(poses)
        noise = normal((*poses.shape[:-2], len(sigma)), generator=generator, dtype=poses.dtype, device=poses.device)
        tried = se3.renormalised(retract(poses, sigma * noise, pose_filter.search))
        there = pose_filter.cost(tried, here, evidence)
        better = there < cost
        poses = torch.where(better[..., None, None], tried, poses)
        cost = torch.where(better, there, cost)
    return poses
