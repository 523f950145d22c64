"""Time span of a recording in which the tool's pose is known, and the starts of readings in it."""

from typing import NamedTuple

import torch
from jaxtyping import Int
from torch import Tensor

from rumi.errors import UsageError
from rumi.rosbag.frames import FrameTree
from rumi.rosbag.mapping import BagMap
from rumi.rosbag.streams import role_of
from sensors.log.reader import Log, Stream

_FEW = 10  # so many times fewer rows than the longest stretch: stamps that are wrong, not a part of the recording
MOST_READINGS = 100_000


class Span(NamedTuple):
    """Span of a recording that is used.

    Attributes:
        start_ns: the first stamp.
        end_ns: the last one of which the tool's pose is known.
        known_ns: to when it is taken to be known: poses hold for a little longer.
        read_ns: to when streams are read.
        problems: which rows are stamped far from that.
    """

    start_ns: int
    end_ns: int
    known_ns: int
    read_ns: int
    problems: list[str]


def span_of(log: Log, mapping: BagMap, frames: FrameTree) -> Span:
    """Of a recording: a few rows with wrong stamps neither lengthen it nor move its start.

    Raises:
        UsageError: nothing was recorded.
    """
    view, every = (round(seconds * 1e9) for seconds in (mapping.actions.view_s, mapping.actions.every_s))
    gap = frames.gap_ns
    moving = [stream for stream in log.streams.values() if len(stream) and not stream.about.get("static")]
    stamps = {stream.name: torch.from_numpy(stream.stamps_ns()).long() for stream in moving}
    if not any(len(each) for each in stamps.values()):
        raise UsageError(f"Expected {log.path} to hold raw streams with anything in them, found none")
    problems: list[str] = []
    tool = [_without_few(each, gap) for each in frames.stamps(mapping.frames.tool)]
    still = not tool
    if still:
        tool = [_without_few(torch.cat(list(stamps.values())).sort().values, max(gap, every))]
    first, last = max(int(each[0]) for each in tool), min(int(each[-1]) for each in tool)
    begins, ends = [first], [last]
    for stream in moving:
        mine = stamps[stream.name]
        inside = mine[(mine >= first - view) & (mine <= last + every)]
        if len(far := mine[(mine < first - view) | (mine > last + every)]) and role_of(stream, mapping) != "camera":
            off = max((first - int(far.min())) / 1e9, (int(far.max()) - last) / 1e9)
            problems.append(
                f"stream {stream.name}: {len(far)} of {len(mine)} rows are stamped up to {off:.1f} s from when the "
                "tool's pose is known, and left out"
            )
        begins += _whole(stream, inside.sort().values)
        ends += _whole(stream, inside.sort(descending=True).values)
    known = max(ends) + every // 2
    return Span(min(begins), last, known if still else min(known, last + gap // 10), last + every, problems)


def reading_starts(span: Span, mapping: BagMap, notes: list[str]) -> range:
    """Start of each reading after the first view, ns.

    Raises:
        UsageError: there would be too many.
    """
    every, view = (round(seconds * 1e9) for seconds in (mapping.actions.every_s, mapping.actions.view_s))
    begin = span.start_ns + view
    count = max(0, (span.known_ns - begin) // max(1, every))
    if count > MOST_READINGS:
        hours = (span.end_ns - span.start_ns) / 3.6e12
        raise UsageError(
            f"Expected {MOST_READINGS} readings at most, got {count}, of {mapping.actions.every_s:g} s each in "
            f"{hours:.1f} hours: set actions.every_s higher, or cut the recording"
        )
    rest = span.end_ns - (begin + count * every)
    if rest > round(mapping.frames.longest_gap_s * 1e8):
        notes.append(f"the last {rest / 1e9:.2f} s are less than a reading of {every / 1e9:g} s, and not used")
    return range(begin, begin + count * every, max(1, every))


def _without_few(stamps: Int[Tensor, "n"], gap_ns: int) -> Int[Tensor, "m"]:
    """Rising stamps without few ones far before or after all others."""
    breaks = (stamps.diff() > gap_ns).nonzero()[:, 0] + 1
    parts = list(torch.tensor_split(stamps, breaks.tolist()))
    least = max(map(len, parts)) / _FEW
    while len(parts[0]) < least:
        parts.pop(0)
    while len(parts[-1]) < least:
        parts.pop()
    return torch.cat(parts)


def _whole(stream: Stream, stamps: Int[Tensor, "n"]) -> list[int]:
    """The first of some stamps whose row is not damaged; none if there is none."""
    for stamp in stamps.tolist():
        if stream.samples(stamp, stamp):
            return [stamp]
    return []
