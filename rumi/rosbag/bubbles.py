"""Contact samples of soft bubbles in a recording."""

from collections.abc import Iterator

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rumi.errors import UsageError
from rumi.rosbag.contact_sample import ContactSample, ContactSamples, report_unknown_poses
from rumi.rosbag.frames import FrameTree
from rumi.rosbag.mapping import BagMap
from rumi.rosbag.span import Span
from rumi.rosbag.streams import Lens, lens_of, lenses_of, unit_of
from sdf import se3
from sensors.log.reader import Log, Sample, Stream
from sensors.semantics import Semantics
from sensors.touch.bubble import Bubble, bubble_patch
from sensors.vision.images import depth_metres, known, undistorted

_PART_NS = 10**9  # of a recording that is read at once


def bubble_contacts(
    log: Log, stream: Stream, mapping: BagMap, frames: FrameTree, span: Span, found: ContactSamples
) -> list[ContactSample]:
    """Patches and free membrane of a stream of depth images from inside a bubble, whose frame is its camera's.

    Raises:
        UsageError: the camera's intrinsics are not known, or no picture of the membrane at rest is in the first view.
    """
    if len(stream) == 0:
        return []
    late_ns, settings = round(mapping.bubble.late_s * 1e9), mapping.bubble.settings()
    lens = lens_of(stream, lenses_of(log, mapping), mapping)
    rest = _at_rest(stream, lens, span.start_ns, span.start_ns + round(mapping.actions.view_s * 1e9))
    # poses are asked for the camera itself, so that it is its own tool
    bubble = Bubble.of(rest, lens.intrinsics, se3.identity(), unit="m")
    contacts: list[ContactSample] = []
    where: list[Bool[Tensor, "k"]] = []
    for samples in _parts(stream, span.start_ns, span.read_ns + max(0, late_ns)):
        stamps = [one.stamp_ns - late_ns for one in samples]
        pose, there = frames.at(stream.frame, stamps)
        where.append(there)
        for one, stamp, world_T_camera, sure in zip(samples, stamps, pose.float(), there.tolist(), strict=True):
            if not sure:
                continue
            try:
                patch = bubble_patch(bubble, _metres(stream, one, lens), world_T_camera, settings)
            except ValueError as error:
                found.problems.append(f"stream {stream.name}: a picture is left out: {error}")
                continue
            surface, free = (patch.observation.of_class(kind) for kind in (Semantics.SURFACE, Semantics.FREE))
            points = patch.observation.points
            contacts.append(ContactSample(stamp, points[surface], bool(patch.contact.any()), points[free]))
    report_unknown_poses(stream, torch.cat([torch.zeros(0, dtype=torch.bool), *where]), found.problems)
    touched = sum(one.touched for one in contacts)
    found.notes.append(f"bubble {stream.name}: {touched} of {len(contacts)} pictures show a touch")
    return contacts


def _at_rest(stream: Stream, lens: Lens, begin: int, end: int) -> Float[Tensor, "H W"]:
    """Mean of the pictures in a span, pixel by pixel where most of them show the membrane."""
    images = [_metres(stream, one, lens) for one in stream.samples(begin, end)]
    if not images or len({image.shape for image in images}) > 1:
        what = "none" if not images else "some of different sizes"
        raise UsageError(
            f"Expected pictures of {stream.name} at rest in the first view, the first {(end - begin) / 1e9:g} s, got "
            f"{what}: let nothing touch the bubble then, or set actions.view_s"
        )
    stack = torch.stack(images)
    seen = torch.stack([known(image) for image in images])
    mean = stack.masked_fill(~seen, 0.0).sum(0) / seen.sum(0).clamp_min(1)
    return torch.where(2 * seen.sum(0) > len(images), mean, torch.zeros_like(mean))


def _metres(stream: Stream, sample: Sample, lens: Lens) -> Float[Tensor, "H W"]:
    depth = depth_metres(np.asarray(sample.values["depth"]), unit_of(stream))
    return undistorted(depth, lens.intrinsics, lens.distortion)


def _parts(stream: Stream, begin: int, end: int) -> Iterator[list[Sample]]:
    """All samples of a span, some at a time: pictures take memory."""
    stamps = np.sort(stream.stamps_ns())
    stamps = stamps[(stamps >= begin) & (stamps <= end)]
    at = 0
    while at < len(stamps):
        after = int(np.searchsorted(stamps, stamps[at] + _PART_NS))
        yield stream.samples(int(stamps[at]), int(stamps[after - 1]))
        at = after
