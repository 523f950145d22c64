"""From a log's raw streams to the readings that a belief takes in, by a mapping file."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rumi.bags.frames import FrameTree
from rumi.bags.mapping import BagMap, WrenchMap
from rumi.bags.views import Views
from rumi.errors import UsageError
from rumi.planning.gripper import GripperShape
from rumi.seeding import generator
from sdf import se3
from sensors.force_evidence import wrench_observation
from sensors.force_torque import WrenchContact, WrenchNoise, WrenchSettings, WrenchStatus, wrench_contact
from sensors.log.reader import Log, Sample, Stream, Taken
from sensors.observation import Observation, concatenate
from sensors.reading import Reading
from sensors.semantics import Semantics
from sensors.tactile import InstantPoints, swept_points
from sensors.tool_load import ToolLoad
from sensors.tool_surface import SphereTool

_FREE_SPACING = 0.005  # metres, lattice on which free points are reported
_BODY_SPACING = 0.005  # metres between the tool's points


@dataclass(frozen=True)
class Made:
    """Readings of a recording.

    Attributes:
        taken: the first view first.
        problems: what could not be used.
        wrenches: how many wrenches were taken for what.
    """

    taken: list[Taken]
    problems: list[str]
    wrenches: dict[str, int]


@dataclass(frozen=True)
class _Felt:
    """What was felt at one time.

    Attributes:
        stamp_ns: when.
        points: (n, 3), of the object's surface, world; none where it is only known that it was touched.
        touched: whether it was.
    """

    stamp_ns: int
    points: Float[Tensor, "n 3"]
    touched: bool


def make_readings(log: Log, mapping: BagMap, *, seed: int = 0) -> Made:
    """Cut a recording into readings.

    The first one holds the view: surface points of the object, and free points about it. Each later one holds
    `actions.instants` poses of the tool over `actions.every_s`, what was felt meanwhile as surface points at their
    own instants, and the space that the tool's body swept as free points.

    Args:
        log: with raw streams.
        mapping: what they mean.
        seed: of the fit of the plane that the object stands on.

    Raises:
        UsageError: a stream or a frame that is needed is missing.
    """
    frames = FrameTree.of_log(log, mapping)
    start, end = _span(log, mapping)
    views = Views(log, mapping, frames, generator(seed))
    felt, wrenches, problems = _all_felt(log, mapping, frames, start)
    if not (views.any or felt):
        listed = ", ".join(sorted(f"{name} ({stream.kind})" for name, stream in log.streams.items())) or "none"
        raise UsageError(
            "Expected a stream with the role cloud, depth, felt, contact or wrench, found none that can be read; the "
            f"log's streams are {listed}"
        )
    first_ns = start + int(mapping.actions.view_s * 1e9)
    seen = views.between(start, first_ns)
    body = GripperShape(**asdict(mapping.tool)).solid(_BODY_SPACING).float()
    cutter = _Cutter(mapping, frames, views, felt, body, start)
    taken = [cutter.first(seen, first_ns)]
    every = int(mapping.actions.every_s * 1e9)
    for begin in range(first_ns, end - every // 2, every):
        reading = cutter.reading(begin, begin + every)
        if reading is None:
            at = (begin - start) / 1e9
            problems.append(
                f"{at:.1f} s to {at + every / 1e9:.1f} s: the tool's pose is not known throughout; left out"
            )
        else:
            taken.append(reading)
    return Made(taken, problems + views.problems, wrenches)


def role_of(stream: Stream, mapping: BagMap) -> str:
    """What a stream is used as: what the mapping says, else what it was imported as."""
    topic = str(stream.about.get("topic", stream.name))
    told = mapping.topics.get(topic)
    return str(stream.about.get("role", "")) if told is None else told.role


class _Cutter:
    """Makes one reading after the other."""

    def __init__(
        self,
        mapping: BagMap,
        frames: FrameTree,
        views: Views,
        felt: Sequence[_Felt],
        body: Float[Tensor, "n 3"],
        start: int,
    ) -> None:
        self._mapping, self._frames, self._views, self._felt, self._body = mapping, frames, views, felt, body
        self._start = start
        self._region = torch.tensor(mapping.scene.within)

    def first(self, seen: Observation, stamp_ns: int) -> Taken:
        pose, known = self._frames.at(self._mapping.frames.tool, [stamp_ns])
        if not bool(known.all()):
            raise UsageError(
                "Expected to know the tool's pose at the end of the first view, "
                f"{(stamp_ns - self._start) / 1e9:.1f} s from the start; the recording has none about then"
            )
        instant = torch.zeros(len(seen), dtype=torch.long)
        return self._taken(seen, instant, pose.float(), torch.zeros(1, dtype=torch.bool), stamp_ns)

    def reading(self, begin_ns: int, end_ns: int) -> Taken | None:
        count = self._mapping.actions.instants
        stamps = torch.linspace(begin_ns, end_ns, count + 1, dtype=torch.float64).long()[1:]
        pose, known = self._frames.at(self._mapping.frames.tool, stamps)
        if not bool(known.all()):
            return None
        pose = pose.float()
        mine = [one for one in self._felt if begin_ns < one.stamp_ns <= end_ns]
        at = [min(int(torch.searchsorted(stamps, one.stamp_ns)), count - 1) for one in mine]
        in_contact = torch.zeros(count, dtype=torch.bool)
        parts = [torch.zeros(0, 3)]
        where = [torch.zeros(0, dtype=torch.long)]
        for one, k in zip(mine, at, strict=True):
            in_contact[k] |= one.touched
            parts.append(one.points)
            where.append(torch.full((len(one.points),), k))
        points, instant = torch.cat(parts), torch.cat(where)
        free = self._swept(pose, in_contact, points, instant)
        observation = [Observation.of(points, Semantics.SURFACE), Observation.of(free.points, Semantics.FREE)]
        instants = [instant, free.instant]
        if self._mapping.scene.looks_again:
            observation.append(self._views.between(begin_ns, end_ns, last=True))
            instants.append(torch.full((len(observation[-1]),), count - 1))
        return self._taken(concatenate(observation), torch.cat(instants), pose, in_contact, end_ns)

    def _swept(
        self, pose: Float[Tensor, "K 4 4"], in_contact: Bool[Tensor, "K"], points: Tensor, instant: Tensor
    ) -> InstantPoints:
        """The space that the tool's body went through, but for what is near to where it touches."""
        # nothing moves while nothing is touched; what was swept while touching belongs to its instant alone
        group = in_contact.long().cumsum(0)
        swept, _ = swept_points(pose, self._body, _FREE_SPACING, group=group, region=self._region)
        keep = torch.ones(len(swept.points), dtype=torch.bool)
        for k in in_contact.nonzero()[:, 0].tolist():
            own, touched = (swept.instant == k).nonzero()[:, 0], points[instant == k]
            if len(touched) == 0:
                keep[own] = False  # touched, but nobody knows where
            elif len(own):
                keep[own] = torch.cdist(swept.points[own], touched).amin(-1) > self._mapping.scene.clear_m
        return InstantPoints(swept.points[keep], swept.instant[keep])

    def _taken(
        self,
        observation: Observation,
        instant: Int[Tensor, "M"],
        pose: Float[Tensor, "K 4 4"],
        in_contact: Bool[Tensor, "K"],
        stamp_ns: int,
    ) -> Taken:
        x, y, z = pose[-1, :3, 3].tolist()
        yaw = math.atan2(float(pose[-1, 1, 0]), float(pose[-1, 0, 0]))
        place = (x, y, yaw) if self._mapping.scene.search == "SE(2)" else (x, y, z, yaw)
        stamp = (stamp_ns - self._start) / 1e9
        reading = Reading(observation, instant, pose, in_contact, None, torch.tensor(place), torch.zeros(()), stamp)
        return Taken(reading, None, None, None)


def _span(log: Log, mapping: BagMap) -> tuple[int, int]:
    """First and last time, ns, at which anything but fixed frames was recorded."""
    recorded = [stream.stamps_ns() for stream in log.streams.values() if not stream.about.get("static")]
    stamps = [int(at) for each in recorded if len(each) for at in (each.min(), each.max())]
    if not stamps:
        raise UsageError(f"Expected {log.path} to hold raw streams with anything in them, found none")
    return min(stamps), max(stamps)


def _all_felt(
    log: Log, mapping: BagMap, frames: FrameTree, start: int
) -> tuple[list[_Felt], dict[str, int], list[str]]:
    found: list[_Felt] = []
    wrenches: dict[str, int] = {}
    problems: list[str] = []
    for stream in log.streams.values():
        role = role_of(stream, mapping)
        if role == "felt":
            found += _points_felt(stream, frames, problems)
        elif role == "contact":
            found += [
                _Felt(one.stamp_ns, torch.zeros(0, 3), bool((one.values["touched"] != 0).any()))  # type: ignore[union-attr]
                for one in stream.samples()
            ]
        elif role == "wrench":
            if mapping.wrench is None:
                raise UsageError(f"Expected a table [wrench] in the mapping for {stream.name}, found none")
            found += _wrenches_felt(stream, mapping, frames, start, wrenches, problems)
        problems += stream.problems
    return sorted(found, key=lambda one: one.stamp_ns), wrenches, problems


def _points_felt(stream: Stream, frames: FrameTree, problems: list[str]) -> list[_Felt]:
    samples = stream.samples()
    pose, known = frames.at(stream.frame, [one.stamp_ns for one in samples])
    found = []
    for one, world_T_frame, there in zip(samples, pose.float(), known.tolist(), strict=True):
        if there:
            points = torch.tensor(one.values["points"]).reshape(-1, 3)
            points = se3.apply(world_T_frame, points[torch.isfinite(points).all(-1)])
            found.append(_Felt(one.stamp_ns, points, len(points) > 0))
    _tell_unknown(stream, known, problems)
    return found


def _wrenches_felt(
    stream: Stream,
    mapping: BagMap,
    frames: FrameTree,
    start: int,
    counted: dict[str, int],
    problems: list[str],
) -> list[_Felt]:
    """Touches of the wrenches of a stream; impossible wrenches are touches that nobody knows the place of."""
    told = mapping.wrench
    assert told is not None
    samples = stream.samples()
    if not samples:
        return []
    pose, known = frames.at(stream.frame, [one.stamp_ns for one in samples])
    _tell_unknown(stream, known, problems)
    samples = [one for one, there in zip(samples, known.tolist(), strict=True) if there]
    pose = pose[known]
    wrench = torch.stack([_wrench_of(one) for one in samples]) if samples else torch.zeros(0, 6, dtype=torch.float64)
    contact = read_wrenches(wrench, pose, _load(told, wrench, pose, samples, start), mapping)
    for name in WrenchStatus:
        counted[name.name.lower()] = counted.get(name.name.lower(), 0) + int((contact.status == int(name)).sum())
    observation, index = wrench_observation(contact, pose)
    points = dict(zip(index.tolist(), observation.points.float(), strict=True))
    none = torch.zeros(0, 3)
    return [
        _Felt(one.stamp_ns, points[k][None] if k in points else none, status != int(WrenchStatus.NONE))
        for k, (one, status) in enumerate(zip(samples, contact.status.tolist(), strict=True))
    ]


def read_wrenches(
    wrench: Float[Tensor, "K 6"], world_T_sensor: Float[Tensor, "K 4 4"], load: ToolLoad, mapping: BagMap
) -> WrenchContact:
    """Where a mapping's ball was touched; wrenches as recorded."""
    told = mapping.wrench
    assert told is not None
    signed = -wrench if told.reaction else wrench
    left = load.contact_wrench(signed, world_T_sensor[:, :3, :3])
    noise = WrenchNoise(told.force_n, told.moment_nm)
    tool = SphereTool(torch.tensor(told.center_m), told.radius_m)
    settings = WrenchSettings(least_force_n=told.least_force_n, friction=told.friction)
    return wrench_contact(left, tool, noise.covariance(), settings)


def _load(told: WrenchMap, wrench: Tensor, pose: Tensor, samples: Sequence[Sample], start: int) -> ToolLoad:
    numbers = [torch.tensor(value, dtype=torch.float64) for value in (told.bias, told.mass_kg, told.mass_center_m)]
    load = ToolLoad(*numbers)
    early = torch.tensor([one.stamp_ns <= start + told.tare_s * 1e9 for one in samples], dtype=torch.bool)
    if told.tare_s > 0 and bool(early.any()):
        signed = -wrench if told.reaction else wrench
        load = load.tared(signed[early], pose[early, :3, :3])
    return load


def _wrench_of(sample: Sample) -> Float[Tensor, "6"]:
    return torch.cat([torch.tensor(sample.values[name]) for name in ("force", "torque")])


def _tell_unknown(stream: Stream, known: Bool[Tensor, "K"], problems: list[str]) -> None:
    lost = int((~known).sum())
    if lost:
        problems.append(
            f"stream {stream.name}: the pose of {stream.frame!r} is not known for {lost} of {len(known)} rows"
        )
