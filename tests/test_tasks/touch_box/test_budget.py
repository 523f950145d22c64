"""Choosing a poke within a time, on a clock that is told how long things take."""

import json
from pathlib import Path

import pytest
import torch

from rumi import exit_codes, loop
from rumi.cli import main
from rumi.clock import SimulatedClock
from rumi.errors import UsageError
from rumi.tasks.grasp_table import clearance_table
from rumi.tasks.touch_box.agent import Toucher
from rumi.tasks.touch_box.budget import BudgetedChoice
from rumi.tasks.touch_box.planar_robot import PlanarRobot
from rumi.tasks.touch_box.robot import TouchBox
from rumi.tasks.touch_box.scene import TouchTask
from rumi.tasks.touch_box.settings import TouchSettings

pytestmark = pytest.mark.outcome

TASK = TouchTask(rates=(0.9, 0.05))
TABLE = clearance_table(0.03, 0.08, 0.08)


class Slow(Toucher):
    """On a machine where candidates take 0.02 s to make and one takes 0.1 s to weigh, a second the first time."""

    def __init__(self, clock, method="sequence"):
        super().__init__(TASK, TouchSettings(count=100, method=method, actions=1), PlanarRobot(TASK, TABLE), TABLE)
        self.clock, self.loaded = clock, []

    def candidates(self, belief, *, generator):
        self.clock.advance(0.02)
        return super().candidates(belief, generator=generator)

    def rollouts(self, belief, paths, rows):
        self.clock.advance((0.1 if self.loaded else 1.0) * len(paths))
        self.loaded.append(True)
        return super().rollouts(belief, paths, rows)


def decided(budget_s, method="sequence", decisions=1):
    clock = SimulatedClock()
    toucher = Slow(clock, method)
    belief = toucher.filter.initial(1, 100, generator=torch.Generator().manual_seed(0))
    choose, generator = BudgetedChoice(toucher, budget_s, clock), torch.Generator().manual_seed(1)
    choose._learn(belief)
    for _ in range(decisions):
        begun = clock()
        paths, choice = choose(belief, generator=generator)
    return toucher, belief, paths, choice, clock() - begun


@pytest.mark.parametrize(("budget_s", "weighed"), [(0.01, 0), (0.2, 0), (0.45, 3), (1.45, 13), (9.0, 20)])
def test_as_many_are_weighed_as_there_is_time_for(budget_s, weighed):
    """The bound on few measurements is twice what one takes: 0.02 s to make them, then one while 0.2 s are left."""
    toucher, belief, paths, choice, took = decided(budget_s)
    assert took == pytest.approx(0.02 + 0.1 * weighed) and took <= max(budget_s, 0.02) + 1e-9
    assert len(paths) == len(choice.value) == len(choice.steps) == max(1, weighed)
    whole, all_of_them = toucher.decide(belief, generator=torch.Generator().manual_seed(1))
    assert torch.equal(paths, whole[: len(paths)])
    if weighed:
        # as they are weighed together
        assert torch.allclose(choice.value, all_of_them.value[:weighed], atol=1e-9)
        # of those that are worth the same either may come out best
        assert float(all_of_them.value[choice.best]) >= float(all_of_them.value[:weighed].max()) - 1e-9
        assert torch.equal(choice.steps, all_of_them.steps[:weighed])
    else:
        assert choice.best == 0 and int(choice.steps[0]) == paths.shape[1] - 1


@pytest.mark.parametrize("method", ["entropy", "max-contact", "ml-observation", "uninformed"])
def test_other_methods_within_a_time(method):
    toucher, belief, _, choice, took = decided(9.0, method)
    _, whole = toucher.decide(belief, generator=torch.Generator().manual_seed(1))
    assert took == pytest.approx(2.02) and len(choice.value) == 20
    if method != "uninformed":
        assert torch.allclose(choice.value, whole.value, atol=1e-9)
        assert float(whole.value[choice.best]) >= float(whole.value.max()) - 1e-9


def test_a_run_within_a_time():
    clock = SimulatedClock()
    toucher = Slow(clock)
    toucher.chooser = BudgetedChoice(toucher, 0.45, clock)
    run = loop.run(TouchBox(TASK, toucher.robot), toucher, seed=2001)
    assert run.steps and all(1 <= len(step.choice.value) <= 4 for step in run.steps)
    with pytest.raises(UsageError, match="budget above 0 s"):
        BudgetedChoice(toucher, 0.0)


def test_the_command(monkeypatch, tmp_path, capsys):
    pytest.importorskip("mujoco")
    monkeypatch.setattr("rumi.tasks.touch_box.grasps.grasp_table", lambda *a, **k: TABLE)
    monkeypatch.chdir(tmp_path)
    quick = ["run", "touch-box", "--robot", "planar", "--count", "60", "--actions", "1", "--no-figures"]
    quick += ["--poke.candidates", "3", "--poke.particles", "20"]
    assert main([*quick, "--plan-budget-s", "0.05", "--out", "own"]) in (exit_codes.DONE, exit_codes.NOT_CONVERGED)
    assert json.loads(Path("own/settings.json").read_text())["plan_budget_s"] == 0.05
    for bad in ("0", "-1", "nan", "inf"):
        assert main([*quick, "--plan-budget-s", bad]) == exit_codes.BAD_INPUT
        assert "--plan-budget-s above 0 s" in capsys.readouterr().err
