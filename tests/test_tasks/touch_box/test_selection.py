"""What pokes are worth."""

import itertools
import math

import pytest
import torch

from rumi.information.entropy import SharedSupport
from rumi.information.neighbours import StateMetric
from rumi.tasks.touch_box.selection import (
    METHODS,
    Rollouts,
    Weighing,
    choose,
    expects_contact,
    likeliest_gain,
    sequence_information,
)
from tests.fixtures.channel import channel_capacity

SUPPORT = SharedSupport(StateMetric.planar(0.06), floor=1e-4)


def rollouts(generator, candidates=3, steps=4, count=6, low=0.1, high=0.5):
    chance = low + (high - low) * torch.rand(candidates, steps, count, generator=generator, dtype=torch.float64)
    states = 0.1 * torch.randn(candidates, steps + 1, count, 3, generator=generator, dtype=torch.float64)
    states[:, 0] = states[0, 0]
    log = torch.randn(count, generator=generator, dtype=torch.float64).log_softmax(-1)
    return Rollouts(states, chance, chance > 0.4, log)


def exact(found, candidate):
    """Mutual information by all reading sequences."""
    weights, chance, total = found.log_weights.exp(), found.probability[candidate], 0.0
    for readings in itertools.product((0.0, 1.0), repeat=chance.shape[0]):
        z = torch.tensor(readings, dtype=torch.float64)[:, None]
        likelihood = (z * chance + (1 - z) * (1 - chance)).prod(0)
        joint = weights * likelihood
        total += float((joint * (likelihood / joint.sum()).log()).sum())
    return total


def test_sequence_information_is_mutual_information(generator):
    found = rollouts(generator)
    value = sequence_information(found, hold=100, samples=40_000, generator=generator)
    for candidate in range(3):
        assert float(value[candidate]) == pytest.approx(exact(found, candidate), abs=0.01)


def test_sequence_information_is_at_most_what_the_channel_carries(generator):
    found = rollouts(generator, candidates=5, steps=8, count=30)
    value = sequence_information(found, hold=100, samples=5000, generator=generator)
    assert float(value.max()) <= 8 * channel_capacity(0.1, 0.5) + 0.02
    assert float(value.min()) >= -0.02


def test_readings_after_contact_has_lasted_count_nothing(generator):
    """Two particles that the tool touches at once: from the second step on the poke is over."""
    chance = torch.tensor([[[0.5, 0.1], [0.5, 0.1], [0.9, 0.0]]], dtype=torch.float64)
    touching = torch.ones(1, 3, 2, dtype=torch.bool)
    log = torch.full((2,), -math.log(2.0), dtype=torch.float64)
    states = torch.zeros(1, 4, 2, 3, dtype=torch.float64)
    cut = Rollouts(states, chance, touching, log)
    short = Rollouts(states[:, :2], chance[:, :1], touching[:, :1], log)
    value = sequence_information(cut, hold=1, samples=20_000, generator=generator)
    assert float(value[0]) == pytest.approx(exact(short, 0), abs=0.01)


def test_the_likeliest_particle_alone_says_what_is_read(generator):
    found = rollouts(generator)
    value, step = likeliest_gain(found, SUPPORT, every=1)
    likely = int(found.log_weights.argmax())
    weights = found.log_weights.exp()

    def entropy(w):
        w = w / w.sum()
        return -float((w * w.log()).sum())

    start = float(SUPPORT(found.states[0, 0], found.log_weights).log_volume)
    for c in range(3):
        gains = []
        for t in range(4):
            chance = found.probability[c, t]
            after = weights * (chance if bool(found.touching[c, t, likely]) else 1 - chance)
            volume = start - float(SUPPORT(found.states[c, t + 1], found.log_weights).log_volume)
            gains.append(entropy(weights) - entropy(after) + volume)
        assert float(value[c]) == pytest.approx(max(gains))
        assert int(step[c]) == 1 + max(range(4), key=gains.__getitem__)


def test_a_particle_that_is_named_says_what_is_read_and_needs_no_weight(generator):
    found = rollouts(generator)
    other = int(found.log_weights.argmin())
    beside = found._replace(
        states=torch.cat((found.states, found.states[:, :, other, None]), 2),
        probability=torch.cat((found.probability, found.probability[..., other, None]), 2),
        touching=torch.cat((found.touching, found.touching[..., other, None]), 2),
        log_weights=torch.nn.functional.pad(found.log_weights, (0, 1), value=-math.inf),
        likeliest=len(found.log_weights),
    )
    named = likeliest_gain(found._replace(likeliest=other), SUPPORT, every=1)
    for one, two in zip(named, likeliest_gain(beside, SUPPORT, every=1), strict=True):
        torch.testing.assert_close(one, two)
    assert not torch.allclose(named[0], likeliest_gain(found, SUPPORT, every=1)[0])


@pytest.mark.parametrize("method", METHODS)
def test_every_method_takes_its_best(method, generator):
    found = rollouts(generator)
    choice = choose(method, Weighing(found, SUPPORT, generator))
    assert choice.value.shape == (3,)
    assert choice.best == int(choice.value.argmax())
    assert bool(((choice.steps >= 1) & (choice.steps <= 4)).all())


def test_most_contact_is_the_touched_share_of_the_belief(generator):
    found = rollouts(generator)
    value = choose("max-contact", Weighing(found, SUPPORT, generator)).value
    touched = found.touching.any(1).double()
    torch.testing.assert_close(value, touched @ found.log_weights.exp())


def test_where_nothing_gains_a_candidate_that_was_drawn_like_any_is_carried_out_to_its_end(generator):
    found = rollouts(generator)
    spread = torch.linspace(1.0, 2.0, 5, dtype=torch.float64)[:, None, None] * found.states[:, :1]
    found = found._replace(states=spread, probability=torch.full_like(found.probability, 0.1))
    for method in ("entropy", "weights-only"):
        choice = choose(method, Weighing(found, SUPPORT, generator))
        assert choice.value.tolist() == [0.0] * 3
        assert (choice.best, choice.steps.tolist()) == (0, [4] * 3)


def test_a_bonus_for_funnels_counts_what_the_motion_alone_gathers(generator):
    found = rollouts(generator)
    states = found.states.clone()
    states[1, -1] = 0.1 * states[1, 0]  # the second poke herds the particles together
    found = found._replace(states=states)
    plain = choose("max-contact", Weighing(found, SUPPORT, generator)).value
    bonus = choose("max-contact", Weighing(found, SUPPORT, generator), funnel=1.0).value - plain
    assert float(bonus[1]) == pytest.approx(3 * math.log(10.0), abs=1e-6)


def test_an_unknown_method_is_refused(generator, no_shape_check):
    with pytest.raises(ValueError, match="entropy"):
        choose("guess", Weighing(rollouts(generator), SUPPORT, generator))


def test_contact_is_expected_of_the_weight_that_was_touched_long_enough():
    touching = torch.tensor([[True, False, False], [True, True, False], [True, True, False]])
    log = torch.tensor([0.5, 0.3, 0.2]).log()
    torch.testing.assert_close(expects_contact(touching, log, 2), torch.tensor([0.0, 0.5, 0.8]))
