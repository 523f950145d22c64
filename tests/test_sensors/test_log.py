import json
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from sdf import se3
from sensors.log import LogError
from sensors.log.columns import reading_columns, reading_of, reading_values
from sensors.observation import Observation, concatenate
from sensors.reading import Reading
from sensors.semantics import Semantics

pytest.importorskip("h5py")

import h5py

from sensors.log.reader import Log
from sensors.log.writer import SCHEMA, LogWriter, Odd, StreamSpec

ROOT = Path(__file__).resolve().parent.parent.parent


def made_up_reading(seed: int, points: int = 40, instants: int = 3, *, measured=True, dtype=torch.float32) -> Reading:
    draw = torch.Generator().manual_seed(seed)
    half = points // 2
    xyz = torch.randn(points, 3, generator=draw, dtype=dtype)
    observation = concatenate(
        [Observation.of(xyz[:half], Semantics.SURFACE), Observation.of(xyz[half:], Semantics.FREE, attached=False)]
    )
    planar = torch.randn(instants, 3, generator=draw, dtype=dtype)
    return Reading(
        observation,
        torch.randint(instants, (points,), generator=draw),
        se3.from_planar(planar, 0.04),
        torch.rand(instants, generator=draw) < 0.5,
        se3.from_planar(0.1 * planar) if measured else None,
        planar[-1],
        torch.rand((), generator=draw, dtype=dtype),
        0.1 * seed,
    )


def assert_same(a: Reading, b: Reading) -> None:
    before, after = reading_values(a), reading_values(b)
    assert before.keys() == after.keys()
    for name, value in before.items():
        if isinstance(value, torch.Tensor):
            assert after[name].dtype == value.dtype, name
            assert torch.equal(after[name], value), name
        else:
            assert after[name] == value, name


READINGS = [made_up_reading(0), made_up_reading(1, 0, 1, measured=False), made_up_reading(2, 900, 20)]


def written(path, readings=READINGS, **options) -> Path:
    with LogWriter(path, **options) as log:
        for step, reading in enumerate(readings):
            control = None if step == 0 else torch.full((3,), 0.1 * step)
            log.reading(reading, control=control, truth=torch.eye(4), digest=bytes([step] * 32))
        log.finish({"stopped_by": "steps"})
    return path


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


STREAMS = [
    StreamSpec("camera/cloud", "points", "camera", {"topic": "/points"}),
    StreamSpec("wrench", "wrench", "tool"),
    StreamSpec("joints", "joints", about={"names": ["a", "b"]}),
    StreamSpec("depth", "depth16", "camera", {"unit_m": 0.001}),
]


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


KILLED = """
import sys
sys.path.insert(0, {root!r})
import numpy as np, torch
from sensors.log.writer import LogWriter, StreamSpec
from sensors.observation import Observation
from sensors.reading import Reading
with LogWriter(sys.argv[1], [StreamSpec("wrench", "wrench")]) as log:
    for step in range(100000):
        points = Observation.of(torch.full((1 + 37 * step % 5000, 3), float(step)), 0)
        pose = torch.eye(4).expand(2, 4, 4)
        log.append("wrench", step + 1, force=np.full(3, float(step)), torque=np.zeros(3))
        still = torch.zeros(2, dtype=torch.bool)
        at = torch.zeros(len(points), dtype=torch.long)
        log.reading(Reading(points, at, pose, still, None, torch.zeros(3), torch.zeros(()), float(step)))
        print(step + 1, flush=True)
"""


@pytest.mark.parametrize("pause", [3, 40])
def test_a_kill_loses_no_reading_that_was_written(tmp_path, pause):
    path = tmp_path / "log.h5"
    process = subprocess.Popen(
        [sys.executable, "-c", KILLED.format(root=str(ROOT)), str(path)], stdout=subprocess.PIPE, text=True
    )
    for _ in range(pause):
        process.stdout.readline()
    process.send_signal(signal.SIGKILL)
    told = int(([pause, *process.stdout.read().split()])[-1])
    assert process.wait() == -signal.SIGKILL
    with Log(path) as log:
        taken = log.taken()
        assert told <= len(taken) <= told + 1
        for step, one in enumerate(taken):
            assert one.reading.stamp == step
            assert len(one.reading.observation) == 1 + 37 * step % 5000
            assert bool((one.reading.observation.points == step).all())
        forces = [sample.values["force"][0] for sample in log.stream("wrench").samples()]
        assert forces[:told] == list(range(told))
        assert log.end is None
        assert log.problems == ["the log was not finished: what had been written is there"]


@pytest.mark.parametrize("part", [0.3, 0.6, 0.95])
def test_of_a_log_that_was_cut_short_the_start_is_read(tmp_path, part):
    readings = [made_up_reading(seed, 3000) for seed in range(20)]
    data = written(tmp_path / "whole.h5", readings).read_bytes()
    (tmp_path / "cut.h5").write_bytes(data[: int(part * len(data))])
    with Log(tmp_path / "cut.h5") as log:
        taken = log.taken()
        assert 0 < len(taken) < 20
        assert f"reading {len(taken)} of 20 is damaged" in log.problems[-1]
    for one, reading in zip(taken, readings[: len(taken)], strict=True):
        assert_same(one.reading, reading)


@pytest.mark.parametrize("live", [True, False])
def test_damage_within_costs_the_rows_it_hits_alone(tmp_path, live):
    path = tmp_path / "log.h5"
    rows = 40
    with LogWriter(path, STREAMS[:1] if live else (), live=live) as log:
        if not live:
            log.add_stream(STREAMS[0])
        for step in range(rows):
            points = np.random.default_rng(step).random((1, 9000, 3), np.float32)
            log.append("camera/cloud", step + 1, 1000, points=points)
    with h5py.File(path) as file:
        chunks = file["streams/camera/cloud/points/data"].id
        chunk = chunks.get_chunk_info(chunks.get_num_chunks() // 2)
    data = bytearray(path.read_bytes())
    middle = chunk.byte_offset + chunk.size // 2
    data[middle : middle + 40] = bytes(range(40))
    path.write_bytes(data)
    with Log(path) as log:
        stream = log.stream("camera/cloud")
        samples = stream.samples()
        assert rows - 6 <= len(samples) < rows
        for sample in samples:
            expected = np.random.default_rng(sample.stamp_ns - 1).random((1, 9000, 3), np.float32)
            assert np.array_equal(sample.values["points"], expected)
        (problem,) = stream.problems
        assert f"{rows - len(samples)} row" in problem


def header_of(path, name):
    """Where an object's header lies in a file."""
    with h5py.File(path) as file:
        return h5py.h5o.get_info(file[name].id).addr


def damaged_at(path, place):
    data = bytearray(path.read_bytes())
    data[place + 12] ^= 0x10
    path.write_bytes(data)


@pytest.mark.parametrize("part", ["", "/force", "/row_crc32", "/stamp_ns"])
def test_a_stream_that_is_damaged_at_its_head_costs_no_other_one(tmp_path, part):
    path = tmp_path / "log.h5"
    with LogWriter(path, [StreamSpec("arm/wrench", "wrench"), StreamSpec("arm/joints", "joints"), STREAMS[1]]) as log:
        for step in range(1, 5):
            for name in ("arm/wrench", "wrench"):
                log.append(name, step, step, force=np.full(3, step), torque=np.zeros(3))
        log.reading(READINGS[0])
        log.finish({})
    damaged_at(path, header_of(path, "streams/arm/wrench" + part))
    with Log(path) as log:
        assert sorted(log.streams) == ["arm/joints", "wrench"]
        (problem,) = log.problems
        assert "arm/wrench" in problem
        assert len(log.stream("wrench").samples()) == 4
        assert_same(log.taken()[0].reading, READINGS[0])


@pytest.mark.parametrize("name", ["settings", "object"])
def test_a_text_that_is_damaged_costs_no_other_part(tmp_path, name):
    path = written(tmp_path / "log.h5", settings={"task": "mug-0"}, about={"object": "{}"})
    damaged_at(path, header_of(path, f"about/{name}"))
    with Log(path) as log:
        assert any(f"about/{name} is damaged" in problem for problem in log.problems)
        assert len(log.taken()) == len(READINGS)
        if name == "settings":
            with pytest.raises(LogError, match="damaged settings"):
                assert log.settings
        else:
            assert log.settings == {"task": "mug-0"}


@pytest.mark.parametrize("seed", range(4))
def test_flipped_bits_are_told_in_words(tmp_path, seed):
    """Wherever they are: what comes is read, or refused as a log that is damaged."""
    path = tmp_path / "log.h5"
    with LogWriter(path, STREAMS) as log:
        for step in range(1, 30):
            log.append("wrench", step, step, force=np.full(3, step), torque=np.zeros(3))
            log.append("depth", step, step, depth=np.full((2, 3), step))
        log.reading(READINGS[0])
        log.finish({})
    whole, draw = path.read_bytes(), np.random.default_rng(seed)
    refused = 0
    for _ in range(15):
        data = bytearray(whole)
        for place in draw.integers(len(data), size=40):
            data[place] ^= 1 << int(draw.integers(8))
        path.write_bytes(data)
        try:
            with Log(path) as log:
                for stream in log.streams.values():
                    for one in stream.samples():
                        numbers = [value for value in one.values.values() if value is not None]
                        assert stream.kind == "joints" or (numbers[0] == one.stamp_ns).all()
                    stream.stamps_ns()
                log.taken()
        except LogError:
            refused += 1
    assert refused < 15


@pytest.mark.parametrize(
    ("was", "damage"), [('"f4"', '"f{"'), ('"tail": [3]', '"tail": ["x"]'), ('"variable": 1', '"variable": 7')]
)
def test_columns_that_cannot_be_are_told(tmp_path, live_log, was, damage):
    path = tmp_path / "log.h5"
    path.write_bytes(live_log)
    with h5py.File(path, "r+") as file:
        told = file["readings"].attrs["columns"]
        assert was in told
        file["readings"].attrs["columns"] = told.replace(was, damage)
    with Log(path) as log, pytest.raises(LogError, match="to be a table of a log, could not read it"):
        log.taken()


@pytest.fixture
def live_log(tmp_path):
    return written(tmp_path / "whole.h5", [made_up_reading(seed, 30) for seed in range(2)]).read_bytes()


def test_what_is_no_log_is_named(tmp_path):
    with pytest.raises(LogError, match="There is no log"):
        Log(tmp_path / "none.h5")
    (tmp_path / "text.h5").write_text("not HDF5")
    with pytest.raises(LogError, match="is no HDF5 file"):
        Log(tmp_path / "text.h5")
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["a"] = [1]
    with pytest.raises(LogError, match="is no log of rumi"):
        Log(tmp_path / "other.h5")


def test_a_log_that_may_not_be_read_is_named(tmp_path, monkeypatch):
    with h5py.File(tmp_path / "log.h5", "w"):
        pass

    def closed(self, *arguments, **named):
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr(Path, "open", closed)
    with pytest.raises(LogError, match=r"Cannot read .*log\.h5: Permission denied"):
        Log(tmp_path / "log.h5")


def test_a_newer_log_is_refused(tmp_path):
    path = written(tmp_path / "log.h5")
    with h5py.File(path, "r+") as file:
        file.attrs["schema"] = SCHEMA + 1
    with pytest.raises(LogError, match=f"newer rumi .schema {SCHEMA + 1}, this one reads {SCHEMA}.: update rumi"):
        Log(path)


def test_an_unfinished_aside_file_is_left_out_of_the_way(tmp_path):
    with pytest.raises(RuntimeError, match="stop"), LogWriter(tmp_path / "log.h5", live=False) as log:
        assert not (tmp_path / "log.h5").exists()
        log.discard()
        raise RuntimeError("stop")
    assert list(tmp_path.iterdir()) == []


def test_every_field_of_a_reading_has_a_column():
    reading = replace(READINGS[0], object_motion=None)
    values = {name: None if v is None else np.asarray(v) for name, v in reading_values(reading).items()}
    assert set(values) <= {column.name for column in reading_columns("f4")}
    assert_same(reading_of(values), reading)
