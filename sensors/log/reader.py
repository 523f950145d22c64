"""Reader of a log, also of one that still grows, was killed, was cut short or is damaged."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import torch
from torch import Tensor

from sdf.extras import optional
from sensors.contact_reading import ContactReading
from sensors.log.columns import reading_columns, reading_of
from sensors.log.errors import LogError
from sensors.log.repaired_header import RepairedHeader
from sensors.log.stream import Sample, Stream
from sensors.log.table import DAMAGE, Row, Table
from sensors.log.writer import FORMAT, SCHEMA
from sensors.reading import Reading

if TYPE_CHECKING:
    import h5py

__all__ = ["Log", "Sample", "Stream", "Taken"]


@dataclass(frozen=True, eq=False)
class Taken:
    """Recorded step of a run: its reading and the action that led to it.

    Attributes:
        reading: as the belief got it, of the task's own kind.
        control: the action that led here, (A,) where it is numbers; None for the first view.
        truth: (4, 4), true world_T_object, None where unknown.
        digest: SHA-256 of the belief after it, None where none was kept.
    """

    reading: Any
    control: Any
    truth: Tensor | None
    digest: bytes | None


class Log:
    """A log, open for reading; use as a context manager.

    Args:
        path: of the file.

    Raises:
        LogError: there is no such file, it is no log, or a newer rumi wrote it.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        if not self.path.is_file():
            raise LogError(f"There is no log {self.path}")
        self._file = _opened(self.path)
        try:
            self._read_head()
        except BaseException:
            self._file.close()
            raise

    def _read_head(self) -> None:
        try:
            attrs = self._file.attrs
            form, schema = attrs.get("format"), attrs.get("schema")
            if form != FORMAT:
                raise LogError(f"{self.path} is no log of rumi: expected its attribute format to be {FORMAT!r}")
            if not isinstance(schema, int | np.integer) or schema > SCHEMA:
                raise LogError(
                    f"{self.path} was written by a newer rumi (schema {schema}, this one reads {SCHEMA}): update rumi"
                )
            self.schema = int(schema)
        except DAMAGE as error:
            if isinstance(error, LogError):
                raise
            raise LogError(f"{self.path} is damaged at its head, and nothing of it can be read: {error}") from error
        self.problems: list[str] = []
        self.texts, self._lost_texts = self._found_texts()
        try:
            end = json.loads(_text(self._file["end"]) or "null")
            self._end: dict[str, Any] | None = end if isinstance(end, dict) else None
        except DAMAGE:  # a kill may have caught it being written
            self._end = None
        if self._end is None:
            self.problems.append("the log was not finished: what had been written is there")
        self.streams = self._found_streams()

    def _found_texts(self) -> tuple[dict[str, str], list[str]]:
        """Texts by name, and the names of those that are damaged."""
        found: dict[str, str] = {}
        lost: list[str] = []
        try:
            if "about" not in self._file:
                return found, lost
            about = self._file["about"]
            names = list(about)
        except DAMAGE as error:
            self.problems.append(f"the texts about the log are damaged: {error}")
            return found, ["settings"]
        for name in names:
            try:
                found[name] = _text(about[name])
            except DAMAGE as error:
                self.problems.append(f"the text about/{name} is damaged: {error}")
                lost.append(name)
        return found, lost

    def _found_streams(self) -> dict[str, Stream]:
        found: dict[str, Stream] = {}
        try:
            self._look_into(self._file["streams"], "", found)
        except DAMAGE as error:
            self.problems.append(f"the streams cannot be listed: {error}")
        return found

    def _look_into(
        self, group: "h5py.Group", prefix: str, found: dict[str, Stream], skip: frozenset[str] = frozenset()
    ) -> None:
        """The streams below a group; what is damaged costs no other one."""
        subgroup = optional("h5py").Group
        for name in sorted(set(group) - skip):
            path = prefix + name
            try:
                item = group[name]
                if not isinstance(item, subgroup):
                    continue
                columns: frozenset[str] = frozenset()
                if "kind" in item.attrs:
                    stream = Stream(path, item)
                    found[stream.name], columns = stream, stream.parts
                self._look_into(item, f"{path}/", found, columns)
            except LogError as error:
                self.problems.append(str(error))
            except DAMAGE as error:
                self.problems.append(f"stream {path} is damaged and left out: {error}")

    @property
    def end(self) -> Mapping[str, Any] | None:
        """How it ended; None for a log that was not finished."""
        return self._end

    @property
    def settings(self) -> dict[str, Any] | None:
        """Of the run that made it, as plain values; None where none did.

        Raises:
            LogError: they are damaged.
        """
        if "settings" in self._lost_texts:
            raise LogError(f"{self.path} has damaged settings, without which its readings cannot be taken in")
        try:
            return dict(json.loads(self.texts["settings"])) if "settings" in self.texts else None
        except (ValueError, TypeError) as error:
            raise LogError(f"{self.path} has damaged settings: {error}") from error

    def stream(self, name: str) -> Stream:
        """A stream by name.

        Raises:
            LogError: there is none; the message lists those that there are.
        """
        if name not in self.streams:
            raise LogError(f"{self.path} has no stream {name!r}; it has {', '.join(sorted(self.streams)) or 'none'}")
        return self.streams[name]

    def taken(self) -> list[Taken]:
        """What the run took in, step by step, up to the first row that is damaged; `problems` says if one was.

        The readings are of the first kind that has a field for each of their columns.

        Raises:
            LogError: the readings are of a newer rumi, or are not there.
        """
        try:
            group = self._file["readings"]
        except DAMAGE:
            raise LogError(f"{self.path} is damaged: its readings are gone") from None
        table = Table(group)
        wrong: list[str] = []
        for kind in (Reading, ContactReading):
            wrong = sorted(
                {column.name for column in table.columns} - {one.name for one in reading_columns("f4", kind)}
            )
            if not wrong:
                break
        else:
            raise LogError(f"{self.path} has readings with {wrong[0]}, which this rumi does not know: update rumi")
        found: list[Taken] = []
        for index, row in table.rows():
            if index != len(found):
                break  # a belief cannot go on without what came in between
            try:
                found.append(_taken(row, kind))
            except ValueError as error:
                raise LogError(f"{self.path} holds no usable reading at step {index}: {error}") from error
        if len(found) < len(table):
            self.problems.append(
                f"reading {len(found)} of {len(table)} is damaged: those before it are there, later ones are not used"
            )
        return found

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def _opened(path: Path) -> "h5py.File":
    """The file; one that grows, was killed or was cut short as if it had been closed."""
    h5py = optional("h5py", "A log")
    try:
        with path.open("rb"):
            pass
    except OSError as error:
        raise LogError(f"Cannot read {path}: {error.strerror or error}") from error
    try:
        return h5py.File(path, "r")
    except DAMAGE as error:
        first = error
    try:
        return h5py.File(RepairedHeader(path), "r")
    except DAMAGE:
        raise LogError(f"{path} is no HDF5 file, or is damaged at its head: {first}") from first


def _taken(row: Row, kind: type[Reading]) -> Taken:
    control, truth, digest = (row.get(name) for name in ("control", "truth", "digest"))
    return Taken(
        reading_of({name: value for name, value in row.items() if name.startswith("reading/")}, kind),
        None if control is None else torch.from_numpy(control.copy()),
        None if truth is None else torch.from_numpy(truth.copy()),
        None if digest is None else digest.tobytes(),
    )


def _text(dataset: "h5py.Dataset") -> str:
    return bytes(dataset[:]).decode()
