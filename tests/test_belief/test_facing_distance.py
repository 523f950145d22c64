"""What a camera saw is held against the side of a wall that faces it."""

from dataclasses import replace

import pytest
import torch

from rumi.belief.pose_trajectories import NOISE, PHYSICS, Trajectories
from rumi.belief.pushed_object import PushedObject
from rumi.belief.systematic_errors import NUMBERS
from rumi.belief.trajectory_history import History, Kind, Segment
from rumi.belief.trajectory_likelihood import FACING, FACING_M, facing_distance, facing_step_m
from rumi.belief.trajectory_settings import PoseTrajectorySettings
from rumi.robot.gripper import GripperShape
from rumi.seeding import generator
from sdf import backend
from sdf.grid_sdf import GridSDF
from sdf.primitives import Box, Cup

DOUBLE = {"dtype": torch.float64}
EYE = (-0.7, 0.0, 0.2)
KNOWS = replace(PoseTrajectorySettings(), eye_m=EYE)
WALL_M = 0.004


@pytest.fixture(scope="module")
def cup() -> PushedObject:
    shape = GridSDF.from_sdf(Cup(0.041, 0.095, WALL_M, 0.004), 0.001)
    return PushedObject.of(shape, GripperShape(), height_m=0.05, resting_m=0.0, spacing_m=0.006, pad_spacing_m=0.006)


def front(count: int, noise_m: float) -> torch.Tensor:
    """Points of the cup's outside that faces a camera at -x, with noise along its rays."""
    random = generator(3)
    angle = torch.pi + 0.9 * (2.0 * torch.rand(count, generator=random, **DOUBLE) - 1.0)
    height = 0.02 + 0.05 * torch.rand(count, generator=random, **DOUBLE)
    points = torch.stack((0.041 * angle.cos(), 0.041 * angle.sin(), height), -1)
    ray = torch.nn.functional.normalize(points - points.new_tensor(EYE), dim=-1)
    return points + noise_m * torch.randn(count, 1, generator=random, **DOUBLE) * ray


def seen(points: torch.Tensor, kinds: torch.Tensor | None = None) -> History:
    kinds = torch.full((len(points),), int(Kind.SEEN)) if kinds is None else kinds
    weight = torch.full((len(points),), 25.0 / len(points), **DOUBLE)
    still = torch.zeros(1, 2, 3, **DOUBLE)
    return History.empty().appended(
        Segment(still, False, points, torch.zeros(len(points), dtype=torch.long), kinds, weight)
    )


def log_likelihood(model, own: PoseTrajectorySettings, history: History, start: torch.Tensor) -> torch.Tensor:
    given = Trajectories.still(start, history)
    return given.replayed(model, own, history, torch.zeros(len(start), dtype=torch.long)).log_likelihood[:, 0]


def test_behind_a_thin_wall_it_is_the_distance_from_its_front():
    plate, eye = Box((0.5 * WALL_M, 0.05, 0.05)), torch.tensor([[-0.7, 0.0, 0.0]])
    behind = torch.linspace(-0.01, 0.0065, 60)  # the front, below 0 before it
    points = torch.stack((behind - 0.5 * WALL_M, 0.0 * behind, 0.0 * behind), -1)[None]
    found = facing_distance(plate, points, eye)[0]
    assert float((found + behind).abs().max()) <= FACING_M + 1e-6
    assert float((plate.distance(points)[0] + behind).abs().max()) > 5.0 * FACING_M  # the far side is nearer
    assert FACING * FACING_M > WALL_M


def test_in_a_thick_object_it_is_the_distance():
    block, eye = Box((0.04, 0.06, 0.03)), torch.tensor([[-0.7, 0.1, 0.2]])
    x = torch.linspace(-0.06, -0.025, 50)
    points = torch.stack((x, 0.0 * x, 0.0 * x), -1)[None]
    torch.testing.assert_close(facing_distance(block, points, eye), block.distance(points), atol=0, rtol=0)


@pytest.mark.parametrize("systematic", [False, True])
def test_the_compiled_replay_is_the_plain_one(cup, systematic):
    random = generator(5)
    points = torch.cat((front(60, 0.002), 0.1 * torch.rand(20, 3, generator=random, **DOUBLE) - 0.05))
    kinds = torch.cat((torch.full((60,), int(Kind.SEEN)), torch.full((20,), int(Kind.FREE))))
    history = seen(points, kinds)
    own = (
        replace(
            KNOWS,
            view_off_m=0.002,
            view_off_rad=0.01,
            view_about_m=(0.3, 0.1),
            worn=(0.0005, 0.0003),
            tool_off_m=0.001,
            size_off=0.02,
        )
        if systematic
        else KNOWS
    )
    start = torch.randn(50, 3, generator=random, **DOUBLE) * torch.tensor([0.003, 0.003, 1.0], **DOUBLE)
    physics = torch.randn(50, PHYSICS + NUMBERS * systematic, generator=random, **DOUBLE)
    noise = torch.zeros(50, 1, NOISE, **DOUBLE)
    given = Trajectories(physics, noise, start[:, None].repeat(1, 2, 1), start.new_zeros(50, 1), history, start)
    found = []
    for version in ("torch", "numba"):
        with backend.force(version):
            done = given.replayed(cup, own, history, torch.zeros(50, dtype=torch.long))
            found.append(done.log_likelihood[:, 0])
    off = (found[0] - found[1]).abs()
    # where another side just begins to be nearer rounding decides for one point, which is worth a third of a nat
    assert float(off.median()) < 2e-3 and float(off.max()) < 1.0


@pytest.mark.parametrize("kind", [Kind.SEEN, Kind.FREE])
def test_in_the_middle_of_a_view_too_what_cannot_reach_its_least_is_given_up_and_nothing_else(cup, kind):
    history = seen(front(300, 0.002), torch.full((300,), int(kind)))
    random = generator(6)
    start = torch.randn(60, 3, generator=random, **DOUBLE) * torch.tensor([0.003, 0.003, 1.0], **DOUBLE)
    given, first = Trajectories.still(start, history), torch.zeros(60, dtype=torch.long)
    with backend.force("numba"):
        whole = given.replayed(cup, KNOWS, history, first).log_likelihood[:, 0]
        least = whole * (0.5 + torch.rand(60, generator=random, **DOUBLE))
        found = given.replayed(cup, KNOWS, history, first, least).log_likelihood[:, 0]
    kept = whole >= least - 1e-6  # up to rounding
    assert torch.equal(found.isfinite(), kept) and 10 < int(kept.sum()) < 50
    torch.testing.assert_close(found[kept], whole[kept], atol=0, rtol=0)


def test_noise_draws_no_thin_wall_to_the_camera(cup):
    """The likeliest place of a wall that is seen with noise of half its thickness is where it is."""
    history = seen(front(2000, 0.5 * WALL_M))
    shifts = torch.linspace(-0.004, 0.004, 33, **DOUBLE)
    start = torch.zeros(33, 3, **DOUBLE)
    start[:, 0] = shifts
    best = {}
    for name, own in (("knows", KNOWS), ("does not", replace(KNOWS, eye_m=None))):
        told = log_likelihood(cup, own, history, start)
        best[name] = float(shifts[told.argmax()])
    assert abs(best["knows"]) <= 0.0005 and best["does not"] <= -0.001
    told = log_likelihood(cup, KNOWS, history, start)
    assert float(told[0]) < float(told.max()) - 10.0  # where the far side of the wall would be in the near one's place


def test_noise_wider_than_a_wall_draws_none_either(cup):
    """With noise of 4.5 mm the look-out for the front reaches two deviations; at 5 mm it would be off by some."""
    own = replace(KNOWS, seen_sd_m=0.0045)
    assert facing_step_m(own) == pytest.approx(0.0018) and facing_step_m(KNOWS) == FACING_M
    history = seen(front(2000, 0.0045))
    shifts = torch.linspace(-0.008, 0.008, 33, **DOUBLE)
    start = torch.zeros(33, 3, **DOUBLE)
    start[:, 0] = shifts
    told = log_likelihood(cup, own, history, start)
    assert abs(float(shifts[told.argmax()])) <= 0.001


def test_a_camera_that_is_nowhere_is_refused():
    with pytest.raises(ValueError, match="eye_m as three finite numbers"):
        replace(KNOWS, eye_m=(0.0, float("nan"), 0.0))
