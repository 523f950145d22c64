"""Roles and cameras of a log's streams by a mapping."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.errors import UsageError
from rumi.rosbag.mapping import BagMap, Topic
from sensors.log.reader import Log, Stream


class Lens(NamedTuple):
    """A camera's intrinsics.

    Attributes:
        intrinsics: (3, 3).
        distortion: OpenCV's coefficients.
        model: of the distortion, as its driver names it.
        rectified: (3, 3), the intrinsics of its pictures once the distortion is taken out of them.
    """

    intrinsics: Float[Tensor, "3 3"]
    distortion: tuple[float, ...]
    model: str = ""
    rectified: Float[Tensor, "3 3"] | None = None

    @property
    def straight(self) -> "Lens":
        """Of pictures whose distortion has been taken out."""
        return Lens(self.intrinsics if self.rectified is None else self.rectified, ())


MODELS = ("", "plumb_bob", "rational_polynomial")
"""Of distortion, whose coefficients are OpenCV's."""


def _topic_of(stream: Stream, mapping: BagMap) -> Topic | None:
    return mapping.topic(str(stream.about.get("topic", stream.name)))


def role_of(stream: Stream, mapping: BagMap) -> str:
    """Role of a stream: the mapping's, else the one that it was imported with."""
    config = _topic_of(stream, mapping)
    return str(stream.about.get("role", "")) if config is None else config.role


def lenses_of(log: Log, mapping: BagMap) -> dict[str, Lens]:
    """By stream, the first CameraInfo of each that has the role camera."""
    found = {}
    for stream in log.streams.values():
        if role_of(stream, mapping) == "camera" and (samples := stream.samples()):
            values = samples[0].values
            intrinsics, distortion = values["intrinsics"], values["distortion"]
            assert intrinsics is not None and distortion is not None
            projection = torch.tensor(stream.about.get("projection", [])).float()
            known = projection.shape == (12,) and float(projection[0]) > 0
            found[stream.name] = Lens(
                torch.tensor(intrinsics).float(),
                tuple(float(k) for k in distortion),
                str(stream.about.get("distortion_model", "")),
                projection.reshape(3, 4)[:, :3] if known else None,
            )
    return found


def lens_of(stream: Stream, lenses: Mapping[str, Lens], mapping: BagMap) -> Lens:
    """That took a stream's depth images.

    Raises:
        UsageError: it is not known, or its distortion is of an unknown model.
    """
    config = _topic_of(stream, mapping)
    name = str(stream.about.get("camera", "")) if config is None or config.camera is None else config.camera.strip("/")
    if name not in lenses:
        listed = ", ".join(lenses) or "none"
        raise UsageError(
            f"Expected the intrinsics of {stream.name}: name its CameraInfo topic as `camera` in the mapping, and "
            f"give that topic the role camera; the log has those of {listed}"
        )
    lens = lenses[name]
    if lens.intrinsics[0, 0] <= 0 or lens.intrinsics[1, 1] <= 0:
        raise UsageError(f"Expected focal lengths above 0 in {name}, got {lens.intrinsics.tolist()}: calibrate it")
    if config.rectified if config is not None else stream.about.get("rectified", False):
        return lens.straight
    if any(lens.distortion) and lens.model not in MODELS:
        raise UsageError(
            f"Expected the distortion of {name} to be of a model {' or '.join(MODELS[1:])}, got {lens.model}: "
            f"rectify the pictures of {stream.name}, and say rectified = true of its topic in the mapping"
        )
    return lens


def color_of(stream: Stream, colors: Sequence[Stream], mapping: BagMap) -> Stream | None:
    """The colour images of a stream's pixels: those that the mapping names, those in its frame, or the only ones.

    Raises:
        UsageError: there are several, or not those that are named.
    """
    config = _topic_of(stream, mapping)
    if config is not None and config.color is not None:
        named = [one for one in colors if str(one.about.get("topic", one.name)).strip("/") == config.color.strip("/")]
        if not named:
            listed = ", ".join(one.name for one in colors) or "none"
            raise UsageError(
                f"Expected {config.color}, the colours of {stream.name}, to have the role color; got {listed}"
            )
        return named[0]
    near = [one for one in colors if one.frame == stream.frame] or list(colors)
    if len(near) > 1:
        raise UsageError(
            f"Expected to know which colours are of {stream.name}: {', '.join(one.name for one in near)} all could be; "
            "name one as `color` of its topic in the mapping"
        )
    return near[0] if near else None


def unit_of(stream: Stream) -> float:
    """Metres of one unit of a depth stream."""
    return float(stream.about.get("unit_m", 0.001)) if stream.kind == "depth16" else 1.0
