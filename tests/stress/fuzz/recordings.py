"""What robots and their owners hand over, under damage: logs, clouds, mappings of bags, descriptions of robots."""

import io
import tempfile
from collections.abc import Callable, Iterable
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from rumi.robot.urdf import UrdfBody
from rumi.rosbag.mapping_file import mapping_of
from sensors.vision.point_files import read_cloud
from tests.stress.fuzz.draw import Draw
from tests.stress.fuzz.files import with_file
from tests.stress.made_run import made_result, made_steps

RECORDINGS: dict[str, Callable[[Draw], Iterable[Tensor]]] = {}
"""Targets by name: each damages a file that was right and reads it."""
WHOLE: dict[str, Callable[[Path], Iterable[Tensor]]] = {}
"""The same files undamaged, written into a folder and read."""

MAP = b"""schema = 1
[topics]
"/cloud" = { role = "cloud" }
"/tf" = "tf"
[frames]
world = "map"
tool = "tool"
[scene]
within = [[0.4, -0.2, 0.0], [0.7, 0.2, 0.2]]
builtin = "mug"
[[fixed]]
child = "camera"
parent = "map"
position_m = [0.1, 0.2, 0.3]
quaternion_wxyz = [1.0, 0.0, 0.0, 0.0]
[settings]
seed = 3
"""
URDF = b"""<robot name="r"><link name="base"><collision><origin xyz="0 0 0.1" rpy="0 0 1.57"/>
<geometry><box size="0.1 0.2 0.3"/></geometry></collision></link>
<link name="arm"><collision><geometry><cylinder radius="0.02" length="0.3"/></geometry></collision></link>
<joint name="j" type="revolute"><parent link="base"/><child link="arm"/><origin xyz="0 0 0.2" rpy="0 0 0"/>
<axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>
"""
HEAD = "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F U\nCOUNT 1 1 1 1\nWIDTH 3\nHEIGHT 2\n"
HEAD += "VIEWPOINT 0 0 1 1 0 0 0\nPOINTS 6\nDATA "


@cache
def _log() -> bytes:
    from rumi.runs.replay import digest
    from sensors.log.writer import LogWriter

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.h5"
        with LogWriter(path, [], settings={"seed": 0}) as log:
            for step in made_steps(3, points=4, particles=2):
                log.reading(step.reading, control=step.control, truth=step.truth, digest=digest(step.belief))
            log.finish(made_result(2).as_dict())
        return path.read_bytes()


def _points() -> np.ndarray:
    return np.arange(18.0).reshape(6, 3).astype("<f4") * np.float32(0.01)


def _ascii() -> bytes:
    return (HEAD + "ascii\n" + "\n".join(f"{x:g} {y:g} {z:g} 255" for x, y, z in _points())).encode() + b"\n"


def _binary() -> bytes:
    rows = np.zeros(6, dtype=[("p", "<f4", 3), ("c", "<u4")])
    rows["p"] = _points()
    return (HEAD + "binary\n").encode() + rows.tobytes()


def _archive() -> bytes:
    made = io.BytesIO()
    np.savez(made, points=_points().reshape(2, 3, 3), world_T_camera=np.eye(4))
    return made.getvalue()


def _vertices() -> bytes:
    head = (
        "ply\nformat ascii 1.0\nelement vertex 6\n" + "".join(f"property float {a}\n" for a in "xyz") + "end_header\n"
    )
    return (head + "\n".join(f"{x:g} {y:g} {z:g}" for x, y, z in _points()) + "\n").encode()


def _read_log(path: Path) -> Iterable[Tensor]:
    from sensors.log.reader import Log

    with Log(path) as log:
        settings, taken = log.settings, log.taken()
        for stream in log.streams.values():
            stream.samples()
    assert settings is None or isinstance(settings, dict)
    # each row has a checksum: what is given is what was written
    assert all(taken[k].reading.stamp == float(k) for k in range(len(taken)))
    return ()


def _read_cloud(path: Path) -> Iterable[Tensor]:
    found = read_cloud(path)
    assert found.points.shape[-1] == 3
    return ()


def _read_map(path: Path) -> Iterable[Tensor]:
    mapping_of(path.read_bytes().decode(errors="replace"))
    return ()


def _read_robot(path: Path) -> Iterable[Tensor]:
    UrdfBody.load(path)
    return ()


def _enter(name: str, file: str, original: Callable[[], bytes], read: Any, *arrays: str) -> None:  # noqa: ANN401
    def whole(folder: Path) -> Iterable[Tensor]:
        (folder / file).write_bytes(original())
        found: Iterable[Tensor] = read(folder / file)
        return found

    RECORDINGS[name] = lambda draw: with_file(draw, file, original, read, list(arrays))
    WHOLE[name] = whole


_enter("cloud-pcd-ascii", "cloud.pcd", _ascii, _read_cloud)
_enter("cloud-pcd-binary", "cloud.pcd", _binary, _read_cloud)
_enter("cloud-npz", "cloud.npz", _archive, _read_cloud, "points", "world_T_camera")
_enter("bag-mapping", "map.toml", lambda: MAP, _read_map)
if find_spec("trimesh"):
    _enter("cloud-ply", "cloud.ply", _vertices, _read_cloud)
if find_spec("h5py"):
    _enter("log", "log.h5", _log, _read_log)
if find_spec("pytorch_kinematics"):
    _enter("urdf", "robot.urdf", lambda: URDF, _read_robot)
