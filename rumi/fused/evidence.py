"""What was felt so far, as log-likelihoods of poses: touches by a wrench, and contact signals of joints.

Both stand in the frame that rides with the object, as the points of the memory do: they stay true when it moves.
"""

import math
from dataclasses import dataclass, replace
from typing import Self

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.fused.reading import FusedReading
from rumi.fused.settings import FusedSettings
from sdf import se3
from sdf.base import SDF
from sdf.posed import posed_query
from sensors.contact_model import ContactModel, robot_distance

_EXTENT_M = 0.1  # within which an outlier may be anywhere


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


@dataclass(frozen=True)
class FeltSoFar:
    """Both, which sum up.

    Attributes:
        touched: by the wrench.
        signalled: by the joints.
    """

    touched: TouchedSurface
    signalled: TouchedSomewhere

    @classmethod
    def nothing(cls, sdf: SDF, settings: FusedSettings, surface_points: int) -> Self:
        """Before anything was felt.

        Args:
            sdf: of the object.
            settings: of the run.
            surface_points: on the gripper's surface.
        """
        own, empty, none = settings.signals, torch.zeros(0, 3), torch.zeros(0)
        model = ContactModel(own.true_positive, own.false_positive, own.decay)
        return cls(
            TouchedSurface(sdf, empty, empty, none, none, settings.wrist.outlier),
            TouchedSomewhere(sdf, torch.zeros(0, surface_points, 3), model),
        )

    def joined(
        self,
        reading: FusedReading,
        world_T_attached: Float[Tensor, "K 4 4"],
        surface: Float[Tensor, "n 3"],
        settings: FusedSettings,
    ) -> Self:
        """With what an action's reading adds.

        Args:
            reading: of it.
            world_T_attached: (K, 4, 4), the frame that rides with the object at each instant.
            surface: (n, 3), points on the gripper's surface, tool frame.
            settings: of the run.
        """
        touched, signalled, wrist = self.touched, self.signalled, settings.wrist
        new = reading.wrench
        if len(new.points):
            own = se3.inverse(world_T_attached)[new.instant]
            touched = replace(
                touched,
                points=torch.cat((touched.points, se3.apply(own, new.points[:, None])[:, 0])),
                normals=torch.cat((touched.normals, se3.rotate(own, new.normals[:, None])[:, 0])),
                point_sd=torch.cat((touched.point_sd, torch.hypot(new.point_sd, _like(wrist.point_m, new.point_sd)))),
                normal_sd=torch.cat(
                    (touched.normal_sd, torch.hypot(new.normal_sd, _like(wrist.normal_rad, new.normal_sd)))
                ),
            )
        if reading.signals is not None and bool(reading.signals.any()):
            index = reading.signals.nonzero()[:, 0]
            parts = index.tensor_split(min(settings.signals.most, len(index)))
            kept = torch.stack([part[0] for part in parts])
            own = se3.inverse(world_T_attached)[kept] @ reading.tool_pose[kept]
            signalled = replace(signalled, surface=torch.cat((signalled.surface, se3.apply(own, surface))))
        return replace(self, touched=touched, signalled=signalled)

    def log_likelihood(self, world_T_object: Float[Tensor, "*b N 4 4"]) -> Float[Tensor, "*b N"]:
        """Of each pose, nats: the sum."""
        return self.touched.log_likelihood(world_T_object) + self.signalled.log_likelihood(world_T_object)

    def moved(self, motion: Float[Tensor, "4 4"]) -> Self:
        """After the object moved by a known motion."""
        return replace(self, touched=self.touched.moved(motion), signalled=self.signalled.moved(motion))


def _like(value: float, other: Tensor) -> Tensor:
    return torch.full_like(other, value)
