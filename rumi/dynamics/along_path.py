"""Quasi-static pushing along tool paths: poses of objects after each instant, and the tool's distance from them."""

from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rumi.dynamics.outline import GridOutline, RectangleOutline, support_of
from rumi.dynamics.sliding import Outline, Sliding, push, rotated
from rumi.robot.tool_shape import ToolShape
from sdf import backend, compiled, se3
from sdf.base import SDF
from sdf.check import check_finite, check_shape, is_eager
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


class PathOutcome(NamedTuple):
    """Outcome of a tool path for E objects.

    Attributes:
        track: (E, K, 3), pose (x, y, yaw) after each instant.
        distance: (E, K), metres from the tool's border to the object then; 0 where they touch, or less by what depth
            a step has left; (E, 0) where nobody asked for it.
    """

    track: Float[Tensor, "E K 3"]
    distance: Float[Tensor, "E #K"]


@runtime_checkable
class PathPush(Protocol):
    """Pushes objects along tool paths: `push_along_path`, or another physics with its arguments."""

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
    ) -> PathOutcome:
        """Where objects are after each instant of a path; see `push_along_path`."""
        ...


def push_along_path(
    poses: Float[Tensor, "E 3"],
    path: Float[Tensor, "#E K1 3"],
    pusher: Pusher,
    outline: Outline,
    sliding: Sliding,
    *,
    substeps: int = 2,
    passes: int = 2,
    distances: bool = True,
) -> PathOutcome:
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
        distances: whether they are asked for, which takes as long as a part.

    Raises:
        ValueError: a shape does not fit, or a pose or the path is not finite.
    """
    check_shape("poses", poses, "(E, 3)", last=(3,))
    check_shape("path", path, "(#E, K1, 3)", last=(3,))
    if is_eager():
        check_finite("poses", poses)
        check_finite("path", path)
    sliding = sliding.expand(len(poses))
    version = backend.dispatch(
        "push_along_path", poses, path, pusher.points, *(part for part in sliding if part is not None)
    )
    found: PathOutcome = version(poses, path, pusher, outline, sliding, substeps, passes, distances)
    return found


def displace_along_path(
    poses: Float[Tensor, "E 3"],
    path: Float[Tensor, "#E K1 3"],
    pusher: Pusher,
    outline: Outline,
    sliding: Sliding,
    *,
    substeps: int = 2,
    passes: int = 2,
) -> PathOutcome:
    """The displacement model: what is touched goes with the point that touches it, and never turns.

    It is the limit of `push_along_path` in which turning is resisted without end and the contact never slips.
    """
    stiff = Sliding(sliding.centre, torch.full_like(sliding.lever, 1e3), torch.full_like(sliding.friction, 1e3))
    return push_along_path(poses, path, pusher, outline, stiff, substeps=substeps, passes=passes)


@backend.register("push_along_path")
def _push_along_path(
    poses: Tensor,
    path: Tensor,
    pusher: Pusher,
    outline: Outline,
    sliding: Sliding,
    substeps: int,
    passes: int,
    distances: bool,
) -> PathOutcome:
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
        if distances:
            distance.append(distance_to(now, path[:, instant + 1], pusher, outline))
    none = poses.new_zeros(len(poses), 0)
    if not track:
        return PathOutcome(none[..., None].expand(-1, -1, 3), none)
    return PathOutcome(torch.stack(track, 1), torch.stack(distance, 1) if distances else none)


@dataclass(frozen=True)
class PathMotion:
    """Motion of an upright object under a planar push model, along the path that a level tool reports.

    Attributes:
        outline: of the object at the tool's height.
        pusher: the tool.
        sliding: how the object slides.
        push: the model.
        substeps: parts of the way from one instant to the next.
    """

    outline: GridOutline
    pusher: Pusher
    sliding: Sliding
    push: PathPush
    substeps: int = 1

    @classmethod
    def of(
        cls,
        sdf: SDF,
        height_m: float,
        shape: ToolShape,
        push: PathPush,
        *,
        spacing_m: float,
        lever_ratio: float = 1.0,
        friction: float = 1.0,
    ) -> "PathMotion":
        """For an object and a gripper.

        Args:
            sdf: of the object.
            height_m: of the tool, object frame.
            shape: of the tool.
            push: the model.
            spacing_m: between the points of the gripper's border.
            lever_ratio: c of the limit surface over the mean distance of the object's base from its centre.
            friction: coefficient between tool and object.
        """
        support = support_of(sdf)
        like = support.centre
        sliding = Sliding(like, like.new_tensor(lever_ratio * support.spread), like.new_tensor(friction))
        return cls(GridOutline.of_slice(sdf, height_m), Pusher(shape.outline(spacing_m).to(like)), sliding, push)

    @torch.no_grad()
    def __call__(self, start: Float[Tensor, "E 3"], tool: Float[Tensor, "E K 3"]) -> Float[Tensor, "E K 4 4"]:
        """World motion of objects from their start poses (x, y, yaw) up to each instant of a tool's path."""
        # the way to the first instant is not reported: what depth it left is worked off on the spot
        path = torch.cat((tool[:, :1], tool), 1)
        outcome = self.push(
            start,
            unwrapped(path),
            Pusher(self.pusher.points.to(start), self.pusher.thickness),
            self.outline.to(start),
            self.sliding.to(start),
            substeps=self.substeps,
        )
        return se3.from_planar(outcome.track) @ se3.inverse(se3.from_planar(start))[:, None]


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


@backend.register("push_along_path", "numba", compiled.supports)
def _push_along_path_numba(
    poses: Tensor,
    path: Tensor,
    pusher: Pusher,
    outline: Outline,
    sliding: Sliding,
    substeps: int,
    passes: int,
    distances: bool,
) -> PathOutcome:
    from rumi.dynamics.along_path_numba import push_along_path as kernel

    if not isinstance(outline, GridOutline | RectangleOutline):
        return _push_along_path(poses, path, pusher, outline, sliding, substeps, passes, distances)
    count, instants = len(poses), path.shape[1] - 1
    track, distance = poses.new_empty(count, instants, 3), poses.new_empty(count, instants if distances else 0)
    quartic = poses.new_zeros(count, 5) if sliding.quartic is None else sliding.quartic
    slides = tuple(part.detach().contiguous().numpy() for part in (*sliding[:3], quartic))
    contact = contact_arrays(pusher, outline, (substeps, passes))
    given = (part.detach().contiguous().numpy() for part in (poses, path))
    kernel(*given, contact, slides, track.numpy(), distance.numpy())
    return PathOutcome(track, distance)


def contact_arrays(
    pusher: Pusher, outline: GridOutline | RectangleOutline, counts: tuple[int, ...], dtype: torch.dtype | None = None
) -> tuple[Any, ...]:
    """Tool and outline as the compiled versions take them: the tool's points, the outline's table and shape, sizes.

    And counts: parts of a way, contacts that are settled in a part, and what else a kernel counts. Without a type,
    points and table keep theirs.
    """
    table, shape = outline_table(outline, pusher.points)
    parts = (pusher.points, table)
    points, values = (part.detach().to(dtype or part.dtype).contiguous().numpy() for part in parts)
    sizes = np.array((pusher.thickness, pusher.radius + outline.radius))
    return points, values, np.array(shape), sizes, np.array(counts)


def outline_table(
    outline: GridOutline | RectangleOutline, like: Tensor
) -> tuple[Float[Tensor, "X Y"], tuple[float, float, float, float, float]]:
    """An outline as the compiled versions take it: distances, and whether it is a rectangle, with halves or lattice.

    The last number is by how much distances outside change a metre, at most.
    """
    if isinstance(outline, RectangleOutline):
        return like.new_zeros(1, 1), (1.0, *outline.half, 0.0, 1.0)
    return outline.values, (0.0, *outline.origin.tolist(), outline.spacing, outline.steepness)
