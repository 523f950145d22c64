"""`rumi reproduce` in processes of its own: killed, interrupted, shared, handed to a cluster; and on a real task."""

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from rumi import exit_codes
from rumi.cli import main
from rumi.runs.jsonlines import read_lines
from scripts.reproduce.records import Records

pytestmark = pytest.mark.usefixtures("at_home")

ROOT = Path(__file__).resolve().parents[2]


def start(*arguments, **changes):
    """The command in a process of its own, in a group of its own."""
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    return subprocess.Popen(
        [sys.executable, "-m", "rumi", "reproduce", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
        start_new_session=True,
        **changes,
    )


def finish(process):
    out, err = process.communicate(timeout=300)
    assert process.returncode == exit_codes.DONE, err
    return out


def results(folder):
    """What is kept, timings apart, by id; every id once."""
    lines = [line for line, _ in read_lines(Path(folder) / "runs.jsonl")]
    found = {line["id"]: {name: line[name] for name in ("figures", "curves", "method", "seed")} for line in lines}
    assert len(found) == len(lines)
    return found


def wait_for(path, lines):
    """Until a file has some lines."""
    for _ in range(600):
        if path.exists() and path.read_bytes().count(b"\n") >= lines:
            return
        time.sleep(0.05)
    raise AssertionError(f"{path} never had {lines} lines")


SMALL = (
    *("steps=2", "initialise.particles=12", "initialise.starts=40", "initialise.polished=12"),
    *("planner.mppi.samples=8", "planner.mppi.warmup_iterations=1", "planner.rollouts=1"),
)
SHORT_RUNS = ("table6", "--tasks", "mug-0", "--methods", "rumi", "info-only", "--presets", "default", "--set", *SMALL)


@pytest.mark.slow
@pytest.mark.parametrize("what", [("fig8",), pytest.param(SHORT_RUNS, marks=pytest.mark.sim)], ids=["toy", "runs"])
def test_killed_five_times_the_end_is_the_same(what):
    seeds, pieces = ("1000-1013", 42) if what == ("fig8",) else ("1000-1011", 24)
    asked = (*what, "--seeds", seeds, "--no-figures", "--jobs", "2")
    whole = finish(start(*asked, "--out", "undisturbed"))
    chance = random.Random(5)
    path = Path("disturbed/runs.jsonl")
    for kill in range(5):
        process = start(*asked, "--out", "disturbed")
        wait_for(path, 1 + pieces // 10 * kill)
        time.sleep(chance.uniform(0.0, 0.8))
        process.kill()  # and with it the processes that it started
        process.communicate()
        time.sleep(1.0)
        before = path.read_bytes()
        time.sleep(1.0)
        assert path.read_bytes() == before, "a worker outlived its command"
        if kill % 2:  # as if the kill had come while a line was being written
            path.write_bytes(before[: -chance.randrange(2, 400)])
    assert 0 < len(list(read_lines(path))) < pieces
    assert finish(start(*asked, "--out", "disturbed")) == whole
    assert results("disturbed") == results("undisturbed")
    assert len(results("disturbed")) == pieces


@pytest.mark.slow
def test_what_a_killed_worker_was_doing_another_does():
    asked = ("fig8", "--seeds", "1000-1009", "--no-figures", "--out", "shared", "--jobs", "2")
    process = start(*asked)
    listing = Path(f"/proc/{process.pid}/task/{process.pid}/children")
    if not listing.exists():
        process.kill()
        pytest.skip("this system does not list the children of a process")
    wait_for(Path("shared/runs.jsonl"), 2)
    workers = [
        int(child)
        for child in listing.read_text().split()
        if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes()
    ]
    assert len(workers) == 2
    os.kill(workers[0], signal.SIGKILL)
    finish(process)
    assert len(results("shared")) == 30


@pytest.mark.slow
def test_two_commands_at_once_share_the_work():
    asked = ("fig8", "--seeds", "1000-1009", "--no-figures", "--out", "shared")
    both = [start(*asked), start(*asked, "--jobs", "2")]
    first, second = map(finish, both)
    assert first == second
    assert len(results("shared")) == 30  # each once


@pytest.mark.slow
@pytest.mark.parametrize("jobs", [1, 2])
def test_ctrl_c_leaves_what_is_done(jobs):
    process = start("fig8", "--seeds", "1000-1099", "--out", "stopped", "--jobs", str(jobs))
    wait_for(Path("stopped/runs.jsonl"), 3)
    os.killpg(process.pid, signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert process.returncode == exit_codes.INTERRUPTED
    assert out == "" and err == "rumi: interrupted\n"
    kept = results("stopped")
    assert 3 <= len(kept) < 300
    time.sleep(1.0)
    assert results("stopped") == kept


@pytest.mark.slow
def test_jobs_of_a_cluster(tmp_path):
    """By submitit's local executor, which hands the same pickles to processes of this machine."""
    pytest.importorskip("submitit")
    asked = ("fig8", "--seeds", "1000-1003", "--no-figures", "--out", "cluster")
    out = finish(start(*asked, "--executor", "submitit", "--jobs", "2", "--slurm", "timeout_min=5"))
    assert len(results("cluster")) == 12
    assert list(Path("cluster/submitit").glob("*result.pkl"))
    assert finish(start(*asked)) == out
    finish(start("fig8", "--seeds", "1000-1003", "--no-figures", "--out", "here"))
    assert results("here") == results("cluster")


@pytest.mark.sim
def test_runs_of_a_task(capsys):
    asked = ("--tasks", "mug-0", "--methods", "rumi", "info-only", "--presets", "default", "--seeds", "1000")
    assert main(["reproduce", "table5", "table7", "fig13", *asked, "--set", *SMALL]) == exit_codes.DONE
    said = capsys.readouterr().out
    first, second = Records(Path("runs/reproduce/runs.jsonl")).every
    assert (first.method, second.method) == ("rumi", "info-only")
    assert first.figures["steps"] == first.figures["allowed"] == 2
    assert [len(values) for values in first.curves.values()] == [3, 3, 3]
    assert first.figures["cumulative_nll"] == pytest.approx(sum(first.curves["nll"]), rel=1e-4)
    assert first.figures["apc"] == pytest.approx(first.curves["apc"][-1], rel=1e-4)
    assert first.timings["plans"] == 2 and first.timings["planning_s"]["dynamics"] > 0
    assert first.curves["nll"][0] == second.curves["nll"][0]  # the same first view
    for word in (f"rumi/default {' '.join(sorted(SMALL))}", "dynamics", "figures/fig13-default.png"):
        assert word in said
    again = main(["reproduce", "table5", *asked, "--set", *SMALL])
    assert again == exit_codes.DONE and len(Records(Path("runs/reproduce/runs.jsonl")).every) == 2
