"""Objectives from step-wise dynamics, against one slow loop."""

from dataclasses import dataclass
from typing import NamedTuple

import pytest
import torch
from torch import Tensor

from kmppi import rollout_objective, sample_weights


def cost(state, control, step):
    return (1.0 + step) * state.square().sum(-1) + 0.1 * control.square().sum(-1)


def end(state):
    return 3.0 * state.sum(-1)


def draw(generator, *shape):
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def test_sums_along_the_horizon(generator):
    controls, start = draw(generator, 4, 3, 2), draw(generator, 2)
    objective = rollout_objective(lambda x, u, _: 0.9 * x + u, cost, end, state=start)
    for k, got in enumerate(objective(controls)):
        state, total = start, torch.zeros((), dtype=torch.float64)
        for step in range(3):
            state = 0.9 * state + controls[k, step]
            total = total + cost(state, controls[k, step], step)
        torch.testing.assert_close(got, total + end(state))


def test_either_cost_will_do(generator):
    controls, start = draw(generator, 4, 3, 2), draw(generator, 2)

    def step(x, u, _):
        return x + u

    both = rollout_objective(step, cost, end, state=start)(controls)
    running = rollout_objective(step, cost, state=start)(controls)
    terminal = rollout_objective(step, terminal_cost=end, state=start)(controls)
    torch.testing.assert_close(running + terminal, both)
    torch.testing.assert_close(terminal, end(start + controls.sum(1)))
    with pytest.raises(ValueError, match="got neither"):
        rollout_objective(step, state=start)


def test_stochastic_rollouts_lie_side_by_side_and_are_averaged(generator):
    controls, start = draw(generator, 5, 3, 2), draw(generator, 2)
    noise = draw(generator, 3, 5, 4, 2)
    calls = iter(noise)

    def step(state, control, _):
        return state + control + next(calls).reshape(20, 2)

    got = rollout_objective(step, cost, end, state=start, rollouts=4)(controls)
    expected = torch.zeros(5, 4, dtype=torch.float64)
    for k in range(5):
        for m in range(4):
            state = start
            for t in range(3):
                state = state + controls[k, t] + noise[t, k, m]
                expected[k, m] += cost(state, controls[k, t], t)
            expected[k, m] += end(state)
    torch.testing.assert_close(got, expected.mean(1))
    # the mean of the exponentials would be another weighing
    other = torch.softmax(torch.logsumexp(-expected, 1), 0)
    assert (sample_weights(got, 1.0) - other).abs().max() > 1e-3


def test_one_bad_rollout_spoils_its_sample_alone():
    def step(state, control, _):
        state = state + control
        return torch.where(torch.arange(6)[:, None] == 3, torch.nan, state)

    got = rollout_objective(step, cost, state=torch.zeros(1), rollouts=2)(torch.ones(3, 2, 1))
    assert got.isfinite().tolist() == [True, False, True]


def test_draws_come_from_the_generator(generator):
    def step(state, control, given):
        return state + control + torch.randn(state.shape, generator=given, dtype=state.dtype)

    start, controls = torch.zeros(1, dtype=torch.float64), draw(generator, 3, 4, 1)

    def run(seed):
        own = torch.Generator().manual_seed(seed)
        return rollout_objective(step, cost, state=start, rollouts=3, generator=own)(controls)

    assert torch.equal(run(1), run(1))
    assert not torch.equal(run(1), run(2))


@dataclass(frozen=True)
class Cart:
    position: Tensor
    speed: Tensor
    mass: float = 2.0


class Pair(NamedTuple):
    position: Tensor
    speed: Tensor


def advance(position, speed, control):
    return position + 0.1 * speed, speed + 0.1 * control


def test_states_of_any_container(generator):
    controls, position, speed = draw(generator, 4, 5, 2), draw(generator, 2), draw(generator, 2)

    def dict_step(s, u, _):
        p, v = advance(s["p"], s["v"], u / 2.0)
        return {"p": p, "v": v}

    variants = [
        (
            Cart(position, speed),
            lambda s, u, _: Cart(*advance(s.position, s.speed, u / s.mass), s.mass),
            lambda s: s.position,
        ),
        (Pair(position, speed), lambda s, u, _: Pair(*advance(s.position, s.speed, u / 2.0)), lambda s: s.position),
        ((position, speed), lambda s, u, _: advance(*s, u / 2.0), lambda s: s[0]),
        ({"p": position, "v": speed}, dict_step, lambda s: s["p"]),
        (
            torch.cat((position, speed)),
            lambda s, u, _: torch.cat(advance(s[:, :2], s[:, 2:], u / 2.0), -1),
            lambda s: s[:, :2],
        ),
    ]
    results = [
        rollout_objective(step, lambda s, u, i, at=at: cost(at(s), u, i), state=state, rollouts=2)(controls)
        for state, step, at in variants
    ]
    assert results[0].shape == (4,)
    for result in results[1:]:
        torch.testing.assert_close(result, results[0])


def test_refuses_no_rollouts():
    with pytest.raises(ValueError, match="rollouts to be 1 or more, got 0"):
        rollout_objective(lambda x, u, _: x, cost, state=torch.zeros(1), rollouts=0)
