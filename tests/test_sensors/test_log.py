import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from sensors.log import LogError
from sensors.log.columns import reading_columns, reading_of, reading_values

pytest.importorskip("h5py")
import h5py

from sensors.log.reader import Log
from sensors.log.writer import SCHEMA, LogWriter, Odd, StreamSpec
from tests.fixtures.logs import READINGS, STREAMS, assert_same, made_up_reading, written


@pytest.mark.parametrize("live", [True, False])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_readings_come_back_bit_for_bit(tmp_path, live, dtype):
    readings = [made_up_reading(seed, 10 * seed, 1 + seed, measured=seed != 1, dtype=dtype) for seed in range(4)]
    path = written(tmp_path / "log.h5", readings, float_type="f4" if dtype == torch.float32 else "f8", live=live)
    with Log(path) as log:
        taken = log.taken()
        assert log.problems == []
        assert log.end == {"stopped_by": "steps"}
    assert len(taken) == 4
    for step, (one, reading) in enumerate(zip(taken, readings, strict=True)):
        assert_same(one.reading, reading)
        assert one.digest == bytes([step] * 32)
    assert taken[0].control is None
    assert torch.equal(taken[2].control, torch.full((3,), 0.2).to(dtype))


def test_the_file_says_what_it_holds(tmp_path):
    """A user opens it with h5py alone."""
    path = written(tmp_path / "log.h5", settings={"task": "mug-0"})
    with h5py.File(path) as file:
        assert file.attrs["format"] == "rumi-log" and file.attrs["schema"] == SCHEMA
        points = file["readings/reading/observation/points"]
        ends = points["end"][:]
        assert ends.tolist() == [40, 40, 940]
        assert np.array_equal(points["data"][ends[1] : ends[2]], READINGS[2].observation.points.numpy())
        names = [column["name"] for column in json.loads(file["readings"].attrs["columns"])]
        assert names == [column.name for column in reading_columns("f4")]
    with Log(path) as log:
        assert log.settings == {"task": "mug-0"}


def test_the_same_readings_give_the_same_bytes_but_for_the_clock(tmp_path, monkeypatch):
    monkeypatch.setattr("time.time_ns", lambda: 7)
    a, b = (written(tmp_path / name).read_bytes() for name in ("a.h5", "b.h5"))
    assert a == b


def test_raw_streams_come_back(tmp_path):
    cloud = np.arange(24, dtype=np.float32).reshape(2, 4, 3)
    depth = np.arange(20, dtype=np.uint16).reshape(4, 5)
    with LogWriter(tmp_path / "log.h5", STREAMS) as log:
        for step in range(3):
            log.append("camera/cloud", 10 + step, 12 + step, points=cloud[:, : 1 + step] + step, color=None)
            log.append("wrench", 10 + step, 12, force=np.array([step, 0.0, 1.0]), torque=np.zeros(3))
            log.append("depth", 10 + step, 12, depth=depth + step)
        empty = {name: np.zeros(0) for name in ("velocity", "effort")}
        log.append("joints", 10, 11, position=np.array([0.5, np.nan]), **empty)
    with Log(tmp_path / "log.h5") as log:
        assert sorted(log.streams) == ["camera/cloud", "depth", "joints", "wrench"]
        stream = log.stream("camera/cloud")
        assert (stream.kind, stream.frame, stream.about) == ("points", "camera", {"topic": "/points"})
        clouds = stream.samples()
        assert [sample.values["points"].shape for sample in clouds] == [(2, 1, 3), (2, 2, 3), (2, 3, 3)]
        assert np.array_equal(clouds[2].values["points"], cloud[:, :3] + 2)
        assert clouds[0].values["color"] is None
        assert [(sample.stamp_ns, sample.received_ns) for sample in clouds] == [(10, 12), (11, 13), (12, 14)]
        assert np.array_equal(log.stream("depth").samples()[1].values["depth"], depth + 1)
        (joints,) = log.stream("joints").samples()
        assert np.array_equal(joints.values["position"], [0.5, np.nan], equal_nan=True)
        with pytest.raises(LogError, match="has no stream 'lidar'; it has camera/cloud, depth, joints, wrench"):
            log.stream("lidar")


def test_odd_stamps_are_flagged_kept_and_put_in_order(tmp_path):
    second = 10**9
    stamps = [5, 7, 6, 7, 50, 8, 0]  # late, duplicate, future, unset
    with LogWriter(tmp_path / "log.h5", STREAMS) as log:
        odd = [
            log.append("wrench", at * second, 9 * second, force=np.full(3, float(at)), torque=np.zeros(3))
            for at in stamps
        ]
        counted = log.odd["wrench"]
    assert odd == [Odd(0), Odd(0), Odd.LATE, Odd.DUPLICATE, Odd.FUTURE, Odd(0), Odd.UNSET]
    assert counted == {"late": 1, "duplicate": 1, "future": 1, "unset": 1}
    with Log(tmp_path / "log.h5") as log:
        stream = log.stream("wrench")
        assert [sample.values["force"][0] for sample in stream.as_recorded()] == stamps
        assert [sample.values["force"][0] for sample in stream.samples()] == [5, 6, 7, 8, 0]
        assert stream.samples()[-1].stamp_ns == 9 * second
        assert [sample.values["force"][0] for sample in stream.samples(6 * second, 8 * second)] == [6, 7, 8]
        assert stream.samples(20 * second, 30 * second) == []
        assert stream.stamps_ns().tolist() == [5 * second, 7 * second, 6 * second, 8 * second, 9 * second]


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"force": np.zeros(3)}, "Expected a value for torque, got none"),
        ({"force": np.zeros(4), "torque": np.zeros(3)}, r"Expected force to have shape \(3\), got \(4,\)"),
        ({"force": ["a"] * 3, "torque": np.zeros(3)}, "Expected force to be numbers"),
        ({"force": np.zeros(3), "torque": np.zeros(3), "power": 1.0}, "no column 'power'; there are .*force"),
    ],
)
def test_rows_that_do_not_fit_are_refused(tmp_path, values, message):
    with LogWriter(tmp_path / "log.h5", STREAMS) as log:
        with pytest.raises(LogError, match=message):
            log.append("wrench", 1, 1, **values)
        log.append("wrench", 2, 2, force=np.ones(3), torque=np.ones(3))
    with Log(tmp_path / "log.h5") as log:
        assert len(log.stream("wrench").samples()) == 1


@pytest.mark.parametrize("live", [True, False])
def test_a_row_that_was_refused_leaves_no_trace(tmp_path, live):
    """Neither in the rows after it, nor in what is said of the right row when it comes."""
    right = {name: np.arange(2.0) for name in ("position", "velocity", "effort")}
    with LogWriter(tmp_path / "log.h5", STREAMS if live else (), live=live) as log:
        if not live:
            log.add_stream(STREAMS[2])
        for step in range(6):
            if step == 2:
                with pytest.raises(LogError, match="Expected effort to have shape"):
                    log.append("joints", 2, 2, **{**right, "effort": np.zeros((1, 2))})
            assert log.append("joints", step, step, **{**right, "position": np.full(2, float(step))}) & ~Odd.UNSET == 0
    with Log(tmp_path / "log.h5") as log:
        samples = log.stream("joints").samples()
        assert [one.values["position"].tolist() for one in samples] == [[float(k)] * 2 for k in range(6)]
        assert log.stream("joints").problems == []


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("live", [True, False])
def test_streams_may_be_named_like_parts_of_others(tmp_path, live, turned):
    streams = [StreamSpec("wrench", "wrench"), StreamSpec("wrench/force", "wrench"), StreamSpec("wrench/b/c", "wrench")]
    streams = streams[::-1] if turned else streams
    with LogWriter(tmp_path / "log.h5", streams if live else (), live=live) as log:
        for step, stream in enumerate(streams, 1):
            if not live:
                log.add_stream(stream)
            log.append(stream.name, step, step, force=np.full(3, step), torque=np.zeros(3))
    with Log(tmp_path / "log.h5") as log:
        assert sorted(log.streams) == ["wrench", "wrench/b/c", "wrench/force"]
        for step, stream in enumerate(streams, 1):
            assert log.stream(stream.name).name == stream.name and log.stream(stream.name).about == {}
            assert log.stream(stream.name).samples()[0].values["force"][0] == step


def test_numbers_that_do_not_fit_their_type_are_refused(tmp_path):
    with LogWriter(tmp_path / "log.h5", STREAMS) as log, pytest.raises(LogError, match="fit numbers of type u2"):
        log.append("depth", 1, 1, depth=np.full((2, 2), -3))


def test_unknown_streams_and_kinds_are_named(tmp_path):
    with pytest.raises(LogError, match="no kind of stream 'smell'; there are points"):
        StreamSpec("nose", "smell")
    with LogWriter(tmp_path / "log.h5", STREAMS[:1]) as log:
        with pytest.raises(LogError, match="no stream 'wrench'; there are camera/cloud"):
            log.append("wrench", 1)
        with pytest.raises(LogError, match="at the start of a live log"):
            log.add_stream(STREAMS[1])
    with pytest.raises(LogError, match="exists"):
        LogWriter(tmp_path / "log.h5")


def test_a_log_that_grows_is_readable(tmp_path):
    writer = LogWriter(tmp_path / "log.h5", STREAMS)
    for step, reading in enumerate(READINGS):
        writer.reading(reading)
        writer.append("wrench", step + 1, force=np.zeros(3), torque=np.zeros(3))
        writer.flush()
        with Log(tmp_path / "log.h5") as log:
            assert_same(log.taken()[-1].reading, reading)
            assert len(log.stream("wrench").samples()) == step + 1
            assert log.problems == ["the log was not finished: what had been written is there"]
    writer.close()


def test_an_unfinished_aside_file_is_left_out_of_the_way(tmp_path):
    with pytest.raises(RuntimeError, match="stop"), LogWriter(tmp_path / "log.h5", live=False):
        assert not (tmp_path / "log.h5").exists()
        raise RuntimeError("stop")
    assert list(tmp_path.iterdir()) == []


def test_a_live_log_keeps_what_was_written_before_an_error(tmp_path):
    with pytest.raises(RuntimeError, match="stop"), LogWriter(tmp_path / "log.h5", STREAMS) as log:
        log.append("wrench", 1, force=np.zeros(3), torque=np.zeros(3))
        raise RuntimeError("stop")
    with Log(tmp_path / "log.h5") as log:
        assert len(log.stream("wrench").samples()) == 1


def test_two_logs_written_aside_for_one_name_are_each_whole(tmp_path):
    first, second = (LogWriter(tmp_path / "log.h5", STREAMS, live=False) for _ in range(2))
    for log, step in ((first, 1), (second, 2), (first, 3)):
        log.append("wrench", step, force=np.full(3, step), torque=np.zeros(3))
    first.finish({})
    with Log(tmp_path / "log.h5") as log:
        assert [one.values["force"][0] for one in log.stream("wrench").samples()] == [1, 3]
    second.discard()
    assert [path.name for path in tmp_path.iterdir()] == ["log.h5"]


def test_every_field_of_a_reading_has_a_column():
    reading = replace(READINGS[0], object_motion=None)
    values = {name: None if v is None else np.asarray(v) for name, v in reading_values(reading).items()}
    assert set(values) <= {column.name for column in reading_columns("f4")}
    assert_same(reading_of(values), reading)
