import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from rumi import exit_codes
from rumi.belief.particles import PoseBelief
from rumi.cli import main
from rumi.commands.replay import _check_object
from rumi.commands.replay_summary import changes, machines
from rumi.errors import UsageError
from rumi.runs.folder import load_run
from rumi.runs.progress import Progress
from rumi.runs.provenance import provenance
from rumi.runs.replay import digest

pytest.importorskip("h5py")

import h5py

from sensors.log.writer import LogWriter

pytestmark = [pytest.mark.usefixtures("at_home"), pytest.mark.outcome]

ROOT = Path(__file__).resolve().parent.parent.parent
SMALL = ("--initialise.particles", "12", "--initialise.starts", "40", "--initialise.polished", "12")
STEPS = 6


def record(folder, task="mug-0", *more):
    """A short run that touches the object: slide goes straight to it."""
    asked = ["run", task, "--method", "slide", "--seed", "3", "--steps", str(STEPS), "--no-figures"]
    return main([*asked, "--out", str(folder), *SMALL, *more])


@pytest.fixture(scope="module")
def recorded(tmp_path_factory, cache):
    """A recorded run with contacts."""
    folder = tmp_path_factory.mktemp("recorded") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RUMI_CACHE", str(cache))
        assert record(folder) in (exit_codes.DONE, exit_codes.NOT_CONVERGED)
    assert load_run(folder).result.contacts > 0
    return folder


def said_of_beliefs(capsys):
    return next(line for line in capsys.readouterr().out.splitlines() if line.strip().startswith("belief"))


@pytest.mark.sim
def test_a_replay_gives_the_recorded_beliefs_bit_for_bit(recorded, capsys):
    code = main(["replay", str(recorded), "--out", "again"])
    assert "the recorded one, bit for bit, after each of" in said_of_beliefs(capsys)
    live, again = load_run(recorded), load_run("again")
    assert code == (exit_codes.DONE if live.result.stopped_by == "sure" else exit_codes.NOT_CONVERGED)
    assert len(again.steps) == len(live.steps)
    for ours, theirs in zip(again.steps, live.steps, strict=True):
        for name in ("world_T_attached", "attached_T_object", "log_weights", "discrepancy"):
            assert torch.equal(getattr(ours.belief, name), getattr(theirs.belief, name)), (ours.step, name)
        assert ours.nll == theirs.nll
        assert ours.contacts == theirs.contacts
        if ours.step:
            assert torch.equal(ours.control, theirs.control)
    assert (recorded / "belief.npz").read_bytes() == Path("again/belief.npz").read_bytes()
    # nothing is planned in a replay
    assert again.result.relies_on.split("; ")[0] == live.result.relies_on.split("; ")[0] == "motion: measured"
    plain = [replace(one.result, timings_s={}, relies_on="") for one in (again, live)]
    assert plain[0] == plain[1]


@pytest.mark.sim
def test_ctrl_c_ends_a_replay_which_says_so(recorded, monkeypatch, capsys):
    def interrupt(self, step):
        if step.step == 1:
            raise KeyboardInterrupt

    monkeypatch.setattr(Progress, "__call__", interrupt)
    code = main(["replay", str(recorded), "--stop.rule", "never", "--out", "again", "--figures"])
    assert code == exit_codes.INTERRUPTED
    said = capsys.readouterr().out
    assert f"readings 2 of {len(load_run(recorded).steps)}: interrupted before the log's end" in said
    assert len(load_run("again").steps) == 2 and not Path("again/figures").exists()


@pytest.mark.sim
def test_a_replay_of_trajectories_is_the_same_too(capsys):
    small = ("--filter.motion", "trajectory", "--filter.trajectories.particles", "16", "--stop.rule", "probability")
    record("run", "mug", *small, "--simulator.no-measures-motion", "--steps", "4")
    assert load_run("run").result.contacts > 0
    main(["replay", "run"])
    assert "bit for bit" in said_of_beliefs(capsys)


@pytest.mark.sim
@pytest.mark.slow
@pytest.mark.parametrize("task", ["shelf-mug", "shelf-box"])
def test_replays_of_other_sensing_are_the_same_too(task, capsys):
    """Motion that is estimated, a camera that looks again, and no camera at all."""
    options = () if task == "shelf-mug" else ("--method", "rumi", "--planner.mppi.samples", "8")
    record("run", task, *options)
    main(["replay", "run"])
    assert "bit for bit" in said_of_beliefs(capsys)


@pytest.mark.sim
@pytest.mark.slow
def test_double_precision_is_recorded_as_it_is(capsys):
    record("run", "mug-0", "--dtype", "float64", "--steps", "2")
    main(["replay", "run"])
    assert "bit for bit" in said_of_beliefs(capsys)
    main(["replay", "run", "--dtype", "float32"])
    assert "differs from the recorded one from the first view on (dtype changed)" in said_of_beliefs(capsys)


@pytest.mark.sim
def test_other_settings_give_what_would_have_been(recorded, capsys):
    main(["replay", str(recorded), "--filter.peakiness", "0.5", "--out", "what-if"])
    assert "differs from the recorded one from the first view on (filter.peakiness changed)" in said_of_beliefs(capsys)
    settings = json.loads(Path("what-if/settings.json").read_text())
    assert settings["filter"]["peakiness"] == 0.5
    assert len(load_run("what-if").steps) > 1
    main(["replay", str(recorded), "--planner.mppi.samples", "9", "--steps", "2"])
    said = capsys.readouterr()
    assert "planner.mppi.samples: no effect, since what was done is recorded" in said.err
    assert "after each of 3 readings" in said.out


@pytest.mark.sim
@pytest.mark.slow
def test_a_replay_draws_figures_where_asked(recorded):
    main(["replay", str(recorded), "--steps", "1", "--out", "seen", "--figures"])
    assert list(Path("seen/figures").glob("*.png"))


@pytest.mark.sim
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--simulator.mini-steps", "5"], "Expected simulator.mini_steps as it was recorded"),
        (["mug-1"], "Expected task as it was recorded|unrecognized|Unrecognized"),
        (["--figures"], "Expected --out DIR with --figures"),
        (["--filter.peakyness", "1"], "--filter.peakiness FLOAT"),
    ],
)
def test_what_a_replay_cannot_do_is_named(recorded, arguments, message, capsys):
    import re

    assert main(["replay", str(recorded), *arguments]) == exit_codes.BAD_INPUT
    said = capsys.readouterr()
    assert re.search(message, said.err + said.out)


def test_what_is_no_log_is_named(capsys, tmp_path):
    assert main(["replay"]) == exit_codes.BAD_INPUT
    assert "Expected the run first" in capsys.readouterr().err
    (tmp_path / "empty").mkdir()
    assert main(["replay", "empty"]) == exit_codes.BAD_INPUT
    assert "empty is no run folder: it has no settings.json" in capsys.readouterr().err
    assert main(["replay", "none.h5"]) == exit_codes.BAD_INPUT
    assert "There is no log none.h5" in capsys.readouterr().err
    with h5py.File("log.h5", "w") as file:
        file["a"] = [1]
    assert main(["replay", "log.h5"]) == exit_codes.BAD_INPUT
    assert "is no log of rumi" in capsys.readouterr().err


@pytest.mark.parametrize("text", ["[]", "{half", "3", '{"mesh": "drill.obj"}'])
def test_a_damaged_record_of_the_object_is_named(text, tmp_path):
    log = SimpleNamespace(path=tmp_path, texts={"object": text})
    with pytest.raises(UsageError, match=r"object\.json is damaged: "):
        _check_object(log, None)
    log.path = tmp_path / "log.h5"
    with pytest.raises(UsageError, match=r"object in .*log\.h5 is damaged: "):
        _check_object(log, None)


@pytest.mark.parametrize("text", ["{}", '{"mesh": null}', '{"mesh": {"sha256": "1"}}'])
def test_a_record_of_the_object_may_have_no_mesh(text, tmp_path):
    _check_object(SimpleNamespace(path=tmp_path, texts={"object": text}), None)


@pytest.mark.parametrize("arguments", [["--filter.peakiness", "1", "log.h5"], ["--out", "run"]])
def test_the_log_stands_first(arguments, capsys):
    assert main(["replay", *arguments]) == exit_codes.BAD_INPUT
    assert "Expected the run first, its folder or a log" in capsys.readouterr().err


def test_replay_has_help(capsys):
    assert main(["replay", "--help"]) == exit_codes.DONE
    said = capsys.readouterr().out
    assert "rumi replay [-h] [OPTIONS] RUN" in said
    assert "--filter.peakiness" in said


@pytest.mark.sim
def test_the_settings_of_a_log_that_another_rumi_wrote_are_checked(recorded, capsys, tmp_path):
    (tmp_path / "trace.npz").write_bytes((recorded / "trace.npz").read_bytes())
    settings = json.loads((recorded / "settings.json").read_text())
    (tmp_path / "settings.json").write_text(json.dumps(settings | {"mood": "good"}))
    assert main(["replay", str(tmp_path)]) == exit_codes.BAD_INPUT
    assert "There is no setting mood" in capsys.readouterr().err


@pytest.mark.sim
def test_a_log_of_before_with_readings_replays_bit_for_bit(recorded, capsys, tmp_path):
    """`rumi run --record` wrote readings to HDF5 beside the trace once; what is exported of it is what the run knew."""
    run = load_run(recorded)
    asked = {name: value for name, value in run.settings.items() if name not in ("schema", "made_with")}
    with LogWriter(tmp_path / "log.h5", [], settings=asked, about={"made_with": "{}"}) as log:
        for step in run.steps:
            log.reading(step.reading, control=step.control, truth=step.truth, digest=digest(step.belief))
        log.finish({"stopped_by": "converged"})
    for path in (tmp_path, tmp_path / "log.h5"):
        main(["replay", str(path)])
        assert "the recorded one, bit for bit, after each of" in said_of_beliefs(capsys)
    poses = []
    for path in (recorded, tmp_path / "log.h5"):
        assert main(["export", str(path), "--to", "json", "--out", str(tmp_path / "pose.json")]) == exit_codes.DONE
        assert capsys.readouterr().out == f"{tmp_path / 'pose.json'}\n"
        poses.append([step["pose"] for step in json.loads((tmp_path / "pose.json").read_text())["steps"]])
    assert len(poses[0]) == STEPS + 1 and poses[0] == poses[1]
    said = [(main(["pushes", str(path)]), capsys.readouterr().out) for path in (recorded, tmp_path / "log.h5")]
    assert said[0] == said[1] and said[0][0] == exit_codes.DONE


@pytest.mark.sim
@pytest.mark.slow
def test_a_run_that_was_killed_is_replayed_up_to_there(cache, capsys):
    command = [sys.executable, "-m", "rumi", "run", "mug-0", "--method", "slide", "--no-figures"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "RUMI_CACHE": str(cache)}
    running = subprocess.Popen([*command, "--stop.rule", "never", "--out", "run", *SMALL], env=environment)
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline and running.poll() is None:
        time.sleep(0.05)
        try:
            if len(load_run("run").steps) > 3:
                break
        except ValueError:
            continue  # not there yet
    running.send_signal(signal.SIGKILL)
    assert running.wait() == -signal.SIGKILL
    assert main(["replay", "run"]) == exit_codes.NOT_CONVERGED
    said = capsys.readouterr()
    assert "the run was not finished: what had been written is there" in said.err
    assert "the recorded one, bit for bit, after each of" in said.out


def test_a_digest_tells_beliefs_apart():
    one = PoseBelief.uniform(torch.eye(4).expand(5, 4, 4))
    other = replace(one, log_weights=one.log_weights.double())
    assert digest(one) == digest(PoseBelief.uniform(torch.eye(4).expand(5, 4, 4)))
    assert digest(one) != digest(other)
    assert digest(one) != digest(one.moved(torch.diag(torch.tensor([1.0, 1.0, 1.0, 1.0]))[[1, 0, 2, 3]]))


def test_changes_are_named_with_dots():
    before = {"a": 1, "b": {"c": 2, "d": [3]}, "e": 5}
    assert changes(before, {"a": 1, "b": {"c": 2, "d": [4]}, "e": None}) == ["b.d", "e"]
    assert changes(before, before) == []


def test_records_of_before_that_name_a_backend_are_of_this_machine():
    then = provenance() | {"backend": "torch"}
    log = SimpleNamespace(texts={"made_with": json.dumps(then)})
    assert machines(log) == []
    log.texts["made_with"] = json.dumps(then | {"threads": 999})
    assert [line.split(",")[0] for line in machines(log)] == ["recorded with threads 999"]
