"""The log of a run of the handle task: whose settings it has, and which of them a replay may change."""

from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rumi.errors import UsageError
from rumi.records import StepRecord
from rumi.runs.json_settings import dataclass_of
from rumi.runs.logbook import LogRecorder
from rumi.tasks.handle.settings import FusedSettings
from sensors.contact_reading import ContactReading

if TYPE_CHECKING:
    from sensors.log.reader import Log

COUNTED = (
    *("preset", "renewals", "fit_a_contact", "contacts", "steps", "signals", "spread_m"),
    *("wrist.point_m", "wrist.normal_rad", "wrist.outlier"),
)
"""Settings of what readings count for, which a replay may change; all others decided what was sensed."""

IDLE = ("budget_s", "thinking_s")
"""Settings of what was done when, which a replay does not use."""


_NAMES = ("handle", "fused")
"""Names of the task in logs: now, and before."""


def asked_of(seed: int, settings: FusedSettings) -> dict[str, Any]:
    """What a run was asked for, as logs and folders keep it."""
    return {"task": "handle", "seed": seed, "handle": settings}


def is_of_handle(log: "Log") -> bool:
    """Whether a log is of the handle task."""
    return (log.settings or {}).get("task") in _NAMES


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
        super().__init__(path, asked_of(seed, settings), about, readings=ContactReading)

    def __call__(self, step: StepRecord) -> None:
        """Append a step; once this returns, a kill no longer loses it."""
        super().__call__(replace(step, reading=ContactReading.of(step.reading)))


def recorded(log: "Log") -> tuple[int, FusedSettings] | None:
    """Seed and settings of the run of the handle task that a log is of; None where it is of another one.

    Raises:
        UsageError: the settings are none of this rumi.
    """
    settings = log.settings or {}
    name = settings.get("task")
    if name not in _NAMES or name not in settings:
        return None
    seed = settings.get("seed")
    if not isinstance(seed, int) or isinstance(seed, bool):
        raise UsageError(f"Expected seed in the settings of {log.path} to be a whole number, got {seed!r}")
    return seed, dataclass_of(FusedSettings, settings[name])


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
