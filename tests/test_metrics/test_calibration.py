"""Calibration: levels and ranks of calibrated beliefs are even, errors are those by hand, tiny beliefs are taken."""

import math

import pytest
import torch

from rumi.belief.particles import PoseBelief
from rumi.metrics.calibration import (
    calibration_error,
    chance_error,
    checked,
    covered,
    fitted_odds,
    rank_test,
    reliability,
)
from rumi.seeding import generator
from sdf import se3
from sdf.symmetry import Symmetries

TOLERANCE = {"within_m": 0.005, "within_rad": math.radians(10.0)}
SPREAD = torch.tensor([0.003, 0.003, 0.08], dtype=torch.float64)


def beliefs(count: int, width: float = 1.0, particles: int = 80):
    """Beliefs of particles and truths from the same normal density, or particles from a wider one."""
    random = generator(3)
    for _ in range(count):
        middle = SPREAD * torch.randn(3, generator=random, dtype=torch.float64)
        drawn = width * SPREAD * torch.randn(particles, 3, generator=random, dtype=torch.float64)
        truth = SPREAD * torch.randn(3, generator=random, dtype=torch.float64)
        yield PoseBelief.uniform(se3.from_planar(middle + drawn, 0.1)), se3.from_planar(middle + truth, 0.1)


def test_of_particles_and_truths_from_one_density_all_is_even():
    found = [checked(*pair, Symmetries.none(), **TOLERANCE) for pair in beliefs(200)]
    for part in ("place", "turn", "both"):
        for share in (0.5, 0.9):
            sd = math.sqrt(share * (1 - share) / 200)
            assert abs(covered([getattr(one, part) for one in found], share) - share) < 3.5 * sd
    assert set(found[0].ranks) == {"x", "y", "turn z"}  # what is held is left out
    for name in found[0].ranks:
        assert rank_test([one.ranks[name] for one in found]) > 0.003
    p_right, right = [one.p_right for one in found], [one.right for one in found]
    assert calibration_error(p_right, right) < 2.5 * chance_error(p_right)


def test_too_wide_and_too_narrow_beliefs_are_found_out():
    wide = [checked(*pair, Symmetries.none(), **TOLERANCE) for pair in beliefs(100, width=3.0)]
    narrow = [checked(*pair, Symmetries.none(), **TOLERANCE) for pair in beliefs(100, width=0.3)]
    assert covered([one.both for one in wide], 0.5) > 0.8 and covered([one.both for one in narrow], 0.9) < 0.5
    for found in (wide, narrow):
        assert rank_test([one.ranks["x"] for one in found]) < 1e-4
        p_right, right = [one.p_right for one in found], [one.right for one in found]
        assert calibration_error(p_right, right) > 2.0 * chance_error(p_right)


def test_a_turn_that_looks_the_same_is_no_error():
    belief, _ = next(beliefs(1))
    truth = belief.mode() @ se3.from_planar(torch.tensor([0.0, 0.0, math.pi], dtype=torch.float64))
    there = Symmetries.parse("z2").to(torch.float64)
    assert checked(belief, truth, there, **TOLERANCE).right
    assert not checked(belief, truth, Symmetries.none(), **TOLERANCE).right


@pytest.mark.parametrize("particles", [1, 2, 1000])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_any_number_of_particles(particles, dtype):
    belief, truth = next(beliefs(1, particles=particles))
    found = checked(belief.to(dtype=dtype), truth.to(dtype), Symmetries.none(), **TOLERANCE)
    assert all(0.0 <= level <= 1.0 for level in (found.place, found.turn, found.both, *found.ranks.values()))
    only = torch.full((particles,), -torch.inf, dtype=dtype).index_fill(0, torch.tensor(0), 0.0)
    one = checked(belief.to(dtype=dtype).reweighted(only), truth.to(dtype), Symmetries.none(), **TOLERANCE)
    assert 0.0 <= one.both <= 1.0 and math.isfinite(one.p_right)


def test_errors_by_hand():
    p, right = [0.95, 0.91, 0.15, 0.11, 0.13, 1.0], [True, False, False, False, True, True]
    bins = reliability(p, right)
    assert [(one.beliefs, round(one.p_right, 4), round(one.right, 4)) for one in bins] == [
        (3, 0.13, 0.3333),
        (3, 0.9533, 0.6667),
    ]
    assert calibration_error(p, right) == pytest.approx((abs(0.39 - 1) + abs(2.86 - 2)) / 6)
    assert calibration_error([], []) == 0.0 and math.isnan(covered([], 0.5))
    assert chance_error([1.0, 0.0]) == 0.0
    assert chance_error([0.5] * 4) == chance_error([0.5] * 4) > 0.1


def test_beliefs_that_are_right_together_err_by_chance_as_one():
    """Each looked at three times errs as each looked at once; taken for three by itself it would err less."""
    p = [0.05 + 0.1 * (k % 10) for k in range(60)]
    thrice = [value for value in p for _ in range(3)]
    together = [k // 3 for k in range(len(thrice))]
    assert chance_error(thrice, groups=together) == pytest.approx(chance_error(p), abs=1e-9)
    assert chance_error(thrice, groups=range(len(thrice))) == chance_error(thrice) < 0.7 * chance_error(p)
    assert chance_error([], groups=[]) == 0.0


def test_ranks_by_hand():
    # ten of each of ten bins; then all in one bin, where chi-squared is 900 of 9 degrees
    even = [(k + 0.5) / 100 for k in range(100)]
    assert rank_test(even) == pytest.approx(1.0)
    assert rank_test([0.05] * 100) < 1e-12
    # 4 bins, 20 ranks: counts 8, 4, 4, 4 give 12.8 / 5 = 2.4, of 3 degrees P = 0.4936
    assert rank_test([0.1] * 8 + [0.3] * 4 + [0.6] * 4 + [1.0] * 4, bins=4) == pytest.approx(0.4936, abs=1e-3)
    with pytest.raises(ValueError, match="one rank or more"):
        rank_test([])


def test_fitted_odds_are_those_by_hand():
    found = fitted_odds([0.5] * 100, [True] * 60 + [False] * 40)
    assert found is not None and found.ratio == pytest.approx(1.5)
    assert math.log(found.high / found.ratio) == pytest.approx(1.0 / math.sqrt(100 * 0.6 * 0.4), rel=1e-6)
    assert found.high / found.ratio == pytest.approx(found.ratio / found.low)


@pytest.mark.parametrize("odds", [0.2, 1.0, 3.0])
def test_odds_are_found_of_beliefs_that_are_off_by_them(odds):
    said = torch.rand(20000, generator=generator(5), dtype=torch.float64)
    right = torch.rand(20000, generator=generator(6), dtype=torch.float64) < recalibrated_(said, odds)
    found = fitted_odds(said.tolist(), right.tolist())
    assert found is not None and abs(math.log(found.ratio / odds)) < 4.0 * math.log(found.high / found.ratio) < 0.2
    again = fitted_odds(recalibrated_(said, found.ratio).tolist(), right.tolist())
    assert again is not None and again.ratio == pytest.approx(1.0, abs=1e-3)


def recalibrated_(p: torch.Tensor, odds: float) -> torch.Tensor:
    return (p.logit() + math.log(odds)).sigmoid()


def test_beliefs_of_a_group_tell_once():
    said, right = [0.3, 0.5, 0.9, 0.6], [False, True, True, False]
    once = fitted_odds(said, right)
    thrice = fitted_odds(said * 3, right * 3, groups=list("abcd") * 3)
    assert once is not None and thrice == pytest.approx(once)


@pytest.mark.parametrize("right", [[], [True, True], [False, False]])
def test_no_odds_where_all_are_right_or_none(right):
    assert fitted_odds([0.2, 1.0][: len(right)], right) is None


def test_odds_of_certain_beliefs_are_finite():
    found = fitted_odds([1.0, 1.0, 0.0], [True, False, False])
    assert found is not None and all(math.isfinite(value) for value in found)
