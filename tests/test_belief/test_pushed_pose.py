"""Filter of a pushed object's pose: Kalman's where nothing is pushed, and each fault found and named."""

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from rumi.belief.pushed_pose import PushedPoseFilter, PushedPoseSettings
from rumi.belief.pushed_pose_reading import PushedPoseBelief
from rumi.dynamics.along_path import Pusher
from rumi.dynamics.outline import RectangleOutline, Support
from rumi.dynamics.pushed_body import PushedBody
from sdf import backend

DOUBLE = {"dtype": torch.float64}
FAR = torch.tensor([[1.0, 1.0, 0.0]] * 2, **DOUBLE)
SETTINGS = PushedPoseSettings()
NOISE = torch.tensor([SETTINGS.reading_m, SETTINGS.reading_m, SETTINGS.reading_rad], **DOUBLE)


@pytest.fixture(autouse=True)
def fused() -> Iterator[None]:
    """The pushing has its own tests; here the quick version of it is enough."""
    with backend.force("numba"):
        yield


def square() -> PushedBody:
    axis = torch.linspace(-0.045, 0.045, 31, **DOUBLE)
    base = torch.cartesian_prod(axis, axis)
    like = torch.zeros(1, **DOUBLE)
    return PushedBody(RectangleOutline((0.045, 0.045)), Support.of_base(base, base.mean(0)), Pusher.disc(0.005, like))


def filter_of(**changes: float) -> PushedPoseFilter:
    return PushedPoseFilter(square(), replace(SETTINGS, **changes))


def followed(
    own: PushedPoseFilter, readings: list[Tensor | None], path: Tensor | None = None
) -> list[PushedPoseBelief]:
    """Beliefs after each reading, the tool far off or along (n, 3)."""
    generator = torch.Generator().manual_seed(0)
    first = readings[0]
    assert first is not None
    found = [own.initial(first, generator=generator)]
    for k in range(1, len(readings)):
        way = FAR if path is None else path[k - 1 : k + 1]
        found.append(own.step(found[-1], way, readings[k], generator=generator))
    return found


def still(count: int, seed: int = 1, pose: tuple[float, float, float] = (0.1, -0.2, 3.1)) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.tensor(pose, **DOUBLE) + NOISE * torch.randn(count, 3, generator=generator, **DOUBLE)


def pushing(count: int) -> tuple[Tensor, Tensor]:
    """A tip's straight path against the middle of a side, and where the square is then."""
    tip = torch.zeros(count, 3, **DOUBLE)
    tip[:, 0] = -0.05 + 1e-3 * torch.arange(count, **DOUBLE)
    pose = torch.zeros(count, 3, **DOUBLE)
    pose[:, 0] = tip[:, 0] + 0.05
    return tip, pose


def alarms(beliefs: list[PushedPoseBelief]) -> list[tuple[int, str | None]]:
    return [(number, belief.fault) for number, belief in enumerate(beliefs) if belief.alarm]


def test_an_object_at_rest_is_followed_as_by_a_kalman_filter() -> None:
    own = filter_of(particles=20_000, still=4e-4, outlier=1e-9, repeats=1e-9)
    readings = still(25)
    radius = own.body.support.spread
    moved = torch.tensor([4e-4, 4e-4, 4e-4 / radius], **DOUBLE).square()
    mean, variance = readings[0], NOISE.square()
    for number, belief in enumerate(followed(own, list(readings))):
        if number:
            variance = variance + moved
            gain = variance / (variance + NOISE.square())
            mean, variance = mean + gain * (readings[number] - mean), (1.0 - gain) * variance
        assert bool(((belief.mean() - mean).abs() < 0.15 * variance.sqrt()).all())
        np.testing.assert_allclose(belief.covariance().diagonal(), variance, rtol=0.15)


def test_faultless_pushing_raises_no_alarm_and_is_followed() -> None:
    tip, pose = pushing(150)
    readings = pose + still(150, pose=(0.0, 0.0, 0.0))
    beliefs = followed(filter_of(), list(readings), tip)
    assert alarms(beliefs) == []
    off = beliefs[-1].mean() - pose[-1]
    assert float(off[:2].norm()) < 2e-3
    assert abs(float(off[2])) < math.radians(2.0)


@pytest.mark.parametrize("jump", [(0.015, 0.0, 0.0), (0.0, -0.04, 0.5), (0.0, 0.0, 0.3)])
def test_a_knock_is_found_at_once_and_the_object_found_again(jump: tuple[float, float, float]) -> None:
    readings = still(60)
    readings[30:] += torch.tensor(jump, **DOUBLE)
    beliefs = followed(filter_of(), list(readings))
    found = alarms(beliefs)
    assert [name for _, name in found] == ["knocked"]
    assert 30 <= found[0][0] <= 33
    off = beliefs[-1].mean() - torch.tensor((0.1, -0.2, 3.1), **DOUBLE) - torch.tensor(jump, **DOUBLE)
    assert bool((off.abs() < NOISE).all())


def test_single_outliers_are_borne_and_raise_their_rate() -> None:
    readings = still(60)
    for number in (10, 25, 40, 55):
        readings[number] += torch.tensor([0.05, -0.03, 1.0], **DOUBLE)
    beliefs = followed(filter_of(), list(readings))
    assert alarms(beliefs) == []
    lost, seen = beliefs[-1].outliers
    first, prior = beliefs[0].outliers
    assert lost - first == pytest.approx(4.0, abs=0.5)  # a near one is told from noise by its odds alone
    assert seen - prior == 59.0


def test_a_tracker_that_repeats_itself_is_stuck_and_leaves_the_belief() -> None:
    tip, pose = pushing(60)
    readings = pose + still(60, pose=(0.0, 0.0, 0.0))
    readings[30:45] = readings[29].clone()
    beliefs = followed(filter_of(), list(readings), tip)
    assert {name for _, name in alarms(beliefs)} == {"stuck"}
    assert beliefs[44].fault == "stuck"
    assert beliefs[-1].fault is None
    # pushed on by the model alone meanwhile
    assert float((beliefs[44].mean() - pose[44])[:2].norm()) < 3e-3


def test_a_tracker_whose_poses_are_old_is_late() -> None:
    tip, pose = pushing(90)
    noise = still(90, pose=(0.0, 0.0, 0.0))
    old = pose.clone()
    old[40:] = pose[28:78]
    found = alarms(followed(filter_of(), list(old + noise), tip))
    assert found
    assert found[0][1] == "late"
    assert found[0][0] < 50


def test_what_a_tracker_said_while_it_fell_behind_is_undone() -> None:
    tip, pose = pushing(120)
    behind = (torch.arange(120) - 40).clamp(0, 24) // 2
    ends = []
    for seed in (1, 4, 5):
        readings = pose[torch.arange(120) - behind] + still(120, seed, pose=(0.0, 0.0, 0.0))
        beliefs = followed(filter_of(), list(readings), tip)
        names = [name for _, name in alarms(beliefs)]
        # late it stays, and is now and then taken for a knock: each alarm weighs its own few readings anew
        assert set(names[:5]) == {"late"}
        assert names.count("late") > 0.8 * len(names)
        ends.append(torch.stack([(beliefs[-1].mean() - pose[-1])[:2].norm(), beliefs[-1].tool.mean(0).norm()]))
    place, tool = torch.stack(ends).median(0).values.tolist()
    assert place < 2.5e-3  # 11 mm where it is not undone
    assert tool < 2e-3  # nor is the tool taken to be elsewhere


def test_readings_from_everywhere_are_none_of_these() -> None:
    readings = still(60)
    generator = torch.Generator().manual_seed(5)
    readings[30:] += torch.tensor([0.3, 0.3, 1.5]) * torch.randn(30, 3, generator=generator, **DOUBLE)
    found = alarms(followed(filter_of(), list(readings)))
    assert "none of these" in {name for _, name in found}


def test_no_reading_moves_the_belief_by_the_model_alone() -> None:
    tip, pose = pushing(40)
    beliefs = followed(filter_of(), [pose[0], *[None] * 39], tip)
    assert float((beliefs[-1].mean() - pose[-1])[:2].norm()) < 3e-3
    assert bool((beliefs[-1].covariance().diagonal() > beliefs[0].covariance().diagonal()).all())
    assert beliefs[-1].evidence.readings == 0


@pytest.mark.parametrize("value", [1e3, 1e150])
def test_one_particle_and_readings_far_off_leave_numbers(value: float) -> None:
    readings = still(8)
    readings[4] = value
    for belief in followed(filter_of(particles=1), list(readings)):
        for part in (belief.pose, belief.log_weights, belief.mean(), belief.covariance()):
            assert bool(part.isfinite().all())


def test_what_has_no_meaning_is_refused() -> None:
    for name, value in (
        ("particles", 0),
        ("reading_m", 0.0),
        ("outlier", 0.5),
        ("repeats", 0.0),
        ("mean_run", 1.0),
        ("tool_m", math.inf),
    ):
        with pytest.raises(ValueError, match=f"Expected {name}"):
            replace(SETTINGS, **{name: value})
    own, generator = filter_of(), torch.Generator().manual_seed(0)
    belief = own.initial(torch.zeros(3, **DOUBLE), generator=generator)
    with pytest.raises(ValueError, match="finite"):
        own.step(belief, FAR, torch.tensor([0.0, torch.nan, 0.0], **DOUBLE), generator=generator)
