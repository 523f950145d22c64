"""Upright object that a level tool pushes, as trajectories need it: quasi-static steps with noise of their own."""

import functools
import math
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rumi.belief.felt_force import directions_of, log_likelihood_of_forces
from rumi.belief.pose_trajectories import Trajectories
from rumi.belief.systematic_errors import NUMBERS, SystematicErrors
from rumi.belief.trajectory_history import History
from rumi.belief.trajectory_likelihood import facing_step_m, replay_plain, tables
from rumi.belief.trajectory_settings import PoseTrajectorySettings
from rumi.dynamics.along_path import Pusher, push_along_path, unwrapped
from rumi.dynamics.outline import GridOutline, support_of
from rumi.dynamics.sliding import Sliding, gathered, push, rotated
from rumi.robot.border import bounding_balls
from rumi.robot.tool_shape import ToolShape
from sdf import backend, compiled, se3
from sdf.base import SDF

_ROUND_M = 1e-4  # by which a circle may differ from one
_ABOVE_M = 1e-3  # that a lifted tool is above the object
_FEW = 16  # points of the tool's border, about, of which the nearest to an object is taken to touch it


def parts_of(before: Float[Tensor, "3"], after: Float[Tensor, "3"], radius_m: float, most_m: float) -> int:
    """In how many parts a tool's motion is taken, in each of which none of it goes farther; 1 where that is 0."""
    if most_m <= 0:
        return 1
    travel = float((after - before)[:2].norm()) + radius_m * abs(float(after[2] - before[2]))
    return max(1, math.ceil(travel / most_m - 1e-6))


@dataclass(frozen=True, eq=False)
class PushedObject:
    """Upright object and level tool, as trajectories need them; float64.

    Attributes:
        sdf: of the object.
        resting_m: height of its origin above the floor.
        outline: of the object at the tool's height.
        centre: (2,), below the centre of mass, object frame.
        spread_m: mean distance of what rests on the floor from there.
        tool: (n, 2), points of the tool's border, tool frame.
        pads: (m, 3), points of its pads, tool frame.
        height_m: of the tool above the floor.
        wide: how much wider than the settings have it the noise of its motion is.
        replay: name of the versions that replay its trajectories.
    """

    sdf: SDF
    resting_m: float
    outline: GridOutline
    centre: Float[Tensor, "2"]
    spread_m: float
    tool: Float[Tensor, "n 2"]
    pads: Float[Tensor, "m 3"]
    height_m: float
    wide: float = 1.0
    replay: str = "replay_trajectories"

    @classmethod
    def of(
        cls, sdf: SDF, shape: ToolShape, *, height_m: float, resting_m: float, spacing_m: float, pad_spacing_m: float
    ) -> Self:
        """For an object and a gripper.

        Args:
            sdf: of the object.
            shape: of the gripper.
            height_m: of the tool above the floor.
            resting_m: of the object's origin above the floor.
            spacing_m: between the points of the tool's border.
            pad_spacing_m: between the points of the pads.
        """
        support, like = support_of(sdf), torch.zeros((), dtype=torch.float64)
        outline = GridOutline.of_slice(sdf, height_m - resting_m).to(like)
        tool, pads = shape.outline(spacing_m).to(like), shape.pad_shell(pad_spacing_m).to(like)
        return cls(sdf, resting_m, outline, support.centre.to(like), support.spread, tool, pads, height_m)

    def resized(self, factor: float) -> Self:
        """The same tool and an object in another size, of which distances are tabulated."""
        from sdf.grid_sdf import tabulated

        sdf, resting_m = tabulated(self.sdf).resized(factor), factor * self.resting_m
        outline = GridOutline.of_slice(sdf, self.height_m - resting_m).to(self.centre)
        centre, spread_m = factor * self.centre, factor * self.spread_m
        return replace(self, sdf=sdf, resting_m=resting_m, outline=outline, centre=centre, spread_m=spread_m)

    @functools.cached_property
    def reach_m(self) -> float:
        """Distance from the tool's origin beyond which nothing is touched."""
        return self.radius_m + self.outline.radius

    @functools.cached_property
    def radius_m(self) -> float:
        """Greatest distance of the tool's border from its origin."""
        return float(self.tool.norm(dim=-1).max())

    @functools.cached_property
    def round_m(self) -> float | None:
        """Radius of the tool about its origin; None where its section is no circle."""
        radius = self.tool.norm(dim=-1)
        return float(radius.mean()) if float(radius.amax() - radius.amin()) < _ROUND_M else None

    @property
    def extent_m(self) -> tuple[float, float, float]:
        """How far its surface is from its place sideways, and how low and how high, at most."""
        low, high = self.sdf.bounds.double()
        return float(torch.stack((low[:2], high[:2])).abs().amax(0).norm()), float(low[2]), float(high[2])

    @property
    def reported(self) -> Float[Tensor, "m 3"]:
        """Where what the pads' points felt is reported, tool frame: at them."""
        return self.pads

    def world_T_object(self, poses: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 4 4"]:
        """Poses in space, heights counted from the object's origin."""
        return se3.from_planar(poses)

    def local(self, pose: Float[Tensor, "N 3"], points: Float[Tensor, "M 3"]) -> Float[Tensor, "N M 3"]:
        """Points in the frame of each pose."""
        local = rotated(points[:, :2] - pose[:, None, :2], -pose[:, None, 2])
        return torch.cat((local, points[:, 2:].expand(len(pose), -1, 1)), -1)

    def unsettled(self, poses: Float[Tensor, "N 3"], least_rad: float = 0.0) -> Bool[Tensor, "N"]:
        """Never: it stands upright."""
        return torch.zeros(len(poses), dtype=torch.bool)

    def lifted(self, tool_pose: Float[Tensor, "K 4 4"]) -> Bool[Tensor, "K"]:
        """Whether the tool's frame is above the object."""
        return tool_pose[:, 2, 3].double() > max(self.height_m, self.resting_m + self.extent_m[2]) + _ABOVE_M

    def middle(self, tool: Float[Tensor, "k 3"]) -> Float[Tensor, "k 3"] | None:
        """Points on the axis of a round tool at the height at which it pushes; None of another tool."""
        if self.round_m is None:
            return None
        height = torch.full_like(tool[:, :1], self.height_m - self.resting_m)
        return torch.cat((tool[:, :2], height), -1)

    def path(self, tool_pose: Float[Tensor, "K 4 4"]) -> Float[Tensor, "K 3"]:
        """What counts of the tool's poses: (x, y, yaw)."""
        return unwrapped(se3.to_planar(tool_pose.double()))

    def tracks(
        self, own: PoseTrajectorySettings, some: Float[Tensor, "n 3"], path: Float[Tensor, "K 2 3"]
    ) -> Float[Tensor, "n K 3"]:
        """Where poses go by the median of the prior, pressure staying where it is at rest."""
        like = some.new_tensor(self.spread_m * own.lever_ratio[0])
        sliding = Sliding(self.centre, like, some.new_tensor(own.friction[0]))
        whole = torch.cat((path[:1, 0], path[:, 1]))[None]
        parts = max(parts_of(before, after, self.radius_m, own.push_m) for before, after in path)
        return push_along_path(some, whole, Pusher(self.tool), self.outline, sliding, substeps=parts).track

    def step(
        self,
        own: PoseTrajectorySettings,
        pose: Float[Tensor, "N 3"],
        before: Float[Tensor, "3"],
        after: Float[Tensor, "3"],
        body: Sliding,
        noise: Float[Tensor, "N 5"],
        errors: SystematicErrors | None = None,
    ) -> Float[Tensor, "N 3"]:
        """Poses after an instant's push, and the noise of it; `body.centre` holds standard normals (x, y, ahead)."""
        tool = [each.expand(len(pose), 3) if errors is None else errors.tool(each) for each in (before, after)]
        parts, moved = parts_of(before, after, self.radius_m, own.push_m), pose
        for part in range(parts):
            start, end = (torch.lerp(tool[0], tool[1], share / parts) for share in (part, part + 1))
            moved = self._slid(own, moved, start, end, body, noise, errors)
        step = moved - pose
        length, turned = step[:, :2].norm(dim=-1), step[:, 2].abs()
        size = length + own.m_per_rad * turned + torch.where((length > 0) | (turned > 0), own.least_m, 0.0)
        way = torch.nn.functional.normalize(tool[1][:, :2] - tool[0][:, :2], dim=-1)
        along = torch.where(length[:, None] > 1e-9, step[:, :2] / length[:, None].clamp_min(1e-9), way)
        across = torch.stack((-along[:, 1], along[:, 0]), -1)
        own_noise = noise[:, :3] * size[:, None] * noise.new_tensor((own.along, own.across, own.turn_rad_per_m))
        shift = own_noise[:, :1] * along + own_noise[:, 1:2] * across
        return moved + torch.cat((shift, own_noise[:, 2:]), -1)

    def _slid(
        self,
        own: PoseTrajectorySettings,
        pose: Float[Tensor, "N 3"],
        before: Float[Tensor, "N 3"],
        after: Float[Tensor, "N 3"],
        body: Sliding,
        noise: Float[Tensor, "N 5"],
        errors: SystematicErrors | None,
    ) -> Float[Tensor, "N 3"]:
        """Poses after a small push by tools that each particle has where it has them, without the noise of it."""
        size = pose.new_ones(len(pose)) if errors is None else errors.size
        reach = self.radius_m + size * self.outline.radius
        near = ((after[:, :2] - pose[:, :2]).norm(dim=-1) < reach).nonzero()[:, 0]
        if not len(near):
            return pose
        start, before, after = pose[near], before[near], after[near]
        direction = rotated(torch.nn.functional.normalize(after[:, :2] - before[:, :2], dim=-1), -start[:, 2])
        share = own.ahead[0] + own.ahead[1] * body.centre[near, 2]
        centre = self.centre + own.centre_m * body.centre[near, :2] + own.centre_change_m * noise[near, 3:]
        ahead, lever, friction = self.height_m * share, body.lever[near], body.friction[near]
        if own.rim:
            placed = after[:, None, :2] + rotated(self.tool, after[:, None, 2])
            local = rotated(placed - start[:, None, :2], -start[:, None, 2])
            deepest = self.outline(local / size[near, None, None]).distance.argmin(-1)
            touched = local[torch.arange(len(near)), deepest]
            behind = ((centre - touched) * direction).sum(-1).clamp_min(0.0)
            goes = direction.norm(dim=-1) > 0.5  # what a turn of the tool alone pushes goes nowhere ahead
            shifted = gathered(share, self.height_m - friction * behind, lever)
            ahead, lever = torch.where(goes, shifted[0], ahead), torch.where(goes, shifted[1], lever)
        sliding = Sliding(centre + ahead[:, None] * direction, lever, friction)
        # the tool of a worn object may be that much thicker before it touches it
        thickness = start.new_zeros(len(near)) if errors is None else -errors.worn_m[near]
        moved, _ = push(
            start, before, after, self.tool, self.outline, sliding, thickness=thickness, size=size[near], passes=2
        )
        return pose.index_copy(0, near, moved)

    def told_by_force(
        self,
        own: PoseTrajectorySettings,
        physics: Float[Tensor, "N P"],
        poses: Float[Tensor, "N S1 3"],
        history: History,
    ) -> Float[Tensor, "N S"]:
        """Log-likelihood of the tool's force in each segment, up to a constant."""
        centre = self.centre + own.centre_m * physics[:, 2:4]
        share = (own.ahead[0] + own.ahead[1] * physics[:, 4])[:, None]
        ahead = self.height_m * share
        if own.rim:
            friction = own.friction[0] * (own.friction[1] * physics[:, :1]).exp()
            lever = self.spread_m * own.lever_ratio[0] * (own.lever_ratio[1] * physics[:, 1:2]).exp()
            arm = self.height_m - friction * self._behind(centre, poses[:, 1:], history)
            ahead, _ = gathered(share.expand_as(arm), arm, lever.expand_as(arm))
        return log_likelihood_of_forces(poses, centre, ahead, history, own)

    def _behind(
        self, centre: Float[Tensor, "N 2"], poses: Float[Tensor, "N S 3"], history: History
    ) -> Float[Tensor, "N S"]:
        """How far behind the centre of friction the tool is at the end of each segment, where it is nearest to it."""
        last = history.ends - 1
        tool, way = history.tool[last, 1], directions_of(history)
        border = tool[:, None, :2] + rotated(self.tool[:: max(1, len(self.tool) // _FEW)], tool[:, None, 2])
        middle = poses[..., :2] + rotated(centre[:, None].expand(*poses.shape[:-1], 2), poses[..., 2])
        off = middle[:, :, None] - border
        nearest = off.square().sum(-1).argmin(-1)
        there = off.gather(2, nearest[..., None, None].expand(*nearest.shape, 1, 2))[:, :, 0]
        return (there * way).sum(-1).clamp_min(0.0)

    @functools.cached_property
    def arrays(self) -> tuple[np.ndarray, ...]:
        """Tool, groups of its points that are neighbours, outline and numbers, as the compiled version takes them.

        Points by coordinate, the last one again until there are GROUP groups of GROUP points, or a multiple of them; of
        groups the centres of their points (x, y), and how far these are from it.
        """
        from rumi.belief.outline_depth_numba import GROUP

        more = -len(self.tool) % (GROUP * GROUP)
        tool = torch.cat((self.tool, self.tool[-1:].expand(more, 2)))
        centre, far = bounding_balls(tool.view(-1, GROUP, 2))
        groups = torch.cat((centre.T.flatten(), far))
        outline = self.outline
        place = (*outline.origin.tolist(), outline.spacing, self.reach_m, outline.radius, self.spread_m)
        numbers = self.tool.new_tensor((*place, *self.centre.tolist(), self.height_m, 1.0))
        return compiled.arrays_of(tool.T.flatten(), groups, outline.values, numbers)


@backend.register("replay_trajectories", "numba", compiled.supports)
def _replay_numba(
    model: PushedObject,
    own: PoseTrajectorySettings,
    history: History,
    given: Trajectories,
    first: Int[Tensor, "N"],
    least: Float[Tensor, "N"],
) -> tuple[Tensor, Tensor]:
    from sdf.grid_sdf import GridSDF

    if not isinstance(model.sdf, GridSDF):
        return replay_plain(model, own, history, given, first, least)
    from rumi.belief.pose_trajectories_numba import replay as kernel
    from sdf.grid_numba import grid_arguments

    poses, found = given.poses.clone(), given.log_likelihood.clone()
    scales, logs = tables(own)
    particles = compiled.arrays_of(first, least, poses, found, given.physics, given.noise)
    grid = grid_arguments(model.sdf, torch.float32)
    others = (own.centre_change_m, own.least_m, own.missed, history.power, bool(own.rim), own.push_m)
    scales = torch.cat((scales, scales.new_tensor((*others, facing_step_m(own), model.resting_m))))
    errors = SystematicErrors.of(own, given.systematic).table if own.systematic else scales.new_zeros(0, NUMBERS)
    eye = scales.new_zeros(0) if own.eye_m is None else scales.new_tensor(own.eye_m)
    if own.eye_m is not None:
        eye[2] -= model.resting_m
    kernel(particles, *history.arrays, model.arrays, scales.numpy(), logs.numpy(), errors.numpy(), eye.numpy(), grid)
    return poses, found
