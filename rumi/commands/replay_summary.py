"""What `rumi replay` says of a replay: how it ended, whether it is the recorded run, and why it may not be."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rumi.errors import UsageError
from rumi.runs.plain import plain

if TYPE_CHECKING:
    from rumi.runs.recorded import RunLog
    from rumi.runs.replay import Replayed
    from sensors.log.reader import Log


def summary(
    done: "Replayed", name: str, lines: Sequence[str], readings: int, changed: Sequence[str], out: Path | None
) -> str:
    """A few lines on a replay.

    Args:
        done: what came of it.
        name: of the task.
        lines: on how it ended.
        readings: that there were.
        changed: settings that are not the recorded ones and that matter.
        out: the folder that was written.
    """
    used = len(done.same)
    first, *rest = lines
    lines = [f"{name}: {first}", *rest]
    if used < readings:
        lines.append(f"readings {used} of {readings}: {done.result.stopped_by} before the log's end")
    known = [same for same in done.same if same is not None]
    if not known:
        lines.append("belief   no live run's to compare with")
    elif all(known):
        lines.append(f"belief   the recorded one, bit for bit, after each of {len(known)} readings")
    else:
        place = done.same.index(False)
        at = "the first view" if place == 0 else f"action {place}"
        why = f" ({', '.join(changed)} changed)" if changed else ", though the settings are the same"
        lines.append(f"belief   differs from the recorded one from {at} on{why}")
    faster = done.robot_s / max(done.wall_s, 1e-9)
    told = f" for {done.robot_s:.1f} of the robot: {faster:.1f} times as fast" if done.robot_s > 0 else ""
    lines.append(f"seconds  {done.wall_s:.1f}{told}")
    if out is not None:
        lines.append(f"folder   {out}")
    return "\n  ".join(lines) + "\n"


def differing(before: Any, after: Any) -> list[str]:  # noqa: ANN401  (settings of one task)
    """Names of the settings that differ, as their flags have them but with underscores."""
    return [name.removeprefix("settings.") for name in changes(plain(before), plain(after))]


def changes(before: Mapping[str, Any], after: Mapping[str, Any], prefix: str = "") -> list[str]:
    """Names of the settings that differ, nested ones with dots."""
    found: list[str] = []
    for name in before.keys() | after.keys():
        a, b = before.get(name), after.get(name)
        if isinstance(a, Mapping) and isinstance(b, Mapping):
            found += changes(a, b, f"{prefix}{name}.")
        elif a != b:
            found.append(prefix + name)
    return sorted(found)


def machines(log: "Log | RunLog") -> list[str]:
    """What this machine has other than the one that recorded a log, which may be why beliefs differ."""
    from rumi.runs.provenance import provenance

    now, then = provenance(), json.loads(log.texts.get("made_with", "{}"))
    then.setdefault("processor", now["processor"])  # logs of before do not tell
    then.pop("backend", None)  # which they all had as torch
    return [f"recorded with {name} {_at(then, name)}, replayed with {_at(now, name)}" for name in changes(then, now)]


def _at(values: Mapping[str, Any], name: str) -> Any:  # noqa: ANN401  (a plain value)
    for part in name.split("."):
        values = values.get(part, {}) if isinstance(values, Mapping) else {}
    return values if values != {} else None


def recorded_mesh(log: "Log | RunLog") -> Mapping[str, Any] | None:
    """What a recording says of its object's mesh; None of an object without one.

    Raises:
        UsageError: that is damaged.
    """
    try:
        mesh = json.loads(log.texts.get("object", "{}")).get("mesh")
        if mesh is not None and not isinstance(mesh, dict):
            raise TypeError(f"its mesh is {mesh!r}")
    except (ValueError, TypeError, AttributeError) as error:
        file = log.path / "object.json" if log.path.is_dir() else f"The record of the object in {log.path}"
        raise UsageError(f"{file} is damaged: {error}") from error
    return mesh
