"""Faults of simulated runs by name, and the texts that ask for them."""

import math
from collections.abc import Collection, Sequence
from typing import Annotated

import tyro

from rumi.errors import UsageError
from rumi.registry import Table
from rumi.sim.fault import Fault
from rumi.sim.object_faults import Absent, Friction, Knock, Mass, Scale
from rumi.sim.sensor_faults import CameraOff, Dead, FalseContact, HandOff, SecondObject, Stale, Stuck

Faults = Annotated[tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="KIND[:SIZE][@STEP]")]
"""Of settings: one text for each fault."""

FAULTS: Table[type[Fault]] = Table("fault", "rumi.faults")
"""Faults by name, as `--fault` has them."""
for _name, _kind in (
    ("knock", Knock),
    ("absent", Absent),
    ("scale", Scale),
    ("hand", HandOff),
    ("camera", CameraOff),
    ("stale", Stale),
    ("dead", Dead),
    ("false-contact", FalseContact),
    ("friction", Friction),
    ("mass", Mass),
    ("stuck", Stuck),
    ("second", SecondObject),
):
    FAULTS.add(_name, _kind)


def parse_fault(text: str, *, steps: int, seed: int = 0) -> Fault:
    """The fault that KIND[:SIZE][@STEP] names.

    Args:
        text: such as "knock:30@4".
        steps: actions of the run at most.
        seed: of what is drawn of it.

    Raises:
        UsageError: there is no such fault, it has no such size, or its step is past the end.
    """
    rest, at, step_text = text.partition("@")
    name, colon, size_text = rest.partition(":")
    kind = FAULTS[name]
    size, step = kind.usual
    if colon:
        if math.isnan(size):
            raise UsageError(f"Expected --fault {name} without a size, got {text!r}")
        size = _number(text, size_text, f"SIZE ({kind.unit})")
        low, high = kind.bounds
        if not low < size <= high or size == 0:
            raise UsageError(f"Expected SIZE of {name} above {low:g} {kind.unit} and up to {high:g}, got {text!r}")
    if at:
        if not step_text.isdecimal():
            raise UsageError(f"Expected STEP as a whole number, the action from which on it holds, got {text!r}")
        step = int(step_text)
    first, last = kind.steps[0], min(kind.steps[1], steps)
    if not first <= step <= last:
        if step > steps:
            raise UsageError(
                f"Expected --fault {name} at an action up to {steps}, the run's last, got {step} ({text!r})"
            )
        raise UsageError(f"Expected --fault {name} at an action from {first} to {last:g}, got {step} ({text!r})")
    return kind(size, step, seed)


def chosen_faults(
    texts: Sequence[str], kinds: Collection[str], *, task: str, steps: int, seed: int = 0
) -> tuple[Fault, ...]:
    """The faults that texts name, of the kinds that a task can have.

    Args:
        texts: such as "knock:30@4".
        kinds: names of faults.
        task: its name, for people.
        steps: actions of the run at most.
        seed: of what is drawn of them.

    Raises:
        UsageError: there is no such fault, or not in this task; or as `parse_fault` has it.
    """
    for text in texts:
        name = text.partition("@")[0].partition(":")[0]
        if name not in kinds:
            raise UsageError(f"Expected --fault of {task} to be one of {', '.join(kinds)}, got {text!r}")
    return tuple(parse_fault(text, steps=steps, seed=seed) for text in texts)


def _number(text: str, part: str, what: str) -> float:
    try:
        value = float(part)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise UsageError(f"Expected {what} as a number, got {text!r}")
    return value
