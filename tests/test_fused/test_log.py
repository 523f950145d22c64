"""A recorded log gives the belief that the live run had, and with other settings another one."""

from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import NamedTuple

import pytest
import torch

pytest.importorskip("h5py")

from rumi import loop
from rumi.cli import main
from rumi.errors import UsageError
from rumi.exit_codes import BAD_INPUT, DONE, NOT_CONVERGED
from rumi.records import StepRecord
from rumi.runs.logbook import LOG, LogRecorder
from rumi.runs.progress import both
from rumi.runs.replay import digest, replay
from rumi.tasks.handle.agent import HandleResult, build_agent
from rumi.tasks.handle.build import build_fused
from rumi.tasks.handle.grasp import HandleTable
from rumi.tasks.handle.log import COUNTED, IDLE, FusedLogRecorder, recorded, refuse_other_senses
from rumi.tasks.handle.settings import FusedSettings
from sensors.contact_reading import ContactReading
from sensors.log.errors import LogError
from sensors.log.reader import Log

pytestmark = pytest.mark.sim

SEEDS = range(1001, 1041)
SETTINGS = FusedSettings(steps=3)


class Live(NamedTuple):
    """A short run with all sensors, of which the last action touches."""

    seed: int
    folder: Path
    steps: list[StepRecord]
    outcome: HandleResult


@pytest.fixture(scope="module")
def live(tool, tmp_path_factory):
    """The first of some seeds, one in four of which will do: which one, the last digit of a plan decides."""
    table = HandleTable(torch.ones(9, 6, 13, dtype=torch.float64))
    parts = build_fused(SETTINGS, tool=tool, table=table)
    for seed in SEEDS:
        folder, steps = tmp_path_factory.mktemp("fused"), []
        with FusedLogRecorder(folder / LOG, seed, SETTINGS, {"made_with": {}}) as log:
            outcome = loop.run(*parts, seed=seed, on_step=both(log, steps.append))
            log.finish(outcome)
        last = steps[-1].reading
        if len(steps) == 4 and len(last.wrench.points) and bool(last.signals.any()) and steps[-1].contacts == 1:
            return Live(seed, folder, steps, outcome)
    raise AssertionError(f"Expected wrist and joints to feel the third action, the first contact, of one of {SEEDS}")


@pytest.fixture
def as_command(tool, live, monkeypatch, capsys, tmp_path):
    """`rumi replay`, with the gripper without the arm's reach, which no belief knows of."""
    monkeypatch.setattr("rumi.tasks.handle.agent.make_tool", lambda *_, **__: tool)
    monkeypatch.chdir(tmp_path)

    def call(*arguments):
        return main(["replay", *map(str, arguments)]), capsys.readouterr()

    return call


def test_a_replay_gives_the_beliefs_of_the_live_run_bit_for_bit(live, tool):
    with Log(live.folder / LOG) as log:
        seed, settings = recorded(log)
        taken = log.taken(ContactReading)
        assert log.problems == []
    assert (seed, settings) == (live.seed, SETTINGS)
    steps = []
    done = replay(taken, build_agent(settings, tool=tool), seed=seed, on_step=steps.append)
    assert done.same == [True] * 4
    for ours, theirs in zip(steps, live.steps, strict=True):
        assert digest(ours.belief) == digest(theirs.belief)
        assert (ours.nll, ours.contacts, ours.converged) == (theirs.nll, theirs.contacts, theirs.converged)
    ours, theirs = done.result.as_dict(), live.outcome.as_dict()
    # a recording knows no clock, and nothing is grasped
    for name in ("timings_s", "lifted", "believed", "grasp", "total_s"):
        ours.pop(name), theirs.pop(name)
    assert ours == theirs


def test_readings_come_back_whole(live):
    with Log(live.folder / LOG) as log:
        taken = log.taken(ContactReading)
    assert taken[0].reading.signals is None and len(taken[0].reading.wrench.points) == 0
    for one, step in zip(taken[1:], live.steps[1:], strict=True):
        ours, theirs = one.reading, step.reading
        assert torch.equal(ours.signals, theirs.signals)
        for name in ("points", "normals", "point_sd", "normal_sd", "instant"):
            a, b = getattr(ours.wrench, name), getattr(theirs.wrench, name)
            assert a.dtype == b.dtype and torch.equal(a, b), name
        assert torch.equal(ours.observation.points, theirs.observation.points)
        assert torch.equal(one.control, step.control)


def test_other_settings_give_another_belief_on_the_same_readings(live, as_command):
    code, said = as_command(live.folder, "--wrist.outlier", "0.4", "--run-budget-s", "9", "--out", "what-if")
    assert code in (DONE, NOT_CONVERGED)
    assert "budget_s: no effect" in said.err
    assert "differs from the recorded one from action 3 on (wrist.outlier changed)" in said.out
    assert (Path("what-if") / "trace.npz").exists()
    assert "as it was recorded" in as_command(live.folder, "--joints.gain", "3")[1].err
    code, said = as_command(live.folder, "--sensors", "camera")
    assert code == BAD_INPUT and "Expected sensors as it was recorded" in said.err
    assert main(["check", str(live.folder)]) == BAD_INPUT


def test_the_same_settings_by_the_command(live, as_command):
    _, said = as_command(live.folder / LOG)
    assert "the recorded one, bit for bit, after each of 4 readings" in said.out


def test_of_a_log_that_was_cut_short_the_start_is_replayed(live, as_command, tmp_path):
    data = (live.folder / LOG).read_bytes()
    (tmp_path / "cut.h5").write_bytes(data[: int(0.9 * len(data))])
    code, said = as_command("cut.h5")
    assert code == NOT_CONVERGED and "the log was not finished" in said.err
    assert "reading 3 of 4 is damaged" in said.err
    assert "the recorded one, bit for bit, after each of 3 readings" in said.out
    (tmp_path / "cut.h5").write_bytes(data[:3000])
    code, said = as_command("cut.h5")
    assert code == BAD_INPUT and "cut.h5" in said.err


def test_what_is_not_there_is_named(as_command, tool, tmp_path):
    code, said = as_command("nothing.h5")
    assert code == BAD_INPUT and "There is no log nothing.h5" in said.err
    (tmp_path / "run").mkdir()
    code, said = as_command("run")
    assert code == BAD_INPUT and "was not recorded" in said.err
    with pytest.raises(UsageError, match="nothing to replay"):
        replay([], build_agent(SETTINGS, tool=tool), seed=0)


def test_settings_of_what_was_sensed_are_refused():
    for changed in (
        replace(SETTINGS, noise_free=True),
        replace(SETTINGS, wrist=replace(SETTINGS.wrist, behind_m=0.2)),
        replace(SETTINGS, joints=replace(SETTINGS.joints, threshold_nm=1.0)),
    ):
        with pytest.raises(UsageError, match="cannot change what was sensed"):
            refuse_other_senses(SETTINGS, changed)
    refuse_other_senses(SETTINGS, replace(SETTINGS, fit_a_contact=1.0, preset="default", budget_s=5.0))
    names = {name for field in fields(FusedSettings) for name in (field.name, *_inner(field))}
    assert {*COUNTED, *IDLE} <= names


def _inner(field):
    kind = type(getattr(SETTINGS, field.name))
    return [f"{field.name}.{inner.name}" for inner in fields(kind)] if is_dataclass(kind) else []


def test_logs_of_other_runs_are_told_apart(live, tmp_path):
    """Those without the further columns hold fused readings too, with nothing in them; the other way is refused."""
    with LogRecorder(tmp_path / "plain.h5", {"task": "mug-0"}) as log:
        log(live.steps[0])
    with Log(tmp_path / "plain.h5") as log:
        assert recorded(log) is None
        assert len(log.taken(ContactReading)[0].reading.wrench.points) == 0
    with Log(live.folder / LOG) as log, pytest.raises(LogError, match="reading/signals, which this rumi"):
        log.taken()
