"""Trajectories of an upright object that a level tool pushes: motion prior, likelihood of what was sensed, replay."""

import functools
import math
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rumi.belief.felt_force import log_likelihood_of_forces
from rumi.belief.particles import PoseBelief
from rumi.belief.pushed_model import Pushed
from rumi.belief.trajectory_history import NODES, History, Kind, arrays_of
from rumi.belief.trajectory_settings import PoseTrajectorySettings
from rumi.dynamics.along_path import Pusher, push_along_path, unwrapped
from rumi.dynamics.outline import GridOutline, support_of
from rumi.dynamics.sliding import Sliding, push, rotated
from rumi.errors import UsageError
from rumi.robot.tool_shape import ToolShape
from sdf import backend, compiled, se3
from sdf.base import SDF

PHYSICS, NOISE, OWN = 5, 11, 5
"""Standard normals of a particle, of a segment, and those of a segment that its action does not share."""


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

    @functools.cached_property
    def reach_m(self) -> float:
        """Distance from the tool's origin beyond which nothing is touched."""
        return float(self.tool.norm(dim=-1).max()) + self.outline.radius

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

    def unsettled(self, poses: Float[Tensor, "N 3"]) -> Bool[Tensor, "N"]:
        """Never: it stands upright."""
        return torch.zeros(len(poses), dtype=torch.bool)

    def path(self, tool_pose: Float[Tensor, "K 4 4"]) -> Float[Tensor, "K 3"]:
        """What counts of the tool's poses: (x, y, yaw)."""
        return unwrapped(se3.to_planar(tool_pose.double()))

    def tracks(
        self, own: PoseTrajectorySettings, some: Float[Tensor, "n 3"], path: Float[Tensor, "K 2 3"]
    ) -> Float[Tensor, "n K 3"]:
        """Where poses go by the median of the prior."""
        like = some.new_tensor(self.spread_m * own.lever_ratio[0])
        sliding = Sliding(self.centre, like, some.new_tensor(own.friction[0]))
        whole = torch.cat((path[:1, 0], path[:, 1]))[None]
        return push_along_path(some, whole, Pusher(self.tool), self.outline, sliding, substeps=1).track

    def step(
        self,
        own: PoseTrajectorySettings,
        pose: Float[Tensor, "N 3"],
        before: Float[Tensor, "3"],
        after: Float[Tensor, "3"],
        body: Sliding,
        noise: Float[Tensor, "N 5"],
    ) -> Float[Tensor, "N 3"]:
        """Poses after an instant's push, and the noise of it; `body.centre` holds standard normals (x, y, ahead)."""
        near = ((after[:2] - pose[:, :2]).norm(dim=-1) < self.reach_m).nonzero()[:, 0]
        if not len(near):
            return pose
        start, many = pose[near], len(near)
        way = after[:2] - before[:2]
        direction = way / way.norm().clamp_min(1e-12)
        ahead = self.height_m * (own.ahead[0] + own.ahead[1] * body.centre[near, 2])
        centre = self.centre + own.centre_m * body.centre[near, :2] + own.centre_change_m * noise[near, 3:]
        centre = centre + ahead[:, None] * rotated(direction.expand(many, 2), -start[:, 2])
        sliding = Sliding(centre, body.lever[near], body.friction[near])
        both = before.expand(many, 3), after.expand(many, 3)
        moved, _ = push(start, *both, self.tool, self.outline, sliding, passes=2)
        step = moved - start
        length = step[:, :2].norm(dim=-1)
        size = length + own.m_per_rad * step[:, 2].abs()
        along = torch.where(length[:, None] > 1e-9, step[:, :2] / length[:, None].clamp_min(1e-9), direction)
        across = torch.stack((-along[:, 1], along[:, 0]), -1)
        own_noise = noise[near, :3] * size[:, None] * noise.new_tensor((own.along, own.across, own.turn_rad_per_m))
        shift = own_noise[:, :1] * along + own_noise[:, 1:2] * across
        return pose.index_copy(0, near, moved + torch.cat((shift, own_noise[:, 2:]), -1))

    @functools.cached_property
    def arrays(self) -> tuple[np.ndarray, ...]:
        """Tool, groups of its points that are neighbours, outline and numbers, as the compiled version takes them.

        A group is the centre of its points (x, y), how far they are from it, and the first of them and the one behind.
        """
        groups = []
        for first in range(0, len(self.tool), _GROUP):
            some = self.tool[first : first + _GROUP]
            centre = 0.5 * (some.amin(0) + some.amax(0))
            far = float((some - centre).norm(dim=-1).max())
            groups.append((*centre.tolist(), far, first, first + len(some)))
        outline = self.outline
        place = (*outline.origin.tolist(), outline.spacing, self.reach_m, outline.radius, self.spread_m)
        numbers = self.tool.new_tensor((*place, *self.centre.tolist(), self.height_m))
        return arrays_of((self.tool, self.tool.new_tensor(groups), outline.values, numbers))


@dataclass(frozen=True, eq=False)
class Trajectories:
    """N particles, each with a history of its own; float64.

    Attributes:
        physics: (N, 5) standard normals: log-friction, log-lever, centre of friction (x, y), pressure ahead.
        noise: (N, S, 11) standard normals of each segment: log-friction, log-lever, motion along, across and turn;
            and for the whole action, of which its first segment's count, the last three once more, the size of all
            these, and the shift (x, y) of the centre of friction.
        poses: (N, S + 1, 3), (x, y, yaw) before the first segment and after each; in space (N, S + 1, 6), with the
            resting pose, the edge that it leans about, and the tilt (`rumi.dynamics.toppling.Leaning`).
        log_likelihood: (N, S), of each segment's readings.
        history: what was done and sensed.
        starts: (Q, 3 or 6), poses that the first view leaves open, about evenly likely; proposals are drawn about them.
        anywhere: whether start poses are even, whatever was known of them at first: they are where a jump led.
        log_evidence: estimate of the log marginal likelihood of the readings since the start, in the plane.
        forgotten: segments before the history's first.
    """

    physics: Float[Tensor, "N 5"]
    noise: Float[Tensor, "N S 11"]
    poses: Float[Tensor, "N S1 D"]
    log_likelihood: Float[Tensor, "N S"]
    history: History
    starts: Float[Tensor, "Q D"]
    anywhere: bool = False
    log_evidence: float = 0.0
    forgotten: int = 0

    def __len__(self) -> int:
        """Number of particles."""
        return len(self.physics)

    @property
    def pose(self) -> Float[Tensor, "N D"]:
        """Where each particle is now."""
        return self.poses[:, -1]

    def at(self, rows: Tensor) -> Self:
        """Some particles."""
        return self._with([getattr(self, name)[rows] for name in _PARTS])

    def put(self, rows: Int[Tensor, "R"], other: Self) -> Self:
        """The same with another's particles in some rows."""
        return self._with([getattr(self, name).index_copy(0, rows, getattr(other, name)) for name in _PARTS])

    def where(self, accept: Bool[Tensor, "N"], other: Self) -> Self:
        """Another's particles where accepted, else one's own."""
        wide = accept[:, None]
        masks = wide, wide[..., None], wide[..., None], wide
        pairs = ((getattr(other, name), getattr(self, name)) for name in _PARTS)
        return self._with([torch.where(mask, *pair) for mask, pair in zip(masks, pairs, strict=True)])

    def _with(self, parts: list[Tensor]) -> Self:
        physics, noise, poses, log_likelihood = parts
        return replace(self, physics=physics, noise=noise, poses=poses, log_likelihood=log_likelihood)

    def lengthened(self, noise: Float[Tensor, "N 1 11"], history: History) -> Self:
        """With one more segment, which is not replayed yet."""
        return replace(
            self,
            noise=torch.cat((self.noise, noise), 1),
            poses=torch.cat((self.poses, self.poses[:, -1:]), 1),
            log_likelihood=torch.cat((self.log_likelihood, self.log_likelihood.new_zeros(len(self), 1)), 1),
            history=history,
        )

    def remembered(self, most: int) -> Self:
        """The same without the older half of a history of more segments, cut where an action begins."""
        begins = (self.history.action == torch.arange(len(self.history))).nonzero()[:, 0]
        begins = begins[begins >= len(self.history) - max(1, most // 2)]
        if len(self.history) <= most or not len(begins):
            return self
        at = int(begins[0])
        return replace(
            self,
            noise=self.noise[:, at:],
            poses=self.poses[:, at:],
            log_likelihood=self.log_likelihood[:, at:],
            history=self.history.since(at),
            starts=self.starts[:0],
            forgotten=self.forgotten + at,
        )

    def log_prior(self) -> Float[Tensor, "N"]:
        """Log-density of physics and noise, up to a constant; start poses are even."""
        return -0.5 * (self.physics.square().sum(-1) + self.noise.square().sum((-2, -1)))

    def replayed(
        self,
        model: Pushed,
        settings: PoseTrajectorySettings,
        history: History,
        first: Int[Tensor, "N"],
        least: Float[Tensor, "N"] | None = None,
    ) -> Self:
        """Poses and likelihood under a history of as many segments, from a segment of each particle's own on.

        Args:
            model: object and tool.
            settings: of motion prior and sensors.
            history: what is replayed.
            first: segment of each particle from which on.
            least: log-likelihood from there on below which a particle may be given up: a segment's is then -inf, and
                what comes after it is left as it was.
        """
        version = backend.dispatch(model.replay, self.poses, *model.sdf.tensors())
        least = torch.full_like(first, -torch.inf, dtype=torch.float64) if least is None else least
        poses, log_likelihood = version(model, settings, history, self, first, least)
        if bool(history.force[:, 2].any()):
            if not isinstance(model, PushedObject):
                raise UsageError("Expected an upright object where the tool's force is felt: in space it tells nothing")
            centre = model.centre + settings.centre_m * self.physics[:, 2:4]
            ahead = model.height_m * (settings.ahead[0] + settings.ahead[1] * self.physics[:, 4])
            told = log_likelihood_of_forces(poses, centre, ahead, history, settings)
            log_likelihood = log_likelihood + torch.where(torch.arange(len(history)) >= first[:, None], told, 0.0)
        return replace(self, poses=poses, log_likelihood=log_likelihood)


_PARTS = ("physics", "noise", "poses", "log_likelihood")


@dataclass(frozen=True)
class PoseTrajectoryBelief(PoseBelief):
    """Pose particles that each have a trajectory of their own.

    Poses are those at present; `world_T_attached` is the motion of one of them, in whose frame the points are kept
    that planners and figures ask for. `discrepancy` is 0: evidence counts by its likelihood.

    Attributes:
        trajectories: of the particles, in their order.
    """

    trajectories: Trajectories | None = None


def log_likelihood_of(
    distance: Float[Tensor, "*b M"], kind: Int[Tensor, "*#M"], own: PoseTrajectorySettings
) -> Float[Tensor, "*b M"]:
    """Log-likelihood of a point at a signed distance from the surface, by its kind, up to a constant of each kind."""
    seen, felt = distance / own.seen_sd_m, (distance - own.felt_m) / own.felt_sd_m
    free = (-distance - own.free_m).clamp_min(0.0) / own.free_sd_m
    off = torch.where(kind == Kind.SEEN, seen, torch.where(kind == Kind.FREE, free, felt))
    near = (own.outliers + (1.0 - own.outliers) * (-0.5 * off.square()).exp()).log()
    feels = own.outliers + (1.0 - 2.0 * own.outliers) * torch.sigmoid((own.pad_m - distance) / own.pad_slope_m)
    bit = torch.where(kind == Kind.PAD_FELT, feels, 1.0 - feels).log()
    return torch.where(kind >= Kind.PAD_FELT, bit, near)


# the compiled version looks likelihoods up over distances: metres between nodes
_STEP_M = 3e-5
_GROUP = 8  # points of the tool's border that it leaves out together


@backend.register("replay_trajectories")
def replay_plain(
    model: Pushed,
    own: PoseTrajectorySettings,
    history: History,
    given: Trajectories,
    first: Int[Tensor, "N"],
    least: Float[Tensor, "N"],
) -> tuple[Tensor, Tensor]:
    """The definition: poses and likelihoods from a segment of each particle's own on; none is given up."""
    poses, logs = given.poses.clone(), given.log_likelihood.clone()
    for segment in range(len(history)):
        rows = (first <= segment).nonzero()[:, 0]
        if not len(rows):
            continue
        noise, physics = given.noise[rows, segment], given.physics[rows]
        together = given.noise[rows, int(history.action[segment]), OWN:]
        friction = own.friction[0] * (own.friction[1] * physics[:, 0] + own.friction_change * noise[:, 0]).exp()
        lever = own.lever_ratio[1] * physics[:, 1] + own.lever_change * noise[:, 1]
        lever = model.spread_m * own.lever_ratio[0] * lever.exp()
        mixed = math.sqrt(1.0 - own.shared) * noise[:, 2:OWN] + math.sqrt(own.shared) * together[:, :3]
        size = (0.5 * own.tails * together[:, 3:4].square()).exp()
        mixed = model.wide * torch.cat((size * mixed, (size - 1.0) * together[:, 4:]), -1)
        pose, total = poses[rows, segment], torch.zeros_like(friction)
        for instant in range(int(history.ends[segment - 1]) if segment else 0, int(history.ends[segment])):
            if bool(history.pushes[instant]):
                before, after = history.tool[instant]
                pose = model.step(own, pose, before, after, Sliding(physics[:, 2:], lever, friction), mixed)
            begin = int(history.point_ends[instant - 1]) if instant else 0
            some = slice(begin, int(history.point_ends[instant]))
            there = history.points[some]
            if not len(there):
                continue
            distance = model.sdf.distance(model.local(pose, there).to(model.sdf.bounds)).to(pose)
            total = total + log_likelihood_of(distance, history.kind[some], own) @ history.weight[some]
        poses[rows, segment + 1], logs[rows, segment] = pose, total
    return poses, logs


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
    particles = arrays_of((first, least, poses, found, given.physics, given.noise))
    grid = grid_arguments(model.sdf, torch.float32)
    scales = torch.cat((scales, scales.new_tensor([own.centre_change_m])))
    kernel(particles, *history.arrays, model.arrays, scales.numpy(), logs.numpy(), grid)
    return poses, found


@functools.cache
def tables(own: PoseTrajectorySettings) -> tuple[Float[Tensor, "16"], Float[Tensor, "kinds D"]]:
    """Numbers of the motion prior as the kernel takes them, and all kinds' log-likelihoods over distances, float32."""
    prior = (*own.friction, *own.lever_ratio, *own.ahead, own.centre_m, own.friction_change, own.lever_change)
    noise = (own.along, own.across, own.turn_rad_per_m, own.m_per_rad, own.tails, own.shared)
    distance = _STEP_M * (torch.arange(NODES, dtype=torch.float64) - NODES // 2)
    priced = torch.stack([log_likelihood_of(distance, torch.tensor(int(kind)), own) for kind in Kind])
    return torch.tensor((*prior, *noise, _STEP_M), dtype=torch.float64), priced.float()
