"""Objective of a rollout whose dynamics are given one step at a time."""

from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from typing import TypeVar, cast

import torch
from jaxtyping import Float
from torch import Tensor

from kmppi.types import Objective

State = TypeVar("State")

Dynamics = Callable[[State, Float[Tensor, "B A"], torch.Generator | None], State]
"""`step(state (B, ...), control (B, A), generator)` gives the next states (B, ...); it draws from the generator."""

RunningCost = Callable[[State, Float[Tensor, "B A"], int], Float[Tensor, "B"]]
"""`running_cost(state (B, ...), control (B, A), step)`: costs (B,) of the states that control number `step` led to."""

TerminalCost = Callable[[State], Float[Tensor, "B"]]
"""`terminal_cost(state (B, ...))`: costs (B,) of the last states."""


def rollout_objective(
    step: Dynamics[State],
    running_cost: RunningCost[State] | None = None,
    terminal_cost: TerminalCost[State] | None = None,
    *,
    state: State,
    rollouts: int = 1,
    generator: torch.Generator | None = None,
) -> Objective:
    """The mean cost of rolling each control sequence out a number of times.

    The mean is taken here, before the costs are weighed (RUMI, V.F): the mean of exponentials would be another
    quantity. One rollout whose cost is not finite makes its sample's cost so.

    Args:
        step: dynamics of B = K * rollouts states at once, a sample's rollouts side by side.
        running_cost: cost of each step, of the state it led to, summed over the horizon.
        terminal_cost: cost of the last state.
        state: where all start, without a batch axis: a tensor, or a dataclass, named tuple, tuple or dict of tensors
            (fields that are no tensors stay as they are).
        rollouts: rollouts M of each sample, for dynamics that draw.
        generator: handed to `step`.

    Returns:
        an objective: controls (K, H, A) to costs (K,).

    Raises:
        ValueError: there is no cost, or `rollouts` is below 1.
    """
    if running_cost is None and terminal_cost is None:
        raise ValueError("Expected a running_cost or a terminal_cost, got neither")
    if rollouts < 1:
        raise ValueError(f"Expected rollouts to be 1 or more, got {rollouts}")

    def objective(controls: Float[Tensor, "K H A"]) -> Float[Tensor, "K"]:
        samples, horizon, _ = controls.shape
        repeated = controls.repeat_interleave(rollouts, 0) if rollouts > 1 else controls
        now = _expand(state, samples * rollouts)
        total = controls.new_zeros(samples * rollouts)
        for index in range(horizon):
            control = repeated[:, index]
            now = step(now, control, generator)
            if running_cost is not None:
                total = total + running_cost(now, control, index)
        if terminal_cost is not None:
            total = total + terminal_cost(now)
        return total.view(samples, rollouts).mean(1)

    return objective


def _expand(state: State, count: int) -> State:
    return cast(State, _expand_any(state, count))


def _expand_any(state: object, count: int) -> object:
    if isinstance(state, Tensor):
        return state.expand(count, *state.shape)
    if is_dataclass(state) and not isinstance(state, type):
        return replace(state, **{f.name: _expand_any(getattr(state, f.name), count) for f in fields(state) if f.init})
    if isinstance(state, dict):
        return {name: _expand_any(value, count) for name, value in state.items()}
    if isinstance(state, tuple):
        values = tuple(_expand_any(value, count) for value in state)
        return state._make(values) if hasattr(state, "_make") else values
    return state
