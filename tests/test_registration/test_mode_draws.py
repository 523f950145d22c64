"""Masses of modes against closed forms and dense enumeration, and the search that finds what a bad touch hides."""

import math
from dataclasses import replace

import pytest
import torch

from rumi.registration.contact_posterior import laplace_covariance, log_likelihood, mixture
from rumi.registration.contact_terms import LocalizeSettings, TouchFit
from rumi.registration.from_contacts import descended, localize
from rumi.registration.mode_draws import apart, laplace_mass, masses, moved, nearby, owners
from rumi.registration.touch_surface import TouchSurface
from rumi.seeding import generator
from scripts.localize_outliers import bracket, touches
from sdf import se3, so3
from sdf.symmetry import Symmetries

pytest.importorskip("scipy")

F64 = torch.float64


@pytest.fixture(scope="module")
def surface():
    return TouchSurface.of(bracket())


def gaussians(modes, covariance, log_mass):
    """Log-density of a sum of Gaussians of steps from modes."""
    plain = TouchSurface.of(bracket(), Symmetries.none())

    def at(poses):
        step = apart(plain, poses, modes)
        squared = (torch.linalg.solve(covariance[:, None], step[..., None])[..., 0] * step).sum(-1)
        size = torch.linalg.slogdet(2.0 * math.pi * covariance).logabsdet
        return (log_mass[:, None] - 0.5 * size[:, None] - 0.5 * squared).logsumexp(0)

    return at


def spread(seed, metres=0.002, radians=0.03):
    """A covariance with correlations."""
    root = torch.randn(6, 6, generator=generator(seed), dtype=F64) / math.sqrt(6.0)
    scale = torch.tensor([metres] * 3 + [radians] * 3, dtype=F64)
    return (root @ root.mT + 0.2 * torch.eye(6, dtype=F64)) * scale * scale[:, None]


def test_a_step_there_and_back(surface):
    poses = se3.make(so3.exp(torch.randn(4, 3, generator=generator(0), dtype=F64)), torch.zeros(4, 3, dtype=F64))
    step = 0.3 * torch.randn(4, 6, generator=generator(1), dtype=F64)
    back = apart(surface, moved(poses, step), poses)
    assert torch.allclose(back[torch.arange(4), torch.arange(4)], step, atol=1e-12)
    assert torch.equal(moved(poses, torch.zeros(4, 6, dtype=F64)), poses)


def test_masses_and_moments_of_gaussians(surface):
    """Also where the covariances that they start from are three times too wide or too narrow."""
    place = torch.tensor([[0.0, 0.0, 0.0], [0.03, 0.0, 0.0], [0.0, 0.0, 0.04]], dtype=F64)
    modes = se3.make(so3.exp(torch.randn(3, 3, generator=generator(2), dtype=F64)), place)
    covariance = torch.stack([spread(k) for k in (3, 4, 5)])
    log_mass = torch.tensor([0.6, 0.3, 0.1], dtype=F64).log() + 7.0
    target = gaussians(modes, covariance, log_mass)
    for given in (1.0, 9.0, 1.0 / 9.0):
        mass, moments = masses(surface, modes, given * covariance, target, draws=8000, generator=generator(6))
        assert torch.allclose(mass, log_mass, atol=0.15), given
        ratio = torch.linalg.eigvals(torch.linalg.solve(covariance, moments)).real
        assert float(ratio.min()) > 0.6 and float(ratio.max()) < 1.6, given
    assert torch.allclose(laplace_mass(target(modes), covariance), log_mass, atol=1e-6)


def enumerated(surface, modes, covariance, wide, target, count):
    """Mass of each mode: the mean over an even (Sobol) set in a box of 3.5 deviations, where it is the mode's own."""
    even = 2.0 * torch.quasirandom.SobolEngine(6, scramble=True, seed=0).draw(count, dtype=F64) - 1.0
    found = []
    for mode in range(len(modes)):
        values, vectors = torch.linalg.eigh(wide[mode])
        box = 3.5 * values.sqrt()
        poses = moved(modes[mode].expand(count, 4, 4), (even * box) @ vectors.mT)
        own = owners(apart(surface, poses, modes), covariance) == mode
        log = torch.where(own, target(poses), -math.inf)
        found.append(log.logsumexp(0) - math.log(count) + (2.0 * box).log().sum())
    return torch.stack(found)


@pytest.mark.parametrize("seed", [1000, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1015, 1024))])
def test_masses_are_those_of_dense_enumeration(seed, surface):
    """Twelve touches, one of them 15 mm off: the curvature at the best pose is no measure of its mass."""
    _, points, _ = touches(surface, 12, 1, 0.015, seed)
    settings = LocalizeSettings(noise_m=0.001)
    fit = mixture(surface, 0.001, settings, normals=False)
    found = localize(surface, points, settings=settings, generator=generator(seed))
    heavy = surface.centred(found.world_T_object[found.weights > 0.03])
    covariance, _ = laplace_covariance(surface, heavy, points, None, fit)

    def target(poses):
        return log_likelihood(surface, poses, points, None, fit)

    mass, moments = masses(surface, heavy, covariance, target, draws=20_000, generator=generator(0))
    exact = enumerated(surface, heavy, covariance, moments, target, 1 << 18).softmax(0)
    assert 0.5 * float((mass.softmax(0) - exact).abs().sum()) < 0.06


@pytest.mark.parametrize("seed", [1016, 1019, 1023])
def test_the_search_finds_what_a_descent_from_the_truth_does(seed, surface):
    """A bad touch pulls the squared loss away from the basin whose likelihood is greatest."""
    truth, points, _ = touches(surface, 12, 1, 0.015, seed)
    settings = LocalizeSettings(noise_m=0.001)
    fit = mixture(surface, 0.001, settings, normals=False)
    near_truth = descended(surface, surface.centred(truth)[None], points, None, TouchFit("absolute", True), 20)
    near_truth = descended(surface, near_truth, points, None, replace(fit, smooth_m=3e-5), 20)
    found = localize(surface, points, settings=settings, generator=generator(seed))
    best = float(log_likelihood(surface, near_truth, points, None, fit))
    assert float(found.log_likelihood.max()) > best - 0.1


def test_draws_nearby_are_the_likeliest(surface):
    modes = se3.identity((2,), dtype=F64)
    modes[1, 0, 3] = 0.5
    covariance = torch.stack([spread(k) for k in (3, 4)])
    target = gaussians(modes, covariance, torch.zeros(2, dtype=F64))
    found = nearby(modes, covariance, target, draws=40, kept=5, generator=generator(1))
    every = nearby(modes, covariance, target, draws=40, kept=40, generator=generator(1))
    assert found.shape == (10, 4, 4) and every.shape == (80, 4, 4)
    for mode in range(2):
        best = target(every[40 * mode : 40 * mode + 40]).sort(descending=True).values[:5]
        assert torch.allclose(target(found[5 * mode : 5 * mode + 5]).sort(descending=True).values, best)
