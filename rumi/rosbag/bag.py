"""Import of a ROS bag as a log of raw streams."""

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np

from rumi.errors import UsageError
from rumi.rosbag.frames import FrameTree
from rumi.rosbag.mapping import BagMap, Topic
from rumi.rosbag.mcap import BagError, Message
from rumi.rosbag.messages import CONVERTERS, RowOf
from rumi.rosbag.source import source_of
from sensors.log.errors import LogError
from sensors.log.reader import Log
from sensors.log.writer import LogWriter

_TF = {"/tf": Topic("tf"), "/tf_static": Topic("tf")}
_Unpack = Callable[[Message], Any]


@dataclass
class BagImport:
    """Report of an import.

    Attributes:
        rows: by stream.
        kinds: of the streams.
        odd: by stream, how many stamps were odd, and how.
        lost: by topic, how many messages could not be read, and why the first one.
        problems: what else was wrong.
    """

    rows: Counter[str] = field(default_factory=Counter)
    kinds: dict[str, str] = field(default_factory=dict)
    odd: dict[str, dict[str, int]] = field(default_factory=dict)
    lost: dict[str, tuple[int, str]] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)


def import_bag(bag: Path, mapping: BagMap, path: Path, *, future_s: float = 1.0) -> BagImport:
    """Write a log of a bag's streams.

    The log is written aside and put in its place at the end. What cannot be read of a bag is told and left out; the
    rest is kept.

    Args:
        bag: a .bag file of ROS 1, an .mcap or .db3 file, the folder of a bag, or CSV or JSON lines.
        mapping: which topics to take.
        path: of the log.
        future_s: seconds that a message's stamp may be later than when it was received.

    Raises:
        UsageError: there is no such bag, none of the topics is in it, or the log cannot be written.
        ModuleNotFoundError: rosbags is not installed.
    """
    done, seen = _attempt(bag, mapping, path, future_s, walk=False)
    if done is None:
        done, seen = _attempt(bag, mapping, path, future_s, walk=True)
    assert done is not None
    topics = {**_TF, **mapping.topics}
    listed = ", ".join(f"{name} ({kind})" for name, kind in sorted(seen.items())) or "none"
    lacking = [name for name in mapping.topics if not any(fnmatchcase(topic, name) for topic in seen)]
    if not any(done.rows.values()):
        path.unlink(missing_ok=True)
        why = "".join(f"; {problem}" for problem in (*done.problems, *(why for _, why in done.lost.values())))
        raise UsageError(f"Expected messages of {', '.join(topics)} in {bag}, found none; its topics are {listed}{why}")
    if lacking:
        done.problems.append(f"the bag has no {', '.join(lacking)}; its topics are {listed}")
    return done


def check_frames(path: Path, mapping: BagMap) -> None:
    """Refuse a mapping whose frames, of the tool, the object or a topic, nothing in a log connects to the world.

    Raises:
        UsageError: with the frame, and those that there are.
    """
    with Log(path) as log:
        tree = FrameTree.of_log(log, mapping)
        for frame in (mapping.frames.tool, mapping.frames.motion, mapping.frames.truth):
            if frame is not None:
                tree.chains(frame)
        for topic in mapping.topics.values():
            if topic.frame is not None:
                tree.chains(topic.frame)


def _attempt(
    bag: Path, mapping: BagMap, path: Path, future_s: float, *, walk: bool
) -> tuple[BagImport | None, dict[str, str]]:
    """The import by rosbags, or record by record; None where rosbags cannot read an MCAP file to its end."""
    source, done = source_of(bag), BagImport()
    seen: dict[str, str] = {}
    about = {"map": mapping.text, "bag": bag.name}
    try:
        log = LogWriter(path, about=about, live=False, future_s=future_s)
    except LogError as error:
        raise UsageError(str(error)) from error
    columns = _Joints()
    try:
        for found in source.salvaged(done.problems) if walk else source.messages():
            seen[found.topic] = found.kind
            topic = mapping.topic(found.topic) or _TF.get(found.topic)
            if topic is None:
                continue
            for row in _rows(found, topic, source.unpack, done):
                _add(log, columns.ordered(row), found.received_ns, done)
    except BagError as error:
        if not walk and source.salvageable:
            log.discard()
            return None, seen
        done.problems.append(f"the bag cannot be read further: {error}")
    except BaseException:
        log.discard()
        raise
    done.odd = {name: odd for name, odd in log.odd.items() if odd}
    log.finish({"rows": dict(done.rows), "lost": {k: v[0] for k, v in done.lost.items()}, "problems": done.problems})
    return done, seen


def _rows(found: Message, config: Topic, unpack: _Unpack, done: BagImport) -> Iterator[RowOf]:
    """Rows of a message; what is wrong with one is counted, and the next one is read."""
    if found.kind not in CONVERTERS:
        known = ", ".join(sorted(CONVERTERS))
        raise UsageError(f"Expected {found.topic} to be of a type among {known}, got {found.kind}")
    roles, convert = CONVERTERS[found.kind]
    if config.role not in roles:
        raise UsageError(f"Expected {found.topic} ({found.kind}) to be {' or '.join(roles)}, got {config.role}")
    try:
        rows = convert(unpack(found), found.topic, config)
    except (KeyboardInterrupt, MemoryError):
        raise
    except Exception as error:  # damaged bytes may bring about any error when they are unpacked
        _lost(done, found.topic, error)
        return
    while True:
        try:
            row = next(rows)
        except StopIteration:
            return
        except (KeyboardInterrupt, MemoryError):
            raise
        except Exception as error:  # or when they are read
            _lost(done, found.topic, error)
            return
        yield row


def _lost(done: BagImport, name: str, why: object) -> None:
    count, first = done.lost.get(name, (0, f"{name}: {why}"))
    done.lost[name] = (count + 1, first)


def _add(log: LogWriter, row: RowOf, received_ns: int, done: BagImport) -> None:
    name = row.stream.name
    if done.kinds.get(name, row.stream.kind) != row.stream.kind:
        _lost(done, name, f"changes from {done.kinds[name]} to {row.stream.kind}")
        return
    try:
        if name not in done.kinds:
            log.add_stream(row.stream)
            done.kinds[name] = row.stream.kind
        log.append(name, row.stamp_ns, received_ns, **row.values)
    except LogError as error:  # numbers that no column of its kind can hold
        _lost(done, name, error)
        return
    done.rows[name] += 1


class _Joints:
    """Puts joints in the order of a stream's first message: others may list them otherwise, or fewer."""

    def __init__(self) -> None:
        self._names: dict[str, list[str]] = {}

    def ordered(self, row: RowOf) -> RowOf:
        if row.stream.kind != "joints":
            return row
        names = list(row.stream.about["names"])
        first = self._names.setdefault(row.stream.name, names)
        if names == first:
            return row
        place = {name: index for index, name in enumerate(names)}
        values: dict[str, object] = {}
        for key, given in row.values.items():
            array = np.asarray(given)
            values[key] = np.array([array[place[name]] if name in place else np.nan for name in first])
        return row._replace(values=values)
