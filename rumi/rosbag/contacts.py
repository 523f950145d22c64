"""Contact samples of all touch sensors of a recording: points, contact flags, bubbles, wrenches, joint torques."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rumi.errors import UsageError
from rumi.rosbag.bubbles import bubble_contacts
from rumi.rosbag.contact_sample import ContactSample, ContactSamples, no_points, report_unknown_poses
from rumi.rosbag.frames import FrameTree
from rumi.rosbag.mapping import BagMap
from rumi.rosbag.span import Span
from rumi.rosbag.streams import role_of
from rumi.rosbag.torques import torque_contacts
from sdf import se3
from sensors.contact_reading import WrenchTouch
from sensors.force.force_torque import WrenchNoise, WrenchSettings, WrenchStatus, wrench_contact
from sensors.force.tool_load import ToolLoad
from sensors.log.reader import Log, Sample, Stream
from sensors.reading import FORCE

_WAY_S = 0.05  # over which a tool's way is looked at


def contact_samples(log: Log, mapping: BagMap, frames: FrameTree, span: Span) -> ContactSamples:
    """Contact samples of all streams with the roles felt, contact, bubble, wrench, torques and sensor.

    Args:
        log: with raw streams.
        mapping: what they mean.
        frames: where they were.
        span: what is used of the recording.

    Raises:
        UsageError: what is needed to read one is missing.
    """
    found = ContactSamples()
    for stream in log.streams.values():
        role = role_of(stream, mapping)
        if role == "felt":
            mine = _point_contacts(stream, frames, span, found.problems)
        elif role == "contact":
            mine = [
                ContactSample(one.stamp_ns, no_points(), bool((one.values["touched"] != 0).any()))  # type: ignore[union-attr]
                for one in stream.samples(span.start_ns, span.read_ns)
            ]
        elif role == "bubble":
            mine = bubble_contacts(log, stream, mapping, frames, span, found)
        elif role == "wrench":
            if mapping.wrench is None:
                raise UsageError(f"Expected a table [wrench] in the mapping for {stream.name}, found none")
            mine = _wrench_contacts(stream, mapping, frames, span, found.wrenches, found.problems)
        elif role == "torques":
            mine = torque_contacts(stream, mapping, span, found)
        elif role == "sensor":
            mine = _measurements(stream, span, found.problems)
        else:
            continue
        found.samples += mine
        found.any |= len(stream) > 0
        found.problems += stream.problems
    found.samples.sort(key=lambda one: one.stamp_ns)
    return found


def _point_contacts(stream: Stream, frames: FrameTree, span: Span, problems: list[str]) -> list[ContactSample]:
    samples = stream.samples(span.start_ns, span.read_ns)
    pose, known = frames.at(stream.frame, [one.stamp_ns for one in samples])
    found = []
    for one, world_T_frame, there in zip(samples, pose.float(), known.tolist(), strict=True):
        if there:
            points = torch.tensor(one.values["points"]).reshape(-1, 3)
            points = se3.apply(world_T_frame, points[torch.isfinite(points).all(-1)])
            found.append(ContactSample(one.stamp_ns, points, len(points) > 0))
    report_unknown_poses(stream, known, problems)
    return found


def _measurements(stream: Stream, span: Span, problems: list[str]) -> list[ContactSample]:
    """Numbers of a further sensor, which its own evidence reads."""
    name = str(stream.about["sensor"])
    rows = [(one.stamp_ns, torch.tensor(one.values["numbers"])) for one in stream.samples(span.start_ns, span.read_ns)]
    same = [(stamp, row) for stamp, row in rows if len(row) == len(rows[0][1])]
    if lost := len(rows) - len(same):
        problems.append(f"stream {stream.name}: {lost} of {len(rows)} rows are not of as many numbers as the first one")
    return [ContactSample(stamp, no_points(), False, measurements={name: row.float()}) for stamp, row in same]


def _wrench_contacts(
    stream: Stream,
    mapping: BagMap,
    frames: FrameTree,
    span: Span,
    counted: dict[str, int],
    problems: list[str],
) -> list[ContactSample]:
    """Contact samples of a stream of wrenches; an impossible wrench is a touch of unknown place."""
    config = mapping.wrench
    assert config is not None
    every = stream.samples(span.start_ns, span.read_ns)
    samples = [one for one in every if bool(torch.isfinite(wrench_of(one)).all())]
    if lost := len(every) - len(samples):
        problems.append(f"stream {stream.name}: {lost} of {len(every)} wrenches are no numbers, and left out")
    if not samples:
        return []
    pose, known = frames.at(stream.frame, [one.stamp_ns for one in samples])
    report_unknown_poses(stream, known, problems)
    samples = [one for one, there in zip(samples, known.tolist(), strict=True) if there]
    pose = pose[known]
    wrench = torch.stack([wrench_of(one) for one in samples]) if samples else torch.zeros(0, 6, dtype=torch.float64)
    wrench = -wrench if config.reaction else wrench
    load = _load(stream, mapping, frames, wrench, pose, samples, span.start_ns, problems)
    wrench = smoothed(wrench, torch.tensor([one.stamp_ns for one in samples]), config.smooth_s)
    left = load.contact_wrench(wrench, pose[:, :3, :3])
    noise = WrenchNoise(config.force_n, config.moment_nm).covariance()
    settings = WrenchSettings(least_force_n=config.least_force_n, friction=config.friction)
    contact = wrench_contact(left, config.tool(), noise, settings)
    forces = (pose[:, :3, :3].double() @ left[:, :3, None].double())[..., 0].float()  # on the tool, world axes
    for name in WrenchStatus:
        counted[name.name.lower()] = counted.get(name.name.lower(), 0) + int((contact.status == int(name)).sum())
    if config.level:
        return _level_contacts(samples, forces, contact.status != int(WrenchStatus.NONE), mapping, frames)
    kept = (contact.status == int(WrenchStatus.CONTACT)).nonzero()[:, 0]
    possible = (contact.status <= int(WrenchStatus.CONTACT)).tolist()
    touches, place = WrenchTouch.of(contact, pose, kept), {k: n for n, k in enumerate(kept.tolist())}

    def sample(k: int, stamp_ns: int, touched: bool) -> ContactSample:
        # of a wrench that no single touch of the tool explains nobody knows what it is the force of
        measured = {FORCE: forces[k]} if possible[k] else {}
        if k not in place:
            return ContactSample(stamp_ns, no_points(), touched, measurements=measured)
        touch = touches.at(torch.tensor([place[k]]))
        likely = touch if config.likelihood else None
        return ContactSample(stamp_ns, touch.points, touched, touch=likely, measurements=measured)

    return [
        sample(k, one.stamp_ns, status != int(WrenchStatus.NONE))
        for k, (one, status) in enumerate(zip(samples, contact.status.tolist(), strict=True))
    ]


def _level_contacts(
    samples: Sequence[Sample],
    forces: Float[Tensor, "K 3"],
    touched: Bool[Tensor, "K"],
    mapping: BagMap,
    frames: FrameTree,
) -> list[ContactSample]:
    """Contact samples of an upright rod at the height of the tool's frame; those of which that is unknown are none.

    What is pushed resists: a force along the rod's way is of the rod itself, as it brakes.
    """
    assert mapping.wrench is not None and mapping.wrench.radius_m is not None
    stamps = torch.tensor([one.stamp_ns for one in samples], dtype=torch.long)
    tool, known = frames.at(mapping.frames.tool, stamps)
    half = round(0.5e9 * max(mapping.wrench.smooth_s, _WAY_S))
    (begin, begun), (end, ended) = (frames.at(mapping.frames.tool, stamps + off) for off in (-half, half))
    way = torch.where((begun & ended)[:, None], end[:, :2, 3] - begin[:, :2, 3], 0.0).float()
    touched = touched & ((way * forces[:, :2]).sum(-1) <= 0.0)
    beside = torch.nn.functional.pad(forces[:, :2], (0, 1))
    points = tool[:, :3, 3].float() - mapping.wrench.radius_m * torch.nn.functional.normalize(beside, dim=-1)
    return [
        ContactSample(one.stamp_ns, point[None] if felt else no_points(), felt, measurements={FORCE: force})
        for one, point, felt, force, there in zip(
            samples, points, touched.tolist(), forces, known.tolist(), strict=True
        )
        if there
    ]


def smoothed(wrench: Float[Tensor, "K 6"], stamps_ns: Int[Tensor, "K"], seconds: float) -> Float[Tensor, "K 6"]:
    """Means of the wrenches within half of some time of each; rising stamps."""
    if not seconds > 0 or not len(wrench):
        return wrench
    half = round(0.5e9 * seconds)
    first = torch.searchsorted(stamps_ns, stamps_ns - half)
    behind = torch.searchsorted(stamps_ns, stamps_ns + half, right=True)
    total = torch.cat((torch.zeros_like(wrench[:1]), wrench.cumsum(0)))
    return (total[behind] - total[first]) / (behind - first)[:, None]


def _load(
    stream: Stream,
    mapping: BagMap,
    frames: FrameTree,
    wrench: Tensor,
    pose: Tensor,
    samples: Sequence[Sample],
    start: int,
    problems: list[str],
) -> ToolLoad:
    """Payload of the sensor, and its bias: by the first wrenches and those high up, where the mapping says so."""
    config = mapping.wrench
    assert config is not None
    numbers = [
        torch.tensor(value, dtype=torch.float64) for value in (config.bias, config.mass_kg, config.mass_center_m)
    ]
    load = ToolLoad(*numbers)
    high = _high(samples, mapping, frames)
    free = wrench[high] - load.weight(pose[high, :3, :3].to(wrench))
    lifted = free.median(0).values if len(free) else None  # a tool that starts or brakes feels more than its weight
    if config.tare_s <= 0 or not samples:
        return load if lifted is None else replace(load, bias=lifted)
    late = samples[0].stamp_ns - start
    if late > config.tare_s * 1e9:
        problems.append(
            f"stream {stream.name}: begins {late / 1e9:.1f} s after the start; its bias is taken from its own first "
            f"{config.tare_s:g} s, in which nothing may touch"
        )
        start = samples[0].stamp_ns
    early = torch.tensor([one.stamp_ns <= start + config.tare_s * 1e9 for one in samples], dtype=torch.bool)
    first = load.tared(wrench[early], pose[early, :3, :3])
    return first if lifted is None else replace(load, bias=0.5 * (first.bias + lifted))


def _high(samples: Sequence[Sample], mapping: BagMap, frames: FrameTree) -> Bool[Tensor, "K"]:
    """At which samples the tool is known to be too high for a touch."""
    config = mapping.wrench
    if config is None or config.tare_above_m is None:
        return torch.zeros(len(samples), dtype=torch.bool)
    tool, known = frames.at(mapping.frames.tool, torch.tensor([one.stamp_ns for one in samples], dtype=torch.long))
    return known & (tool[:, 2, 3] > config.tare_above_m)


def wrench_of(sample: Sample) -> Float[Tensor, "6"]:
    """Force and moment of a sample of a stream of wrenches, N and N m."""
    return torch.cat([torch.tensor(sample.values[name]) for name in ("force", "torque")])
