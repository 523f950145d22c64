"""Logs that were cut short, damaged or are none: what can be read is, and the rest is told in words."""

import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from sensors.log import LogError

pytest.importorskip("h5py")
import h5py

from sensors.log.reader import Log
from sensors.log.writer import SCHEMA, LogWriter, StreamSpec
from tests.fixtures.logs import READINGS, STREAMS, assert_same, made_up_reading, written

ROOT = Path(__file__).resolve().parent.parent.parent
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
