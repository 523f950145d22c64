"""Object motion predicted by a push model from the tool's reported path: no slip sensor needed."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.belief.particles import PoseBelief
from rumi.dynamics.base import ObjectMotion
from sdf import se3
from sensors.reading import Reading


@dataclass(frozen=True)
class PushedMotion:
    """Motion of the best-fitting particle under a push model, along the path that the tool reports.

    An action in which nothing was felt moved nothing, and is not predicted. Upright objects only.

    Attributes:
        predict: the push model's motion (`rumi.dynamics.base.PushModel.motion`).
    """

    predict: ObjectMotion

    @torch.no_grad()
    def __call__(self, belief: PoseBelief, reading: Reading) -> Float[Tensor, "*b K 4 4"]:
        """World motion up to each instant."""
        best = belief.discrepancy.argmin(-1)[..., None, None, None]
        poses, tool = belief.world_T_object, reading.tool_pose
        chosen = torch.gather(poses, -3, best.expand(*best.shape[:-3], 1, 4, 4))[..., 0, :, :]
        start, path = se3.to_planar(chosen).reshape(-1, 3), se3.to_planar(tool).reshape(-1, tool.shape[-3], 3)
        contact = reading.in_contact.any(-1).reshape(-1)
        motion = se3.identity((len(path), path.shape[1]), dtype=start.dtype, device=start.device).contiguous()
        motion[contact] = self.predict(start[contact], path[contact]).to(motion)
        return motion.reshape(tool.shape)
