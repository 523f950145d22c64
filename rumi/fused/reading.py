"""What an action brings of all sensors: points, touches with their covariance, and contact signals."""

from dataclasses import dataclass, field, fields

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sensors.reading import Reading


@dataclass(frozen=True)
class WrenchTouch:
    """Touches that a wrench told, world frame.

    Attributes:
        points: (M, 3), metres.
        normals: (M, 3), of the object, outward, unit.
        point_sd: (M), metres, of the point along the tool's surface, by the sensor's noise.
        normal_sd: (M), radians.
        instant: (M), of the reading.
    """

    points: Float[Tensor, "M 3"]
    normals: Float[Tensor, "M 3"]
    point_sd: Float[Tensor, "M"]
    normal_sd: Float[Tensor, "M"]
    instant: Int[Tensor, "M"]

    @classmethod
    def none(cls) -> "WrenchTouch":
        """No touch."""
        return cls(torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(0), torch.zeros(0), torch.zeros(0).long())


@dataclass(frozen=True)
class FusedReading(Reading):
    """A reading with what is not told by points.

    Attributes:
        wrench: touches by the wrist's sensor.
        signals: (K), whether the joints felt a contact at each instant; None where nobody asked them.
    """

    wrench: WrenchTouch = field(default_factory=WrenchTouch.none)
    signals: Bool[Tensor, "K"] | None = None

    @classmethod
    def of(cls, reading: Reading) -> "FusedReading":
        """The same with nothing else; the first view's has no more than points."""
        if isinstance(reading, cls):
            return reading
        return cls(**{part.name: getattr(reading, part.name) for part in fields(Reading)})
