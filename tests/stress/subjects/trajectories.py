"""Trajectories of a pushed block: 1 to 10^4 particles, weights that are all but one 0, 10^4 actions."""

import math
from functools import cache, partial

import torch
from torch import Tensor

from rumi.belief.pose_filter import FilterSettings
from rumi.belief.pose_trajectories import NOISE, PHYSICS, Trajectories
from rumi.belief.pose_trajectory_filter import PoseTrajectoryFilter
from rumi.belief.pushed_object import PushedObject
from rumi.belief.trajectory_history import History
from rumi.belief.trajectory_settings import PoseTrajectorySettings
from rumi.bench.drawn_segments import drawn_push, drawn_truth, drawn_view
from rumi.robot.gripper import GripperShape
from sdf.grid_sdf import GridSDF
from sdf.primitives import Box
from sensors.discrepancy import Discrepancy
from tests.stress import measures
from tests.stress.draws import choice, integer, normal, uniform
from tests.stress.sweep import Inputs, Sweep, register

F64 = torch.float64
PADS = torch.tensor([[0.035, y, 0.0] for y in (-0.045, -0.03, 0.03, 0.045)], dtype=F64)


@cache
def _followed(particles: int, memory: int, dtype: torch.dtype) -> PoseTrajectoryFilter:
    sdf = GridSDF.from_sdf(Box([0.04, 0.06, 0.03]), 0.004).to(dtype)
    model = PushedObject.of(sdf, GripperShape(), height_m=0.03, resting_m=0.03, spacing_m=0.01, pad_spacing_m=0.01)
    own = PoseTrajectorySettings(particles=particles, memory=memory, branches=3, rounds=1)
    settings = FilterSettings(motion="trajectory", trajectories=own)
    discrepancy = Discrepancy(sdf, 0.08, free_scale=80.0, tolerance=0.001).to(dtype)
    return PoseTrajectoryFilter(settings, discrepancy, model)


def _started(followed: PoseTrajectoryFilter, spread: float, random: torch.Generator) -> Trajectories:
    count, own = followed.own.particles, followed.own
    view = drawn_view(_object(followed), own, torch.zeros(3, dtype=F64), 20, random)
    start = spread * torch.randn(count, 3, generator=random, dtype=F64) * torch.tensor([1.0, 1.0, 20.0], dtype=F64)
    given = Trajectories(
        torch.randn(count, PHYSICS, generator=random, dtype=F64),
        torch.randn(count, 1, NOISE, generator=random, dtype=F64),
        start[:, None].repeat(1, 2, 1),
        start.new_zeros(count, 1),
        History.empty().appended(view),
        start[:300],
    )
    return given.replayed(followed.model, own, given.history, torch.zeros(count, dtype=torch.long))


def _object(followed: PoseTrajectoryFilter) -> PushedObject:
    assert isinstance(followed.model, PushedObject)
    return followed.model


def _path(angle: float, reach: float, step: float) -> Tensor:
    way = torch.tensor([math.cos(angle), math.sin(angle)], dtype=F64)
    back = reach + step * torch.arange(5, dtype=F64)[:, None]
    tool = torch.cat((back * way, torch.full_like(back, angle)), -1)
    return torch.stack((tool[:-1], tool[1:]), 1)


def _draw(dtype: torch.dtype, generator: torch.Generator) -> Inputs:
    particles = (1, 2, 60, 10_000)[int(4 * uniform(generator, 1))]
    return {
        "particles": particles,
        "dtype": dtype,
        "one": integer(generator, 0, 1),
        "spread": choice(generator, (0.0, 0.002, 0.05)),
        "angle": 3.0 * normal(generator, 1),
        "step": choice(generator, (0.0, 0.002, 0.02, 0.2)),
        "seed": int(1e6 * uniform(generator, 1)),
    }


def _updated(inputs: Inputs) -> Tensor:
    """What is not finite after three pushes, and how far off histories are from a replay of them, in 1e-6."""
    random = torch.Generator().manual_seed(inputs["seed"])
    followed = _followed(inputs["particles"], 80, inputs["dtype"])
    now = _started(followed, inputs["spread"], random)
    truth = drawn_truth(torch.zeros(3, dtype=F64), random)
    weights = torch.zeros(len(now), dtype=F64)
    if int(inputs["one"]):
        weights = torch.full_like(weights, -math.inf).index_fill(0, torch.tensor(0), 0.0)
    for k in range(3):
        path = _path(float(inputs["angle"]) + 2.0 * k, -0.11, inputs["step"])
        segment, truth = drawn_push(_object(followed), followed.own, truth, path, PADS, random)
        now = followed.absorbed(now, weights.log_softmax(-1), segment, random, opens=True, closes=True)
        weights = torch.zeros_like(weights)
    none = torch.zeros(len(now), dtype=torch.long)
    whole = now.replayed(followed.model, followed.own, now.history, none)
    off = (whole.poses - now.poses).abs().amax() / 1e-9 + (
        whole.log_likelihood - now.log_likelihood
    ).abs().amax() / 1e-3
    return off[None] + 0.0 * sum(part.sum() for part in (now.poses, now.log_likelihood, now.physics, now.noise))


for _kind, _name in ((torch.float32, "float32"), (F64, "float64")):
    register(
        Sweep(
            name=f"trajectories-update-{_name}",
            draw=partial(_draw, _kind),
            operation=_updated,
            reference=lambda inputs: torch.zeros(1, dtype=F64),
            error=lambda got, wanted, inputs: measures.absolute(got, wanted),
            limit=1.0,
            unit="of 1 nm and 0.001 nats between what was taken in bit by bit and a replay",
            condition=lambda inputs: torch.tensor([float(inputs["particles"])], dtype=F64),
            condition_of="particles",
        )
    )


def _long(inputs: Inputs) -> Tensor:
    """Segments held over the most that are, after 10^4 actions; not finite where a pose is not."""
    random = torch.Generator().manual_seed(inputs["seed"])
    followed = _followed(8, 10, torch.float32)
    now, truth = _started(followed, 0.002, random), drawn_truth(torch.zeros(3, dtype=F64), random)
    flat = torch.zeros(len(now), dtype=F64).log_softmax(-1)
    for k in range(inputs["actions"]):
        # to the object's own place, from one side and the other, so that it stays about the origin
        path = _path(math.pi * (k % 2), -0.085, 0.002)
        segment, truth = drawn_push(_object(followed), followed.own, truth, path, PADS, random)
        truth = truth.remembered(4)
        now = followed.absorbed(now, flat, segment, random, opens=True, closes=True).remembered(followed.own.memory)
    return torch.tensor([len(now.history) / (followed.own.memory + 2.0)]) + 0.0 * now.poses.sum().float()


register(
    Sweep(
        name="trajectories-actions",
        draw=lambda generator: {"seed": int(1e6 * uniform(generator, 1)), "actions": 10_000},
        operation=_long,
        reference=lambda inputs: torch.zeros(1),
        error=lambda got, wanted, inputs: measures.absolute(got, wanted),
        limit=1.0,
        unit="of the segments that memory may hold",
        condition=lambda inputs: torch.tensor([float(inputs["actions"])]),
        condition_of="actions",
        slow=True,
    )
)
