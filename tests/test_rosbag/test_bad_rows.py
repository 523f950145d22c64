"""Rows that cannot be: wrong stamps, no numbers, sensors that begin late; all else of the recording is read."""

import numpy as np
import pytest
import torch

from rumi.errors import UsageError
from rumi.rosbag.mapping_file import mapping_of
from rumi.rosbag.readings import make_readings
from rumi.rosbag.torques import JointTrack
from sensors.log.reader import Log
from sensors.log.writer import LogWriter, StreamSpec
from sensors.reading import FORCE

SECOND = 10**9
START = 1_700_000_000 * SECOND
MAP = """
schema = 1
[topics]
"/wrench" = "wrench"
"/felt" = "felt"
[frames]
world = "base"
tool = "gripper"
[scene]
builtin = "mug"
within = [[0.4, -0.2, 0.0], [0.8, 0.2, 0.2]]
[wrench]
radius_m = 0.0125
tare_s = 0.3
[actions]
view_s = 0.2
every_s = 0.4
"""
STREAMS = [
    StreamSpec("tf/base/gripper", "pose", "base", {"parent": "base", "child": "gripper"}),
    StreamSpec("wrench", "wrench", "gripper", {"topic": "/wrench", "role": "wrench"}),
    StreamSpec("felt", "points", "base", {"topic": "/felt", "role": "felt"}),
]


def pose(x=0.5):
    made = np.eye(4)
    made[:3, 3] = (x, 0.0, 0.1)
    return made


def push(force=0.0):
    return {"force": np.array([force, 0.0, 0.0]), "torque": np.zeros(3)}


def written(path, extra=(), *, rows=42, wrench_from=0.0, bias=3.0):
    """A log of 2.05 s: a tool that moves and a wrench that is its bias alone; `extra` rows come last."""
    with LogWriter(path, STREAMS) as log:
        for index in range(rows):
            stamp = START + index * 50_000_000
            log.append("tf/base/gripper", stamp, stamp, pose=pose(0.5 + 0.002 * index))
            if 0.05 * index >= wrench_from:
                log.append("wrench", stamp + 1, stamp + 1, **push(bias))
        for stream, stamp, values in extra:
            log.append(stream, stamp, START + 10 * SECOND, **values)
        log.finish({})
    return path


def made_of(path, text=MAP):
    with Log(path) as log:
        return make_readings(log, mapping_of(text))


def test_a_sound_recording_has_no_problems(tmp_path):
    """Its last quarter of a second is less than a reading; that is no problem."""
    made = made_of(written(tmp_path / "log.h5"))
    assert made.problems == []
    assert len(made.taken) == 1 + 4
    assert made.wrenches["none"] == 42 and made.wrenches["contact"] == 0
    assert [note for note in made.notes if "the last 0.25 s are less than a reading" in note]


@pytest.mark.parametrize(
    ("stream", "stamp", "values"),
    [
        ("wrench", 5 * SECOND, push()),
        ("wrench", START - 3600 * SECOND, push()),
        ("wrench", START - 5 * SECOND, push(900.0)),
        ("wrench", START + 11 * SECOND - SECOND // 2, push(900.0)),
        ("tf/base/gripper", 5 * SECOND, {"pose": pose(9.0)}),
        ("tf/base/gripper", START - 3600 * SECOND, {"pose": pose(9.0)}),
        ("felt", 5 * SECOND, {"points": np.ones((1, 1, 3))}),
    ],
)
def test_a_row_with_a_wrong_stamp_costs_nothing_else(tmp_path, stream, stamp, values):
    sound = made_of(written(tmp_path / "sound.h5"))
    made = made_of(written(tmp_path / "log.h5", [(stream, stamp, values)]))
    assert made.wrenches["none"] == 42
    assert len(made.taken) == len(sound.taken)
    for ours, theirs in zip(made.taken, sound.taken, strict=True):
        assert torch.equal(ours.reading.tool_pose, theirs.reading.tool_pose)
        assert torch.equal(ours.reading.in_contact, theirs.reading.in_contact)
        assert ours.reading.stamp == theirs.reading.stamp
    (problem,) = made.problems
    assert stream in problem and "1 of " in problem


@pytest.mark.parametrize("bit", [3, 40, 63])
@pytest.mark.parametrize("row", [0, 20])
def test_a_flipped_bit_in_a_stamp_costs_its_row(tmp_path, bit, row):
    """Whichever: that of a wrench, or of a pose of the tool."""
    path = written(tmp_path / "log.h5")
    whole = path.read_bytes()
    for name, off in (("wrench", 1), ("tf/base/gripper", 0)):
        data = bytearray(whole)
        place = data.index((START + row * 50_000_000 + off).to_bytes(8, "little"))
        data[place + bit // 8] ^= 1 << bit % 8
        path.write_bytes(data)
        made = made_of(path)
        assert len(made.taken) == 5 or (row == 0 and name != "wrench")
        assert 41 <= made.wrenches["none"] <= 42
        assert any(name in problem and "left out" in problem for problem in made.problems)


def test_too_many_readings_are_refused(tmp_path):
    with pytest.raises(UsageError, match=r"100000 readings at most, got 18.*set actions.every_s higher"):
        made_of(written(tmp_path / "log.h5"), MAP.replace("every_s = 0.4", "every_s = 1e-6"))


@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_wrenches_that_are_no_numbers_are_left_out(tmp_path, number):
    made = made_of(written(tmp_path / "log.h5", [("wrench", START + SECOND + 7, push(number))]))
    assert made.wrenches["none"] == 42 and len(made.taken) == 5
    assert made.problems == ["stream wrench: 1 of 43 wrenches are no numbers, and left out"]


def test_poses_that_are_no_numbers_are_left_out(tmp_path):
    bad = pose()
    bad[0, 3] = np.nan
    made = made_of(written(tmp_path / "log.h5", [("tf/base/gripper", START + 25_000_000, {"pose": bad})]))
    assert len(made.taken) == 5 and made.wrenches["none"] == 42
    assert made.problems == ["stream tf/base/gripper: 1 of 43 poses are no numbers"]


def test_a_wrench_that_begins_late_is_tared_by_its_own_start(tmp_path):
    made = made_of(written(tmp_path / "log.h5", wrench_from=0.5))
    assert made.wrenches["none"] == 32 and made.wrenches["contact"] == 0
    assert made.problems == [
        "stream wrench: begins 0.5 s after the start; its bias is taken from its own first 0.3 s, in which nothing may "
        "touch"
    ]


def test_a_row_of_joints_of_another_length_is_left_out(tmp_path):
    with LogWriter(tmp_path / "log.h5", [StreamSpec("joints", "joints", about={"names": ["a", "b"]})]) as log:
        for index in range(5):
            row = np.full(3 if index == 2 else 2, float(index))
            log.append("joints", START + index, START + index, position=row, velocity=row, effort=row)
    with Log(tmp_path / "log.h5") as log:
        track = JointTrack(log.stream("joints"))
    assert track.tables["position"][:, 0].tolist() == [0.0, 1.0, 3.0, 4.0]
    assert track.problems == ["stream joints: 1 of 5 rows are not of its 2 joints, left out"]


def test_the_force_of_a_wrench_comes_along_without_its_bias(tmp_path):
    """The mean of all rows on the way to each instant: one without a force and two with; NaN where there is none."""
    extra = [("wrench", START + round(at * SECOND) + 7, push(3.0 + force)) for at, force in ((1.0, 2.0), (1.001, 4.0))]
    made = made_of(written(tmp_path / "log.h5", extra))
    found = torch.cat([own.reading.measurements[FORCE] for own in made.taken[1:]])
    felt = found.nan_to_num().abs() > 1e-4
    assert found.shape[1] == 3 and int(felt.sum()) == 1
    assert float(found[felt]) == pytest.approx(2.0, abs=1e-4)


def test_a_wrench_that_no_touch_of_the_tool_explains_gives_no_force(tmp_path):
    """A moment that takes the line of force past the ball: something else was touched, or the shape is wrong."""
    impossible = {"force": np.array([5.0, 0.0, 0.0]), "torque": np.array([0.0, 0.0, 1.0])}
    made = made_of(written(tmp_path / "log.h5", [("wrench", START + SECOND + 7, impossible)]))
    assert made.wrenches["miss"] == 1 and made.wrenches["none"] == 42
    found = torch.cat([own.reading.measurements[FORCE] for own in made.taken[1:]])
    assert float(found.nan_to_num().abs().max()) < 1e-4
    assert sum(int(own.reading.in_contact.sum()) for own in made.taken) == 1, "that it touched is known all the same"
