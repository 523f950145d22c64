"""How far a push model says that the object moved while the tool went its way: no slip sensor needed."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.belief.particles import PoseBelief
from rumi.dynamics.along_path import Carrier, Pusher, carry, unwrapped
from rumi.dynamics.outline import GridOutline, support_of
from rumi.dynamics.quasi_static import QuasiStaticSettings
from rumi.dynamics.sliding import Sliding
from rumi.robot.gripper import GripperShape
from sdf import se3
from sdf.base import SDF
from sensors.reading import Reading


@dataclass(frozen=True)
class PushedMotion:
    """Motion of the best-fitting particle under a planar push model, along the path that the tool reports.

    An action in which nothing was felt moved nothing. Upright objects only.

    Attributes:
        outline: of the object at the tool's height.
        pusher: the tool.
        sliding: how the object slides.
        substeps: parts of the way from one instant to the next.
        carrier: the model, by default quasi-static; `carry_along` is the displacement model.
    """

    outline: GridOutline
    pusher: Pusher
    sliding: Sliding
    substeps: int = 1
    carrier: Carrier = carry

    @classmethod
    def of(
        cls,
        sdf: SDF,
        height_m: float,
        shape: GripperShape,
        settings: QuasiStaticSettings | None = None,
        carrier: Carrier = carry,
    ) -> "PushedMotion":
        """For an object and a gripper.

        Args:
            sdf: of the object.
            height_m: of the tool, object frame.
            shape: of the gripper.
            settings: friction, limit surface and spacing of the gripper's points.
            carrier: the model.
        """
        own, support = settings or QuasiStaticSettings(), support_of(sdf)
        like = support.centre
        return cls(
            GridOutline.of_slice(sdf, height_m),
            Pusher(shape.outline(own.spacing_m).to(like)),
            Sliding(like, like.new_tensor(own.lever_ratio * support.spread), like.new_tensor(own.friction)),
            carrier=carrier,
        )

    @torch.no_grad()
    def __call__(self, belief: PoseBelief, reading: Reading) -> Float[Tensor, "*b K 4 4"]:
        """World motion up to each instant."""
        best = belief.discrepancy.argmin(-1)[..., None, None, None]
        poses = belief.world_T_object
        chosen = torch.gather(poses, -3, best.expand(*best.shape[:-3], 1, 4, 4))[..., 0, :, :]
        start, tool = se3.to_planar(chosen), se3.to_planar(reading.tool_pose)
        batch, instants = start.shape[:-1], tool.shape[-2]
        # the way to the first instant is not reported: what depth it left is worked off on the spot
        path = torch.cat((tool[..., :1, :], tool), -2).reshape(-1, instants + 1, 3)
        flat = start.reshape(-1, 3)
        carried = self.carrier(
            flat,
            unwrapped(path),
            Pusher(self.pusher.points.to(start), self.pusher.thickness),
            self.outline.to(start),
            Sliding(*(part.to(start) for part in self.sliding)),
            substeps=self.substeps,
        )
        track = se3.from_planar(carried.track.reshape(*batch, instants, 3))
        motion = track @ se3.inverse(se3.from_planar(start))[..., None, :, :]
        felt = reading.in_contact.any(-1)[..., None, None, None]
        identity = se3.identity((*batch, instants), dtype=motion.dtype, device=motion.device)
        return torch.where(felt, motion, identity)
