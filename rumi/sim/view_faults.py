"""Errors of a simulated camera's view: pixels without depth, a wrong mask, a wrong calibration, another place."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import max_pool2d

from rumi.seeding import split
from rumi.sim.error_settings import ViewErrors
from rumi.sim.sensor_settings import SensorSettings
from sdf import se3


def grown(mask: Bool[Tensor, "H W"], pixels: int) -> Bool[Tensor, "H W"]:
    """A mask dilated by a square of that many pixels to each side; eroded where the number is negative.

    What is beyond the image does not count.
    """
    if pixels == 0:
        return mask
    turned = mask if pixels > 0 else ~mask
    size = 2 * abs(pixels) + 1
    found = max_pool2d(turned[None, None].float(), size, stride=1, padding=abs(pixels))[0, 0] > 0
    return found if pixels > 0 else ~found


def miscalibration(sensors: SensorSettings, generator: torch.Generator) -> Float[Tensor, "4 4"]:
    """taken_T_true of a sensor's frame: off by the calibration's errors, along and about random axes."""
    place, axis = torch.randn(2, 3, generator=generator)
    place, axis = (torch.nn.functional.normalize(part, dim=0) for part in (place, axis))
    return se3.exp(torch.cat((sensors.calibration_m * place, sensors.calibration_rad * axis)))


def taken_pose(
    pose: Float[Tensor, "4 4"], off: Float[Tensor, "4 4"], sensors: SensorSettings, target: tuple[float, float, float]
) -> Float[Tensor, "4 4"]:
    """Where a camera at `pose` is taken to be: turned about itself, or about the target that it was calibrated by."""
    off = off.double()
    if sensors.turned_about == "sensor":
        return pose @ off
    about = se3.make(torch.eye(3, dtype=torch.float64), torch.tensor(target).double())
    return about @ off @ se3.inverse(about) @ pose


@dataclass(frozen=True)
class ViewFaults:
    """How the views of one run are wrong.

    Attributes:
        errors: of the views.
        sensors: of which the depth's noise and the calibration count.
        eye_m: (3,), from the camera's usual place to where it stands.
        off: (4, 4), taken_T_true of the calibration.
        generator: of what each view draws.
    """

    errors: ViewErrors
    sensors: SensorSettings
    eye_m: Float[Tensor, "3"]
    off: Float[Tensor, "4 4"]
    generator: torch.Generator

    @classmethod
    def drawn(cls, errors: ViewErrors, sensors: SensorSettings, seed: int) -> "ViewFaults":
        """Those of a seed."""
        eye = torch.rand(3, generator=split(seed, "camera's place"), dtype=torch.float64)
        off = miscalibration(sensors, split(seed, "camera's calibration"))
        return cls(errors, sensors, errors.eye_m * (2.0 * eye - 1.0), off, split(seed, "camera's pixels"))

    def noisy(self, depth: Float[Tensor, "H W"]) -> Float[Tensor, "H W"]:
        """Depth with noise and holes, 0 where the camera knows nothing."""
        if self.sensors.depth_noise_m > 0:
            noise = torch.randn(depth.shape, generator=self.generator, dtype=depth.dtype)
            depth = depth + self.sensors.depth_noise_m * noise
        return holed(depth, self.errors, self.generator)

    def masked(self, mask: Bool[Tensor, "H W"]) -> Bool[Tensor, "H W"]:
        """The mask as the robot has it: grown by a whole number of pixels up to `mask_px`, or shrunk, evenly drawn."""
        most = self.errors.mask_px
        if most == 0:
            return mask
        return grown(mask, int(torch.randint(-most, most + 1, (), generator=self.generator)))


def holed(depth: Float[Tensor, "H W"], errors: ViewErrors, generator: torch.Generator) -> Float[Tensor, "H W"]:
    """Depth that is 0 in a share of the pixels."""
    if errors.holes == 0:
        return depth
    hole = torch.rand(depth.shape, generator=generator) < errors.holes
    return torch.where(hole, torch.zeros_like(depth), depth)
