"""Likelihood of what was sensed along trajectories: a point's by its distance, and motions replayed to be weighed."""

import functools
import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rumi.belief.pose_trajectories import OWN, PHYSICS, Trajectories
from rumi.belief.pushed_model import Pushed
from rumi.belief.systematic_errors import SystematicErrors
from rumi.belief.trajectory_history import NODES, History, Kind
from rumi.belief.trajectory_settings import PoseTrajectorySettings
from rumi.dynamics.sliding import Sliding
from sdf import backend
from sdf.base import SDF

# compiled versions look likelihoods up over distances: metres between nodes
_STEP_M = 3e-5

FACING_M, FACING = 0.001, 5
"""Length of a step towards a camera, at least, in which the side of a wall that faces it is looked for; how many."""

_DEVIATIONS = 2.0  # of what is seen, that the steps reach: behind a wall out of reach a point counts as near its back


def facing_step_m(own: PoseTrajectorySettings) -> float:
    """Length of a step towards a camera in which the side of a wall that faces it is looked for."""
    reach_m = _DEVIATIONS * own.seen_sd_m
    return FACING_M if reach_m <= FACING * FACING_M + 1e-9 else reach_m / FACING


def facing_distance(
    sdf: SDF, points: Float[Tensor, "N M 3"], eye: Float[Tensor, "N 3"], step_m: float = FACING_M
) -> Float[Tensor, "N M"]:
    """Signed distance of seen points from the surface that faces the camera, metres, below 0 behind it.

    What is seen through noise may come to lie behind a thin wall, whose far side is nearer then. As long as the surface
    comes nearer on the way to the camera, another one is in between.

    Args:
        sdf: of the object.
        points: in its frame.
        eye: of the camera, in its frame; it is far, so that all points see it in one direction.
        step_m: length of a step towards it; the result is off by one at most.
    """
    step = step_m * torch.nn.functional.normalize(eye, dim=-1)[:, None]
    now = sdf.distance(points.to(sdf.bounds)).to(points)
    gone, open_yet = torch.zeros_like(now), torch.ones_like(now, dtype=torch.bool)
    for turn in range(1, FACING + 1):
        ahead = sdf.distance((points + turn * step).to(sdf.bounds)).to(points)
        open_yet = open_yet & (ahead < now)
        now, gone = torch.where(open_yet, ahead, now), torch.where(open_yet, turn * step_m, gone)
    return now - gone


def log_likelihood_of(
    distance: Float[Tensor, "*b M"], kind: Int[Tensor, "*#M"], own: PoseTrajectorySettings
) -> Float[Tensor, "*b M"]:
    """Log-likelihood of a point at a signed distance from the surface, by its kind, up to a constant of each kind."""
    seen, felt = distance / own.seen_sd_m, (distance - own.felt_m) / own.felt_sd_m
    free = (-distance - own.free_m).clamp_min(0.0) / own.free_sd_m
    off = torch.where(kind == Kind.SEEN, seen, torch.where(kind == Kind.FREE, free, felt))
    near = (own.outliers + (1.0 - own.outliers) * (-0.5 * off.square()).exp()).log()
    within = torch.sigmoid((own.pad_m - distance) / own.pad_slope_m)
    feels = own.outliers + max(0.0, 1.0 - 2.0 * own.outliers - own.dead) * within  # all but dead: chance alone
    bit = torch.where(kind == Kind.PAD_FELT, feels, 1.0 - feels).log()
    return torch.where(kind >= Kind.PAD_FELT, bit, near)


def told_by_silence(points: Float[Tensor, "N"], own: PoseTrajectorySettings, power: float) -> Float[Tensor, "N"]:
    """Log-likelihood of pads that felt nothing at an instant: that nothing was there, or that all of them missed it.

    Args:
        points: log-likelihood of their points where nothing was missed, times `power`.
        own: of the sensors.
        power: to which the reading is raised.
    """
    return power * (own.missed + (1.0 - own.missed) * (points / power).exp()).log() if own.missed else points


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
        errors = SystematicErrors.of(own, given.systematic[rows]) if own.systematic else None
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
                body = Sliding(physics[:, 2:PHYSICS], lever, friction)
                pose = model.step(own, pose, before, after, body, mixed, errors)
            begin = int(history.point_ends[instant - 1]) if instant else 0
            some = slice(begin, int(history.point_ends[instant]))
            there = history.points[some]
            if not len(there):
                continue
            taken = pose
            if errors is not None:
                seen = history.kind[begin] == Kind.SEEN
                taken = errors.seen(pose) if seen else errors.felt(pose, history.tool[instant, 1])
            local = model.local(taken, there)
            local = local if errors is None else errors.of_the_model(local, model.resting_m)
            distance = model.sdf.distance(local.to(model.sdf.bounds)).to(pose)
            if own.eye_m is not None and bool((shown := history.kind[some] == Kind.SEEN).any()):
                eye = pose.new_tensor(own.eye_m) - pose.new_tensor((0.0, 0.0, model.resting_m))
                toward = model.local(taken, eye[None])
                toward = toward if errors is None else errors.of_the_model(toward, model.resting_m)
                distance[:, shown] = facing_distance(model.sdf, local[:, shown], toward[:, 0], facing_step_m(own))
            if errors is not None:
                distance = errors.size[:, None] * distance + errors.worn_m[:, None]
            each = log_likelihood_of(distance, history.kind[some], own) * history.weight[some]
            silent, power = history.kind[some] == Kind.PAD_SILENT, history.power if segment == len(history) - 1 else 1.0
            total = total + each[:, ~silent].sum(-1) + told_by_silence(each[:, silent].sum(-1), own, power)
        poses[rows, segment + 1], logs[rows, segment] = pose, total
    return poses, logs


@functools.cache
def tables(own: PoseTrajectorySettings) -> tuple[Float[Tensor, "16"], Float[Tensor, "kinds D"]]:
    """Numbers of the motion prior as the kernel takes them, and all kinds' log-likelihoods over distances, float32."""
    prior = (*own.friction, *own.lever_ratio, *own.ahead, own.centre_m, own.friction_change, own.lever_change)
    noise = (own.along, own.across, own.turn_rad_per_m, own.m_per_rad, own.tails, own.shared)
    distance = _STEP_M * (torch.arange(NODES, dtype=torch.float64) - NODES // 2)
    priced = torch.stack([log_likelihood_of(distance, torch.tensor(int(kind)), own) for kind in Kind])
    return torch.tensor((*prior, *noise, _STEP_M), dtype=torch.float64), priced.float()
