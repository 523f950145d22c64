"""What is in a bag is in the log, whatever is wrong with other parts of it."""

import re

import numpy as np
import pytest
import torch

from rumi.cli import main
from rumi.errors import UsageError
from rumi.exit_codes import BAD_INPUT, DONE, NOT_CONVERGED
from rumi.rosbag.bag import import_bag
from rumi.rosbag.mapping_file import mapping_of
from sensors.log.reader import Log
from sensors.log.writer import Odd
from tests.fixtures.bags import ALL_ROLES


@pytest.fixture
def mapping():
    return mapping_of(ALL_ROLES)


def wrenches(bags, folder, stamps, received=None, **options):
    maker = bags.Maker(folder, **options)
    for index, at in enumerate(stamps):
        came = bags.START + (index if received is None else received[index]) * bags.SECOND
        stamp = bags.START + at * bags.SECOND if at is not None else 0
        maker.wrench("/wrench", stamp, "sensor", np.full(6, float(index)), received=came)
    return maker.close()


@pytest.mark.parametrize("mcap", [True, False])
def test_every_kind_of_message(bags, tmp_path, mapping, mcap):
    draw = np.random.default_rng(0)
    points = draw.random((4, 6, 3), np.float32)
    points[0, 0] = np.nan
    colors = draw.integers(0, 256, (4, 6, 3), dtype=np.uint8)
    depth = draw.integers(0, 5000, (5, 7), dtype=np.uint16)
    metres = draw.random((5, 7), np.float32)
    at = bags.START
    maker = bags.Maker(tmp_path / "bag", mcap=mcap)
    maker.cloud("/cloud", at, "camera", points, colors=colors)
    maker.cloud("/cloud", at + 1, "camera", points.reshape(-1, 3))
    maker.image("/depth", at, "camera", depth, "16UC1")
    maker.image("/metres", at, "camera", metres, "32FC1")
    maker.image("/color", at, "camera", colors, "bgr8")
    maker.camera_info("/info", at, "camera", np.arange(9.0), (5, 7))
    maker.wrench("/wrench", at, "sensor", np.arange(6.0))
    maker.joints("/joints", at, ["a", "b"], [1.0, 2.0], effort=[3.0, 4.0])
    maker.joints("/joints", at + 1, ["b"], [5.0])
    maker.flag("/touched", at + 7, True)
    pose = torch.tensor([[0.0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])
    maker.tf(at, "base", "hand", pose)
    maker.tf(at, "base", "eye/left", pose, topic="/tf_static")
    file = maker.close()
    done = import_bag(file, mapping, tmp_path / "log.h5")
    assert done.problems == [] and done.lost == {}
    with Log(tmp_path / "log.h5") as log:
        assert log.problems == []
        kinds = {name: stream.kind for name, stream in log.streams.items()}
        assert kinds == {
            "cloud": "points", "depth": "depth16", "metres": "depth", "color": "color", "info": "camera",
            "wrench": "wrench", "joints": "joints", "touched": "contact", "tf/base/hand": "pose",
            "tf/base/eye%2Fleft/static": "pose",
        }  # fmt: skip
        first, second = log.stream("cloud").samples()
        assert np.array_equal(first.values["points"], points, equal_nan=True)
        assert np.array_equal(first.values["color"], colors)
        assert second.values["points"].shape == (1, 24, 3) and second.values["color"] is None
        assert log.stream("cloud").frame == "camera"
        assert np.array_equal(log.stream("depth").samples()[0].values["depth"], depth)
        assert log.stream("depth").about["unit_m"] == 0.001 and log.stream("depth").about["camera"] == "info"
        assert np.array_equal(log.stream("metres").samples()[0].values["depth"], metres)
        assert np.array_equal(log.stream("color").samples()[0].values["color"], colors[..., ::-1])
        info = log.stream("info").samples()[0].values
        assert np.array_equal(info["intrinsics"], np.arange(9.0).reshape(3, 3))
        assert info["size"].tolist() == [5, 7]
        wrench = log.stream("wrench").samples()[0]
        assert wrench.values["force"].tolist() == [0, 1, 2] and wrench.values["torque"].tolist() == [3, 4, 5]
        assert log.stream("wrench").frame == "wrist"
        joints = [one.values for one in log.stream("joints").samples()]
        assert log.stream("joints").about["names"] == ["a", "b"]
        assert np.array_equal(joints[1]["position"], [np.nan, 5.0], equal_nan=True)
        assert joints[0]["effort"].tolist() == [3, 4] and np.isnan(joints[0]["velocity"]).all()
        (touched,) = log.stream("touched").samples()
        assert touched.stamp_ns == at + 7 and touched.odd == Odd.UNSET
        hand = log.stream("tf/base/hand")
        np.testing.assert_allclose(hand.samples()[0].values["pose"], pose, atol=1e-12)
        assert hand.about == {"topic": "/tf", "parent": "base", "child": "hand", "static": False}


def test_the_map_stays_with_the_log(bags, tmp_path, mapping):
    import_bag(wrenches(bags, tmp_path / "bag", [0, 1]), mapping, tmp_path / "log.h5")
    with Log(tmp_path / "log.h5") as log:
        assert log.texts["map"] == ALL_ROLES
        assert log.texts["bag"] == "bag.mcap"
        assert log.settings is None


def test_odd_stamps(bags, tmp_path, mapping):
    stamps = [0, 2, 1, 2, 60, 5, None]
    file = wrenches(bags, tmp_path / "bag", stamps, received=[0, 2, 3, 4, 5, 6, 7])
    done = import_bag(file, mapping, tmp_path / "log.h5")
    assert done.odd == {"wrench": {"late": 1, "duplicate": 1, "future": 1, "unset": 1}}
    with Log(tmp_path / "log.h5") as log:
        stream = log.stream("wrench")
        assert [one.values["force"][0] for one in stream.as_recorded()] == list(range(7))
        assert [one.values["force"][0] for one in stream.samples()] == [0, 2, 1, 5, 6]


def test_messages_that_make_no_sense_are_counted(bags, tmp_path, mapping):
    maker = bags.Maker(tmp_path / "bag")
    maker.wrench("/wrench", bags.START, "sensor", np.zeros(6))
    maker.raw("/wrench", b"\x00\x01\x00\x00short", bags.START + 1)
    maker.wrench("/wrench", bags.START + 2, "sensor", np.ones(6))
    maker.image("/metres", bags.START, "camera", np.zeros((2, 2, 3), np.uint8), "rgb8")
    done = import_bag(maker.close(), mapping, tmp_path / "log.h5")
    assert done.rows == {"wrench": 2}
    assert done.lost["/wrench"][0] == 1
    assert "expected an image of role depth, got the encoding rgb8" in done.lost["/metres"][1]


@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_messages_of_no_numbers_are_counted(bags, tmp_path, mapping, number):
    bad = np.full(6, number)
    maker = bags.Maker(tmp_path / "bag")
    for index in range(3):
        at = bags.START + index
        wrong = index == 1
        maker.wrench("/wrench", at, "sensor", bad if wrong else np.zeros(6))
        maker.camera_info("/info", at, "camera", np.full(9, number if wrong else 1.0), (5, 7))
        maker.joints("/joints", at, ["a", "b"], [np.inf if wrong else 1.0, 2.0])
        pose = torch.eye(4)
        pose[0, 3] = number if wrong else 1.0
        one, other = torch.eye(4), torch.eye(4)
        maker.tfs(at, [("base", "arm", one), ("base", "hand", pose), ("base", "head", other)])
    done = import_bag(maker.close(), mapping, tmp_path / "log.h5")
    assert dict(done.rows) == {
        "wrench": 2, "info": 2, "joints": 2, "tf/base/arm": 3, "tf/base/hand": 2, "tf/base/head": 3
    }  # fmt: skip
    assert {topic: count for topic, (count, _) in done.lost.items()} == {
        "/wrench": 1, "/info": 1, "/joints": 1, "/tf": 1
    }  # fmt: skip
    assert "/wrench: expected numbers, got some that are none, or infinite" in done.lost["/wrench"][1]
    assert "1 of 3 transforms left out, 'base' to 'hand'" in done.lost["/tf"][1]


def test_numbers_that_no_column_holds_cost_their_message_alone(bags, tmp_path, mapping):
    maker = bags.Maker(tmp_path / "bag")
    for index in range(5):
        height = 4_000_000_000 if index == 2 else 48
        maker.camera_info("/info", bags.START + index, "camera", np.eye(3), (height, 64))
    done = import_bag(maker.close(), mapping, tmp_path / "log.h5")
    assert done.rows == {"info": 4}
    assert done.lost["info"][0] == 1 and "Expected size to fit numbers of type i4" in done.lost["info"][1]
    with Log(tmp_path / "log.h5") as log:
        assert len(log.stream("info").samples()) == 4


def test_frames_and_topics_with_like_names_stay_apart(bags, tmp_path):
    text = ALL_ROLES.replace('"/touched" = "contact"', '"/wrench/force" = "felt"')
    children = ["cam/left", "cam_left", "cam%2Fleft", "left", "left/static", "."]
    maker = bags.Maker(tmp_path / "bag")
    for index, child in enumerate(children):
        pose = torch.eye(4)
        pose[0, 3] = float(index)
        for topic in ("/tf", "/tf_static"):
            maker.tf(bags.START + index, "base", child, pose, topic=topic)
    maker.tf(bags.START, "base", "", torch.eye(4))
    maker.wrench("/wrench", bags.START, "sensor", np.zeros(6))
    maker.cloud("/wrench/force", bags.START, "base", np.ones((2, 3)))
    done = import_bag(maker.close(), mapping_of(text), tmp_path / "log.h5")
    assert set(done.lost) == {"/tf"} and "'base' to '': expected the names of two frames" in done.lost["/tf"][1]
    with Log(tmp_path / "log.h5") as log:
        assert log.problems == []
        found = sorted(
            (one.about["child"], one.about["static"], one.samples()[0].values["pose"][0, 3])
            for one in log.streams.values()
            if one.kind == "pose"
        )
        assert found == sorted((child, way, float(k)) for k, child in enumerate(children) for way in (False, True))
        assert len(log.stream("wrench").samples()) == len(log.stream("wrench/force").samples()) == 1
        assert log.stream("wrench/force").kind == "points"


def test_topics_that_are_missing_are_named(bags, tmp_path, mapping):
    file = wrenches(bags, tmp_path / "bag", [0, 1])
    done = import_bag(file, mapping, tmp_path / "log.h5")
    (problem,) = done.problems
    assert problem.startswith("the bag has no /cloud, /depth, /metres")
    assert "its topics are /wrench (geometry_msgs/msg/WrenchStamped)" in problem
    other = mapping_of(ALL_ROLES.replace('"/wrench"', '"/force"'))
    with pytest.raises(UsageError, match=r"found none; its topics are /wrench \(geometry_msgs"):
        import_bag(file, other, tmp_path / "none.h5")
    assert not (tmp_path / "none.h5").exists()


def test_a_type_that_does_not_suit_its_role_is_named(bags, tmp_path):
    file = wrenches(bags, tmp_path / "bag", [0])
    wrong = mapping_of(ALL_ROLES.replace('role = "wrench"', 'role = "cloud"'))
    with pytest.raises(UsageError, match=r"Expected /wrench .*WrenchStamped.* to be wrench, got cloud"):
        import_bag(file, wrong, tmp_path / "log.h5")
    assert not list(tmp_path.glob("log*"))


def test_what_is_no_bag_is_named(tmp_path, mapping):
    with pytest.raises(UsageError, match="There is no bag"):
        import_bag(tmp_path / "none.mcap", mapping, tmp_path / "log.h5")
    for name in ("bad.mcap", "bad.db3"):
        (tmp_path / name).write_text("not a bag, but long enough to have been one" * 10)
        with pytest.raises(UsageError, match="found none"):
            import_bag(tmp_path / name, mapping, tmp_path / "log.h5")
    (tmp_path / "empty").mkdir()
    with pytest.raises(UsageError, match=r"found no \.mcap"):
        import_bag(tmp_path / "empty", mapping, tmp_path / "log.h5")
    assert not list(tmp_path.glob("log*"))


def test_a_folder_without_its_metadata_is_read(bags, tmp_path, mapping):
    file = wrenches(bags, tmp_path / "bag", [0, 1, 2])
    assert import_bag(file.parent, mapping, tmp_path / "whole.h5").rows == {"wrench": 3}
    (file.parent / "metadata.yaml").unlink()
    assert import_bag(file.parent, mapping, tmp_path / "log.h5").rows == {"wrench": 3}


def test_a_folder_whose_files_are_packed_as_wholes_is_read(bags, tmp_path, mapping):
    file = wrenches(bags, tmp_path / "bag", [0, 1, 2], packed_files=True)
    (packed,) = file.parent.glob("*.zstd")
    assert import_bag(file.parent, mapping, tmp_path / "log.h5").rows == {"wrench": 3}
    with pytest.raises(UsageError, match="give the folder that it lies in"):
        import_bag(packed, mapping, tmp_path / "alone.h5")
    (file.parent / "metadata.yaml").unlink()
    with pytest.raises(UsageError, match="give the folder that it lies in"):
        import_bag(file.parent, mapping, tmp_path / "none.h5")


def test_the_command(bags, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "map.toml").write_text(ALL_ROLES)
    wrenches(bags, tmp_path / "bag", [0, 1, 1])
    assert main(["import", "bag/bag.mcap", "--map", "map.toml"]) == NOT_CONVERGED
    said = capsys.readouterr()
    assert "bag.h5: 3 rows of 1 streams" in said.out and "(1 duplicate)" in said.out
    assert "the bag has no /cloud" in said.err
    few = re.sub(r'"/(cloud|depth|metres|color|info|joints|touched)" .*\n', "", ALL_ROLES)
    fixed = "".join(f'[[fixed]]\nparent = "base"\nchild = "{child}"\n' for child in ("hand", "wrist"))
    (tmp_path / "few.toml").write_text(few + fixed)
    assert main(["import", "bag/bag.mcap", "--map", "few.toml", "--out", "few.h5"]) == DONE
    assert main(["import", "bag/bag.mcap", "--map", "few.toml", "--out", "few.h5"]) == BAD_INPUT
    assert "few.h5 exists" in capsys.readouterr().err
    for never in ("inf", "nan", "-1"):
        assert main(["import", "bag/bag.mcap", "--map", "few.toml", "--future", never]) == BAD_INPUT
        assert "Expected --future of 0 s to 1e+09 s" in capsys.readouterr().err
    assert main(["import", "bag/bag.mcap", "--map", "none.toml"]) == BAD_INPUT
    assert "Cannot read the mapping none.toml" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ('tool = "hand"', r"Nothing connects the frame 'hnd' to 'base'; the recording's frames are base, hand"),
        ('world = "base"', r"Nothing connects the frame 'hand' to 'bse'"),
        ('"/wrench" = "wrench"', "Nothing connects the frame 'wrst' to 'base'"),
    ],
)
def test_a_frame_that_is_not_there_is_refused_when_it_is_imported(bags, tmp_path, monkeypatch, capsys, wrong, message):
    monkeypatch.chdir(tmp_path)
    right = re.sub(r"\[topics\].*\[frames\]", '[topics]\n"/wrench" = "wrench"\n[frames]', ALL_ROLES, flags=re.DOTALL)
    maker = bags.Maker(tmp_path / "bag")
    maker.wrench("/wrench", bags.START, "hand", np.zeros(6))
    maker.tf(bags.START, "base", "hand", torch.eye(4, dtype=torch.float64))
    maker.close()
    (tmp_path / "map.toml").write_text(right)
    assert main(["import", "bag", "--map", "map.toml"]) == DONE
    (tmp_path / "bag.h5").unlink()
    capsys.readouterr()
    frame = '"/wrench" = { role = "wrench", frame = "wrst" }'
    changed = frame if "wrench" in wrong else wrong.replace("hand", "hnd").replace("base", "bse")
    (tmp_path / "map.toml").write_text(right.replace(wrong, changed))
    assert main(["import", "bag", "--map", "map.toml"]) == BAD_INPUT
    assert re.search(message, capsys.readouterr().err)
    assert not list(tmp_path.glob("*.h5*"))
