"""Contact samples of a recording: the type that every touch sensor's reader returns."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sensors.contact_reading import WrenchTouch
from sensors.log.reader import Stream


def no_points() -> Tensor:
    """(0, 3)."""
    return torch.zeros(0, 3)


@dataclass(frozen=True)
class ContactSample:
    """One contact measurement at one time.

    Attributes:
        stamp_ns: when.
        points: (n, 3), of the object's surface, world; none where only the fact of a touch is known.
        touched: whether it was.
        free: (m, 3), points without contact, world.
        touch: the same with a normal, by how sure both are, where that counts.
        signal: whether it is a signal of joint torques that counts.
        measurements: (n), of a further sensor by its name.
    """

    stamp_ns: int
    points: Float[Tensor, "n 3"]
    touched: bool
    free: Float[Tensor, "m 3"] = field(default_factory=no_points)
    touch: WrenchTouch | None = None
    signal: bool = False
    measurements: Mapping[str, Float[Tensor, "..."]] = field(default_factory=dict)


@dataclass
class ContactSamples:
    """All contact samples of a recording.

    Attributes:
        samples: by time.
        wrenches: how many wrenches were taken for what.
        notes: what else was found in the streams.
        problems: what could not be used.
        any: whether there was a touch sensor at all.
    """

    samples: list[ContactSample] = field(default_factory=list)
    wrenches: dict[str, int] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    any: bool = False


def report_unknown_poses(stream: Stream, known: Bool[Tensor, "K"], problems: list[str]) -> None:
    """Add to the problems how often the pose of a sensor is unknown."""
    lost = int((~known).sum())
    if lost:
        problems.append(
            f"stream {stream.name}: the pose of {stream.frame!r} is not known for {lost} of {len(known)} rows"
        )
