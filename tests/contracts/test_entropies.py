"""Contract of the entropies: what holds for every estimator of the differential entropy of weighted states."""

import math

import pytest
import torch

from rumi.information.entropy import Entropy, SharedSupport
from rumi.information.neighbours import StateMetric
from tests.fixtures.entropies import ENTROPIES, entropies

DOUBLE = {"dtype": torch.float64}
PLANAR = StateMetric((0.06, 0.06, 0.5), (False, False, True))

# holds for the plain and for the compiled version
pytestmark = pytest.mark.usefixtures("version")


@pytest.fixture(params=ENTROPIES)
def entropy(request: pytest.FixtureRequest) -> Entropy:
    return entropies(SharedSupport(PLANAR, floor=(1e-3, 1e-3, 0.009)))[request.param]


def test_a_row_of_a_batch_is_the_set_alone(entropy, generator):
    states = torch.randn(3, 4, 30, 3, generator=generator, **DOUBLE)
    log = torch.randn(4, 30, generator=generator, **DOUBLE)
    states[0, 1, :10] = states[0, 1, 10:20]
    assert isinstance(entropy, Entropy)
    alone = torch.stack([torch.stack([entropy(states[i, j], log[j]) for j in range(4)]) for i in range(3)])
    torch.testing.assert_close(entropy(states, log), alone, atol=1e-12, rtol=0)


def test_weights_need_not_be_normalised(entropy, generator):
    states, log = torch.randn(30, 3, generator=generator, **DOUBLE), torch.randn(30, generator=generator, **DOUBLE)
    torch.testing.assert_close(entropy(states, log + 7.0), entropy(states, log))


def test_coincident_states_count_once(entropy, generator):
    states, log = torch.randn(20, 3, generator=generator, **DOUBLE), torch.randn(20, generator=generator, **DOUBLE)
    twice = torch.cat((states, states)), torch.cat((log, log)) - math.log(2.0)
    torch.testing.assert_close(entropy(*twice), entropy(states, log), atol=1e-9, rtol=0)


def test_a_rotation_of_all_angles_changes_nothing(entropy, generator):
    states = torch.randn(60, 3, generator=generator, **DOUBLE) * torch.tensor([0.05, 0.05, 1.5])
    log = torch.randn(60, generator=generator, **DOUBLE)
    turned = states.clone()
    turned[:, 2] = torch.remainder(states[:, 2] + 2.1, 2 * math.pi) - math.pi
    assert float(entropy(turned, log)) == pytest.approx(float(entropy(states, log)), abs=1e-9)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_degenerate_sets_have_a_finite_entropy(entropy, dtype, generator):
    states = torch.randn(20, 3, generator=generator).to(dtype)
    flat = states.clone()
    flat[:, 1] = 0.0
    certain = torch.full((20,), -math.inf, dtype=dtype)
    certain[3] = 0.0
    even = torch.zeros(20, dtype=dtype)
    coincident = states[[0] * 10 + [1] * 10], states[[0] * 20]
    for case, log in ((states, certain), (flat, even), *((s, even) for s in coincident), (states[:1], even[:1])):
        found = entropy(case, log)
        assert found.dtype == dtype and bool(torch.isfinite(found))


def test_invalid_sets_are_refused(entropy):
    states, log = torch.arange(15.0).view(5, 3), torch.zeros(5)
    for value in (math.nan, math.inf):
        wild = states.clone()
        wild[2, 1] = value
        with pytest.raises(ValueError, match="Expected states to be finite, got 1 of 15"):
            entropy(wild, log)
        with pytest.raises(ValueError, match="Expected a finite log-weight in each set"):
            entropy(states, torch.where(torch.arange(5) == 3, value, log))
    with pytest.raises(ValueError, match="none that is NaN or \\+inf, got -inf"):
        entropy(states.expand(2, 5, 3), torch.stack((log, log - math.inf)))
    with pytest.raises(ValueError, match="one state or more in each set"):
        entropy(states[:0], log[:0])


@pytest.mark.parametrize("case", ["zero weight", "coincident", "one"])
@pytest.mark.parametrize("version", ["torch"], indirect=True)
def test_gradients_are_finite(entropy, case, generator):
    states, log = torch.rand(8, 3, generator=generator, **DOUBLE), torch.randn(8, generator=generator, **DOUBLE)
    if case == "zero weight":
        log[2] = -math.inf
    elif case == "coincident":
        states[1] = states[0]
    else:
        states, log = states[:1], log[:1]
    inputs = states.requires_grad_(), log.requires_grad_()
    for slope in torch.autograd.grad(entropy(*inputs), inputs, allow_unused=True):
        assert slope is None or bool(slope.isfinite().all())
