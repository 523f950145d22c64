"""Readings of a tool that feels where it touches: felt points are surface, what its body swept through is free."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sdf import se3
from sensors.observation import Observation
from sensors.reading import Reading
from sensors.touch.tactile import InstantPoints, swept_points, tactile_observation


class TouchReadings:
    """Makes the readings of a run, one an action, from the tool's poses and what was felt at each.

    A felt point is one of the object's surface: of a pad that is hard, the pad's own; of one that feels at a distance,
    the middle of the layer in which the surface then is. While nothing measures how the object moves, what was free
    before a touch is kept apart from what was after it; of an instant that touched without knowing where, nothing is
    taken to be free.

    Args:
        body: (n, 3), points in the tool's volume, tool frame, metres: `ToolShape.solid`.
        region: (2, 3), lower and upper corner of a box that holds the object; free points outside are left out.
        spacing_m: of the lattice on which free points are reported.
        clear_m: the body is free but for what is this near to a felt point of its instant.
        spatial: the tool moves in space: configurations are (x, y, z, yaw), else (x, y, yaw).
    """

    def __init__(
        self,
        body: Float[Tensor, "n 3"],
        region: Float[Tensor, "2 3"],
        *,
        spacing_m: float = 0.005,
        clear_m: float = 0.01,
        spatial: bool = False,
    ) -> None:
        self._body, self._region = body.float(), region.float()
        self._spacing, self._clear, self._spatial = spacing_m, clear_m, spatial
        self._attached = se3.identity()

    def first(self, view: Observation, tool_pose: Float[Tensor, "4 4"], stamp: float = 0.0) -> Reading:
        """The reading before the first action: what a camera saw, or nothing; a run begins.

        Args:
            view: surface and free points, world frame.
            tool_pose: world_T_tool.
            stamp: seconds.
        """
        self._attached = se3.identity()
        poses, still = tool_pose.float()[None], torch.zeros(1, dtype=torch.bool)
        instant = torch.zeros(len(view), dtype=torch.long)
        return Reading(view, instant, poses, still, se3.identity((1,)), self._at(poses[0]), torch.zeros(()), stamp)

    def reading(
        self,
        tool_pose: Float[Tensor, "K 4 4"],
        felt: Sequence[Float[Tensor, "_ 3"] | None],
        object_motion: Float[Tensor, "K 4 4"] | None = None,
        *,
        clipped_m: float = 0.0,
        stamp: float = 0.0,
    ) -> Reading:
        """The reading of one action.

        Args:
            tool_pose: world_T_tool at each of K instants, from the measured joints.
            felt: world points where the tool felt the object then, none for no touch; None where it touched and
                nothing tells where.
            object_motion: how far the object had moved from the start of the action up to each instant, world frame;
                None where nothing measures it.
            clipped_m: metres of the commanded translation that the arm refused.
            stamp: seconds since the start of the run.
        """
        poses = tool_pose.float()
        in_contact = torch.tensor([points is None or len(points) > 0 for points in felt])
        known = [torch.zeros(0, 3) if points is None else points.float() for points in felt]
        counts = torch.tensor([len(points) for points in known])
        touched = InstantPoints(torch.cat(known), torch.arange(len(felt)).repeat_interleave(counts))
        attached_T_world = None
        if object_motion is not None:
            object_motion = object_motion.float()
            attached_T_world = se3.inverse(object_motion @ self._attached)
            self._attached = object_motion[-1] @ self._attached
        free = swept_clear(
            poses, self._body, in_contact, touched, self._region, self._spacing, self._clear, attached_T_world
        )
        observation, instant = tactile_observation(touched, free)
        at, clipped = self._at(poses[-1]), torch.tensor(clipped_m)
        return Reading(observation, instant, poses, in_contact, object_motion, at, clipped, stamp)

    def _at(self, pose: Float[Tensor, "4 4"]) -> Float[Tensor, "Q"]:
        x, y, z = pose[:3, 3].tolist()
        yaw = math.atan2(float(pose[1, 0]), float(pose[0, 0]))
        return torch.tensor((x, y, z, yaw) if self._spatial else (x, y, yaw))


def swept_clear(
    tool_pose: Float[Tensor, "K 4 4"],
    body: Float[Tensor, "n 3"],
    in_contact: Bool[Tensor, "K"],
    touched: InstantPoints,
    region: Float[Tensor, "2 3"],
    spacing_m: float,
    clear_m: float,
    attached_T_world: Float[Tensor, "K 4 4"] | None = None,
) -> InstantPoints:
    """The space that a tool's body went through, but for what is near to where it touches.

    Nothing moves while nothing is touched: where the motion is not measured, what was swept while touching belongs to
    its instant alone.

    Args:
        tool_pose: world_T_tool at each instant.
        body: points in the tool's volume, tool frame.
        in_contact: whether it touched then.
        touched: where.
        region: box in the object's frame; points outside are left out.
        spacing_m: of the lattice of points.
        clear_m: what is this near to a point touched at its instant is not known to be free; nothing is at an instant
            that touched where nobody knows.
        attached_T_world: world to the frame that rides with the object at each instant; None where nobody knows.
    """
    group = in_contact.long().cumsum(0) if attached_T_world is None else None
    swept, _ = swept_points(tool_pose, body, spacing_m, attached_T_world=attached_T_world, group=group, region=region)
    keep = torch.ones(len(swept.points), dtype=torch.bool)
    for k in in_contact.nonzero()[:, 0].tolist():
        own, near = (swept.instant == k).nonzero()[:, 0], touched.points[touched.instant == k]
        if len(near) == 0:
            keep[own] = False  # touched, but nobody knows where
        elif len(own):
            keep[own] = torch.cdist(swept.points[own], near).amin(-1) > clear_m
    return InstantPoints(swept.points[keep], swept.instant[keep])
