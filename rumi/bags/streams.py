"""What a log's streams are to a mapping: their roles, and the cameras that took their pictures."""

from collections.abc import Mapping
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.bags.mapping import BagMap
from rumi.errors import UsageError
from sensors.log.reader import Log, Stream


class Lens(NamedTuple):
    """A camera's intrinsics.

    Attributes:
        intrinsics: (3, 3).
        distortion: OpenCV's coefficients.
    """

    intrinsics: Float[Tensor, "3 3"]
    distortion: tuple[float, ...]


def role_of(stream: Stream, mapping: BagMap) -> str:
    """What a stream is used as: what the mapping says, else what it was imported as."""
    topic = str(stream.about.get("topic", stream.name))
    told = mapping.topics.get(topic)
    return str(stream.about.get("role", "")) if told is None else told.role


def lenses_of(log: Log, mapping: BagMap) -> dict[str, Lens]:
    """By stream, the first CameraInfo of each that has the role camera."""
    found = {}
    for stream in log.streams.values():
        if role_of(stream, mapping) == "camera" and (samples := stream.samples()):
            values = samples[0].values
            intrinsics, distortion = values["intrinsics"], values["distortion"]
            assert intrinsics is not None and distortion is not None
            found[stream.name] = Lens(torch.tensor(intrinsics).float(), tuple(float(k) for k in distortion))
    return found


def lens_of(stream: Stream, lenses: Mapping[str, Lens]) -> Lens:
    """That took a stream's depth images.

    Raises:
        UsageError: it is not known.
    """
    name = str(stream.about.get("camera", ""))
    if name not in lenses:
        listed = ", ".join(lenses) or "none"
        raise UsageError(
            f"Expected the intrinsics of {stream.name}: name its CameraInfo topic as `camera` in the mapping, and "
            f"give that topic the role camera; the log has those of {listed}"
        )
    return lenses[name]


def unit_of(stream: Stream) -> float:
    """Metres of one unit of a depth stream."""
    return float(stream.about.get("unit_m", 0.001)) if stream.kind == "depth16" else 1.0
