"""The run folder: what a run writes, so that figures, replay and viewers can read it, and how it is read.

settings.json   all resolved settings with versions, written first
object.json     what the object is: of a mesh its file's name and hash, and how the object's frame lies in it
trace.npz       readings, controls, beliefs and plans, step by step; readable while the run goes on and after a kill
steps.jsonl     one line of plain numbers a step, with seconds by stage
belief.npz      the last belief: poses (P, 4, 4) object to world, log_weights, stamp, frame
result.json     how the run ended; missing as long as it has not
"""

import contextlib
import json
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from torch import Tensor

from rumi.agent import stop_reason
from rumi.belief.remarks import Remark
from rumi.errors import UsageError
from rumi.records import RunResult
from rumi.registration.pose_summary import PoseSummary
from rumi.runs.codec import line, read_geometry, read_steps, write_geometry, write_step
from rumi.runs.files import naming, new_file, whole_file
from rumi.runs.plain import plain
from rumi.runs.provenance import provenance
from rumi.runs.scene_geometry import SceneGeometry
from rumi.runs.trace import TraceWriter, read_trace
from sdf.cache import DAMAGED

SCHEMA = 1
"""Version of the run folder; raised when an older reader would misread a newer folder."""

FILES = ("log.h5", "map.toml", "object.json", "steps.jsonl", "trace.npz", "settings.json")
"""What is written before the first step, in the order in which it may be removed."""


class RunRecorder:
    """Writes a run folder while the run goes on; usable as `on_step` of `rumi.loop.run` and as a context manager.

    The folder is this run's alone from the first file on, whoever else wants it. A run that fails or is interrupted
    before its first step leaves nothing there.

    Args:
        folder: where; made with its parents. A folder that holds a run already is refused.
        settings: everything that the run was asked for, as plain values or dataclasses.
        geometry: what figures need beside the steps; may be given later, by `scene`.

    Raises:
        UsageError: the folder cannot be written or holds a run.
    """

    def __init__(self, folder: Path | str, settings: Mapping[str, Any], geometry: SceneGeometry | None = None) -> None:
        self.folder = Path(folder)
        self._last: Any = None  # a record of any task
        self._closed = False
        prepare_folder(self.folder)
        _claim(self.folder, {"schema": SCHEMA, **plain(settings), "made_with": provenance()})
        try:
            with naming(self.folder), contextlib.ExitStack() as opened:
                self._trace = opened.enter_context(TraceWriter(self.folder / "trace.npz"))
                self._lines = opened.enter_context((self.folder / "steps.jsonl").open("w", encoding="utf-8"))
                self._trace.json("format", {"schema": SCHEMA})
                self._trace.flush()
                if geometry is not None:
                    self.scene(geometry)
                opened.pop_all()  # from here on `close` closes them
        except BaseException:
            self._discard()
            raise

    def scene(self, geometry: SceneGeometry) -> None:
        """Add what figures need beside the steps; once."""
        with naming(self.folder):
            write_geometry(self._trace, geometry)
            self._trace.flush()

    def __call__(self, step: Any) -> None:  # noqa: ANN401  (a record of any task)
        """Append a step; once this returns, a kill no longer loses it."""
        with naming(self.folder):
            write_step(self._trace, step, self._last)
            self._trace.flush()
            self._lines.write(json.dumps(line(step), allow_nan=False) + "\n")
            self._lines.flush()
        self._last = step

    def finish(self, result: Any) -> None:  # noqa: ANN401  (of any task)
        """Write how the run ended, and close."""
        self.close()
        write_json(self.folder / "result.json", {"schema": SCHEMA, **plain(result.as_dict())})

    def close(self) -> None:
        """Write the last belief and close; also right for a run that was cut short."""
        if self._closed:
            return
        self._closed = True
        with naming(self.folder):
            self._trace.close()
            self._lines.close()
        if self._last is not None and (poses := self._last.poses) is not None:
            write_belief(self.folder / "belief.npz", *poses, stamp=self._last.stamp)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        try:
            self.close()
        finally:
            if error[0] is not None and self._last is None:
                self._discard()

    def _discard(self) -> None:
        """Remove what a run without a step wrote; settings.json last, until which the folder is nobody else's."""
        for name in FILES:
            (self.folder / name).unlink(missing_ok=True)
        with contextlib.suppress(OSError):  # other files lie in it
            self.folder.rmdir()


@dataclass(frozen=True)
class Run:
    """A run as it was recorded.

    Attributes:
        folder: where it lies.
        settings: what it was asked for.
        geometry: what figures need beside the steps; None where the recorder was given none.
        steps: the records of all whole steps, of the task's own kind.
        result: how it ended, of a task without an own kind of record; None for a run that still goes on or was killed.
        ended: result.json as it is, with today's word for why it ended; None as `result`.
    """

    folder: Path
    settings: dict[str, Any]
    geometry: SceneGeometry | None
    steps: list[Any]
    result: RunResult | None
    ended: dict[str, Any] | None = None

    @property
    def task(self) -> str:
        """Its name, also where a folder of before calls it otherwise."""
        name = self.settings.get("task")
        return {"fused": "handle"}.get(name, name) if isinstance(name, str) else "touch-box"


def load_run(folder: Path | str) -> Run:
    """Read a run folder, also one whose run goes on or was killed.

    Raises:
        UsageError: there is no run, it is damaged, or a newer rumi wrote it.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise UsageError(f"There is no run folder {folder}: give the folder that `rumi run` named at its end")
    settings = _read_json(folder, "settings.json")
    if settings is None or not (folder / "trace.npz").is_file():
        missing = "settings.json" if settings is None else "trace.npz"
        raise UsageError(f"{folder} is no run folder: it has no {missing}")
    schema = settings.get("schema")
    if not isinstance(schema, int) or schema > SCHEMA:
        raise UsageError(
            f"{folder} was written by a newer rumi (schema {schema}, this one reads {SCHEMA}): update rumi"
        )
    ended = _read_json(folder, "result.json")
    try:
        if ended is not None:
            ended["stopped_by"] = stop_reason(str(ended["stopped_by"]))
        result = None if ended is None or "expected_nll" not in ended else _result(ended)
        actions = 0 if result is None else int(result.steps)
    except (KeyError, ValueError, TypeError, OverflowError) as error:
        raise UsageError(f"{folder / 'result.json'} is damaged: {error}") from error
    timings = _timings(folder)
    try:
        members = read_trace(folder / "trace.npz")
        geometry, steps = read_geometry(members), read_steps(members, timings)
    except (AttributeError, IndexError, *DAMAGED) as error:
        raise UsageError(f"{folder / 'trace.npz'} is damaged: {error}") from error
    # an interrupt may have caught the recorder at the last step
    lost = 0 if result is None else actions + 1 - len(steps)
    if result is not None and lost not in ((0, 1) if result.stopped_by == "interrupted" else (0,)):
        raise UsageError(f"{folder / 'trace.npz'} is damaged: {len(steps)} steps are whole of {actions + 1}")
    if result is not None and steps:
        result = replace(result, belief=getattr(steps[-1], "belief", None))
    return Run(folder, settings, geometry, steps, result, ended)


def prepare_folder(folder: Path) -> None:
    """Make the folder of a run, with its parents; other files may lie in it, and stay.

    Raises:
        UsageError: it cannot be written, or holds a run already.
    """
    make_folder(folder)
    if holds_run(folder):
        raise UsageError(f"{folder} holds a run already: give another folder, or remove this one")


def make_folder(folder: Path) -> None:
    """Make a folder, with its parents, and make sure that files can be written there.

    Raises:
        UsageError: they cannot.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise _unwritable(folder, error) from error


def _unwritable(folder: Path, error: OSError) -> UsageError:
    return UsageError(f"Cannot write to the folder {folder}: {error.strerror or error}; give another one")


def holds_run(folder: Path | str) -> bool:
    """Whether a run was begun in this folder."""
    return any((Path(folder) / name).exists() for name in ("settings.json", "trace.npz", "result.json"))


def free_folder(folder: Path) -> Path:
    """Make the folder, with a number behind its name where there is one of that name: no other process has it then.

    Raises:
        UsageError: it cannot be made.
    """
    found, number = folder, 1
    while True:
        try:
            found.mkdir(parents=True)
            return found
        except FileExistsError:
            number += 1
            found = folder.with_name(f"{folder.name}-{number}")
        except OSError as error:
            raise _unwritable(found, error) from error


def _claim(folder: Path, settings: Any) -> None:  # noqa: ANN401  (plain values)
    """Write settings.json in one go, by which the folder is this run's; of two at the same time one is refused."""
    try:
        new_file(folder / "settings.json", json_text(settings))
    except FileExistsError:
        raise UsageError(f"{folder} holds a run already: give another folder, or remove this one") from None


@contextlib.contextmanager
def remove_if_empty_on_error(folder: Path) -> Iterator[None]:
    """Take an empty folder away again where what is done first fails or is interrupted; files in it are kept."""
    try:
        yield
    except BaseException:
        with contextlib.suppress(OSError):
            folder.rmdir()
        raise


def json_text(value: Any) -> str:  # noqa: ANN401  (whatever `plain` takes)
    """A value as the text of a JSON file."""
    return json.dumps(plain(value), indent=2, allow_nan=False) + "\n"


def write_json(path: Path, value: Any) -> None:  # noqa: ANN401  (whatever `plain` takes)
    """Write JSON in one go: a reader finds the whole file or none."""
    text = json_text(value)
    with whole_file(path) as aside:
        aside.write_text(text, encoding="utf-8")


def write_belief(path: Path, poses: Tensor, log_weights: Tensor, *, stamp: float, frame: str = "world") -> None:
    """Write a belief for other programs, in one go.

    `poses` (P, 4, 4) map the object's frame to `frame`, `log_weights` (P) are normalised, `stamp` is in seconds.
    """
    with whole_file(path) as aside, TraceWriter(aside) as archive:
        archive.array("poses", poses.detach().cpu().numpy())
        archive.array("log_weights", log_weights.detach().cpu().numpy())
        archive.array("stamp", np.asarray(stamp))
        archive.array("frame", np.asarray(frame))


def _read_json(folder: Path, name: str) -> dict[str, Any] | None:
    path = folder / name
    if not path.is_file():
        return None
    try:
        return dict(json.loads(path.read_text(encoding="utf-8")))
    except (ValueError, TypeError) as error:
        raise UsageError(f"{path} is damaged: {error}") from error


def _result(values: Mapping[str, Any]) -> RunResult:
    known = {field.name: values.get(field.name) for field in fields(RunResult)}
    for name in ("apc", "expected_nll"):  # numbers that are always there: null stands for one that is not finite
        known[name] = float("nan") if known[name] is None else known[name]
    known["pose"] = None if known["pose"] is None else PoseSummary.of(known["pose"])
    known |= {"relies_on": known["relies_on"] or "", "warnings": tuple(known["warnings"] or ())}
    known |= {"lost": bool(known["lost"]), "explanations": known["explanations"] or {}}
    known["remarks"] = tuple(Remark(**remark) for remark in known["remarks"] or ())
    return RunResult(**known)  # type: ignore[arg-type]


def _timings(folder: Path) -> dict[int, dict[str, float]]:
    """Seconds by stage of each step; they are for people, so that a line that has none is no error."""
    found: dict[int, dict[str, float]] = {}
    path = folder / "steps.jsonl"
    for text in path.read_text(encoding="utf-8", errors="replace").splitlines() if path.is_file() else ():
        with contextlib.suppress(ValueError):
            values = json.loads(text)
            step, seconds = (values.get(name) if isinstance(values, dict) else None for name in ("step", "timings_s"))
            if isinstance(step, int) and isinstance(seconds, dict):
                found[step] = seconds
    return found
