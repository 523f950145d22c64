"""Alignment of observations with a model at a known pose, and the small motion that improves it: calibration."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from sdf import se3, so3
from sdf.base import SDF
from sensors.observation import Observation
from sensors.semantics import Semantics

GROSS_M = 0.006
"""A surface point farther than this from the surface is a gross error."""

_ROUNDS = 30
_HUBER_M = 0.004  # residuals beyond it count linearly
_FEWEST = 20  # points that a correction is made from
_MOST = 1500  # of them
_SHIFTS_M = (-0.016, -0.008, 0.008, 0.016)  # starts along each axis
_PATCH = 1 / 3  # of the object's diagonal: points within less are one patch, which fits in many places
_WEAK = 0.03  # of the largest singular value: a direction that the points say less about is left alone


@dataclass(frozen=True)
class Alignment:
    """Observations against a model.

    Attributes:
        surface: signed distances of the surface points (n), metres, positive outside.
        free: the same of the free points (m).
        correction: (4, 4), world motion that lays the surface points best on the model; None where they cannot tell.
        corrected: signed distances of the surface points after it (n).
        untold: why they cannot.
    """

    surface: Float[Tensor, "n"]
    free: Float[Tensor, "m"]
    correction: Float[Tensor, "4 4"] | None
    corrected: Float[Tensor, "n"]
    untold: str = ""

    def text(self) -> str:
        """A few lines for people."""
        lines = []
        if len(self.surface):
            lines.append(f"surface  {len(self.surface)} points: {_spread(self.surface)}")
        else:
            lines.append("surface  no points")
        inside = self.free[self.free < 0]
        deepest = f", the deepest {-1e3 * float(inside.min()):.1f} mm" if len(inside) else ""
        lines.append(f"free     {len(self.free)} points: {len(inside)} of them inside the object{deepest}")
        if self.correction is not None:
            x, y, z = (1e3 * self.correction[:3, 3]).tolist()
            turn = torch.rad2deg(so3.log(self.correction[:3, :3])).tolist()
            about = ", ".join(f"{angle:.2f}" for angle in turn)
            lines.append(
                f"nearest  if all were moved by ({x:.1f}, {y:.1f}, {z:.1f}) mm and turned by ({about}) degrees "
                f"about the object's origin: {_spread(self.corrected)}"
            )
        elif len(self.surface):
            lines.append(f"nearest  {self.untold}: this says nothing about how all would have to be moved")
        return "\n".join(lines)


def align(points: Observation, world_T_object: Float[Tensor, "4 4"], sdf: SDF) -> Alignment:
    """Lay observations over a model.

    Args:
        points: in the world frame.
        world_T_object: (4, 4), where the object is.
        sdf: of the object; its distances should be exact.
    """
    pose = world_T_object.double()
    surface = points.points[points.of_class(Semantics.SURFACE)].double()
    free = points.points[points.of_class(Semantics.FREE)].double()
    with torch.no_grad():
        signed = sdf.distance(se3.apply(se3.inverse(pose), surface))
        away = sdf.distance(se3.apply(se3.inverse(pose), free))
    across = float((surface.amax(0) - surface.amin(0)).norm()) if len(surface) else 0.0
    untold = ""
    if len(surface) < _FEWEST:
        untold = f"fewer than {_FEWEST} points"
    elif across < _PATCH * float((sdf.bounds[1] - sdf.bounds[0]).norm()):
        untold = f"one patch, {1e3 * across:.0f} mm across"
    if untold:
        return Alignment(signed, away, None, signed, untold)
    moved = _nearest(surface, pose, sdf)
    with torch.no_grad():
        corrected = sdf.distance(se3.apply(se3.inverse(pose) @ moved, surface))
    # about the object's origin, where a turn does not look like a shift
    at = se3.make(torch.eye(3, dtype=torch.float64), pose[:3, 3])
    return Alignment(signed, away, se3.inverse(at) @ moved @ at, corrected)


def _nearest(surface: Float[Tensor, "n 3"], pose: Float[Tensor, "4 4"], sdf: SDF) -> Float[Tensor, "4 4"]:
    """World motion of the points that brings them to the surface.

    Several shifts are starts: points that are off by more than a wall is thick lie near its wrong side.
    """
    some = surface[:: max(1, len(surface) // _MOST)]
    best, least = se3.identity(dtype=torch.float64), math.inf
    for shift in [(0.0, 0.0, 0.0), *(_along(axis, size) for axis in range(3) for size in _SHIFTS_M)]:
        start = se3.make(torch.eye(3, dtype=torch.float64), torch.tensor(shift, dtype=torch.float64))
        motion = _descended(some, start, pose, sdf)
        with torch.no_grad():
            off = sdf.distance(se3.apply(se3.inverse(pose) @ motion, some)).abs()
        cost = float(torch.where(off < _HUBER_M, 0.5 * off**2, _HUBER_M * (off - 0.5 * _HUBER_M)).mean())
        # what is a little better but far away is chance
        if cost < 0.9 * least:
            best, least = motion, cost
    return best


def _along(axis: int, size: float) -> tuple[float, float, float]:
    return (size * (axis == 0), size * (axis == 1), size * (axis == 2))


def _descended(
    surface: Float[Tensor, "n 3"], motion: Float[Tensor, "4 4"], pose: Float[Tensor, "4 4"], sdf: SDF
) -> Float[Tensor, "4 4"]:
    """Gauss-Newton on distances, robust to gross errors.

    What the points do not determine (a turn about an axis of symmetry, a shift along a plane) is left as it is.
    """
    center = surface.mean(0)
    reach = float((surface - center).norm(dim=-1).mean())
    back = se3.inverse(pose)
    for _ in range(_ROUNDS):
        here = se3.apply(motion, surface)
        local = se3.apply(back, here).requires_grad_(True)
        distance = sdf.distance(local)
        (slope,) = torch.autograd.grad(distance.sum(), local)
        normal = slope @ pose[:3, :3].mT
        table = torch.cat((normal, torch.linalg.cross((here - center) / reach, normal)), -1)
        left = distance.detach()
        weight = (_HUBER_M / left.abs().clamp_min(1e-12)).clamp_max(1.0).sqrt()[:, None]
        u, s, v = torch.linalg.svd(table * weight, full_matrices=False)
        inverse = torch.where(s > _WEAK * s[0], 1.0 / s.clamp_min(1e-12), torch.zeros_like(s))
        step = -v.mT @ (inverse * (u.mT @ (left * weight[:, 0])))
        turn = so3.exp(step[3:] / reach)
        motion = se3.make(turn, center - turn @ center + step[:3]) @ motion
        if float(step.norm()) < 1e-7:
            break
    return motion


def _spread(signed: Float[Tensor, "n"]) -> str:
    size = 1e3 * signed.abs()
    gross = 100.0 * float((signed.abs() > GROSS_M).double().mean())
    most = float(size.quantile(0.95)) if len(size) < 1_000_000 else math.nan
    return (
        f"{1e3 * float(signed.mean()):+.1f} mm on average, half within {float(size.median()):.1f} mm, 95 % within "
        f"{most:.1f} mm, {gross:.1f} % beyond {1e3 * GROSS_M:.0f} mm"
    )
