"""The log of a fused run: what it took in, and the same beliefs from it again."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from rumi.clock import Clock
from rumi.errors import UsageError
from rumi.planning.policy import Plan
from rumi.records import StepRecord
from rumi.runs.json_settings import dataclass_of
from rumi.runs.logbook import LogRecorder, digest
from rumi.runs.replay import Replayed
from rumi.task import StepResult
from rumi.tasks.handle.agent import begin, belief_streams, follow
from rumi.tasks.handle.finder import Finder
from rumi.tasks.handle.settings import FusedSettings
from rumi.tasks.rummage.scoring import observe, summarise
from sensors.contact_reading import ContactReading

if TYPE_CHECKING:
    from sensors.log.reader import Log, Taken

COUNTED = (
    *("preset", "renewals", "fit_a_contact", "contacts", "steps", "signals", "spread_m"),
    *("wrist.point_m", "wrist.normal_rad", "wrist.outlier"),
)
"""Settings of what readings count for, which a replay may change; all others decided what was sensed."""

IDLE = ("budget_s", "thinking_s")
"""Settings of what was done when, which a replay does not use."""


class FusedLogRecorder(LogRecorder):
    """A `LogRecorder` of fused readings.

    Args:
        path: of the log; it must not exist.
        seed: of the run.
        settings: of the run.
        about: further plain values by name.
    """

    def __init__(
        self, path: Path | str, seed: int, settings: FusedSettings, about: Mapping[str, Any] | None = None
    ) -> None:
        asked = {"task": "fused", "seed": seed, "fused": settings}
        super().__init__(path, asked, about, readings=ContactReading)

    def __call__(self, step: StepRecord) -> None:
        """Append a step; once this returns, a kill no longer loses it."""
        super().__call__(replace(step, reading=ContactReading.of(step.reading)))


def recorded(log: "Log") -> tuple[int, FusedSettings] | None:
    """Seed and settings of the fused run that a log is of; None where it is of another one.

    Raises:
        UsageError: the settings are none of this rumi.
    """
    settings = log.settings or {}
    if settings.get("task") != "fused" or "fused" not in settings:
        return None
    seed = settings.get("seed")
    if not isinstance(seed, int) or isinstance(seed, bool):
        raise UsageError(f"Expected seed in the settings of {log.path} to be a whole number, got {seed!r}")
    return seed, dataclass_of(FusedSettings, settings["fused"])


def differing(before: Any, after: Any, prefix: str = "") -> list[str]:  # noqa: ANN401  (settings of any kind)
    """Names of the settings that differ, nested ones with dots."""
    found: list[str] = []
    for part in fields(before):
        a, b, name = getattr(before, part.name), getattr(after, part.name), prefix + part.name
        if is_dataclass(a):
            found += differing(a, b, f"{name}.")
        elif a != b:
            found.append(name)
    return found


def refuse_other_senses(before: FusedSettings, after: FusedSettings) -> None:
    """Refuse settings of a replay under which something else would have been sensed.

    Raises:
        UsageError: with the first of them.
    """
    for name in differing(before, after):
        if name not in IDLE and not any(name == counted or name.startswith(f"{counted}.") for counted in COUNTED):
            raise UsageError(f"Expected {name} as it was recorded, got another: a replay cannot change what was sensed")


def replay_fused(
    taken: "Sequence[Taken]", finder: Finder, *, seed: int, on_step: Callable[[StepRecord], None] | None = None
) -> Replayed:
    """Take in a log's readings by the steps that take in a robot's; nothing is planned, and nothing grasped.

    With the settings, the seed and the machine of the run that was recorded, the beliefs are the same bit for bit.

    Args:
        taken: what the log holds, the first view first.
        finder: how.
        seed: of the belief's randomness.
        on_step: called with the record of every step.

    Raises:
        UsageError: there is nothing to take in, or readings of another kind of run.
    """
    if not taken:
        raise UsageError("Expected a log with a first reading at least, got none: there is nothing to replay")
    clock, history, random = Clock(), list[StepRecord](), belief_streams(seed)
    same: list[bool | None] = []
    start = time.perf_counter()

    def emit(record: StepRecord) -> StepRecord:
        theirs = taken[record.step].digest
        same.append(None if theirs is None else digest(record.belief) == theirs)
        history.append(record)
        if on_step is not None:
            on_step(record)
        return record

    result = StepResult(taken[0].reading, taken[0].truth)
    with clock("belief"):
        known = begin(finder, result.reading, random=random)
    last = emit(observe(finder.rummager, clock, history, result, known.belief, known.memory))
    for one in taken[1 : finder.settings.steps + 1]:
        if last.converged:
            break
        configuration, result = one.reading.configuration, StepResult(one.reading, one.truth)
        control = torch.zeros_like(configuration) if one.control is None else one.control
        plan = Plan(control[None], configuration[None].expand(2, -1))
        known, last = follow(finder, known, clock, history, result, control, plan, random=random)
        emit(last)
    found = summarise(finder.rummager, history, "converged" if last.converged else "steps")
    robot_s = history[-1].reading.stamp - history[0].reading.stamp
    return Replayed(found, same, robot_s, time.perf_counter() - start, last)
