"""Laws of every push model in each of its uses: rollouts, pushes along a path, motion; also of one from outside."""

import importlib.util
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import replace
from typing import NamedTuple

import pytest
import torch
from torch import Tensor

from rumi.dynamics.along_path import Pusher, unwrapped
from rumi.dynamics.base import PushModel, PushRollouts, RolloutModel, Use
from rumi.dynamics.outline import GridOutline, support_of
from rumi.dynamics.registry import AUTO, PUSH_MODELS, EngineSettings, PushModels, PushSettings, push_model
from rumi.dynamics.sliding import Sliding
from rumi.errors import UsageError
from rumi.fields.information import information_field
from rumi.fields.workspace import Workspace
from rumi.robot.tool import Tool
from rumi.tasks.touch_box.mujoco_scene import path_scene
from rumi.tasks.touch_box.scene import TouchTask
from sdf import backend, gpu, se3
from sdf.object_model import ObjectModel, object_model
from sdf.primitives import Box
from sdf.symmetry import Symmetries

OUTSIDE = "rough"
NAMES = (*PUSH_MODELS, OUTSIDE)
SIMULATED = ("mujoco",)
HALF = (0.04, 0.06, 0.05)
HEIGHT = 0.045
TASK = TouchTask()
# rollouts of the one meet a belief's contact field, which begins before the surface; the other's motion takes a second
TOLERANCE_M = {"displacement": 0.015, "mujoco": 0.01}
SETTINGS = PushSettings(engine=EngineSettings(time_step_s=0.004, threads=1))
MIRROR = torch.tensor([1.0, -1.0, -1.0])
START = torch.tensor([0.28, 0.0, 0.0])
AHEAD, ASIDE, BACK = ([1.0, 0.0, 0.0], [0.8, 0.3, 0.0], [-1.0, 0.0, 0.0])
POSE = torch.tensor([0.4, 0.01, 0.2])


@pytest.fixture(params=[pytest.param(n, marks=pytest.mark.sim) if n in SIMULATED else n for n in NAMES])
def name(request: pytest.FixtureRequest, outside: None) -> str:
    if request.param in SIMULATED and importlib.util.find_spec("mujoco") is None:
        pytest.skip("needs mujoco")
    return request.param


@pytest.fixture(scope="module")
def box() -> ObjectModel:
    return object_model("box", Box(list(HALF)), Symmetries.none(), spacing=0.002, points=20)


@pytest.fixture(params=["", "warp"], ids=["default", "warp"])
def own_version(request: pytest.FixtureRequest) -> Iterator[None]:
    """What runs by default, then the versions for a GPU, on the CPU."""
    if request.param and not gpu.available():
        pytest.skip("without warp")
    with backend.force(request.param) if request.param else nullcontext():
        yield


on_gpu_as_well = pytest.mark.usefixtures("own_version")


def member(name: str, use: Use) -> PushModel:
    if not PUSH_MODELS[name].has(use):
        pytest.skip(f"{name} has no {use}")
    return push_model(name, use, SETTINGS)


def tool(dtype: torch.dtype = torch.float32) -> Tool:
    return Tool(torch.tensor([[-5.0, -5.0], [5.0, 5.0]]), height_m=HEIGHT, body_spacing_m=0.01).to(dtype)


def placed(pose: Tensor) -> Tensor:
    return se3.from_planar(pose, HALF[2])


def rollouts(name: str, box: ObjectModel, poses: Tensor) -> RolloutModel:
    dtype = poses.dtype
    area = torch.tensor([[0.2, -0.3, HEIGHT], [0.7, 0.3, HEIGHT]])
    workspace = Workspace.from_bounds(area, 0.005, planar_height=HEIGHT).to(dtype)
    particles, even = placed(poses), poses.new_zeros(len(poses)).log_softmax(-1)
    model = box.to(dtype)
    fields = information_field(model.sdf, particles, even, workspace.points)
    return member(name, "rollouts").rollouts(model, particles, even, tool(dtype), workspace, fields)


def roll(name: str, box: ObjectModel, pose: Tensor, controls: list[list[float]], start: Tensor = START) -> PushRollouts:
    acts = pose.new_tensor([controls])
    return rollouts(name, box, pose[None]).rollout(
        start.to(pose), acts, rollouts=1, generator=torch.Generator().manual_seed(0)
    )


class Case(NamedTuple):
    """Objects, a tool path, and where all of it ends."""

    poses: Tensor
    path: Tensor

    def along(self, name: str) -> Tensor:
        """End poses by the use "path", in the scene of the task."""
        push = member(name, "path").path(lambda: path_scene(TASK))
        count = len(self.poses)
        sliding = Sliding(torch.zeros(count, 2), torch.full((count,), 0.05), torch.full((count,), 0.4))
        own = sliding.to(self.poses)
        fingers = TASK.fingers._replace(points=TASK.fingers.points.to(self.poses))
        outcome = push(self.poses, self.path, fingers, TASK.outline, own)
        assert outcome.track.dtype == outcome.distance.dtype == self.poses.dtype
        assert bool(outcome.distance.isfinite().all())
        return outcome.track

    def moved(self, name: str, box: ObjectModel) -> Tensor:
        """World motions by the use "motion"."""
        predict = member(name, "motion").motion(box, tool().shape, HEIGHT, HALF[2])
        found = predict(self.poses, self.path.expand(len(self.poses), -1, -1))
        assert found.shape == (len(self.poses), self.path.shape[1], 4, 4)
        assert found.dtype == self.poses.dtype
        return found


def straight(begin: tuple[float, float], end: tuple[float, float], dtype: torch.dtype = torch.float64) -> Tensor:
    share = torch.linspace(0, 1, 13, dtype=dtype)[:, None]
    low, high = (torch.tensor([*place, 0.0], dtype=dtype) for place in (begin, end))
    return (low + share * (high - low))[None]


BOXES = torch.tensor([[0.0, 0.004, 0.3], [0.01, -0.01, -0.2], [0.0, 0.0, 0.12]], dtype=torch.float64)
PUSH = straight((-0.2, 0.01), (-0.02, -0.01))


def test_it_is_a_member(name: str) -> None:
    kind = PUSH_MODELS[name]
    assert issubclass(kind, PushModel)
    assert kind.defaults.rollouts >= 1
    assert kind.defaults.reachability_scale >= 0
    assert kind.objects in ("any", "upright", "planar")
    assert PushSettings(name).push_model == name


@on_gpu_as_well
def test_rollouts_out_of_reach_push_nothing(name: str, box: ObjectModel) -> None:
    found = roll(name, box, POSE, [BACK] * 3)
    assert not bool(found.touched.any())
    assert float(found.displacements.abs().max()) == 0.0
    assert found.turns is None or float(found.turns.abs().max()) == 0.0


@on_gpu_as_well
def test_rollouts_that_stand_still_push_nothing(name: str, box: ObjectModel) -> None:
    found = roll(name, box, POSE, [[0.0, 0.0, 0.0]] * 2)
    assert float(found.displacements.abs().max()) == 0.0
    assert torch.equal(found.configurations, START.expand(1, 1, 3, 3))


@on_gpu_as_well
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_rollouts_that_push_are_finite_and_forward(name: str, box: ObjectModel, dtype: torch.dtype) -> None:
    found = roll(name, box, POSE.to(dtype), [AHEAD] * 4)
    assert isinstance(rollouts(name, box, POSE[None].to(dtype)), RolloutModel)
    assert bool(found.touched.all())
    assert found.displacements.dtype == found.configurations.dtype == dtype
    assert bool(found.displacements.isfinite().all())
    assert 0.0 <= found.checked <= 1.0
    way = float(found.configurations[0, 0, -1, 0] - START[0])
    assert 0.01 < float(found.displacements[0, 0, -1, 0]) <= way + 5e-3


@on_gpu_as_well
def test_mirrored_rollouts_mirror(name: str, box: ObjectModel) -> None:
    one, other = (
        roll(name, box, POSE * side, (torch.tensor([ASIDE] * 4) * side).tolist(), START * side)
        for side in (torch.ones(3), MIRROR)
    )
    assert bool(one.touched.all())
    assert bool(other.touched.all())
    across = torch.tensor([1.0, -1.0, 1.0])
    torch.testing.assert_close(one.displacements * across, other.displacements, atol=3e-3, rtol=0)
    if one.turns is not None and other.turns is not None:
        torch.testing.assert_close(one.turns, -other.turns, atol=0.03, rtol=0)


@on_gpu_as_well
def test_a_row_of_rollouts_is_as_alone(name: str, box: ObjectModel) -> None:
    """Control sequences do not know each other."""
    model = rollouts(name, box, POSE[None])
    controls = torch.tensor([[AHEAD] * 3, [ASIDE] * 3, [BACK] * 3])
    draw = {"rollouts": 2, "generator": torch.Generator().manual_seed(0)}
    together = model.rollout(START, controls, **draw)
    for row in range(3):
        alone = model.rollout(START, controls[row][None], **draw)
        assert torch.equal(alone.displacements[0], together.displacements[row])
        assert torch.equal(alone.contact[0], together.contact[row])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_scene_of_a_batch_is_rolled_out_as_alone(name: str, box: ObjectModel, dtype: torch.dtype) -> None:
    """Beliefs of three scenes, one of a toppled box that only some members push, and a batch of one."""
    random = torch.Generator().manual_seed(1)
    planar = POSE + torch.tensor([0.01, 0.01, 0.3]) * torch.randn(3, 4, 3, generator=random)
    poses = placed(planar.to(dtype))
    toppled = se3.exp(poses.new_tensor([0.0, 0.0, 0.0, 1.5, 0.0, 0.0]))
    mixed = torch.stack((poses[0], poses[1] @ toppled))
    starts, controls = START.to(dtype).expand(3, 3), poses.new_tensor([[AHEAD] * 3, [ASIDE] * 3]).expand(3, 2, 3, 3)
    settings = replace(SETTINGS, push_model=name)
    for batch, own in ((poses, settings), (poses[:1], settings), (mixed, replace(settings, push_model=AUTO))):
        count = len(batch)
        together = rolled(own, box, batch, starts[:count], controls[:count])
        assert together.contact.any()
        for row in range(count):
            alone = rolled(own, box, batch[row], starts[row], controls[row], row)
            exact = {"atol": 1e-10 if dtype == torch.float64 else 1e-6, "rtol": 0.0}
            torch.testing.assert_close(together.displacements[row], alone.displacements, **exact)
            torch.testing.assert_close(together.configurations[row], alone.configurations, **exact)
            assert torch.equal(together.contact[row], alone.contact)
            assert torch.equal(together.duplicate_of[row], alone.duplicate_of)
            if alone.turns is not None:
                torch.testing.assert_close(together.turns[row], alone.turns, **exact)


def rolled(
    settings: PushSettings, box: ObjectModel, poses: Tensor, start: Tensor, controls: Tensor, seed: int = 0
) -> PushRollouts:
    """Rollouts of a scene, or of some whose generators have the seeds from 0 on."""
    dtype, batch = poses.dtype, poses.shape[:-3]
    area = torch.tensor([[0.2, -0.3, HEIGHT], [0.7, 0.3, HEIGHT]])
    workspace, model = Workspace.from_bounds(area, 0.01, planar_height=HEIGHT).to(dtype), box.to(dtype)
    even = poses.new_zeros(poses.shape[:-2]).log_softmax(-1)
    fields = information_field(model.sdf, poses, even, workspace.points)
    found = PushModels(settings).rollouts(model, poses, even, tool(dtype), workspace, fields)
    assert isinstance(found, RolloutModel)
    seeds = range(batch[0]) if batch else (seed,)
    random = [torch.Generator().manual_seed(one) for one in seeds]
    nominal = found.coarse().nominal_rollout(start, controls[..., 0, :, :])
    assert nominal.configurations.shape == (*batch, 1, 1, 4, 3)
    return found.rollout(start, controls, rollouts=2, generator=random if batch else random[0])


def test_paths_out_of_reach_push_nothing(name: str) -> None:
    far = Case(BOXES + torch.tensor([0.0, 0.5, 0.0]), PUSH)
    assert torch.equal(far.along(name), far.poses[:, None].expand(-1, 12, -1))


def test_paths_without_a_way_push_nothing(name: str) -> None:
    still = Case(BOXES, PUSH[:, :1].expand(1, 4, 3))
    assert torch.equal(still.along(name), still.poses[:, None].expand(-1, 3, -1))
    assert Case(BOXES, PUSH[:, :1]).along(name).shape == (3, 0, 3)
    assert Case(BOXES[:0], PUSH).along(name).shape == (0, 12, 3)


def test_mirrored_paths_mirror(name: str) -> None:
    mirror = MIRROR.double()
    found, other = Case(BOXES, PUSH).along(name), Case(BOXES * mirror, PUSH * mirror).along(name)
    assert float((found[:, -1] - BOXES)[:, :2].norm(dim=-1).min()) > 0.01
    torch.testing.assert_close(found * mirror, other, atol=2e-3, rtol=0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_an_object_on_a_path_is_as_alone(name: str, dtype: torch.dtype) -> None:
    poses, path = BOXES.to(dtype), PUSH.to(dtype)
    together = Case(poses, path).along(name)
    exact = {"atol": 1e-3 if name in SIMULATED else 0.0, "rtol": 0.0}  # a simulator skips what all of a batch can
    for row in range(len(poses)):
        torch.testing.assert_close(Case(poses[row][None], path).along(name)[0], together[row], **exact)


def test_motion_out_of_reach_is_none(name: str, box: ObjectModel) -> None:
    path = straight((0.0, 0.0), (0.1, 0.0), torch.float32)
    motion = Case(POSE[None], path).moved(name, box)
    torch.testing.assert_close(motion, torch.eye(4).expand(motion.shape), atol=1e-6, rtol=0)


def test_motion_of_nothing_is_empty(name: str, box: ObjectModel) -> None:
    assert len(Case(POSE[None][:0], straight((0.0, 0.0), (0.1, 0.0), torch.float32)).moved(name, box)) == 0


def test_motions_in_a_batch_are_as_alone(name: str, box: ObjectModel) -> None:
    poses, path = torch.stack((POSE, POSE * MIRROR)), straight((0.28, 0.0), (0.36, 0.0), torch.float32)
    together = Case(poses, path).moved(name, box)
    for row in range(2):
        torch.testing.assert_close(Case(poses[row][None], path).moved(name, box)[0], together[row], atol=1e-6, rtol=0)


def test_all_uses_say_the_same_of_a_push(name: str, box: ObjectModel) -> None:
    """To 4 mm of 20 cm: the uses cut a push into other parts."""
    controls = [[0.5, 0.0, 0.0]] * 6
    found = roll(name, box, POSE, controls)
    path = unwrapped(found.configurations[0])
    shift = found.displacements[0, 0, -1, :2]
    assert float(shift.norm()) > 0.02
    ends = {"rollouts": POSE[:2] + shift}
    if found.turns is not None and found.pivot is not None:
        assert torch.allclose(found.pivot, POSE[:2])
    share = torch.linspace(0, 1, 49)[:, None]
    fine = (path[0, 0] + share * (path[0, -1] - path[0, 0]))[None]
    motion = Case(POSE[None], fine).moved(name, box)[0, -1]
    ends["motion"] = (motion @ placed(POSE))[:2, 3]
    if name not in SIMULATED:
        support, own = support_of(box.sdf), SETTINGS.quasi_static
        friction = 0.8 if name == OUTSIDE else own.friction
        sliding = Sliding(support.centre, torch.tensor(own.lever_ratio * support.spread), torch.tensor(friction))
        pusher = Pusher(tool().shape.outline(own.spacing_m).float())
        outline = GridOutline.of_slice(box.sdf, HEIGHT - HALF[2])
        ends["path"] = member(name, "path").path()(POSE[None], fine, pusher, outline, sliding).track[0, -1, :2]
    for use, end in ends.items():
        assert float((end - ends["rollouts"]).norm()) < TOLERANCE_M.get(name, 4e-3), use


def test_a_use_that_a_model_lacks_is_refused_when_a_run_is_built(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    class Lacking(PushModel):
        """No use at all."""

    monkeypatch.setitem(PUSH_MODELS._members, "lacking", Lacking)
    for use in ("rollouts", "path", "motion"):
        with pytest.raises(UsageError, match=f"{use!r}, got 'lacking'.*displacement, quasi-static, mujoco"):
            push_model("lacking", use)  # type: ignore[arg-type]
    with pytest.raises(UsageError, match="lacks it"):
        PushModels(PushSettings("lacking"))


def test_names_that_there_are_not_are_refused_with_those_that_there_are(name: str) -> None:
    for refused in (lambda: PushSettings("magnetic"), lambda: push_model("magnetic", "path")):
        with pytest.raises(UsageError, match=f"magnetic|{AUTO}") as error:
            refused()
        assert OUTSIDE in str(error.value)
