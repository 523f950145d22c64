"""Contract of the particle filters: what holds for the pose filter, the trajectory filter and the resample-move filter.

Each follows a few readings of an object near the origin, and resamples on the way.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from rumi.belief.particles import PoseBelief
from rumi.belief.pose_filter import FilterSettings, PoseFilter
from rumi.belief.prior import PlanarPrior
from rumi.belief.static_filter import ResampleMoveFilter
from rumi.belief.trajectory_belief import TouchAction
from rumi.belief.trajectory_filter import TrajectoryFilter, TrajectorySettings
from rumi.dynamics.along_path import Pusher
from rumi.dynamics.outline import RectangleOutline
from rumi.information.neighbours import StateMetric
from sdf import backend, se3
from sdf.primitives import Box
from sensors.discrepancy import Discrepancy
from sensors.observation import Observation
from sensors.semantics import Semantics
from sensors.touch.contact_model import ContactModel
from tests.fixtures.readings import make_reading

SPREAD = (0.01, 0.01, 0.2)
DTYPES = pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["single", "double"])


@dataclass(frozen=True)
class Step:
    """What a filter step leaves."""

    states: Tensor
    log_weights: Tensor
    ess: Tensor
    resampled: bool


Follow = Callable[[Tensor, torch.Generator], Iterator[Step]]
"""Steps of a filter from particles at planar poses (N, 3)."""


def pose_filter(start: Tensor, generator: torch.Generator) -> Iterator[Step]:
    sdf = Box((0.03, 0.08, 0.05)).to(start.dtype)
    settings = FilterSettings(trigger=0.5, motion="sticking")
    follow = PoseFilter(settings, [Discrepancy(sdf, 0.1, free_scale=10.0).to(start.dtype)], "SE(2)").to(start.dtype)
    belief, memory = PoseBelief.uniform(se3.from_planar(start)), Observation.empty(dtype=start.dtype)
    for y in (-0.04, 0.0, 0.04):
        heights = torch.linspace(-0.04, 0.04, 30, dtype=start.dtype)
        points = torch.stack((torch.full_like(heights, -0.03), torch.full_like(heights, y), heights), -1)
        seen = Observation.of(points, Semantics.SURFACE)
        reading = make_reading(seen, contact=True, dtype=start.dtype)
        belief, memory, info = follow(belief, memory, reading, generator=generator)
        yield Step(belief.world_T_object, belief.log_weights, belief.ess(), bool(info.resampled))


def trajectory_filter(start: Tensor, generator: torch.Generator) -> Iterator[Step]:
    prior = PlanarPrior(start, start.new_tensor([1e-9, 1e-9, 1e-9]))
    follow = TrajectoryFilter(
        RectangleOutline((0.03, 0.08)),
        start.new_zeros(2),
        Pusher.disc(0.02, start),
        ContactModel(0.9, 0.05, 300.0).to(start.dtype),
        prior,
        TrajectorySettings(trigger=0.9, noise=0.05),
    )
    belief, history = follow.initial(1, len(start), generator=generator), []
    for x, signals in ((-0.11, [False, True]), (-0.07, [True, True]), (-0.05, [True, False])):
        path = torch.tensor([[x + 0.01 * k, 0.02, 0.0] for k in range(3)], dtype=start.dtype)
        history.append(TouchAction(path, torch.tensor(signals)))
        belief, info = follow.step(belief, history, generator=generator)
        yield Step(belief.pose[0], belief.log_weights[0], belief.ess()[0], bool(info.resampled))


@dataclass(frozen=True)
class Position:
    """Readings of x and y with Gaussian noise."""

    readings: Tensor

    def log_likelihood(self, states: Tensor, /) -> Tensor:
        return -0.5 * ((self.readings[:, None] - states[:, :2]) / 0.002).square().sum((0, 2))


def resample_move_filter(start: Tensor, generator: torch.Generator) -> Iterator[Step]:
    width = start.new_tensor(SPREAD)
    follow = ResampleMoveFilter(StateMetric.planar(0.05), lambda states: -0.5 * (states / width).square().sum(-1))
    belief, readings = follow.start(start), start.new_tensor([[0.004, 0.001], [0.003, 0.0], [0.005, -0.001]])
    for k in range(3):
        new, every = Position(readings[k : k + 1]), Position(readings[: k + 1])
        belief, info = follow.update(belief, new, every, generator=generator)
        yield Step(belief.states, belief.log_weights, torch.tensor(belief.ess), info.resampled)


def tempered_filter(start: Tensor, generator: torch.Generator) -> Iterator[Step]:
    follow = ResampleMoveFilter(StateMetric.planar(0.05), lambda states: torch.zeros_like(states[:, 0]))
    sharp = Position(start.new_tensor([[0.004, 0.001]] * 50))
    belief = follow.update_tempered(follow.start(start), sharp, sharp, generator=generator)
    yield Step(belief.states, belief.log_weights, torch.tensor(belief.ess), True)


FILTERS: dict[str, Follow] = {
    "pose": pose_filter,
    "trajectory": trajectory_filter,
    "resample-move": resample_move_filter,
    "tempered": tempered_filter,
}


@pytest.fixture(params=FILTERS)
def follow(request: pytest.FixtureRequest) -> Iterator[Follow]:
    with backend.force("numba"):
        yield FILTERS[request.param]


def particles(count: int, dtype: torch.dtype = torch.float64) -> Tensor:
    noise = torch.randn(count, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return (noise * torch.tensor(SPREAD, dtype=torch.float64)).to(dtype)


def steps(follow: Follow, start: Tensor, seed: int = 0) -> list[Step]:
    return list(follow(start, torch.Generator().manual_seed(seed)))


def check(step: Step, start: Tensor) -> None:
    count = len(start)
    assert step.states.dtype == step.log_weights.dtype == start.dtype
    assert step.log_weights.shape == (count,) and len(step.states) == count
    assert bool(torch.isfinite(step.states).all()) and not bool(step.log_weights.isnan().any())
    assert float(step.log_weights.logsumexp(-1)) == pytest.approx(0.0, abs=1e-5)
    assert 1.0 <= float(step.ess) <= count


@DTYPES
def test_weights_are_normalised_and_states_finite(follow, dtype):
    start = particles(60, dtype)
    found = steps(follow, start)
    for step in found:
        check(step, start)
    assert any(step.resampled for step in found)


def test_the_same_generator_gives_the_same_belief_to_the_bit(follow):
    first, again, other = (steps(follow, particles(40), seed)[-1] for seed in (0, 0, 1))
    assert torch.equal(first.states, again.states) and torch.equal(first.log_weights, again.log_weights)
    assert not torch.equal(first.states, other.states)


@pytest.mark.parametrize("count", [1, 2])
def test_one_particle_and_two(follow, count):
    start = particles(count)
    for step in steps(follow, start):
        check(step, start)


def test_coincident_particles(follow):
    start = particles(1).expand(30, 3).clone()
    for step in steps(follow, start):
        check(step, start)


def test_readings_draw_particles_to_what_explains_them(follow):
    """Along x, which all of the readings tell of, the belief ends narrower than it began."""
    start = particles(300)
    last = steps(follow, start)[-1]
    x = last.states[:, 0, 3] if last.states.dim() == 3 else last.states[:, 0]
    weights = last.log_weights.exp()
    spread = float((weights @ (x - weights @ x).square()).sqrt())
    assert spread < 0.9 * float(start[:, 0].std()), spread
