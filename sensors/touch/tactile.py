"""Tactile pads: contact points of a tool, and the free space that its body swept."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sdf import se3
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
    count, each = len(world_T_tool), len(body_points)
    device = world_T_tool.device
    attached_T_tool = world_T_tool if attached_T_world is None else attached_T_world @ world_T_tool
    places = se3.apply(attached_T_tool, body_points)
    low = torch.floor(region[0] / spacing)
    cells = torch.floor(places / spacing) - low
    shape = (torch.ceil(region[1] / spacing) - low).long().clamp_min(1)
    inside = ((cells >= 0) & (cells < shape)).all(-1)
    instant, index = inside.nonzero(as_tuple=True)
    x, y, z = cells[instant, index].long().unbind(-1)
    key = (x * shape[1] + y) * shape[2] + z
    groups = 1
    if group is not None:
        groups = int(group.max()) + 1 if count else 1
        key = key + group[instant] * shape.prod()
    # the order of `nonzero` is by instant, then by point: the least index of a cell is the first to come into it
    order = torch.arange(len(key), device=device)
    first = torch.full((int(shape.prod()) * groups,), count * each, dtype=torch.long, device=device)
    first.scatter_reduce_(0, key, order, "amin")
    chosen = first[first < count * each].sort().values
    instant, index = instant[chosen], index[chosen]
    return InstantPoints(_place(world_T_tool, body_points, instant, index), instant), index


def tactile_observation(touched: InstantPoints, free: InstantPoints) -> tuple[Observation, Int[Tensor, "M"]]:
    """Touched points as surface and swept ones as free, all attached to the object, and their instants."""
    observation = concatenate(
        [Observation.of(touched.points, Semantics.SURFACE), Observation.of(free.points, Semantics.FREE)]
    )
    return observation, torch.cat((touched.instant, free.instant))


def _place(transforms: Tensor, points: Tensor, instant: Tensor, index: Tensor) -> Float[Tensor, "M 3"]:
    own = transforms[instant]
    return (own[:, :3, :3] @ points[index][..., None])[..., 0] + own[:, :3, 3]
