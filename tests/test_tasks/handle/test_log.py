"""A recorded run gives the belief that the live run had, and with other settings another one; logs of before do too."""

import json
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import pytest
import torch

pytest.importorskip("h5py")

from rumi import loop
from rumi.agent import Parts
from rumi.cli import main
from rumi.errors import UsageError
from rumi.exit_codes import BAD_INPUT, DONE, NOT_CONVERGED
from rumi.planning.policy import Plan, PlanRequest
from rumi.records import StepRecord
from rumi.runs.folder import load_run
from rumi.runs.logbook import LOG
from rumi.runs.plain import plain
from rumi.runs.progress import both
from rumi.runs.recorded import RunLog
from rumi.runs.replay import digest, replay
from rumi.tasks.handle.agent import HandleResult, build_agent
from rumi.tasks.handle.build import build_handle
from rumi.tasks.handle.entry import HANDLE, HandleRunSettings
from rumi.tasks.handle.grasp import handle_odds
from rumi.tasks.handle.settings import HandleSettings
from sensors.contact_reading import ContactReading
from sensors.log.reader import Log
from sensors.log.writer import LogWriter

pytestmark = [pytest.mark.sim, pytest.mark.outcome]

SEED = 1001
SETTINGS = HandleSettings(steps=2)


class Ahead:
    """Policy that goes straight ahead, into the mug."""

    def act(self, request: PlanRequest) -> Plan:
        """One control, as far as the tool goes."""
        now = request.scene.configuration
        control = now.new_tensor([1.0, 0.0, 0.0])
        return Plan(control[None], torch.stack((now, request.scene.tool.free_step(now, control)[0])))


class Live(NamedTuple):
    """A short run with all sensors, of which the last action touches."""

    folder: Path
    steps: list[StepRecord]
    outcome: HandleResult


@pytest.fixture(scope="module")
def live(tool, tmp_path_factory):
    """Two actions straight ahead, of which the second pushes the mug; wrist and joints feel it."""
    table = handle_odds(torch.ones(9, 6, 13, dtype=torch.float64))
    task, agent = build_handle(SETTINGS, tool=tool, table=table)
    agent = replace(agent, rummager=replace(agent.rummager, policy=Ahead()))
    folder, steps = tmp_path_factory.mktemp("fused"), []
    with HANDLE.recorder(folder, HandleRunSettings(SETTINGS, SEED), Parts(task, agent), log=False) as recorder:
        outcome = loop.run(task, agent, seed=SEED, on_step=both(recorder, steps.append))
        recorder.finish(outcome)
    last = steps[-1]
    assert (len(steps), last.contacts) == (3, 1)
    assert len(last.reading.wrench.points) and bool(last.reading.signals.any())
    return Live(folder, steps, outcome)


@pytest.fixture
def as_command(tool, live, monkeypatch, capsys, tmp_path):
    """`rumi replay`, with the gripper without the arm's reach, which no belief knows of."""
    monkeypatch.setattr("rumi.tasks.handle.agent.make_tool", lambda *_, **__: tool)
    monkeypatch.chdir(tmp_path)

    def call(*arguments):
        return main(["replay", *map(str, arguments)]), capsys.readouterr()

    return call


@pytest.fixture(scope="module")
def log_of_before(live, tmp_path_factory):
    """The log that `rumi run fused --record` wrote when readings were in HDF5 and the task was called so."""
    path = tmp_path_factory.mktemp("before") / LOG
    asked = {"task": "fused", "seed": SEED, "fused": plain(SETTINGS)}
    with LogWriter(path, [], settings=asked, about={"made_with": "{}"}, readings=ContactReading) as log:
        for step in live.steps:
            reading = ContactReading.of(step.reading)
            log.reading(reading, control=step.control, truth=step.truth, digest=digest(step.belief))
        log.finish({"stopped_by": "steps"})
    return path


def test_the_clock_counts_thinking_motion_and_grasp(live):
    """On which a decision lasts a second, a motion 1.1 and the grasp 2.1."""
    assert live.outcome.total_s == pytest.approx(1.0 + 2 * 2.1 + 2.1)


def test_readings_come_back_whole(live, log_of_before):
    with Log(log_of_before) as log:
        before = log.taken()
    assert before[0].reading.signals is None and len(before[0].reading.wrench.points) == 0
    for taken in (before, RunLog(live.folder).taken()):
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
    assert "run_budget_s: no effect" in said.err
    assert "differs from the recorded one from action 2 on (wrist.outlier changed)" in said.out
    assert len(load_run("what-if").steps) == 3
    for changed in (["--joints.gain", "3"], ["--noise-free"], ["--wrist.behind-m", "0.2"]):
        code, said = as_command(live.folder, *changed)
        name = changed[0].removeprefix("--").replace("-", "_")
        assert code == BAD_INPUT and f"Expected {name} as it was recorded" in said.err
    code, said = as_command(live.folder, "--sensors", "camera")
    assert code == BAD_INPUT and "Expected sensors as it was recorded" in said.err
    assert main(["check", str(live.folder)]) == BAD_INPUT


def test_the_same_settings_by_the_command(live, log_of_before, as_command):
    for recording in (live.folder, log_of_before):
        _, said = as_command(recording)
        assert "the recorded one, bit for bit, after each of 3 readings" in said.out


def test_of_a_log_that_was_cut_short_the_start_is_replayed(log_of_before, as_command, tmp_path):
    data = log_of_before.read_bytes()
    (tmp_path / "cut.h5").write_bytes(data[: int(0.9 * len(data))])
    code, said = as_command("cut.h5")
    assert code == NOT_CONVERGED and "the log was not finished" in said.err
    assert "reading 2 of 3 is damaged" in said.err
    assert "the recorded one, bit for bit, after each of 2 readings" in said.out
    (tmp_path / "cut.h5").write_bytes(data[:3000])
    code, said = as_command("cut.h5")
    assert code == BAD_INPUT and "cut.h5" in said.err


def test_no_readings_are_refused(tool):
    with pytest.raises(UsageError, match="nothing to replay"):
        replay([], build_agent(SETTINGS, tool=tool), seed=0)


def test_a_folder_of_before_is_read(live, tmp_path):
    """The task was called fused, its end by another word, and figures of the grasp had a file of their own."""
    for name in ("trace.npz", "steps.jsonl"):
        (tmp_path / name).write_bytes((live.folder / name).read_bytes())
    values = json.loads((live.folder / "settings.json").read_text())
    (tmp_path / "settings.json").write_text(
        json.dumps({**values, "task": "fused", "fused": values["handle"]} | {"handle": None})
    )
    ended = json.loads((live.folder / "result.json").read_text()) | {"stopped_by": "converged"}
    (tmp_path / "result.json").write_text(json.dumps(ended))
    run = load_run(tmp_path)
    assert run.task == "handle" and run.result.stopped_by == "sure" and len(run.steps) == 3
    before = {name: value for name, value in run.settings.items() if name != "handle"}
    assert HANDLE.from_dict(before) == HandleRunSettings(SETTINGS, SEED)


def test_settings_count_do_nothing_or_decided_what_was_sensed():
    counted = ("fit_a_contact", "preset", "signals.spacing_m", "wrist.point_m", "seed")
    sensed = ("noise_free", "wrist.behind_m", "joints.threshold_nm", "sensors")
    roles = {"counted": counted, "idle": ("run_budget_s", "thinking_s"), "sensed": sensed}
    for role, names in roles.items():
        assert [HANDLE.role(name) for name in names] == [role] * len(names)
    assert replace(SETTINGS, preset="default") != SETTINGS
