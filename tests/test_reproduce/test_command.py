"""`rumi reproduce`: what it refuses, does once, goes on with, and leaves behind however it ends."""

import re
from pathlib import Path

import pytest

from rumi import exit_codes
from rumi.cli import main
from rumi.errors import UsageError
from rumi.runs.jsonlines import read_lines
from scripts.reproduce import command, experiments, toy, worker
from scripts.reproduce.jobs import KINDS
from scripts.reproduce.records import Records
from scripts.reproduce.worker import Errand

pytestmark = pytest.mark.usefixtures("at_home")

ROOT = Path(__file__).resolve().parents[2]
FEW = ("reproduce", "fig8", "--seeds", "1000-1001", "--no-figures")


@pytest.fixture
def quick(monkeypatch):
    """A toy that is done at once, and a count of how often."""
    calls = []

    def carry_out(job, cache_dir):
        calls.append((job.method, job.seed))
        names = ("cost", "change", "jerk", "end_distance", "plan_cost", "plan_change", "plan_jerk")
        figures = dict.fromkeys(names, 1.0)
        curves = {name: [float(job.seed), 1.0] for name in ("path_x", "path_y", "plan_x", "plan_y")}
        return {"figures": figures, "timings": {"wall_s": 0.5}, "curves": curves}

    monkeypatch.setitem(KINDS, "toy", carry_out)
    return calls


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "Which experiment. There are table5"),
        (["table9"], "no experiment 'table9'; there are table5.*all"),
        (["table5", "--tasks", "mug-9"], "no task 'mug-9'; there are mug-0"),
        (["table5", "--methods", "magic"], "no method 'magic'; there are rumi"),
        (["table5", "--presets", "best"], "no preset 'best'; there are default"),
        (["table5", "--seeds", "9-0"], "Expected seeds such as 0-9"),
        (["fig8", "--jobs", "0"], "Expected jobs to be 1 or more, got 0"),
        (["fig8", "--shard", "3/2"], "Expected shard to be i/n"),
        (["fig8", "--executor", "cloud"], "executor"),
        (["fig8", "--slurm", "a=1"], "--slurm is about --executor submitit"),
        (["fig8", "--executor", "submitit", "--slurm", "alone"], "Expected --slurm name=value"),
        (["fig8", "--code", "abc"], "give --show with it"),
        (["fig8", "--show"], "There are no results in"),
        (["table5", "--set", "planner.rolouts=3"], "Expected a setting and its value"),
        (["table5", "--set", "planner.rollouts=0"], "rollouts to be 1 or more"),
        (["fig8", "--results", "."], "Cannot write"),
        (["fig8", "--markdown", "."], "Cannot write .: it is a folder"),
        (["fig8", "--markdown", "file/page.md"], "Cannot write file/page.md"),
        (["fig8", "--markdown", "page"], "Expected --markdown to have an ending, such as page.md, got page"),
        (["fig8", "--out", "file", "--results", "runs.jsonl"], "Cannot write to the folder file/figures"),
        (["fig8", "--nonsense", "1"], "nonsense"),
    ],
)
def test_refuses(arguments, message, capsys, quick):
    Path("file").write_text("in the way")
    assert main(["reproduce", *arguments]) == exit_codes.BAD_INPUT
    said = capsys.readouterr()
    assert "Traceback" not in said.err
    assert re.search(message, " ".join((said.err + said.out).split()))
    assert quick == []


def test_what_is_done_is_not_done_again(capsys, quick):
    assert main([*FEW]) == exit_codes.DONE
    first = capsys.readouterr()
    assert sorted(quick) == sorted((method, seed) for method in toy.SETTINGS for seed in (1000, 1001))
    assert first.err == "" and "| KMPPI | 2 | 1 [1, 1] |" in first.out
    assert main([*FEW]) == exit_codes.DONE
    assert len(quick) == 6
    assert capsys.readouterr().out == first.out
    assert main(["reproduce", "fig8", "--seeds", "1001-1002", "--no-figures"]) == exit_codes.DONE
    assert len(quick) == 9
    assert len(Records(Path("runs/reproduce/runs.jsonl")).every) == 9


def test_other_code_does_it_again(monkeypatch, quick):
    assert main([*FEW]) == exit_codes.DONE
    monkeypatch.setattr("scripts.reproduce.jobs.code_of", lambda kind: "another")
    assert main([*FEW]) == exit_codes.DONE
    assert len(quick) == 12


def test_shards_together_are_the_whole(capsys, quick):
    for k in (1, 2, 3):
        assert main([*FEW, "--shard", f"{k}/3"]) == exit_codes.DONE
    assert len(quick) == 6
    shards = capsys.readouterr().out
    assert main([*FEW]) == exit_codes.DONE
    assert len(quick) == 6
    assert shards.endswith(capsys.readouterr().out)


def test_an_error_is_no_result_and_is_tried_again(capsys, monkeypatch, quick):
    good, seen = KINDS["toy"], []

    def bad(job, cache_dir):
        seen.append(job.seed)
        if (job.method, job.seed) == ("SMPPI", 1001):
            raise RuntimeError("out of luck")
        return good(job, cache_dir)

    monkeypatch.setitem(KINDS, "toy", bad)
    assert main([*FEW]) == command.FAILED
    assert "rumi: toy, SMPPI, seed 1001 failed: RuntimeError: out of luck" in capsys.readouterr().err
    assert len(seen) == 6 and len(Records(Path("runs/reproduce/runs.jsonl")).every) == 5
    (error,) = (line for line, _ in read_lines(Path("runs/reproduce/.runs.errors.jsonl")))
    assert "Traceback" in error["traceback"] and error["work"] == "toy, SMPPI, seed 1001"
    monkeypatch.setitem(KINDS, "toy", good)
    assert main([*FEW]) == exit_codes.DONE
    assert len(Records(Path("runs/reproduce/runs.jsonl")).every) == 6


def test_what_a_process_could_not_go_on_with_is_said(tmp_path, monkeypatch):
    errand = Errand((), tmp_path / "a.jsonl", {}, tmp_path, "now")
    monkeypatch.setattr(worker, "work", lambda *_: (_ for _ in ()).throw(UsageError("the code changed")))
    worker.work_until_parent_ends(errand, 0, 2)
    with pytest.raises(UsageError, match="the code changed"):
        worker.failures(errand)
    later = Errand((), tmp_path / "a.jsonl", {}, tmp_path, "later")
    assert worker.failures(later) == {}


def test_code_that_changed_is_not_taken_for_the_one_asked_for(tmp_path):
    (job,) = experiments.work_of(["fig8"], experiments.Selection(seeds=(1,)))[:1]
    with pytest.raises(UsageError, match=r"The code changed since .* \(of toy\)"):
        worker.work(Errand((job,), tmp_path / "a.jsonl", {"toy": "another"}, tmp_path, "now"))
    assert not (tmp_path / "a.jsonl").exists()


def test_an_interrupt_keeps_what_is_done(capsys, monkeypatch, quick):
    good = KINDS["toy"]

    def interrupted(job, cache_dir):
        if len(quick) == 4:
            raise KeyboardInterrupt
        return good(job, cache_dir)

    monkeypatch.setitem(KINDS, "toy", interrupted)
    assert main([*FEW]) == exit_codes.INTERRUPTED
    assert len(Records(Path("runs/reproduce/runs.jsonl")).every) == 4
    monkeypatch.setitem(KINDS, "toy", good)
    assert main([*FEW]) == exit_codes.DONE
    assert len(quick) == 6


def test_show_runs_nothing(capsys, quick):
    assert main([*FEW]) == exit_codes.DONE
    ran = capsys.readouterr().out
    assert main([*FEW, "--show"]) == exit_codes.DONE
    assert capsys.readouterr().out == ran
    assert main(["reproduce", "fig8", "--no-figures", "--show", "--seeds", "5"]) == exit_codes.DONE
    assert "| KMPPI" not in capsys.readouterr().out
    assert len(quick) == 6
