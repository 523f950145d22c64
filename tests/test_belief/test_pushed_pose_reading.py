"""A reading's fused way into the belief equals the plain one: push, batch update, test of faults, resampling."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from rumi.belief.pushed_pose import PushedPoseFilter, PushedPoseSettings
from rumi.belief.pushed_pose_reading import PushedPoseBelief
from rumi.dynamics.along_path import Pusher
from rumi.dynamics.outline import GridOutline, RectangleOutline, Support, support_of
from rumi.dynamics.pushed_body import PushedBody
from rumi.robot.gripper import GripperShape
from sdf import backend
from sdf.primitives import Mug

DOUBLE = {"dtype": torch.float64}


def square() -> PushedBody:
    axis = torch.linspace(-0.045, 0.045, 31, **DOUBLE)
    base = torch.cartesian_prod(axis, axis)
    like = torch.zeros(1, **DOUBLE)
    return PushedBody(RectangleOutline((0.045, 0.045)), Support.of_base(base, base.mean(0)), Pusher.disc(0.005, like))


def mug() -> PushedBody:
    sdf = Mug().double()
    return PushedBody(GridOutline.of_slice(sdf, 0.05), support_of(sdf), Pusher(GripperShape().outline(0.005).double()))


def close(found: PushedPoseBelief, plain: PushedPoseBelief) -> None:
    for name in ("pose", "log_weights", "parameters", "tool", "trail", "reading"):
        torch.testing.assert_close(getattr(found, name), getattr(plain, name), rtol=1e-9, atol=1e-9, msg=name)
    for one, other in zip((*found.sliding, *found.evidence), (*plain.sliding, *plain.evidence), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-6, atol=1e-6)
    assert found.outliers == pytest.approx(plain.outliers, abs=1e-6)
    assert (found.alarm, found.fault, len(found.past)) == (plain.alarm, plain.fault, len(plain.past))


def episode(body: PushedBody, count: int) -> tuple[Tensor, Tensor]:
    """A tool's path up to the object and on against it, and readings that go with it, with an outlier."""
    generator = torch.Generator().manual_seed(2)
    gone = 1e-3 * torch.arange(count, **DOUBLE)
    start = -body.pusher.radius - body.outline.radius + 0.02
    path = torch.stack((start + gone, torch.full_like(gone, 0.004), 0.01 * gone), -1)
    readings = torch.stack(((gone - 0.01).clamp_min(0.0), torch.zeros_like(gone), torch.zeros_like(gone)), -1)
    readings += torch.tensor([1e-3, 1e-3, 0.0175]) * torch.randn(readings.shape, generator=generator, **DOUBLE)
    readings[count // 2] += torch.tensor([0.05, -0.03, 3.0], **DOUBLE)
    readings[3] = readings[2]
    return path, readings


@pytest.mark.parametrize("body", [square(), mug()], ids=["disc on square", "gripper on mug"])
def test_the_fused_filter_is_the_batch_filter(body: PushedBody) -> None:
    own = PushedPoseFilter(body)
    path, readings = episode(body, 50)
    ends = []
    for version in ("torch", "numba"):
        generator = torch.Generator().manual_seed(0)
        with backend.force(version):
            belief = own.initial(readings[0], generator=generator)
            found = [belief]
            for k in range(1, len(readings)):
                reading = None if k == 20 else readings[k]
                found.append(own.step(found[-1], path[k - 1 : k + 1], reading, generator=generator))
        ends.append(found)
    for plain, fused in zip(*ends, strict=True):
        close(fused, plain)
    assert any(bool((belief.log_weights == belief.log_weights[0]).all()) for belief in ends[0][1:])  # resampled
    assert bool((ends[0][-1].mean()[:2].abs() > 0.005).any())


@pytest.mark.parametrize("particles", [1, 7])
@pytest.mark.parametrize("value", [(1e-3, 0.0, 3.13), (0.3, -0.3, 1.0), (1e3, -1e3, 0.0)])
def test_one_fused_reading_is_the_plain_one(particles: int, value: tuple[float, float, float]) -> None:
    own = PushedPoseFilter(square(), replace(PushedPoseSettings(), particles=particles))
    path = torch.tensor([[-0.06, 0.0, 0.0], [-0.045, 0.002, 0.0], [-0.04, 0.0, 0.1]], **DOUBLE)
    found = []
    for version in ("torch", "numba"):
        generator = torch.Generator().manual_seed(1)
        with backend.force(version):
            belief = own.initial(torch.zeros(3, **DOUBLE), generator=generator)
            found.append(own.step(belief, path, torch.tensor(value, **DOUBLE), generator=generator))
    close(found[1], found[0])


@pytest.mark.parametrize("version", ["torch", "numba"])
def test_readings_beyond_all_numbers_are_refused(version: str) -> None:
    own, generator = PushedPoseFilter(square()), torch.Generator().manual_seed(0)
    with backend.force(version):
        belief = own.initial(torch.zeros(3, **DOUBLE), generator=generator)
        with pytest.raises(ValueError, match="Expected log_ratios without NaN"):
            own.step(belief, torch.ones(2, 3, **DOUBLE), torch.full((3,), 1e200, **DOUBLE), generator=generator)
