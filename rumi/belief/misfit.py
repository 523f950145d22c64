"""Whether a reading fits any pose that is believed: log-likelihood ratios of faults against the belief, a reading each.

What is felt or seen is summed up for each particle as how far the middle one of the reading's surface points is from
its surface, and how deep its free points go into it, so that many points that err together count as one reading. A
belief that has taken the reading in fits better than what was predicted: a test of its ratios (`ChangeTest`) is wrong
less often than it says, and finds less.
"""

import math
from dataclasses import dataclass
from typing import Annotated

import torch
from annotated_types import Interval
from jaxtyping import Float
from torch import Tensor

from rumi.belief.particles import PoseBelief
from sdf import se3
from sdf.base import SDF
from sdf.bounds import Checked, Positive, ShareBelow1
from sensors.observation import Observation
from sensors.semantics import Semantics

MISFITS = ("knocked", "absent", "none of these")
"""The object is elsewhere near by; it is gone; nothing known fits."""

_JUMPS = 256  # poses that a knock may have led to
_POINTS = 128  # of a reading that are looked up, evenly, of each kind


@dataclass(frozen=True)
class MisfitSettings(Checked):
    """Settings of the test, in every run.

    Attributes:
        alpha: chance that a faultless run, however long, is called lost; 0 never asks, nor doubts objects that may
            have tipped.
        fit_m: standard deviation of a reading's middle surface point from the surface, and of the depth of its free
            points, where the belief is right.
        broad_m: the same where it is not.
        outlier: chance that a reading is nothing of the belief's even so.
        knock_m: standard deviation of a knock, along each level axis.
        knock_rad: of the turn with it.
        recover: widen the belief and search again by what is sensed from then on.
    """

    alpha: ShareBelow1 = 0.02
    fit_m: Positive = 4e-3
    broad_m: Positive = 0.03
    outlier: Annotated[float, Interval(gt=0.0, lt=0.5)] = 0.001
    knock_m: Positive = 0.03
    knock_rad: Positive = 0.4
    recover: bool = True


def log_ratios(belief: PoseBelief, added: Observation, sdf: SDF, own: MisfitSettings) -> Float[Tensor, "K"]:
    """Log-likelihood ratio of each of `MISFITS` against the belief, nats.

    Args:
        belief: that is asked, before the reading or after.
        added: the reading's points, in the frame that rides with the object.
        sdf: of the object.
        own: settings.
    """
    rides = added.valid & added.attached
    surface, free = (_some(added.points[rides & added.of_class(kind)]) for kind in (Semantics.SURFACE, Semantics.FREE))
    poses, weights = belief.attached_T_object, belief.log_weights.double().log_softmax(-1)
    if not len(surface) and not len(free):
        return weights.new_zeros(len(MISFITS))
    off, deep = _off(poses, surface, sdf), _deep(poses, free, sdf)
    null = torch.logsumexp(weights + _fits(off, deep, own), -1)
    jumped = knocked(belief, own, _JUMPS)
    moved = _fits(_off(jumped, surface, sdf), _deep(jumped, free, sdf), own)
    knock = torch.logsumexp(moved, -1) - math.log(len(jumped))
    gone = null.new_zeros(()) if off is None else _half_normal(off.amin(), own.broad_m) + math.log(own.outlier)
    # felt from anywhere; and nothing felt where the object may be as often as not
    nothing = math.log(0.5) if deep is not None and bool((deep > own.fit_m).any()) else 0.0
    none = null.new_tensor(nothing) if off is None else nothing + _half_normal(off.amin(), own.broad_m)
    return torch.stack((knock, gone, none)) - null


def knocked(belief: PoseBelief, own: MisfitSettings, count: int) -> Float[Tensor, "count 4 4"]:
    """Poses, in the attached frame, to which a knock may have led: particles moved about upright axes, none drawn."""
    uniform = torch.quasirandom.SobolEngine(4, scramble=True, seed=1).draw(count, dtype=torch.float64)
    rows = torch.searchsorted(belief.log_weights.double().softmax(-1).cumsum(-1), uniform[:, 3].contiguous())
    normal = math.sqrt(2.0) * torch.erfinv((2.0 * uniform[:, :3] - 1.0).clamp(-1.0 + 1e-9, 1.0 - 1e-9))
    scale = normal.new_tensor((own.knock_m, own.knock_m, own.knock_rad))
    move = scale * normal
    world_T_object = belief.world_T_object[rows.clamp_max(belief.log_weights.shape[-1] - 1)]
    turn = se3.from_planar(torch.cat((torch.zeros_like(move[:, :2]), move[:, 2:]), -1)).to(world_T_object)
    moved = world_T_object.clone()
    moved[:, :3, :3] = turn[:, :3, :3] @ world_T_object[:, :3, :3]
    moved[:, :2, 3] += move[:, :2].to(world_T_object)
    return se3.inverse(belief.world_T_attached) @ moved


def _fits(
    off: Float[Tensor, "N"] | None, deep: Float[Tensor, "N"] | None, own: MisfitSettings
) -> Float[Tensor, "N"] | Float[Tensor, ""]:
    """Log-likelihood of a reading's summary under each particle: a density of `off`, a chance of `deep`."""
    total: Tensor = torch.zeros((), dtype=torch.float64)
    if off is not None:
        near, far = math.log1p(-own.outlier), math.log(own.outlier)
        total = total + torch.logaddexp(near + _half_normal(off, own.fit_m), far + _half_normal(off, own.broad_m))
    if deep is not None:
        total = total + (own.outlier + (1.0 - own.outlier) * (-0.5 * (deep / own.fit_m).square()).exp()).log()
    return total


def _half_normal(value: Float[Tensor, "*b"], deviation: float) -> Float[Tensor, "*b"]:
    return 0.5 * math.log(2.0 / math.pi) - math.log(deviation) - 0.5 * (value / deviation).square()


def _some(points: Float[Tensor, "M 3"]) -> Float[Tensor, "m 3"]:
    return points[:: max(1, math.ceil(len(points) / _POINTS))]


@torch.no_grad()
def _off(poses: Float[Tensor, "N 4 4"], points: Float[Tensor, "M 3"], sdf: SDF) -> Float[Tensor, "N"] | None:
    """Distance of the middle point from each particle's surface, metres; None without points."""
    if not len(points):
        return None
    return sdf.distance(se3.apply(se3.inverse(poses), points)).abs().median(-1).values.double()


@torch.no_grad()
def _deep(poses: Float[Tensor, "N 4 4"], points: Float[Tensor, "M 3"], sdf: SDF) -> Float[Tensor, "N"] | None:
    """Depth of the deepest point within each particle, metres; None without points."""
    if not len(points):
        return None
    return (-sdf.distance(se3.apply(se3.inverse(poses), points))).amax(-1).clamp_min(0.0).double()
