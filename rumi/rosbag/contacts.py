"""What touch sensed in a recording, at which times: felt points, contact flags and wrenches."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rumi.errors import UsageError
from rumi.rosbag.frames import FrameTree
from rumi.rosbag.mapping import BagMap
from rumi.rosbag.sensor_maps import WrenchMap
from rumi.rosbag.span import Span
from rumi.rosbag.streams import role_of
from sdf import se3
from sensors.contact_reading import WrenchTouch
from sensors.force.force_torque import WrenchContact, WrenchNoise, WrenchSettings, WrenchStatus, wrench_contact
from sensors.force.tool_load import ToolLoad
from sensors.log.reader import Log, Sample, Stream


def _none() -> Tensor:
    return torch.zeros(0, 3)


@dataclass(frozen=True)
class Felt:
    """What was felt at one time.

    Attributes:
        stamp_ns: when.
        points: (n, 3), of the object's surface, world; none where it is only known that it was touched.
        touched: whether it was.
        free: (m, 3), where nothing was felt, world.
        touch: the same with a normal, by how sure both are, where that counts.
        signal: whether it is a signal of joint torques that counts.
    """

    stamp_ns: int
    points: Float[Tensor, "n 3"]
    touched: bool
    free: Float[Tensor, "m 3"] = field(default_factory=_none)
    touch: WrenchTouch | None = None
    signal: bool = False


@dataclass
class AllFelt:
    """What was felt in a recording.

    Attributes:
        felt: by time.
        wrenches: how many wrenches were taken for what.
        notes: what else was found in the streams.
        problems: what could not be used.
        any: whether there was a sensor that may feel.
    """

    felt: list[Felt] = field(default_factory=list)
    wrenches: dict[str, int] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    any: bool = False


def all_felt(log: Log, mapping: BagMap, frames: FrameTree, span: Span) -> AllFelt:
    """Of all streams with the roles felt, contact, bubble, wrench and torques.

    Args:
        log: with raw streams.
        mapping: what they mean.
        frames: where they were.
        span: what is used of the recording.

    Raises:
        UsageError: what is needed to read one is missing.
    """
    from rumi.rosbag.bubbles import bubbles_felt
    from rumi.rosbag.torques import torques_felt

    found = AllFelt()
    for stream in log.streams.values():
        role = role_of(stream, mapping)
        if role == "felt":
            mine = _points_felt(stream, frames, span, found.problems)
        elif role == "contact":
            mine = [
                Felt(one.stamp_ns, _none(), bool((one.values["touched"] != 0).any()))  # type: ignore[union-attr]
                for one in stream.samples(span.start_ns, span.read_ns)
            ]
        elif role == "bubble":
            mine = bubbles_felt(log, stream, mapping, frames, span, found)
        elif role == "wrench":
            if mapping.wrench is None:
                raise UsageError(f"Expected a table [wrench] in the mapping for {stream.name}, found none")
            mine = _wrenches_felt(stream, mapping, frames, span, found.wrenches, found.problems)
        elif role == "torques":
            mine = torques_felt(stream, mapping, span, found)
        else:
            continue
        found.felt += mine
        found.any |= len(stream) > 0
        found.problems += stream.problems
    found.felt.sort(key=lambda one: one.stamp_ns)
    return found


def _points_felt(stream: Stream, frames: FrameTree, span: Span, problems: list[str]) -> list[Felt]:
    samples = stream.samples(span.start_ns, span.read_ns)
    pose, known = frames.at(stream.frame, [one.stamp_ns for one in samples])
    found = []
    for one, world_T_frame, there in zip(samples, pose.float(), known.tolist(), strict=True):
        if there:
            points = torch.tensor(one.values["points"]).reshape(-1, 3)
            points = se3.apply(world_T_frame, points[torch.isfinite(points).all(-1)])
            found.append(Felt(one.stamp_ns, points, len(points) > 0))
    tell_unknown(stream, known, problems)
    return found


def _wrenches_felt(
    stream: Stream,
    mapping: BagMap,
    frames: FrameTree,
    span: Span,
    counted: dict[str, int],
    problems: list[str],
) -> list[Felt]:
    """Touches of the wrenches of a stream; impossible wrenches are touches that nobody knows the place of."""
    told = mapping.wrench
    assert told is not None
    every = stream.samples(span.start_ns, span.read_ns)
    samples = [one for one in every if bool(torch.isfinite(_wrench_of(one)).all())]
    if lost := len(every) - len(samples):
        problems.append(f"stream {stream.name}: {lost} of {len(every)} wrenches are no numbers, and left out")
    if not samples:
        return []
    pose, known = frames.at(stream.frame, [one.stamp_ns for one in samples])
    tell_unknown(stream, known, problems)
    samples = [one for one, there in zip(samples, known.tolist(), strict=True) if there]
    pose = pose[known]
    wrench = torch.stack([_wrench_of(one) for one in samples]) if samples else torch.zeros(0, 6, dtype=torch.float64)
    load = _load(stream, told, wrench, pose, samples, span.start_ns, problems)
    contact = read_wrenches(wrench, pose, load, mapping)
    for name in WrenchStatus:
        counted[name.name.lower()] = counted.get(name.name.lower(), 0) + int((contact.status == int(name)).sum())
    kept = (contact.status == int(WrenchStatus.CONTACT)).nonzero()[:, 0]
    touches, place = WrenchTouch.of(contact, pose, kept), {k: n for n, k in enumerate(kept.tolist())}

    def felt(k: int, stamp_ns: int, touched: bool) -> Felt:
        if k not in place:
            return Felt(stamp_ns, _none(), touched)
        touch = touches.at(torch.tensor([place[k]]))
        return Felt(stamp_ns, touch.points, touched, touch=touch if told.likelihood else None)

    return [
        felt(k, one.stamp_ns, status != int(WrenchStatus.NONE))
        for k, (one, status) in enumerate(zip(samples, contact.status.tolist(), strict=True))
    ]


def read_wrenches(
    wrench: Float[Tensor, "K 6"], world_T_sensor: Float[Tensor, "K 4 4"], load: ToolLoad, mapping: BagMap
) -> WrenchContact:
    """Where a mapping's tool was touched; wrenches as recorded."""
    told = mapping.wrench
    assert told is not None
    signed = -wrench if told.reaction else wrench
    left = load.contact_wrench(signed, world_T_sensor[:, :3, :3])
    noise = WrenchNoise(told.force_n, told.moment_nm)
    settings = WrenchSettings(least_force_n=told.least_force_n, friction=told.friction)
    return wrench_contact(left, told.tool(), noise.covariance(), settings)


def _load(
    stream: Stream,
    told: WrenchMap,
    wrench: Tensor,
    pose: Tensor,
    samples: Sequence[Sample],
    start: int,
    problems: list[str],
) -> ToolLoad:
    """What hangs from the sensor, and its bias: by the first wrenches, where the mapping says so."""
    numbers = [torch.tensor(value, dtype=torch.float64) for value in (told.bias, told.mass_kg, told.mass_center_m)]
    load = ToolLoad(*numbers)
    if told.tare_s <= 0 or not samples:
        return load
    late = samples[0].stamp_ns - start
    if late > told.tare_s * 1e9:
        problems.append(
            f"stream {stream.name}: begins {late / 1e9:.1f} s after the start; its bias is taken from its own first "
            f"{told.tare_s:g} s, in which nothing may touch"
        )
        start = samples[0].stamp_ns
    early = torch.tensor([one.stamp_ns <= start + told.tare_s * 1e9 for one in samples], dtype=torch.bool)
    signed = -wrench if told.reaction else wrench
    return load.tared(signed[early], pose[early, :3, :3])


def _wrench_of(sample: Sample) -> Float[Tensor, "6"]:
    return torch.cat([torch.tensor(sample.values[name]) for name in ("force", "torque")])


def tell_unknown(stream: Stream, known: Bool[Tensor, "K"], problems: list[str]) -> None:
    """Add to the problems how often nobody knows where a sensor was."""
    lost = int((~known).sum())
    if lost:
        problems.append(
            f"stream {stream.name}: the pose of {stream.frame!r} is not known for {lost} of {len(known)} rows"
        )
