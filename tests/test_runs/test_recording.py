import errno
import itertools
import json
import math
import os
import re
import stat
import threading
import zipfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from rumi.errors import UsageError
from rumi.runs import folder as folder_module
from rumi.runs.files import new_file
from rumi.runs.folder import SCHEMA, RunRecorder, holds_run, load_run, write_belief, write_json
from rumi.runs.plain import plain
from rumi.runs.trace import TraceWriter, read_trace
from sdf.processor import processor
from tests.fixtures.made_up_run import make_up

WRITTEN = {"settings.json", "trace.npz", "steps.jsonl", "belief.npz"}
SETTINGS = {"task": "mug-0", "seed": 3, "stop": {"fit": float("inf")}}


@pytest.fixture(scope="module")
def run():
    return make_up(6, particles=20)


def record(folder, run, *, finish=True):
    with RunRecorder(folder, SETTINGS, run.geometry) as recorder:
        for step in run.steps:
            recorder(step)
        if finish:
            recorder.finish(run.result)
    return folder


def assert_same(left, right, at=""):
    """Equal values, tensors byte by byte, whatever they are nested in."""
    if isinstance(left, torch.Tensor):
        assert torch.equal(left, right), at
        assert left.dtype == right.dtype, at
    elif hasattr(left, "__dataclass_fields__"):
        for field in fields(left):
            assert_same(getattr(left, field.name), getattr(right, field.name), f"{at}.{field.name}")
    elif isinstance(left, dict):
        assert list(left) == list(right), at
        for key in left:
            assert_same(left[key], right[key], f"{at}[{key!r}]")
    elif isinstance(left, float):
        assert left == right or (math.isnan(left) and (right is None or math.isnan(right))), at
    else:
        assert left == right, at


def test_what_is_written_is_read(tmp_path, run):
    read = load_run(record(tmp_path / "run", run))
    assert len(read.steps) == len(run.steps)
    for step, again in zip(run.steps, read.steps, strict=True):
        assert_same(replace(step, plan=None), replace(again, plan=None), f"step {step.step}")
        if step.plan is None:
            assert again.plan is None
            continue
        assert_same(step.plan.path, again.plan.path)
        assert step.plan.info == again.plan.info
        assert (step.plan.samples is None) == (again.plan.samples is None)
        if step.plan.samples is not None:
            assert_same(step.plan.samples.paths, again.plan.samples.paths)
            assert_same(step.plan.samples.costs, again.plan.samples.costs)
        for name, values in step.plan.fields.items():
            torch.testing.assert_close(values, again.plan.fields[name], rtol=1e-3, atol=1e-6)
    assert_same(run.geometry, read.geometry)
    assert_same(replace(run.result, belief=run.steps[-1].belief), read.result)
    assert read.settings["task"] == "mug-0"


def test_a_plan_of_several_actions_is_shared_as_it_was(tmp_path, run):
    steps = load_run(record(tmp_path / "run", run)).steps
    shared = [step.plan is before.plan for before, step in itertools.pairwise(run.steps)]
    assert [step.plan is before.plan for before, step in itertools.pairwise(steps)] == shared
    assert any(shared)


def test_twice_the_same_run_gives_the_same_bytes(tmp_path, run):
    first, second = (record(tmp_path / name, run) for name in "ab")
    for name in ("trace.npz", "belief.npz", "settings.json", "result.json"):
        assert (first / name).read_bytes() == (second / name).read_bytes(), name
    slower = [replace(step, timings_s={"plan": 9.0}) for step in run.steps]
    third = record(tmp_path / "c", replace(run, steps=slower))
    assert (first / "trace.npz").read_bytes() == (third / "trace.npz").read_bytes()
    for name, other in (
        (json.loads(line) for line in lines)
        for lines in zip(*((folder / "steps.jsonl").read_text().splitlines() for folder in (first, third)), strict=True)
    ):
        assert {**name, "timings_s": 0} == {**other, "timings_s": 0}


def test_the_belief_file_is_for_others(tmp_path, run):
    with np.load(record(tmp_path / "run", run) / "belief.npz", allow_pickle=False) as belief:
        last = run.steps[-1].belief
        np.testing.assert_array_equal(belief["poses"], last.world_T_object.numpy())
        np.testing.assert_array_equal(belief["log_weights"], last.log_weights.numpy())
        assert float(belief["stamp"]) == run.steps[-1].reading.stamp
        assert str(belief["frame"]) == "world"


def test_numpy_opens_a_finished_trace(tmp_path, run):
    with np.load(record(tmp_path / "run", run) / "trace.npz", allow_pickle=False) as trace:
        np.testing.assert_array_equal(trace["step_00002/belief/log_weights"], run.steps[2].belief.log_weights.numpy())


def test_every_step_can_be_read_while_the_run_goes_on(tmp_path, run):
    recorder = RunRecorder(tmp_path / "run", SETTINGS, run.geometry)
    assert load_run(tmp_path / "run").steps == []
    for count, step in enumerate(run.steps, start=1):
        recorder(step)
        assert len(load_run(tmp_path / "run").steps) == count
    recorder.close()


def test_a_killed_run_is_read_up_to_the_last_whole_step(tmp_path, run):
    whole = record(tmp_path / "run", run, finish=False)
    data = (whole / "trace.npz").read_bytes()
    generator = torch.Generator().manual_seed(0)
    cuts = torch.randint(200, len(data), (25,), generator=generator).sort().values.tolist()
    before = 0
    for cut in cuts:
        (whole / "trace.npz").write_bytes(data[:cut])
        read = load_run(whole)
        assert read.result is None
        assert before <= len(read.steps) <= len(run.steps)
        before = len(read.steps)
        if read.steps:
            assert_same(read.steps[-1].belief, run.steps[before - 1].belief)
    assert before > 0


def test_an_unfinished_run_says_so(tmp_path, run):
    read = load_run(record(tmp_path / "run", run, finish=False))
    assert read.result is None
    assert len(read.steps) == len(run.steps)
    assert (tmp_path / "run" / "belief.npz").exists()


def test_json_has_no_number_that_json_does_not_know(tmp_path, run):
    folder = record(tmp_path / "run", run)

    def refuse(name):
        raise AssertionError(name)

    for path in (folder / "settings.json", folder / "result.json"):
        json.loads(path.read_text(), parse_constant=refuse)
    settings = json.loads((folder / "settings.json").read_text())
    assert settings["stop"] == {"fit": None}
    assert settings["schema"] == SCHEMA
    assert settings["made_with"]["versions"]["torch"] == torch.__version__
    assert settings["made_with"]["processor"] == processor()._asdict()
    assert json.loads((folder / "result.json").read_text())["rotation_error_deg"] is None


def test_a_run_is_never_overwritten(tmp_path, run):
    folder = record(tmp_path / "run", run)
    before = (folder / "trace.npz").read_bytes()
    with pytest.raises(UsageError, match="holds a run already"):
        RunRecorder(folder, SETTINGS)
    assert (folder / "trace.npz").read_bytes() == before
    assert holds_run(folder)
    assert not holds_run(tmp_path)


def test_of_runs_at_once_one_has_the_folder(tmp_path, run, monkeypatch):
    """All have found it free when the first one takes it."""
    count = 6
    together = threading.Barrier(count)
    monkeypatch.setattr(folder_module, "provenance", lambda: {"passed": together.wait() >= 0})

    def start(number):
        try:
            with RunRecorder(tmp_path / "run", {"seed": number}) as recorder:
                recorder(run.steps[0])
        except UsageError as error:
            return str(error)
        return number

    with ThreadPoolExecutor(count) as pool:
        ended = list(pool.map(start, range(count)))
    assert sum("holds a run already" in str(one) for one in ended) == count - 1
    (owner,) = (one for one in ended if isinstance(one, int))
    assert load_run(tmp_path / "run").settings["seed"] == owner
    assert len(load_run(tmp_path / "run").steps) == 1
    assert {path.name for path in (tmp_path / "run").iterdir()} == WRITTEN


def test_a_file_system_without_links_keeps_runs_apart_too(tmp_path, monkeypatch):
    def refuse(*names):
        raise PermissionError(1, "no links here")

    monkeypatch.setattr(os, "link", refuse)
    new_file(tmp_path / "a", "first")
    with pytest.raises(FileExistsError):
        new_file(tmp_path / "a", "second")
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [("a", "first")]


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError])
def test_what_ends_before_its_first_step_leaves_nothing(tmp_path, run, error):
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "notes.txt").write_text("mine")
    for name, left in (("run", None), ("own", ["notes.txt"])):
        with pytest.raises(error), RunRecorder(tmp_path / name, SETTINGS, run.geometry) as recorder:
            write_json(recorder.folder / "object.json", {})
            raise error
        assert left == ([path.name for path in (tmp_path / name).iterdir()] if left else None)
    assert not (tmp_path / "run").exists()
    with pytest.raises(error), RunRecorder(tmp_path / "run", SETTINGS) as recorder:
        recorder(run.steps[0])
        raise error
    assert len(load_run(tmp_path / "run").steps) == 1


def full(*arguments, **named):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.parametrize("part", ["write_step", "write_geometry"])
def test_a_full_disk_says_where_and_an_empty_run_is_taken_away(tmp_path, run, monkeypatch, part):
    monkeypatch.setattr(folder_module, part, full)
    with pytest.raises(UsageError, match=r"Cannot write .*run: No space left"):
        record(tmp_path / "run", run)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("name", ["belief.npz", "a.json"])
def test_a_full_disk_leaves_no_half_file(tmp_path, run, monkeypatch, name):
    monkeypatch.setattr(TraceWriter, "array", full)
    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(UsageError, match=rf"Cannot write .*{name}: No space left"):
        if name == "a.json":
            write_json(tmp_path / name, {})
        write_belief(tmp_path / name, *run.steps[0].poses, stamp=0.0)
    assert list(tmp_path.iterdir()) == []


def test_an_unwritable_folder_is_refused(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(UsageError, match=r"Cannot write to the folder .*file"):
        RunRecorder(tmp_path / "file" / "run", SETTINGS)


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_without_permission_is_refused(tmp_path):
    closed = tmp_path / "closed"
    closed.mkdir()
    closed.chmod(stat.S_IRUSR | stat.S_IXUSR)
    with pytest.raises(UsageError, match="Cannot write to the folder"):
        RunRecorder(closed / "run", SETTINGS)


def test_what_is_no_run_is_named(tmp_path, run):
    with pytest.raises(UsageError, match="There is no run folder"):
        load_run(tmp_path / "nowhere")
    with pytest.raises(UsageError, match=r"is no run folder: it has no settings\.json"):
        load_run(tmp_path)
    folder = record(tmp_path / "run", run)
    write_json(folder / "settings.json", {"schema": SCHEMA + 1})
    with pytest.raises(UsageError, match="written by a newer rumi"):
        load_run(folder)
    (folder / "settings.json").write_text("{half")
    with pytest.raises(UsageError, match=r"settings\.json is damaged"):
        load_run(folder)


def test_a_damaged_trace_of_a_finished_run_is_named(tmp_path, run):
    folder = record(tmp_path / "run", run)
    data = bytearray((folder / "trace.npz").read_bytes())
    middle = len(data) // 2
    data[middle : middle + 400] = bytes(400)
    (folder / "trace.npz").write_bytes(data)
    with pytest.raises(UsageError, match="is damaged"):
        load_run(folder)


def test_numbers_that_are_not_finite_come_back_so(tmp_path, run):
    strange = replace(run.steps[0], apc=math.inf, nll=math.nan)
    with RunRecorder(tmp_path / "run", SETTINGS, run.geometry) as recorder:
        recorder(strange)
    (read,) = load_run(tmp_path / "run").steps
    assert math.isnan(read.apc)
    assert read.nll is None


def test_trace_refuses_objects_and_keeps_scalars(tmp_path):
    with TraceWriter(tmp_path / "t.npz") as trace:
        trace.array("scalar", np.asarray(2.5))
        trace.array("none", np.zeros((0, 3), np.float32))
        with pytest.raises(ValueError, match="pickle"):
            trace.array("object", np.array([{}]))
    read = read_trace(tmp_path / "t.npz")
    assert read["scalar"].shape == () and read["scalar"] == 2.5
    assert read["none"].shape == (0, 3)


@pytest.mark.parametrize("compress", [True, False])
def test_a_member_whose_header_was_never_mended_is_left_out(tmp_path, monkeypatch, compress):
    path = tmp_path / "t.npz"
    found = []
    mended = zipfile.ZipInfo.FileHeader

    def kept(member, zip64=None):
        trace.flush()  # what a kill would leave before the header is written over
        found.append(path.read_bytes())
        return mended(member, zip64)

    with TraceWriter(path) as trace:
        trace.array("whole", np.arange(50.0), compress=compress)
        monkeypatch.setattr(zipfile.ZipInfo, "FileHeader", kept)
        trace.array("cut", np.arange(50.0), compress=compress)
        monkeypatch.undo()
    assert len(found) == 2  # before the first header, and before it is mended
    path.write_bytes(found[1])
    read = read_trace(path)
    assert list(read) == ["whole"]
    np.testing.assert_array_equal(read["whole"], np.arange(50.0))


def test_plain_refuses_what_json_cannot_hold():
    with pytest.raises(TypeError, match="got object"):
        plain({"a": [object()]})
    assert plain({"a": torch.tensor([1.0, math.nan])}) == {"a": [1.0, None]}


@pytest.mark.parametrize("steps", ["1e999", '"two"', "null", "[]"])
def test_a_result_of_steps_that_are_no_number_is_damaged(tmp_path, run, steps):
    folder = record(tmp_path / "run", run)
    path = folder / "result.json"
    text = path.read_text()
    damaged = re.sub(r'"steps": \d+', f'"steps": {steps}', text)
    assert damaged != text
    path.write_text(damaged)
    with pytest.raises(UsageError, match=r"result.json is damaged"):
        load_run(folder)
