"""Pushes of logs of ROS 1 bags: of a bag written here, and of recorded ones."""

import math
import os
from pathlib import Path

import numpy as np
import pytest
import torch

from rumi.cli import main
from rumi.errors import UsageError
from rumi.exit_codes import BAD_INPUT, DONE, NOT_CONVERGED
from rumi.rosbag.bag import check_frames, import_bag
from rumi.rosbag.frames import FrameTree
from rumi.rosbag.mapping_file import mapping_of, read_mapping
from scripts import recorded_bags
from scripts.bench.recorded_pushes import read_pushes
from scripts.bench.vicon_pushes import MAP
from sensors.log.errors import LogError
from sensors.log.reader import Log

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


def pushes_of(bag, log, text=MAP, block="slider"):
    import_bag(bag, mapping_of(text), log)
    return read_pushes(log, mapping_of(text), block=block)


def test_tip_block_and_wrench_are_told_in_one_frame(tmp_path):
    found = pushes_of(write(tmp_path / "a.bag"), tmp_path / "a.h5")
    steps = torch.arange(11, dtype=torch.float64)
    torch.testing.assert_close(found.time_s, 0.1 * steps)
    torch.testing.assert_close(found.tip[:, 0], 0.01 * steps)
    torch.testing.assert_close(found.block[:, :2, 3], torch.tensor([0.4, 0.1]).double().expand(11, 2))
    torch.testing.assert_close(found.block[0, :2, 0], torch.tensor([0.0, 1.0]).double())
    torch.testing.assert_close(found.wrench[:, 1], steps)
    torch.testing.assert_close(found.wrench[:, 3], torch.full((11,), -1.0).double())


@pytest.mark.parametrize(
    ("options", "text", "block", "said"),
    [
        ({"wrench": False}, MAP, "slider", "role wrench"),
        ({"frame": "elsewhere"}, MAP, "slider", "at the same time|slider"),
        ({}, MAP, "brick", "at the same time|brick"),
        ({}, MAP.replace('tool = "tip"', 'tool = "finger"'), "slider", "finger"),
    ],
)
def test_what_a_log_lacks_is_told(tmp_path, options, text, block, said):
    with pytest.raises(UsageError, match=said):
        pushes_of(write(tmp_path / "a.bag", **options), tmp_path / "a.h5", text, block)


def test_another_file_is_refused(tmp_path):
    (tmp_path / "a.h5").write_text("no log")
    for name in ("a.h5", "b.h5"):
        with pytest.raises(LogError):
            read_pushes(tmp_path / name, mapping_of(MAP), block="slider")


@pytest.mark.data
@pytest.mark.parametrize(
    "name",
    [
        "Al_block/Test_metal_1.bag",
        pytest.param("Plastic_block/Test_changing_vel_1.bag", marks=pytest.mark.slow),
        pytest.param("St_block/Test_st_3.bag", marks=pytest.mark.slow),
    ],
)
def test_recorded_blocks_are_pushed_where_the_tip_is(tmp_path, name):
    folder = Path(os.environ.get("RUMI_DATA", "")) / "vicon_bags"
    if not os.environ.get("RUMI_DATA") or not folder.is_dir():
        pytest.skip("RUMI_DATA is not set")
    found = pushes_of(folder / name, tmp_path / f"{Path(name).stem}.h5")
    assert len(found.time_s) > 100 and all(bool(part.isfinite().all()) for part in found)
    way = (found.block[:, :2, 3] - found.block[0, :2, 3]).norm(dim=-1)
    assert float(way[-1]) > 0.1
    # while the block moves, the tip is at its border: the distance from its middle is that of a block some cm wide
    moving = np.gradient(way.numpy(), found.time_s.numpy()) > 0.02
    apart = (found.tip[:, :2] - found.block[:, :2, 3]).norm(dim=-1)[torch.tensor(moving)]
    assert 0.02 < float(apart.median()) < 0.10, (name, float(apart.median()))
    force = found.wrench[torch.tensor(moving), :2].norm(dim=-1)
    assert float(force.median()) > 0.5


def test_poses_by_topics_are_frames_of_the_log(tmp_path):
    mapping = mapping_of(MAP)
    done = import_bag(write(tmp_path / "a.bag"), mapping, tmp_path / "a.h5")
    assert not done.problems
    assert not done.lost
    assert done.rows["tip_pose"] == done.rows["vicon/block/block"] == done.rows["netft_data"] == 11
    check_frames(tmp_path / "a.h5", mapping)
    with Log(tmp_path / "a.h5") as log:
        tree = FrameTree.of_log(log, mapping)
        stamps = [k * 10**8 for k in range(11)]
        tip, known = tree.at("tip", stamps)
        assert bool(known.all())
        np.testing.assert_allclose(tip[:, :2, 3], [[0.01 * k, 0.2] for k in range(11)], atol=1e-9)
        block, _ = tree.at("slider", stamps)
        np.testing.assert_allclose(block[:, :2, 3], [[0.4, 0.1]] * 11, atol=1e-9)


@pytest.mark.parametrize(("line", "lacking"), [('{ role = "pose", child = "tip" }', "frame"), ('"pose"', "frame")])
def test_a_pose_between_unnamed_frames_is_told(tmp_path, line, lacking):
    mapping = mapping_of(MAP.replace('{ role = "pose", frame = "map", child = "tip" }', line))
    done = import_bag(write(tmp_path / "a.bag"), mapping, tmp_path / "a.h5")
    count, why = done.lost["/tip_pose"]
    assert count == 11
    assert lacking in why


def test_child_is_of_the_role_pose_alone():
    with pytest.raises(UsageError, match="child"):
        mapping_of(MAP.replace('"wrench"', '{ role = "wrench", child = "tip" }'))


def test_a_suggested_mapping_can_be_used(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "a.bag")
    assert main(["import", "a.bag", "--suggest"]) == DONE
    text = (tmp_path / "a.toml").read_text()
    assert "# geometry_msgs/msg/PoseStamped, 11 messages, without a frame of its own: TODO" in text
    # what a replay needs beside it stands there as comments, which can be taken as they are
    uncommented = text.replace("# [wrench]", "[wrench]").replace("# radius_m", "radius_m").replace("# tare", "tare")
    wrench = mapping_of(uncommented.replace("# center_m", "center_m")).wrench
    assert wrench.center_m == (0.0, 0.0, 0.1) and wrench.tare_s == 0.3
    mapping = read_mapping(tmp_path / "a.toml")
    assert mapping.frames.world == "map"
    assert mapping.frames.tool == "tip"
    assert {name: topic.role for name, topic in mapping.topics.items()} == {
        "/tip_pose": "pose", "/vicon/block/block": "pose", "/netft_data": "wrench",
    }  # fmt: skip
    assert main(["import", "a.bag", "--map", "a.toml"]) == DONE
    # what is there is kept
    assert main(["import", "a.bag", "--suggest"]) == BAD_INPUT
    assert "there already" in capsys.readouterr().err
    assert (tmp_path / "a.toml").read_text() == text


def test_several_bags_come_in_by_one_command(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("lab.toml").write_text(MAP)
    bags = [str(write(tmp_path / name)) for name in ("a.bag", "b.bag")]
    assert main(["import", *bags, "--map", "lab.toml", "--out", "logs"]) == DONE
    assert sorted(path.name for path in Path("logs").iterdir()) == ["a.h5", "b.h5"]
    out = capsys.readouterr().out
    assert "logs/a.h5: " in out and "logs/b.h5: " in out
    (tmp_path / "other").mkdir()
    same = str(write(tmp_path / "other" / "a.bag"))
    assert main(["import", *bags, same, "--map", "lab.toml", "--out", "logs"]) == BAD_INPUT
    assert "logs/a.h5: import them one by one" in capsys.readouterr().err
    assert main(["import", *bags, "--suggest"]) == BAD_INPUT
    assert main(["import", "--map", "lab.toml"]) == BAD_INPUT
    assert "BAG" in capsys.readouterr().err


def test_one_of_several_bags_that_lacks_something_is_told(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("lab.toml").write_text(MAP)
    whole, without = write(tmp_path / "a.bag"), write(tmp_path / "b.bag", wrench=False)
    assert main(["import", str(without), str(whole), "--map", "lab.toml"]) == NOT_CONVERGED
    assert "no /netft_data" in capsys.readouterr().err
    assert Path("a.h5").is_file() and Path("b.h5").is_file()


@pytest.mark.parametrize("flags", [[], ["--suggest", "--map", "a.toml"]])
def test_either_a_mapping_or_a_suggestion(tmp_path, capsys, flags):
    assert main(["import", str(write(tmp_path / "a.bag")), *flags]) == BAD_INPUT
    assert "--suggest" in capsys.readouterr().err


@pytest.mark.data
def test_a_recorded_bag_comes_in_as_it_is_and_replays_bit_for_bit(tmp_path, monkeypatch, cache):
    """The smallest of the eleven; `python -m scripts.recorded_bags` does it with all of them."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("RUMI_CACHE", str(cache))
    bag = min(recorded_bags.bags(), key=lambda one: one.stat().st_size)
    recorded_bags.prepare()
    assert main(["import", str(bag), "--map", "lab.toml"]) == DONE
    for error in recorded_bags.errors(bag):
        assert error.poses > 300 and error.mm < 0.1 and error.degrees < 0.05
    assert recorded_bags.replay(bag, steps=2) == (3, 3)
