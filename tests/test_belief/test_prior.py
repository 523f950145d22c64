"""The prior of an object that no camera sees: how it lies, and where poses are drawn."""

import math

import pytest
import torch

from rumi.belief.prior import REACH, PlanarPrior, PosePrior, lying
from rumi.errors import UsageError
from sdf import se3
from sdf.drill import Drill
from sdf.object_model import box_model

HALF = (0.030, 0.079, 0.105)
BOUNDS = torch.tensor([[-h for h in HALF], list(HALF)], dtype=torch.float64)


def box_prior(**changes):
    values = {"mean": (0.4, 0.1), "spread_m": 0.05, "bounds": BOUNDS, "up": ("x", "y", "z")} | changes
    return PosePrior.of(values["mean"], values["spread_m"], values["bounds"], values["up"])


@pytest.mark.parametrize(("up", "height"), list(zip("xyz", HALF, strict=True)))
def test_lies_on_the_floor(up, height):
    pose = lying(BOUNDS, up)
    assert float(torch.linalg.det(pose[:3, :3])) == pytest.approx(1.0)
    axis = torch.eye(3, dtype=torch.float64)["xyz".index(up)]
    assert (pose[:3, :3] @ axis).tolist() == [0.0, 0.0, 1.0]
    points = se3.apply(pose, box_model().surface_points.double())
    assert float(points[:, 2].min()) == pytest.approx(0.0, abs=1e-6)
    assert float(points[:, 2].max()) == pytest.approx(2 * height, abs=1e-6)


def test_an_object_with_its_origin_on_the_floor_stays_there():
    assert torch.equal(lying(Drill().bounds, "z"), torch.eye(4))


def test_spread_poses_are_even_and_within_reach(generator):
    prior = box_prior()
    poses = prior.spread_poses(3000, generator=generator)
    off = poses[:, :2, 3] - prior.mean
    radius = off.norm(dim=-1) / prior.spread_m
    assert float(radius.max()) <= REACH
    # even over the disc: a quarter within half of its radius
    assert float((radius < 0.5 * REACH).double().mean()) == pytest.approx(0.25, abs=0.02)
    assert off.mean(0).abs().max() < 0.005
    for way, height in enumerate(HALF):
        own = poses[way::3]
        assert torch.allclose(own[:, 2, 3], torch.tensor(height, dtype=torch.float64))
        up = own[:, 2, :3].abs().argmax(-1)
        assert bool((up == way).all())
        # each at all yaws
        side = own[:, :2, (way + 1) % 3]
        yaw = torch.atan2(side[:, 1], side[:, 0])
        counts = torch.histc(yaw, 8, -math.pi, math.pi)
        assert float(counts.min()) > 100


def test_the_same_seed_gives_the_same_poses():
    draw = [box_prior().spread_poses(50, generator=torch.Generator().manual_seed(seed)) for seed in (3, 3, 4)]
    assert torch.equal(draw[0], draw[1]) and not torch.equal(draw[0], draw[2])


def test_the_density_is_that_of_a_normal_distribution(generator):
    prior = box_prior()
    poses = prior.spread_poses(20, generator=generator)
    expected = torch.distributions.Normal(prior.mean, prior.spread_m).log_prob(poses[:, :2, 3]).sum(-1)
    difference = prior.negative_log_density(poses) + expected
    torch.testing.assert_close(difference, difference[:1].expand(20))


def test_moves_to_another_dtype(generator):
    prior = box_prior().to(torch.float32)
    assert prior.spread_poses(4, generator=generator).dtype == torch.float32


@pytest.mark.parametrize(
    ("changes", "message"), [({"spread_m": 0.0}, "spread_m to be positive"), ({"up": ("xy",)}, "x, y or z, got 'xy'")]
)
def test_refuses_what_has_no_meaning(changes, message):
    with pytest.raises(UsageError, match=message):
        box_prior(**changes)


def test_prior_density_is_a_density() -> None:
    """Sums to 1 over a fine lattice, yaw wrapped, and draws have its moments."""
    own = PlanarPrior(
        torch.tensor([[0.0, 0.0, 3.0], [0.3, 0.1, 0.0]], dtype=torch.float64),
        torch.tensor([0.05, 0.04, 0.3], dtype=torch.float64),
        torch.tensor([1.0, 3.0], dtype=torch.float64),
    )
    axes = [torch.linspace(-0.3, 0.6, 91), torch.linspace(-0.3, 0.4, 71), torch.linspace(-math.pi, math.pi, 64)[:-1]]
    steps = [float(a[1] - a[0]) for a in axes]
    grid = torch.stack(torch.meshgrid(*[a.double() for a in axes], indexing="ij"), -1)
    assert float(own.log_density(grid).exp().sum()) * math.prod(steps) == pytest.approx(1.0, abs=1e-3)
    draws = own.sample(4000, generator=torch.Generator().manual_seed(0))
    assert float((draws[:, 0] > 0.15).double().mean()) == pytest.approx(0.75, abs=0.03)
