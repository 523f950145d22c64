"""Raw stream of a log: its samples by time."""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from sensors.log.columns import KINDS, STAMPS
from sensors.log.errors import LogError
from sensors.log.table import DAMAGE, Row, Table
from sensors.log.writer import Odd

if TYPE_CHECKING:
    import h5py


@dataclass(frozen=True)
class Sample:
    """One row of a raw stream.

    Attributes:
        stamp_ns: ns since 1970, by the sensor's clock; where that was not set, of its receipt.
        received_ns: ns since 1970, of its receipt.
        odd: what is odd about the stamp.
        values: the kind's columns.
    """

    stamp_ns: int
    received_ns: int
    odd: Odd
    values: Row


class Stream:
    """One raw stream of a log.

    Attributes:
        name: of the stream.
        kind: one of `KINDS`.
        frame: that its numbers are in.
        about: its further attributes.
        problems: what was wrong with it, as far as it was read.
    """

    def __init__(self, name: str, group: "h5py.Group") -> None:
        self.name = name
        try:
            attrs = {key: group.attrs[key] for key in group.attrs}
        except DAMAGE as error:
            raise LogError(f"stream {name} is damaged at its head and left out: {error}") from None
        self.kind, self.frame = str(attrs.pop("kind", "")), str(attrs.pop("frame", ""))
        if self.kind not in KINDS:
            raise LogError(f"Stream {name} is of a kind that this rumi does not know, {self.kind!r}: update rumi")
        attrs.pop("columns", None)
        try:
            self.about: dict[str, Any] = {key: json.loads(value) for key, value in attrs.items()}
            self.name = str(self.about.pop("stream_name", name))
        except DAMAGE as error:
            raise LogError(f"stream {name} has damaged attributes and is left out: {error}") from None
        self._table = Table(group)
        needed = {column.name for column in (*STAMPS, *KINDS[self.kind]) if not column.optional}
        if lacking := sorted(needed - {column.name for column in self._table.columns}):
            raise LogError(f"Expected stream {name} of kind {self.kind} to hold {lacking[0]}, found none")
        self.problems: list[str] = []

    def __len__(self) -> int:
        return len(self._table)

    @property
    def parts(self) -> frozenset[str]:
        """What lies in its group of its own."""
        return frozenset(column.name.partition("/")[0] for column in self._table.columns)

    def stamps_ns(self) -> np.ndarray:
        """Stamps of the rows that `samples` gives, not checked and in the order in which they came; reads little.

        Raises:
            LogError: the stream is damaged there.
        """
        stamps, flags = self._stamps()
        return stamps[(flags & (Odd.DUPLICATE | Odd.FUTURE)) == 0]

    def _stamps(self) -> tuple[np.ndarray, np.ndarray]:
        try:
            stamps, flags = self._table.unchecked("stamp_ns"), self._table.unchecked("flag")
        except DAMAGE as error:
            raise LogError(f"The stamps of stream {self.name} are damaged: {error}") from error
        count = min(len(stamps), len(flags))  # the same but for damage
        return stamps[:count], flags[:count]

    def as_recorded(self, start: int = 0, end: int | None = None) -> Iterator[Sample]:
        """All rows that can be read, in the order in which they came.

        Args:
            start: the first row.
            end: the one after the last.
        """
        for _, row in self._table.rows(start, end):
            stamp, received, odd = (int(_need(row, column.name)) for column in STAMPS)
            values = {name: value for name, value in row.items() if name not in {column.name for column in STAMPS}}
            yield Sample(stamp, received, Odd(odd), values)
        self.problems = [f"stream {self.name}: {_those(self._table.damaged)}"] if self._table.damaged else []

    def samples(self, begin_ns: int | None = None, end_ns: int | None = None) -> list[Sample]:
        """The rows that a belief is made from: in the order of their stamps, without duplicates and future stamps.

        Args:
            begin_ns: the earliest; earlier ones are not read.
            end_ns: the latest; later ones are not read.
        """
        rows: tuple[int, int | None] = (0, None)
        if begin_ns is not None or end_ns is not None:
            stamps, _ = self._stamps()
            low = stamps.min(initial=0) if begin_ns is None else begin_ns
            high = stamps.max(initial=0) if end_ns is None else end_ns
            inside = ((low <= stamps) & (stamps <= high)).nonzero()[0]
            if len(inside) == 0:
                return []
            rows = (int(inside[0]), int(inside[-1]) + 1)
        good = [one for one in self.as_recorded(*rows) if not one.odd & (Odd.DUPLICATE | Odd.FUTURE)]
        if begin_ns is not None:
            good = [one for one in good if one.stamp_ns >= begin_ns]
        if end_ns is not None:
            good = [one for one in good if one.stamp_ns <= end_ns]
        return sorted(good, key=lambda sample: sample.stamp_ns)


def _need(row: Row, name: str) -> np.ndarray:
    value = row[name]
    if value is None:
        raise LogError(f"Expected a value for {name}, found none")
    return value


def _those(rows: list[int]) -> str:
    shown = ", ".join(map(str, rows[:5])) + (", ..." if len(rows) > 5 else "")
    return f"{len(rows)} row{'s are' if len(rows) > 1 else ' is'} damaged and left out ({shown})"
