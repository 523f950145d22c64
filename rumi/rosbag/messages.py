"""ROS messages as rows of raw streams: numbers and units as they came, arrays in place of packed bytes."""

from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from rumi.rosbag.mapping import Topic, pose_of
from sensors.log.writer import StreamSpec

_FIELD_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_COLORS = {"rgb8": (3, [0, 1, 2]), "bgr8": (3, [2, 1, 0]), "rgba8": (4, [0, 1, 2]), "bgra8": (4, [2, 1, 0]),
           "mono8": (1, [0, 0, 0])}  # fmt: skip
_DEPTHS = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}


class RowOf(NamedTuple):
    """A row for a stream.

    Attributes:
        stream: which, with what its first row tells of it.
        stamp_ns: of the message; 0 where it has none.
        values: the kind's columns.
    """

    stream: StreamSpec
    stamp_ns: int
    values: dict[str, object]


Convert = Callable[[Any, str, Topic], Iterator[RowOf]]


def stamp_ns(message: Any) -> int:  # noqa: ANN401  (a message of any type)
    """Of a message's header; 0 without one."""
    header = getattr(message, "header", None)
    return 0 if header is None else int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)


def point_cloud(message: Any, topic: str, config: Topic) -> Iterator[RowOf]:  # noqa: ANN401
    """sensor_msgs/PointCloud2: x, y and z of floating numbers, and rgb where there is one."""
    fields = {field.name: field for field in message.fields}
    if lacking := [name for name in "xyz" if name not in fields]:
        raise ValueError(f"expected fields x, y and z, found {', '.join(fields) or 'none'} without {lacking[0]}")
    order = ">" if message.is_bigendian else "<"
    names = [name for name in ("x", "y", "z", "rgb", "rgba") if name in fields]
    kind = np.dtype(
        {
            "names": names,
            "formats": [order + _FIELD_TYPES[fields[name].datatype] for name in names],
            "offsets": [fields[name].offset for name in names],
            "itemsize": message.point_step,
        }
    )
    height, width = int(message.height), int(message.width)
    data = np.frombuffer(memoryview(message.data), np.uint8)
    if message.row_step < width * message.point_step or len(data) < height * message.row_step:
        raise ValueError(f"expected {height} x {width} points of {message.point_step} bytes, got {len(data)} bytes")
    rows = data[: height * message.row_step].reshape(height, message.row_step)[:, : width * message.point_step]
    table = np.ascontiguousarray(rows).view(kind).reshape(height, width)
    points = np.stack([table[name].astype(np.float32) for name in "xyz"], -1)
    color = None
    packed = next((name for name in ("rgb", "rgba") if name in names), None)
    if packed is not None and kind[packed].itemsize == 4:
        word = np.ascontiguousarray(table[packed]).view(order + "u4").astype(np.uint32)
        color = np.stack([(word >> shift) & 0xFF for shift in (16, 8, 0)], -1).astype(np.uint8)
    yield RowOf(_spec(message, topic, config, "points"), stamp_ns(message), {"points": points, "color": color})


def image(message: Any, topic: str, config: Topic) -> Iterator[RowOf]:  # noqa: ANN401
    """sensor_msgs/Image: depth (16UC1, mono16, 32FC1) or colour (rgb8, bgr8, rgba8, bgra8, mono8)."""
    height, width, encoding = int(message.height), int(message.width), str(message.encoding)
    order = ">" if message.is_bigendian else "<"
    if encoding in _DEPTHS:
        kind, channels, wanted = np.dtype(order + _DEPTHS[encoding]), 1, "depth"
    elif encoding in _COLORS:
        kind, channels, wanted = np.dtype("u1"), _COLORS[encoding][0], "color"
    else:
        raise ValueError(f"unknown encoding {encoding!r}; known are {', '.join([*_DEPTHS, *_COLORS])}")
    if (config.role == "color") != (wanted == "color"):
        raise ValueError(f"expected an image of role {config.role}, got the encoding {encoding}")
    data = np.frombuffer(memoryview(message.data), np.uint8)
    used = width * channels * kind.itemsize
    if message.step < used or len(data) < height * message.step:
        raise ValueError(f"expected {height} rows of {used} bytes, got {len(data)} bytes")
    rows = np.ascontiguousarray(data[: height * message.step].reshape(height, message.step)[:, :used])
    array = rows.view(kind).reshape(height, width, channels)
    if wanted == "color":
        color = array[..., _COLORS[encoding][1]]
        yield RowOf(_spec(message, topic, config, "color"), stamp_ns(message), {"color": color})
        return
    whole = kind.kind == "u"
    unit = config.unit_m or (0.001 if whole else 1.0)
    about: dict[str, Any] = {"unit_m": unit, **({"camera": config.camera.strip("/")} if config.camera else {})}
    about |= {"rectified": True} if config.rectified else {}
    spec = _spec(message, topic, config, "depth16" if whole else "depth", about)
    depth = array[..., 0].astype(array.dtype.newbyteorder("="))
    yield RowOf(spec, stamp_ns(message), {"depth": depth if whole else depth * np.float32(unit)})


def camera_info(message: Any, topic: str, config: Topic) -> Iterator[RowOf]:  # noqa: ANN401
    """sensor_msgs/CameraInfo."""
    intrinsics, distortion = np.asarray(message.k, float).reshape(3, 3), np.asarray(message.d, float)
    projection = np.asarray(message.p, float)
    _finite(intrinsics, distortion, projection)
    about: dict[str, Any] = {"distortion_model": str(message.distortion_model), "projection": projection.tolist()}
    values: dict[str, object] = {
        "intrinsics": intrinsics,
        "distortion": distortion,
        "size": np.array([message.height, message.width]),
    }
    yield RowOf(_spec(message, topic, config, "camera", about), stamp_ns(message), values)


def wrench(message: Any, topic: str, config: Topic) -> Iterator[RowOf]:  # noqa: ANN401
    """geometry_msgs/WrenchStamped."""
    force, torque = (np.array([part.x, part.y, part.z]) for part in (message.wrench.force, message.wrench.torque))
    _finite(force, torque)
    yield RowOf(_spec(message, topic, config, "wrench"), stamp_ns(message), {"force": force, "torque": torque})


def joint_state(message: Any, topic: str, config: Topic) -> Iterator[RowOf]:  # noqa: ANN401
    """sensor_msgs/JointState; the names stand with the row too, so that others can be put in their order."""
    names = [str(name) for name in message.name]
    values = {}
    for name in ("position", "velocity", "effort"):
        given = np.asarray(getattr(message, name), float)
        if len(given) not in (0, len(names)):
            raise ValueError(f"expected {len(names)} of {name} or none, got {len(given)}")
        if np.isinf(given).any():
            raise ValueError(f"expected numbers of {name}, got some that are infinite")
        values[name] = given if len(given) else np.full(len(names), np.nan)
    yield RowOf(_spec(message, topic, config, "joints", {"names": names}), stamp_ns(message), dict(values))


def transforms(message: Any, topic: str, config: Topic) -> Iterator[RowOf]:  # noqa: ANN401
    """tf2_msgs/TFMessage: a stream for each pair of frames; one that is wrong costs no other one."""
    static = topic.rstrip("/").endswith("static")
    wrong: list[str] = []
    for one in message.transforms:
        parent, child = str(one.header.frame_id).strip("/"), str(one.child_frame_id).strip("/")
        at, turn = one.transform.translation, one.transform.rotation
        about = {"topic": topic, "parent": parent, "child": child, "static": static}
        name = f"tf/{_escaped(parent)}/{_escaped(child)}" + ("/static" if static else "")
        try:
            if not (parent and child):
                raise ValueError("expected the names of two frames")
            pose = pose_of((at.x, at.y, at.z), (turn.w, turn.x, turn.y, turn.z))
        except ValueError as error:
            wrong.append(f"{parent!r} to {child!r}: {error}")
            continue
        yield RowOf(StreamSpec(name, "pose", parent, about), stamp_ns(one), {"pose": pose.numpy()})
    if wrong:
        raise ValueError(f"{len(wrong)} of {len(message.transforms)} transforms left out, {wrong[0]}")


def pose(message: Any, topic: str, config: Topic) -> Iterator[RowOf]:  # noqa: ANN401
    """geometry_msgs/PoseStamped, PoseWithCovarianceStamped and TransformStamped, nav_msgs/Odometry: a frame's pose."""
    parent = (config.frame or str(message.header.frame_id)).strip("/")
    child = (config.child or str(getattr(message, "child_frame_id", ""))).strip("/")
    if not parent or not child:
        lacking = "frame, in which it is" if not parent else "child, whose it is"
        raise ValueError(f"expected a pose between two frames: name its {lacking}, in the mapping")
    given = message.transform if hasattr(message, "transform") else message.pose
    given = given.pose if hasattr(given, "pose") else given  # with a covariance
    at, turn = (
        (given.translation, given.rotation) if hasattr(given, "translation") else (given.position, given.orientation)
    )
    found = pose_of((at.x, at.y, at.z), (turn.w, turn.x, turn.y, turn.z))
    about = {"topic": topic, "role": config.role, "parent": parent, "child": child, "static": False}
    yield RowOf(StreamSpec(topic.strip("/"), "pose", parent, about), stamp_ns(message), {"pose": found.numpy()})


def flag(message: Any, topic: str, config: Topic) -> Iterator[RowOf]:  # noqa: ANN401
    """std_msgs/Bool and the like: whether a finger touches; they have no stamp of their own."""
    touched = np.atleast_1d(np.asarray(message.data)).astype(bool).astype(np.uint8)
    yield RowOf(_spec(message, topic, config, "contact"), stamp_ns(message), {"touched": touched})


def numbers(message: Any, topic: str, config: Topic) -> Iterator[RowOf]:  # noqa: ANN401
    """sensor_msgs/Range and std_msgs/Float32, Float64 and their arrays: the numbers of a further sensor."""
    values = np.atleast_1d(np.asarray(message.range if hasattr(message, "range") else message.data, float))
    spec = _spec(message, topic, config, "numbers", {"sensor": config.sensor})
    yield RowOf(spec, stamp_ns(message), {"numbers": np.where(np.isfinite(values), values, np.nan)})


POSES = (
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped",
    "nav_msgs/msg/Odometry",
)
"""Message types of a frame's pose."""

CONVERTERS: Mapping[str, tuple[tuple[str, ...], Convert]] = {
    "sensor_msgs/msg/PointCloud2": (("cloud", "felt"), point_cloud),
    "sensor_msgs/msg/Image": (("depth", "color", "bubble"), image),
    "sensor_msgs/msg/CameraInfo": (("camera",), camera_info),
    "geometry_msgs/msg/WrenchStamped": (("wrench",), wrench),
    "sensor_msgs/msg/JointState": (("joints", "torques"), joint_state),
    "tf2_msgs/msg/TFMessage": (("tf",), transforms),
    **{kind: (("pose",), pose) for kind in POSES},
    "std_msgs/msg/Bool": (("contact",), flag),
    "std_msgs/msg/UInt8MultiArray": (("contact",), flag),
    "sensor_msgs/msg/Range": (("sensor",), numbers),
    "std_msgs/msg/Float32": (("sensor",), numbers),
    "std_msgs/msg/Float64": (("sensor",), numbers),
    "std_msgs/msg/Float32MultiArray": (("sensor",), numbers),
    "std_msgs/msg/Float64MultiArray": (("sensor",), numbers),
}
"""Roles that a message type can have, and what turns it into rows."""


def _escaped(frame: str) -> str:
    """A frame's name as one part of a stream's: different ones stay different."""
    named = frame.replace("%", "%25").replace("/", "%2F")
    return named.replace(".", "%2E") if not frame.strip(".") else named


def _finite(*arrays: np.ndarray) -> None:
    if not all(np.isfinite(array).all() for array in arrays):
        raise ValueError("expected numbers, got some that are none, or infinite")


def _spec(
    message: Any,  # noqa: ANN401
    topic: str,
    config: Topic,
    kind: str,
    about: Mapping[str, Any] | None = None,
) -> StreamSpec:
    header = getattr(message, "header", None)
    frame = config.frame or ("" if header is None else str(header.frame_id).strip("/"))
    return StreamSpec(topic.strip("/"), kind, frame, {"topic": topic, "role": config.role, **(about or {})})
