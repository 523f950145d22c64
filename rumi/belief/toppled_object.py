"""Object that slides and topples, and a level tool that moves in space, as trajectories need them."""

import functools
import math
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rumi.belief.pose_trajectories import Trajectories
from rumi.belief.systematic_errors import SystematicErrors
from rumi.belief.trajectory_history import History, Kind
from rumi.belief.trajectory_likelihood import replay_plain, tables
from rumi.belief.trajectory_settings import PoseTrajectorySettings
from rumi.dynamics.along_path import unwrapped
from rumi.dynamics.resting import RestingPoses
from rumi.dynamics.sliding import Sliding, rotated
from rumi.dynamics.tool_contact import GROUP
from rumi.dynamics.toppling import Leaning, push_in_space
from rumi.robot.border import bounding_balls
from rumi.robot.gripper import GripperShape
from sdf import backend, compiled, se3
from sdf.base import SDF
from sdf.symmetry import Symmetries

_UNFITTED, _WITH_CARE = 5.0, 3.5  # times the noise of motion in the plane, and of what is soon toppled
_UNSTEADY_RAD = 0.2  # of tilt about some edge, by which an object that falls over then is soon toppled


@dataclass(frozen=True, eq=False)
class ToppledObject:
    """Object that rests on the floor in one of some ways, and a tool in space; float64.

    A pose is (x, y, yaw, resting pose, edge it leans about, tilt), a tool's (x, y, yaw, z). Upright objects and a tool
    at one height are the plane, which `PushedObject` knows by an outline.

    Attributes:
        sdf: of the object.
        rests: its resting poses; the first are those that it may start in.
        ways: number of these.
        tool: (n, 3), points of the tool's surface, tool frame; GROUP at a time lie near each other.
        pads: (m, 3), points of its pads.
        reported: (m, 3), where what they feel is reported.
        reach_m: distance between tool and object, sideways, beyond which nothing is touched.
        wide: how much wider than the settings have it the noise of its motion is.
    """

    sdf: SDF
    rests: RestingPoses
    ways: int
    tool: Float[Tensor, "n 3"]
    pads: Float[Tensor, "m 3"]
    reported: Float[Tensor, "m 3"]
    reach_m: float
    wide: float
    resting_m: float = 0.0
    spread_m: float = 1.0
    replay: str = "replay_in_space"

    @classmethod
    def of(
        cls,
        sdf: SDF,
        shape: GripperShape,
        ways: Float[Tensor, "R 4 4"],
        symmetries: Symmetries,
        *,
        spacing_m: float,
        pad_spacing_m: float,
        felt_ahead_m: float = 0.0,
        wide: float | None = 1.0,
    ) -> Self:
        """For an object and a gripper.

        Args:
            sdf: of the object.
            shape: of the gripper.
            ways: poses above the world's origin in which the object may start.
            symmetries: rotations after which it looks the same.
            spacing_m: between the points of the tool's surface.
            pad_spacing_m: between the points of the pads.
            felt_ahead_m: distance in front of the pads at which felt points are reported.
            wide: how much wider than the settings have it the noise of its motion is; None for as much as is usual of
                such an object.
        """
        pads, tool = shape.pad_shell(pad_spacing_m).double(), shape.surface(spacing_m).double()
        reported = pads + felt_ahead_m * shape.pad_normals(pads)
        reach = _radius(sdf) + float(tool[:, :2].norm(dim=-1).max())
        rests = RestingPoses.of(sdf, ways, symmetries)
        found = cls(sdf, rests, len(ways), _grouped(tool), pads, reported, reach, _UNFITTED if wide is None else wide)
        return replace(found, wide=_WITH_CARE) if wide is None and found.unsteady else found

    def resized(self, factor: float) -> Self:
        """The same tool and an object in another size, of which distances are tabulated."""
        from sdf.grid_sdf import tabulated

        sdf, rests = tabulated(self.sdf).resized(factor), self.rests.resized(factor)
        reach_m = self.reach_m + (factor - 1.0) * _radius(self.sdf)
        return replace(self, sdf=sdf, rests=rests, reach_m=reach_m)

    @functools.cached_property
    def arrays(self) -> tuple[tuple[np.ndarray, ...], np.ndarray]:
        """Tool and a tabulated object's box as the compiled version takes them, float32.

        Points by coordinate, and extents of their groups by number; the box's corners.
        """
        from sdf.grid_sdf import tabulated

        tool = compiled.arrays_of(self.tool.T.float().flatten(), _extents(self.tool).float().flatten())
        return tool, tabulated(self.sdf).box_of().float().flatten().numpy()

    @property
    def extent_m(self) -> tuple[float, float, float]:
        """How far its surface is from its place sideways, and how low and how high, at most."""
        far = _radius(self.sdf)
        return far, 0.0, far + float(self.rests.height_m.max())

    @property
    def unsteady(self) -> bool:
        """Whether it is soon toppled, as it may stand at first."""
        return float(self.rests.edges.tip_rad[: self.ways].min()) < _UNSTEADY_RAD

    def world_T_object(self, poses: Float[Tensor, "*b 6"]) -> Float[Tensor, "*b 4 4"]:
        """Poses in space above the floor."""
        return self.rests.world_T_object(poses[..., :3].double(), poses[..., 3:].double()).to(poses)

    def heights_off(self, poses: Float[Tensor, "N 6"], worn_m: float, share: float) -> Float[Tensor, "N"]:
        """Draws of how much higher an object's origin is than its model's: even quantiles, in an order of their own.

        Args:
            poses: of objects.
            worn_m: deviation by what is worn off, metres.
            share: deviation by its size, as a share of the origin's height.
        """
        place = torch.randperm(len(poses), generator=torch.Generator().manual_seed(0)).double()
        wide = (share * self.rests.height_m[poses[:, 3].long()]).square() + worn_m**2
        return torch.special.ndtri((place + 0.5) / len(poses)) * wide.sqrt()

    def local(self, pose: Float[Tensor, "N 6"], points: Float[Tensor, "M 3"]) -> Float[Tensor, "N M 3"]:
        """Points in the frame of each pose."""
        return se3.apply(se3.inverse(self.world_T_object(pose)), points.expand(len(pose), -1, 3))

    def unsettled(self, poses: Float[Tensor, "N 6"], least_rad: float = 0.0) -> Bool[Tensor, "N"]:
        """Whether each leans on the tool, by at least an angle."""
        return (poses[:, 4] >= 0) & (poses[:, 5] >= least_rad)

    def lifted(self, tool_pose: Float[Tensor, "K 4 4"]) -> Bool[Tensor, "K"]:
        """Never: its path tells how high it is."""
        return torch.zeros(len(tool_pose), dtype=torch.bool)

    def middle(self, tool: Float[Tensor, "k 4"]) -> Float[Tensor, "k 3"] | None:
        """None: its tool is no rod."""
        return None

    def path(self, tool_pose: Float[Tensor, "K 4 4"]) -> Float[Tensor, "K 4"]:
        """(x, y, yaw, z) of the tool."""
        there = tool_pose.double()
        return torch.cat((unwrapped(se3.to_planar(there)), there[:, 2, 3:]), -1)

    def tracks(
        self, own: PoseTrajectorySettings, some: Float[Tensor, "n 6"], path: Float[Tensor, "K 2 4"]
    ) -> Float[Tensor, "n K 6"]:
        """Where poses go by the median of the prior."""
        instants = torch.arange(len(path))
        none, flat = torch.zeros_like(instants), some.new_zeros(len(path), 3)
        sensed = torch.eye(4).to(some).expand(len(path), 4, 4), flat[:, 0]
        told = History(path, none == 0, instants + 1, instants, flat[:0], none[:0], flat[:0, 0], none, flat, *sensed)
        first = torch.zeros(len(some), dtype=torch.long)
        return Trajectories.still(some, told).replayed(self, own, told, first).poses[:, 1:]

    def step(
        self,
        own: PoseTrajectorySettings,
        pose: Float[Tensor, "N 6"],
        before: Float[Tensor, "4"],
        after: Float[Tensor, "4"],
        body: Sliding,
        noise: Float[Tensor, "N 5"],
        errors: SystematicErrors | None = None,
    ) -> Float[Tensor, "N 6"]:
        """Poses after an instant's push, and the noise of it; `body.centre` holds standard normals (x, y, ahead)."""
        if errors is not None:
            raise ValueError("Expected no systematic errors in space: sensors are wider in their place")
        near = ((after[:2] - pose[:, :2]).norm(dim=-1) < self.reach_m) | (pose[:, 4] >= 0)
        near = near.nonzero()[:, 0]
        if not len(near):
            return pose
        start = pose[near]
        way = after[:2] - before[:2]
        direction = (way / way.norm().clamp_min(1e-12)).expand(len(near), 2)
        rest = start[:, 3].long()
        ahead = after[3] * (own.ahead[0] + own.ahead[1] * body.centre[near, 2])
        centre = self.rests.centre[rest] + own.centre_m * body.centre[near, :2]
        centre = centre + ahead[:, None] * rotated(direction, -start[:, 2])
        sliding = Sliding(centre, body.lever[near] * self.rests.spread_m[rest], body.friction[near])
        state = Leaning(start[:, :3], start[:, 3:])
        firm = (own.firm_change / self.wide * noise[near, 2]).exp()
        soft = own.soft[0] * (own.soft[1] / self.wide * noise[near, 1]).exp()
        grip = (own.grip[1] * (noise[near, 0] / self.wide - own.grip[0])).clamp(0.0, 1.0)
        done = push_in_space(self.sdf, self.rests, self.tool, state, before, after, sliding, firm, soft, grip)
        moved = done.state.planar
        step = moved - start[:, :3]
        length = step[:, :2].norm(dim=-1)
        size = length + own.m_per_rad * step[:, 2].abs()
        # what is pushed along slips as the tool moves it, up and down too
        tools_way = (after - before)[[0, 1, 3]].norm()
        size = size + own.slip * tools_way
        # a fall leaves it somewhere about where it would lie
        size = torch.where(done.fell, size.new_tensor(own.fall_m), size) * (done.slid | done.fell)
        # what leans on the tool slips about as the tool moves it, and as it slides itself
        size = torch.where(done.state.lying[:, 1] >= 0, length + own.lean * tools_way, size)
        along = torch.where((length[:, None] > 1e-9) & ~done.fell[:, None], step[:, :2], done.ahead)
        along = along / along.norm(dim=-1, keepdim=True).clamp_min(1e-9)
        across = torch.stack((-along[:, 1], along[:, 0]), -1)
        own_noise = noise[near, :3] * size[:, None] * noise.new_tensor((own.along, own.across, own.turn_rad_per_m))
        shift = own_noise[:, :1] * along + own_noise[:, 1:2] * across
        moved = moved + torch.cat((shift, own_noise[:, 2:]), -1)
        return pose.index_copy(0, near, torch.cat((moved, done.state.lying), -1))

    def told_by_force(
        self,
        own: PoseTrajectorySettings,
        physics: Float[Tensor, "N P"],
        poses: Float[Tensor, "N S1 6"],
        history: History,
    ) -> Float[Tensor, "N S"]:
        """Zero: an object that may lean or fall goes where its edges let it, not as friction alone has it."""
        return poses.new_zeros(len(poses), len(history))


backend.register("replay_in_space")(replay_plain)


@backend.register("replay_in_space", "numba", compiled.supports)
def _replay_numba(
    model: ToppledObject,
    own: PoseTrajectorySettings,
    history: History,
    given: Trajectories,
    first: Int[Tensor, "N"],
    least: Float[Tensor, "N"],
) -> tuple[Tensor, Tensor]:
    from sdf.grid_sdf import GridSDF

    shown = own.eye_m is not None and bool((history.kind == Kind.SEEN).any())  # the compiled version knows no camera
    if shown or not isinstance(model.sdf, GridSDF):
        return replay_plain(model, own, history, given, first, least)
    from rumi.belief.toppled_object_numba import replay as kernel
    from sdf.grid_numba import grid_arguments

    poses, logs = given.poses.clone(), given.log_likelihood.clone()
    rests, edges = model.rests, model.rests.edges
    prior, priced = tables(own)
    topples = own.fall_m, own.firm_change / model.wide, own.lean, own.soft[0], own.soft[1] / model.wide
    scales = torch.cat((prior, prior.new_tensor((*topples, *own.grip, own.missed, history.power, own.slip))))
    numbers = prior.new_tensor((model.reach_m, model.wide, float(model.tool[:, :2].norm(dim=-1).max())))
    done, sensed = history.arrays
    turned = rests.turn, rests.height_m, rests.centre, rests.spread_m
    kernel(
        compiled.arrays_of(first, least, poses, logs, given.physics, given.noise),
        done,
        sensed,
        *model.arrays,
        compiled.arrays_of(*turned, edges.point, edges.normal, edges.tip_rad, edges.next, edges.change),
        *compiled.arrays_of(numbers, scales, priced),
        grid_arguments(model.sdf, torch.float32),
    )
    return poses, logs


def _radius(sdf: SDF) -> float:
    """Greatest distance of an object's bounds from its origin."""
    return float(sdf.bounds.double().abs().amax(0).norm())


def _grouped(points: Float[Tensor, "n 3"]) -> Float[Tensor, "m 3"]:
    """Points in groups of so many that lie near each other, by halves along the longest side; the last is filled up."""
    if len(points) <= GROUP:
        return torch.cat((points, points[-1:].expand(GROUP - len(points), 3)))
    axis = int((points.amax(0) - points.amin(0)).argmax())
    ordered = points[points[:, axis].argsort(stable=True)]
    half = GROUP * math.ceil(len(points) / (2 * GROUP))
    return torch.cat((_grouped(ordered[:half]), _grouped(ordered[half:])))


def _extents(points: Float[Tensor, "m 3"]) -> Float[Tensor, "7 G"]:
    """Middle and half sides of a box about each group, and radius of a sphere about that middle."""
    groups = points.view(-1, GROUP, 3)
    middle, apart = bounding_balls(groups)
    return torch.cat((middle, groups.amax(1) - middle, apart[:, None]), -1).T
