"""Payload identification and compensation: a force-torque sensor's bias and the weight of its tool."""

from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import torch
from jaxtyping import Float
from torch import Tensor

from sdf.check import check_finite, check_shape

GRAVITY = 9.81
"""m/s^2, along -z of the world."""

# of the least singular value to the largest, below which a calibration does not tell its unknowns apart
_CONDITION = 1e-2


@dataclass(frozen=True)
class ToolLoad:
    """Bias and weight.

    Attributes:
        bias: (6,), of forces and moments, N and N m, in the sensor's frame.
        mass_kg: (), of all that hangs from the sensor.
        center_s: (3,), its centre of mass in the sensor's frame, metres.
    """

    bias: Float[Tensor, "6"]
    mass_kg: Float[Tensor, ""]
    center_s: Float[Tensor, "3"]

    def weight(
        self, world_R_sensor: Float[Tensor, "*b 3 3"], acceleration_w: Float[Tensor, "*b 3"] | None = None
    ) -> Float[Tensor, "*b 6"]:
        """Wrench of the weight at some orientations of the sensor.

        Args:
            world_R_sensor: (*b, 3, 3).
            acceleration_w: (*b, 3), of the centre of mass, m/s^2; None where it is at rest or slow. The moment that
                angular acceleration takes is left out: for it the tool's inertia would have to be known.
        """
        pull = world_R_sensor.new_tensor([0.0, 0.0, -GRAVITY]).expand(world_R_sensor.shape[:-1])
        if acceleration_w is not None:
            pull = pull - acceleration_w
        force = self.mass_kg.to(pull) * (world_R_sensor.mT @ pull[..., None])[..., 0]
        return torch.cat((force, torch.linalg.cross(self.center_s.to(force).expand_as(force), force)), -1)

    def contact_wrench(
        self,
        wrench: Float[Tensor, "*b 6"],
        world_R_sensor: Float[Tensor, "*b 3 3"],
        acceleration_w: Float[Tensor, "*b 3"] | None = None,
    ) -> Float[Tensor, "*b 6"]:
        """Of readings (*b, 6) what is left for contact; the other arguments are those of `weight`."""
        return wrench - self.bias.to(wrench) - self.weight(world_R_sensor.to(wrench), acceleration_w)

    def tared(self, wrench: Float[Tensor, "K 6"], world_R_sensor: Float[Tensor, "K 3 3"]) -> Self:
        """The same weight with the bias that readings without contact show: biases drift with warmth.

        Args:
            wrench: (K, 6), K >= 1 readings at rest.
            world_R_sensor: (K, 3, 3), the sensor then.
        """
        check_shape("wrench", wrench, "(K, 6)", last=(6,))
        check_finite("wrench", wrench)
        if len(wrench) == 0:
            raise ValueError("Expected at least one reading without contact, got none")
        return replace(self, bias=(wrench - self.weight(world_R_sensor.to(wrench))).mean(0))


class Calibration(NamedTuple):
    """A load that explains readings, and how well.

    Attributes:
        load: bias, mass and centre of mass.
        force_rms_n: of what it leaves unexplained.
        moment_rms_nm: the same of the moments.
    """

    load: ToolLoad
    force_rms_n: float
    moment_rms_nm: float


def calibrate_load(wrench: Float[Tensor, "K 6"], world_R_sensor: Float[Tensor, "K 3 3"]) -> Calibration:
    """Bias, mass and centre of mass from readings at rest without contact, by linear least squares.

    Force: bias + m g; moment: bias + (m c) x g, with gravity g in the sensor's frame: both linear in the unknowns.

    Args:
        wrench: (K, 6), of at least three orientations that turn gravity about two axes of the sensor.
        world_R_sensor: (K, 3, 3).

    Raises:
        ValueError: if the orientations are too much alike to tell bias and weight apart, or the mass is negative.
    """
    check_shape("wrench", wrench, "(K, 6)", last=(6,))
    check_shape("world_R_sensor", world_R_sensor, "(K, 3, 3)", last=(len(wrench), 3, 3))
    check_finite("wrench", wrench)
    check_finite("world_R_sensor", world_R_sensor)
    pull = -GRAVITY * world_R_sensor.double()[:, 2, :]  # R^T (0, 0, -g)
    count, eye = len(pull), torch.eye(3, dtype=torch.float64, device=pull.device)
    still = eye.expand(count, 3, 3)
    zero, (x, y, z) = torch.zeros_like(pull[:, 0]), pull.unbind(-1)
    # (m c) x g as a matrix on m c
    turned = torch.stack((zero, z, -y, -z, zero, x, y, -x, zero), -1).view(count, 3, 3)
    forces = _solved(torch.cat((still, pull[..., None]), -1), wrench[:, :3].double())
    moments = _solved(torch.cat((still, turned), -1), wrench[:, 3:].double())
    mass = forces[0][3]
    if not float(mass) > 0:
        raise ValueError(
            f"Expected the tool to have weight, got a mass of {float(mass):.4g} kg: readings of what the tool does to "
            "the world have to be negated, and world_R_sensor takes the sensor's directions to the world's"
        )
    load = ToolLoad(torch.cat((forces[0][:3], moments[0][:3])), mass, moments[0][3:] / mass)
    return Calibration(load, forces[1], moments[1])


def _solved(rows: Float[Tensor, "K 3 U"], given: Float[Tensor, "K 3"]) -> tuple[Float[Tensor, "U"], float]:
    """Least squares, and the root mean square of what is left."""
    matrix, values = rows.flatten(0, 1), given.flatten()
    scale = matrix.norm(dim=0).clamp_min(1e-12)
    left, singular, right = torch.linalg.svd(matrix / scale, full_matrices=False)
    if len(matrix) < matrix.shape[1] or float(singular[-1]) < _CONDITION * float(singular[0]):
        raise ValueError(
            f"Expected orientations that tell bias and weight apart, got {len(rows)} that are too much alike: turn the "
            "sensor about two of its axes that are not vertical, by 30 degrees or more"
        )
    found = (right.mT @ ((left.mT @ values) / singular)) / scale
    return found, float((matrix @ found - values).square().mean().sqrt())
