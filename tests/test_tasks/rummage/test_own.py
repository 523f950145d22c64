"""The rummager of a robot of one's own: what it is given is followed, or refused in words."""

from dataclasses import replace

import pytest
import torch

import rumi
from rumi.errors import UsageError
from rumi.runs.folder import RunRecorder
from rumi.sim.settings import SimSettings
from rumi.task import StepResult
from rumi.tasks.rummage.objects import ObjectSettings
from rumi.tasks.rummage.scene_spec import PriorSpec
from sdf.object_model import box_model, mug_model
from sdf.primitives import Sphere
from tests.fixtures.readings import make_reading


def lattice(low=0.03, high=0.03):
    bounds = torch.tensor([[0.2, -0.2, low], [0.6, 0.2, high]])
    return rumi.Workspace.from_bounds(bounds, 0.05, planar_height=low if low == high else None)


BALL = rumi.SolidTool([Sphere(0.01)])


@pytest.fixture(scope="module")
def model():
    return box_model()


def test_what_is_said_is_what_it_has(model):
    settings = rumi.preset("fast", method="info-only", steps=5)
    agent = rumi.rummager(
        model, lattice(), tool=BALL, motion="measured", action_m=0.03, action_rad=0.2, settings=settings
    )
    assert (
        isinstance(agent.tool.shape, rumi.SolidTool) and agent.steps == 5 and agent.filter.settings.motion == "measured"
    )
    torch.testing.assert_close(agent.tool.scale, torch.tensor([0.03, 0.03, 0.2]))
    assert agent.initialise == settings.initialise and agent.filter.pushed is None


@pytest.mark.parametrize(
    ("workspace", "given", "motion"),
    [
        (lattice(), {}, "trajectory"),
        (lattice(), {"looks_again": True}, "trajectory"),
        (lattice(), {"prior": PriorSpec((0.5, 0.0), 0.02)}, "corrected"),
        (lattice(0.03, 0.2), {}, "estimated"),
        (lattice(0.03, 0.2), {"prior": PriorSpec((0.5, 0.0), 0.02), "up": ("x", "y", "z")}, "trajectory"),
        (lattice(0.03, 0.2), {"prior": PriorSpec((0.5, 0.0), 0.02), "tool": BALL}, "estimated"),
    ],
)
def test_without_a_word_nothing_is_taken_for_measured(workspace, given, motion, model):
    assert rumi.rummager(model, workspace, **given).filter.settings.motion == motion


@pytest.mark.parametrize(
    ("workspace", "given", "motion"),
    [
        (lattice(), {}, "measured"),
        (lattice(0.03, 0.2), {}, "measured"),
        (lattice(0.03, 0.2), {"prior": PriorSpec((0.5, 0.0), 0.02), "up": ("x", "y", "z")}, "trajectory"),
        (lattice(0.03, 0.2), {"prior": PriorSpec((0.5, 0.0), 0.02), "tool": BALL}, "measured"),
    ],
)
def test_what_a_sensor_measures_is_evidence_of_what_may_topple(workspace, given, motion, model):
    for asked in ({"motion": "auto"}, {"settings": rumi.preset("default")}):
        assert rumi.rummager(model, workspace, **given, **asked).filter.settings.motion == motion


def test_in_the_plane_trajectories_may_begin_from_a_prior(model):
    prior = PriorSpec((0.5, 0.0), 0.02, (0.3, 0.1))
    found = rumi.rummager(model, lattice(), motion="trajectory", prior=prior).filter
    assert found.prior.yaw == (0.3, 0.1) and found.own.first_particles > found.own.particles


def test_trajectories_are_surer_of_the_mugs_that_they_are_fitted_to(model):
    fitted, plain = rumi.rummager(mug_model(0.004), lattice()).filter.own, rumi.preset("default").filter.trajectories
    assert fitted == plain.for_mugs()
    assert rumi.rummager(model, lattice()).filter.own == plain.for_others() != fitted


def test_a_camera_that_looks_again_lets_pushes_go_otherwise_than_foreseen():
    fitted = rumi.rummager(mug_model(0.004), lattice()).filter.own
    seen = rumi.rummager(mug_model(0.004), lattice(), looks_again=True).filter.own
    assert seen == fitted.seen_again() and seen.turn_rad_per_m == 2.0 * fitted.turn_rad_per_m
    assert seen.later_share * seen.seen_points == pytest.approx(fitted.seen_again_points)
    assert seen.later_share < fitted.later_share == 1.0 == replace(seen, seen_points=0.0).later_share


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"settings": rumi.preset("default", object=ObjectSettings(mesh="part.stl"))}, "the model is given"),
        ({"settings": rumi.preset("default", simulator=SimSettings(action_scale_m=0.05))}, "action_m"),
        ({"action_m": float("nan")}, "action_m to be a finite number"),
        ({"motion": "corrected", "workspace": lattice(0.03, 0.2)}, "upright objects with a level tool"),
        ({"workspace": lattice(0.5, 0.5)}, "up to the middle of the tool"),
        ({"workspace": lattice(0.01, 0.01)}, "0.012 m below"),
        ({"settings": rumi.preset("default", fault=("knocked:0.02@5",))}, "no faults"),
        ({"settings": rumi.preset("default", tool_height_m=0.03)}, "workspace has the tool's height"),
        ({"settings": replace(rumi.preset(), planner=replace(rumi.preset().planner, push_model="mujoco"))}, None),
    ],
)
def test_what_nothing_could_follow_is_refused(changes, said, model):
    workspace = changes.pop("workspace", lattice())
    if said is None:
        pytest.importorskip("mujoco")
        changes, said = {**changes, "tool": rumi.SolidTool([Sphere(0.01)])}, "'quasi-static' or 'displacement'"
    with pytest.raises(UsageError, match=said):
        rumi.rummager(model, workspace, **changes)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_a_robot_gives_float32_whatever_the_belief_is_in(model, monkeypatch, dtype):
    told = []

    class Robot:
        def reset(self, seed):
            return make_reading()

        def step(self, control):
            told.append(control.dtype)
            return make_reading()

        def finish(self, action):
            """Nothing."""

        def close(self):
            """Nothing."""

    def one_step(task, agent, **_):
        assert StepResult.of(task.reset(0)).reading.tool_pose.dtype == agent.model.surface_points.dtype
        return StepResult.of(task.step(agent.model.surface_points[0])).reading.tool_pose.dtype

    monkeypatch.setattr("rumi.loop.run", one_step)
    agent = rumi.rummager(model, lattice(), motion="corrected", settings=rumi.preset("default", dtype=dtype))
    assert rumi.run(Robot(), agent, seed=0) == getattr(torch, dtype)
    assert told == [torch.float32]


def test_a_folder_of_such_a_run_says_how_to_replay_it(model, tmp_path):
    agent = rumi.rummager(model, lattice())
    with RunRecorder(tmp_path / "run", {**agent.about, "seed": 0}, None):
        pass
    with pytest.raises(UsageError, match=r"rumi\.replay"):
        rumi.replay(tmp_path / "run")
