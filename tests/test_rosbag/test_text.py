"""Recordings as CSV and JSON lines: the same readings as from the bag that they were written of."""

import csv
import json

import pytest
import torch

from rumi.cli import main
from rumi.rosbag.bag import import_bag
from rumi.rosbag.mapping_file import mapping_of
from rumi.rosbag.readings import make_readings
from sdf import so3
from sensors.log.reader import Log

TEXT_MAP = """
[topics]
"gripper" = { role = "pose", child = "gripper", frame = "base" }
"seen" = { role = "cloud", frame = "camera" }
"felt" = { role = "felt", frame = "gripper" }
"touched" = "contact"
"""


def write(path, rows):
    with path.open("w", newline="") as file:
        if path.suffix == ".csv":
            table = csv.DictWriter(file, list(rows[0]))
            table.writeheader()
            table.writerows(rows)
        else:
            file.writelines(json.dumps(row) + "\n" for row in rows)


def seconds(stamp_ns):
    return f"{stamp_ns // 10**9}.{stamp_ns % 10**9:09d}"


def samples(log, name):
    return [(seconds(one.stamp_ns), one.values) for one in log.stream(name).samples()]


def pose_row(pose):
    turn = so3.quaternion(torch.as_tensor(pose)[:3, :3]).tolist()
    return dict(zip(("x", "y", "z", "qx", "qy", "qz", "qw"), [*pose[:3, 3].tolist(), *turn], strict=True))


@pytest.fixture(scope="module")
def both(bags, tmp_path_factory):
    """Readings of a bag, and of the same as text; the folder of the text and its mapping."""
    folder = tmp_path_factory.mktemp("text")
    recorded = bags.record(folder / "bag", organised=False)
    assert import_bag(recorded.bag, mapping_of(bags.MAP), folder / "bag.h5").problems == []
    text = folder / "text"
    text.mkdir()
    with Log(folder / "bag.h5") as log:
        made = make_readings(log, mapping_of(bags.MAP))
        poses = [{"stamp_s": at, **pose_row(one["pose"])} for at, one in samples(log, "tf/base/gripper")]
        write(text / "gripper.csv", poses)
        points = [(at, one["points"].reshape(-1, 3)) for at, one in samples(log, "pads/points")]
        write(
            text / "felt.csv",
            [{"stamp_s": at, "x": x, "y": y, "z": z} for at, part in points for x, y, z in part.tolist()],
        )
        write(
            text / "touched.csv",
            [{"stamp_s": at, "touched": int(one["touched"][0])} for at, one in samples(log, "pads/touched")],
        )
        seen = [(at, torch.as_tensor(one["points"]).reshape(-1, 3)) for at, one in samples(log, "camera/points")]
        rows = [{"stamp_s": at, "points": part[part.isfinite().all(-1)].tolist()} for at, part in seen]
        write(text / "seen.jsonl", rows)
        ((_, camera),) = samples(log, "tf/base/camera/static")
    x, y, z, *turn = pose_row(camera["pose"]).values()
    fixed = f'[[fixed]]\nparent = "base"\nchild = "camera"\nposition_m = [{x}, {y}, {z}]\n'
    fixed += f"quaternion_wxyz = [{turn[3]}, {turn[0]}, {turn[1]}, {turn[2]}]\n"
    mapping = "schema = 1\n" + TEXT_MAP + fixed + bags.MAP[bags.MAP.index("[frames]") :]
    (folder / "text.toml").write_text(mapping)
    assert main(["import", str(text), "--map", str(folder / "text.toml"), "--out", str(folder / "text.h5")]) == 0
    with Log(folder / "text.h5") as log:
        return made, make_readings(log, mapping_of(mapping)), text


@pytest.mark.sim
def test_text_gives_the_readings_of_the_bag(both):
    made, told, _ = both
    assert told.problems == made.problems == [] and len(told.taken) == len(made.taken)
    for one, other in zip(told.taken, made.taken, strict=True):
        torch.testing.assert_close(one.reading.tool_pose, other.reading.tool_pose, atol=1e-6, rtol=0)
        assert torch.equal(one.reading.in_contact, other.reading.in_contact)
        assert len(one.reading.observation) == len(other.reading.observation)
        torch.testing.assert_close(one.reading.observation.points, other.reading.observation.points, atol=1e-6, rtol=0)


@pytest.mark.sim
def test_a_mapping_is_suggested_for_text(both, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["import", str(both[2]), "--suggest", "--out", "map.toml"]) == 0
    text = (tmp_path / "map.toml").read_text()
    mapping = mapping_of(text)
    assert {name: topic.role for name, topic in mapping.topics.items()} == {
        "gripper": "pose", "seen": "cloud", "felt": "cloud", "touched": "contact",
    }  # fmt: skip
    assert mapping.topics["gripper"].child == "gripper" and "without a frame of its own: TODO" in text


def imported(tmp_path, name, text, topic):
    (tmp_path / name).write_text(text)
    mapping = f'schema = 1\n[topics]\n"{name.partition(".")[0]}" = {topic}\n[frames]\nworld = "base"\ntool = "tool"\n'
    mapping += '[scene]\nbuiltin = "mug"\nwithin = [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]\n'
    (tmp_path / "log.h5").unlink(missing_ok=True)
    done = import_bag(tmp_path / name, mapping_of(mapping), tmp_path / "log.h5")
    with Log(tmp_path / "log.h5") as log:
        return done, [(one.stamp_ns, one.values) for one in next(iter(log.streams.values())).samples()]


def test_every_kind_of_column_becomes_its_stream(tmp_path):
    rows = "stamp_s, fx, fy, fz, tx, ty, tz\n1700000000.123456789, 1, 2, 3, .1, .2, .3\n"
    _, ((stamp, values),) = imported(tmp_path, "wrist.csv", rows, '{ role = "wrench", frame = "wrist" }')
    assert stamp == 1_700_000_000_123_456_789, "to the nanosecond"
    assert values["force"].tolist() == [1, 2, 3] and values["torque"].tolist() == [0.1, 0.2, 0.3]
    rows = '{"stamp_s": 2, "position_j1": 0.5, "position_j2": -1, "effort_j1": 3, "effort_j2": 4}\n'
    _, ((_, values),) = imported(tmp_path, "arm.jsonl", rows, '"torques"')
    assert values["position"].tolist() == [0.5, -1.0] and values["effort"].tolist() == [3.0, 4.0]
    rows = "stamp_s,value_1,value_2\n2,5,6\n2.5,7,8\n"
    _, found = imported(tmp_path, "palm.csv", rows, '{ role = "sensor", sensor = "proximity" }')
    assert [values["numbers"].tolist() for _, values in found] == [[5, 6], [7, 8]]
    rows = "stamp_s,x,y,z\n1,0,0,0\n1,1,1,1\n2,2,2,2\n"
    _, found = imported(tmp_path, "felt.csv", rows, '{ role = "felt", frame = "tool" }')
    assert [len(values["points"].reshape(-1, 3)) for _, values in found] == [2, 1], "a cloud a stamp"


def test_a_mark_of_the_byte_order_is_no_part_of_the_first_column(tmp_path):
    for name, text in (("touch.csv", "stamp_s,touched\n1,1\n"), ("touch.jsonl", '{"stamp_s": 1, "touched": 1}\n')):
        _, found = imported(tmp_path, name, "\ufeff" + text, '"contact"')
        assert [stamp for stamp, _ in found] == [10**9]


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("x,y,z\n1,2,3\n", "expected a column stamp_s"),
        ("stamp_s,a\n1,2\n", "expected beside stamp_s the columns x y z qx"),
        ("stamp_s,touched\n1,perhaps\n", "0, 1, true or false, got 'perhaps'"),
        ("stamp_s,touched\nsoon,1\n", "sample 1"),
        ("stamp_s,touched\nnan,1\n", "sample 1"),
        ("stamp_s,touched\n1e30,1\n", "expected stamp_s of 0 to 9.2e9 s"),
        ("stamp_s,fx,fy,fz,tx,ty,tz\n1,1,2\n", "sample 1"),
    ],
)
def test_what_makes_no_sense_is_named(rows, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "push.csv").write_text(rows)
    assert main(["import", "push.csv", "--suggest"]) == 2
    said = capsys.readouterr().err
    assert message in said and "push.csv, sample 1" in said and "Traceback" not in said


def test_rows_before_a_wrong_one_are_kept(tmp_path):
    done, found = imported(tmp_path, "touch.csv", "stamp_s,touched\n1,1\n2,0\n3,2\n", '"contact"')
    assert len(found) == 2 and "touch.csv, sample 3" in done.problems[0]
