"""Expected gain of touch: golden numbers, mutual information spelt out, the channel's capacity as a ceiling."""

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from rumi.information.binary_gain import binary_gain, expected_gain
from rumi.information.entropy import SharedSupport, weights_entropy
from rumi.information.neighbours import StateMetric
from tests.fixtures.channel import channel_capacity

DOUBLE = {"dtype": torch.float64}
SUPPORT = SharedSupport(StateMetric.euclidean(2))


def test_golden_outcome(golden: Callable[[str], dict[str, Any]]) -> None:
    case = golden("eig.binary")
    log, p = torch.tensor(case["inputs"]["w"], **DOUBLE).log(), torch.tensor(case["expected"]["p1"], **DOUBLE)
    gain, entropy, expected = binary_gain(log, p), weights_entropy(log), case["expected"]
    for value, name in ((entropy, "H_w0"), (entropy - gain, "E_H"), (gain, "IG_w")):
        assert float(value) == pytest.approx(expected[name], abs=case["atol"])


def test_golden_capacity(golden: Callable[[str], dict[str, Any]]) -> None:
    case = golden("eig.capacity")
    found = channel_capacity(case["inputs"]["alpha_fp"], case["inputs"]["alpha_tp"])
    assert found == pytest.approx(case["expected"]["capacity"], abs=case["atol"])


def test_capacity_at_the_ends() -> None:
    assert channel_capacity(0.0, 1.0) == pytest.approx(math.log(2), abs=1e-12)
    assert channel_capacity(0.3, 0.3) == 0.0
    # a reading that is never wrong when it says contact: the Z channel
    assert channel_capacity(0.0, 0.5) == pytest.approx(math.log(1 + 0.5 * 0.5), abs=1e-12)
    with pytest.raises(ValueError, match="low <= high"):
        channel_capacity(0.5, 0.4)


def double_loop(w: list[float], p: list[float]) -> float:
    """Eqs 7-8 as printed: every particle in turn is the truth and has both readings by their probabilities."""
    total = 0.0
    for truth, weight in enumerate(w):
        for contact in (True, False):
            chance = p[truth] if contact else 1 - p[truth]
            joint = [wi * (pi if contact else 1 - pi) for wi, pi in zip(w, p, strict=True)]
            mass = sum(joint)
            if weight * chance > 0:
                total += weight * chance * -sum(j / mass * math.log(j / mass) for j in joint if j > 0)
    return total


beliefs = st.lists(st.tuples(st.floats(1e-3, 1.0), st.floats(0.0, 1.0)), min_size=1, max_size=12)


@given(beliefs)
def test_gain_is_mutual_information(belief: list[tuple[float, float]]) -> None:
    """h(mean) - mean h: of reading and state. And the double loop over truths gives the same."""
    weights = [w / sum(v for v, _ in belief) for w, _ in belief]
    p = [q for _, q in belief]
    log = torch.tensor(weights, **DOUBLE).log()
    gain = float(binary_gain(log, torch.tensor(p, **DOUBLE)))

    def entropy(q: float) -> float:
        return -sum(v * math.log(v) for v in (q, 1 - q) if v > 0)

    mean = min(1.0, sum(w * q for w, q in zip(weights, p, strict=True)))
    information = entropy(mean) - sum(w * entropy(q) for w, q in zip(weights, p, strict=True))
    assert gain == pytest.approx(information, abs=1e-9)
    assert float(weights_entropy(log)) - gain == pytest.approx(double_loop(weights, p), abs=1e-9)
    assert gain >= -1e-12


@given(beliefs, st.floats(0.0, 1.0), st.floats(0.0, 1.0))
def test_no_reading_tells_more_than_its_channel_carries(belief: list[tuple[float, float]], a: float, b: float) -> None:
    low, high = min(a, b), max(a, b)
    log = torch.tensor([w for w, _ in belief], **DOUBLE).log()
    p = low + (high - low) * torch.tensor([q for _, q in belief], **DOUBLE)
    assert float(binary_gain(log, p)) <= channel_capacity(low, high) + 1e-9


def test_the_ceiling_is_reached() -> None:
    """Two heaps, one touched and one not, at the best share."""
    shares = torch.linspace(0.01, 0.99, 981, **DOUBLE)
    log = torch.stack((1 - shares, shares), -1).log()
    gain = binary_gain(log, torch.tensor([0.1, 0.5], **DOUBLE))
    assert float(gain.max()) == pytest.approx(channel_capacity(0.1, 0.5), abs=1e-6)


@pytest.mark.parametrize("certain", [0.0, 1.0])
def test_an_outcome_that_cannot_happen_counts_nothing(certain: float) -> None:
    found = binary_gain(torch.zeros(5, **DOUBLE), torch.full((5,), certain, **DOUBLE))
    assert float(found) == pytest.approx(0.0, abs=1e-12)
    told = binary_gain(torch.zeros(2, **DOUBLE), torch.tensor([0.0, 1.0], **DOUBLE))
    assert float(told) == pytest.approx(math.log(2), abs=1e-12)


def walks(
    generator: torch.Generator, candidates: int = 4, steps: int = 6, count: int = 30
) -> tuple[Tensor, Tensor, Tensor]:
    start = torch.randn(count, 2, generator=generator, **DOUBLE)
    shift = 0.1 * torch.randn(candidates, steps, count, 2, generator=generator, **DOUBLE)
    shift[:, ::2] = 0.0  # every other step moves nothing
    states = torch.cat((start.expand(candidates, 1, count, 2), start + shift.cumsum(1)), 1)
    return (
        states,
        torch.randn(count, generator=generator, **DOUBLE),
        torch.rand(candidates, steps, count, generator=generator, **DOUBLE),
    )


def test_gain_of_candidates_spelt_out(generator: torch.Generator) -> None:
    states, log, p = walks(generator)
    found = expected_gain(states, log, p, SUPPORT)
    for c in range(4):
        best, at = 0.0, 0
        for t in range(6):
            weights = float(binary_gain(log, p[c, t]))
            volume = float(SUPPORT(states[c, 0], log).log_volume - SUPPORT(states[c, t + 1], log).log_volume)
            assert float(found.weights[c, t]) == pytest.approx(weights, abs=1e-12)
            assert float(found.volume[c, t]) == pytest.approx(volume, abs=1e-12)
            if weights + volume > best:
                best, at = weights + volume, t + 1
        assert float(found.value[c]) == pytest.approx(best, abs=1e-12)
        assert int(found.best_step[c]) == at


def test_density_terms_in_between_are_those_before(generator: torch.Generator) -> None:
    states, log, p = walks(generator)
    exact, rare = expected_gain(states, log, p, SUPPORT), expected_gain(states, log, p, SUPPORT, every=4)
    torch.testing.assert_close(rare.volume[:, 3], exact.volume[:, 3])
    torch.testing.assert_close(rare.volume[:, 5], exact.volume[:, 5])
    assert float(rare.volume[:, :3].abs().max()) == 0.0
    torch.testing.assert_close(rare.volume[:, 4], exact.volume[:, 3])
    torch.testing.assert_close(rare.weights, exact.weights)


def test_starts_may_differ_between_candidates(generator: torch.Generator) -> None:
    states, log, p = walks(generator)
    states = states + torch.arange(4.0, **DOUBLE)[:, None, None, None] * states
    found = expected_gain(states, log, p, SUPPORT)
    for c in range(4):
        alone = expected_gain(states[c : c + 1], log, p[c : c + 1], SUPPORT)
        torch.testing.assert_close(found.volume[c : c + 1], alone.volume)


def test_stays_where_nothing_gains(generator: torch.Generator) -> None:
    """Motions that only spread the particles, and readings that tell nothing."""
    states, log, _ = walks(generator)
    start = states[:, :1]
    spreading = start * (1.0 + 0.2 * torch.arange(7.0, **DOUBLE)[:, None, None])
    mute = torch.full((4, 6, 30), 0.1, **DOUBLE)
    found = expected_gain(spreading, log, mute, SUPPORT)
    assert found.best_step.tolist() == [0] * 4
    assert found.value.tolist() == [0.0] * 4
    # without the density term, the same motions are worth nothing
    assert expected_gain(spreading, log, mute, None).volume.abs().max() == 0
    # and gathering is worth what it gathers
    gathering = expected_gain(spreading.flip(1), log, mute, SUPPORT)
    assert gathering.best_step.tolist() == [6] * 4
    assert float(gathering.value[0]) == pytest.approx(2 * math.log(2.2), abs=1e-9)


def test_no_candidates_and_no_steps() -> None:
    log = torch.zeros(5, **DOUBLE)
    none = expected_gain(torch.zeros(0, 3, 5, 2, **DOUBLE), log, torch.zeros(0, 2, 5, **DOUBLE), SUPPORT)
    assert none.value.shape == (0,)
    still = expected_gain(torch.zeros(2, 1, 5, 2, **DOUBLE), log, torch.zeros(2, 0, 5, **DOUBLE), SUPPORT)
    assert still.value.tolist() == [0.0, 0.0]


@pytest.mark.parametrize("count", [2, 100, 3000])
def test_a_small_gain_keeps_its_digits_in_float32(count: int) -> None:
    random = torch.Generator().manual_seed(count)
    log, p = torch.randn(count, generator=random), 0.3 + 1e-4 * torch.rand(count, generator=random)
    found, wanted = binary_gain(log, p), binary_gain(log.double(), p.double())
    assert float(found) == pytest.approx(float(wanted), rel=0.05)
    assert float(found) > 0


def test_outcomes_that_cannot_happen_or_almost_cannot_tell_nothing_infinite() -> None:
    p = torch.tensor([[0.0, 1.0, 0.0], [1e-30, 1e-38, 0.9], [1.0, 1.0, 1.0]])
    log = torch.tensor([[0.0, -math.inf, 0.0], [0.0, -80.0, -90.0], [0.0, 1.0, 2.0]])
    gain = binary_gain(log, p)
    assert bool(torch.isfinite(gain).all())
    assert gain[0] == 0.0 and gain[2] == 0.0
