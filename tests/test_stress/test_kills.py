"""Kills, a disk that is full, a folder that cannot be written, two writers: nothing half-written is believed."""

import json
import os
import resource
import shutil
import signal
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from rumi import exit_codes
from rumi.errors import UsageError
from rumi.robot import reach_table
from rumi.robot.reach_table import ReachSettings, ReachTable
from rumi.runs.folder import RunRecorder, load_run, write_json
from rumi.runs.jsonlines import append_line, read_lines
from rumi.sim.settings import SimSettings
from rumi.tasks.rummage.scenes import find_task, make_tool
from sdf.cache import keep_arrays, load_arrays, save_arrays
from tests.stress import killed_checks, killed_commands, kills, pairs
from tests.stress.killed_commands import kill_commands
from tests.stress.kills import kill_many
from tests.stress.made_run import made_steps
from tests.stress.pairs import run_pairs
from tests.stress.processes import Commands

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="kills by signal")


def test_kills_leave_what_was_written(tmp_path):
    found = kill_many(12, tmp_path, seed=1)
    assert found.wrong == []
    assert sum(found.kills.values()) >= 12
    assert set(found.kills) == set(kills.WRITERS)


def test_a_writer_that_writes_in_place_is_caught(tmp_path, monkeypatch):
    def careless(folder, number, say):
        values = {"a": np.zeros((400, 400)), "b": np.zeros(7)}
        while True:
            np.savez(folder / "cache-0.npz", **values)

    monkeypatch.setattr(kills, "WRITERS", {"cache": careless})
    assert kill_many(12, tmp_path).wrong


def in_a_child(work):
    """Exit code of a function in a process of its own, whose files may not grow beyond 20 kB: as on a full disk."""
    pid = os.fork()
    if pid == 0:
        code = 1
        try:
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
            resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
            code = work()
        finally:
            os._exit(code)
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])


def test_a_full_disk_keeps_the_old_cache_and_leaves_nothing_else(tmp_path):
    path = tmp_path / "a.npz"
    save_arrays(path, {"a": np.ones(3)})

    def work():
        keep_arrays(path, {"a": np.zeros(10**5)})
        return 7

    assert in_a_child(work) == 7
    assert load_arrays(path, ("a",))["a"].tolist() == [1.0] * 3
    assert os.listdir(tmp_path) == ["a.npz"]


def test_a_full_disk_leaves_a_run_up_to_there(tmp_path):
    def work():
        said = 0
        with RunRecorder(tmp_path / "run", {"seed": 0}) as recorder:
            for step in made_steps(points=60, particles=20):
                try:
                    recorder(step)
                except UsageError as error:
                    assert f"Cannot write {tmp_path / 'run'}: File too large" in str(error)
                    return said
                said += 1
        return 0

    written = in_a_child(work)
    assert written > 0
    assert len(load_run(tmp_path / "run").steps) >= written


def test_a_full_disk_keeps_the_old_lines_and_results(tmp_path):
    append_line(tmp_path / "lines.jsonl", {"k": 0})
    write_json(tmp_path / "a.json", {"k": 0})

    def work():
        for write in (lambda: append_line(tmp_path / "lines.jsonl", {"k": "x" * 10**5}),
                      lambda: write_json(tmp_path / "a.json", {"k": "x" * 10**5})):  # fmt: skip
            try:
                write()
            except UsageError:
                continue
            return 1
        return 7

    assert in_a_child(work) == 7
    assert [line for line, _ in read_lines(tmp_path / "lines.jsonl")] == [{"k": 0}]
    append_line(tmp_path / "lines.jsonl", {"k": 1})
    assert [line for line, _ in read_lines(tmp_path / "lines.jsonl")] == [{"k": 0}, {"k": 1}]
    assert json.loads((tmp_path / "a.json").read_text()) == {"k": 0}


@pytest.mark.sim
def test_runs_at_once_have_a_folder_each(tmp_path, cache):
    found = run_pairs(2, tmp_path, cache=cache)
    assert found.wrong == []
    assert (found.pairs, found.refused) == ({pairs.NAMED: 1, pairs.DEFAULT: 1}, 1)


def test_a_run_that_is_not_as_it_was_is_caught(tmp_path):
    for name in ("whole", "run"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "steps.jsonl").write_text("{}\n")
    pairs.check_same(tmp_path / "run", tmp_path / "whole")
    (tmp_path / "run" / "steps.jsonl").write_text("")
    with pytest.raises(AssertionError, match="Expected 1 steps"):
        pairs.check_same(tmp_path / "run", tmp_path / "whole")
    (tmp_path / "run" / ".part").write_text("")
    with pytest.raises(AssertionError, match=r"got \['\.part', 'steps\.jsonl'\]"):
        pairs.check_same(tmp_path / "run", tmp_path / "whole")


def test_a_cache_that_cannot_be_written_is_done_without(tmp_path, monkeypatch, caplog):
    (tmp_path / "file").write_text("")
    solved = ReachTable(torch.zeros(141, 61).double(), torch.zeros(141, 61).double())
    monkeypatch.setattr(reach_table, "solve_table", lambda settings: solved)
    found = reach_table.reach_table(ReachSettings(), cache_dir=tmp_path / "file" / "below")
    assert found is solved
    assert "cannot be kept" in caplog.text


@pytest.fixture(scope="module")
def commands():
    with Commands() as made:
        yield made


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    """A folder that keeps the arm's reach as zeros: to solve it takes seconds."""
    folder = tmp_path_factory.mktemp("caches")
    with pytest.MonkeyPatch.context() as patch:
        zeros = torch.zeros(reach_table.table_shape(ReachSettings())).double()
        patch.setattr(reach_table, "solve_table", lambda settings: ReachTable(zeros, zeros))
        make_tool(find_task(killed_commands.TASK), SimSettings(), cache_dir=folder)
    assert len(list(folder.glob("reach-*.npz"))) == 1
    return folder


@pytest.fixture(scope="module")
def kind(commands, cache, tmp_path_factory):
    return killed_commands.RunKind(commands, tmp_path_factory.mktemp("runs"), cache)


@pytest.mark.sim
def test_a_killed_run_leaves_the_steps_that_it_had_said(kind):
    """Each turn that is killed in time is looked at; where the machine was quicker, the next one is tried."""
    random = np.random.default_rng(1)
    killed = 0
    for number in range(30):
        killed += kind.turn(random, number)
        if killed == 2:
            return
    pytest.fail(f"Expected 2 of 30 runs to be killed before their end, got {killed}")


def test_a_command_that_ends_before_its_moment_counts_for_none(commands, cache, tmp_path):
    command = commands.begin(["--version"], tmp_path, "it", cache=cache)
    assert not command.kill_after(100.0)
    assert command.out.read_text().startswith("rumi ")
    hanging = commands.begin(["reproduce", "fig8", "--seeds", "1000-1099", "--no-figures"], tmp_path, "on", cache=cache)
    assert hanging.kill_after(0.1)
    with pytest.raises(AssertionError, match="ended with 2: rumi: There is no command"):
        commands.begin(["no-such"], tmp_path, "no", cache=cache).finish((0,))


@pytest.mark.sim
def test_steps_that_are_lost_or_others_are_missed(kind, tmp_path):
    whole = tmp_path / "whole"
    shutil.copytree(kind.whole.folder, whole)
    killed_checks.check_run(whole, 4, kind.whole)
    with pytest.raises(AssertionError, match="of 5 steps 4 are left"):
        killed_checks.check_run(whole, 5, kind.whole)
    steps = kind.whole.steps
    other = replace(kind.whole, steps=[steps[1], *steps[1:]])
    with pytest.raises(AssertionError, match="step 0 is not that"):
        killed_checks.check_run(whole, 0, other)
    trace = whole / "trace.npz"
    trace.write_bytes(trace.read_bytes()[: trace.stat().st_size // 2])
    (whole / "result.json").unlink()
    killed_checks.check_run(whole, 0, kind.whole)
    with pytest.raises(AssertionError, match="of 4 steps"):
        killed_checks.check_run(whole, 4, kind.whole)


@pytest.mark.sim
@pytest.mark.parametrize("grow", [3000, 60_000, 300_000])
def test_a_command_on_a_full_disk_says_so_and_leaves_its_steps(kind, commands, cache, tmp_path, grow):
    asked = [*killed_commands.RUN, "--out", "run"]
    command = commands.begin(asked, tmp_path, "run", cache=cache, grow=grow)
    command.finish((exit_codes.BAD_INPUT,))
    said = command.err.read_text()
    assert "File too large" in said
    steps = sum(line.startswith(("first view:", "action ")) for line in said.splitlines())
    killed_checks.check_run(tmp_path / "run", steps, kind.whole)


@pytest.mark.sim
@pytest.mark.slow
def test_commands_killed_in_turn(tmp_path):
    found = kill_commands(14, tmp_path, seed=1)
    assert found.wrong == []
    assert set(found.kills) == set(killed_commands.ORDER)
