"""Fit of a reading to the particle that explains it best: distances that it leaves, heights at which it is felt."""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rumi.belief.particles import PoseBelief
from sdf import se3
from sdf.base import SDF
from sdf.posed import posed_distance
from sensors.observation import Observation
from sensors.reading import Reading
from sensors.semantics import Semantics

_ON_M, _TOUCHES_M = 0.006, 0.001  # a felt point this near a pad is the pad's; a pad this near the object feels it
_BEST = 5  # particles of least discrepancy that are asked: one that explains a reading is enough
_AT_ONCE = 32


def unexplained(belief: PoseBelief, added: Observation, sdf: SDF, enough_m: float = 0.0) -> tuple[float, float]:
    """Distances that the best particles leave between what is believed and what a reading added, metres.

    Args:
        belief: after the reading.
        added: its new points, in the frame that rides with the object.
        sdf: of the object.
        enough_m: a particle that leaves no more than this explains the reading: no further one is asked.

    Returns:
        of the particle that explains most, among those that were asked: how far the middle one of the surface points is
        from its surface, and how deep a free point is inside; 0 without such points.
    """
    cost = belief.discrepancy
    rides = added.valid & added.attached
    surface, free = (added.points[rides & added.of_class(kind)] for kind in (Semantics.SURFACE, Semantics.FREE))
    # trajectories count by their likelihoods, and their costs are all 0: none is known to be best, so all may be asked
    even = bool((cost == cost[0]).all())
    best = _spread(len(cost)) if even else cost.topk(min(_BEST, len(cost)), largest=False).indices
    least = (math.inf, math.inf)
    with torch.no_grad():
        for some in best.split(_AT_ONCE):
            poses = belief.attached_T_object[some]
            off, deep = poses.new_zeros(2, len(some))
            if len(surface):
                off = posed_distance(sdf, poses, surface).abs().median(-1).values
            if len(free):
                deep = (-posed_distance(sdf, poses, free)).amax(-1).clamp_min(0.0)
            row = int(torch.maximum(off, deep).argmin())
            least = min(least, (float(off[row]), float(deep[row])), key=max)
            if max(least) <= enough_m:
                break
    return least


def _spread(count: int) -> Int[Tensor, "count"]:
    """All rows, the first `_AT_ONCE` of them evenly spread, and so on: populations follow one another."""
    turns = max(1, math.ceil(count / _AT_ONCE))
    return torch.cat([torch.arange(turn, count, turns) for turn in range(turns)])


def felt_heights(
    reading: Reading, world_T_object: Float[Tensor, "N 4 4"], pads: Float[Tensor, "P 3"], sdf: SDF
) -> tuple[float, float, float, float] | None:
    """Heights at which the pads feel the object, and at which the particle that explains them best has them feel it.

    An object that lies where it is believed to stand is felt low on the pads alone, one that was lifted high on them.

    Args:
        reading: of an action.
        world_T_object: of the particles, at its last instant.
        pads: points of the pads' surface, tool frame.
        sdf: of the object.

    Returns:
        lowest and highest point felt at the last instant, and lowest and highest point of the pads that touches the
        object there by a particle; metres; None where nothing was felt, or no particle has the pads touch it.
    """
    last = (reading.instant == len(reading.in_contact) - 1) & reading.observation.of_class(Semantics.SURFACE)
    places = se3.apply(reading.tool_pose[-1].to(pads), pads).to(world_T_object)
    felt = reading.observation.points[last].to(places)
    felt = felt[torch.cdist(felt, places).amin(-1) < _ON_M] if len(felt) else felt  # a camera sees others
    if not bool(reading.in_contact[-1]) or not len(felt):
        return None
    with torch.no_grad():
        touches = posed_distance(sdf, world_T_object, places) < _TOUCHES_M
    some = touches.any(-1)
    if not bool(some.any()):
        return None
    heights, touches = places[:, 2], touches[some]
    low = torch.where(touches, heights, math.inf).amin(-1)
    high = torch.where(touches, heights, -math.inf).amax(-1)
    bottom, top = float(felt[:, 2].min()), float(felt[:, 2].max())
    off = torch.maximum((bottom - low).abs(), (top - high).abs())
    best = int(off.argmin())
    return bottom, top, float(low[best]), float(high[best])
