"""Exports as an MCAP file: pose estimates as the messages of ROS 2, by rosbags."""

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rumi.runs.export import Estimates, Format
from rumi.runs.files import whole_file
from sdf import so3
from sdf.extras import optional

FRAMES = ("world", "object", "tool")
"""Of the transforms: the belief's own frame, the object at its best pose, and the tool."""

_START_NS = 10**9  # a stamp of 0 means "no time" in ROS: the run begins one second later


class _Messages:
    """Makes the messages of one file, whose header's frame is the world.

    Args:
        store: of message types, as rosbags gives it.
    """

    def __init__(self, store: Any) -> None:  # noqa: ANN401  (of rosbags)
        self._types = {name.split("/")[-1]: made for name, made in store.types.items() if "/msg/" in name}

    def make(self, name: str, /, **values: Any) -> Any:  # noqa: ANN401
        """A message of a type by its short name."""
        return self._types[name](**values)

    def header(self, stamp_ns: int) -> Any:  # noqa: ANN401
        """At a time, in the world."""
        time = self.make("Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
        return self.make("Header", stamp=time, frame_id=FRAMES[0])

    def pose(self, pose: Float[Tensor, "4 4"]) -> Any:  # noqa: ANN401
        """geometry_msgs/Pose."""
        return self.make("Pose", position=self._vector("Point", pose), orientation=self._turn(pose))

    def transform(self, stamp_ns: int, child: str, pose: Float[Tensor, "4 4"]) -> Any:  # noqa: ANN401
        """geometry_msgs/TransformStamped of a frame in the world."""
        made = self.make("Transform", translation=self._vector("Vector3", pose), rotation=self._turn(pose))
        return self.make("TransformStamped", header=self.header(stamp_ns), child_frame_id=child, transform=made)

    def cloud(self, stamp_ns: int, points: Float[Tensor, "M 3"]) -> Any:  # noqa: ANN401
        """sensor_msgs/PointCloud2 of x, y and z in float32."""
        fields = [self.make("PointField", name=name, offset=4 * k, datatype=7, count=1) for k, name in enumerate("xyz")]
        data = np.frombuffer(points.float().numpy().astype("<f4").tobytes(), np.uint8)
        return self.make(
            "PointCloud2", header=self.header(stamp_ns), height=1, width=len(points), fields=fields,
            is_bigendian=False, point_step=12, row_step=12 * len(points), data=data, is_dense=True,
        )  # fmt: skip

    def numbers(self, values: list[float]) -> Any:  # noqa: ANN401
        """std_msgs/Float64MultiArray."""
        layout = self.make("MultiArrayLayout", dim=[], data_offset=0)
        return self.make("Float64MultiArray", layout=layout, data=np.array(values, np.float64))

    def _vector(self, kind: str, pose: Tensor) -> Any:  # noqa: ANN401
        return self.make(kind, **dict(zip("xyz", pose[:3, 3].tolist(), strict=True)))

    def _turn(self, pose: Tensor) -> Any:  # noqa: ANN401
        return self.make("Quaternion", **dict(zip("xyzw", so3.quaternion(pose[:3, :3]).tolist(), strict=True)))


def _mcap(found: Estimates, path: Path) -> list[Path]:
    """Estimates of each step as TF, PoseWithCovarianceStamped and modes; points that are known at the end.

    Raises:
        ModuleNotFoundError: rosbags is not installed.
    """
    rosbag2 = optional("rosbags.rosbag2", "Writing an MCAP file")
    typesys = optional("rosbags.typesys", "Writing an MCAP file")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    messages = _Messages(store)
    with whole_file(path) as aside, tempfile.TemporaryDirectory(dir=path.parent) as folder:
        # rosbags writes a folder with a file of the folder's name; readers take the file alone
        with rosbag2.Writer(Path(folder) / "bag", version=9, storage_plugin=rosbag2.StoragePlugin.MCAP) as bag:
            connections: dict[str, Any] = {}

            def write(topic: str, stamp_ns: int, message: Any) -> None:  # noqa: ANN401
                kind = message.__msgtype__
                if topic not in connections:
                    connections[topic] = bag.add_connection(topic, kind, typestore=store)
                bag.write(connections[topic], stamp_ns, store.serialize_cdr(message, kind))

            for one in found.steps:
                at, pose = _START_NS + round(1e9 * one.stamp), one.pose
                frames = [(FRAMES[1], pose.world_T_object)]
                if one.world_T_tool is not None:
                    frames.append((FRAMES[2], one.world_T_tool))
                moved = [messages.transform(at, child, where) for child, where in frames]
                write("/tf", at, messages.make("TFMessage", transforms=moved))
                covariance = pose.covariance.reshape(36).numpy()
                mean = messages.pose(pose.world_T_object)
                best = messages.make("PoseWithCovariance", pose=mean, covariance=covariance)
                stamped = messages.make("PoseWithCovarianceStamped", header=messages.header(at), pose=best)
                write("/rumi/pose", at, stamped)
                poses = [messages.pose(mode.world_T_object) for mode in pose.modes]
                write("/rumi/modes", at, messages.make("PoseArray", header=messages.header(at), poses=poses))
                write("/rumi/mode_weights", at, messages.numbers([mode.weight for mode in pose.modes]))
            write("/rumi/particles", at, messages.make(
                "PoseArray", header=messages.header(at), poses=[messages.pose(pose) for pose in found.poses]
            ))  # fmt: skip
            write("/rumi/particle_weights", at, messages.numbers(torch.exp(found.log_weights).tolist()))
            for name in ("free", "surface"):
                write(f"/rumi/{name}", at, messages.cloud(at, getattr(found, name)))
        (Path(folder) / "bag" / "bag.mcap").replace(aside)
    return [path]


MCAP = Format("TF, PoseWithCovarianceStamped, modes, free and surface points, for ROS 2", "belief.mcap", _mcap)
