"""Settings of what a real robot lacks: errors of its view, its pads and its tool's pose, and of the object's model."""

from dataclasses import dataclass

from rumi.errors import UsageError
from sdf.bounds import Checked, CountOr0, NotNegative, Positive, ShareBelow1


@dataclass(frozen=True)
class ViewErrors(Checked, refusal=UsageError):
    """What is wrong with a camera's views beside noise and calibration, which `SensorSettings` have.

    Attributes:
        eye_m: by how much the camera stands off its usual place along each axis at most; that place is known.
        holes: share of the pixels without depth, drawn for each picture.
        mask_px: by how many pixels the object's mask spills over or is eroded at most, drawn for each picture; of
            sensors of kind "points" alone, since others tell the object by its colour.
    """

    eye_m: NotNegative = 0.0
    holes: ShareBelow1 = 0.0
    mask_px: CountOr0 = 0


@dataclass(frozen=True)
class PadErrors(Checked, refusal=UsageError):
    """Errors of pads that feel points; a reading is what one pad reports at one instant.

    Attributes:
        dead: share of the pads' points that never feel, in round patches.
        patch_m: radius of a patch.
        missed: share of the readings that lack what is felt.
        false: share of the readings with a touch that there is none of.
    """

    dead: ShareBelow1 = 0.0
    patch_m: Positive = 0.006
    missed: ShareBelow1 = 0.0
    false: ShareBelow1 = 0.0


@dataclass(frozen=True)
class BuildSpread(Checked, refusal=UsageError):
    """Spread of how an object differs from what is known of it, drawn by seed.

    Attributes:
        mass: share by which its mass is off at most, of what the task has or draws.
        friction: the same of the friction of everything.
        com_m: how far its centre of mass is off at most.
        scale: share by which it is larger or smaller than its model at most.
        worn_m: how much deeper than its model's its surface lies at most.
    """

    mass: ShareBelow1 = 0.0
    friction: ShareBelow1 = 0.0
    com_m: NotNegative = 0.0
    scale: ShareBelow1 = 0.0
    worn_m: NotNegative = 0.0
