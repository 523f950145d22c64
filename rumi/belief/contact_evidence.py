"""Evidence of contact: points with normals from wrenches, and binary contact signals of joints.

Both are kept in the frame that rides with the object, as the points of the memory are: they stay true when it moves.
"""

import math
from dataclasses import dataclass, field, replace
from typing import Annotated

import torch
from annotated_types import Interval
from jaxtyping import Bool, Float
from torch import Tensor

from sdf import numbers, se3, so3
from sdf.base import SDF
from sdf.bounds import Checked, Count, Share, TrainedPositive, TrainedShareBelow1
from sdf.containers import container
from sdf.posed import posed_query
from sensors.contact_reading import ContactReading
from sensors.reading import Reading
from sensors.touch.contact_model import ContactModel, robot_distance

_EXTENT_M = 0.1  # within which an outlier may be anywhere


@dataclass(frozen=True)
class SignalSettings(Checked):
    """Sensor model of the joints' contact signals.

    Attributes:
        true_positive: probability of a signal while the gripper touches.
        false_positive: probability of one while it is far.
        decay: with which the first falls off to the second with distance, 1/m.
        most: signals of contact that count of an action: the first, and others evenly after it.
        spacing_m: of the points on the gripper's surface.
    """

    true_positive: Share = 0.9
    false_positive: Share = 0.02
    decay: Annotated[float, Interval(gt=0.0, lt=1e6)] = 150.0
    most: Count = 2
    spacing_m: Annotated[float, Interval(ge=0.001, le=1.0)] = 0.008

    def __post_init__(self) -> None:
        """Refuse what cannot be."""
        numbers.refuse_trained(self)
        super().__post_init__()
        if not self.false_positive < self.true_positive:
            raise ValueError(
                f"Expected true_positive above false_positive, got {self.true_positive} and {self.false_positive}"
            )


@container()
@dataclass(frozen=True)
class ContactPointEvidence:
    """Likelihood of contact points with normals, against a signed distance function: an `Evidence`.

    log L = sum over contacts of log((1 - o) exp(-v^2 / (2 s^2) - a^2 / (2 n^2)) + o u), with the signed distance v of
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
    outlier: float | Tensor

    @classmethod
    def none(cls, sdf: SDF, outlier: float | Tensor, like: Tensor) -> "ContactPointEvidence":
        """No contact, in the dtype and on the device of a tensor."""
        empty = like.new_zeros(0, 3)
        return cls(sdf, empty, empty, empty[:, 0], empty[:, 0], outlier)

    def log_likelihood(self, world_T_object: Float[Tensor, "*b N 4 4"], /) -> Float[Tensor, "*b N"]:
        """Of each pose, nats."""
        if len(self.points) == 0:
            return world_T_object.new_zeros(world_T_object.shape[:-2])
        query = posed_query(self.sdf, world_T_object, self.points)
        facing = se3.rotate(world_T_object, query.gradient)
        cosine = (facing * self.normals).sum(-1) / facing.norm(dim=-1).clamp_min(1e-6)
        angle = so3.arccos(cosine)
        fit = -0.5 * (query.distance / self.point_sd).square() - 0.5 * (angle / self.normal_sd).square()
        # densities of the peak and of an outlier: in one length and one angle
        peak = -(2.0 * math.pi * self.point_sd * self.normal_sd).log()
        uniform = -math.log(2.0 * _EXTENT_M * math.pi)
        floor = numbers.log(self.outlier) + uniform - peak
        return torch.logaddexp(fit + numbers.log1p(-self.outlier), floor.expand_as(fit)).sum(-1)


@dataclass(frozen=True)
class ContactPointModel(Checked):
    """Measurement model of contact points with normals: an `EvidenceModel`.

    Attributes:
        sdf: of the object.
        point_m: standard deviation of what moves a touched point beside the sensor's noise.
        normal_rad: the same of its normal.
        outlier: share of contacts that tell nothing.

    The three are numbers, or tensors of one number each, to which gradients go.
    """

    sdf: SDF
    point_m: TrainedPositive = 0.003
    normal_rad: TrainedPositive = 0.3
    outlier: TrainedShareBelow1 = 0.1

    @classmethod
    def of(cls, sdf: SDF, surface: Float[Tensor, "n 3"]) -> "ContactPointModel":
        """For an object; the tool's surface tells nothing more."""
        return cls(sdf)

    def update(
        self, evidence: ContactPointEvidence | None, reading: Reading, world_T_attached: Float[Tensor, "K 4 4"], /
    ) -> ContactPointEvidence | None:
        """Evidence with the contact points of a reading; see `EvidenceModel`."""
        if not isinstance(reading, ContactReading) or len(reading.wrench.points) == 0:
            return evidence
        before, new = evidence or ContactPointEvidence.none(self.sdf, self.outlier, reading.tool_pose), reading.wrench
        own = se3.inverse(world_T_attached)[new.instant]
        point_sd = torch.hypot(new.point_sd, numbers.like(self.point_m, new.point_sd))
        normal_sd = torch.hypot(new.normal_sd, numbers.like(self.normal_rad, new.normal_sd))
        return replace(
            before,
            points=torch.cat((before.points, se3.apply(own, new.points[:, None])[:, 0])),
            normals=torch.cat((before.normals, se3.rotate(own, new.normals[:, None])[:, 0])),
            point_sd=torch.cat((before.point_sd, point_sd)),
            normal_sd=torch.cat((before.normal_sd, normal_sd)),
        )


@container()
@dataclass(frozen=True)
class ContactSignalEvidence:
    """Likelihood of contact signals, each of some point of the gripper's surface, nobody knows which: an `Evidence`.

    Attributes:
        sdf: of the object.
        surface: (*b, S, n, 3), points on the gripper's surface at each signal, metres.
        model: of a signal at a distance.
        signals: (*b, S), whether each was one of contact; None where all were.
    """

    sdf: SDF
    surface: Float[Tensor, "*b S n 3"]
    model: ContactModel
    signals: Bool[Tensor, "*b S"] | None = None

    def log_likelihood(self, world_T_object: Float[Tensor, "*b N 4 4"], /) -> Float[Tensor, "*b N"]:
        """Of each pose, nats."""
        if self.surface.shape[-3] == 0:
            return world_T_object.new_zeros(world_T_object.shape[:-2])
        distance = robot_distance(self.sdf, world_T_object, self.surface)
        contact = torch.ones_like(distance, dtype=torch.bool)
        if self.signals is not None:
            contact = self.signals[..., None, :].expand(distance.shape)
        return self.model.log_likelihood(distance, contact).sum(-1)


@dataclass(frozen=True)
class ContactSignalModel:
    """Measurement model of the joints' contact signals: an `EvidenceModel`.

    Attributes:
        sdf: of the object.
        surface: (n, 3), points on the gripper's surface, tool frame: where a contact signal may come from.
        signals: how signals come about, and how many count.
    """

    sdf: SDF
    surface: Float[Tensor, "n 3"]
    signals: SignalSettings = field(default_factory=SignalSettings)

    @classmethod
    def of(cls, sdf: SDF, surface: Float[Tensor, "n 3"]) -> "ContactSignalModel":
        """For an object and a tool with these points on its surface."""
        return cls(sdf, surface)

    def update(
        self, evidence: ContactSignalEvidence | None, reading: Reading, world_T_attached: Float[Tensor, "K 4 4"], /
    ) -> ContactSignalEvidence | None:
        """Evidence with the contact signals of a reading; see `EvidenceModel`."""
        if not isinstance(reading, ContactReading) or reading.signals is None or not bool(reading.signals.any()):
            return evidence
        if evidence is None:
            own = self.signals
            model = ContactModel(own.true_positive, own.false_positive, own.decay)
            evidence = ContactSignalEvidence(self.sdf, reading.tool_pose.new_zeros(0, len(self.surface), 3), model)
        index = reading.signals.nonzero()[:, 0]
        parts = index.tensor_split(min(self.signals.most, len(index)))
        kept = torch.stack([part[0] for part in parts])
        attached_T_tool = se3.inverse(world_T_attached)[kept] @ reading.tool_pose[kept]
        surface = se3.apply(attached_T_tool, self.surface.to(attached_T_tool))
        return replace(evidence, surface=torch.cat((evidence.surface, surface)))
