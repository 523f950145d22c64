"""Pushes of ROS 1 bags: of a bag written here, and of recorded ones."""

import math
import os
from pathlib import Path

import numpy as np
import pytest
import torch

from rumi.errors import UsageError
from rumi.rosbag.ros1_pushes import read_pushes

pytest.importorskip("rosbags")


def write(path, *, frame="world", wrench=True):
    """A tip that goes along x, a block seen from a frame that is turned by a right angle, and a sensor on the tip."""
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms\n", "tf2_msgs/msg/TFMessage"))
    kinds = store.types
    header, stamp = kinds["std_msgs/msg/Header"], kinds["builtin_interfaces/msg/Time"]
    vector, point = kinds["geometry_msgs/msg/Vector3"], kinds["geometry_msgs/msg/Point"]
    turn = kinds["geometry_msgs/msg/Quaternion"]
    half = math.sqrt(0.5)
    with Writer(path) as bag:
        topics = {"/tf": "tf2_msgs/msg/TFMessage", "/tip_pose": "geometry_msgs/msg/PoseStamped"}
        topics |= {"/vicon/block/block": "geometry_msgs/msg/TransformStamped"}
        topics |= {"/netft_data": "geometry_msgs/msg/WrenchStamped"} if wrench else {}
        lines = {topic: bag.add_connection(topic, kind, typestore=store) for topic, kind in topics.items()}

        def put(topic, k, message):
            raw = store.serialize_ros1(message, topics[topic])
            bag.write(lines[topic], k * 10**8, raw)

        for k in range(11):

            def own(name, k=k):
                return header(seq=k, stamp=stamp(sec=k // 10, nanosec=k % 10 * 10**8), frame_id=name)

            still, quarter = turn(x=0.0, y=0.0, z=0.0, w=1.0), turn(x=0.0, y=0.0, z=half, w=half)
            step = kinds["geometry_msgs/msg/Transform"]
            stamped = kinds["geometry_msgs/msg/TransformStamped"]
            ties = [
                stamped(own("map"), frame, step(vector(x=0.4, y=0.0, z=0.0), quarter)),
                stamped(own("/map"), "/sensor", step(vector(x=0.0, y=0.0, z=0.0), quarter)),
            ]
            put("/tf", k, kinds["tf2_msgs/msg/TFMessage"](transforms=ties))
            pose = kinds["geometry_msgs/msg/Pose"](point(x=0.01 * k, y=0.2, z=0.0), still)
            put("/tip_pose", k, kinds["geometry_msgs/msg/PoseStamped"](own(""), pose))
            put("/vicon/block/block", k, stamped(own("/world"), "block", step(vector(x=0.1, y=0.0, z=0.0), still)))
            if wrench:
                told = kinds["geometry_msgs/msg/Wrench"](vector(x=float(k), y=0.0, z=0.0), vector(x=0.0, y=1.0, z=0.0))
                put("/netft_data", k, kinds["geometry_msgs/msg/WrenchStamped"](own("sensor"), told))
    return path


def test_tip_block_and_wrench_are_told_in_one_frame(tmp_path):
    found = read_pushes(write(tmp_path / "a.bag"))
    steps = torch.arange(11, dtype=torch.float64)
    torch.testing.assert_close(found.time_s, 0.1 * steps)
    torch.testing.assert_close(found.tip[:, 0], 0.01 * steps)
    torch.testing.assert_close(found.block[:, :2, 3], torch.tensor([0.4, 0.1]).double().expand(11, 2))
    torch.testing.assert_close(found.block[0, :2, 0], torch.tensor([0.0, 1.0]).double())
    torch.testing.assert_close(found.wrench[:, 1], steps)
    torch.testing.assert_close(found.wrench[:, 3], torch.full((11,), -1.0).double())


@pytest.mark.parametrize(
    ("options", "text"), [({"wrench": False}, "netft_data"), ({"frame": "elsewhere"}, "from world")]
)
def test_what_a_bag_lacks_is_told(tmp_path, options, text):
    with pytest.raises(UsageError, match=text):
        read_pushes(write(tmp_path / "a.bag", **options))


def test_another_file_is_refused(tmp_path):
    (tmp_path / "a.bag").write_text("no bag")
    for name in ("a.bag", "b.bag"):
        with pytest.raises(UsageError, match="ROS 1 bag"):
            read_pushes(tmp_path / name)


@pytest.mark.data
def test_recorded_blocks_are_pushed_where_the_tip_is():
    folder = Path(os.environ.get("RUMI_DATA", "")) / "vicon_bags"
    if not os.environ.get("RUMI_DATA") or not folder.is_dir():
        pytest.skip("RUMI_DATA is not set")
    for name in ("Al_block/Test_metal_1.bag", "Plastic_block/Test_changing_vel_1.bag", "St_block/Test_st_3.bag"):
        found = read_pushes(folder / name)
        assert len(found.time_s) > 100 and all(bool(part.isfinite().all()) for part in found)
        way = (found.block[:, :2, 3] - found.block[0, :2, 3]).norm(dim=-1)
        assert float(way[-1]) > 0.1
        # while the block moves, the tip is at its border: the distance from its middle is that of a block some cm wide
        moving = np.gradient(way.numpy(), found.time_s.numpy()) > 0.02
        apart = (found.tip[:, :2] - found.block[:, :2, 3]).norm(dim=-1)[torch.tensor(moving)]
        assert 0.02 < float(apart.median()) < 0.10, (name, float(apart.median()))
        force = found.wrench[torch.tensor(moving), :2].norm(dim=-1)
        assert float(force.median()) > 0.5
