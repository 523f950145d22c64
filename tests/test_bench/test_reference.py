"""The reference posterior on a grid: right where the answer is known, and sure of itself elsewhere."""

import math

import pytest
import torch

from scripts.bench.posteriors import stand_ins
from scripts.bench.reference import boltzmann, grid_posterior
from sdf import backend, se3
from sdf.primitives import Box, Mug
from sensors.discrepancy import Discrepancy
from sensors.observation import Observation, concatenate
from sensors.semantics import Semantics

F64 = torch.float64
WIDE = ((-0.04, -0.04), (0.04, 0.04))


def normal(mean, std):
    mean, std = torch.tensor(mean, dtype=F64), torch.tensor(std, dtype=F64)

    def log_density(planar):
        off = planar - mean
        off = torch.cat((off[:, :2], torch.remainder(off[:, 2:] + math.pi, 2 * math.pi) - math.pi), -1)
        return -0.5 * (off / std).square().sum(-1)

    return log_density


def moments(found):
    weights = found.log_weights.exp()[:, None]
    mean = (weights * found.planar).sum(0)
    return mean, (weights * (found.planar - mean).square()).sum(0).sqrt()


def test_a_normal_posterior_has_its_moments():
    found = grid_posterior(normal((0.003, -0.004, 0.5), (0.002, 0.003, 0.1)), *WIDE)
    mean, std = moments(found)
    torch.testing.assert_close(mean, torch.tensor([0.003, -0.004, 0.5], dtype=F64), atol=2e-5, rtol=1e-3)
    torch.testing.assert_close(std, torch.tensor([0.002, 0.003, 0.1], dtype=F64), atol=0, rtol=0.01)
    assert float(found.log_weights.exp().sum()) == pytest.approx(1.0)
    assert found.change < 0.01
    assert found.dropped < 1e-3


def test_all_modes_are_kept_also_across_the_cut_of_the_circle():
    one, two = normal((0.01, 0.0, math.pi), (0.002, 0.002, 0.1)), normal((-0.01, 0.0, 0.0), (0.002, 0.002, 0.1))
    found = grid_posterior(lambda p: torch.logaddexp(one(p), two(p) + math.log(3.0)), *WIDE)
    left = found.planar[:, 0] < 0
    assert float(found.log_weights[left].exp().sum()) == pytest.approx(0.75, abs=1e-3)
    beyond = found.planar[~left, 2]
    share = float(found.log_weights[~left][beyond > 0].exp().sum())
    assert share == pytest.approx(0.125, abs=1e-3)


def test_it_says_when_its_cells_do_not_suffice():
    with pytest.raises(RuntimeError, match="10000 cells"):
        grid_posterior(normal((0, 0, 0), (0.02, 0.02, 1.0)), *WIDE, largest=10000)


def observed(sdf, count=60):
    random = torch.Generator().manual_seed(3)
    low, high = sdf.bounds
    places = low - 0.03 + (high - low + 0.06) * torch.rand(count, 3, generator=random, dtype=F64)
    kinds = (Semantics.FREE, Semantics.OCCUPIED, Semantics.SURFACE)
    return concatenate([Observation.of(part, kind) for part, kind in zip(places.chunk(3), kinds, strict=True)])


@pytest.mark.parametrize("version", ["torch", None])
@pytest.mark.parametrize("shape", [Mug(tube_radius=0.008, ring_radius=0.035), Box((0.03, 0.04, 0.05))])
def test_the_density_is_the_filters(shape, version):
    shape = shape.double()
    memory = observed(shape)
    random = torch.Generator().manual_seed(1)
    # wide enough apart for several blocks, near enough for free points to be left out
    planar = torch.randn(700, 3, generator=random, dtype=F64) * torch.tensor([0.01, 0.01, 0.8], dtype=F64)
    expected = -2.0 * Discrepancy(shape, 1.0, free_scale=80.0, tolerance=0.001)(se3.from_planar(planar), memory)
    if version is None:
        found = boltzmann(shape, memory)(planar)
    else:
        with backend.force(version):
            found = boltzmann(shape, memory)(planar)
    torch.testing.assert_close(found, expected, rtol=1e-10, atol=1e-9)


def test_stand_ins_have_the_posteriors_moments():
    found = grid_posterior(normal((0.003, -0.004, 0.5), (0.002, 0.003, 0.1)), *WIDE)
    planar = se3.to_planar(stand_ins(found, 4000))
    mean, std = moments(found)
    torch.testing.assert_close(planar.mean(0), mean, atol=1e-4, rtol=0.01)
    torch.testing.assert_close(planar.std(0), std, atol=0, rtol=0.02)
    drawn = found.drawn(4000, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(drawn.std(0), std, atol=0, rtol=0.06)
