"""The store and the driver that all experiments share, on one made up."""

import json

import pytest

from rumi.errors import UsageError
from scripts import store
from scripts.experiment import Experiment
from scripts.reproduce import code, same_code
from scripts.store import Store, median_seconds


def measure(kind, seed, size):
    return {"kind_seen": kind, "product": seed * size}


def show(lines, chosen):
    return "\n".join(f"{line['kind']} {line['seed']} {line['product']}" for line in lines)


@pytest.fixture
def made(tmp_path):
    experiment = Experiment(
        "made up", "unused.jsonl", {"kind": ("a", "b", "slow")}, measure, show,
        seeds="3-4", usual={"kind": ("a", "b")}, parameters={"size": 2}, identity=lambda variant: {"code": "c0"},
        possible=lambda variant: (variant["kind"], variant["seed"]) != ("b", 4),
    )  # fmt: skip
    path = tmp_path / "results.jsonl"

    def run(*arguments):
        experiment.main([*arguments, "--results", str(path)])
        return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []

    return run


def test_each_is_measured_once_and_shown(made, capsys):
    lines = made("run")
    assert [(line["settings"]["kind"], line["settings"]["seed"]) for line in lines] == [("a", 3), ("b", 3), ("a", 4)]
    assert lines[0]["settings"] == {"kind": "a", "size": 2, "seed": 3, "code": "c0"}
    assert made("run") == lines
    capsys.readouterr()
    made("show", "--seeds", "3", "--kinds", "b")
    assert capsys.readouterr().out == "b 3 6\n"
    more = made("run", "--kinds", "slow", "--size", "5", "--seeds", "7", "--jobs", "2")
    assert more[:3] == lines and more[3]["figures"] == {"kind_seen": "slow", "product": 35}
    assert made("run", "--seeds", "8", "--seconds", "-1") == more


def test_what_there_is_not_is_named(made):
    with pytest.raises(UsageError, match="There is no kind 'c'; there are a, b, slow"):
        made("run", "--kinds", "c")


def test_a_line_cut_off_is_measured_again_and_lines_of_older_files_count(tmp_path):
    path = tmp_path / "a.jsonl"
    path.write_text('{"kind": "a", "seed": 3, "product": 1}\n{"settings": {"kind": "b"}, "figu')
    kept = Store(path)
    assert kept.has({"kind": "a", "seed": 3}) and not kept.has({"kind": "a", "seed": 4})
    assert kept.measure({"kind": "b"}, lambda: {"product": 2}) and not kept.measure({"kind": "b"}, dict)
    assert not kept.has({"seed": 3, "kind": "b"})  # of a line by parts, all settings count
    assert [line["product"] for line in Store(path).flat()] == [1, 2]


def test_what_fails_leaves_no_line(tmp_path):
    with pytest.raises(RuntimeError):
        Store(tmp_path / "a.jsonl").measure({"part": "a"}, lambda: (_ for _ in ()).throw(RuntimeError()))
    assert not (tmp_path / "a.jsonl").exists()


def test_results_of_the_same_code_count(tmp_path, monkeypatch):
    path = tmp_path / "a.jsonl"
    for module in (code, same_code):
        monkeypatch.setattr(module, "SAME_CODE", tmp_path / "same_code.json")
    monkeypatch.setattr(same_code, "code_of", lambda kind: present)
    Store(path).add({"seed": 1, "code": "first"}, {"product": 1})
    present = "second"
    same_code.enter("run", "first")
    assert Store(path).has({"seed": 1, "code": "second"}) and not Store(path).has({"seed": 1, "code": "first"})
    present = "third"
    same_code.enter("run", "second")
    assert Store(path).flat()[0]["code"] == "third"
    present = "first"  # and back again
    same_code.enter("run", "third")
    assert Store(path).flat()[0]["code"] == "first"
    code.same_code.cache_clear()


def test_nothing_is_entered_where_the_golden_runs_differ(tmp_path, monkeypatch):
    monkeypatch.setattr(same_code, "SAME_CODE", tmp_path / "same_code.json")
    monkeypatch.setattr(
        same_code.subprocess, "run", lambda command, **_: same_code.subprocess.CompletedProcess(command, 1)
    )
    monkeypatch.setattr("sys.argv", ["same_code", "toy", "0" * 12])
    with pytest.raises(SystemExit) as end:
        same_code.main()
    assert end.value.code == 1 and not same_code.SAME_CODE.exists()


def test_seconds_are_the_median_of_calls_within_a_budget(monkeypatch):
    passed = iter([0.0, 1.0, 1.0, 1.4, 1.4, 2.0, 2.0, 2.5])
    monkeypatch.setattr(store, "clock", lambda: next(passed))
    assert median_seconds(lambda: None, repeats=3, budget_s=9.0) == pytest.approx(0.5)
