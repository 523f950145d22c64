"""Touches of a rectangle as evidence on its planar pose."""

import math

import pytest
import torch

from sdf import backend, compiled
from sdf.sweep import nearest_on_rectangle, sweep_rectangle, turned
from sensors.touch.rectangle_touch import RectangleTouches, rectangle_log_likelihoods, way_clearance, way_clearances
from sensors.touch.touch_likelihood import TouchNoise

F64 = torch.float64
HALF = torch.tensor([0.1, 0.05], dtype=F64)
NOISE = TouchNoise()
RADIUS = 0.0125


# every test of this file holds for the plain and for the compiled version
pytestmark = pytest.mark.usefixtures("version")


def test_golden_rectangle(golden):
    case = golden("s003.rect")
    given, wanted = case["inputs"], case["expected"]
    found = rectangle_log_likelihoods(
        torch.tensor(given["poses"], dtype=F64),
        torch.tensor(given["zp"], dtype=F64)[None],
        torch.tensor(given["zn"], dtype=F64)[None],
        torch.tensor(given["half"], dtype=F64),
        TouchNoise(given["sigma_p"], given["sigma_n"]),
        corners=False,
    )
    assert torch.allclose(found[0], torch.tensor(wanted["loglik"], dtype=F64), atol=case["atol"])


def test_a_corner_explains_the_normals_between_its_sides():
    pose = torch.zeros(1, 3, dtype=F64)
    normal = torch.tensor([[math.cos(0.7), math.sin(0.7)], [1.0, 0.0]], dtype=F64)
    points = HALF.expand(2, 2)
    found = rectangle_log_likelihoods(pose, points, normal, HALF, NOISE)[:, 0]
    assert float(found.abs().max()) < 1e-12
    alone = rectangle_log_likelihoods(pose, points, normal, HALF, NOISE, corners=False)[:, 0]
    assert float(alone[0]) < -15 and float(alone[1]) == 0.0
    # the opposite corner is a rectangle's diagonal away
    far = rectangle_log_likelihoods(pose, points, -normal, HALF, NOISE)[0, 0]
    assert float(far) < -100


def test_clearance_is_the_least_distance_of_the_way():
    generator = torch.Generator().manual_seed(1)
    poses = 0.1 * torch.randn(200, 3, generator=generator, dtype=F64)
    start, end = 0.3 * torch.randn(2, 200, 2, generator=generator, dtype=F64)
    found = way_clearance(poses, HALF, start, end)
    share = torch.linspace(0, 1, 3001, dtype=F64)[:, None, None]
    own = (turned(-poses[:, 2]) @ (start + share * (end - start) - poses[:, :2])[..., None])[..., 0]
    least = nearest_on_rectangle(own, HALF)[2].amin(0)
    # what cuts a corner off between two steps is neither
    sure = least.abs() > 3e-4
    poses, start, end, found, least = (part[sure] for part in (poses, start, end, found, least))
    free = least > 0
    assert 20 < int(free.sum()) < 180
    assert torch.equal(found > 0, free)
    assert torch.allclose(found[free], least[free], atol=3e-4)
    # moved out of the way by so much and no less, the rectangle is clear
    assert bool((found[~free] >= least[~free].abs() * -1 - 0.15).all())
    depth = -found[~free]
    turn = torch.linspace(0, 2 * math.pi, 721, dtype=F64)
    out = torch.stack((turn.cos(), turn.sin()), -1)[:, None] * (depth[:, None] + 1e-3)
    shifted = poses[~free].expand(721, -1, 3).clone()
    shifted[..., :2] += out
    assert bool((way_clearance(shifted, HALF, start[~free], end[~free]) > 0).any(0).all())
    shifted[..., :2] -= out * 0.02 + out * 1e-3 / (depth[:, None] + 1e-3)
    assert not bool((way_clearance(shifted, HALF, start[~free], end[~free]) > 1e-9).any())


def test_ways_and_tops():
    here = RectangleTouches.none(HALF, NOISE, RADIUS)
    poses = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.3, 0.0]], dtype=F64)
    a, b = torch.tensor([-0.3, 0.0], dtype=F64), torch.tensor([0.3, 0.0], dtype=F64)
    way = here.with_way(a, b).log_likelihood(poses)
    assert float(way[0]) < -50 and float(way[1]) == pytest.approx(0.0, abs=1e-9)
    # one that just passes by says next to nothing of where exactly
    beside = torch.tensor([0.0, 0.05 + RADIUS], dtype=F64)
    close = here.with_way(a + beside, b + beside).log_likelihood(poses[:1])
    assert -0.05 < float(close) < 0.0
    top = here.with_top(0.1 * b).log_likelihood(poses)
    assert float(top[0]) == 0.0 and float(top[1]) == pytest.approx(-0.5 * (0.25 / 0.005) ** 2)
    touch = here.with_touch(HALF * torch.tensor([1.0, 0.0]), torch.tensor([1.0, 0.0], dtype=F64))
    both = touch.joined(here.with_way(a, b)).log_likelihood(poses)
    assert torch.allclose(both, touch.log_likelihood(poses) + way)


def test_the_truth_explains_what_a_ball_feels():
    generator = torch.Generator().manual_seed(2)
    poses = torch.rand(300, 3, generator=generator, dtype=F64) * torch.tensor([0.1, 0.1, 6.0])
    start, end = 0.5 * torch.randn(2, 300, 2, generator=generator, dtype=F64)
    felt = sweep_rectangle(poses, HALF, start, end, RADIUS)
    hit = felt.hit & (felt.distance > 0)
    each = torch.stack(
        [
            rectangle_log_likelihoods(poses[k : k + 1], felt.point[k : k + 1], felt.normal[k : k + 1], HALF, NOISE)[
                0, 0
            ]
            for k in hit.nonzero()[:, 0].tolist()
        ]
    )
    assert len(each) > 40 and float(each.abs().max()) < 1e-12


@pytest.mark.skipif(not compiled.available(), reason="without numba")
@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_versions_agree(dtype):
    generator = torch.Generator().manual_seed(7)
    poses = torch.randn(60, 3, generator=generator, dtype=F64) * torch.tensor([0.1, 0.1, 3.0])
    points = 0.15 * torch.randn(30, 2, generator=generator, dtype=F64)
    normals = torch.nn.functional.normalize(torch.randn(30, 2, generator=generator, dtype=F64), dim=-1)
    normals[:4] = torch.tensor([[1.0, 0.0], [0.0, 0.0], [0.0, -1.0], [-1.0, 0.0]])  # and one that is none
    ways = 0.3 * torch.randn(30, 2, 2, generator=generator, dtype=F64)
    ways[:3, 1] = ways[:3, 0]  # that go nowhere
    ways[3, :, 1] = 0.02  # along an edge
    poses[0] = 0.0
    poses, points, normals, ways, half = (part.to(dtype) for part in (poses, points, normals, ways, HALF))
    for rows in (slice(None), slice(0, 0)):
        for corners in (True, False):
            found = []
            for name in ("torch", "numba"):
                with backend.force(name):
                    touches = rectangle_log_likelihoods(
                        poses, points[rows], normals[rows], half, TouchNoise(0.005, 0.1, 0.01), corners=corners
                    )
                    found.append((touches, way_clearances(poses, half, ways[rows])))
            (plain, clear), (quick, quick_clear) = found
            assert plain.dtype == quick.dtype == dtype and plain.shape == quick.shape
            loose = dtype == torch.float32
            assert torch.allclose(plain, quick, atol=2e-2 if loose else 1e-9, rtol=1e-3 if loose else 1e-9)
            assert torch.allclose(clear, quick_clear, atol=1e-6 if loose else 1e-12)
    batched = rectangle_log_likelihoods(poses.expand(2, 60, 3), points, normals, half, NOISE)
    assert torch.allclose(batched[1], rectangle_log_likelihoods(poses, points, normals, half, NOISE), atol=2e-2)


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_ways_and_tops_that_are_no_numbers_are_refused(bad: float) -> None:
    here, nowhere = RectangleTouches.none(HALF, NOISE, RADIUS), torch.tensor([0.0, bad], dtype=F64)
    for pair in ((HALF, nowhere), (nowhere, HALF)):
        with pytest.raises(ValueError, match="_w to be finite"):
            here.with_way(*pair)
    with pytest.raises(ValueError, match="over_w to be finite"):
        here.with_top(nowhere)


@pytest.mark.parametrize("version", ["torch", "numba"])
def test_poses_and_touches_of_another_shape_are_refused(no_shape_check, version: str) -> None:
    poses, points, ways = torch.zeros(4, 3), torch.zeros(5, 2), torch.zeros(6, 2, 2)
    with backend.force(version):
        for bad in ((poses[:, :2], points, points), (poses, torch.zeros(5, 3), torch.zeros(5, 3))):
            with pytest.raises(ValueError, match="to have shape"):
                rectangle_log_likelihoods(*bad, HALF, NOISE)
        for pair in ((poses[:, :2], ways), (poses, ways[:, 0])):
            with pytest.raises(ValueError, match="to have shape"):
                way_clearances(pair[0], HALF, pair[1])
