"""Pushes of an object by particles that differ in how it slides and in how far it is from where it is tracked."""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rumi.dynamics.along_path import Pusher, contact_arrays, push_along_path
from rumi.dynamics.outline import GridOutline, RectangleOutline, Support
from rumi.dynamics.push_registration import as_tracked, put_right
from rumi.dynamics.pushed_body import PushedBody
from rumi.dynamics.sliding import Outline, Sliding, rotated
from sdf import backend, compiled
from sdf.check import check_finite, check_shape, is_eager

_PASSES = 2  # contacts that are settled in a part of the way, at most
_APART = 4  # points of a tool that begins in the object that are brought out of it, at most


class TrackedEnds(NamedTuple):
    """Where pushes end by each particle.

    Attributes:
        poses: (E, N, 3), (x, y, yaw) as tracked, metres and radians.
        way: (E, N), what the centre of mass goes, and the turn times the base's radius, metres.
    """

    poses: Float[Tensor, "E N 3"]
    way: Float[Tensor, "E N"]


def tracked_ends(
    start: Float[Tensor, "E 3"],
    path: Float[Tensor, "E K1 3"],
    shifts: Float[Tensor, "N 5"],
    sliding: Sliding,
    body: PushedBody,
    *,
    substeps: int = 1,
) -> TrackedEnds:
    """Push along paths by each particle (`push_along_path`), from poses that are put right by its shifts.

    An object in which the tool begins is not pushed there, but tracked wrong: it is first moved straight off the tool,
    by the depth.

    Args:
        start: poses as tracked.
        path: of the tool, as tracked.
        shifts: of tool and outline, `rumi.dynamics.push_registration.SHIFTS`.
        sliding: of each particle, with a quartic.
        body: object and tool.
        substeps: parts of the way from one instant to the next.

    Raises:
        ValueError: a shape does not fit, or a pose or the path is not finite.
    """
    check_shape("start", start, "(E, 3)", last=(3,))
    check_shape("path", path, "(E, K1, 3)", last=(3,))
    if is_eager():
        check_finite("start", start)
        check_finite("path", path)
    version = backend.dispatch(
        "tracked_ends", start, path, shifts, body.pusher.points, *(part for part in sliding if part is not None)
    )
    found: TrackedEnds = version(start, path, shifts, sliding, body, substeps)
    return found


@backend.register("tracked_ends")
def _tracked_ends(
    start: Tensor, path: Tensor, shifts: Tensor, sliding: Sliding, body: PushedBody, substeps: int
) -> TrackedEnds:
    pushes, count = len(start), len(shifts)
    shift = torch.cat((shifts[:, :2], torch.zeros_like(shifts[:, :1])), -1)
    # the object is moved in place of the tool: only where they are to each other matters
    whole = (put_right(start[:, None].expand(-1, count, -1), shifts) + shift).reshape(-1, 3)
    outline = body.outline.to(start)
    pusher, paths = Pusher(body.pusher.points.to(start), body.pusher.thickness), path.repeat_interleave(count, 0)
    whole = separated(whole, paths[:, 0], pusher, outline)
    track = push_along_path(
        whole,
        paths,
        pusher,
        outline,
        sliding.map(lambda part: part.repeat(pushes, *[1] * (part.ndim - 1))),
        substeps=substeps,
        passes=_PASSES,
        distances=False,
    ).track
    last = track[:, -1] if track.shape[1] else whole
    ends = as_tracked(last.view(pushes, count, 3) - shift, shifts)
    return TrackedEnds(ends, way_of(start[:, None], ends, body.support))


def separated(
    poses: Float[Tensor, "E 3"], tool: Float[Tensor, "E 3"], pusher: Pusher, outline: Outline
) -> Float[Tensor, "E 3"]:
    """Poses of objects moved off a tool that stands in them: along the normal by the depth, without a turn."""
    for _ in range(_APART):
        placed = tool[:, None, :2] + rotated(pusher.points, tool[:, None, 2])
        local = rotated(placed - poses[:, None, :2], -poses[:, None, 2])
        depth, index = (pusher.thickness - outline(local).distance).max(-1)
        gradient = outline(local[torch.arange(len(local)), index]).gradient
        inward = -rotated(gradient / gradient.norm(dim=-1, keepdim=True).clamp_min(1e-9), poses[:, 2])
        poses = torch.cat((poses[:, :2] + depth.clamp_min(0.0)[:, None] * inward, poses[:, 2:]), -1)
    return poses


def way_of(start: Float[Tensor, "*#b 3"], end: Float[Tensor, "*#b 3"], support: Support) -> Float[Tensor, "*b"]:
    """What the centre of mass goes from one pose to another, and the turn times the base's mean radius, metres."""
    centre = support.centre.to(start)
    before, after = (pose[..., :2] + rotated(centre, pose[..., 2]) for pose in (start, end))
    return (after - before).norm(dim=-1) + support.spread * (end[..., 2] - start[..., 2]).abs()


@backend.register("tracked_ends", "numba", compiled.supports)
def _tracked_ends_numba(
    start: Tensor, path: Tensor, shifts: Tensor, sliding: Sliding, body: PushedBody, substeps: int
) -> TrackedEnds:
    from rumi.dynamics.tracked_push_numba import tracked_ends as kernel

    if not isinstance(body.outline, GridOutline | RectangleOutline) or sliding.quartic is None:
        return _tracked_ends(start, path, shifts, sliding, body, substeps)
    ends, way = start.new_empty(len(start), len(shifts), 3), start.new_empty(len(start), len(shifts))
    slides = (sliding.centre, sliding.lever, sliding.friction, sliding.quartic)
    kernel(
        *(part.detach().contiguous().numpy() for part in (start, path.to(start.dtype), shifts.to(start.dtype))),
        contact_arrays(body.pusher, body.outline, (substeps, _PASSES, _APART), start.dtype),
        tuple(part.detach().to(start.dtype).contiguous().numpy() for part in slides),
        np.array((*body.support.centre.tolist(), body.support.spread)),
        ends.numpy(),
        way.numpy(),
    )
    return TrackedEnds(ends, way)
