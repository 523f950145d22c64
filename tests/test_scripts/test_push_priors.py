"""Priors by some shapes alone: what is left out is not looked at, and scales are recovered."""

import math

import pytest
import torch

from rumi.dynamics.push_density import PushResidual
from scripts.bench import push_priors
from scripts.bench.push_priors import FACTORS, _t_scale, chosen_factor, without

FITS = {f"{surface} {shape}": (0.0,) * 8 for surface in ("abs", "plywood") for shape in ("rect1", "tri1", "hex")}


def test_shapes_and_surfaces_are_left_out():
    assert set(without(FITS, ("hex",))) == {"abs rect1", "abs tri1", "plywood rect1", "plywood tri1"}
    assert set(without(FITS, ("hex", "tri1"), "abs")) == {"plywood rect1"}


def test_a_shape_s_own_sets_have_no_say_in_what_is_chosen_for_it():
    names = ("rect1", "tri1", "hex")

    def factors(right: float) -> dict[str, float]:
        return {f"{factor:g}": 0.9 - 0.1 * (factor != right) for factor in FACTORS}

    for mine in (FACTORS[0], FACTORS[1]):
        found = {
            f"abs {shape}": {left: factors(mine if shape == "hex" else FACTORS[1]) for left in names if left != shape}
            for shape in names
        }
        assert chosen_factor(found, ("hex",)) == pytest.approx(FACTORS[1])


def test_regions_hold_enough_of_the_shape_that_is_held_least():
    def line(least: float) -> dict[str, float]:
        return {f"{factor:g}": min(1.0, least + 0.05 * index) for index, factor in enumerate(FACTORS)}

    held = {"abs rect1": {"hex": line(0.99)}, "abs tri1": {"hex": line(0.75)}, "abs hex": {"rect1": line(0.0)}}
    assert chosen_factor(held, ("hex",)) == pytest.approx(0.84)  # the triangle has 75, 80 and 85 %, the mean 90 at 0.8
    assert chosen_factor({name: {"hex": line(0.1)} for name in held}, ("hex",)) == FACTORS[-1]


def test_an_object_s_own_scale_is_recovered(monkeypatch):
    generator, common = torch.Generator().manual_seed(0), PushResidual()
    way = 0.05 * torch.rand(4000, generator=generator, dtype=torch.float64)
    chi = 2.0 * torch._standard_gamma(torch.full((4000, 1), 0.5 * common.tails).double(), generator=generator)
    normal = torch.randn(4000, 3, generator=generator, dtype=torch.float64)
    off = 1.4 * common.scale(way) * normal * (common.tails / chi).sqrt()
    monkeypatch.setattr(push_priors, "_residuals", lambda name, parameters: (off, way))
    assert push_priors._log_scale("abs hex", (0.0,) * 8, common) == pytest.approx(math.log(1.4), abs=0.05)


def test_a_t_scale_is_that_of_the_draws():
    generator = torch.Generator().manual_seed(0)
    normal = torch.randn(20_000, generator=generator, dtype=torch.float64)
    chi = 2.0 * torch._standard_gamma(torch.full((20_000,), 2.0, dtype=torch.float64), generator=generator)
    assert _t_scale(3.0 * normal / (chi / 4.0).sqrt()) == pytest.approx(3.0, rel=0.03)
