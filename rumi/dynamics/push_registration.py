"""Registration of a pushed object with its tool: how far both are from where they are tracked, by where they touched.

What tracks the tool and what tracks the object disagree by a millimetre or two, and an object's frame lies a little off
its outline: the real pushes of Yu et al. (2016) end with the tip up to 2.4 mm in or off the object. Both errors are
constant: the tool's in the world, the outline's in the object's frame. To first order the measured gap of a touch is
a linear function of them, so that their posterior is a normal one, found by iteratively reweighted least squares with
Student-t errors. Pushes are predicted from poses that are put right.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.dynamics.pushed_body import ObservedPush, PushedBody
from rumi.dynamics.sliding import rotated

SHIFTS = ("tool x", "tool y", "outline x", "outline y", "outline yaw")
"""Of the tool in the world, and of the outline in the object's frame; metres and radians."""

_NOISE_M = 2e-4  # of a gap: the sets' own
_TAILS = 4.0  # degrees of freedom: of a gap, and of the prior, since one frame of 14 sets is turned by 4 degrees
_FAR = 4.0  # prior deviations of a gap beyond which the tool no longer touched
_STEPS = 12
_DEVIATION = (1e-3, 1e-3, 4e-4, 4e-4, 0.01)


@dataclass(frozen=True)
class Registration:
    """Normal belief about the shifts of a tool and an object from where they are tracked.

    Attributes:
        deviation: scale of the prior, (5,), Student-t about 0; see `SHIFTS`.
        mean: (5,).
        root: (5, 5), of the covariance (lower triangle), by rows.
    """

    deviation: tuple[float, ...] = _DEVIATION
    mean: tuple[float, ...] = (0.0,) * 5
    root: tuple[tuple[float, ...], ...] | None = None

    def __post_init__(self) -> None:
        """Refuse what has no meaning."""
        if len(self.deviation) != len(SHIFTS) or not all(0 < part < math.inf for part in self.deviation):
            raise ValueError(f"Expected a deviation above 0 for each of {', '.join(SHIFTS)}, got {self.deviation}")

    def shifts(self, white: Float[Tensor, "N 5"]) -> Float[Tensor, "N 5"]:
        """Those that standard normal numbers stand for."""
        root = white.new_tensor(self.deviation).diag() if self.root is None else white.new_tensor(self.root)
        return white.new_tensor(self.mean) + white @ root.T

    def learnt(self, pushes: Sequence[ObservedPush], body: PushedBody) -> "Registration":
        """The posterior by all pushes of an object: where they end the tool touches, where they begin it is not inside.

        Ends at which the tool is too far off to touch tell nothing.
        """
        deviation = torch.tensor(self.deviation, dtype=torch.float64)
        precision = deviation.square().reciprocal().diag()
        mean, whole = torch.zeros_like(deviation), precision
        gap, slope = touches([push.end for push in pushes], [push.path[-1] for push in pushes], body)
        near = gap.abs() < _FAR * torch.hypot((slope * deviation).norm(dim=-1), gap.new_tensor(_NOISE_M))
        first, first_slope = touches([push.start for push in pushes], [push.path[0] for push in pushes], body)
        gap, slope = torch.cat((gap[near], first)), torch.cat((slope[near], first_slope))
        begins = torch.arange(len(gap)) >= int(near.sum())
        for _ in range(_STEPS):
            left = (gap - slope @ mean) / _NOISE_M
            weight = _TAILS / (_TAILS + left.square()) / _NOISE_M**2
            weight = torch.where(begins & (left > 0), torch.zeros_like(weight), weight)
            rare = _TAILS / (_TAILS + (mean / deviation).square())
            whole = precision * rare + (slope.T * weight) @ slope
            mean = torch.linalg.solve(whole, (slope.T * weight) @ gap)
        root = torch.linalg.cholesky(torch.linalg.inv(whole))
        return replace(self, mean=tuple(mean.tolist()), root=tuple(map(tuple, root.tolist())))


def touches(
    poses: Sequence[Float[Tensor, "3"]], tools: Sequence[Float[Tensor, "3"]], body: PushedBody
) -> tuple[Float[Tensor, "n"], Float[Tensor, "n 5"]]:
    """Gaps between a tool and an object as tracked, metres, and how they change with the shifts."""
    pose, tool = torch.stack(list(poses)).double(), torch.stack(list(tools)).double()
    points = body.pusher.points.to(pose)
    placed = tool[:, None, :2] + rotated(points, tool[:, None, 2])
    local = rotated(placed - pose[:, None, :2], -pose[:, None, 2])
    outline = body.outline.to(pose) if hasattr(body.outline, "to") else body.outline
    gap, index = outline(local).distance.min(-1)
    point = local[torch.arange(len(local)), index]
    gradient = outline(point).gradient
    normal = gradient / gradient.norm(dim=-1, keepdim=True).clamp_min(1e-9)
    turn = point[:, 0] * normal[:, 1] - point[:, 1] * normal[:, 0]
    return gap - body.pusher.thickness, torch.cat((rotated(normal, pose[:, 2]), normal, turn[:, None]), -1)


def put_right(poses: Float[Tensor, "*b 3"], shifts: Float[Tensor, "*#b 5"]) -> Float[Tensor, "*b 3"]:
    """Poses of an object's outline, of those of its tracked frame."""
    place = poses[..., :2] + rotated(shifts[..., 2:4], poses[..., 2])
    return torch.cat((place, poses[..., 2:] + shifts[..., 4:]), -1)


def as_tracked(poses: Float[Tensor, "*b 3"], shifts: Float[Tensor, "*#b 5"]) -> Float[Tensor, "*b 3"]:
    """The inverse of `put_right`."""
    yaw = poses[..., 2:] - shifts[..., 4:]
    return torch.cat((poses[..., :2] - rotated(shifts[..., 2:4], yaw[..., 0]), yaw), -1)
