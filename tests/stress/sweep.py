"""A sweep: drawn inputs, a public operation, a reference of higher precision, and how far they may be apart."""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from rumi.seeding import split

Inputs = Mapping[str, Any]
"""What a round is about: tensors of one case a row, and whatever all cases share."""

Function = Callable[[Inputs], Any]

SWEEPS: dict[str, "Sweep"] = {}
"""All sweeps by name, in the order of the table; `tests.stress.subjects.load` enters them."""


@dataclass(frozen=True)
class Sweep:
    """Inputs drawn by seed, the operation under test, what it should give, and how far off it may be.

    Attributes:
        name: what users call it: subject, operation and what is special, such as "se3-log-float32".
        draw: inputs of one round, from a generator.
        operation: what is tested.
        reference: the same in higher precision, or a property's right-hand side.
        error: (n,) of what the operation gave, of the reference and the inputs: one number a case, in `unit`.
        limit: that no error may exceed.
        unit: of the error.
        condition: (n,), what makes a case hard.
        condition_of: what that number is.
        slow: takes minutes: left out of short runs unless it is asked for by name.
    """

    name: str
    draw: Callable[[torch.Generator], Inputs]
    operation: Function
    reference: Function
    error: Callable[[Any, Any, Inputs], Tensor]
    limit: float
    unit: str
    condition: Callable[[Inputs], Tensor]
    condition_of: str
    slow: bool = False


@dataclass(frozen=True)
class Outcome:
    """What the rounds of a sweep found.

    Attributes:
        name, limit, unit, condition_of: of the sweep.
        rounds, cases: how many were carried out.
        worst: greatest error; infinite where something was not finite or raised an error.
        condition: of the worst case; None where there is none to tell.
        seed: of the worst round, by which `--seed` draws it again.
        case: row of the worst case within that round.
        inputs: the worst case's numbers, as text.
        failure: what went wrong beside an error above the limit: an exception, or a value that is not finite.
        seconds: spent.
    """

    name: str
    limit: float
    unit: str
    condition_of: str
    rounds: int = 0
    cases: int = 0
    worst: float = -1.0
    condition: float | None = None
    seed: int = 0
    case: int = 0
    inputs: dict[str, str] = field(default_factory=dict)
    failure: str | None = None
    seconds: float = 0.0

    @property
    def kept(self) -> bool:
        """Whether all cases stayed within the limit."""
        return self.failure is None and self.worst <= self.limit

    @classmethod
    def of(cls, sweep: Sweep) -> "Outcome":
        """Before the first round."""
        return cls(sweep.name, sweep.limit, sweep.unit, sweep.condition_of)


def register(sweep: Sweep) -> Sweep:
    """Enter a sweep into the table.

    Raises:
        ValueError: there is one of that name.
    """
    if sweep.name in SWEEPS:
        raise ValueError(f"Expected a new name, got {sweep.name!r}, which is a sweep already")
    SWEEPS[sweep.name] = sweep
    return sweep


def carry_out(sweep: Sweep, seeds: Sequence[int], before: Outcome | None = None) -> Outcome:
    """Rounds of a sweep, one a seed, on top of what was found before.

    A round of an odd seed runs on two threads (of torch and of the fused kernels), of an even one on one.
    """
    found = before or Outcome.of(sweep)
    threads = torch.get_num_threads()
    try:
        for seed in seeds:
            torch.set_num_threads(1 + seed % 2)
            found = _round(sweep, seed, found)
    finally:
        torch.set_num_threads(threads)
    return found


def _round(sweep: Sweep, seed: int, found: Outcome) -> Outcome:
    began = time.perf_counter()
    inputs = sweep.draw(split(seed, sweep.name))
    failure = None
    try:
        errors = sweep.error(sweep.operation(inputs), sweep.reference(inputs), inputs).detach().double().reshape(-1)
        condition = sweep.condition(inputs).detach().double().reshape(-1).expand(len(errors))
    except Exception as error:  # whatever comes out is what is looked for
        failure = f"{type(error).__name__}: {error}"
        errors, condition = torch.full((1,), math.inf), torch.full((1,), math.nan)
    if failure is None and not bool(torch.isfinite(errors).all()):
        failure = "a value that is not finite"
    if errors.numel() == 0:
        return replace(found, rounds=found.rounds + 1, seconds=found.seconds + time.perf_counter() - began)
    errors = torch.nan_to_num(errors, nan=math.inf, posinf=math.inf)
    worst = int(errors.argmax())
    rounds = replace(found, rounds=found.rounds + 1, cases=found.cases + len(errors))
    rounds = replace(rounds, seconds=found.seconds + time.perf_counter() - began)
    if float(errors[worst]) <= found.worst:
        return rounds
    hard = float(condition[worst])
    return replace(
        rounds,
        worst=float(errors[worst]),
        condition=hard if math.isfinite(hard) else None,
        seed=seed,
        case=worst,
        inputs={name: _text(value, worst, len(errors)) for name, value in inputs.items()},
        failure=found.failure or failure,
    )


def _text(value: Any, case: int, cases: int) -> str:  # noqa: ANN401  (whatever a draw gives)
    """A case's share of an input, short enough for a line."""
    if isinstance(value, Tensor):
        row = value[case] if value.ndim and value.shape[0] == cases else value
        flat = row.detach().double().reshape(-1)
        shown = ", ".join(f"{float(x):.9g}" for x in flat[:16])
        return f"[{shown}]" if flat.numel() <= 16 else f"[{shown}, ...] {tuple(row.shape)}"
    text = repr(value)
    return text if len(text) <= 160 else text[:157] + "..."
