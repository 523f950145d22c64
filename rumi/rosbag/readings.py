"""Readings for a belief from a log's raw streams, by a mapping file."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rumi.errors import UsageError
from rumi.rosbag.contact_sample import ContactSample
from rumi.rosbag.contacts import contact_samples
from rumi.rosbag.frames import FrameTree
from rumi.rosbag.mapping import BagMap
from rumi.rosbag.span import reading_starts, span_of
from rumi.rosbag.views import Views
from rumi.seeding import generator
from sdf import se3
from sensors.contact_reading import ContactReading, WrenchTouch, surest
from sensors.log.reader import Log, Taken
from sensors.observation import Observation, concatenate
from sensors.reading import FORCE, Reading
from sensors.semantics import Semantics
from sensors.touch.tactile import InstantPoints
from sensors.touch.touch_readings import swept_clear

_FREE_SPACING = 0.005  # metres, lattice on which free points are reported
_BODY_SPACING = 0.005  # metres between the tool's points


@dataclass(frozen=True)
class ImportedReadings:
    """Readings made from a recording.

    Attributes:
        taken: the first view first.
        problems: what could not be used.
        wrenches: how many wrenches were taken for what.
        notes: what was found in other streams of touch.
    """

    taken: list[Taken]
    problems: list[str]
    wrenches: dict[str, int]
    notes: list[str]


def make_readings(log: Log, mapping: BagMap, *, seed: int = 0) -> ImportedReadings:
    """Cut a recording into readings.

    The first one holds the view: surface points of the object, and free points about it. Each later one holds
    `actions.instants` poses of the tool over `actions.every_s`, contact points meanwhile as surface points at their
    own instants, and the space that the tool's body swept as free points.

    Args:
        log: with raw streams.
        mapping: what they mean.
        seed: of the fit of the plane that the object stands on.

    Raises:
        UsageError: a stream or a frame that is needed is missing.
    """
    frames = FrameTree.of_log(log, mapping)
    span = span_of(log, mapping, frames)
    start = span.start_ns
    views = Views(log, mapping, frames, generator(seed))
    contacts = contact_samples(log, mapping, frames, span)
    problems = [*frames.problems, *span.problems, *contacts.problems]
    if not (views.any or contacts.any):
        listed = ", ".join(sorted(f"{name} ({stream.kind})" for name, stream in log.streams.items())) or "none"
        raise UsageError(
            "Expected a stream with the role cloud, depth, felt, contact, bubble, wrench, torques or sensor, found "
            f"none that can be read; the log's streams are {listed}"
        )
    first_ns = start + round(mapping.actions.view_s * 1e9)
    seen = views.between(start, first_ns)
    body = mapping.tool.shape().solid(_BODY_SPACING).float()
    cutter = _Cutter(mapping, frames, views, contacts.samples, body, start)
    taken = [cutter.first(seen, first_ns)]
    every = round(mapping.actions.every_s * 1e9)
    for begin in reading_starts(span, mapping, contacts.notes):
        try:
            taken.append(cutter.reading(begin, begin + every))
        except _UnknownPoseError as error:
            at = (begin - start) / 1e9
            problems.append(f"{at:.1f} s to {at + every / 1e9:.1f} s: {error} is not known throughout; left out")
    return ImportedReadings(taken, list(dict.fromkeys(problems + views.problems)), contacts.wrenches, contacts.notes)


class _UnknownPoseError(Exception):
    """A pose that a reading needs is not known; its text says whose."""


class _Cutter:
    """Makes one reading after the other."""

    def __init__(
        self,
        mapping: BagMap,
        frames: FrameTree,
        views: Views,
        contacts: Sequence[ContactSample],
        body: Float[Tensor, "n 3"],
        start: int,
    ) -> None:
        self._mapping, self._frames, self._views, self._contacts, self._body = mapping, frames, views, contacts, body
        self._start = start
        self._region = torch.tensor(mapping.scene.within)
        self._ridden: Tensor | None = None  # pose of frames.motion at the end of the last reading

    def first(self, seen: Observation, stamp_ns: int) -> Taken:
        pose, known = self._frames.at(self._mapping.frames.tool, [stamp_ns])
        if not bool(known.all()):
            raise UsageError(
                "Expected to know the tool's pose at the end of the first view, "
                f"{(stamp_ns - self._start) / 1e9:.1f} s from the start; the recording has none about then"
            )
        instant = torch.zeros(len(seen), dtype=torch.long)
        try:
            motion = self._motion(torch.tensor([stamp_ns]))
        except _UnknownPoseError as error:
            raise UsageError(
                f"Expected to know {error} at the end of the first view; the recording has none"
            ) from error
        return self._taken(seen, instant, pose.float(), torch.zeros(1, dtype=torch.bool), stamp_ns, motion)

    def reading(self, begin_ns: int, end_ns: int) -> Taken:
        count = self._mapping.actions.instants
        # whole numbers: floating ones tell times since 1970 to 0.2 microseconds
        stamps = begin_ns + (end_ns - begin_ns) * torch.arange(1, count + 1) // count
        pose, known = self._frames.at(self._mapping.frames.tool, stamps)
        if not bool(known.all()):
            raise _UnknownPoseError("the tool's pose")
        motion = self._motion(stamps)
        pose = pose.float()
        mine = [one for one in self._contacts if begin_ns < one.stamp_ns <= end_ns]
        at = [min(int(torch.searchsorted(stamps, one.stamp_ns)), count - 1) for one in mine]
        in_contact = torch.zeros(count, dtype=torch.bool)
        parts = [torch.zeros(0, 3)]
        where = [torch.zeros(0, dtype=torch.long)]
        clear, clear_at = [torch.zeros(0, 3)], [torch.zeros(0, dtype=torch.long)]
        for one, k in zip(mine, at, strict=True):
            in_contact[k] |= one.touched
            parts.append(one.points)
            where.append(torch.full((len(one.points),), k))
            within = one.free[((one.free >= self._region[0]) & (one.free <= self._region[1])).all(-1)]
            clear.append(within)
            clear_at.append(torch.full((len(within),), k))
        points, instant = torch.cat(parts), torch.cat(where)
        touched, clear_m = InstantPoints(points, instant), self._mapping.scene.clear_m
        free = swept_clear(pose, self._body, in_contact, touched, self._region, _FREE_SPACING, clear_m)
        observation = [
            Observation.of(points, Semantics.SURFACE),
            Observation.of(torch.cat((*clear, free.points)), Semantics.FREE),
        ]
        instants = [instant, *clear_at, free.instant]
        if self._mapping.scene.looks_again:
            observation.append(self._views.between(begin_ns, end_ns, last=True))
            instants.append(torch.full((len(observation[-1]),), count - 1))
        taken = self._taken(concatenate(observation), torch.cat(instants), pose, in_contact, end_ns, motion)
        taken = replace(taken, reading=replace(taken.reading, measurements=_last_measurements(mine, at, count)))
        if not (self._mapping.touches_count or self._mapping.signals_count):
            return taken
        signals: Tensor | None = None
        if self._mapping.signals_count:
            signals = torch.zeros(count, dtype=torch.bool)
            signals[[k for one, k in zip(mine, at, strict=True) if one.signal]] = True
        return replace(
            taken, reading=replace(ContactReading.of(taken.reading), wrench=self._touches(mine, at), signals=signals)
        )

    def _touches(self, mine: Sequence[ContactSample], at: Sequence[int]) -> WrenchTouch:
        """The touches of a reading that count with their normals."""
        found = [replace(one.touch, instant=torch.tensor([k])) for one, k in zip(mine, at, strict=True) if one.touch]
        if not found:
            return WrenchTouch.none()
        config = self._mapping.wrench
        assert config is not None
        every = WrenchTouch(*(torch.cat([getattr(one, part.name) for one in found]) for part in fields(WrenchTouch)))
        return every.at(surest(every.point_sd.square(), config.most))

    def _motion(self, stamps_ns: Int[Tensor, "K"]) -> Float[Tensor, "K 4 4"] | None:
        """How far the object had moved at some times since the reading before; None where nothing measures it."""
        frame = self._mapping.frames.motion
        if frame is None:
            return None
        pose, known = self._frames.at(frame, stamps_ns)
        if not bool(known.all()):
            raise _UnknownPoseError(f"the pose of {frame}, which rides with the object,")
        before = pose[0] if self._ridden is None else self._ridden
        self._ridden = pose[-1]
        return (pose @ se3.inverse(before)).float()

    def _truth(self, stamp_ns: int) -> Float[Tensor, "4 4"] | None:
        """The object's pose by another system; None where nobody measured it."""
        if self._mapping.frames.truth is None:
            return None
        pose, known = self._frames.at(self._mapping.frames.truth, [stamp_ns])
        return pose[0].float() if bool(known.all()) else None

    def _taken(
        self,
        observation: Observation,
        instant: Int[Tensor, "M"],
        pose: Float[Tensor, "K 4 4"],
        in_contact: Bool[Tensor, "K"],
        stamp_ns: int,
        motion: Float[Tensor, "K 4 4"] | None,
    ) -> Taken:
        x, y, z = pose[-1, :3, 3].tolist()
        yaw = math.atan2(float(pose[-1, 1, 0]), float(pose[-1, 0, 0]))
        place = (x, y, yaw) if self._mapping.scene.search == "SE(2)" else (x, y, z, yaw)
        stamp = (stamp_ns - self._start) / 1e9
        reading = Reading(observation, instant, pose, in_contact, motion, torch.tensor(place), torch.zeros(()), stamp)
        return Taken(reading, None, self._truth(stamp_ns), None)


def _last_measurements(
    samples: Sequence[ContactSample], at: Sequence[int], instants: int
) -> dict[str, Float[Tensor, "K ..."]]:
    """The last numbers of each further sensor up to each instant of a reading, of forces the mean; NaN of none."""
    found: dict[str, Tensor] = {}
    counts = torch.zeros(instants, 1)
    for sample, instant in zip(samples, at, strict=True):
        for name, values in sample.measurements.items():
            rows = found.setdefault(name, values.new_full((instants, len(values)), math.nan))
            if name == FORCE:
                counts[instant] += 1.0
                old = rows[instant].nan_to_num()
                values = old + (values - old) / counts[instant]
            rows[instant] = values
    return found
