"""Registration of a pushed object with its tool: how far both are from where they are tracked, by where they touched.

What tracks the tool and what tracks the object disagree by a millimetre or two, and an object's frame lies a little off
its outline: the real pushes of Yu et al. (2016) end with the tip up to 2.4 mm in or off the object. Both errors are
constant: the tool's in the world, the outline's in the object's frame. Touches tell both: of greatest posterior density
are the shifts that Gauss-Newton steps find, reweighted by Student-t errors (iteratively reweighted least squares); what
is left is Student-t about them, by the last step. Pushes are predicted from poses that are put right.
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
_CLAMP = 7.0  # standard normal numbers beyond which Student-t ones grow no more
_DEVIATION = (8e-4, 8e-4, 2.7e-4, 2.7e-4, 0.0085)


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
        """Those that standard normal numbers stand for, as heavy in the tails as the prior is."""
        root = white.new_tensor(self.deviation).diag() if self.root is None else white.new_tensor(self.root)
        return white.new_tensor(self.mean) + student_4(white) @ root.T

    def learnt(self, pushes: Sequence[ObservedPush], body: PushedBody) -> "Registration":
        """The posterior by all pushes of an object: where they end the tool touches, where they begin it is not inside.

        Ends at which the tool is too far off to touch tell nothing.
        """
        deviation = torch.tensor(self.deviation, dtype=torch.float64)
        poses = torch.stack([push.end for push in pushes] + [push.start for push in pushes]).double()
        tools = torch.stack([push.path[-1] for push in pushes] + [push.path[0] for push in pushes]).double()
        begins = torch.arange(len(poses)) >= len(pushes)
        gap, slope = touches(poses, tools, body)
        near = gap.abs() < _FAR * torch.hypot((slope * deviation).norm(dim=-1), gap.new_tensor(_NOISE_M))
        taken = near | begins
        poses, tools, begins = poses[taken], tools[taken], begins[taken]
        mean, whole = torch.zeros_like(deviation), deviation.square().reciprocal().diag()
        for _ in range(_STEPS):
            # anew about what is known: a frame that is turned by degrees is beyond one linear model
            gap, slope = touches(poses, tools, body, mean)
            left = gap / _NOISE_M
            weight = _TAILS / (_TAILS + left.square()) / _NOISE_M**2
            weight = torch.where(begins & (left > 0), torch.zeros_like(weight), weight)
            rare = _TAILS / (_TAILS + (mean / deviation).square())
            whole = (rare / deviation.square()).diag() + (slope.T * weight) @ slope
            mean = torch.linalg.solve(whole, (slope.T * weight) @ (gap + slope @ mean))
        root = torch.linalg.cholesky(torch.linalg.inv(whole))
        return replace(self, mean=tuple(mean.tolist()), root=tuple(map(tuple, root.tolist())))


def student_4(white: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """Student-t numbers with 4 degrees of freedom at the quantiles of standard normal ones (Shaw 2006)."""
    tail = torch.special.ndtr(-white.abs().clamp_max(_CLAMP))
    root = (4.0 * tail * (1.0 - tail)).sqrt()
    return 2.0 * white.sign() * ((root.arccos() / 3.0).cos() / root - 1.0).clamp_min(0.0).sqrt()


def normal_of_4(student: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """Standard normal numbers at the quantiles of Student-t ones with 4 degrees of freedom: undoes `student_4`."""
    beyond = student.abs() / (4.0 + student.square()).sqrt()  # sine of an angle: 1 at infinity
    tail = 0.25 * (1.0 - beyond).square() * (2.0 + beyond)
    return -student.sign() * torch.special.ndtri(tail)


def touches(
    poses: Float[Tensor, "n 3"],
    tools: Float[Tensor, "n 3"],
    body: PushedBody,
    shifts: Float[Tensor, "5"] | None = None,
) -> tuple[Float[Tensor, "n"], Float[Tensor, "n 5"]]:
    """Gaps between a tool and an object that are put right by some shifts, metres, and how more shifts lessen them."""
    shifts = poses.new_zeros(5) if shifts is None else shifts
    pose, points = put_right(poses, shifts), body.pusher.points.to(poses)
    placed = tools[:, None, :2] - shifts[:2] + rotated(points, tools[:, None, 2])
    local = rotated(placed - pose[:, None, :2], -pose[:, None, 2])
    outline = body.outline.to(pose)
    gap, index = outline(local).distance.min(-1)
    point = local[torch.arange(len(local)), index]
    gradient = outline(point).gradient
    normal = gradient / gradient.norm(dim=-1, keepdim=True).clamp_min(1e-9)
    turn = point[:, 0] * normal[:, 1] - point[:, 1] * normal[:, 0]
    slope = torch.cat((rotated(normal, pose[:, 2]), rotated(normal, shifts[4]), turn[:, None]), -1)
    return gap - body.pusher.thickness, slope


def put_right(poses: Float[Tensor, "*b 3"], shifts: Float[Tensor, "*#b 5"]) -> Float[Tensor, "*b 3"]:
    """Poses of an object's outline, of those of its tracked frame."""
    place = poses[..., :2] + rotated(shifts[..., 2:4], poses[..., 2])
    return torch.cat((place, poses[..., 2:] + shifts[..., 4:]), -1)


def as_tracked(poses: Float[Tensor, "*b 3"], shifts: Float[Tensor, "*#b 5"]) -> Float[Tensor, "*b 3"]:
    """The inverse of `put_right`."""
    yaw = poses[..., 2:] - shifts[..., 4:]
    return torch.cat((poses[..., :2] - rotated(shifts[..., 2:4], yaw[..., 0]), yaw), -1)
