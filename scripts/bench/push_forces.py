"""Real pushes with the force at the tip: what force, and slip or stick, tell of an object's lever and friction.

`RUMI_DATA/real_pushes/forces` is read: 50 pushes a file by 16 mm of a right-angled triangle of aluminium (150 mm a leg)
on three known points, or on its whole face (github.com/robinzhoucmu/Pushing). The log of the force is mirrored, and
turned against the tip by 135 degrees (found from the data: so it lies about the normals of the sides).
"""

import math
from functools import cache
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rumi.dynamics.pushed_body import ObservedPush, PushedBody
from rumi.dynamics.sliding import rotated
from scripts.bench.real_pushes import WrenchTwists, folder, polygon_body
from sdf.so3 import wrap

LEG_M, TIP_M = 0.15, 0.0005
"""Of the triangle, its right angle at the origin; and of the tip, whose tracked point is where it touches."""

SUPPORTS = {
    "wide": "10_130_10_10_10_130",
    "slanted": "10_90_10_10_30_130",
    "middle": "30_90_30_30_30_90",
    "narrow": "30_63.33_43.33_30_43.33_63.33",
    "face": "patch",
}
"""Folders by how the triangle rests."""

_SENSOR_RAD = math.radians(-135.0)
_INSTANTS = 17
_PUSHES_N = 0.5  # least force of a tip that pushes
_SLIP = 0.15  # of the tip's way: a contact that slides by more slips
_SCALE = 0.06  # error of a force's tangent


class ForcePush(NamedTuple):
    """A push with what the tip felt.

    Attributes:
        push: start, tip path, end.
        wrench: (3,), mean force, object frame, N, and its moment about the object's origin, N m.
        twist: (3,), of the object's origin, object frame, metres, and turn, radians, over the push.
        tangent: of the force's angle off the normal.
        slips: whether the contact slid along the object.
    """

    push: ObservedPush
    wrench: Float[Tensor, "3"]
    twist: Float[Tensor, "3"]
    tangent: float
    slips: bool


def triangle() -> PushedBody:
    """The triangle of even density, and the tip."""
    return polygon_body(LEG_M * torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]], dtype=torch.float64), TIP_M)


def true_lever_m(support: str) -> float | None:
    """Greatest moment over greatest force of what three points carry, metres, by statics; None for a face."""
    name = SUPPORTS[support]
    if name == "patch":
        return None
    points = torch.tensor([float(part) for part in name.split("_")], dtype=torch.float64).view(2, 3).T
    centre = torch.full((2,), 1e3 * LEG_M / 3.0, dtype=torch.float64)
    rows = torch.cat((points.T, torch.ones(1, 3, dtype=torch.float64)))
    loads = torch.linalg.solve(rows, torch.cat((centre, torch.ones(1, dtype=torch.float64))))
    return 1e-3 * float(loads @ (points - centre).norm(dim=-1))


@cache
def force_pushes(support: str) -> tuple[ForcePush, ...]:
    """The pushes of a file that touch and are felt."""
    (file,) = (folder() / "forces" / SUPPORTS[support]).glob("*.txt")
    lines = iter(file.read_text().splitlines())

    def rows(count: int) -> np.ndarray:
        return np.array([next(lines).split() for _ in range(count)], dtype=float)

    found = []
    for _ in range(int(next(lines))):
        poses, force, robot = rows(2), rows(int(next(lines))), rows(int(next(lines)))
        yaw = 2.0 * np.arctan2(poses[:, 6], poses[:, 3])
        start, end = (torch.tensor([*(1e-3 * poses[i, :2]), yaw[i]], dtype=torch.float64) for i in range(2))
        end[2] = start[2] + wrap(end[2] - start[2])
        way = np.hypot(*np.diff(robot[:, 1:3], axis=0).T).cumsum()
        at = np.searchsorted(way, np.linspace(0.0, way[-1], _INSTANTS)).clip(0, len(robot) - 1)
        at[-1] = len(robot) - 1
        tip = 1e-3 * torch.tensor(robot[at, 1:3])
        path = torch.cat((tip, torch.zeros_like(tip[:, :1])), -1)
        # a sensor that was pressed before its log began has no rest in it
        rest = force[:20, 1:].mean(0)
        felt = force[:, 1:] - (rest if np.hypot(*rest) < 0.2 else 0.0)
        pushing = felt[np.hypot(*felt.T) > _PUSHES_N]
        made = _with_force(ObservedPush(start, path, end), pushing, robot[-1])
        if made is not None:
            found.append(made)
    return tuple(found)


def _with_force(push: ObservedPush, felt: np.ndarray, robot: np.ndarray) -> ForcePush | None:
    if len(felt) < 100:
        return None
    x, y = torch.tensor(felt[len(felt) // 4 :].mean(0)).tolist()
    angle = 2.0 * math.atan2(robot[7], robot[4]) + _SENSOR_RAD - math.atan2(y, x)
    force = math.hypot(x, y) * torch.tensor([math.cos(angle), math.sin(angle)], dtype=torch.float64)
    # over the share of the tip's way in which it pushed
    middle, turn = 0.5 * (push.start + push.end), push.end[2] - push.start[2]
    body = triangle_body()
    local = rotated(push.path[-1:, :2] - push.end[:2], -push.end[2])
    normal = -body.outline(local).gradient[0]
    normal = normal / normal.norm()
    own = rotated(force, -push.end[2])
    tangent = float((normal[0] * own[1] - normal[1] * own[0]) / (own @ normal))
    # where the end's contact point of the object was at the start, against where the tip went in contact
    gone = rotated((push.end - push.start)[:2], -middle[2])
    arm = local[0]
    carried = gone + turn * torch.stack((-arm[1], arm[0]))
    into = float(carried @ normal)
    heading = rotated(push.path[-1, :2] - push.path[0, :2], -middle[2])
    along = heading / heading.norm()
    if not float(along @ normal) > 0.05 or not into > 1e-3:
        return None
    tip = into / float(along @ normal) * along
    slip = tip - carried
    slides = float((normal[0] * slip[1] - normal[1] * slip[0]).abs()) > _SLIP * float(tip.norm())
    at = rotated(force, -middle[2])
    moment = arm[0] * at[1] - arm[1] * at[0]
    return ForcePush(push, torch.stack((*at, moment)), torch.stack((*gone, turn)), tangent, slides)


@cache
def triangle_body() -> PushedBody:
    """`triangle`, made once."""
    return triangle()


def pairs_of(pushes: tuple[ForcePush, ...]) -> WrenchTwists:
    """Their wrenches and twists."""
    wrench, twist = (torch.stack([getattr(own, name) for own in pushes]) for name in ("wrench", "twist"))
    return WrenchTwists(wrench, twist, 1.0)


def slip_log_likelihood(friction: Float[Tensor, "N"], tangent: Float[Tensor, "n"], slips: Tensor) -> Float[Tensor, "N"]:
    """Of forces' angles off the normal by frictions: on the edge of the cone where a contact slips, in it else."""
    off = (tangent.abs()[:, None] - friction) / _SCALE
    edge = -2.0 * torch.log1p(off.square() / 3.0)
    within = torch.where(off > 0, edge, torch.zeros_like(edge))
    return torch.where(slips[:, None], edge, within).sum(0)
