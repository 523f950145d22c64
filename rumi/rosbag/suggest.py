"""A mapping file to begin with, from the topics, types and frames that a bag has."""

import json
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from posixpath import commonpath
from typing import Any

from rumi.errors import UsageError
from rumi.rosbag.mapping_file import SCHEMA
from rumi.rosbag.messages import CONVERTERS, POSES
from rumi.rosbag.recording_source import Source, source_of
from rumi.rosbag.source import BagError

_TF = "tf2_msgs/msg/TFMessage"
_FRAMED = ("sensor_msgs/msg/PointCloud2", "geometry_msgs/msg/WrenchStamped")
_COLORS = ("rgb", "bgr", "mono8")
_TOOL_WORDS = ("tool", "tip", "gripper", "hand", "ee", "finger", "tcp")


_WRENCH = (
    "# [wrench]  # TODO for a replay: the tool's surface in the sensor's frame",
    '# radius_m = 0.01  # of a ball, or mesh = "tool.stl"',
    "# center_m = [0.0, 0.0, 0.1]",
    "# tare_s = 0.5  # seconds at the start in which nothing touches",
    "",
)


@dataclass
class _Found:
    """What a bag has.

    Attributes:
        count: messages by topic and type.
        first: the first message of each topic that can be read.
        parents: of each frame, by transforms.
    """

    count: Counter[tuple[str, str]] = field(default_factory=Counter)
    first: dict[str, Any] = field(default_factory=dict)
    parents: dict[str, str] = field(default_factory=dict)


def suggest_mapping(bag: Path) -> str:
    """Text of a mapping file for a bag: a role for every topic that has one, and guesses of the frames.

    What a line is made of stands behind it; what has to be looked at is marked TODO. It is a mapping that can be read
    as it is.

    Raises:
        UsageError: there is no such bag, or nothing in it can be read.
        ModuleNotFoundError: rosbags is not installed.
    """
    found = _look(source_of(bag))
    if not found.count:
        raise UsageError(f"Expected a bag with messages, got none from {bag}")
    world = _world(found)
    lines = [
        f"# What the topics and frames of {bag.name} mean; see scripts/docs/reference/mapping.md.",
        f"schema = {SCHEMA}",
        "",
        "[topics]",
    ]
    names: list[str] = []
    for (topic, kind), count in sorted(found.count.items()):
        about = f"{kind}, {count} message{'s' * (count != 1)}"
        if kind == _TF:
            lines.append(f"# {topic}: {about}: read by itself")
        elif kind not in CONVERTERS:
            lines.append(f"# {topic}: {about}: no role")
        else:
            value, told, child = _topic(topic, kind, found, world)
            names += [child] if child else []
            lines.append(f"{json.dumps(topic)} = {value}  # {about}{told}")
    frames = sorted({*found.parents, *found.parents.values(), *names})
    tool = _tool(found, names)
    lines += [
        "",
        f"# frames of the recording: {', '.join(frames) or 'none'}",
        "[frames]",
        f"world = {json.dumps(world)}  # TODO z up; the belief lives in it",
        f"tool = {json.dumps(tool)}  # TODO of the tool that touches",
        "floor_z_m = 0.0  # TODO height in world of what the object stands on",
        '# motion = "tracked"  # a frame that rides with the object, where a tracker measured it',
        '# truth = "object"  # the object\'s own frame: the replay is judged by it, the belief does not see it',
        "",
        "[scene]",
        "within = [[-0.5, -0.5, 0.0], [0.5, 0.5, 0.5]]  # TODO a box about the object, metres, over the floor",
        "",
        "[object]",
        '# mesh = "object.stl"  # TODO, or in [scene] builtin = "mug"',
        "",
        *(_WRENCH if any(CONVERTERS[kind][0][0] == "wrench" for _, kind in found.count if kind in CONVERTERS) else ()),
    ]
    return "\n".join(lines)


def _look(source: Source) -> _Found:
    found = _Found()
    try:
        for message in source.messages():
            found.count[message.topic, message.kind] += 1
            if message.kind == _TF:
                for one in source.unpack(message).transforms:
                    found.parents[_name(one.child_frame_id)] = _name(one.header.frame_id)
            elif message.kind in CONVERTERS and message.topic not in found.first:
                found.first[message.topic] = source.unpack(message)
    except BagError as error:
        if not found.count:
            raise UsageError(f"Cannot read the bag {source.path}: {error}") from error
    return found


def _topic(topic: str, kind: str, found: _Found, world: str) -> tuple[str, str, str]:
    """The topic's value in TOML, what to say of it, and the frame that it is the pose of."""
    roles, message = CONVERTERS[kind][0], found.first[topic]
    frame = _name(str(message.header.frame_id)) if hasattr(message, "header") else ""
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
        child = _name(str(getattr(message, "child_frame_id", "")))
        if not child:
            child = values["child"] = topic.strip("/").split("/")[-1].removesuffix("_pose") or "pose"
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


def _world(found: _Found) -> str:
    """The root under which most frames are; else the frame of the first message that names one."""
    roots = Counter(_chain(found, frame)[-1] for frame in found.parents)
    if roots:
        return roots.most_common(1)[0][0]
    named = [_name(str(one.header.frame_id)) for one in found.first.values() if hasattr(one, "header")]
    return next((name for name in named if name), "world")


def _tool(found: _Found, names: list[str]) -> str:
    """A frame whose name speaks of a tool; else the one that is farthest from the root."""
    leaves = sorted({*found.parents} - {*found.parents.values()}, key=lambda frame: -len(_chain(found, frame)))
    every = [*names, *leaves]
    for word in _TOOL_WORDS:
        for name in every:
            if word in name.lower().replace("/", "_").split("_"):
                return name
    return next(iter([*leaves, *names]), "tool")


def _chain(found: _Found, frame: str) -> list[str]:
    chain = [frame]
    while (parent := found.parents.get(chain[-1])) is not None and parent not in chain:
        chain.append(parent)
    return chain


def _name(frame: str) -> str:
    return frame.strip("/")
