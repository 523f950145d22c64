"""What was felt so far, as log-likelihoods of poses: touches by a wrench, and contact signals of joints.

Both stand in the frame that rides with the object, as the points of the memory do: they stay true when it moves.
"""

import math
from dataclasses import dataclass, field, replace
from typing import Self

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.belief.particles import PoseBelief
from sdf import se3
from sdf.base import SDF
from sdf.posed import posed_query
from sensors.contact_reading import FeltReading
from sensors.evidence import KeptEvidence
from sensors.reading import Reading
from sensors.touch.contact_model import ContactModel, robot_distance

_EXTENT_M = 0.1  # within which an outlier may be anywhere


@dataclass(frozen=True)
class SignalSettings:
    """What the joints' signals count for.

    Attributes:
        true_positive: probability of a signal while the gripper touches.
        false_positive: probability of one while it is far.
        decay: with which the first falls off to the second with distance, 1/m.
        most: signals of contact that count of an action: the first, and others evenly after it.
        spacing_m: of the points on the gripper's surface.
    """

    true_positive: float = 0.9
    false_positive: float = 0.02
    decay: float = 150.0
    most: int = 2
    spacing_m: float = 0.008

    def __post_init__(self) -> None:
        """Refuse what cannot be."""
        if not 0 <= self.false_positive < self.true_positive <= 1:
            raise ValueError(
                "Expected true_positive above false_positive, both of 0 to 1, "
                f"got {self.true_positive} and {self.false_positive}"
            )
        if not 0 < self.decay < 1e6:
            raise ValueError(f"Expected decay above 0 (to 1e6 1/m), got {self.decay}")
        if self.most < 1:
            raise ValueError(f"Expected most of 1 or more, got {self.most}")
        if not 0.001 <= self.spacing_m <= 1:
            raise ValueError(f"Expected spacing_m of 0.001 to 1, got {self.spacing_m}")


@dataclass(frozen=True)
class TouchedSurface:
    """Touched points with normals, against a signed distance function: an `Evidence`.

    log L = sum over touches of log((1 - o) exp(-v^2 / (2 s^2) - a^2 / (2 n^2)) + o u), with the signed distance v of
    the point, the angle a between the normals, the outliers' share o, and their uniform density u, relative to the peak
    of the others'. A pose that fits has nearly 0, and others less.

    Attributes:
        sdf: of the object.
        points: (M, 3), metres.
        normals: (M, 3), outward, unit.
        point_sd: (M), s, metres.
        normal_sd: (M), n, radians.
        outlier: o.
    """

    sdf: SDF
    points: Float[Tensor, "M 3"]
    normals: Float[Tensor, "M 3"]
    point_sd: Float[Tensor, "M"]
    normal_sd: Float[Tensor, "M"]
    outlier: float

    def log_likelihood(self, world_T_object: Float[Tensor, "*b N 4 4"]) -> Float[Tensor, "*b N"]:
        """Of each pose, nats."""
        if len(self.points) == 0:
            return world_T_object.new_zeros(world_T_object.shape[:-2])
        with torch.no_grad():
            query = posed_query(self.sdf, world_T_object, self.points)
        facing = se3.rotate(world_T_object, query.gradient)
        cosine = (facing * self.normals).sum(-1) / facing.norm(dim=-1).clamp_min(1e-6)
        angle = torch.acos(cosine.clamp(-1.0, 1.0))
        fit = -0.5 * (query.distance / self.point_sd).square() - 0.5 * (angle / self.normal_sd).square()
        # densities of the peak and of an outlier: in one length and one angle
        peak = -(2.0 * math.pi * self.point_sd * self.normal_sd).log()
        uniform = -math.log(2.0 * _EXTENT_M * math.pi)
        floor = math.log(self.outlier) + uniform - peak if self.outlier > 0 else torch.full_like(peak, -torch.inf)
        return torch.logaddexp(fit + math.log1p(-self.outlier), floor.expand_as(fit)).sum(-1)

    def moved(self, motion: Float[Tensor, "4 4"]) -> Self:
        """After the object moved by a known motion."""
        turned = se3.rotate(motion, self.normals)
        return replace(self, points=se3.apply(motion, self.points), normals=turned)

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Self:
        """On another device, in a floating dtype; the signed distance function stays where it is."""
        parts = ("points", "normals", "point_sd", "normal_sd")
        return replace(self, **{name: getattr(self, name).to(device=device, dtype=dtype) for name in parts})


@dataclass(frozen=True)
class TouchedSomewhere:
    """Contact signals: some point of the gripper's surface touched, nobody knows which; an `Evidence`.

    Attributes:
        sdf: of the object.
        surface: (S, n, 3), points on the gripper's surface at each signal, metres.
        model: of a signal at a distance.
    """

    sdf: SDF
    surface: Float[Tensor, "S n 3"]
    model: ContactModel

    def log_likelihood(self, world_T_object: Float[Tensor, "*b N 4 4"]) -> Float[Tensor, "*b N"]:
        """Of each pose, nats."""
        if len(self.surface) == 0:
            return world_T_object.new_zeros(world_T_object.shape[:-2])
        distance = robot_distance(self.sdf, world_T_object, self.surface)
        felt = torch.ones_like(distance, dtype=torch.bool)
        return self.model.log_likelihood(distance, felt).sum(-1)

    def moved(self, motion: Float[Tensor, "4 4"]) -> Self:
        """After the object moved by a known motion."""
        return replace(self, surface=se3.apply(motion, self.surface))

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Self:
        """On another device, in a floating dtype; the signed distance function stays where it is."""
        return replace(self, surface=self.surface.to(device=device, dtype=dtype))


@dataclass(frozen=True)
class FeltSoFar:
    """Both, which sum up: a `KeptEvidence`.

    Attributes:
        touched: by the wrench.
        signalled: by the joints.
    """

    touched: TouchedSurface
    signalled: TouchedSomewhere

    def log_likelihood(self, world_T_object: Float[Tensor, "*b N 4 4"]) -> Float[Tensor, "*b N"]:
        """Of each pose, nats: the sum."""
        return self.touched.log_likelihood(world_T_object) + self.signalled.log_likelihood(world_T_object)

    def moved(self, motion: Float[Tensor, "4 4"]) -> Self:
        """After the object moved by a known motion."""
        return replace(self, touched=self.touched.moved(motion), signalled=self.signalled.moved(motion))

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Self:
        """On another device, in a floating dtype."""
        return replace(self, touched=self.touched.to(device, dtype), signalled=self.signalled.to(device, dtype))


@dataclass(frozen=True)
class Feeling:
    """What of one scene's readings counts beside points, and for how much: the `feel` of a `PoseFilter`.

    Attributes:
        sdf: of the object.
        surface: (n, 3), points on the gripper's surface, tool frame: where a contact signal may come from.
        point_m: standard deviation of what moves a touched point beside the sensor's noise.
        normal_rad: the same of its normal.
        outlier: share of touches that tell nothing.
        signals: of contact.
    """

    sdf: SDF
    surface: Float[Tensor, "n 3"]
    point_m: float = 0.003
    normal_rad: float = 0.3
    outlier: float = 0.1
    signals: SignalSettings = field(default_factory=SignalSettings)

    def __post_init__(self) -> None:
        """Refuse what cannot be."""
        for name in ("point_m", "normal_rad"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"Expected {name} above 0, got {getattr(self, name)}")
        if not 0 <= self.outlier < 1:
            raise ValueError(f"Expected an outlier share in [0, 1), got {self.outlier}")

    def nothing(self, dtype: torch.dtype = torch.float32, device: torch.device | str | None = None) -> FeltSoFar:
        """Before anything was felt."""
        own, empty = self.signals, torch.zeros(0, 3, dtype=dtype, device=device)
        model = ContactModel(own.true_positive, own.false_positive, own.decay)
        return FeltSoFar(
            TouchedSurface(self.sdf, empty, empty, empty[:, 0], empty[:, 0], self.outlier),
            TouchedSomewhere(self.sdf, empty.new_zeros(0, len(self.surface), 3), model),
        )

    def __call__(self, belief: PoseBelief, reading: Reading, motion: Float[Tensor, "K 4 4"]) -> KeptEvidence | None:
        """All that was felt, with what a reading adds; None where nothing was, now or before.

        Args:
            belief: before the reading.
            reading: of an action.
            motion: (K, 4, 4), of the object in the world, up to each instant.
        """
        felt = belief.felt
        if not isinstance(reading, FeltReading):
            return felt
        signalled = reading.signals is not None and bool(reading.signals.any())
        if len(reading.wrench.points) == 0 and not signalled:
            return felt
        if felt is None:
            felt = self.nothing(reading.tool_pose.dtype, reading.tool_pose.device)
        if not isinstance(felt, FeltSoFar):
            raise TypeError(f"Expected what was felt to be a FeltSoFar, which further touches join, got {felt!r}")
        return self.joined(felt, reading, motion @ belief.world_T_attached)

    def joined(self, felt: FeltSoFar, reading: FeltReading, world_T_attached: Float[Tensor, "K 4 4"]) -> FeltSoFar:
        """With what a reading adds.

        Args:
            felt: before.
            reading: of an action.
            world_T_attached: (K, 4, 4), the frame that rides with the object at each instant.
        """
        touched, signalled, new = felt.touched, felt.signalled, reading.wrench
        if len(new.points):
            own = se3.inverse(world_T_attached)[new.instant]
            touched = replace(
                touched,
                points=torch.cat((touched.points, se3.apply(own, new.points[:, None])[:, 0])),
                normals=torch.cat((touched.normals, se3.rotate(own, new.normals[:, None])[:, 0])),
                point_sd=torch.cat((touched.point_sd, torch.hypot(new.point_sd, _like(self.point_m, new.point_sd)))),
                normal_sd=torch.cat(
                    (touched.normal_sd, torch.hypot(new.normal_sd, _like(self.normal_rad, new.normal_sd)))
                ),
            )
        if reading.signals is not None and bool(reading.signals.any()):
            index = reading.signals.nonzero()[:, 0]
            parts = index.tensor_split(min(self.signals.most, len(index)))
            kept = torch.stack([part[0] for part in parts])
            own = se3.inverse(world_T_attached)[kept] @ reading.tool_pose[kept]
            surface = self.surface.to(own)
            signalled = replace(signalled, surface=torch.cat((signalled.surface, se3.apply(own, surface))))
        return replace(felt, touched=touched, signalled=signalled)


def _like(value: float, other: Tensor) -> Tensor:
    return torch.full_like(other, value)
