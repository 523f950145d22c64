import json
import subprocess
import sys
import types
from pathlib import Path

import pytest
import torch

from rumi import exit_codes
from rumi.bench import command, history
from rumi.bench.case import CASES, Setup
from rumi.cli import main

ROOT = Path(__file__).resolve().parent.parent.parent
SOME = ("distance-mug", "kmppi-toy")


@pytest.fixture(autouse=True)
def small(at_home, monkeypatch):
    """In a folder of its own, with everything tiny and without the peers."""

    def tiny(device, **more):
        return Setup(device, tiny=True, **more | {"without_peers": "not asked for"})

    monkeypatch.setattr(command, "Setup", tiny)
    monkeypatch.setattr(command, "QUICK", (0.0, 3))


def test_times_what_is_asked_for(capsys):
    assert main(["bench", "--quick", "--only", *SOME, "--json", "out/bench.jsonl"]) == exit_codes.DONE
    said = capsys.readouterr()
    assert [line.split(":")[0] for line in said.out.splitlines() if line.startswith(SOME)] == list(SOME)
    assert "targets met" in said.out
    (run,) = history.read(Path("out/bench.jsonl"))
    assert [case["name"] for case in run["cases"]] == list(SOME)
    assert run["quick"] and run["machine"]["threads"] == torch.get_num_threads()
    rows = run["cases"][0]["variants"]
    assert rows[0]["name"] == "torch" and rows[0]["median_s"] > 0 and rows[0]["samples"] >= 3
    assert rows[0]["ran"]["posed_distance"] == "torch"


def test_threads_are_set_and_set_back(capsys):
    before = torch.get_num_threads()
    assert main(["bench", "--quick", "--only", "reach-mug", "--threads", "2", "--json", "a.json"]) == exit_codes.DONE
    assert json.loads(Path("a.json").read_text())["machine"]["threads"] == 2
    assert torch.get_num_threads() == before


def test_a_doctored_line_is_flagged(capsys):
    file = Path("bench.jsonl")
    assert main(["bench", "--quick", "--only", "rollouts", "--json", str(file)]) == exit_codes.DONE
    (run,) = history.read(file)

    def doctored(factor):
        """As if rumi's versions had taken so many times as long."""
        for row in run["cases"][0]["variants"]:
            row["least_s"] *= factor if row["by"] == "rumi" else 1.0
        file.write_text(json.dumps(run) + "\n")

    doctored(1e3)
    assert main(["bench", "--quick", "--only", "rollouts", "--against", str(file)]) == exit_codes.DONE
    assert "0 of 2 variants became worse" in capsys.readouterr().out
    doctored(1e-6)
    assert main(["bench", "--quick", "--only", "rollouts", "--against", str(file)]) == command.WRONG
    shown = capsys.readouterr().out
    assert "WORSE rollouts, torch" in shown and "WORSE rollouts, numba" in shown
    assert "2 of 2 variants became worse by over 20 %" in shown


def test_a_disagreement_is_an_error(monkeypatch, capsys):
    from dataclasses import replace

    make = CASES["distance-mug"]
    monkeypatch.setitem(CASES, "distance-mug", lambda setup: replace(make(setup), tolerance=-1.0))
    assert main(["bench", "--quick", "--only", "distance-mug"]) == command.WRONG
    assert "DIFFER" in capsys.readouterr().out


def test_an_interrupt_keeps_what_was_measured(monkeypatch, capsys):
    def interrupt(setup):
        raise KeyboardInterrupt

    monkeypatch.setitem(CASES, "kmppi-toy", interrupt)
    assert main(["bench", "--quick", "--only", *SOME, "reach-mug", "--json", "bench.jsonl"]) == exit_codes.INTERRUPTED
    (run,) = history.read(Path("bench.jsonl"))
    assert [case["name"] for case in run["cases"]] == ["distance-mug"]
    assert "kept what was measured: distance-mug" in capsys.readouterr().err


def test_a_page(capsys):
    assert main(["bench", "--quick", "--only", "reach-mug", "--markdown"]) == exit_codes.DONE
    shown = capsys.readouterr().out
    assert "| variant | median |" in shown and "**reach-mug**" in shown


def test_what_is_not_installed_is_left_out(monkeypatch, capsys):
    def lacking(setup):
        raise ModuleNotFoundError("No module named 'mujoco'", name="mujoco")

    monkeypatch.setitem(CASES, "plan-mug", lacking)
    assert main(["bench", "--quick", "--only", "plan-mug"]) == exit_codes.DONE
    assert "left out plan-mug: No module named 'mujoco'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--only", "field-mgu"], "There is no case 'field-mgu'; the cases are distance-mug, distance-box"),
        (["--json", "file/bench.json"], "Cannot write file/bench.json"),
        (["--json", "folder"], "Cannot write folder: it is a folder"),
        (["--pareto", "--out", "file"], "Cannot write to the folder file"),
        (["--scaling", "--out", "file/bench"], "Cannot write to the folder file/bench"),
        (["--against", "none.jsonl"], "Cannot read none.jsonl"),
        (["--threads", "0"], "Expected threads to be 1 or more, got 0"),
        (["--threads", "x"], "--threads"),
        (["--pareto", "--only", "reach-mug"], "leave them out with --pareto"),
        (["--fast"], "--fast"),
    ],
)
def test_bad_input_is_named_before_anything_is_timed(arguments, message, capsys, monkeypatch):
    Path("file").write_text("in the way")
    Path("folder").mkdir()
    for work in ("_carry_out", "_studies"):
        monkeypatch.setattr(command, work, lambda *a, **k: pytest.fail("timed"))
    assert main(["bench", *arguments]) == exit_codes.BAD_INPUT
    said = capsys.readouterr()
    assert message in said.err
    assert "Traceback" not in said.err


@pytest.mark.parametrize("name", ["pareto", "scaling"])
def test_studies_get_what_they_need(name, monkeypatch):
    asked = []
    study = types.SimpleNamespace(run=lambda **options: asked.append(options))
    monkeypatch.setitem(sys.modules, f"rumi.bench.{name}", study)
    assert main(["bench", f"--{name}", "--quick", "--out", "here", "--json", "lines.jsonl"]) == exit_codes.DONE
    assert asked == [{"quick": True, "out": Path("here"), "jsonl": Path("lines.jsonl")}]


def test_importing_rumi_loads_no_benchmarks():
    code = "import sys, rumi; assert not any(name.startswith('rumi.bench') for name in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
