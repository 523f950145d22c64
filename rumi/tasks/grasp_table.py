"""Where to grasp, and how likely the object is lifted: the share of the belief at which the grasp succeeds."""

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rumi.dynamics.sliding import rotated
from rumi.resampling import systematic
from sdf.cache import keep_arrays, load_arrays
from sdf.so3 import wrap

_WITNESSES, _FINAL = 100, 8  # particles by which grasps are told apart at first, and grasps that are judged by all
_CROWD = 0.5  # of the table's ends: poses this near to a candidate make up its local mean
_CANDIDATES = 60  # particles that are tried, the likeliest in even shares of the belief
_STEEP_RAD = 0.5  # yaw beyond which fingers slip


_logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class GraspTable:
    """Chance that an object is lifted, by where it stands relative to where it is taken to stand; linear between nodes.

    Along an axis across which object and fingers are their own mirror image, an offset is told by its amount, and the
    yaw by its sign relative to the offset's. Beyond the ends is failure.

    Attributes:
        odds: (A, B, C), at evenly spaced offsets along x and y, 0..ends (-ends..ends where not mirrored), and yaw
            (-ends[2]..ends[2]).
        ends: greatest offsets, metres, and yaw, radians.
        mirrored: whether x and y are told by their amount; by default a box's.
        period: radians after which a turned object looks as before.
    """

    odds: Float[Tensor, "A B C"]
    ends: tuple[float, float, float]
    mirrored: tuple[bool, bool] = (True, True)
    period: float = math.pi

    def __call__(self, taken: Float[Tensor, "*#b 3"], true: Float[Tensor, "*#b 3"]) -> Float[Tensor, "*b"]:
        """Chance of lifting objects at (x, y, yaw) by grasps that take them to stand elsewhere."""
        apart, yaw = relative(taken, true, self.period)
        offsets = list(apart.unbind(-1))
        negative = torch.zeros_like(yaw, dtype=torch.bool)
        for i in (0, 1):
            if self.mirrored[i]:
                negative = negative ^ (offsets[i] < 0)
                offsets[i] = offsets[i].abs()
        return self._linear(torch.stack((*offsets, torch.where(negative, -1.0, 1.0).to(yaw) * yaw), -1))

    def _linear(self, place: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
        odds, ends = self.odds.to(place), place.new_tensor(self.ends)
        last = place.new_tensor([float(n - 1) for n in odds.shape])
        low = torch.where(torch.tensor((*self.mirrored, False), device=place.device), 0.0, -ends)
        at = (place - low) / (ends - low) * last
        within = ((at >= 0) & (at <= last)).all(-1)
        at = torch.minimum(at.clamp_min(0.0), last)
        corner = torch.minimum(at.floor(), last - 1.0)
        part, index = at - corner, corner.long()
        found = torch.zeros_like(at[..., 0])
        for step in torch.cartesian_prod(*[torch.arange(2, device=place.device)] * 3):
            share = torch.where(step.bool(), part, 1.0 - part).prod(-1)
            found = found + share * odds[tuple((index + step).unbind(-1))]
        return torch.where(within, found, 0.0)


def relative(
    taken: Float[Tensor, "*#b 3"], true: Float[Tensor, "*#b 3"], period: float = math.pi
) -> tuple[Float[Tensor, "*b 2"], Float[Tensor, "*b"]]:
    """Offset and yaw of an object in the frame in which it is taken to stand; the yaw to the nearest whole period."""
    apart = rotated(true[..., :2] - taken[..., :2], -taken[..., 2])
    return apart, wrap(true[..., 2] - taken[..., 2], period)


def simulated_table(
    like: GraspTable, lift: Callable[[Float[Tensor, "N 3"]], Tensor], path: Path | None = None
) -> GraspTable:
    """A table of grasps that are simulated once, at its nodes.

    Args:
        like: its shape, ends and symmetry.
        lift: whether an object at (x, y, yaw) is lifted by a grasp that takes it to stand at the origin.
        path: that keeps the odds; None simulates them each time.
    """
    counts = like.odds.shape
    kept = None if path is None else load_arrays(path, ("odds",))
    if kept is not None:
        found = kept["odds"]
        if found.shape == counts and found.dtype == np.float64 and bool(((found >= 0.0) & (found <= 1.0)).all()):
            return replace(like, odds=torch.from_numpy(found))
        _logger.warning("%s holds no odds of grasps: simulating them again", path)
    low = [0.0 if i < 2 and like.mirrored[i] else -like.ends[i] for i in range(3)]
    axes = [torch.linspace(low[i], like.ends[i], counts[i], dtype=torch.float64) for i in range(3)]
    odds = lift(torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)).to(torch.float64).view(counts)
    if path is not None:
        keep_arrays(path, {"odds": odds.numpy()})
    return replace(like, odds=odds)


class Grasp(NamedTuple):
    """Where to grasp.

    Attributes:
        pose: (3,), (x, y, yaw) at which the object is taken to stand.
        probability: believed, of lifting it.
    """

    pose: Float[Tensor, "3"]
    probability: float


def best_grasp(poses: Float[Tensor, "N 3"], log_weights: Float[Tensor, "N"], table: GraspTable) -> Grasp:
    """The grasp that lifts the box at the greatest share of the belief, out of likely poses and means about them.

    Args:
        poses: of the particles.
        log_weights: of the particles.
        table: of success.
    """
    weights = log_weights.softmax(-1)
    few = poses[systematic(log_weights, 0.5, _WITNESSES, raw=True)]
    even = torch.full_like(few[:, 0], 1.0 / len(few))
    tried = poses[systematic(log_weights, 0.5, _CANDIDATES, raw=True)]
    for _ in range(2):
        tried = torch.cat((tried, _local_means(tried[-_CANDIDATES:], few, even, table)))
    # most are told apart by few particles; all are asked about the best
    tried = tried[(table(tried[:, None], few) @ even).topk(min(_FINAL, len(tried))).indices]
    chance = table(tried[:, None], poses) @ weights
    best = int(chance.argmax())
    return Grasp(tried[best], float(chance[best]))


def _local_means(
    tried: Float[Tensor, "C 3"], poses: Float[Tensor, "N 3"], weights: Float[Tensor, "N"], table: GraspTable
) -> Float[Tensor, "C 3"]:
    """Mean of the poses about each candidate, those a whole period off turned back."""
    apart, yaw = relative(tried[:, None], poses, table.period)
    place = torch.cat((apart, yaw[..., None]), -1) / poses.new_tensor(table.ends)
    share = weights * torch.exp(-0.5 * (place / _CROWD).square().sum(-1))
    share = share / share.sum(-1, keepdim=True).clamp_min(1e-30)
    shift = rotated((share[..., None] * apart).sum(1), tried[:, 2])
    return tried + torch.cat((shift, (share * yaw).sum(1)[:, None]), -1)


def clearance_table(half_width_m: float, opening_m: float, half_length_m: float) -> GraspTable:
    """Success by geometry alone: the open fingers clear the box, and close on its sides within its length.

    For tests and for robots without a simulation of their own.

    Args:
        half_width_m: of the box, along its x.
        opening_m: between the fingers.
        half_length_m: of the box, along its y, within which fingers hold.
    """
    ends = (0.5 * opening_m, half_length_m, 0.9)
    aside, along, yaw = torch.meshgrid(
        torch.linspace(0.0, ends[0], 21, dtype=torch.float64),
        torch.linspace(0.0, ends[1], 9, dtype=torch.float64),
        torch.linspace(-ends[2], ends[2], 37, dtype=torch.float64),
        indexing="ij",
    )
    clear = half_width_m / yaw.cos() + aside <= 0.5 * opening_m
    return GraspTable((clear & (yaw.abs() <= _STEEP_RAD) & (along <= ends[1])).to(torch.float64), ends)
