"""What a motion is expected to tell by touching."""

import math

import pytest
import torch

from rumi.information.contact_gain import Outcomes, add_noise, rectangle_likelihood, touch_gain, with_kinds
from sdf import se3
from sdf.sweep import sweep_rectangle
from sensors.touch.touch_likelihood import TouchNoise

F64 = torch.float64
HALF = torch.tensor([0.1, 0.05], dtype=F64)
NOISE = TouchNoise()
RADIUS = 0.0125


# every test of this file holds for the plain and for the compiled version
pytestmark = pytest.mark.usefixtures("version")


def believed(count=120, spread=(0.02, 0.02, 0.2)):
    generator = torch.Generator().manual_seed(0)
    poses = torch.randn(count, 3, generator=generator, dtype=F64) * torch.tensor(spread, dtype=F64)
    return poses, 0.3 * torch.randn(count, generator=generator, dtype=F64)


def gains(poses, log, start, end, **options):
    sweep = sweep_rectangle(poses, HALF, start[..., None, :], end[..., None, :], RADIUS)
    return touch_gain(log, Outcomes.of(sweep), rectangle_likelihood(poses, HALF, NOISE), **options)


STARTS = torch.tensor([[0.0, 0.3], [0.3, 0.0], [0.2, 0.2], [0.09, 0.3], [0.6, 0.6]], dtype=F64)
ENDS = torch.tensor([[0.0, -0.3], [-0.3, 0.0], [0.05, 0.05], [0.09, -0.3], [0.9, 0.9]], dtype=F64)


@pytest.mark.parametrize("options", [{}, {"readings": 40}, {"readings": 40, "noise": NOISE}, {"noise": NOISE}])
def test_it_is_never_negative_and_nothing_where_nothing_is_met(options):
    poses, log = believed()
    if options:
        options = options | {"generator": torch.Generator().manual_seed(1)}
    found = gains(poses, log, STARTS, ENDS, **options)
    assert found.shape == (5,)
    assert bool((found >= 0).all())
    assert float(found[4]) < 1e-12
    assert bool((found[:4] > 0.5).all())


def test_whether_it_is_met_at_all_is_told_too():
    # one state of two is missed: which it is, is all there is to tell
    poses = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.5, 0.0]], dtype=F64)
    start, end = torch.tensor([0.3, 0.0], dtype=F64), torch.tensor([-0.3, 0.0], dtype=F64)
    found = gains(poses, torch.zeros(2, dtype=F64), start, end)
    assert float(found) == pytest.approx(math.log(2.0))


def test_contact_counts_wherever_on_the_way_it_is():
    # two states, 60 mm apart along the way: both are met, long before the nominal end and after it
    poses = torch.tensor([[0.0, 0.03, 0.0], [0.0, -0.03, 0.0]], dtype=F64)
    start, end = torch.tensor([0.0, 0.3], dtype=F64), torch.tensor([0.0, 0.0], dtype=F64)
    assert float(gains(poses, torch.zeros(2, dtype=F64), start, end)) == pytest.approx(math.log(2.0), abs=1e-6)
    # cut off before the nearer one it tells nothing, and between them which one it is
    for stop, wanted in ((0.15, 0.0), (0.06, math.log(2.0))):
        cut = torch.tensor([0.0, stop], dtype=F64)
        assert float(gains(poses, torch.zeros(2, dtype=F64), start, cut)) == pytest.approx(wanted, abs=1e-6)


def test_noisy_readings_give_the_mutual_information():
    """Heights of a long side, Gaussian, felt from above with Gaussian noise: 1/2 log(1 + spread^2 / noise^2)."""
    generator = torch.Generator().manual_seed(2)
    for spread in (0.005, 0.02):
        poses = torch.zeros(800, 3, dtype=F64)
        poses[:, 1] = spread * torch.randn(800, generator=generator, dtype=F64)
        start, end = torch.tensor([0.0, 0.4], dtype=F64), torch.tensor([0.0, -0.1], dtype=F64)
        log = torch.zeros(800, dtype=F64)
        found = gains(poses, log, start, end, readings=400, noise=NOISE, generator=generator)
        assert float(found) == pytest.approx(0.5 * math.log1p((spread / 0.005) ** 2), rel=0.1)
        if spread == NOISE.point_m:
            # without noise it is another number, the paper's
            assert float(gains(poses, log, start, end)) < 0.8 * float(found)


def test_a_rigid_change_of_world_changes_nothing():
    poses, log = believed()
    world = torch.tensor([0.4, -1.0, 2.0], dtype=F64)
    rigid = se3.from_planar(world)[:2, :2]
    place = poses[:, :2] @ rigid.mT + world[:2]
    moved = torch.cat((place, poses[:, 2:] + 2.0), -1)
    before = gains(poses, log, STARTS, ENDS)
    after = gains(moved, log, STARTS @ rigid.mT + world[:2], ENDS @ rigid.mT + world[:2])
    assert torch.allclose(before, after, atol=1e-8)


def test_noise_is_what_it_says():
    generator = torch.Generator().manual_seed(5)
    for dims in (2, 3):
        normal = torch.nn.functional.normalize(torch.ones(4000, dims, dtype=F64), dim=-1)
        points, normals = add_noise(torch.zeros(4000, dims, dtype=F64), normal, NOISE, generator=generator)
        assert torch.allclose(points.std(0), torch.full((dims,), 0.005, dtype=F64), rtol=0.1)
        angle = torch.acos((normals * normal).sum(-1).clamp(-1, 1))
        assert float(angle.square().mean().sqrt()) == pytest.approx(NOISE.normal_rad * math.sqrt(dims - 1), rel=0.1)
        assert torch.allclose(normals.norm(dim=-1), torch.ones(4000, dtype=F64))


def test_kinds():
    generator = torch.Generator().manual_seed(6)
    likelihood = torch.randn(4, 5, generator=generator, dtype=F64)
    reading, state = torch.tensor([0, 1, 2, 1]), torch.tensor([1, 1, 0, 2, 3])
    told = with_kinds(likelihood, reading, state)
    same = reading[:, None] == state
    assert torch.equal(told[same], likelihood[same]) and bool((told[~same] == -math.inf).all())


def test_what_cannot_be(no_shape_check):
    poses, log = believed(5)
    with pytest.raises(ValueError, match="need a generator"):
        gains(poses, log, STARTS, ENDS, readings=3)
    with pytest.raises(ValueError, match="one reading or more"):
        gains(poses, log, STARTS, ENDS, readings=0, generator=torch.Generator())
    with pytest.raises(ValueError, match="log_weights"):
        gains(poses, log[:4], STARTS, ENDS)
