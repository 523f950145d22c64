"""What a viewer shows of a touch-box run."""

from dataclasses import replace

import pytest
import torch

from rumi import loop
from rumi.dynamics.along_path import Pusher
from rumi.dynamics.outline import RectangleOutline
from rumi.runs.folder import RunRecorder, load_run
from rumi.tasks.grasp_table import clearance_table
from rumi.tasks.touch_box.agent import Toucher
from rumi.tasks.touch_box.planar_robot import PlanarRobot
from rumi.tasks.touch_box.records import TouchRun
from rumi.tasks.touch_box.robot import TouchBox
from rumi.tasks.touch_box.scene import TouchTask
from rumi.tasks.touch_box.settings import TouchSettings
from rumi.tasks.touch_box.view import TouchView, poke_odds

TASK = TouchTask(rates=(0.9, 0.05))
TABLE = clearance_table(0.03, 0.08, 0.08)
SETTINGS = TouchSettings(count=100, actions=2, threshold=1.0)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run") / "run"
    agent = Toucher(TASK, SETTINGS, PlanarRobot(TASK, TABLE), TABLE)
    with RunRecorder(folder, {"task": "touch-box", "seed": 2001}) as recorder:
        recorder.finish(loop.run(TouchBox(TASK, agent.robot), agent, seed=2001, on_step=recorder))
    return load_run(folder)


def test_a_step_shows_readings_grasp_and_truth(run):
    view, pose = TouchView(TASK, SETTINGS), TouchRun.of(run).pose
    first, last = view.step(run.steps[:1], pose), view.step(run.steps, pose)
    assert "contacts" not in first.scene and {"grasp", "truth"} <= set(first.scene)
    touched = run.steps[-1].touched
    felt, unfelt = (last.scene[name].points for name in ("contacts", "readings_without_contact"))
    assert len(felt) == int(touched.contact.sum()) and len(felt) + len(unfelt) == len(touched.contact)
    assert len(last.scene["tool/path"].lines) == 2 and len(last.scene["grasp"].lines) == 3
    assert last.curves["right/lift"] == run.steps[-1].grasp.probability
    assert set(last.curves) == {"right/lift", "nll/true"}


def test_a_decision_shows_the_rejected_pokes_and_says_why(run):
    view = TouchView(TASK, SETTINGS)
    record = run.steps[-1]
    found = view.decision(run.steps)
    assert len(found.scene["samples"].lines) == len(record.candidates) - 1
    chosen = record.candidates[record.choice.best, :, :2].numpy()
    assert abs(found.scene["path"].lines[0][:, :2] - chosen).max() < 1e-12
    assert found.curves["gain/chosen"] == float(record.choice.value.max()) >= found.curves["gain/next_best"]
    for word in ("gain", "where", "odds", "risk", "grasp"):
        assert f"**{word}**" in found.words
    assert f"{found.curves['gain/chosen']:.3g} (nats, by `sequence`)" in found.words
    # the best of those that were rejected is the darkest of them, the worst the palest
    shade = [sum(colour) for colour in found.scene["samples"].colours]
    value = record.choice.value[torch.arange(len(record.candidates)) != record.choice.best]
    assert int(value.argmax()) == shade.index(min(shade)) and int(value.argmin()) == shade.index(max(shade))


def test_a_replay_decides_nothing(run):
    taken = [run.steps[0], replace(run.steps[1], candidates=None, choice=None)]
    assert TouchView(TASK, SETTINGS).decision(taken) is None


def test_odds_of_a_poke_are_those_of_plain_geometry():
    """A round finger goes 40 cm along x; a box stands on its start, one 20 cm ahead, and one aside."""
    path = torch.linspace(0.0, 0.4, 41, dtype=torch.float64)[:, None] * torch.tensor([1.0, 0.0, 0.0])
    poses = torch.tensor([[0.0, 0.0, 0.3], [0.2, 0.0, 0.0], [0.2, 0.5, 0.0]], dtype=torch.float64)
    weights = torch.tensor([0.2, 0.5, 0.3], dtype=torch.float64).log()
    finger = Pusher.disc(0.0101, poses)
    odds = poke_odds(path, poses, weights, finger, RectangleOutline((0.03, 0.08)))
    assert odds.blocked == pytest.approx(0.2) and odds.touches == pytest.approx(0.5)
    assert odds.push_m == pytest.approx(0.4 - 0.16, abs=1e-9), "it meets the near side at x = 16 cm"
    aside = poke_odds(path, poses[2:], weights[2:], finger, RectangleOutline((0.03, 0.08)))
    assert aside == (0.0, 0.0, 0.0)
