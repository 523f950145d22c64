"""Priors by some shapes alone: what is left out is not looked at, and scales are recovered."""

import pytest
import torch

from scripts.bench.push_priors import FACTORS, POWERS, Choice, _t_scale, chosen_factor, chosen_power, label, without

FITS = {f"{surface} {shape}": (0.0,) * 8 for surface in ("abs", "plywood") for shape in ("rect1", "tri1", "hex")}


def test_shapes_and_surfaces_are_left_out():
    assert set(without(FITS, ("hex",))) == {"abs rect1", "abs tri1", "plywood rect1", "plywood tri1"}
    assert set(without(FITS, ("hex", "tri1"), "abs")) == {"plywood rect1"}


def test_a_shape_s_own_sets_have_no_say_in_what_is_chosen_for_it():
    names, best, other = ("rect1", "tri1", "hex"), POWERS[1], POWERS[-1]

    def powers(liked: float) -> dict[str, float]:
        return {label(Choice(power, 1.0)): float(power == liked) for power in POWERS}

    def factors(right: float) -> dict[str, float]:
        return {f"{factor:g}": 0.9 - 0.1 * (factor != right) for factor in FACTORS}

    for mine in (best, other):
        found = {
            f"abs {shape}": {left: powers(mine if shape == "hex" else best) for left in names if left != shape}
            for shape in names
        }
        assert chosen_power(found, ("hex",)) == best
    for mine in (FACTORS[0], FACTORS[1]):
        found = {
            f"abs {shape}": {left: factors(mine if shape == "hex" else FACTORS[1]) for left in names if left != shape}
            for shape in names
        }
        assert chosen_factor(found, ("hex",)) == FACTORS[1]


def test_a_t_scale_is_that_of_the_draws():
    generator = torch.Generator().manual_seed(0)
    normal = torch.randn(20_000, generator=generator, dtype=torch.float64)
    chi = 2.0 * torch._standard_gamma(torch.full((20_000,), 2.0, dtype=torch.float64), generator=generator)
    assert _t_scale(3.0 * normal / (chi / 4.0).sqrt()) == pytest.approx(3.0, rel=0.03)
