"""The push model that is MuJoCo: like the simulator, the same with any number of threads, and skipping what it may."""

import importlib.util
import math
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import torch
from torch import Tensor

from rumi.dynamics.outline import GridOutline, support_of
from rumi.dynamics.quasi_static import QuasiStaticRollouts
from rumi.dynamics.registry import EngineSettings, PushModels, PushSettings
from rumi.fields.information import information_field
from rumi.fields.workspace import Workspace
from rumi.robot.tool import Tool
from rumi.sim.push_model import MujocoRollouts
from rumi.sim.world import World
from rumi.tasks.rummage.build import build
from rumi.tasks.rummage.scenes import make_tool
from rumi.tasks.rummage.settings import preset
from sdf import se3, so3
from sdf.object_model import ObjectModel, object_model
from sdf.primitives import Mug
from sdf.symmetry import Symmetries

pytestmark = pytest.mark.sim

HEIGHT = 0.045
FREE = torch.tensor([[-5.0, -5.0], [5.0, 5.0]])
START = torch.tensor([0.22, 0.0, 0.0])


@pytest.fixture(scope="module")
def mug() -> ObjectModel:
    return object_model("mug", Mug(), Symmetries.none(), spacing=0.002, points=20)


def make(mug: ObjectModel, yaws: list[float], settings: EngineSettings | None = None) -> MujocoRollouts:
    poses = se3.from_planar(torch.tensor([[0.4, 0.0, yaw] for yaw in yaws]))
    return MujocoRollouts(mug, poses, torch.zeros(len(yaws)).log_softmax(-1), Tool(FREE, height_m=HEIGHT), settings)


def ways() -> Tensor:
    """One that misses, one that pushes head-on, one that pushes aside."""
    controls = torch.zeros(3, 2, 3)
    controls[0, :, 0], controls[1, :, 0], controls[2, :, 0] = -0.5, 0.9, 0.9
    controls[2, :, 1] = 0.25
    return controls


def test_it_is_what_the_simulator_does(mug: ObjectModel) -> None:
    settings = EngineSettings(time_step_s=0.004)
    model = make(mug, [1.0], settings)
    found = model.rollout(START, ways(), rollouts=1)
    world = World(mug.exact, model.tool.shape, HEIGHT, 0.004)
    for k in (1, 2):
        world.reset(START, torch.tensor([0.4, 0.0, 1.0]))
        before = se3.to_planar(world.world_T_object())
        now = START
        for h in range(2):
            path = model.tool.free_path(now, ways()[k, h][None], 20)
            world.move(path, settings.action_s, settings.hold_s)
            now = path[-1]
        after = se3.to_planar(world.world_T_object())
        assert float((after - before)[:2].norm()) > 0.02
        shift = found.displacements[k, 0, -1, :2].double()
        assert float((shift - (after - before)[:2]).norm()) < 1e-3
        assert abs(float(found.turns[k, 0, -1]) - float(after[2] - before[2])) < 0.02


def test_threads_change_nothing(mug: ObjectModel) -> None:
    one, two = (make(mug, [0.2, 1.0, -1.0], EngineSettings(threads=count)) for count in (1, 2))
    first, second = (model.rollout(START, ways(), rollouts=3) for model in (one, two))
    assert torch.equal(first.displacements, second.displacements)
    assert torch.equal(first.turns, second.turns)
    again = one.rollout(START, ways(), rollouts=3)
    assert torch.equal(first.displacements, again.displacements)


def test_what_is_skipped_would_have_changed_nothing(mug: ObjectModel) -> None:
    """A way of five actions of which the first come not near."""
    far = torch.tensor([0.0, 0.0, 0.0])
    ahead = torch.zeros(1, 5, 3)
    ahead[0, :, 0] = 1.0
    model, all_of_it = make(mug, [0.7]), make(mug, [0.7])
    all_of_it.reach = 10.0
    found, whole = model.rollout(far, ahead, rollouts=1), all_of_it.rollout(far, ahead, rollouts=1)
    assert found.checked < whole.checked == 1
    assert float(whole.displacements[0, 0, -1].norm()) > 0.01
    torch.testing.assert_close(found.displacements, whole.displacements, atol=5e-4, rtol=0)


def test_agrees_with_the_quasi_static_model(mug: ObjectModel) -> None:
    engine = make(mug, [0.2, 1.0, 2.5, -1.5])
    outline, support = GridOutline.of_slice(mug.sdf, HEIGHT), support_of(mug.sdf)
    poses = se3.from_planar(engine.poses)
    plain = QuasiStaticRollouts(outline, support, engine.tool, poses, engine.weights.log())
    a, b = (model.rollout(START, ways(), rollouts=4) for model in (engine, plain))
    assert torch.equal(a.touched, b.touched)
    touched = a.touched
    error = (a.displacements - b.displacements)[:, :, -1].norm(dim=-1)[touched]
    assert float(a.displacements[:, :, -1].norm(dim=-1)[touched].median()) > 0.03
    assert float(error.median()) < 0.01
    assert float((a.turns - b.turns)[:, :, -1][touched].abs().median()) < math.radians(10)


def test_a_tool_in_space_pushes_as_a_level_one_and_passes_over(mug: ObjectModel) -> None:
    """At the level one's height; a hand above the rim touches nothing."""
    level = make(mug, [0.2, 1.0])
    space = Tool(torch.tensor([[-5.0, -5.0, 0.0], [5.0, 5.0, 0.5]]))
    model = MujocoRollouts(mug, se3.from_planar(level.poses), level.weights.log(), space)
    controls = torch.cat((ways()[..., :2], torch.zeros(3, 2, 1), ways()[..., 2:]), -1)
    start = torch.tensor([0.22, 0.0, HEIGHT, 0.0])
    a, b = level.rollout(START, ways(), rollouts=2), model.rollout(start, controls, rollouts=2)
    assert torch.equal(a.touched, b.touched)
    assert b.configurations.shape == (3, 2, 3, 4)
    assert float(b.displacements[1, :, -1].norm(dim=-1).min()) > 0.02
    # its drive gives way: it lags where it meets the mug
    torch.testing.assert_close(a.displacements, b.displacements, atol=3e-3, rtol=0)
    torch.testing.assert_close(a.turns, b.turns, atol=0.05, rtol=0)
    above = model.rollout(torch.tensor([0.22, 0.0, 0.3, 0.0]), controls, rollouts=2)
    assert not bool(above.touched.any())
    assert float(above.displacements.abs().max()) == 0


@pytest.mark.parametrize(("tilt", "name"), [(0.0, "mujoco"), (8.0, "mujoco"), (40.0, "displacement")])
def test_what_a_tool_in_space_has_tilted_is_pushed_and_what_it_toppled_is_not(
    tilt: float, name: str, mug: ObjectModel
) -> None:
    space = Tool(torch.tensor([[-5.0, -5.0, 0.0], [5.0, 5.0, 0.5]]))
    lean = se3.make(so3.exp(torch.tensor([0.0, math.radians(tilt), 0.0])), torch.tensor([0.0, 0.0, 0.01]))
    poses = torch.stack((se3.from_planar(torch.tensor([0.4, 0.0, 0.7])),) * 2)
    poses[1] = poses[1] @ lean
    family = PushModels(PushSettings("mujoco"))
    assert family.chosen(poses, space) == name
    level = Tool(FREE, height_m=HEIGHT)
    assert family.chosen(poses, level) == "mujoco"
    if name == "mujoco":
        workspace = Workspace.from_bounds(torch.tensor([[0.2, -0.2, 0.0], [0.6, 0.2, 0.1]]), 0.05)
        even = torch.zeros(2).log_softmax(-1)
        fields = information_field(mug.sdf, poses, even, workspace.points)
        made = family.rollouts(mug, poses, even, space, workspace, fields)
        assert isinstance(made, MujocoRollouts)
        assert float(made.poses[1, 2]) == pytest.approx(0.7, abs=0.05)


@pytest.mark.parametrize("task", ["mug-0", "drill-0"])
def test_a_run_may_plan_with_it(task: str, monkeypatch: pytest.MonkeyPatch, cache: Path) -> None:
    # without the arm's reach, which takes seconds and changes no push
    monkeypatch.setattr("rumi.tasks.rummage.build.make_tool", partial(make_tool, free_flying=True))
    settings = preset(task=task, steps=1)
    few = replace(settings.planner.mppi, samples=4, horizon=2, knots=2, warmup_iterations=1, iterations=1)
    planner = replace(settings.planner, push_model="mujoco", mppi=few, rollouts=1)
    parts = build(replace(settings, planner=planner), cache_dir=cache)
    policy = parts.agent.policy
    assert isinstance(policy.push_models, PushModels)  # type: ignore[attr-defined]
    assert policy.push_models.settings.push_model == "mujoco"  # type: ignore[attr-defined]
    parts.task.close()


def test_the_script_says_which_model_is_nearest(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    script = Path(__file__).resolve().parents[2] / "scripts" / "push_models.py"
    spec = importlib.util.spec_from_file_location(script.stem, script)
    module = importlib.util.module_from_spec(spec)
    sys.modules[script.stem] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    monkeypatch.setattr(sys, "argv", ["push_models.py", "--pushes", "8", "--lever-ratios", "1.5"])
    module.main()
    rows = [line.split("|")[1:-1] for line in capsys.readouterr().out.splitlines() if line.startswith("| ")][1:]
    means = {row[0].split(" (")[0].split(",")[0].strip(): float(row[2]) for row in rows}
    assert list(means) == ["the mug stays", "displacement", "quasi-static", "mujoco"]
    assert means["mujoco"] < means["quasi-static"] < means["displacement"] < means["the mug stays"]
