"""The loop with a task that is told beforehand: what its records say of each step."""

from dataclasses import dataclass, replace
from typing import get_args

import pytest
import torch

from rumi import loop
from rumi.agent import StopReason, stop_reason
from rumi.belief.initialise import InitialiseSettings
from rumi.belief.pose_filter import FilterSettings, PoseFilter
from rumi.belief.prior import PosePrior
from rumi.belief.reinitialise import ReinitialiseSettings
from rumi.fields.workspace import Workspace
from rumi.information.stopping import StopSettings
from rumi.planning.rummaging import RummagingPolicy
from rumi.records import StepRecord
from rumi.registration.descent import DescentSettings
from rumi.robot.tool import Tool
from rumi.runs.replay import LogTask, Repeat
from rumi.session import Session, run_scenes
from rumi.tasks.rummage.agent import Rummager
from sdf import se3
from sdf.object_model import box_model
from sensors.discrepancy import Discrepancy
from sensors.log.reader import Taken
from sensors.observation import Observation
from sensors.reading import Reading
from sensors.semantics import Semantics
from tests.fixtures.readings import make_reading

BOUNDS = torch.tensor([[0.2, -0.2, 0.02], [0.6, 0.2, 0.02]])
QUICK = DescentSettings(iterations=1)


def reading(observation: Observation, *, touched: bool) -> Reading:
    return make_reading(observation, motion=se3.identity((1,)), contact=touched)


def test_a_step_after_which_poses_were_drawn_anew_keeps_all_its_seconds() -> None:
    """The last step of a run that ends sure is looked at twice; its first look's seconds are its own, too."""
    box = box_model()
    prior = PosePrior.of((0.4, 0.0), 0.02, box.sdf.bounds, ("z",))
    truth = se3.from_planar(torch.tensor([0.4, 0.0, 0.2])) @ prior.ways[0]
    felt = Observation.of(se3.apply(truth, box.surface_points), Semantics.SURFACE)
    nothing = reading(Observation.empty(), touched=False)
    taken = [
        Taken(nothing, None, None, None),
        Taken(nothing, torch.zeros(3), None, None),
        Taken(replace(reading(felt, touched=True), stamp=1.0), torch.zeros(3), None, None),
    ]
    task = LogTask(taken)
    rummager = Rummager(
        box,
        PoseFilter(FilterSettings(descent=QUICK), [Discrepancy(box.sdf, box.radius)], "SE(3)", prior),
        RummagingPolicy(torch.ones(0)),
        Workspace.from_bounds(BOUNDS, 0.05, planar_height=0.02),
        Tool(BOUNDS[:, :2]),
        initialise=InitialiseSettings(particles=20),
        renewal=ReinitialiseSettings(starts=50, polished=10, coarse=QUICK, fine=QUICK),
        stop_rule=StopSettings(expected_nll=1e6, fit=1e6),
        agreement_points=10,
    )
    steps: list[StepRecord] = []
    result = loop.run(task, Repeat(rummager, [torch.zeros(3)] * 2), seed=0, steps=2, on_step=steps.append)
    assert result.stopped_by == "sure"
    assert [sorted(step.timings_s) for step in steps[1:]] == [["agree", "belief", "score", "simulate"]] * 2
    total = sum(sum(step.timings_s.values()) for step in steps)
    assert sum(result.timings_s.values()) == total


@dataclass(frozen=True)
class Counted:
    """Record and state in one: how many actions there were."""

    step: int = 0

    @property
    def record(self):
        return self


@dataclass(frozen=True)
class Counter:
    """Counts up to a number, and does nothing from another on."""

    enough: int = 9
    idle: int = 9

    def begin(self, result, *, seed, clock):
        return Counted()

    def stop(self, state):
        return "sure" if state.step >= self.enough else None

    def act(self, state):
        return state, None if state.step >= self.idle else "on"

    def update(self, state, action, result):
        return Counted(state.step + 1)

    def last(self, state):
        return None if state.step == 0 else "grasp"

    def result(self, state, stopped_by, outcome):
        return state.step, stopped_by, outcome


class Told:
    """A task that writes down what it is asked."""

    def __init__(self, interrupt=None):
        self.asked, self.interrupt = [], interrupt

    def _ask(self, what):
        self.asked.append(what)
        if what == self.interrupt:
            raise KeyboardInterrupt
        return what

    def reset(self, seed):
        return self._ask(f"reset {seed}")

    def step(self, action):
        return self._ask(action)

    def finish(self, action):
        return self._ask(action)

    def close(self):
        pass


@pytest.mark.parametrize(
    ("agent", "steps", "result"),
    [
        (Counter(enough=2), None, (2, "sure", "grasp")),
        (Counter(enough=2), 2, (2, "sure", "grasp")),
        (Counter(), 1, (1, "steps", "grasp")),
        (Counter(), 0, (0, "steps", None)),
        (Counter(idle=2), 5, (2, "nothing to do", "grasp")),
        (Counter(idle=0), None, (0, "nothing to do", None)),
        (Counter(enough=0), 5, (0, "sure", None)),
    ],
)
def test_it_reads_and_acts_until_there_is_a_reason_to_stop_and_then_does_the_last_thing(agent, steps, result):
    task, seen = Told(), []
    assert loop.run(task, agent, seed=7, steps=steps, on_step=seen.append) == result
    done = result[0]
    assert task.asked == ["reset 7", *["on"] * done, *(["grasp"] if done else [])]
    assert [record.step for record in seen] == list(range(done + 1))


def test_ctrl_c_ends_it_with_what_it_has():
    assert loop.run(Told("on"), Counter(), seed=0) == (0, "interrupted", None)
    assert loop.run(Told("grasp"), Counter(enough=1), seed=0) == (1, "interrupted", None)
    with pytest.raises(KeyboardInterrupt):
        loop.run(Told("reset 0"), Counter(), seed=0)


def test_a_run_to_the_end_is_no_result_where_ctrl_c_cut_it_off():
    seen = []
    assert loop.run_to_end(Told(), Counter(), seed=7, steps=2, on_step=seen.append) == (2, "steps", "grasp")
    assert [record.step for record in seen] == [0, 1, 2]
    for where in ("reset 0", "on", "grasp"):
        with pytest.raises(KeyboardInterrupt):
            loop.run_to_end(Told(where), Counter(enough=1), seed=0)
    with pytest.raises(KeyboardInterrupt):
        loop.run_to_end(Told(), Impatient(), seed=0)


def test_records_of_before_tell_their_end_in_todays_words():
    former = {"converged": "sure", "actions": "steps", "time": "nothing to do", "stay": "nothing to do"}
    assert {word: stop_reason(word) for word in former} == former
    assert [stop_reason(word) for word in get_args(StopReason)] == list(get_args(StopReason))
    assert stop_reason("degenerate") == "degenerate"


def test_scenes_side_by_side_are_asked_and_end_as_each_alone():
    agents = [Counter(enough=3), Counter(idle=1), Counter(enough=0), Counter()]
    tasks, seen = [Told() for _ in agents], []
    results = run_scenes(
        tasks, agents, seeds=[5, 6, 7, 8], steps=4, on_step=lambda scene, record: seen.append((scene, record.step))
    )
    for scene, (agent, task) in enumerate(zip(agents, tasks, strict=True)):
        alone, steps = Told(), []
        assert results[scene] == loop.run(alone, agent, seed=5 + scene, steps=4, on_step=steps.append)
        assert task.asked == alone.asked
        assert [step for own, step in seen if own == scene] == [record.step for record in steps]
    with pytest.raises(ValueError, match="an agent for each of 4 tasks"):
        run_scenes(tasks, agents[:2], seeds=[0, 1])
    with pytest.raises(ValueError, match="an agent and a seed"):
        run_scenes(tasks, agents, seeds=[0])


def test_one_steps_in_and_out_of_a_session():
    session = Session([Counter(enough=1), Counter(idle=2)], seeds=[0, 1])
    assert session.step(["first", "view"]) == ["on", "on"]
    assert session.step(["felt", "felt"]) == [loop.Last("grasp"), "on"]
    assert session.step(["lifted", "felt"]) == [None, loop.Last("grasp")]
    assert session.results == [(1, "sure", "lifted"), None] and session.stopped_by == ["sure", None]
    session.interrupt()
    assert session.results[1] == (2, "interrupted", None)
    assert session.step([None, None]) == [None, None]
    with pytest.raises(ValueError, match="a reading for each of 2 scenes"):
        session.step(["one"])


class Impatient(Counter):
    """Somebody presses Ctrl-C while it thinks of its second action."""

    def act(self, state):
        if state.step == 1:
            raise KeyboardInterrupt
        return super().act(state)


def test_ctrl_c_ends_all_scenes_with_what_they_have():
    counters = [Counter(), Counter(enough=1), Counter()]
    assert run_scenes([Told(), Told(), Told("on")], counters, seeds=[0, 0, 0]) == [(0, "interrupted", None)] * 3
    thinking = [Counter(), Impatient(), Counter(enough=1)]
    ended = [(1, "interrupted", None), (1, "interrupted", None), (0, "interrupted", None)]
    assert run_scenes([Told(), Told(), Told()], thinking, seeds=[0, 0, 0]) == ended
