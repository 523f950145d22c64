"""Sequential test of faults against brute force over onsets, and its false alarms on simulated faultless readings."""

import itertools
import math

import numpy as np
import pytest
import torch
from torch import Tensor

from rumi.belief.change_test import Bound, ChangeEvidence, ChangeTest

WEIGHTS = (2.0, 1.0, 1.0)


def followed(test: ChangeTest, ratios: Tensor) -> list[ChangeEvidence]:
    """Evidence after each of (*b, n, K) readings."""
    evidence, found = test.begin(*ratios.shape[:-2]), []
    for reading in range(ratios.shape[-2]):
        evidence = test.update(evidence, ratios[..., reading, :])
        found.append(evidence)
    return found


def by_hand(ratios: np.ndarray, bound: str) -> tuple[float, np.ndarray, np.ndarray]:
    """Evidence, posterior and mean onsets of (n, K) ratios: every onset on its own."""
    count, kinds = ratios.shape
    share = np.array(WEIGHTS) / sum(WEIGHTS)
    prior = [1.0 if bound == "rate" else 1.0 / (onset * (onset + 1)) for onset in range(1, count + 1)]
    each = np.array(
        [[prior[onset] * math.exp(math.fsum(ratios[onset:, kind])) for kind in range(kinds)] for onset in range(count)]
    )
    none = 1.0 if bound == "rate" else 1.0 - math.fsum(prior)
    terms = np.concatenate(([none], share * each.sum(0)))
    numbers = np.arange(1, count + 1)[:, None]
    whole = terms[1:].sum() + (0.0 if bound == "rate" else none)
    return math.log(whole), terms / terms.sum(), (numbers * each).sum(0) / each.sum(0)


@pytest.mark.parametrize("bound", ["run", "rate"])
def test_every_onset_on_its_own_gives_the_same(bound: Bound) -> None:
    ratios = np.random.default_rng(0).normal(0.0, 2.0, (2, 9, 3))
    test = ChangeTest(WEIGHTS, bound=bound)
    for number, evidence in enumerate(followed(test, torch.tensor(ratios)), start=1):
        for run in range(2):
            whole, shares, onsets = by_hand(ratios[run, :number], bound)
            assert float(test.log_evidence(evidence)[run]) == pytest.approx(whole, abs=1e-9)
            np.testing.assert_allclose(test.explanations(evidence)[run], shares, atol=1e-12)
            np.testing.assert_allclose(test.onset(evidence)[run], onsets, rtol=1e-9)


def shifted(seed: int, runs: int, readings: int, shifts: tuple[float, ...]) -> Tensor:
    """Log ratios of faultless standard normal readings against shifted ones."""
    generator = torch.Generator().manual_seed(seed)
    x = torch.randn(runs, readings, 1, generator=generator, dtype=torch.float64)
    shift = torch.tensor(shifts, dtype=torch.float64)
    return shift * x - 0.5 * shift.square()


@pytest.mark.parametrize("alpha", [0.2, 0.05])
@pytest.mark.parametrize("shifts", [(1.0, -1.0, 3.0), (0.3, -0.3, 8.0)])
def test_faultless_runs_raise_no_more_alarms_than_set(alpha: float, shifts: tuple[float, ...]) -> None:
    test, runs = ChangeTest(WEIGHTS, alpha), 2000
    ratios = shifted(1, runs, 300, shifts)
    ever = torch.stack([test.alarm(evidence) for evidence in followed(test, ratios)]).any(0)
    # the bound holds for the rate itself; a count of 2000 scatters about it
    assert float(ever.double().mean()) <= alpha + 3.0 * math.sqrt(alpha * (1 - alpha) / runs)


def test_a_sum_over_onsets_is_a_martingale_of_mean_one() -> None:
    """Over all outcomes of a fair coin, at every reading: exactly 1."""
    ratio = torch.tensor(
        [[1.6, 0.5, 0.1], [0.4, 1.5, 1.9]], dtype=torch.float64
    ).log()  # of a head, of a tail; means of 1
    outcomes = torch.tensor(list(itertools.product((0, 1), repeat=8)))
    test = ChangeTest(WEIGHTS)
    for evidence in followed(test, ratio[outcomes]):
        assert float(test.log_evidence(evidence).exp().mean()) == pytest.approx(1.0, abs=1e-12)


def test_the_mean_run_to_a_false_alarm_is_as_long_as_set() -> None:
    test, runs = ChangeTest((1.0,), 0.02, "rate"), 1000
    ratios = shifted(2, runs, 600, (1.0,))
    alarms = torch.stack([test.alarm(evidence) for evidence in followed(test, ratios)])
    first = torch.where(alarms.any(0), alarms.to(torch.int8).argmax(0) + 1, 600)  # cut short: a lower bound
    assert float(first.double().mean()) >= 50.0


@pytest.mark.parametrize("bound", ["run", "rate"])
def test_a_fault_is_found_named_and_dated(bound: Bound) -> None:
    generator = torch.Generator().manual_seed(3)
    x = torch.randn(200, 30, 1, generator=generator, dtype=torch.float64)
    x[:, 20:] += 3.0
    shift = torch.tensor([3.0, -3.0], dtype=torch.float64)
    test = ChangeTest((1.0, 1.0), 0.01, bound)
    each = followed(test, shift * x - 0.5 * shift.square())
    assert float(test.alarm(each[25]).double().mean()) > 0.95
    shares = test.explanations(each[-1])
    assert shares.shape == (200, 3)
    assert bool((shares.argmax(-1) == 1).all())
    assert float((test.onset(each[-1])[:, 0] - 21.0).abs().median()) < 1.0


def test_powers_of_ratios_hold_the_bound_where_likelihoods_are_too_narrow() -> None:
    """Readings scatter 1.2 times as much as p has it."""
    test, runs = ChangeTest((1.0, 1.0), 0.05), 2000
    generator = torch.Generator().manual_seed(4)
    x = 1.2 * torch.randn(runs, 200, 1, generator=generator, dtype=torch.float64)
    shift = torch.tensor([3.0, -3.0], dtype=torch.float64)
    ever = torch.stack([test.alarm(e) for e in followed(test, 0.5 * (shift * x - 0.5 * shift.square()))]).any(0)
    assert float(ever.double().mean()) <= 0.05


@pytest.mark.parametrize("bound", ["run", "rate"])
@pytest.mark.parametrize("value", [-torch.inf, -1e300, -1e4, 0.0, 1e4, 1e300, torch.inf])
def test_extreme_ratios_leave_numbers(bound: Bound, value: float) -> None:
    test = ChangeTest((1.0, 1e-300), bound=bound)
    ratios = torch.tensor([[value, 0.0], [value, value], [0.0, -torch.inf]], dtype=torch.float64)
    for evidence in followed(test, ratios.repeat(5, 1)):
        assert not bool(test.log_evidence(evidence).isnan())
        shares = test.explanations(evidence)
        assert float(shares.sum()) == pytest.approx(1.0)
        assert bool(test.onset(evidence).isfinite().all())
        assert bool((test.onset(evidence) <= float(evidence.readings) + 1e-6).all())


def test_no_reading_is_no_evidence() -> None:
    test = ChangeTest(WEIGHTS)
    evidence = test.begin(4)
    np.testing.assert_allclose(test.log_evidence(evidence), 0.0, atol=1e-12)
    np.testing.assert_allclose(test.explanations(evidence)[:, 0], 1.0)
    assert not bool(test.alarm(evidence).any())


@pytest.mark.usefixtures("no_shape_check")
def test_what_has_no_meaning_is_refused() -> None:
    for given in ({"weights": ()}, {"weights": (1.0, 0.0)}, {"alpha": 0.0}, {"alpha": 1.0}, {"bound": "week"}):
        with pytest.raises(ValueError, match="Expected"):
            ChangeTest(**given)
    test = ChangeTest(WEIGHTS)
    with pytest.raises(ValueError, match="NaN"):
        test.update(test.begin(), torch.tensor([0.0, torch.nan, 0.0]))
    with pytest.raises(ValueError, match="one for each alternative"):
        test.update(test.begin(), torch.zeros(2))
