"""Where to grasp, and how likely the box is lifted: the share of the belief at which the grasp succeeds."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.dynamics.sliding import rotated
from rumi.resampling import systematic
from sdf.so3 import wrap

_WITNESSES, _FINAL = 100, 8  # particles by which grasps are told apart at first, and grasps that are judged by all
_CROWD = 0.5  # of the table's ends: poses this near to a candidate make up its local mean


@dataclass(frozen=True, eq=False)
class GraspTable:
    """Chance that a box is lifted, by where it stands relative to where it is taken to stand; linear between nodes.

    A box with two mirror planes and fingers that are alike: aside and along are told by their amounts, the yaw by its
    sign relative to theirs.

    Attributes:
        odds: (A, B, C), at evenly spaced offsets aside (0..ends[0]), along (0..ends[1]) and yaw (-ends[2]..ends[2]).
        ends: greatest offset aside (along the box's x) and along (its y), metres, and yaw, radians; beyond is failure.
    """

    odds: Float[Tensor, "A B C"]
    ends: tuple[float, float, float]

    def __call__(self, grasp: Float[Tensor, "*#b 3"], box: Float[Tensor, "*#b 3"]) -> Float[Tensor, "*b"]:
        """Chance of lifting boxes at poses by grasps that take them to stand elsewhere."""
        apart, yaw = relative(grasp, box)
        aside, along = apart.unbind(-1)
        sign = torch.where((aside < 0) ^ (along < 0), -1.0, 1.0).to(yaw)
        place = torch.stack((aside.abs(), along.abs(), sign * yaw), -1)
        return self._linear(place)

    def _linear(self, place: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
        odds = self.odds.to(place)
        last = place.new_tensor([float(n - 1) for n in odds.shape])
        ends = place.new_tensor(self.ends)
        low = torch.stack((torch.zeros_like(ends[0]), torch.zeros_like(ends[1]), -ends[2]))
        at = (place - low) / (ends - low) * last
        within = ((at >= 0) & (at <= last)).all(-1)
        at = torch.minimum(at.clamp_min(0.0), last)
        corner = torch.minimum(at.floor(), last - 1.0)
        part, index = at - corner, corner.long()
        found = torch.zeros_like(at[..., 0])
        for i in (0, 1):
            for j in (0, 1):
                for k in (0, 1):
                    share = torch.ones_like(found)
                    for axis, step in enumerate((i, j, k)):
                        share = share * (part[..., axis] if step else 1.0 - part[..., axis])
                    a, b, c = (index + index.new_tensor([i, j, k])).unbind(-1)
                    found = found + share * odds[a, b, c]
        return torch.where(within, found, 0.0)


def relative(
    grasp: Float[Tensor, "*#b 3"], box: Float[Tensor, "*#b 3"]
) -> tuple[Float[Tensor, "*b 2"], Float[Tensor, "*b"]]:
    """Offset and yaw of a box in the frame in which it is taken to stand; the yaw to the nearest half turn."""
    apart = rotated(box[..., :2] - grasp[..., :2], -grasp[..., 2])
    yaw = wrap(box[..., 2] - grasp[..., 2], math.pi)
    return apart, yaw


class Grasp(NamedTuple):
    """Where to grasp.

    Attributes:
        pose: (3,), where the box is taken to stand.
        probability: believed, of lifting it.
    """

    pose: Float[Tensor, "3"]
    probability: float


def best_grasp(
    poses: Float[Tensor, "N 3"], log_weights: Float[Tensor, "N"], table: GraspTable, *, candidates: int = 60
) -> Grasp:
    """The grasp that lifts the box at the greatest share of the belief, out of likely poses and means about them.

    Args:
        poses: of the particles.
        log_weights: of the particles.
        table: of success.
        candidates: particles that are tried, the likeliest in even shares of the belief.
    """
    weights = log_weights.softmax(-1)
    few = poses[systematic(log_weights, 0.5, _WITNESSES, raw=True)]
    even = torch.full_like(few[:, 0], 1.0 / len(few))
    tried = poses[systematic(log_weights, 0.5, candidates, raw=True)]
    for _ in range(2):
        tried = torch.cat((tried, _local_means(tried[-candidates:], few, even, table)))
    # most are told apart by few particles; all are asked about the best
    tried = tried[(table(tried[:, None], few) @ even).topk(min(_FINAL, len(tried))).indices]
    chance = table(tried[:, None], poses) @ weights
    best = int(chance.argmax())
    return Grasp(tried[best], float(chance[best]))


def _local_means(
    tried: Float[Tensor, "C 3"], poses: Float[Tensor, "N 3"], weights: Float[Tensor, "N"], table: GraspTable
) -> Float[Tensor, "C 3"]:
    """Mean of the poses about each candidate, those half a turn off turned back."""
    apart, yaw = relative(tried[:, None], poses)
    place = torch.cat((apart, yaw[..., None]), -1) / poses.new_tensor(table.ends)
    share = weights * torch.exp(-0.5 * (place / _CROWD).square().sum(-1))
    share = share / share.sum(-1, keepdim=True).clamp_min(1e-30)
    shift = rotated((share[..., None] * apart).sum(1), tried[:, 2])
    return tried + torch.cat((shift, (share * yaw).sum(1)[:, None]), -1)


def clearance_table(half_width_m: float, opening_m: float, half_length_m: float, steep_rad: float = 0.5) -> GraspTable:
    """Success by geometry alone: the open fingers clear the box, and close on its sides within its length.

    For tests and for robots without a simulation of their own.

    Args:
        half_width_m: of the box, along its x.
        opening_m: between the fingers.
        half_length_m: of the box, along its y, within which fingers hold.
        steep_rad: yaw beyond which fingers slip.
    """
    ends = (0.5 * opening_m, half_length_m, 0.9)
    aside, along, yaw = torch.meshgrid(
        torch.linspace(0.0, ends[0], 21, dtype=torch.float64),
        torch.linspace(0.0, ends[1], 9, dtype=torch.float64),
        torch.linspace(-ends[2], ends[2], 37, dtype=torch.float64),
        indexing="ij",
    )
    clear = half_width_m / yaw.cos() + aside <= 0.5 * opening_m
    return GraspTable((clear & (yaw.abs() <= steep_rad) & (along <= ends[1])).to(torch.float64), ends)
