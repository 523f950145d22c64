"""Tactile pads: contact points of a tool, and the free space that its body swept."""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sdf import backend, compiled, se3
from sdf.check import check_shape
from sensors.observation import Observation, concatenate
from sensors.semantics import Semantics


class InstantPoints(NamedTuple):
    """Points, each with its instant.

    Attributes:
        points: (M, 3), metres, world frame.
        instant: (M), index of each point's instant.
    """

    points: Float[Tensor, "M 3"]
    instant: Int[Tensor, "M"]


def touched_points(
    world_T_tool: Float[Tensor, "K 4 4"], pad_points: Float[Tensor, "n 3"], touched: Bool[Tensor, "K n"]
) -> InstantPoints:
    """World points of the pads where and when they felt the object.

    Args:
        world_T_tool: (K, 4, 4), the tool at each instant.
        pad_points: (n, 3), points on the pads, tool frame.
        touched: (K, n), which of them felt something.
    """
    check_shape("touched", touched, "(K, n)", last=(len(world_T_tool), len(pad_points)))
    instant, index = touched.nonzero(as_tuple=True)
    return InstantPoints(_place(world_T_tool, pad_points, instant, index), instant)


def swept_points(
    world_T_tool: Float[Tensor, "K 4 4"],
    body_points: Float[Tensor, "n 3"],
    spacing: float,
    *,
    attached_T_world: Float[Tensor, "K 4 4"] | None = None,
    group: Int[Tensor, "K"] | None = None,
    region: Float[Tensor, "2 3"],
) -> tuple[InstantPoints, Int[Tensor, "M"]]:
    """One point for each lattice cell that the tool's body went through: the first that came into it.

    Cells belong to the frame that rides with the object, as far as its motion is known: there, what was free stays
    free. Without a known motion, instants of different groups are kept apart.

    Args:
        world_T_tool: (K, 4, 4), the tool at each instant.
        body_points: (n, 3), points in the tool's volume, tool frame.
        spacing: of the lattice, metres.
        attached_T_world: (K, 4, 4), world to the object's frame at each instant; None where it stands still.
        group: (K), instants of one group share their cells; None for one group.
        region: (2, 3), box in the object's frame; cells outside are left out.

    Returns:
        the points and the index of each among `body_points`.
    """
    _check(world_T_tool, body_points, region)
    attached_T_tool = world_T_tool if attached_T_world is None else attached_T_world @ world_T_tool
    low = torch.floor(region[0] / spacing)
    shape = (torch.ceil(region[1] / spacing) - low).long().clamp_min(1)
    if group is None:
        group = torch.zeros(len(world_T_tool), dtype=torch.long, device=world_T_tool.device)
    version = backend.dispatch("first_in_cells", attached_T_tool, body_points, low)
    instant, index = version(attached_T_tool, body_points, spacing, low, shape, group)
    return InstantPoints(_place(world_T_tool, body_points, instant, index), instant), index


def points_in_box(
    box_T_tool: Float[Tensor, "K 4 4"], points: Float[Tensor, "n 3"], box: Float[Tensor, "2 3"]
) -> tuple[InstantPoints, Int[Tensor, "M"]]:
    """Points of a tool that are in a box, or on its border, and when.

    Args:
        box_T_tool: (K, 4, 4), the tool at each instant.
        points: (n, 3), tool frame.
        box: its lowest and its highest corner.

    Returns:
        their places in the box's frame, and the index of each among `points`; by instants, then by points.
    """
    _check(box_T_tool, points, box)
    version = backend.dispatch("points_in_box", box_T_tool, points, box)
    found: tuple[InstantPoints, Tensor] = version(box_T_tool, points, box)
    return found


def _check(frame_T_tool: Tensor, points: Tensor, box: Tensor) -> None:
    """Refuse what a compiled kernel would read beyond."""
    check_shape("poses of the tool", frame_T_tool, "(K, 4, 4)")
    check_shape("points of the tool", points, "(n, 3)")
    check_shape("box", box, "(2, 3)")


@backend.register("points_in_box")
def _points_in_box(box_T_tool: Tensor, points: Tensor, box: Tensor) -> tuple[InstantPoints, Tensor]:
    places = se3.apply(box_T_tool, points)
    instant, index = ((places >= box[0]) & (places <= box[1])).all(-1).nonzero(as_tuple=True)
    return InstantPoints(places[instant, index], instant), index


@backend.register("points_in_box", "numba", compiled.supports)
def _points_in_box_numba(box_T_tool: Tensor, points: Tensor, box: Tensor) -> tuple[InstantPoints, Tensor]:
    from sensors.touch.tactile_numba import points_in_box as kernel

    transforms, flat, ends = (part.detach().contiguous().numpy() for part in (box_T_tool, points, box))
    most = len(transforms) * len(flat)
    found, places, count = np.empty((2, most), np.int64), np.empty((most, 3), flat.dtype), np.zeros(1, np.int64)
    kernel(transforms, flat, ends, found, places, count)
    instant, index = torch.from_numpy(found[:, : int(count[0])].copy())
    return InstantPoints(torch.from_numpy(places[: int(count[0])].copy()), instant), index


@backend.register("first_in_cells")
def _first_in_cells(
    transforms: Float[Tensor, "K 4 4"],
    points: Float[Tensor, "n 3"],
    spacing: float,
    low: Float[Tensor, "3"],
    shape: Int[Tensor, "3"],
    group: Int[Tensor, "K"],
) -> tuple[Int[Tensor, "M"], Int[Tensor, "M"]]:
    """Instant and index of the first place in each cell of each group, in the order of instants, then of points."""
    places = se3.apply(transforms, points)
    count, each = places.shape[:2]
    cells = torch.floor(places / spacing) - low
    inside = ((cells >= 0) & (cells < shape)).all(-1)
    instant, index = inside.nonzero(as_tuple=True)
    x, y, z = cells[instant, index].long().unbind(-1)
    key = (x * shape[1] + y) * shape[2] + z + group[instant] * shape.prod()
    groups = int(group.max()) + 1 if count else 1
    # the order of `nonzero` is by instant, then by point: the least index of a cell is the first to come into it
    order = torch.arange(len(key), device=places.device)
    first = torch.full((int(shape.prod()) * groups,), count * each, dtype=torch.long, device=places.device)
    first.scatter_reduce_(0, key, order, "amin")
    chosen = first[first < count * each].sort().values
    return instant[chosen], index[chosen]


@backend.register("first_in_cells", "numba", compiled.supports)
def _first_in_cells_numba(
    transforms: Tensor, points: Tensor, spacing: float, low: Tensor, shape: Tensor, group: Tensor
) -> tuple[Tensor, Tensor]:
    """The same point by point, each cell marked as it is met."""
    from sensors.touch.tactile_numba import first_in_cells

    groups = int(group.max()) + 1 if len(group) else 1
    own, flat = (part.detach().contiguous().numpy() for part in (transforms, points))
    pitch, start = points.new_tensor(spacing).numpy(), low.detach().to(points).numpy()
    taken = np.zeros((groups, *shape.tolist()), np.bool_)
    found, count = np.empty((2, len(own) * len(flat)), np.int64), np.zeros(1, np.int64)
    first_in_cells(own, flat, pitch[()], start, group.numpy(), taken, found, count)
    instant, index = torch.from_numpy(found[:, : int(count[0])].copy())
    return instant, index


def tactile_observation(touched: InstantPoints, free: InstantPoints) -> tuple[Observation, Int[Tensor, "M"]]:
    """Touched points as surface and swept ones as free, all attached to the object, and their instants."""
    observation = concatenate(
        [Observation.of(touched.points, Semantics.SURFACE), Observation.of(free.points, Semantics.FREE)]
    )
    return observation, torch.cat((touched.instant, free.instant))


def _place(transforms: Tensor, points: Tensor, instant: Tensor, index: Tensor) -> Float[Tensor, "M 3"]:
    own = transforms[instant]
    return (own[:, :3, :3] @ points[index][..., None])[..., 0] + own[:, :3, 3]
