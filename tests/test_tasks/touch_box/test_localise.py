"""The loop, closed on the quasi-static robot."""

import math
from dataclasses import replace

import pytest
import torch

from rumi import loop
from rumi.tasks.grasp_table import clearance_table
from rumi.tasks.touch_box.agent import Toucher, likeliest
from rumi.tasks.touch_box.planar_robot import PlanarRobot
from rumi.tasks.touch_box.records import signals
from rumi.tasks.touch_box.robot import TouchBox, Touched
from rumi.tasks.touch_box.scene import TouchTask
from rumi.tasks.touch_box.selection import choose
from rumi.tasks.touch_box.settings import PokeSettings, TouchSettings
from scripts.reproduce.touch_report import calibration, summarise, table

pytestmark = pytest.mark.outcome

TASK = TouchTask(rates=(0.9, 0.05))
TABLE = clearance_table(0.03, 0.08, 0.08)
SETTINGS = TouchSettings(count=200)


def toucher(settings=SETTINGS, task=TASK):
    return Toucher(task, settings, PlanarRobot(task, TABLE), TABLE)


def run_of(own, seed):
    return loop.run(TouchBox(own.task, own.robot), own, seed=seed)


def test_it_finds_the_box_and_lifts_it():
    own = replace(SETTINGS, count=800)  # with 200 and readings as sharp as these, four of ten fail
    runs = [run_of(toucher(own), seed) for seed in (2000, 2001, 2002)]
    assert sum(run.lifted for run in runs) >= 2  # at a threshold of 0.92 one may fail
    assert all(1 <= len(run.steps) <= 15 for run in runs)
    for run in runs:
        assert (run.stopped_by == "sure") == (run.end.grasp.probability >= SETTINGS.threshold)
        if run.lifted:
            assert float((run.end.grasp.pose - run.end.truth)[:2].norm()) < 0.085


def test_it_gives_up_after_so_many_pokes_and_grasps_all_the_same():
    run = run_of(toucher(replace(SETTINGS, actions=1, threshold=1.0)), 2000)
    assert len(run.steps) == 1 and run.stopped_by == "steps" and run.as_dict()["lifted"] is run.lifted
    assert replace(run, stopped_by="interrupted", lifted=None).as_dict()["lifted"] is None


@pytest.mark.parametrize("method", ["entropy", "max-contact", "ml-observation"])
def test_other_methods_choose_too(method):
    run = run_of(toucher(replace(SETTINGS, method=method, actions=2)), 2001)
    assert len(run.steps) <= 2
    assert all(len(step.choice.value) == 20 for step in run.steps)


def test_a_poke_ends_where_the_belief_expects_contact():
    """All particles in one place: the poke ends three readings after the tool got there, whatever it feels."""
    own = toucher()
    generator = torch.Generator().manual_seed(0)
    belief = own.filter.initial(1, 50, generator=generator)
    belief = replace(belief, pose=torch.tensor([0.4, 0.0, 0.0], dtype=torch.float64).expand(1, 50, 3).clone())
    share = torch.linspace(0.0, 1.0, 41, dtype=torch.float64)[:, None]
    path = torch.tensor([[0.25, 0.0, 0.0]], dtype=torch.float64) + share * torch.tensor([[0.2, 0.0, 0.0]]).double()
    own.robot.reset(own_truth(), 0)
    touched = own.robot.execute(path, own.watch(belief, path))
    assert touched.stopped == "belief"
    # at 0.36 the finger touches the box
    assert float(touched.path[-1, 0]) == pytest.approx(0.36 + 0.01, abs=0.006)


def own_truth():
    from rumi.tasks.touch_box.scene import BoxTruth

    return BoxTruth(torch.tensor([0.4, 0.0, 0.0], dtype=torch.float64), 0.4, 0.4, 0.5)


def test_a_decision_has_a_candidate_for_each_that_was_asked_for():
    own = toucher()
    generator = torch.Generator().manual_seed(0)
    belief = own.filter.initial(1, 200, generator=generator)
    paths, choice = own.decide(belief, generator=generator)
    assert paths.shape == (20, 41, 3)
    assert choice.value.shape == (20,)


def test_the_likeliest_particle_is_the_heaviest_with_its_copies_and_else_the_one_that_fits():
    own = toucher()
    belief = own.filter.initial(1, 50, generator=torch.Generator().manual_seed(0))

    def found(weights=None, **changes):
        log = torch.zeros(1, 50, dtype=torch.float64) if weights is None else weights
        return likeliest(replace(belief, log_weights=log.log_softmax(-1), **changes), TASK.prior, own.support.metric)

    heavy = torch.zeros(1, 50, dtype=torch.float64)
    heavy[0, 17] = 1.0
    assert found(heavy) == 17
    # nine copies together weigh more than one that weighs twice as much as the others
    heavy[0, 17] = math.log(2.0)
    copies = belief.pose.clone()
    copies[0, 30:39] = copies[0, 5]
    assert found(heavy, pose=copies) == 5
    # all alike: by the readings, and before there are any by the prior
    fits = torch.zeros_like(heavy)
    fits[0, 41] = 100.0
    assert found(log_likelihood=fits) == 41
    assert found() == int(TASK.prior.log_density(belief.start[0]).argmax())


def test_the_reading_that_is_simulated_is_the_likeliest_particle_s(monkeypatch):
    """However few are rolled out, and wherever in the belief it is."""
    seen = []

    def watched(method, given, **named):
        seen.append(given.rollouts)
        return choose(method, given, **named)

    monkeypatch.setattr("rumi.tasks.touch_box.agent.choose", watched)
    own = toucher(replace(SETTINGS, method="ml-observation", poke=PokeSettings(candidates=3, particles=20)))
    belief = own.filter.initial(1, 200, generator=torch.Generator().manual_seed(0))
    weights = torch.zeros(1, 200, dtype=torch.float64)
    weights[0, 77] = 0.5  # too light to be sure to be drawn
    belief = replace(belief, log_weights=weights.log_softmax(-1))
    for seed in range(5):
        own.decide(belief, generator=torch.Generator().manual_seed(seed))
    for rollouts in seen:
        assert torch.equal(rollouts.states[0, 0, rollouts.likeliest], belief.pose[0, 77])
        torch.testing.assert_close(rollouts.log_weights.exp()[:20], torch.full((20,), 0.05, dtype=torch.float64))
        assert float(rollouts.log_weights.exp().sum()) == pytest.approx(1.0)


def test_a_robot_that_cannot_follow_all_paths_is_asked_for_those_it_can():
    class Picky(PlanarRobot):
        def feasible(self, paths):
            return paths[:, 0, 0] < paths[:, -1, 0]  # from the base's side alone

    own = Toucher(TASK, SETTINGS, Picky(TASK, TABLE), TABLE)
    generator = torch.Generator().manual_seed(0)
    found = own.candidates(own.filter.initial(1, 200, generator=generator), generator=generator)
    assert bool(own.robot.feasible(found).all())


def test_the_tables_say_what_the_runs_did():
    def line(seed, lifted, actions, believed):
        steps = [{"readings": "01", "seconds": {"plan": 0.1, "robot": 5.0}}] * actions
        return {
            **{"seed": seed, "lifted": lifted, "sure": believed > 0.9, "actions": actions},
            **{"believed": believed, "steps": steps},
        }

    first = [line(0, True, 4, 0.95), line(1, True, 6, 0.93)]
    other = [line(0, False, 9, 0.5), line(1, True, 8, 0.99), line(2, True, 5, 0.99)]
    summary = summarise(first)
    assert (summary.runs, summary.lifted, summary.actions, summary.readings) == (2, 2, 5.0, 2.0)
    assert summary.seconds == pytest.approx(0.1)
    text = table({"one": first, "two": other})
    assert "| one | 2/2 = 1.00" in text
    assert "| two | -3.5 ± 2.9 (n = 2) | 1 | 0 |" in text
    assert "| 0.90 to 0.95 | 1 | 0.93 | 1/1" in calibration(first)
    assert "| sure (threshold reached) | 2 | 0.94 | 2/2 = 1.00" in calibration(first)


def test_signals_are_a_word():
    assert signals(torch.tensor([True, False, True])) == "101"


def test_priors_are_the_default_box_s_to_the_last_digit_and_go_with_another():
    usual = TouchSettings().filter
    assert toucher().filter.settings.lever_m == usual.lever_m
    assert toucher().filter.settings.friction == usual.friction
    small = replace(TASK, half=(0.015, 0.04), friction=(0.3, 0.5))
    own = toucher(task=small).filter.settings
    assert own.lever_m == pytest.approx([0.5 * end for end in usual.lever_m])
    # half as wide, about the same middle: 0.1 to 0.7 about 0.2 to 0.6
    assert own.friction == pytest.approx((0.25, 0.55))
    known = replace(SETTINGS, filter=replace(usual, friction=(0.4, 0.4)))
    assert toucher(known, replace(TASK, friction=(0.5, 0.9))).filter.settings.friction == pytest.approx((0.7, 0.7))


def test_a_step_of_a_likelihood_is_where_simulated_readings_have_it():
    model = toucher(replace(SETTINGS, decay=None)).filter.model
    found = model(torch.tensor([-1e-3, 1.9e-4, 2.1e-4, 1e-2], dtype=torch.float64))
    torch.testing.assert_close(found, torch.tensor([0.9, 0.9, 0.05, 0.05], dtype=torch.float64))


def test_a_poke_out_of_reach_is_no_evidence():
    """Nothing moved, nothing was felt: all particles weigh what they did, also one that stands in the way."""

    class Short(PlanarRobot):
        def execute(self, path, go_on):
            return Touched(path[:1], torch.zeros(0, dtype=torch.bool), None, "reach")

    own = Toucher(TASK, replace(SETTINGS, actions=1), Short(TASK, TABLE), TABLE)
    (step,) = run_of(own, 2000).steps
    assert torch.equal(step.belief[1], torch.zeros(200, dtype=torch.float64).log_softmax(-1))


def test_readings_that_repeat_their_errors_count_for_less():
    task = replace(TASK, correlation=0.5)
    assert toucher(task=task).filter.settings.temper == pytest.approx(1.0 / 3.0)
    assert toucher(replace(SETTINGS, weigh_correlated=False), task).filter.settings.temper == 1.0
    robot = PlanarRobot(TASK, TABLE)
    robot.correlation, robot.rates = 0.0, (0.8, 0.02)  # a robot's own are taken for the task's
    own = Toucher(task, SETTINGS, robot, TABLE)
    assert own.filter.settings.temper == 1.0
    assert float(own.filter.model(torch.zeros(1, dtype=torch.float64))) == pytest.approx(0.8)
