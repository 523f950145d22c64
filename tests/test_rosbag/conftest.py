"""Bags written by rosbags, of what a simulated robot senses: its camera's cloud, its frames, what its pads felt."""

import functools
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from rumi.rosbag.bag import import_bag
from rumi.rosbag.mapping_file import mapping_of
from rumi.rosbag.readings import ImportedReadings, make_readings
from sdf import se3, so3
from sensors.log.reader import Log
from sensors.semantics import Semantics
from sensors.vision.camera import look_at, pinhole, pixel_rays

pytest.importorskip("rosbags")
pytest.importorskip("h5py")

START = 1_700_000_000 * 10**9
SECOND = 10**9


class BagMaker:
    """Writes messages to a bag, in the order in which they are given.

    Args:
        folder: of the bag.
        mcap: its storage; SQLite otherwise.
        packed: compress chunks.
    """

    def __init__(self, folder: Path, *, mcap: bool = True, packed: bool = False) -> None:
        from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
        from rosbags.typesys import Stores, get_typestore

        self.store = get_typestore(Stores.ROS2_JAZZY)
        self.types = SimpleNamespace(**{name.split("/")[-1]: made for name, made in self.store.types.items()})
        plugin = StoragePlugin.MCAP if mcap else StoragePlugin.SQLITE3
        self._writer = Writer(folder, version=9, storage_plugin=plugin)
        if packed:
            self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        self._writer.open()
        self._connections = {}
        self.file = folder / f"{folder.name}.{'mcap' if mcap else 'db3'}"

    def close(self) -> Path:
        self._writer.close()
        return self.file

    def add(self, topic: str, message, received: int) -> None:
        kind = message.__msgtype__
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(topic, kind, typestore=self.store)
        self._writer.write(self._connections[topic], received, self.store.serialize_cdr(message, kind))

    def raw(self, topic: str, data: bytes, received: int) -> None:
        self._writer.write(self._connections[topic], received, data)

    def header(self, stamp: int, frame: str):
        time = self.types.Time(sec=stamp // SECOND, nanosec=stamp % SECOND)
        return self.types.Header(stamp=time, frame_id=frame)

    def cloud(self, topic, stamp, frame, points, *, colors=None, received=None) -> None:
        points = np.asarray(points, np.float32)
        grid = points if points.ndim == 3 else points[None]
        fields = [
            ("x", "f4"),
            ("y", "f4"),
            ("z", "f4"),
            ("pad", "f4"),
            *([("rgb", "u4")] if colors is not None else []),
        ]
        table = np.zeros(grid.shape[:2], np.dtype(fields))
        for axis, name in enumerate("xyz"):
            table[name] = grid[..., axis]
        if colors is not None:
            red, green, blue = (np.asarray(colors).reshape(*grid.shape)[..., k].astype(np.uint32) for k in range(3))
            table["rgb"] = red << 16 | green << 8 | blue
        told = [
            self.types.PointField(name=name, offset=table.dtype.fields[name][1], datatype=7, count=1)
            for name in table.dtype.names
            if name != "pad"
        ]
        message = self.types.PointCloud2(
            header=self.header(stamp, frame), height=grid.shape[0], width=grid.shape[1], fields=told,
            is_bigendian=False, point_step=table.dtype.itemsize, row_step=table.dtype.itemsize * grid.shape[1],
            data=np.frombuffer(table.tobytes(), np.uint8), is_dense=False,
        )  # fmt: skip
        self.add(topic, message, stamp if received is None else received)

    def image(self, topic, stamp, frame, array, encoding, *, received=None) -> None:
        array = np.ascontiguousarray(array)
        step = array.strides[0]
        message = self.types.Image(
            header=self.header(stamp, frame), height=array.shape[0], width=array.shape[1], encoding=encoding,
            is_bigendian=0, step=step, data=np.frombuffer(array.tobytes(), np.uint8),
        )  # fmt: skip
        self.add(topic, message, stamp if received is None else received)

    def camera_info(self, topic, stamp, frame, intrinsics, size) -> None:
        roi = self.types.RegionOfInterest(x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        message = self.types.CameraInfo(
            header=self.header(stamp, frame), height=size[0], width=size[1], distortion_model="plumb_bob",
            d=np.zeros(5), k=np.asarray(intrinsics, float).reshape(9), r=np.eye(3).reshape(9),
            p=np.zeros(12), binning_x=0, binning_y=0, roi=roi,
        )  # fmt: skip
        self.add(topic, message, stamp)

    def tf(self, stamp, parent, child, pose, *, topic="/tf", received=None) -> None:
        self.tfs(stamp, [(parent, child, pose)], topic=topic, received=received)

    def tfs(self, stamp, frames, *, topic="/tf", received=None) -> None:
        """One message of several transforms: parent, child and pose of each."""
        made = []
        for parent, child, given in frames:
            pose = torch.as_tensor(given, dtype=torch.float64)
            x, y, z, w = so3.quaternion(pose[:3, :3]).tolist()
            at = self.types.Vector3(**dict(zip("xyz", pose[:3, 3].tolist(), strict=True)))
            turn = self.types.Quaternion(x=x, y=y, z=z, w=w)
            one = self.types.TransformStamped(
                header=self.header(stamp, parent), child_frame_id=child,
                transform=self.types.Transform(translation=at, rotation=turn),
            )  # fmt: skip
            made.append(one)
        self.add(topic, self.types.TFMessage(transforms=made), stamp if received is None else received)

    def wrench(self, topic, stamp, frame, wrench, *, received=None) -> None:
        force, torque = (
            self.types.Vector3(x=float(part[0]), y=float(part[1]), z=float(part[2]))
            for part in (wrench[:3], wrench[3:])
        )
        message = self.types.WrenchStamped(
            header=self.header(stamp, frame), wrench=self.types.Wrench(force=force, torque=torque)
        )
        self.add(topic, message, stamp if received is None else received)

    def joints(self, topic, stamp, names, position, effort=(), velocity=()) -> None:
        message = self.types.JointState(
            header=self.header(stamp, ""), name=list(names), position=np.asarray(position, float),
            velocity=np.asarray(velocity, float), effort=np.asarray(effort, float),
        )  # fmt: skip
        self.add(topic, message, stamp)

    def flag(self, topic, received, value: bool) -> None:
        self.add(topic, self.types.Bool(data=value), received)


MAP = """
schema = 1

[topics]
"/camera/points" = "cloud"
"/pads/points" = "felt"
"/pads/touched" = "contact"

[frames]
world = "base"
tool = "gripper"
floor_z_m = -0.2

[scene]
builtin = "mug"
within = [[0.40, -0.15, 0.0], [0.80, 0.20, 0.15]]

[actions]
view_s = 0.2
every_s = 1.1
instants = 20

[settings]
filter.motion = "sticking"
initialise = { particles = 30, starts = 200, polished = 30 }
stop.rule = "never"
"""
"""Of the bags that `record` writes; the floor is 0.2 m below the base."""

RISE = torch.eye(4, dtype=torch.float64)
RISE[2, 3] = 0.2  # floor_T_base


@dataclass
class Recorded:
    """A simulated run as a bag.

    Attributes:
        bag: the file.
        truth: where the mug was at the end.
        start: where it was at first.
        readings: what the simulated robot reported.
    """

    bag: Path
    truth: torch.Tensor
    start: torch.Tensor
    readings: list


@functools.cache
def pushes():
    """A simulated robot that goes to a mug and pushes it a little: its task, first result and results."""
    from rumi.tasks.rummage.build import make_task
    from rumi.tasks.rummage.scenes import SCENES, large_handled_mug, make_tool

    spec = replace(SCENES["mug-0"], start=(0.55, 0.03, 0.6))
    task = make_task(spec, tool=make_tool(spec, free_flying=True), model=large_handled_mug())
    first = task.reset(0)
    controls = torch.tensor([[1.0, 0.3, 0.0], [1.0, 0.1, 0.0], [0.9, 0.0, 0.0], [0.6, 0.0, 0.0], [0.2, 0.0, 0.0]])
    return task, first, [task.step(control) for control in controls]


def record(folder: Path, *, organised: bool = True, depth: bool = False, **options) -> Recorded:
    """Write the bag of a simulated run."""
    task, first, results = pushes()
    camera = task.spec.camera
    task.reset(0)
    image, _ = task.depth_image()
    intrinsics = pinhole(camera.height, camera.width, camera.field_of_view_rad)
    cloud = pixel_rays(camera.height, camera.width, intrinsics) * image[..., None]
    cloud[~torch.isfinite(image)] = torch.nan
    base_T_floor = se3.inverse(RISE)
    maker = BagMaker(folder, **options)
    world_T_camera = look_at(torch.tensor(camera.position).double(), torch.tensor(camera.target).double())
    maker.tf(START, "base", "camera", base_T_floor @ world_T_camera, topic="/tf_static")
    last = 0
    if depth:
        maker.camera_info("/camera/info", START, "camera", intrinsics, (camera.height, camera.width))
        millimetres = torch.where(torch.isfinite(image), 1000.0 * image, 0.0).round().numpy().astype(np.uint16)
        maker.image("/camera/depth", START + SECOND // 10, "camera", millimetres, "16UC1")
    else:
        points = cloud.numpy() if organised else cloud.numpy().reshape(-1, 3)
        maker.cloud("/camera/points", START + SECOND // 10, "camera", points)
    pose = base_T_floor @ first.reading.tool_pose[0].double()
    for at in (0, SECOND // 10, SECOND // 5):
        maker.tf(START + at, "base", "gripper", pose)
    begin = START + SECOND // 5
    for result in results:
        reading = result.reading
        count = len(reading.tool_pose)
        surface = reading.observation.of_class(Semantics.SURFACE)
        for k in range(count):
            stamp = begin + int(1.1 * SECOND * (k + 1) / count)
            pose = base_T_floor @ reading.tool_pose[k].double()
            maker.tf(stamp, "base", "gripper", pose)
            felt = reading.observation.points[surface & (reading.instant == k)]
            if len(felt):
                own = se3.apply(se3.inverse(reading.tool_pose[k]), felt)
                maker.cloud("/pads/points", stamp - SECOND // 1000, "gripper", own)
            maker.flag("/pads/touched", stamp - SECOND // 1000, bool(reading.in_contact[k]))
            last = stamp
        begin = last
    return Recorded(maker.close(), results[-1].truth, first.truth, [first.reading, *(r.reading for r in results)])


def readings_of(bag: Path, text: str, path: Path) -> ImportedReadings:
    """What a bag tells by a mapping file's text, all of it, by way of a log at `path`."""
    mapping = mapping_of(text)
    path.unlink(missing_ok=True)
    done = import_bag(bag, mapping, path)
    assert done.problems == [] and done.lost == {}
    with Log(path) as log:
        return make_readings(log, mapping)


@pytest.fixture(scope="session")
def bags():
    """What bags are made with: test files cannot import this one."""
    return SimpleNamespace(
        Maker=BagMaker, record=record, readings_of=readings_of, MAP=MAP, RISE=RISE, START=START, SECOND=SECOND
    )


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A simulated run as a bag."""
    return record(tmp_path_factory.mktemp("bags") / "pushes")
