"""A mapping file to begin with, from the topics, types, frames, poses and wrenches that a bag has."""

import json
import math
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from posixpath import commonpath
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.errors import UsageError
from rumi.rosbag.mapping import Topic
from rumi.rosbag.mapping_file import SCHEMA
from rumi.rosbag.mcap import BagError
from rumi.rosbag.messages import CONVERTERS, POSES
from rumi.rosbag.source import Source, source_of
from rumi.rosbag.suggest_forces import forces_of, lines_of
from rumi.rosbag.suggest_geometry import Geometry, rod_of, tracked_frame
from rumi.rosbag.suggest_rod import ROD_END, is_upright, lines_of_end, lines_of_rod

_TF = "tf2_msgs/msg/TFMessage"
_WRENCH = "geometry_msgs/msg/WrenchStamped"
_FRAMED = ("sensor_msgs/msg/PointCloud2", _WRENCH)
_VIEWS = ("sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/Image")
_COLORS = ("rgb", "bgr", "mono8")
_TOOL_WORDS = ("tool", "tip", "gripper", "hand", "ee", "finger", "tcp")
_GRIPPER_WORDS = ("gripper", "hand")
_UNNAMED = "?"  # parent of a frame whose messages do not say what they are in
_ABOUT_M = 0.1  # about the tool's way and the object's first place, that the object may be
_HIGH_M = 0.3  # over the floor
_OVER_FLOOR_M = 0.01  # that the tool is at its lowest
_TRACKER_M = 0.01  # by which a tracker tells the first place
_TRACKER_DEG = 5.0  # and the first turn
_READINGS = 12  # that a recording is cut into at least

_UNKNOWN_TOOL = (
    "# [tool]  # TODO unless it is a gripper with two pads: its shape in its own frame",
    '# mesh = "tool.stl"  # or radius_m = 0.005, of a rod, and rod_m = [[0.0, 0.0, 0.0], [0.0, 0.0, 0.1]]',
    "",
)
_UNKNOWN_SURFACE = (
    "# [wrench]  # TODO for a replay: the tool's surface in the sensor's frame",
    '# radius_m = 0.01  # of a ball, or with rod_m of a rod, or mesh = "tool.stl"',
    "# center_m = [0.0, 0.0, 0.1]",
    "# tare_s = 0.3  # seconds at the start in which nothing touches",
    "",
)


@dataclass
class _Found:
    """What a bag has.

    Attributes:
        count: messages by topic and type.
        first: the first message of each topic that can be read.
        geometry: poses and wrenches.
    """

    count: Counter[tuple[str, str]] = field(default_factory=Counter)
    first: dict[str, Any] = field(default_factory=dict)
    geometry: Geometry = field(default_factory=Geometry)


def suggest_mapping(bag: Path) -> str:
    """Text of a mapping file for a bag: a role for every topic that has one, and guesses of all that a replay needs.

    What a line is made of stands behind it; what has to be looked at is marked TODO. It is a mapping that can be read
    as it is.

    Raises:
        UsageError: there is no such bag, or nothing in it can be read.
        ModuleNotFoundError: rosbags is not installed.
    """
    found = _look(source_of(bag))
    if not found.count:
        raise UsageError(f"Expected a bag with messages, got none from {bag}")
    parents = found.geometry.parents
    world = _world(found)
    for child in [child for child, parent in parents.items() if parent == _UNNAMED]:
        parents[child] = world
    lines = [
        f"# What the topics and frames of {bag.name} mean; see scripts/docs/reference/mapping.md.",
        f"schema = {SCHEMA}",
        "",
        "[topics]",
    ]
    names: list[str] = []
    twice = _twice(found)
    for (topic, kind), count in sorted(found.count.items()):
        about = f"{kind}, {count} message{'s' * (count != 1)}"
        if kind == _TF:
            lines.append(f"# {topic}: {about}: read by itself")
        elif kind not in CONVERTERS:
            lines.append(f"# {topic}: {about}: no role")
        else:
            value, told, child = _topic(topic, kind, found, world)
            names += [child] if child else []
            line = f"{json.dumps(topic)} = {value}  # {about}{told}"
            lines.append(f"# {line}, the same as {twice[topic]}" if topic in twice else line)
    tool = _tool(found, names)
    return "\n".join([*lines, "", *_geometry(found, names, tool, world, twice)])


def _geometry(found: _Found, names: list[str], tool: str, world: str, twice: dict[str, str]) -> list[str]:
    """Lines of all tables but that of the topics."""
    geometry = found.geometry
    wrenches = [topic for topic, kind in sorted(found.count) if kind == _WRENCH and topic not in twice]
    rod = None
    if len(wrenches) == 1 and not set(_words(tool)).intersection(_GRIPPER_WORDS):
        rod = rod_of(geometry, wrenches[0], _frame(found.first[wrenches[0]]) or world, tool, world)
    tracked = tracked_frame(geometry, names, tool, world)
    stamps, poses = geometry.poses(tool, world)
    places = poses[:, :3, 3]
    if rod is not None:
        places = places + (poses[:, :3, :3] @ rod.end_t)
    block = geometry.poses(tracked, world)[1][:1] if tracked is not None else torch.zeros(0, 4, 4)
    at = block[:, :3, 3]
    frames = sorted({*geometry.parents, *geometry.parents.values(), *names})
    ends_apart = rod is not None and not rod.ends_at_tool
    seen = any(kind in _VIEWS for _, kind in found.count)
    lines = [
        f"# frames of the recording: {', '.join(frames) or 'none'}",
        "[frames]",
        f"world = {json.dumps(world)}  # TODO z up; the belief lives in it",
        f"tool = {json.dumps(ROD_END if ends_apart else tool)}  # TODO of the tool that touches",
        _floor(places),
        *_tracked(tracked),
        "",
        *(lines_of_end(tool, rod) if rod is not None and ends_apart else ()),
        "[scene]",
        _within(places, at),
        *(() if seen else _prior(places, block)),
        "",
        "[object]",
        '# mesh = "object.stl"  # TODO, or in [scene] builtin = "mug", or rumi replay --mesh object.stl',
        "",
    ]
    if rod is not None:
        forces = forces_of(geometry.wrenches[wrenches[0]], stamps, places)
        upright = is_upright(rod, poses)
        lines += lines_of_rod(rod, off=upright and len(block) > 0 and not seen)
        lines += lines_of(forces, lowest_m=_OVER_FLOOR_M, upright=upright)
    else:
        lines += (*_UNKNOWN_TOOL, *(_UNKNOWN_SURFACE if wrenches else ()))
    every = _every_s(stamps.tolist())
    return [*lines, "[actions]", f"every_s = {every:g}  # of a reading", ""]


def _look(source: Source) -> _Found:
    found = _Found()
    geometry = found.geometry
    try:
        for message in source.messages():
            found.count[message.topic, message.kind] += 1
            topic, kind = message.topic, message.kind
            if kind not in CONVERTERS or (topic in found.first and kind not in (_TF, _WRENCH, *POSES)):
                continue
            given = source.unpack(message)
            found.first.setdefault(topic, given)
            if kind == _TF:
                geometry.add(topic, CONVERTERS[kind][1](given, topic, Topic("tf")), message.received_ns)
            elif kind == _WRENCH:
                geometry.add(topic, CONVERTERS[kind][1](given, topic, Topic("wrench")), message.received_ns)
            elif kind in POSES:
                config = Topic("pose", frame=_frame(given) or _UNNAMED, child=_child(topic, given))
                geometry.add(topic, CONVERTERS[kind][1](given, topic, config), message.received_ns)
    except BagError as error:
        if not found.count:
            raise UsageError(f"Cannot read the bag {source.path}: {error}") from error
    return found


def _topic(topic: str, kind: str, found: _Found, world: str) -> tuple[str, str, str]:
    """The topic's value in TOML, what to say of it, and the frame that it is the pose of."""
    roles, message = CONVERTERS[kind][0], found.first[topic]
    frame = _frame(message)
    values = {"role": roles[0]}
    told, child = f", in frame {frame}" if frame else "", ""
    if kind == "sensor_msgs/msg/Image":
        color = str(message.encoding).startswith(_COLORS)
        values["role"] = "color" if color else "depth"
        infos = [name for name, other in found.count if other == "sensor_msgs/msg/CameraInfo"]
        near = max(infos, key=lambda name: len(commonpath((f"/{name}", f"/{topic}"))), default=None)
        if not color and near is not None:
            values["camera"] = near
        told += f", {message.encoding}"
    elif kind in POSES:
        child = _child(topic, message)
        if not _name(str(getattr(message, "child_frame_id", ""))):
            values["child"] = child
        if not frame:
            values["frame"] = world
            told += ", without a frame of its own: TODO"
    elif roles[0] == "sensor":
        values["sensor"] = topic.strip("/").replace("/", "_")
    else:
        told += "".join(f", or {other}" for other in roles[1:])
        if not frame and kind in _FRAMED:
            values["frame"] = world
            told += ", without a frame of its own: TODO"
    inner = ", ".join(f"{key} = {json.dumps(value)}" for key, value in values.items())
    return (json.dumps(values["role"]) if len(values) == 1 else "{ " + inner + " }"), told, child


def _twice(found: _Found) -> dict[str, str]:
    """Topics of wrenches that are of the same frame as another one with no fewer messages, and that one."""
    by_frame: dict[str, list[str]] = {}
    for topic in (topic for topic, kind in sorted(found.count) if kind == _WRENCH):
        if frame := _frame(found.first[topic]):
            by_frame.setdefault(frame, []).append(topic)
    best = {frame: max(topics, key=lambda one: found.count[one, _WRENCH]) for frame, topics in by_frame.items()}
    return {topic: best[frame] for frame, topics in by_frame.items() for topic in topics if topic != best[frame]}


def _floor(places: Float[Tensor, "n 3"]) -> str:
    floor = float(places[:, 2].min()) - _OVER_FLOOR_M if len(places) else 0.0
    why = f", here {_OVER_FLOOR_M:g} m below the tool's way" if len(places) else ""
    return f"floor_z_m = {floor:.3f}  # TODO height in world of what the object stands on{why}"


def _tracked(tracked: str | None) -> list[str]:
    """Lines of the frames that a tracker gives."""
    name = json.dumps(tracked or "object")
    return [
        f"{'' if tracked else '# '}truth = {name}  # the object's own frame, tracked: judges the replay, no more",
        f"# motion = {name}  # where the belief may know how the object moves",
    ]


def _within(places: Float[Tensor, "n 3"], at: Float[Tensor, "m 3"]) -> str:
    told = torch.cat((places, at.to(places)))
    low, high = ([-0.5, -0.5], [0.5, 0.5])
    if len(told):
        low, high = (told.amin(0)[:2] - _ABOUT_M).tolist(), (told.amax(0)[:2] + _ABOUT_M).tolist()
    corners = ", ".join(f"[{x:.2f}, {y:.2f}, {z:g}]" for (x, y), z in ((low, 0.0), (high, _HIGH_M)))
    return f"within = [{corners}]  # TODO a box about the object, metres, over the floor"


def _prior(places: Float[Tensor, "n 3"], block: Float[Tensor, "m 4 4"]) -> list[str]:
    """Lines of where the object is at first, where no camera sees it."""
    turn = []
    if len(block):
        (x, y), spread, why = block[0, :2, 3].tolist(), _TRACKER_M, "where the tracker saw it first"
        yaw = math.degrees(math.atan2(float(block[0, 1, 0]), float(block[0, 0, 0])))
        turn = [
            f"prior_yaw_deg = {yaw:.1f}  # TODO its turn about z at first, as the tracker has it",
            f"prior_yaw_spread_deg = {_TRACKER_DEG:g}  # TODO standard deviation of that",
        ]
    elif len(places):
        low, high = places.amin(0), places.amax(0)
        (x, y), why = (0.5 * (low + high))[:2].tolist(), "the middle of the tool's way"
        spread = max(0.05, float((high - low)[:2].max()) / 4.0)
    else:
        return []
    return [
        f"prior_mean_m = [{x:.3f}, {y:.3f}]  # TODO where it is at first: {why}",
        f"prior_spread_m = {spread:.2f}  # TODO standard deviation of that",
        *turn,
    ]


def _every_s(stamps_ns: list[int]) -> float:
    """Seconds of a reading: 1, or less for a short recording."""
    seconds = (max(stamps_ns) - min(stamps_ns)) / 1e9 if stamps_ns else 0.0
    return min(1.0, max(0.1, round(seconds / _READINGS, 1))) if seconds else 1.0


def _frame(message: Any) -> str:  # noqa: ANN401  (a message of any type)
    """Frame that a message says it is in; none where it says none."""
    return _name(str(message.header.frame_id)) if hasattr(message, "header") else ""


def _child(topic: str, message: Any) -> str:  # noqa: ANN401
    """Frame that a message of a pose is of: as it says, else by its topic."""
    said = _name(str(getattr(message, "child_frame_id", "")))
    return said or topic.strip("/").split("/")[-1].removesuffix("_pose") or "pose"


def _world(found: _Found) -> str:
    """The root under which most frames are; else the frame of the first message that names one."""
    roots = Counter(found.geometry.chain(frame)[-1] for frame in found.geometry.parents)
    del roots[_UNNAMED]
    if roots:
        return roots.most_common(1)[0][0]
    return next((name for name in map(_frame, found.first.values()) if name), "world")


def _tool(found: _Found, names: list[str]) -> str:
    """A frame whose name speaks of a tool; else the one that is farthest from the root."""
    parents = found.geometry.parents
    leaves = sorted({*parents} - {*parents.values()}, key=lambda frame: (-len(found.geometry.chain(frame)), frame))
    every = [*names, *leaves]
    for word in _TOOL_WORDS:
        for name in every:
            if word in _words(name):
                return name
    return next(iter([*leaves, *names]), "tool")


def _words(frame: str) -> list[str]:
    return frame.lower().replace("/", "_").split("_")


def _name(frame: str) -> str:
    return frame.strip("/")
