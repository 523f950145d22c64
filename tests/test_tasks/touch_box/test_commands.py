"""`rumi run touch-box` and `rumi reproduce touch-...`, on the quasi-static robot."""

import json
from pathlib import Path

import pytest

pytest.importorskip("mujoco")

from rumi.cli import main
from rumi.exit_codes import BAD_INPUT, DONE, INTERRUPTED, NOT_CONVERGED
from rumi.runs.jsonlines import read_lines
from rumi.tasks.grasp_table import clearance_table


@pytest.fixture(autouse=True)
def quick(monkeypatch, tmp_path):
    """The grasps' table is simulated elsewhere; runs write where nothing else is."""
    monkeypatch.setattr("rumi.tasks.touch_box.grasps.grasp_table", lambda *a, **k: clearance_table(0.03, 0.08, 0.08))
    monkeypatch.setenv("RUMI_CACHE", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)


QUICK = ["--robot", "planar", "--count", "100", "--actions", "2", "--task.rates", "0.9", "0.05"]


def test_a_run_leaves_its_folder(capsys):
    code = main(["run", "touch-box", *QUICK, "--seed", "2001", "--push-model", "displacement"])
    result = json.loads(Path("runs/touch-box-sequence-planar-s2001/result.json").read_text())
    assert code == (DONE if result["lifted"] else NOT_CONVERGED)
    assert result["actions"] == len(result["steps"]) <= 2
    settings = json.loads(Path("runs/touch-box-sequence-planar-s2001/settings.json").read_text())
    assert settings["scene"]["rates"] == [0.9, 0.05]
    assert settings["settings"]["push_model"] == "displacement"
    said = capsys.readouterr()
    assert "pokes, " in said.out and "action 1: " in said.err


def test_figures_are_drawn():
    pytest.importorskip("matplotlib")
    main(["run", "touch-box", *QUICK, "--out", "own", "--seed", "2002"])
    kept = {"belief.npz", "figures", "result.json", "settings.json", "steps.jsonl", "trace.npz"}
    assert {path.name for path in Path("own").iterdir()} - {"run.rrd"} == kept  # where the viewer is installed
    assert {path.name for path in Path("own/figures").iterdir()} == {"pokes.png", "sure.png"}
    assert main(["plot", "own", "--out", "again"]) == DONE
    assert Path("again/pokes.png").read_bytes() == Path("own/figures/pokes.png").read_bytes()


def test_an_interrupt_leaves_the_pokes_that_were_done(monkeypatch, capsys):
    from rumi.tasks.touch_box.planar_robot import PlanarRobot

    execute, done = PlanarRobot.execute, []

    def interrupt(self, *arguments):
        if done:
            raise KeyboardInterrupt
        done.append(execute(self, *arguments))
        return done[0]

    monkeypatch.setattr(PlanarRobot, "execute", interrupt)
    assert main(["run", "touch-box", *QUICK, "--seed", "2001", "--out", "own"]) == INTERRUPTED
    assert "touch-box: interrupted after 1 poke" in capsys.readouterr().out
    assert json.loads(Path("own/settings.json").read_text())["seed"] == 2001
    _, poke = (line for line, _ in read_lines(Path("own/steps.jsonl")))
    assert len(poke["readings"]) == len(done[0].contact)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["run", "touch-box", "--method", "guess"], "guess"),
        (["run", "touch-box", "--task.rates", "0.1", "0.5"], "true > false positive rate"),
        (["run", "touch-box", "--poke.candidates", "0"], "Expected candidates to be 1 or more, got 0"),
        (["run", "touch-box", "--task.speed", "0"], "Expected speed above 0 and finite, got 0.0"),
        (["run", "touch-box", "--threshold", "nan"], "Expected threshold in (0, 1], got nan"),
        (["run", "touch-box", "--filter.overlap-error", "0.7"], "Expected overlap_error"),
        (["run", "touch-box", "--robot", "arm", "--task.rates", "0.9", "0.05"], "The arm feels by its own torques"),
        (["run", "touch-box", "--robot", "arm", "--task.correlation", "0.5"], "The arm feels by its own torques"),
        (["reproduce", "touch-table9"], "There is no experiment 'touch-table9' of touch"),
        (["reproduce", "touch-table1", "table5"], "There is no experiment 'table5' of touch"),
        (["reproduce", "table5", "touch-table1"], "the touch-* experiments are given by themselves"),
        (["reproduce", "--seeds", "2000", "--show", "touch-table1"], "holds no runs with these settings"),
        (
            ["reproduce", "table5", "--seeds", "0", "--show", "--out", "touch-out"],
            f"There are no results in {Path('touch-out')}",
        ),
        (["reproduce", "table5", "--tasks", "touch-box"], "There is no task 'touch-box'"),
        (["reproduce"], "touch-fig4"),
        (["reproduce", "table9"], "by themselves touch-table1, touch-table2, touch-fig3, touch-fig4"),
        (["reproduce", "touch-fig3", "--out", "file", "--results", "a.jsonl"], "Cannot write to the folder file"),
        (["reproduce", "touch-table1", "--results", "."], "Cannot write .: it is a folder"),
        (["reproduce", "touch-table1", "--methods", "guess"], "There is no method 'guess'"),
        (["reproduce", "touch-table1", "--show"], "holds no runs with these settings"),
    ],
)
def test_what_cannot_be_is_refused(arguments, message, monkeypatch, capsys):
    monkeypatch.setattr("scripts.reproduce.touch.build_touch_box", lambda *a, **k: pytest.fail("it was begun"))
    Path("file").write_text("in the way")
    assert main(arguments) == BAD_INPUT
    # the parser puts a frame round its words
    assert message in " ".join(capsys.readouterr().err.replace("│", " ").split())
    assert not Path("runs").exists()


def test_a_table_is_made_of_runs_that_are_done_once(capsys):
    pytest.importorskip("matplotlib")
    asked = ["--methods", "max-contact", "uninformed", "--seeds", "2000-2001", "--robot", "planar"]
    asked += ["--settings.count", "100", "--settings.actions", "2"]
    assert main(["reproduce", "touch-table1", *asked]) == DONE
    lines = [line for line, _ in read_lines(Path("runs/reproduce/touch.jsonl"))]
    assert len(lines) == 4
    first = capsys.readouterr().out
    assert "| max-contact |" in first and "| uninformed |" in first and "believed at the grasp" in first
    assert main(["reproduce", "touch-table1", "touch-fig3", *asked, "--show"]) == DONE
    shown = capsys.readouterr().out
    assert first.strip() in shown
    assert "Median seconds a poke: whole poke" in shown
    assert main(["reproduce", "touch-table1", *asked]) == DONE
    assert len(list(read_lines(Path("runs/reproduce/touch.jsonl")))) == 4


def test_other_tables_and_figures(capsys):
    pytest.importorskip("matplotlib")
    assert main(["reproduce", "touch-table2", "touch-fig4", "--runs", "4"]) == DONE
    said = capsys.readouterr().out
    assert "| smooth+replay |" in said and "0.018 (position)" in said
    assert Path("runs/reproduce/touch-fig4.png").stat().st_size > 10_000
