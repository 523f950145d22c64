"""Append-only tables in an HDF5 file: a kill loses no whole row, and damage to one row costs no other.

Rows are only ever appended. A kill while HDF5 writes may cut the last of them short, so that each row has a checksum,
which is written after all of the row: rows without one do not count. Chunks of a file that grows are neither
compressed nor checked by HDF5, since a chunk that holds older rows too is written over as it fills up: with the same
bytes, which a kill cannot harm, but not if they were packed.
"""

import dataclasses
import json
import zlib
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from sensors.log.columns import Column
from sensors.log.errors import LogError

if TYPE_CHECKING:
    import h5py

Row = dict[str, np.ndarray | None]

DAMAGE = (
    OSError,
    KeyError,
    RuntimeError,
    ValueError,
    TypeError,
    AttributeError,
    IndexError,
    OverflowError,
    MemoryError,
)
"""What h5py raises where a file is damaged, or what is found there makes numpy raise."""

CHECK = "row_crc32"
"""The dataset that is written last."""

_CHUNK_BYTES, _CHUNK_ROWS = 1 << 15, 256  # small, so that the first rows lie near the start of the file
_BLOCK_BYTES = 1 << 24  # read at once, of rows that are whole


class TableWriter:
    """Appends rows to a new group.

    Args:
        group: an empty group of the file.
        columns: of each row.
        packed: compress; only for a file that is put in its place when it is finished.
    """

    def __init__(self, group: "h5py.Group", columns: Sequence[Column], *, packed: bool = False) -> None:
        self._columns = tuple(columns)
        group.attrs["columns"] = json.dumps([dataclasses.asdict(column) for column in columns])
        self._buffer: list[tuple[dict[str, np.ndarray], int]] = []
        self._sets: dict[str, Any] = {}
        self._ends = {column.name: 0 for column in columns}
        self.rows = 0
        self.buffered_bytes = 0
        for column in columns:
            holder = group.create_group(column.name) if column.variable or column.optional else group
            name = "data" if holder is not group else column.name
            self._sets[column.name] = made = _dataset(holder, name, column.dtype, column.tail, packed)
            (made if holder is group else holder).attrs["about"] = column.about
            if column.variable:
                self._sets[f"{column.name}/end"] = _dataset(holder, "end", "i8", (), packed)
            if column.variable == 2:
                self._sets[f"{column.name}/shape"] = _dataset(holder, "shape", "i4", (2,), packed)
            if column.optional:
                self._sets[f"{column.name}/given"] = _dataset(holder, "given", "u1", (), packed)
        self._sets[CHECK] = _dataset(group, CHECK, "u4", (), packed)
        self._lengths = dict.fromkeys(self._sets, 0)

    def append(self, values: Mapping[str, object]) -> None:
        """Add a row; it is in the file after the next `flush`.

        Raises:
            LogError: a column is missing, unknown or of another shape.
        """
        names = {column.name for column in self._columns}
        if wrong := sorted(set(values) - names):
            raise LogError(f"There is no column {wrong[0]!r}; there are {', '.join(sorted(names))}")
        # all of it before anything changes: a row that is refused leaves no trace
        arrays: dict[str, np.ndarray] = {}
        for column in self._columns:
            value = values.get(column.name)
            if value is None and not column.optional:
                raise LogError(f"Expected a value for {column.name}, got none")
            empty = (0,) * column.variable + column.tail
            arrays[column.name] = np.zeros(empty, column.dtype) if value is None else column.array(value)
        row: dict[str, np.ndarray] = {}
        check = 0
        for column in self._columns:
            given, array = values.get(column.name) is not None, arrays[column.name]
            row[column.name] = array.reshape(-1, *column.tail) if column.variable else array[None]
            if column.variable:
                self._ends[column.name] += len(row[column.name])
                row[f"{column.name}/end"] = np.array([self._ends[column.name]])
            if column.variable == 2:
                row[f"{column.name}/shape"] = np.array([array.shape[:2]], "i4")
            if column.optional:
                row[f"{column.name}/given"] = np.array([given], "u1")
            check = _checksum(array, given, check)
        row[CHECK] = np.array([check], "u4")
        self._buffer.append((row, check))
        self.buffered_bytes += sum(part.nbytes for part in row.values())

    def flush(self) -> None:
        """Write all rows that were appended, checksums last, and hand them to the operating system."""
        if not self._buffer:
            return
        rows = [row for row, _ in self._buffer]
        for name, dataset in self._sets.items():  # CHECK is the last of them
            block = np.concatenate([row[name] for row in rows])
            if len(block):
                start = self._lengths[name]
                self._lengths[name] = start + len(block)
                dataset.resize(self._lengths[name], 0)
                dataset[start:] = block
            dataset.flush()
        self.rows += len(rows)
        self._buffer, self.buffered_bytes = [], 0


class Table:
    """Rows of a group, as far as they are whole.

    Args:
        group: as `TableWriter` left it; it says itself which columns it has.

    Raises:
        LogError: the group is no table, or a column is missing.
    """

    def __init__(self, group: "h5py.Group") -> None:
        self._group, self.name = group, str(group.name)
        try:
            recorded = json.loads(group.attrs["columns"])
            self.columns = tuple(Column(**{**column, "tail": tuple(map(int, column["tail"]))}) for column in recorded)
            for column in self.columns:
                np.dtype(column.dtype)  # raises where damage made it no type
                if not isinstance(column.name, str) or column.variable not in (0, 1, 2):
                    raise ValueError(f"a column {column.name!r} of {column.variable!r} axes that vary")
            self._checks = group[CHECK]
            self._rows = int(self._checks.shape[0])
        except DAMAGE as error:
            raise LogError(f"Expected {self.name} to be a table of a log, could not read it: {error}") from None
        self._sets: dict[str, Any] = {}
        for column in self.columns:
            parts = {column.name: f"{column.name}/data"} if column.variable or column.optional else {column.name: ""}
            parts |= {f"{column.name}/end": ""} if column.variable else {}
            parts |= {f"{column.name}/shape": ""} if column.variable == 2 else {}
            parts |= {f"{column.name}/given": ""} if column.optional else {}
            for name, path in parts.items():
                try:
                    self._sets[name] = made = group[path or name]
                    made.shape, made.dtype  # noqa: B018  (raise where they are damaged)
                except DAMAGE as error:
                    raise LogError(
                        f"Expected {self.name} to hold {path or name}: the log is damaged, or of another kind ({error})"
                    ) from None
        self.damaged: list[int] = []

    def __len__(self) -> int:
        """Number of rows that were written whole, damaged ones included."""
        return self._rows

    def rows(self, start: int = 0, end: int | None = None) -> Iterator[tuple[int, Row]]:
        """The index and the values of each row, without those that are damaged: `damaged` lists these afterwards.

        Args:
            start: the first row.
            end: the one after the last; all by default.
        """
        self.damaged = []
        at, last = start, len(self) if end is None else min(end, len(self))
        while at < last:
            stop = min(self._block_end(at), last)
            try:
                block = self._read(at, stop)
            except DAMAGE:
                block = None
            for index in range(at, stop):
                row = None
                if block is not None:
                    row = self._row(block, index - at)
                elif stop - at > 1:
                    try:
                        row = self._row(self._read(index, index + 1), 0)
                    except DAMAGE:
                        row = None
                if row is None:
                    self.damaged.append(index)
                else:
                    yield index, row
            at = stop

    def unchecked(self, name: str) -> np.ndarray:
        """A column of fixed shape as it lies in the file, as many rows as there are, not checked.

        Raises:
            OSError: the file is damaged there.
        """
        return np.asarray(self._sets[name][: len(self)])

    def _block_end(self, at: int) -> int:
        """So many rows that they fit a block, by the size of the first."""
        size = 64
        for column in self.columns:
            size += int(np.prod(column.tail)) * np.dtype(column.dtype).itemsize * self._length(column, at)
        return min(len(self), at + max(1, min(4096, _BLOCK_BYTES // size)))

    def _length(self, column: Column, at: int) -> int:
        if not column.variable:
            return 1
        try:
            first, last = self._span(column, at, at + 1)
        except DAMAGE:
            return 1
        return last - first

    def _span(self, column: Column, start: int, stop: int) -> tuple[int, int]:
        ends = self._sets[f"{column.name}/end"][max(0, start - 1) : stop]
        first, last = int(ends[0]) if start else 0, int(ends[-1])
        if len(ends) != stop - max(0, start - 1) or not 0 <= first <= last <= self._sets[column.name].shape[0]:
            raise ValueError(f"{column.name} ends at {last}, out of its {self._sets[column.name].shape[0]}")
        return first, last

    def _read(self, start: int, stop: int) -> dict[str, np.ndarray]:
        block = {CHECK: self._checks[start:stop]}
        for column in self.columns:
            if column.variable:
                first, last = self._span(column, start, stop)
                ends = self._sets[f"{column.name}/end"][start:stop]
                block[f"{column.name}/start"] = np.concatenate(([first], ends[:-1])) - first
                block[f"{column.name}/end"] = ends - first
            else:
                first, last = start, stop
            block[column.name] = self._sets[column.name][first:last]
            if len(block[column.name]) < last - first:
                raise ValueError(f"{column.name} is shorter than its rows")
            for part in ("shape", "given"):
                if (name := f"{column.name}/{part}") in self._sets:
                    block[name] = self._sets[name][start:stop]
        return block

    def _row(self, block: Mapping[str, np.ndarray], index: int) -> Row | None:
        """A row of a block, None if it is not what was written."""
        row: Row = {}
        check = 0
        try:
            for column in self.columns:
                given = not column.optional or bool(block[f"{column.name}/given"][index])
                if column.variable:
                    first, last = (int(block[f"{column.name}/{part}"][index]) for part in ("start", "end"))
                    if not 0 <= first <= last:
                        return None
                    array = block[column.name][first:last]
                else:
                    array = np.asarray(block[column.name][index])
                if column.variable == 2:
                    array = array.reshape(*block[f"{column.name}/shape"][index].tolist(), *column.tail)
                check = _checksum(array, given, check)
                row[column.name] = array if given else None
            return row if check == int(block[CHECK][index]) else None
        except DAMAGE:
            return None


def _dataset(group: "h5py.Group", name: str, dtype: str, tail: tuple[int, ...], packed: bool) -> Any:  # noqa: ANN401
    each = max(1, int(np.prod(tail)) * np.dtype(dtype).itemsize)
    rows = (16 if packed else 1) * _CHUNK_BYTES // each
    chunk = (max(1, rows if name == "data" else min(_CHUNK_ROWS, rows)), *tail)
    packing: dict[str, Any] = {"compression": "gzip", "compression_opts": 1, "shuffle": True} if packed else {}
    return group.create_dataset(name, (0, *tail), dtype, maxshape=(None, *tail), chunks=chunk, **packing)


def _checksum(array: np.ndarray, given: bool, before: int) -> int:
    shape = repr((given, array.shape)).encode()
    return zlib.crc32(np.ascontiguousarray(array).tobytes(), zlib.crc32(shape, before))
