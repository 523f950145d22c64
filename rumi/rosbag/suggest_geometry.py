"""Geometry of a recording for a suggested mapping: the way of its tool, a rod on its force sensor, a tracked object."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from rumi.errors import UsageError
from rumi.rosbag.frames import Edge, FrameTree
from rumi.rosbag.messages import RowOf
from sdf import se3

_STILL_S = 0.3  # at the start, in which nothing touches
_STRONGEST = 0.2  # share of the forces that tell where they act
_FEWEST = 5  # of them
_NOISES = 5.0  # that they are above what is measured at the start
_BEYOND_M = 0.02  # that the rod goes beyond the middle of where they act
_NEAR_M = 0.02  # a tool's frame so near to the rod's end is at it
_MOVES_M = 0.01  # that a frame goes at least if it is said to move
_RIDES_M = 0.02  # by which a sensor that rides with the tool may seem to move, as stamps differ,
_RIDES = 0.95  # in this share of the poses
_LEAST_M = 0.01  # of a lever with a direction


@dataclass
class Geometry:
    """Poses of frames and wrenches of a recording, as they come.

    Attributes:
        parents: of each frame.
        wrenches: stamps and rows (force and moment) of each topic.
    """

    parents: dict[str, str] = field(default_factory=dict)
    wrenches: dict[str, list[tuple[int, np.ndarray]]] = field(default_factory=dict)
    _poses: dict[str, dict[int, Tensor]] = field(default_factory=dict)
    _static: set[str] = field(default_factory=set)

    def add(self, topic: str, rows: Iterable[RowOf], received_ns: int) -> None:
        """Add the rows of a message; what is wrong in one is left out."""
        try:
            for row in rows:
                stamp, about, values = row.stamp_ns or received_ns, row.stream.about, row.values
                if row.stream.kind == "wrench":
                    both = np.concatenate([np.asarray(values[name]) for name in ("force", "torque")])
                    self.wrenches.setdefault(topic, []).append((stamp, both))
                else:
                    child = str(about["child"])
                    self.parents[child] = str(about["parent"])
                    self._poses.setdefault(child, {})[stamp] = torch.as_tensor(values["pose"], dtype=torch.float64)
                    if about["static"]:
                        self._static.add(child)
        except (ValueError, TypeError, AttributeError):  # the import says what
            return

    def chain(self, frame: str) -> list[str]:
        """Frames from one up to its root."""
        chain = [frame]
        while (parent := self.parents.get(chain[-1])) is not None and parent not in chain:
            chain.append(parent)
        return chain

    def poses(self, frame: str, world: str, at: str | None = None) -> tuple[Int[Tensor, "n"], Float[Tensor, "n 4 4"]]:
        """Stamps, and world_T_frame at them, where it is known.

        Args:
            frame: whose poses are asked for.
            world: in which they are.
            at: frame whose stamps are taken; the frame itself by default.
        """
        tree = FrameTree({child: self._edge(child) for child in self.parents}, world)
        none = torch.zeros(0, dtype=torch.long), torch.zeros(0, 4, 4, dtype=torch.float64)
        try:
            moving = tree.stamps(at or frame)
            stamps = max(moving, key=len) if moving else torch.zeros(1, dtype=torch.long)
            poses, known = tree.at(frame, stamps)
        except UsageError:  # nothing connects them
            return none
        return stamps[known], poses[known]

    def _edge(self, child: str) -> Edge:
        poses = self._poses[child]
        stamps = sorted(poses)
        if child in self._static:
            return Edge(self.parents[child], torch.zeros(0, dtype=torch.long), poses[stamps[-1]][None])
        return Edge(self.parents[child], torch.tensor(stamps), torch.stack([poses[stamp] for stamp in stamps]))


class Rod(NamedTuple):
    """A rod between a force sensor and where its forces act.

    Attributes:
        length_m: of it.
        end_t: (3,), its far end, in the tool's frame.
        sensor_t: (3,), the sensor's origin, in the tool's frame.
        end_s: (3,), its far end, in the sensor's frame.
    """

    length_m: float
    end_t: Float[Tensor, "3"]
    sensor_t: Float[Tensor, "3"]
    end_s: Float[Tensor, "3"]

    @property
    def ends_at_tool(self) -> bool:
        """Whether the tool's frame is at its far end."""
        return float(self.end_t.norm()) <= _NEAR_M


def rod_of(found: Geometry, topic: str, sensor: str, tool: str, world: str) -> Rod | None:
    """A rod from a force sensor to the tool's frame, or as far as its forces act; None where nothing tells of one.

    It goes to the tool's frame; where that is at the sensor, to a frame that rides on the sensor; else along the
    sensor's z axis.

    Args:
        found: in the recording.
        topic: of the wrenches.
        sensor: frame of them.
        tool: its frame.
        world: the fixed frame.
    """
    sensor_T_tool = _offset(found, sensor, tool, world)
    if sensor_T_tool is None:
        return None
    toward = sensor_T_tool[:3, 3]
    if _length(toward) < _LEAST_M:
        riders = [frame for frame in found.parents if sensor in found.chain(frame)[1:]]
        offsets = [_offset(found, sensor, frame, world) for frame in riders]
        toward = max((one[:3, 3] for one in offsets if one is not None), key=_length, default=toward)
    known = _length(toward)
    axis = toward / known if known >= _LEAST_M else torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    length = max(known, _lever(found.wrenches[topic], axis.numpy()))
    if length < _LEAST_M:
        return None
    tool_T_sensor = se3.inverse(sensor_T_tool)
    end_s = length * axis
    return Rod(length, se3.apply(tool_T_sensor, end_s[None])[0], tool_T_sensor[:3, 3], end_s)


def tracked_frame(found: Geometry, named: Iterable[str], tool: str, world: str) -> str | None:
    """The frame that another system tracks: of all that are not on the robot the one that goes farthest.

    Args:
        found: in the recording.
        named: frames that messages of poses are of; others count where they move.
        tool: frame of the tool.
        world: the fixed frame.
    """
    robot, bases, named = {*found.chain(tool)}, {*found.parents.values()}, {*named}
    extents = {frame: _extent(found.poses(frame, world)[1]) for frame in found.parents}
    moving = {frame for frame, extent in extents.items() if extent > _MOVES_M}
    best, farthest = None, -1.0
    for frame in sorted({*found.parents} - robot - bases):
        alone = not moving.intersection(found.chain(frame)[1:])
        carried = tool in moving and _offset(found, tool, frame, world) is not None
        if alone and not carried and (frame in named or frame in moving) and extents[frame] > farthest:
            best, farthest = frame, extents[frame]
    return best


def _extent(poses: Float[Tensor, "n 4 4"]) -> float:
    """How far a frame goes, metres; below 0 where nobody knows."""
    if not len(poses):
        return -1.0
    places = poses[:, :3, 3]
    return float((places.amax(0) - places.amin(0)).norm())


def _offset(found: Geometry, sensor: str, frame: str, world: str) -> Float[Tensor, "4 4"] | None:
    """sensor_T_frame where the recording begins; None where it does not ride with the sensor."""
    at, there = found.poses(frame, world)
    also, sensed = found.poses(sensor, world, at=frame)
    same = torch.isin(at, also), torch.isin(also, at)
    if not bool(same[0].any()):
        return None
    relative = se3.inverse(sensed[same[1]]) @ there[same[0]]
    places = relative[:, :3, 3]
    off = (places - places.median(0).values).norm(dim=-1)
    return relative[0] if float(off.quantile(_RIDES)) <= _RIDES_M else None


def _lever(wrenches: list[tuple[int, np.ndarray]], axis: np.ndarray) -> float:
    """How far along an axis of the sensor a rod reaches that the strongest forces across it act on, metres.

    0 where none are strong.
    """
    ordered = sorted(wrenches, key=lambda one: one[0])
    stamps = np.array([stamp for stamp, _ in ordered])
    rows = np.stack([row for _, row in ordered])
    still = stamps <= stamps[0] + round(_STILL_S * 1e9)
    rows = rows - np.median(rows[still], 0)
    across = np.cross(axis, rows[:, :3])
    strength = np.linalg.norm(across, axis=-1)
    strong = strength > max(float(np.quantile(strength, 1.0 - _STRONGEST)), _NOISES * float(strength[still].mean()))
    if int(strong.sum()) < _FEWEST:
        return 0.0
    levers = (rows[strong, 3:] * across[strong]).sum(-1) / strength[strong] ** 2
    return max(0.0, float(np.median(levers))) + _BEYOND_M


def _length(vector: Float[Tensor, "3"]) -> float:
    return float(vector.norm())
