"""Real pushes of a square through the trajectory filter, from a start that is roughly known, by contact and force."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.belief.pose_filter import FilterSettings
from rumi.belief.pose_trajectories import NOISE, PHYSICS, Trajectories
from rumi.belief.pose_trajectory_filter import PoseTrajectoryFilter
from rumi.belief.pushed_object import PushedObject
from rumi.belief.pushed_prior import as_believed
from rumi.belief.trajectory_history import History, Kind, Segment
from rumi.belief.trajectory_likelihood import log_likelihood_of
from rumi.belief.trajectory_settings import PoseTrajectorySettings
from rumi.dynamics.outline import GridOutline
from rumi.dynamics.push_posterior import PushPosterior
from rumi.dynamics.pushed_body import PushedBody
from rumi.resampling import resample_systematic
from scripts.bench.push_reference import Contact
from scripts.bench.real_pushes import TIP_M
from sdf.grid_sdf import GridSDF
from sdf.primitives import Box
from sensors.discrepancy import Discrepancy

TALL_M = 0.03
DRAWS, _POSSIBLE = 8000, 300


def sensed(start_m: float) -> PoseTrajectorySettings:
    """Settings of a felt tip, and of a start that is known to so much; the motion prior is the default's."""
    return PoseTrajectorySettings(
        seen_sd_m=start_m,
        outliers=1e-4,
        felt_m=TIP_M,
        felt_sd_m=Contact().deviation_m,
        felt_weight=1.0,
        ahead=(0.0, 0.0),
        centre_change_m=0.0,
    )


def motion_of(
    believed: PushPosterior, body: PushedBody, own: PoseTrajectorySettings
) -> tuple[PoseTrajectorySettings, Float[Tensor, "2"]]:
    """Settings with the motion prior of a push density, and its centre of friction; the limit surface is no part."""
    spread = body.support.spread
    mean = believed.log_weights.exp() @ believed.parameters
    settings = as_believed(own, spread, believed)
    return settings, body.support.centre + spread * mean[6:]


def square_object(body: PushedBody, half_m: float, centre: Float[Tensor, "2"]) -> PushedObject:
    """A square of a body's outline, with its centre of friction, and the round tip."""
    assert isinstance(body.outline, GridOutline)
    sdf = GridSDF.from_sdf(Box([half_m, half_m, TALL_M]), 0.003)
    around = torch.linspace(0.0, 2.0 * math.pi, 25, dtype=torch.float64)[:-1]
    tip = TIP_M * torch.stack((around.cos(), around.sin()), -1)
    return PushedObject(sdf, TALL_M, body.outline, centre, body.support.spread, tip, tip.new_zeros(1, 3), TALL_M)


def followed(
    told: Float[Tensor, "3"],
    scale: Float[Tensor, "3"],
    tip: Float[Tensor, "K1 3"],
    own: PoseTrajectorySettings,
    square: PushedObject,
    random: torch.Generator,
    *,
    half_m: float,
    forces: Float[Tensor, "K 2"] | None = None,
    worth: float = 1.0,
) -> Float[Tensor, "N 3"]:
    """Poses of the filter's particles at the end of a push.

    Args:
        told: start, normal about which the true one is, by deviations
        scale: of x, y and yaw.
        tip: its path; it touches all along, which counts as one reading for as many instants as make a segment.
        own: of the filter.
        square: the object.
        random: of the filter.
        half_m: half of its side.
        forces: of the tip on the object, on the way to each instant after the first; None where none is felt.
        worth: independent readings that the mean force of a segment is worth.
    """
    settings = FilterSettings(motion="trajectory", trajectories=own)
    filtered = PoseTrajectoryFilter(settings, Discrepancy(square.sdf, 0.08, free_scale=80.0, tolerance=1e-3), square)
    now = _about(told, scale, tip[0], own, square, half_m, random)
    flat = now.log_likelihood.new_zeros(len(now)).log_softmax(-1)
    path = torch.stack((tip[:-1], tip[1:]), 1)
    for k, part in enumerate(path.split(own.instants)):
        count = torch.arange(len(part))
        felt = torch.full_like(count, int(Kind.FELT))
        weight = torch.full((len(part),), 1.0 / len(part), dtype=torch.float64)
        force = None
        if forces is not None:
            mean = forces[k * own.instants : (k + 1) * own.instants].mean(0)
            force = torch.cat((mean, mean.new_tensor([worth])))
        segment = Segment(part, True, _at_middle(part[:, 1]), count, felt, weight, force)
        now = filtered.absorbed(now, flat, segment, random, opens=k == 0, closes=True)
    return now.pose


def _at_middle(tips: Tensor) -> Tensor:
    """Points of the tip's centre at the object's middle height."""
    return torch.cat((tips[:, :2], torch.zeros_like(tips[:, :1])), -1)


def _about(
    told: Tensor,
    scale: Tensor,
    tip: Tensor,
    own: PoseTrajectorySettings,
    square: PushedObject,
    half_m: float,
    random: torch.Generator,
) -> Trajectories:
    """Particles of a start that is known to so much and touched.

    Points seen on the sides of the square that was told of hold the start in the filter's moves.
    """
    arm = float(scale[0] / scale[2]) / math.sqrt(2.0)
    side = torch.tensor([-arm, arm], dtype=torch.float64)
    local = torch.cat([torch.stack((torch.full_like(side, s * half_m), side), -1) for s in (-1, 1)])
    local = torch.cat((local, local.flip(-1)))
    cos, sin = told[2].cos(), told[2].sin()
    place = told[:2] + torch.stack((cos * local[:, 0] - sin * local[:, 1], sin * local[:, 0] + cos * local[:, 1]), -1)
    points = torch.cat((_at_middle(place), _at_middle(tip[None])))
    kind = torch.tensor([int(Kind.SEEN)] * len(place) + [int(Kind.FELT)])
    weight = torch.tensor([0.25] * len(place) + [1.0], dtype=torch.float64)
    view = Segment(torch.zeros(1, 2, 3, dtype=torch.float64), False, points, torch.zeros_like(kind), kind, weight)
    start = told + scale * torch.randn(DRAWS, 3, generator=random, dtype=torch.float64)
    apart = square.sdf.distance(square.local(start, points[-1:]).to(square.sdf.bounds)).to(start)
    touches = log_likelihood_of(apart, kind[-1:], own)[:, 0]
    start = start[resample_systematic(touches, _POSSIBLE, generator=random)]
    some = start[torch.randperm(len(start), generator=random)[: own.particles]]
    physics = torch.randn(len(some), PHYSICS, generator=random, dtype=torch.float64)
    noise = torch.randn(len(some), 1, NOISE, generator=random, dtype=torch.float64)
    history = History.empty().appended(view)
    poses = some[:, None].repeat(1, 2, 1)
    given = Trajectories(physics, noise, poses, some.new_zeros(len(some), 1), history, start)
    return given.replayed(square, own, history, torch.zeros(len(some), dtype=torch.long))
