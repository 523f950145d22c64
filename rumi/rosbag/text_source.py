"""Recordings as text, CSV or JSON lines, as the messages of a bag: a file a topic, a row a sample."""

import csv
import heapq
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from decimal import Decimal, InvalidOperation
from itertools import groupby
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from rumi.rosbag.mcap import BagError, Message

SUFFIXES = (".csv", ".jsonl")
STAMP = "stamp_s"
"""Column of the seconds of a row."""

_PLACE, _TURN = ("x", "y", "z"), ("qx", "qy", "qz", "qw")
_FORCE, _TORQUE = ("fx", "fy", "fz"), ("tx", "ty", "tz")
_JOINT = ("position", "velocity", "effort")


Row = Mapping[str, Any]
Build = Callable[[SimpleNamespace, Sequence[Row]], SimpleNamespace]


class TextSource:
    """A recording as text: what `BagSource` is to a bag.

    Args:
        path: a .csv or .jsonl file, or a folder of some.

    Attributes:
        salvageable: whether it can be read record by record too.
    """

    salvageable = False

    def __init__(self, path: Path) -> None:
        self.path, self._files = path, text_files(path)

    def messages(self) -> Iterator[Message]:
        """All samples, in the order of their stamps.

        Raises:
            BagError: a file cannot be read, or not further; the message says which row, and why.
        """
        yield from heapq.merge(*(_samples(file) for file in self._files), key=lambda one: one.received_ns)

    def salvaged(self, problems: list[str]) -> Iterator[Message]:
        """Nothing more: `messages` reads row by row up to the first that is wrong."""
        return iter(())

    def unpack(self, message: Message) -> Any:  # noqa: ANN401  (as `BagSource` has it)
        """A sample as a message."""
        return message.data


def text_files(path: Path) -> list[Path]:
    """The text files of a recording, none where it is a bag."""
    if path.is_dir():
        return sorted(file for file in path.iterdir() if file.suffix in SUFFIXES)
    return [path] if path.suffix in SUFFIXES and path.is_file() else []


def _samples(file: Path) -> Iterator[Message]:
    """Messages of a file; rows of points with the same stamp are one cloud."""
    kind: tuple[str, Build] | None = None
    number = 0
    try:
        for stamp, rows in groupby(_rows(file), key=_stamp_ns):
            found = list(rows)
            kind = kind or _kind(found[0])
            header = SimpleNamespace(stamp=SimpleNamespace(sec=stamp // 10**9, nanosec=stamp % 10**9), frame_id="")
            parts = [found] if kind[1] is _cloud else [[row] for row in found]
            for part in parts:
                made = kind[1](SimpleNamespace(header=header), part)
                number += len(part)
                yield Message(file.stem, kind[0], stamp, made)
    except (ValueError, KeyError, TypeError, InvalidOperation, OverflowError, csv.Error) as error:
        what = f"it lacks {error}" if isinstance(error, KeyError) else str(error)
        raise BagError(f"{file.name}, sample {number + 1}: {what}") from error


def _rows(file: Path) -> Iterator[Row]:
    try:
        with file.open(newline="", encoding="utf-8-sig") as lines:
            if file.suffix == ".csv":
                for row in csv.DictReader(lines, skipinitialspace=True):
                    yield {str(name).strip(): value for name, value in row.items()}
            else:
                for line in lines:
                    if line.strip():
                        yield _object(json.loads(line))
    except (OSError, UnicodeDecodeError) as error:
        raise BagError(f"{file.name}: {error}") from error


def _object(row: Any) -> Row:  # noqa: ANN401  (what JSON has)
    if not isinstance(row, dict):
        raise ValueError(f"expected an object, got {type(row).__name__}")
    return row


def _stamp_ns(row: Row) -> int:
    """Whole nanoseconds: floating seconds since 1970 tell 0.2 microseconds."""
    if STAMP not in row:
        raise ValueError(f"expected a column {STAMP}, the seconds, among {', '.join(map(str, row))}")
    stamp = int((Decimal(str(row[STAMP])) * 10**9).to_integral_value())
    if not 0 <= stamp < 2**63:
        raise ValueError(f"expected {STAMP} of 0 to 9.2e9 s, got {row[STAMP]}")
    return stamp


def _kind(row: Row) -> tuple[str, Build]:
    """The type of message that a row's names tell, and what makes one of rows."""
    names = set(row) - {STAMP}
    if names == {*_PLACE, *_TURN}:
        return "geometry_msgs/msg/PoseStamped", _pose
    if names == {*_FORCE, *_TORQUE}:
        return "geometry_msgs/msg/WrenchStamped", _wrench
    if names in ({*_PLACE}, {"points"}):
        return "sensor_msgs/msg/PointCloud2", _cloud
    if names == {"touched"}:
        return "std_msgs/msg/Bool", _flag
    if names and all(name.partition("_")[0] in _JOINT and name.partition("_")[2] for name in names):
        return "sensor_msgs/msg/JointState", _joints
    if names and all(name.partition("_")[0] == "value" for name in names):
        return "std_msgs/msg/Float64MultiArray", _numbers
    raise ValueError(
        f"expected beside {STAMP} the columns {' '.join(_PLACE + _TURN)} of a pose, {' '.join(_FORCE + _TORQUE)} of a "
        f"wrench, {' '.join(_PLACE)} of points, touched, position_JOINT velocity_JOINT effort_JOINT or value_1 "
        f"value_2 ..., got {', '.join(sorted(names)) or 'none'}"
    )


def _vector(row: Row, names: Sequence[str]) -> SimpleNamespace:
    return SimpleNamespace(**{key: float(row[name]) for key, name in zip("xyzw", names, strict=False)})


def _pose(message: SimpleNamespace, rows: Sequence[Row]) -> SimpleNamespace:
    message.pose = SimpleNamespace(position=_vector(rows[0], _PLACE), orientation=_vector(rows[0], _TURN))
    return message


def _wrench(message: SimpleNamespace, rows: Sequence[Row]) -> SimpleNamespace:
    message.wrench = SimpleNamespace(force=_vector(rows[0], _FORCE), torque=_vector(rows[0], _TORQUE))
    return message


def _cloud(message: SimpleNamespace, rows: Sequence[Row]) -> SimpleNamespace:
    given = [row["points"] if "points" in row else [[row[name] for name in _PLACE]] for row in rows]
    points = np.array([point for part in given for point in part], np.float32).reshape(-1, 3)
    fields = [SimpleNamespace(name=name, offset=4 * at, datatype=7) for at, name in enumerate(_PLACE)]
    size = SimpleNamespace(height=1, width=len(points), point_step=12, row_step=12 * len(points), is_bigendian=False)
    data = np.frombuffer(points.astype("<f4").tobytes(), np.uint8)
    return SimpleNamespace(header=message.header, fields=fields, data=data, **vars(size))


def _flag(message: SimpleNamespace, rows: Sequence[Row]) -> SimpleNamespace:
    word = str(rows[0]["touched"]).strip().lower()
    if word not in ("0", "1", "true", "false"):
        raise ValueError(f"expected touched to be 0, 1, true or false, got {word!r}")
    message.data = word in ("1", "true")
    return message


def _joints(message: SimpleNamespace, rows: Sequence[Row]) -> SimpleNamespace:
    message.name = list(dict.fromkeys(name.partition("_")[2] for name in rows[0] if name != STAMP))
    for part in _JOINT:
        columns = [f"{part}_{joint}" for joint in message.name]
        setattr(message, part, [float(rows[0][one]) for one in columns] if columns[0] in rows[0] else [])
    return message


def _numbers(message: SimpleNamespace, rows: Sequence[Row]) -> SimpleNamespace:
    message.data = [float(rows[0][name]) for name in rows[0] if name != STAMP]
    return message
