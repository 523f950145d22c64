"""What holds of every task's agent, and of the folder that its runs leave."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, get_args

import pytest
import torch

pytest.importorskip("mujoco")

from rumi import loop
from rumi.agent import Agent, Parts, State, StopReason
from rumi.clock import Clock
from rumi.errors import UsageError
from rumi.runs.folder import RunRecorder, load_run
from rumi.runs.plain import plain
from rumi.runs.progress import both
from rumi.runs.recorded import RunLog
from rumi.runs.replay import digest, replay
from rumi.session import run_scenes
from rumi.task import Task
from rumi.tasks.grasp_table import clearance_table
from rumi.tasks.handle.build import build_handle
from rumi.tasks.handle.entry import HandleRunSettings
from rumi.tasks.handle.grasp import handle_odds
from rumi.tasks.handle.settings import HandleSettings, task_of
from rumi.tasks.peg.entry import PegRunSettings
from rumi.tasks.peg.settings import PegSettings
from rumi.tasks.registry import TASKS, entry_of
from rumi.tasks.rummage.build import build_rummager, make_task
from rumi.tasks.rummage.scenes import make_tool
from rumi.tasks.rummage.settings import preset
from rumi.tasks.touch_box.agent import Toucher
from rumi.tasks.touch_box.entry import TouchBoxSettings
from rumi.tasks.touch_box.planar_robot import PlanarRobot
from rumi.tasks.touch_box.robot import TouchBox
from rumi.tasks.touch_box.scene import TouchTask
from rumi.tasks.touch_box.settings import TouchSettings

pytestmark = pytest.mark.sim


class Member(NamedTuple):
    """A task in small.

    Attributes:
        name: of the task.
        settings: of a run.
        build: makes task and agent of them.
        steps: actions at most.
    """

    name: str
    settings: Any
    build: Callable[[Any], Parts[Any, Any]]
    steps: int = 3


def rummaging(settings: Any) -> Parts[Any, Any]:
    spec = TASKS["mug-0"].spec
    model, tool = spec.object_factory(), make_tool(spec, free_flying=True)
    task = make_task(spec, settings.simulator, tool=tool, model=model)
    return Parts(task, build_rummager(spec, settings, model, tool))


def touching(settings: TouchBoxSettings) -> Parts[Any, Any]:
    table = clearance_table(0.03, 0.08, 0.08)
    robot = PlanarRobot(settings.task, table)
    return Parts(TouchBox(settings.task, robot), Toucher(settings.task, settings.settings, robot, table))


def handling(settings: HandleRunSettings) -> Parts[Any, Any]:
    table = handle_odds(torch.ones(9, 6, 13, dtype=torch.float64))
    return build_handle(settings.settings, tool=make_tool(task_of(settings.settings), free_flying=True), table=table)


SMALL = preset("fast", task="mug-0", method="slide", seed=3)
SMALL = replace(SMALL, initialise=replace(SMALL.initialise, particles=12, starts=40, polished=12))
MEMBERS = [
    Member("mug-0", SMALL, rummaging),
    Member(
        "touch-box",
        TouchBoxSettings(TouchSettings(count=60, actions=3), TouchTask(rates=(0.9, 0.05)), "planar"),
        touching,
    ),
    Member("peg", PegRunSettings(PegSettings(particles=150, search_particles=400)), TASKS["peg"].build, 6),
    Member("handle", HandleRunSettings(HandleSettings(steps=2), seed=1001), handling, 2),
]


class Live(NamedTuple):
    """A run and its folder."""

    member: Member
    parts: Parts[Any, Any]
    folder: Path
    records: list[Any]
    result: Any


@pytest.fixture(scope="module", params=MEMBERS, ids=lambda member: member.name)
def live(request, tmp_path_factory):
    member, records = request.param, []
    parts = member.build(member.settings)
    folder = tmp_path_factory.mktemp("runs") / "run"
    entry = TASKS[member.name]
    with entry.recorder(folder, member.settings, parts, log=False) as recorder:
        on_step = both(recorder, records.append)
        result = loop.run(*parts, seed=member.settings.seed, steps=member.steps, on_step=on_step)
        recorder.finish(result)
    return Live(member, parts, folder, records, result)


def told(result: Any) -> dict[str, Any]:
    """How a run ended, without what differs from one time to the next."""
    found = {name: value for name, value in result.as_dict().items() if name != "timings_s"}
    if isinstance(found.get("steps"), list):
        found["steps"] = [{**step, "seconds": None} for step in found["steps"]]
    return found


def test_its_parts_are_what_the_loop_asks_for(live):
    assert isinstance(live.parts.agent, Agent) and isinstance(live.parts.task, Task)
    assert [record.step for record in live.records] == list(range(len(live.records)))
    assert len(live.records) > 1, "a run without an action shows little"


def test_it_stops_for_a_reason_that_there_is(live):
    assert live.result.stopped_by in get_args(StopReason)
    assert all(set(record.timings_s) for record in live.records)


def test_its_answer_is_in_its_result(live):
    told = json.loads(json.dumps(plain(live.result.as_dict()), allow_nan=False))
    assert "motion: " in told["relies_on"] and told["relies_on"] == live.parts.agent.relies_on
    assert told["warnings"] == list(getattr(live.parts.agent, "warnings", ()))
    assert (told["why_not"] is None) == (live.result.stopped_by == "sure")
    run = load_run(live.folder)
    pose = entry_of(run).pose(replace(run, result=None))
    assert (None if pose is None else plain(pose.as_dict())) == told["pose"]
    if pose is not None:
        assert torch.linalg.eigvalsh(pose.covariance)[0] > -1e-12 and 0.0 <= pose.probability <= 1.0


def test_the_same_seed_gives_the_same_run(live):
    again: list[Any] = []
    seed = live.member.settings.seed
    result = loop.run(*live.parts, seed=seed, steps=live.member.steps, on_step=again.append)
    assert [digest(record.belief) for record in again] == [digest(record.belief) for record in live.records]
    assert told(result) == told(live.result)


def test_its_run_beside_another_is_the_same(live):
    """Two scenes step by step in turn: each is what it is alone."""
    member, seeds = live.member, (live.member.settings.seed + 1, live.member.settings.seed)
    seen: dict[int, list[str]] = {0: [], 1: []}
    with member.build(member.settings) as other:
        tasks, agents = (other.task, live.parts.task), (other.agent, live.parts.agent)
        results = run_scenes(
            tasks,
            agents,
            seeds=seeds,
            steps=member.steps,
            on_step=lambda scene, record: seen[scene].append(digest(record.belief)),
        )
    assert seen[1] == [digest(record.belief) for record in live.records] != seen[0]
    assert told(results[1]) == told(live.result)


def test_an_update_leaves_the_state_before_as_it_was(live):
    task, agent = live.parts
    state = agent.begin(task.reset(live.member.settings.seed), seed=live.member.settings.seed, clock=Clock())
    assert isinstance(state, State)
    before, belief = state.record, digest(state.record.belief)
    thought, action = agent.act(state)
    after = agent.update(thought, action, task.step(action))
    assert state.record is before and thought.record is before and digest(before.belief) == belief
    assert after.record is not before and after.record.step == 1


def test_its_folder_holds_the_run(live):
    run = load_run(live.folder)
    assert run.task == live.member.name and entry_of(run) is TASKS[live.member.name]
    assert entry_of(run).from_dict(run.settings) == live.member.settings
    assert [digest(step.belief) for step in run.steps] == [digest(record.belief) for record in live.records]
    assert [step.timings_s.keys() for step in run.steps] == [record.timings_s.keys() for record in live.records]
    assert run.ended is not None and run.ended["stopped_by"] == live.result.stopped_by


def test_its_folder_replays_bit_for_bit(live):
    opened = RunLog(live.folder)
    assert opened.problems == []
    done = replay(opened.taken(), live.parts.agent, seed=live.member.settings.seed)
    assert done.same == [True] * len(live.records)


def test_other_randomness_gives_another_belief(live):
    """A replay is no copy: with another seed the belief is another one."""
    done = replay(RunLog(live.folder).taken(), live.parts.agent, seed=live.member.settings.seed + 1)
    assert False in done.same


def test_its_folder_can_be_drawn(live, tmp_path):
    pytest.importorskip("matplotlib")
    run = load_run(live.folder)
    drawn = entry_of(run).draw(replace(run, steps=run.steps[:2]), tmp_path / "figures")
    assert drawn and all(path.stat().st_size > 1000 for path in drawn)


class Interrupted:
    """A task in the midst of whose second action somebody presses Ctrl-C."""

    def __init__(self, task: Any) -> None:
        self.task, self.steps = task, 0

    def reset(self, seed: int) -> Any:
        return self.task.reset(seed)

    def step(self, action: Any) -> Any:
        self.steps += 1
        if self.steps == 2:
            raise KeyboardInterrupt
        return self.task.step(action)

    def finish(self, action: Any) -> Any:
        pytest.fail("nothing is done after Ctrl-C")

    def close(self) -> None:
        self.task.close()


def test_ctrl_c_keeps_what_there_is(live, tmp_path):
    member, entry = live.member, TASKS[live.member.name]
    task = Interrupted(live.parts.task)
    with entry.recorder(tmp_path / "run", member.settings, live.parts, log=False) as recorder:
        result = loop.run(task, live.parts.agent, seed=member.settings.seed, steps=member.steps, on_step=recorder)
        recorder.finish(result)
    assert result.stopped_by == "interrupted"
    run = load_run(tmp_path / "run")
    assert run.ended is not None and run.ended["stopped_by"] == "interrupted"
    assert [digest(step.belief) for step in run.steps] == [digest(record.belief) for record in live.records[:2]]


def test_a_killed_run_is_there_up_to_its_last_step(live, tmp_path):
    entry = TASKS[live.member.name]
    recorder = RunRecorder(tmp_path / "run", entry.as_dict(live.member.settings))
    recorder(live.records[0])
    recorder(live.records[1])
    run = load_run(tmp_path / "run")
    assert len(run.steps) == 2 and run.ended is None and run.result is None
    assert "not finished" in RunLog(tmp_path / "run").problems[0]
    recorder.close()


def test_without_actions_it_reads_once_and_ends(live):
    records: list[Any] = []
    result = loop.run(*live.parts, seed=live.member.settings.seed, steps=0, on_step=records.append)
    assert len(records) == 1 and result.stopped_by in ("steps", "sure")


def test_of_two_runs_one_gets_the_folder(live, tmp_path):
    entry = TASKS[live.member.name]
    first = RunRecorder(tmp_path / "run", entry.as_dict(live.member.settings))
    with pytest.raises(UsageError, match="holds a run already"):
        RunRecorder(tmp_path / "run", entry.as_dict(live.member.settings))
    first.close()
    assert load_run(tmp_path / "run").steps == []
