"""Writer of a log while sensors run: raw streams by name, and the readings of a run step by step."""

import enum
import json
import time
import uuid
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import numpy as np

from sdf.extras import optional
from sensors.log.columns import KINDS, STAMPS, reading_columns, reading_values
from sensors.log.errors import LogError
from sensors.log.table import TableWriter
from sensors.reading import Reading

FORMAT, SCHEMA = "rumi-log", 1
"""The root attributes `format` and `schema`; the latter is raised when an older reader would misread a newer log."""

_ABOUT = (
    "Sensor streams and readings as recorded. SI units: metres, radians, seconds, newtons; images in the units that "
    "they say. a_T_b maps points of frame b to frame a. Stamps are ns since 1970. See scripts/docs/reference/files.md."
)
_FLUSH_BYTES = 1 << 20
_END_BYTES = 1 << 16


class Odd(enum.IntFlag):
    """Irregularities of a stamp.

    A late row is put in its place when it is read; the others are left out of what a belief is made from.
    """

    LATE = 1
    """Older than one that came before."""
    DUPLICATE = 2
    """The same as one that came before."""
    FUTURE = 4
    """Later than it was received, by more than the log's `future_s`."""
    UNSET = 8
    """Zero: the time of receipt counts in its place."""


@dataclass(frozen=True)
class StreamSpec:
    """One raw stream.

    Attributes:
        name: by which it is asked for; a slash groups streams.
        kind: one of `KINDS`.
        frame: that its numbers are in.
        about: further attributes: plain values, such as `topic`, `names`, `unit_m`, `parent`, `child`.
    """

    name: str
    kind: str
    frame: str = ""
    about: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise LogError(f"There is no kind of stream {self.kind!r}; there are {', '.join(KINDS)}")
        if not self.name.strip("/") or "." in self.name.split("/"):
            raise LogError(f"Expected a stream to have a name, got {self.name!r}")


class LogWriter:
    """Writes a log; use as a context manager.

    A log that grows in its place (`live`) is readable at any time, also after a kill: all that was flushed is kept.
    Its streams are known from the start. One that is written aside and put in its place when it is finished may add
    streams at any time, and is compressed; where the block fails, nothing is left of it.

    Args:
        path: of the file; it must not exist.
        streams: raw streams.
        settings: of the run, as plain values; None where no run made the log.
        about: further texts by name: kept as they are.
        float_type: of the readings' numbers, `f4` or `f8`.
        readings: their kind.
        live: whether the log grows in its place.
        future_s: seconds that a stamp may be later than the time of receipt.

    Raises:
        LogError: the file exists, or cannot be written.
    """

    def __init__(
        self,
        path: Path | str,
        streams: Sequence[StreamSpec] = (),
        *,
        settings: Mapping[str, Any] | None = None,
        about: Mapping[str, str] | None = None,
        float_type: str = "f4",
        readings: type[Reading] = Reading,
        live: bool = True,
        future_s: float = 1.0,
    ) -> None:
        self.path, self._live, self._future_ns = Path(path), live, int(future_s * 1e9)
        # beside it, under a name that no other writer of the same log takes
        aside = self.path.with_name(f".{uuid.uuid4().hex[:12]}-{self.path.name}")
        self._writes_to = self.path if live else aside
        h5py = optional("h5py", "A log")
        if self.path.exists():
            raise LogError(f"{self.path} exists: give another name, or remove it")
        try:
            # the latest format is the one that can be read while it grows
            self._file = h5py.File(self._writes_to, "x", libver="latest")
        except OSError as error:
            raise LogError(f"Cannot write {self.path}: {error}") from error
        root = self._file.attrs
        root["format"], root["schema"], root["about"], root["future_s"] = FORMAT, SCHEMA, _ABOUT, future_s
        texts = dict(about or {}) | ({} if settings is None else {"settings": json.dumps(settings)})
        for name, text in texts.items():
            self._file.create_dataset(f"about/{name}", data=np.frombuffer(text.encode(), np.uint8))
        self._end = self._file.create_dataset("end", (0,), "u1", maxshape=(None,), chunks=(_END_BYTES,))
        columns = reading_columns(float_type, readings)
        self._readings = TableWriter(self._file.create_group("readings"), columns, packed=not live)
        self._file.create_group("streams")
        self._streams: dict[str, TableWriter] = {}
        self._stamps: dict[str, tuple[set[int], int]] = {}
        self.odd: dict[str, dict[str, int]] = {}
        for stream in streams:
            self._add(stream)
        self._flushed = time.monotonic()
        if live:
            self._file.flush()
            self._file.swmr_mode = True

    def add_stream(self, stream: StreamSpec) -> None:
        """Add a stream to a log that is not live.

        Raises:
            LogError: there is one of that name, or the log is live.
        """
        if self._live:
            raise LogError(f"Expected all streams at the start of a live log, got {stream.name} later")
        self._add(stream)

    def _add(self, stream: StreamSpec) -> None:
        if stream.name in self._streams:
            raise LogError(f"There is a stream {stream.name} already")
        path = self._place(stream.name)
        group = self._file.create_group(f"streams/{path}")
        group.attrs["kind"], group.attrs["frame"] = stream.kind, stream.frame
        if path != stream.name:
            group.attrs["stream_name"] = json.dumps(stream.name)
        for name, value in stream.about.items():
            group.attrs[name] = json.dumps(value)
        self._streams[stream.name] = TableWriter(group, (*STAMPS, *KINDS[stream.kind]), packed=not self._live)
        self._stamps[stream.name] = (set(), 0)
        self.odd[stream.name] = {}

    def _place(self, name: str) -> str:
        """Where a stream lies: by its name, but never in another stream, whose columns have names too."""
        if not any(f"{a}/".startswith(f"{b}/") for one in self._streams for a, b in ((name, one), (one, name))):
            return name
        path = name.replace("%", "%25").replace("/", "%2F")
        return f"{path}%2F" if path in self._file["streams"] else path

    def append(self, stream: str, stamp_ns: int, received_ns: int | None = None, /, **values: object) -> Odd:
        """Add a row to a stream, and say what is odd about its stamp.

        A live log is flushed when a fifth of a second or a megabyte has gathered.

        Args:
            stream: its name.
            stamp_ns: ns since 1970, of the sensor.
            received_ns: the same, of its receipt; now by default.
            values: the kind's columns.

        Raises:
            LogError: there is no such stream, or a value has not the column's shape.
        """
        if stream not in self._streams:
            raise LogError(f"There is no stream {stream!r}; there are {', '.join(self._streams) or 'none'}")
        received = time.time_ns() if received_ns is None else received_ns
        stamp = stamp_ns or received
        odd = self._odd(stream, stamp, received)
        odd |= Odd.UNSET if stamp_ns == 0 else Odd(0)
        table = self._streams[stream]
        table.append({"stamp_ns": stamp, "received_ns": received, "flag": odd.value, **values})
        if not odd & Odd.FUTURE:  # which later ones are not compared with
            seen, latest = self._stamps[stream]
            seen.add(stamp)
            self._stamps[stream] = (seen, max(latest, stamp))
        for one in odd:
            self.odd[stream][one.name.lower()] = self.odd[stream].get(one.name.lower(), 0) + 1  # type: ignore[union-attr]
        if table.buffered_bytes > _FLUSH_BYTES or (self._live and time.monotonic() - self._flushed > 0.2):
            self.flush()
        return odd

    def _odd(self, stream: str, stamp: int, received: int) -> Odd:
        seen, latest = self._stamps[stream]
        if stamp > received + self._future_ns:
            return Odd.FUTURE
        if stamp in seen:
            return Odd.DUPLICATE
        return Odd.LATE if stamp < latest else Odd(0)

    def reading(
        self, reading: Reading, *, control: object = None, truth: object = None, digest: bytes | None = None
    ) -> None:
        """Add what a run took in with one step; once this returns, a kill no longer loses it.

        Args:
            reading: as the belief got it.
            control: (A,), the action that led here; None for the first view.
            truth: (4, 4), true world_T_object, None where unknown.
            digest: SHA-256 of the belief after it.
        """
        values = {"control": control, "truth": truth, "taken_ns": time.time_ns()} | reading_values(reading)
        if digest is not None:
            values["digest"] = np.frombuffer(digest, np.uint8)
        self._readings.append(values)
        self.flush()

    def flush(self) -> None:
        """Hand everything over to the operating system."""
        for table in (*self._streams.values(), self._readings):
            table.flush()
        self._flushed = time.monotonic()

    def finish(self, end: Mapping[str, Any]) -> None:
        """Say how it ended, as plain values, and close; an unfinished log lacks this."""
        self.flush()
        text = np.frombuffer(json.dumps(end).encode(), np.uint8)
        self._end.resize(len(text), 0)
        self._end[:] = text
        self.close()

    def close(self) -> None:
        """Write what is left and close; a log that was written aside is put in its place."""
        if not self._file:
            return
        self.flush()
        self._file.close()
        if not self._live:
            self._writes_to.replace(self.path)

    def discard(self) -> None:
        """Close a log that is not to be kept, and remove it."""
        if self._file:
            self._file.close()
        self._writes_to.unlink(missing_ok=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        if error[0] is not None and not self._live:
            self.discard()
        else:
            self.close()
