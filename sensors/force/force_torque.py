"""Contact point and normal on a tool of known shape by a wrench of a force-torque sensor, with covariance.

A wrench is (fx, fy, fz, mx, my, mz), N and N m: what the world does to the tool, about the origin of the sensor's
frame, in that frame. A driver that reports the reaction: negate it. One point is assumed to be touched, and to be
pushed, not pulled.
"""

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from sdf import backend, compiled, so3
from sdf.bounds import Checked, Count, NotNegative, Positive
from sdf.check import check_finite, check_shape
from sensors.force.tool_surface import ToolSurface


class WrenchStatus(IntEnum):
    """Classification of a wrench; the last three are of no single touch of the tool."""

    NONE = 0
    """The force is below the threshold."""
    CONTACT = 1
    TWIST = 2
    """There is a moment about the line of force: more than one contact, or a load that was not taken off."""
    MISS = 3
    """The line of force passes the tool by: something else was touched, or the frame or the shape is wrong."""
    FRICTION = 4
    """The force leans further from the normal than friction allows."""


@dataclass(frozen=True)
class WrenchNoise(Checked):
    """White noise of a sensor's readings.

    Attributes:
        force_n: standard deviation along each axis.
        moment_nm: about each axis.
        tared_over: readings that the bias is a mean of; its error is added. None where the bias is exact.
    """

    force_n: NotNegative = 0.1
    moment_nm: NotNegative = 0.005
    tared_over: Count | None = None

    def covariance(self) -> Float[Tensor, "6 6"]:
        """Of one reading whose bias was taken off, float64."""
        factor = 1.0 if self.tared_over is None else 1.0 + 1.0 / self.tared_over
        variances = [self.force_n**2] * 3 + [self.moment_nm**2] * 3
        return factor * torch.diag(torch.tensor(variances, dtype=torch.float64))


@dataclass(frozen=True)
class WrenchSettings(Checked):
    """Settings of contact detection by a wrench.

    Attributes:
        least_force_n: a force below it is none.
        friction: largest coefficient of friction between tool and world (Coulomb): how far a force may lean.
        twist_m: moment about the line of force that a soft contact patch may carry, metres times the force.
        sigmas: standard deviations of the noise by which a wrench may be beyond what one touch can do.
    """

    least_force_n: Positive = 1.0
    friction: NotNegative = 0.6
    twist_m: NotNegative = 0.0
    sigmas: Positive = 3.0


class WrenchContact(NamedTuple):
    """Contact of a tool by a wrench, in the sensor's frame; zeros where the force is below the threshold.

    Attributes:
        point_s: (*b, 3), on the tool, metres. Of an impossible wrench the best guess.
        normal_s: (*b, 3), unit, outward from the tool; the touched object's own normal is the opposite.
        covariance: (*b, 3, 3), of the point along the tool's surface, m^2: to first order, of the sensor's noise alone.
        normal_sd_rad: (*b), standard deviation of the normal about each axis along the surface.
        status: (*b), `WrenchStatus`.
    """

    point_s: Float[Tensor, "*b 3"]
    normal_s: Float[Tensor, "*b 3"]
    covariance: Float[Tensor, "*b 3 3"]
    normal_sd_rad: Float[Tensor, "*b"]
    status: Int[Tensor, "*b"]


def wrench_contact(
    wrench: Float[Tensor, "*b 6"],
    tool: ToolSurface,
    covariance: Float[Tensor, "6 6"],
    settings: WrenchSettings | None = None,
) -> WrenchContact:
    """Contact point and normal of a single point contact by its wrench (bias and weight taken off), sensor's frame.

    A force f at a point c has the moment c x f, so that c is on the line of force (f x m) / |f|^2 + t f; a push enters
    the tool where the line first meets it (Bicchi, Salisbury and Brock 1993). Friction need not be known for that: the
    line goes through the point whichever way the force leans. It is for the check alone, and bounds how aslant a touch
    can be. Autograd reaches the wrench through point and normal, the face of a polyhedron held fixed.

    Args:
        wrench: (*b, 6), force then moment about the sensor's origin, N and N m.
        tool: convex, in the sensor's frame.
        covariance: (6, 6), of the wrench's noise (`WrenchNoise.covariance`).
        settings: when it counts as a touch.

    Raises:
        ValueError: a wrench that is not finite, or of whole numbers.
    """
    # one wrench at a time comes at a kilohertz: what takes long is asked only where something is wrong
    if wrench.shape[-1:] != (6,) or covariance.shape != (6, 6):
        check_shape("wrench", wrench, "(*b, 6)", last=(6,))
        check_shape("covariance", covariance, "(6, 6)", last=(6, 6))
    if not wrench.is_floating_point():
        raise ValueError(
            f"Expected wrench to be floating, got {wrench.dtype}: a point in whole metres is none; use .float()"
        )
    if not math.isfinite(float(wrench.detach().sum())):
        check_finite("wrench", wrench)
    version = backend.dispatch("wrench_contact", wrench)
    found: WrenchContact = version(wrench, tool, covariance, settings or WrenchSettings())
    return found


@backend.register("wrench_contact")
def _plain(wrench: Tensor, tool: ToolSurface, covariance: Tensor, settings: WrenchSettings) -> WrenchContact:
    force, moment = wrench[..., :3], wrench[..., 3:]
    square = force.square().sum(-1)
    felt = square >= settings.least_force_n**2
    # what is below the threshold is worked out for a force that is none, so that nothing is divided by 0
    up = torch.tensor([0.0, 0.0, 1.0]).to(wrench)
    force = torch.where(felt[..., None], force, up)
    moment = torch.where(felt[..., None], moment, 0.0)
    size = force.norm(dim=-1)
    direction = force / size[..., None]
    twist = (moment * direction).sum(-1)
    foot = torch.linalg.cross(force, moment) / size.square()[..., None]
    struck = tool.strike(foot, direction)

    noise = covariance.to(wrench)
    basis = _basis(direction)
    motion = _line_motion(force, direction, size, twist, struck.point)
    beside = basis @ motion
    spread = beside @ noise @ beside.mT
    roots = _roots(spread) @ basis
    # a touch within the friction cone leans no further than that
    least = math.cos(math.atan(settings.friction))
    slant = (struck.normal * direction).sum(-1).clamp(max=-least)
    eye = torch.eye(3, dtype=wrench.dtype, device=wrench.device)
    along = eye - direction[..., :, None] * struck.normal[..., None, :] / slant[..., None, None]
    moved = along @ basis.mT
    point_covariance = moved @ spread @ moved.mT
    normal_sd = tool.normal_sd(struck, direction, roots, least)

    allowed = settings.sigmas
    turn = torch.cat((_across(moment, direction) / size[..., None], direction), -1)
    twist_sd = ((turn @ noise) * turn).sum(-1).clamp_min(0.0).sqrt()
    aim_sd = (0.5 * (noise[:3, :3].diagonal().sum() - ((direction @ noise[:3, :3]) * direction).sum(-1))).clamp_min(0.0)
    lean = torch.acos((-(struck.normal * direction).sum(-1)).clamp(-1.0, 1.0))
    lean_sd = (aim_sd / size.square() + normal_sd.square()).sqrt()
    gap_sd = spread.diagonal(dim1=-2, dim2=-1).sum(-1).sqrt()
    status = torch.full(felt.shape, int(WrenchStatus.CONTACT), dtype=torch.long, device=wrench.device)
    for wrong, name in (
        (lean > math.atan(settings.friction) + allowed * lean_sd, WrenchStatus.FRICTION),
        (struck.gap > allowed * gap_sd, WrenchStatus.MISS),
        (twist.abs() > settings.twist_m * size + allowed * twist_sd, WrenchStatus.TWIST),
        (~felt, WrenchStatus.NONE),
    ):
        status = torch.where(wrong, int(name), status)
    return WrenchContact(
        torch.where(felt[..., None], struck.point, 0.0),
        torch.where(felt[..., None], struck.normal, 0.0),
        torch.where(felt[..., None, None], point_covariance, 0.0),
        torch.where(felt, normal_sd, 0.0),
        status,
    )


@backend.register("wrench_contact", "numba", compiled.supports)
def _contact_numba(wrench: Tensor, tool: ToolSurface, covariance: Tensor, settings: WrenchSettings) -> WrenchContact:
    from sensors.force.force_torque_numba import contacts

    batch = wrench.shape[:-1]
    flat = wrench.detach().double().reshape(-1, 6).contiguous().numpy()
    numbers, status = np.empty((len(flat), 16)), np.empty(len(flat), np.int64)
    noise = covariance.detach().double().cpu().contiguous().numpy()
    limits = settings.least_force_n, settings.friction, settings.twist_m, settings.sigmas
    contacts(flat, tool.sphere.numpy(), tool.planes.numpy(), noise, *map(float, limits), numbers, status)
    found = torch.from_numpy(numbers).to(wrench.dtype).view(*batch, 16)
    point, normal, spread, normal_sd = found.split((3, 3, 9, 1), -1)
    kind = torch.from_numpy(status).view(batch)
    return WrenchContact(point, normal, spread.unflatten(-1, (3, 3)), normal_sd[..., 0], kind)


def _line_motion(force: Tensor, direction: Tensor, size: Tensor, twist: Tensor, point: Tensor) -> Tensor:
    """How the line of force moves beside a point on it, (*b, 3, 6), with the wrench: the derivative of f x m / |f|^2.

    Its part along the force is of no use: the line slides along itself.
    """
    force_hat, point_hat, hat = so3.hat(force), so3.hat(point), so3.hat(direction)
    square = size.square()[..., None, None]
    by_force = (-force_hat @ point_hat - twist[..., None, None] * hat) / square
    return torch.cat((by_force, force_hat / square), -1)


def _across(vector: Tensor, direction: Tensor) -> Tensor:
    return vector - (vector * direction).sum(-1, keepdim=True) * direction


def _basis(direction: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 2 3"]:
    """Two unit vectors beside a direction: the first beside the axis that it has least of."""
    least = direction.abs().argmin(-1)
    axis = torch.nn.functional.one_hot(least, 3).to(direction)
    first = torch.nn.functional.normalize(torch.linalg.cross(direction, axis), dim=-1)
    return torch.stack((first, torch.linalg.cross(direction, first)), -2)


def _roots(spread: Float[Tensor, "*b 2 2"]) -> Float[Tensor, "*b 2 2"]:
    """Rows whose outer products sum to the covariance (Cholesky, also of one that is singular)."""
    tiny = torch.finfo(spread.dtype).tiny
    a = spread[..., 0, 0].clamp_min(0.0).sqrt()
    b = spread[..., 1, 0] / a.clamp_min(tiny)
    c = (spread[..., 1, 1] - b.square()).clamp_min(0.0).sqrt()
    return torch.stack((torch.stack((a, b), -1), torch.stack((torch.zeros_like(c), c), -1)), -2)
