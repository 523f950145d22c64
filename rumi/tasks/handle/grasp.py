"""Where to grasp the mug: the place at which the handle is lifted at the greatest share of the belief."""

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.dynamics.sliding import rotated
from rumi.tasks.handle.gripper import HandleGripper, grasp_xml
from sdf import se3
from sdf.cache import content_key, keep_arrays, load_arrays
from sdf.so3 import wrap

_NODES = (9, 6, 13)  # along, aside, turned
_ENDS = (0.032, 0.040, 0.9)  # metres, metres, radians


@dataclass(frozen=True, eq=False)
class HandleTable:
    """Chance of lifting, by where the mug stands in the frame in which it is taken to stand; linear between nodes.

    The mug is its own mirror image: offsets aside are told by their amount, the yaw by its sign relative to theirs.
    Beyond the ends is failure.

    Attributes:
        odds: (A, B, C), at offsets along the handle (-ends[0]..ends[0]), aside (0..ends[1]) and yaw
            (-ends[2]..ends[2]).
        ends: metres, metres, radians.
    """

    odds: Float[Tensor, "A B C"]
    ends: tuple[float, float, float] = _ENDS

    def __call__(self, taken: Float[Tensor, "*#b 3"], true: Float[Tensor, "*#b 3"]) -> Float[Tensor, "*b"]:
        """Chance of lifting mugs at (x, y, yaw) by grasps that take them to stand elsewhere."""
        apart = rotated(true[..., :2] - taken[..., :2], -taken[..., 2])
        yaw = wrap(true[..., 2] - taken[..., 2])
        along, aside = apart.unbind(-1)
        sign = torch.where(aside < 0, -1.0, 1.0).to(yaw)
        place = torch.stack((along, aside.abs(), sign * yaw), -1)
        odds, ends = self.odds.to(place), place.new_tensor(self.ends)
        last = place.new_tensor([float(n - 1) for n in odds.shape])
        low = torch.stack((-ends[0], torch.zeros_like(ends[1]), -ends[2]))
        at = (place - low) / (ends - low) * last
        within = ((at >= 0) & (at <= last)).all(-1)
        at = torch.minimum(at.clamp_min(0.0), last)
        corner = torch.minimum(at.floor(), last - 1.0)
        part, index = at - corner, corner.long()
        found = torch.zeros_like(at[..., 0])
        for step in torch.cartesian_prod(*[torch.arange(2)] * 3):
            share = torch.where(step.bool(), part, 1.0 - part).prod(-1)
            found = found + share * odds[tuple((index + step).unbind(-1))]
        return torch.where(within, found, 0.0)


def handle_table(gripper: HandleGripper, *, cache_dir: Path | None = None) -> HandleTable:
    """Success of simulated grasps over a grid of misplacements, worked out once.

    Args:
        gripper: that grasps.
        cache_dir: folder that keeps the table; None simulates it each time (half a minute).
    """
    text = grasp_xml(gripper.shape, gripper.body, gripper.physics, gripper.settings)
    key = content_key(repr((text, _NODES, _ENDS)), gripper.controls(torch.zeros(3)).tobytes())
    path = None if cache_dir is None else cache_dir / f"handle-{key}.npz"
    kept = None if path is None else load_arrays(path, ("odds",))
    if kept is not None and kept["odds"].shape == _NODES:
        return HandleTable(torch.from_numpy(kept["odds"]))
    axes = [
        torch.linspace(-_ENDS[0], _ENDS[0], _NODES[0], dtype=torch.float64),
        torch.linspace(0.0, _ENDS[1], _NODES[1], dtype=torch.float64),
        torch.linspace(-_ENDS[2], _ENDS[2], _NODES[2], dtype=torch.float64),
    ]
    places = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    still = torch.zeros(3, dtype=torch.float64)
    lifted = [gripper.grasp(still, se3.from_planar(place)) for place in places]
    odds = torch.tensor(lifted, dtype=torch.float64).view(_NODES)
    if path is not None:
        keep_arrays(path, {"odds": odds.numpy()})
    return HandleTable(odds)


class Grasp(NamedTuple):
    """Where to grasp.

    Attributes:
        pose: (3,), (x, y, yaw) at which the mug is taken to stand.
        probability: believed, of lifting it.
    """

    pose: Float[Tensor, "3"]
    probability: float


def best_grasp(world_T_object: Float[Tensor, "N 4 4"], log_weights: Float[Tensor, "N"], table: HandleTable) -> Grasp:
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
