"""Particles carried along one tool path: where each is after every instant, and how far the tool then is from it."""

from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rumi.dynamics.outline import GridOutline, RectangleOutline
from rumi.dynamics.sliding import Outline, Sliding, push, rotated
from sdf import backend
from sdf import compiled as fused
from sdf.check import check_finite, check_shape, may_look
from sdf.so3 import wrap


class Pusher(NamedTuple):
    """A planar tool that pushes.

    Attributes:
        points: (n, 2), of its border, tool frame, metres.
        thickness: radius of a disc about every point, metres; one point with a radius is a round finger.
    """

    points: Float[Tensor, "n 2"]
    thickness: float = 0.0

    @property
    def radius(self) -> float:
        """Greatest distance of the tool's border from its frame's origin, metres."""
        return float(self.points.norm(dim=-1).max()) + self.thickness

    @staticmethod
    def disc(radius: float, like: Tensor) -> "Pusher":
        """A round finger."""
        return Pusher(like.new_zeros(1, 2), radius)


class Carried(NamedTuple):
    """What a tool path did to E objects.

    Attributes:
        track: (E, K, 3), pose (x, y, yaw) after each instant.
        distance: (E, K), metres from the tool's border to the object then; 0 where they touch, or less by what depth
            a step has left.
    """

    track: Float[Tensor, "E K 3"]
    distance: Float[Tensor, "E K"]


@runtime_checkable
class Carrier(Protocol):
    """Says what a tool path does to objects: `carry`, or another physics with its arguments."""

    def __call__(
        self,
        poses: Float[Tensor, "E 3"],
        path: Float[Tensor, "#E K1 3"],
        pusher: Pusher,
        outline: Outline,
        sliding: Sliding,
        *,
        substeps: int = 2,
        passes: int = 2,
    ) -> Carried:
        """Where objects are after each instant of a path; see `carry`."""
        ...


def carry(
    poses: Float[Tensor, "E 3"],
    path: Float[Tensor, "#E K1 3"],
    pusher: Pusher,
    outline: Outline,
    sliding: Sliding,
    *,
    substeps: int = 2,
    passes: int = 2,
) -> Carried:
    """Push objects along tool paths, quasi-statically (`sliding.push` has the mechanics).

    Skipped, with the same poses: motions in which the tool is too far off to touch.

    Args:
        poses: (x, y, yaw) of each object, metres and radians.
        path: (x, y, yaw) of the tool at K + 1 instants, the present first; for each object, or one for all. A jump of
            the yaw by a whole turn is a whole turn of the tool: see `unwrapped`.
        pusher: the tool.
        outline: of the objects.
        sliding: of each object.
        substeps: equal parts of the way from one instant to the next.
        passes: contacts that are settled in a part, at most.

    Raises:
        ValueError: a shape does not fit, or a pose or the path is not finite.
    """
    check_shape("poses", poses, "(E, 3)", last=(3,))
    check_shape("path", path, "(#E, K1, 3)", last=(3,))
    if may_look():
        check_finite("poses", poses)
        check_finite("path", path)
    sliding = sliding.expand(len(poses))
    version = backend.dispatch("carry", poses, path, pusher.points, *sliding)
    found: Carried = version(poses, path, pusher, outline, sliding, substeps, passes)
    return found


def carry_along(
    poses: Float[Tensor, "E 3"],
    path: Float[Tensor, "#E K1 3"],
    pusher: Pusher,
    outline: Outline,
    sliding: Sliding,
    *,
    substeps: int = 2,
    passes: int = 2,
) -> Carried:
    """The displacement model: what is touched goes with the point that touches it, and never turns.

    It is the limit of `carry` in which turning is resisted without end and the contact never slips.
    """
    stiff = Sliding(sliding.centre, torch.full_like(sliding.lever, 1e3), torch.full_like(sliding.friction, 1e3))
    return carry(poses, path, pusher, outline, stiff, substeps=substeps, passes=passes)


@backend.register("carry")
def _carry(
    poses: Tensor, path: Tensor, pusher: Pusher, outline: Outline, sliding: Sliding, substeps: int, passes: int
) -> Carried:
    path = path.expand(len(poses), *path.shape[1:])
    reach, now = pusher.radius + outline.radius, poses
    track, distance = [], []
    for instant in range(path.shape[1] - 1):
        begin, way = path[:, instant], path[:, instant + 1] - path[:, instant]
        for part in range(substeps):
            before, after = begin + (part / substeps) * way, begin + ((part + 1) / substeps) * way
            near = ((after - now)[:, :2].norm(dim=-1) < reach).nonzero()[:, 0]
            if len(near):
                pushed, _ = push(
                    now[near],
                    before[near],
                    after[near],
                    pusher.points,
                    outline,
                    sliding.at(near),
                    thickness=pusher.thickness,
                    passes=passes,
                )
                now = now.index_copy(0, near, pushed)
        track.append(now)
        distance.append(distance_to(now, path[:, instant + 1], pusher, outline))
    if not track:
        return Carried(poses.new_zeros(len(poses), 0, 3), poses.new_zeros(len(poses), 0))
    return Carried(torch.stack(track, 1), torch.stack(distance, 1))


def distance_to(
    poses: Float[Tensor, "E 3"], tool: Float[Tensor, "#E 3"], pusher: Pusher, outline: Outline
) -> Float[Tensor, "E"]:
    """Distance of a tool's border from objects, metres."""
    placed = tool[:, None, :2] + rotated(pusher.points, tool[:, None, 2])
    local = rotated(placed - poses[:, None, :2], -poses[:, None, 2])
    return outline(local).distance.amin(-1) - pusher.thickness


def unwrapped(path: Float[Tensor, "*b T 3"]) -> Float[Tensor, "*b T 3"]:
    """The same path without jumps of the yaw from pi to -pi."""
    yaw = path[..., 2]
    step = wrap(yaw[..., 1:] - yaw[..., :-1])
    whole = torch.cat((yaw[..., :1], yaw[..., :1] + step.cumsum(-1)), -1)
    return torch.cat((path[..., :2], whole[..., None]), -1)


@backend.register("carry", "numba", fused.supports)
def _carry_numba(
    poses: Tensor, path: Tensor, pusher: Pusher, outline: Outline, sliding: Sliding, substeps: int, passes: int
) -> Carried:
    from rumi.dynamics.along_path_numba import carry as kernel

    if not isinstance(outline, GridOutline | RectangleOutline):
        return _carry(poses, path, pusher, outline, sliding, substeps, passes)
    count, instants = len(poses), path.shape[1] - 1
    track, distance = poses.new_empty(count, instants, 3), poses.new_empty(count, instants)
    if isinstance(outline, RectangleOutline):
        table, shape = poses.new_zeros(1, 1), (1.0, *outline.half, 0.0)
    else:
        table, shape = outline.values, (0.0, *outline.origin.tolist(), outline.spacing)
    kernel(
        *(part.detach().contiguous().numpy() for part in (poses, path, pusher.points, table, *sliding)),
        np.array(shape),
        np.array((pusher.thickness, pusher.radius + outline.radius)),
        np.array((substeps, passes)),
        track.numpy(),
        distance.numpy(),
    )
    return Carried(track, distance)
