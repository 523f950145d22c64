"""Where to grasp the mug: the place at which the handle is lifted at the greatest share of the belief."""

import math
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.tasks.grasp_table import Grasp, GraspTable, simulated_table
from rumi.tasks.handle.gripper import HandleGripper, grasp_xml
from sdf import se3
from sdf.cache import content_key

_NODES = (9, 6, 13)  # along, aside, turned
_ENDS = (0.032, 0.040, 0.9)  # metres, metres, radians


def handle_table(gripper: HandleGripper, *, cache_dir: Path | None = None) -> GraspTable:
    """Success of simulated grasps over a grid of misplacements, worked out once.

    Args:
        gripper: that grasps.
        cache_dir: folder that keeps the table; None simulates it each time (half a minute).
    """
    text = grasp_xml(gripper.shape, gripper.body, gripper.physics, gripper.settings)
    key = content_key(repr((text, _NODES, _ENDS)), gripper.controls(torch.zeros(3)).tobytes())
    path = None if cache_dir is None else cache_dir / f"handle-{key}.npz"
    still = torch.zeros(3, dtype=torch.float64)

    def lift(places: Tensor) -> Tensor:
        return torch.tensor([gripper.grasp(still, se3.from_planar(place)) for place in places])

    return simulated_table(handle_odds(torch.zeros(_NODES)), lift, path)


def handle_odds(odds: Float[Tensor, "A B C"]) -> GraspTable:
    """Table of a mug, its own mirror image, by the offsets along its handle, aside and the yaw."""
    return GraspTable(odds, _ENDS, mirrored=(False, True), period=2.0 * math.pi)


def best_grasp(world_T_object: Float[Tensor, "N 4 4"], log_weights: Float[Tensor, "N"], table: GraspTable) -> Grasp:
    """The grasp that lifts the mug at the greatest share of the belief, of those at the particles and their mean.

    Args:
        world_T_object: poses of the particles.
        log_weights: of the particles.
        table: of success.
    """
    poses, weights = se3.to_planar(world_T_object.double()), log_weights.double().softmax(-1)
    turn = torch.stack((poses[:, 2].cos(), poses[:, 2].sin()), -1)
    yaw = torch.atan2(weights @ turn[:, 1], weights @ turn[:, 0])
    mean = torch.cat((weights @ poses[:, :2], yaw[None]))
    tried = torch.cat((mean[None], poses))
    chance = table(tried[:, None], poses[None]) @ weights
    best = int(chance.argmax())
    return Grasp(tried[best], min(1.0, float(chance[best])))
