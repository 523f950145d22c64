import gc
import io
import json
from dataclasses import replace
from pathlib import Path

import pytest

from rumi import exit_codes
from rumi.cache import cache_folder
from rumi.cli import main
from rumi.commands.calibrate import report
from rumi.commands.run import keep_learnt, parse, planned_with
from rumi.dynamics.push_posterior import PushPosterior
from rumi.dynamics.registry import push_model
from rumi.errors import DegenerateBeliefError, UsageError
from rumi.runs.folder import RunRecorder, load_run
from rumi.runs.plain import plain
from rumi.runs.progress import Progress
from rumi.tasks.rummage.build import build
from rumi.tasks.rummage.drawn_scenes import DRAWN
from rumi.tasks.rummage.entry import Rummaging
from rumi.tasks.rummage.scenes import SCENES
from rumi.tasks.rummage.settings import preset
from tests.fixtures.made_up_run import make_up
from tests.fixtures.small_run import SMALL

pytestmark = pytest.mark.usefixtures("at_home")
ROOT = Path(__file__).resolve().parent.parent.parent


def run_small(*more, steps=2):
    return main(["run", "mug-0", "--steps", str(steps), "--no-figures", *SMALL, *more])


@pytest.mark.sim
def test_a_run_leaves_its_folder(capsys):
    assert run_small("--seed", "4") == exit_codes.NOT_CONVERGED
    run = load_run("runs/mug-0-rumi-default-s4")
    assert len(run.steps) == 3
    assert run.result.steps == 2
    assert run.settings["planner"]["mppi"]["samples"] == 8
    assert run.settings["seed"] == 4
    assert run.geometry.reachability is not None
    said = capsys.readouterr()
    assert "mug-0: not sure after 2 actions" in said.out
    assert "runs/mug-0-rumi-default-s4" in said.out
    steps = [text for text in said.err.splitlines() if not text.startswith("rumi: compiling")]
    relied = [text.strip() for text in steps if text.startswith("      ")]
    steps = [text for text in steps if not text.startswith("      ")]
    words = " ".join([steps[1], *relied])
    assert "relies on motion: measured; reach: of the arm; push model: quasi-static" in words
    assert [text.split(":")[0] for text in steps[2:]] == ["first view", "action 1", "action 2"]
    assert "Traceback" not in said.err
    assert "not sure: 0 actions touched the object, 1 are asked for; all actions are used up" in " ".join(
        said.out.split()
    )
    assert main(["result", "runs/mug-0-rumi-default-s4", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["pose"] == run.ended["pose"] and told["why_not"] == run.result.why_not and told["warnings"] == []
    assert len(told["pose"]["world_T_object"]) == 4 and run.result.belief is not None


@pytest.mark.sim
def test_a_run_by_a_budget(monkeypatch):
    set_aside = []
    monkeypatch.setattr(gc, "freeze", lambda: set_aside.append(True))
    assert run_small("--plan-budget-s", "0.02", steps=3) == exit_codes.NOT_CONVERGED
    run = load_run("runs/mug-0-rumi-default-s0")
    assert run.settings["plan_budget_s"] == 0.02
    assert run.result.timings_s["warm_up"] > 0
    assert len(run.steps) == 4
    assert set_aside  # what was loaded is held back from the garbage collector


@pytest.mark.sim
def test_the_same_seed_gives_the_same_files_and_never_overwrites():
    Path("a").mkdir()
    Path("a/notes.txt").write_text("mine")
    run_small("--out", "a")
    run_small("--out", "b")
    for name in ("trace.npz", "belief.npz", "settings.json"):
        assert Path("a", name).read_bytes() == Path("b", name).read_bytes(), name
    first, second = (json.loads(Path(folder, "result.json").read_text()) for folder in "ab")
    assert {**first, "timings_s": 0} == {**second, "timings_s": 0}
    before = {path.name: path.read_bytes() for path in Path("a").iterdir()}
    assert run_small("--out", "a") == exit_codes.BAD_INPUT
    assert {path.name: path.read_bytes() for path in Path("a").iterdir()} == before
    assert before["notes.txt"] == b"mine"


@pytest.mark.sim
def test_exit_code_when_sure():
    always = ("--stop.expected-nll", "1e9", "--stop.fit", "1e9", "--stop.contacts", "0")
    assert run_small(*always) == exit_codes.DONE
    assert load_run("runs/mug-0-rumi-default-s0").result.stopped_by == "sure"


@pytest.mark.sim
def test_an_interrupt_leaves_a_readable_run(monkeypatch, capsys):
    def interrupt(self, step):
        if step.step == 1:
            raise KeyboardInterrupt

    monkeypatch.setattr(Progress, "__call__", interrupt)
    assert main(["run", "mug-0", "--steps", "5", *SMALL]) == exit_codes.INTERRUPTED
    run = load_run("runs/mug-0-rumi-default-s0")
    assert run.result.stopped_by == "interrupted"
    assert len(run.steps) == 2
    assert not Path("runs/mug-0-rumi-default-s0/figures").exists()
    assert "interrupted after 1 action" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "work"),
    [
        (["mug-0"], "rumi.tasks.rummage.build.build"),
        (["handle", "--record"], "rumi.tasks.handle.build.build_handle"),
        (["peg"], "rumi.tasks.peg.entry.build_peg"),
        (["peg"], "rumi.tasks.peg.simulated.PegTask.reset"),
        (["touch-box"], "rumi.tasks.touch_box.build.build_touch_box"),
    ],
)
def test_an_interrupt_before_there_is_a_result_leaves_no_folder(arguments, work, monkeypatch, capsys):
    def interrupt(*arguments, **named):
        raise KeyboardInterrupt

    monkeypatch.setattr(work, interrupt)
    assert main(["run", *arguments, "--out", "own"]) == exit_codes.INTERRUPTED
    assert capsys.readouterr().err.endswith("rumi: interrupted\n")
    assert not Path("own").exists()


@pytest.mark.sim
def test_figures_are_drawn_and_drawn_again(capsys):
    assert main(["run", "mug-0", "--steps", "1", "--method", "reach-only", *SMALL]) == exit_codes.NOT_CONVERGED
    figures = Path("runs/mug-0-reach-only-default-s0/figures")
    assert (figures / "overview.png").stat().st_size > 1000
    assert (figures / "run.gif").stat().st_size > 1000
    capsys.readouterr()
    assert main(["plot", str(figures.parent), "--steps", "1", "--out", "again"]) == exit_codes.DONE
    assert "again/scene_001.png" in capsys.readouterr().out.replace("\\", "/")
    assert not Path("again/scene_000.png").exists()
    assert main(["plot", str(figures.parent), "--steps", "7"]) == exit_codes.BAD_INPUT
    assert "has steps 0 to 1, got 7" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["find"], "There is no command 'find'; the commands are tasks, run, replay"),
        (
            ["run", "mug-9"],
            f"There is no task 'mug-9'; there are {', '.join([*SCENES, *DRAWN])}, touch-box, peg, handle",
        ),
        (["run", "mug-0", "--preset", "quick"], "There is no preset 'quick'; the presets are default, fast, paper"),
        (["run", "mug-0", "--preset=quick"], "There is no preset 'quick'"),
        (["run", "peg", "--preset", "fast"], "There is no preset 'fast'; the presets are default, paper"),
        (["run", "mug-0", "--filter.triger", "3"], "--filter.trigger FLOAT"),
        (["run", "mug-0", "--whatever"], "Unrecognized options: --whatever"),
        (["run", "--seed", "3", "mug-0"], "Expected the task first, as in `rumi run mug-0 --seed 3`, got --seed"),
        (["run", "mug-0", "--simulator.sensors.lost", "0.5"], "Expected --simulator.sensors.kind camera, bubbles"),
        (["run", "mug-0", "--steps", "41"], "Expected steps to be at most the 40 of mug-0, got 41"),
        (["run", "mug-0", "--method", "poke"], "There is no method 'poke'; there are"),
        (["run", "mug-0", "--seed", "x"], "--seed"),
        (["run", "mug-0", "--seed", "-1"], "Expected seed to be 0 or more, below 2**63, got -1"),
        (["run", "mug-0", "--seed", "99999999999999999999"], "Expected seed to be 0 or more, below 2**63, got 9999"),
        (["run", "peg", "--seed", "9223372036854775808"], "Expected seed to be 0 or more, below 2**63, got 9223"),
        (["run", "mug-0", "--initialise.particles", "0"], "Expected particles to be 1 or more, got 0"),
        (["run", "mug-0", "--planner.mppi.samples", "0"], "samples"),
        (["run", "mug-0", "--out", "file/run"], "Cannot write to the folder file"),
        (["run", "touch-box", "--out", "file"], "Cannot write to the folder file"),
        (["run"], "usage: rumi run TASK [options]"),
        (["plot", "nowhere"], "There is no run folder nowhere"),
        (["plot"], "RUN"),
    ],
)
def test_bad_input_is_named_without_a_traceback(arguments, message, capsys):
    Path("file").write_text("in the way")
    assert main(arguments) == exit_codes.BAD_INPUT
    said = capsys.readouterr()
    assert message in said.err
    assert "Traceback" not in said.err
    assert said.out == ""
    assert not list(Path("runs").glob("*"))


def test_no_cuda_is_bad_input(monkeypatch, capsys):
    import torch

    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert main(["run", "mug-0", "--device", "cuda"]) == exit_codes.BAD_INPUT
    assert "no CUDA device" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (UsageError("a step past the end"), "a step past the end"),
        (ValueError("points must be finite"), "points must be finite"),
        (DegenerateBeliefError("no weight left"), "no weight left"),
        (ModuleNotFoundError("No module named 'mujoco'", name="mujoco"), f"pip install -e '{ROOT}[sim]'"),
    ],
)
def test_what_goes_wrong_in_a_run_is_named(error, message, monkeypatch, capsys):
    def fail(arguments):
        raise error

    monkeypatch.setattr("rumi.commands.run.run", fail)
    assert main(["run", "mug-0"]) == exit_codes.BAD_INPUT
    assert message in capsys.readouterr().err
    monkeypatch.setenv("RUMI_DEBUG", "1")
    with pytest.raises(type(error)):
        main(["run", "mug-0"])


def test_cache_folder(monkeypatch):
    monkeypatch.setenv("RUMI_CACHE", "/x")
    assert cache_folder() == Path("/x")
    monkeypatch.delenv("RUMI_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", "/y")
    assert cache_folder() == Path("/y/rumi")


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_progress_is_a_bar_on_a_terminal_and_lines_elsewhere():
    steps = make_up(5, particles=10).steps
    for stream, marks in ((Terminal(), ("\r", "4/4", "ess")), (io.StringIO(), ("action 4", "contact", "0.3 s"))):
        with Progress("mug-0", 4, Rummaging().describe, stream) as progress:
            for step in steps:
                progress(step)
        for mark in marks:
            assert mark in stream.getvalue()
        assert "," not in stream.getvalue() and max(map(len, stream.getvalue().splitlines())) <= 80
    assert Rummaging().describe(steps[0]).startswith("nll 22.0")


@pytest.mark.sim
def test_an_object_that_cannot_be_made_leaves_no_folder(tmp_path, capsys):
    (tmp_path / "large.obj").write_text("v 0 0 0\nv 99 0 0\nv 0 99 0\nv 0 0 99\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
    arguments = ["run", "mug-0", "--mesh", str(tmp_path / "large.obj"), "--out", str(tmp_path / "run")]
    assert main(arguments) == 2
    assert "--scale" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    "asked",
    [
        ("drill-0", "--planner.push-model", "quasi-static"),
        ("drill-0", "--filter.motion", "pushed"),
        ("box-0", "--planner.push-model", "mujoco"),
    ],
)
def test_models_that_push_in_a_plane_refuse_other_tasks(asked, cache):
    """Before any step is made, and in words."""
    with pytest.raises(UsageError, match=f"{asked[1]} {asked[2]} .*{asked[0]}"):
        build(parse(asked)[2].settings, cache_dir=cache)


def test_pushes_of_a_run_are_learnt_from(tmp_path, capsys):
    made = make_up(9, particles=10)
    with RunRecorder(tmp_path / "run", plain(preset(task="mug-0")), made.geometry) as record:
        for step in made.steps:
            record(step)
    out, figure = tmp_path / "mug.json", tmp_path / "mug.png"
    assert main(["pushes", str(tmp_path / "run"), "--out", str(out), "--figure", str(figure)]) == exit_codes.DONE
    printed = capsys.readouterr().out
    assert "5 pushes" in printed and "of other objects'" in printed
    assert len(PushPosterior.load(out).pushes) == 5 and figure.stat().st_size > 1000
    assert main(["pushes", str(tmp_path / "run"), "--pushes", str(out)]) == exit_codes.DONE
    assert preset().planner.push_parameters == "fixed"
    settings = replace(preset(task="mug-0").planner, push_parameters=str(out))
    assert len(push_model("quasi-static", "rollouts", settings).posterior.pushes) == 5
    out.write_text("{}")
    assert main(["pushes", str(tmp_path / "run"), "--pushes", str(out)]) == exit_codes.BAD_INPUT
    assert "Expected push parameters" in capsys.readouterr().err
    assert run_small("--planner.push-parameters", str(out)) == exit_codes.BAD_INPUT
    assert not list(Path("runs").glob("*"))


@pytest.mark.parametrize("flag", ["--out", "--figure"])
def test_where_pushes_cannot_be_written_they_are_not_learnt(flag, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("rumi.commands.pushes.learnt", lambda *_, **__: pytest.fail("learnt"))
    assert main(["pushes", str(tmp_path / "run"), flag, str(tmp_path)]) == exit_codes.BAD_INPUT
    assert f"Cannot write {tmp_path}: it is a folder" in capsys.readouterr().err


def test_a_run_whose_pushes_cannot_be_kept_is_not_begun(tmp_path, capsys):
    (tmp_path / "file").touch()
    assert run_small("--pushes", str(tmp_path / "file" / "mug.json")) == exit_codes.BAD_INPUT
    assert f"Cannot write {tmp_path / 'file' / 'mug.json'}" in capsys.readouterr().err
    assert not list(Path("runs").glob("*"))


def test_a_run_goes_on_from_the_pushes_of_the_last(tmp_path, capsys):
    made, file = make_up(9, particles=10), tmp_path / "mug.json"
    settings = preset(task="mug-0")
    with RunRecorder(tmp_path / "run", plain(settings), made.geometry) as record:
        for step in made.steps:
            record(step)
    assert planned_with(settings, file, "mug-0") == settings  # there is no file yet
    for count in (5, 10):
        keep_learnt(tmp_path / "run", file, 0)
        assert len(PushPosterior.load(file).pushes) == count and "5 pushes learnt from" in capsys.readouterr().err
    assert planned_with(settings, file, "mug-0").planner.push_parameters == str(file)
    assert main(["run", "touch-box", "--pushes", str(file), "--out", str(tmp_path / "other")]) == exit_codes.BAD_INPUT
    assert not (tmp_path / "other").exists()


@pytest.mark.sim
def test_beliefs_are_held_against_the_truth(capsys):
    asked = ["calibrate", "mug", "--seed", "1000", "--steps", "1", "--simulator.no-measures-motion", *SMALL]
    asked += ["--filter.motion", "trajectory", "--filter.trajectories.particles", "10", "--out", "c.jsonl"]
    assert main([*asked, "--episodes", "1"]) == exit_codes.DONE
    said = capsys.readouterr()
    assert "mug: 1 episodes" in said.out and "1 of 1: seed 1000, steps" in said.err
    first = Path("c.jsonl").read_text()
    # what is there is not run again
    assert main([*asked, "--episodes", "2", "--figure", "c.png"]) == exit_codes.DONE
    said = capsys.readouterr()
    assert "mug: 2 episodes" in said.out and "seed 1000" not in said.err and "2 of 2: seed 1001, steps" in said.err
    assert Path("c.jsonl").read_text().startswith(first) and Path("c.png").stat().st_size > 1000
    assert main([*asked, "--episodes", "0"]) == exit_codes.BAD_INPUT
    assert "--episodes of 1 or more" in capsys.readouterr().err
    assert main(["calibrate", "touch-box"]) == exit_codes.BAD_INPUT
    assert "Expected a task that rummages" in capsys.readouterr().err


def test_a_report_of_calibration_by_hand():
    step = {"contacts": 1, "p_right": 0.96, "right": True, "place": 0.4, "turn": 0.92, "both": 0.3, "ranks": {"x": 0.5}}
    lines = [
        {"stopped_by": "sure", "steps": [{**step, "contacts": 0}, step]},
        {"stopped_by": "sure", "steps": [step, {**step, "right": False, "place": 0.995}]},
    ]
    told = report("mug", lines).splitlines()
    assert told[0] == "mug: 2 episodes, 1 right at the end, 1 stopped sure and wrong"
    assert told[1].split()[:2] == ["beliefs", "3"]
    assert "50% 67%, 90% 67%, 95% 67%, 99% 67%" in told[2] and "50% 0%, 90% 0%, 95% 100%" in told[3]
    assert "of 3 with 0.95 or more 2 right" in told[5] and "error 0.293" in told[5]
    halves = [{"stopped_by": "sure", "steps": [{**step, "p_right": 0.5, "right": k < 3}]} for k in range(4)]
    assert "odds of being right are 3.00 (0.95 to 9.52) times its own" in report("mug", halves)
    assert "odds" not in report("mug", halves[:3])
    assert "none touched" in report("mug", [{"stopped_by": "steps", "steps": [{**step, "contacts": 0}]}])
