"""Reading with contacts beside points: contact points with normals and covariance, and binary contact signals."""

from dataclasses import dataclass, field, fields, replace
from typing import Self

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sdf import se3
from sdf.check import check_finite, is_eager
from sdf.containers import Ragged, container
from sensors.force.force_torque import WrenchContact
from sensors.reading import RAGGED, Reading


@container()
@dataclass(frozen=True)
class WrenchTouch:
    """Touches that a wrench told, world frame.

    Attributes:
        points: (*b, M, 3), metres.
        normals: (*b, M, 3), of the object, outward, unit.
        point_sd: (*b, M), metres, of the point along the tool's surface, by the sensor's noise.
        normal_sd: (*b, M), radians.
        instant: (*b, M), of the reading.
    """

    points: Float[Tensor, "*b M 3"]
    normals: Float[Tensor, "*b M 3"]
    point_sd: Float[Tensor, "*b M"]
    normal_sd: Float[Tensor, "*b M"]
    instant: Int[Tensor, "*b M"]

    @classmethod
    def none(cls) -> "WrenchTouch":
        """No touch."""
        return cls(torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(0), torch.zeros(0), torch.zeros(0).long())

    @classmethod
    def of(
        cls, contact: WrenchContact, world_T_sensor: Float[Tensor, "K 4 4"], kept: Int[Tensor, "M"]
    ) -> "WrenchTouch":
        """Touches of K wrenches at as many instants, float32; the object's normals are the opposite of the tool's.

        Args:
            contact: of the wrenches, in the sensor's frame.
            world_T_sensor: (K, 4, 4), the sensor at each.
            kept: (M), those to take, which are of a single touch.
        """
        pose = world_T_sensor[kept]
        points = se3.apply(pose, contact.point_s[kept, None])[:, 0].float()
        normals = -se3.rotate(pose, contact.normal_s[kept, None])[:, 0].float()
        sd = (0.5 * contact.covariance[kept].diagonal(dim1=-2, dim2=-1).sum(-1)).sqrt().float()
        return cls(points, normals, sd, contact.normal_sd_rad[kept].float(), kept)

    def at(self, index: Int[Tensor, "m"]) -> Self:
        """Touches `index`."""
        return replace(self, **{part.name: getattr(self, part.name)[index] for part in fields(self)})


def surest(variance: Float[Tensor, "M"], most: int) -> Int[Tensor, "m"]:
    """Of touches one after the other, the surest in each of at most `most` equal parts; others are of the same places.

    Args:
        variance: (M), of each one's point.
        most: parts.
    """
    if len(variance) == 0:
        return torch.zeros(0, dtype=torch.long, device=variance.device)
    parts = torch.arange(len(variance), device=variance.device).tensor_split(min(most, len(variance)))
    return torch.stack([part[variance[part].argmin()] for part in parts])


@container(RAGGED | {"signals": Ragged(-1)}, data=("stamp",))
@dataclass(frozen=True)
class ContactReading(Reading):
    """A reading with what is not told by points.

    Attributes:
        wrench: touches by the wrist's sensor.
        signals: (*b, K), whether the joints felt a contact at each instant; None where nobody asked them.
    """

    wrench: WrenchTouch = field(default_factory=WrenchTouch.none)
    signals: Bool[Tensor, "*b K"] | None = None

    def __post_init__(self) -> None:
        """Refuse what no sensor can mean."""
        super().__post_init__()
        touch, instants = self.wrench, self.tool_pose.shape[-3]
        for name in ("points", "normals", "point_sd", "normal_sd"):
            check_finite(f"wrench.{name}", getattr(touch, name))
        wrong = (touch.instant < 0) | (touch.instant >= instants)
        if is_eager() and bool(wrong.any()):
            raise ValueError(
                f"Expected wrench.instant to be 0 to {instants - 1}, the instants of tool_pose, "
                f"got {int(touch.instant[wrong][0])}"
            )

    @classmethod
    def of(cls, reading: Reading) -> "ContactReading":
        """The same with nothing else; the first view's has no more than points."""
        if isinstance(reading, cls):
            return reading
        return cls(**{part.name: getattr(reading, part.name) for part in fields(Reading)})
