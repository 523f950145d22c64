"""One piece of work: what decides its result, and the name that it is kept under."""

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any

from rumi.errors import UsageError
from rumi.runs.json_settings import FORMER_KEYS
from rumi.tasks.rummage.settings import Settings, from_dict, preset, to_dict
from scripts.reproduce.code import code_of

TOY_METHODS = ("MPPI", "SMPPI", "KMPPI")
_MESH = "object.mesh="


@dataclass(frozen=True)
class Job:
    """One run, one closed loop of the toy of Figure 8, or one of the peg task.

    Attributes:
        kind: "run", "toy", "peg", or "peg-real" where weighing candidates takes what it takes on this machine.
        task: its name; "toy" of the toy, "peg" of the peg task.
        method: its name; of the toy one of MPPI, SMPPI, KMPPI.
        preset: that the settings start from; empty for the toy.
        seed: of all randomness.
        overrides: settings on top of the preset, such as "planner.rollouts=3"; None for the toy.
    """

    kind: str
    task: str
    method: str
    preset: str
    seed: int
    overrides: tuple[str, ...] = ()

    @property
    def column(self) -> str:
        """Method, preset and overrides, as tables show them."""
        return column_name(self.method, self.preset, self.overrides)

    @property
    def code(self) -> str:
        """Hash of the code that its result depends on."""
        return code_of(self.kind)

    @cached_property
    def settings(self) -> Settings:
        """The settings of a run.

        Raises:
            UsageError: there is no such task, method, preset or setting.
        """
        return replace(_settings(self.task, self.method, self.preset, self.overrides), seed=self.seed)

    @property
    def settings_hash(self) -> str:
        """Of all settings but the seed and the task, of a mesh by what is in it; empty for the toy."""
        if self.kind != "run":
            return ""
        values, mesh = _counted(self.task, self.method, self.preset, self.overrides), self.settings.object.mesh
        if mesh is not None:
            content = hashlib.sha256(Path(mesh).read_bytes()).hexdigest()
            values = {**values, "object": {**values["object"], "mesh": content}}
        return _digest(values)[:12]

    @cached_property
    def id(self) -> str:
        """Under which its result is kept: the same for the same work by the same code."""
        return identity(self.describe())

    def describe(self) -> dict[str, Any]:
        """All that decides the result."""
        return {
            "kind": self.kind,
            "task": self.task,
            "method": self.method,
            "preset": self.preset,
            "overrides": list(named(self.overrides)),
            "seed": self.seed,
            "settings": self.settings_hash,
            "code": self.code,
        }

    def carry_out(self, cache_dir: Path) -> dict[str, Any]:
        """Do it: `figures`, `timings` and `curves`, ready for JSON."""
        return KINDS[self.kind](self, cache_dir)


@cache
def _settings(task: str, method: str, preset_name: str, overrides: tuple[str, ...]) -> Settings:
    """The settings of runs, of whatever seed."""
    values = to_dict(replace(preset(preset_name), task=task, method=method))
    return from_dict(overridden(values, overrides))


@cache
def _counted(task: str, method: str, preset_name: str, overrides: tuple[str, ...]) -> dict[str, Any]:
    """What the hash of settings is of, but what is in a mesh."""
    settings = _settings(task, method, preset_name, overrides)
    values = {k: v for k, v in to_dict(settings).items() if k not in ("seed", "task")}
    # results on record are kept under the names that settings had then, and without those that came later
    for former, now in FORMER_KEYS["Settings"].items():
        values[former] = values.pop(now)
    for added in (values["filter"], "evidence"), (values["simulator"]["sensors"], "further"):
        if not added[0][added[1]]:
            del added[0][added[1]]
    return values


def _run(job: Job, cache_dir: Path) -> dict[str, Any]:
    from scripts.reproduce.runs import carry_out

    return carry_out(job.settings, cache_dir)


def _toy(job: Job, cache_dir: Path) -> dict[str, Any]:
    from scripts.reproduce.toy import carry_out

    return carry_out(job.method, job.seed)


def _peg(job: Job, cache_dir: Path) -> dict[str, Any]:
    from scripts.reproduce.peg import carry_out

    return carry_out(job.overrides, job.seed)


KINDS: dict[str, Callable[[Job, Path], dict[str, Any]]] = {"run": _run, "toy": _toy, "peg": _peg, "peg-real": _peg}
"""All kinds of work by name."""


def identity(described: dict[str, Any]) -> str:
    """The name of some work, of all that decides its result."""
    # of a mesh its contents decide, which are in the settings' hash
    whole = described | {"overrides": [o for o in described["overrides"] if not o.startswith(_MESH)]}
    return _digest(whole)[:16]


def column_name(method: str, preset_name: str, overrides: Sequence[str] = ()) -> str:
    """Method, preset and overrides in one, such as `rumi/default planner.rollouts=3`."""
    base = f"{method}/{preset_name}" if preset_name else method
    return " ".join([base, *named(overrides)])


def named(overrides: Sequence[str]) -> tuple[str, ...]:
    """Overrides in order as they are kept and shown: of a mesh its file's name, since where it lies decides nothing."""
    return tuple(
        sorted(
            _MESH + Path(value.removeprefix(_MESH)).name if value.startswith(_MESH) else value
            for value in map(_spelled, overrides)
        )
    )


def _spelled(override: str) -> str:
    """With the setting as Python spells it; the flags of `rumi run` have dashes."""
    path, equals, text = override.partition("=")
    return path.replace("-", "_") + equals + text


def overridden(values: Mapping[str, Any], overrides: Sequence[str]) -> dict[str, Any]:
    """Settings with some given another value.

    Args:
        values: as `rumi.tasks.rummage.settings.to_dict` gives them.
        overrides: "path.to.setting=value", the value as JSON or else as text; dashes as in the flags of `rumi run` do.

    Raises:
        UsageError: there is no such setting, or no value.
    """
    changed: dict[str, Any] = json.loads(json.dumps(values))
    for override in overrides:
        path, equals, text = _spelled(override).partition("=")
        *parents, last = path.split(".")
        inner: Any = changed
        for parent in parents:
            inner = inner.get(parent) if isinstance(inner, dict) else None
        if not equals or not isinstance(inner, dict) or last not in inner or isinstance(inner[last], dict):
            raise UsageError(
                f"Expected a setting and its value, such as planner.rollouts=3, got {override!r}; "
                "`rumi run --help` lists the settings"
            )
        try:
            inner[last] = json.loads(text)
        except json.JSONDecodeError:
            inner[last] = text
    return changed


def _digest(value: object) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()
