"""Motion that a push model makes of the tool's path."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from rumi.belief.motion import PushedMotion, object_motion, slip_motion
from rumi.belief.particles import PoseBelief
from rumi.belief.pose_filter import FilterSettings, PoseFilter
from rumi.dynamics.along_path import PathMotion, push_along_path
from rumi.dynamics.quasi_static import QuasiStaticSettings
from rumi.planning.rummaging_settings import RummagingSettings
from rumi.registration.descent import DescentSettings
from rumi.robot.gripper import GripperShape
from rumi.robot.tool import Tool
from rumi.sim.world import World
from rumi.tasks.rummage.motions import pushed_motion
from sdf import se3
from sdf.grid_sdf import GridSDF
from sdf.object_model import object_model
from sdf.primitives import Mug
from sdf.surface import sample_surface
from sdf.symmetry import Symmetries
from sensors.discrepancy import Discrepancy
from sensors.observation import Observation
from sensors.reading import Reading
from sensors.semantics import Semantics
from tests.fixtures.readings import make_reading

HEIGHT = 0.045
MUG = Mug()
SDF = GridSDF.from_sdf(MUG, 0.002)
MODULE = Discrepancy(SDF, 0.09, free_scale=80.0)


@pytest.fixture(scope="module")
def pushed() -> PushedMotion:
    own = QuasiStaticSettings()
    numbers = {"spacing_m": own.spacing_m, "lever_ratio": own.lever_ratio, "friction": own.friction}
    return PushedMotion(PathMotion.of(SDF, HEIGHT, GripperShape(), push_along_path, **numbers))


def reading(path: Tensor, felt: bool = True) -> Reading:
    return make_reading(tool=se3.from_planar(path, HEIGHT), contact=felt, configuration=path[..., -1, :])


def straight(yaw: float = 0.0, count: int = 20) -> Tensor:
    share = torch.arange(1, count + 1)[:, None] / count
    return torch.tensor([0.29, 0.02, yaw]) + share * torch.tensor([0.08, 0.01, 0.2])


def belief(yaw: float, others: int = 3) -> PoseBelief:
    """The first particle fits best; the others are elsewhere."""
    poses = torch.tensor([[0.4, 0.0, yaw]] + [[0.7, 0.3, 0.0]] * others)
    made = PoseBelief.uniform(se3.from_planar(poses))
    misfit = torch.ones(len(poses))
    misfit[0] = 0.0
    return PoseBelief(made.world_T_attached, made.attached_T_object, made.log_weights, misfit)


@pytest.mark.sim
@pytest.mark.parametrize("yaw", [0.5, 2.0, -1.2])
def test_it_is_nearer_to_the_simulator_than_sticking(pushed: PushedMotion, yaw: float) -> None:
    pytest.importorskip("mujoco")
    world = World(MUG, GripperShape(), HEIGHT, 0.004)
    world.reset(torch.tensor([0.29, 0.02, 0.0]), torch.tensor([0.4, 0.0, yaw]))
    before = world.world_T_object()
    track = world.move(straight().double(), 1.0, 0.1)
    after = track.world_T_object[-1]
    felt = reading(track.configuration.float())
    found = pushed(belief(yaw), felt)[-1].double() @ before
    stuck = slip_motion(felt.tool_pose, felt.in_contact)[-1].double() @ before
    metres, radians = se3.distance(found, after)
    assert float(se3.distance(before, after)[0]) > 0.02
    assert float(metres) < 0.006
    assert float(radians) < math.radians(8)
    assert float(metres) < 0.5 * float(se3.distance(stuck, after)[0])


@pytest.mark.sim
@pytest.mark.parametrize("yaw", [0.5, 2.0])
def test_the_engine_is_near_and_the_displacement_model_never_turns(yaw: float) -> None:
    pytest.importorskip("mujoco")
    mug = object_model("mug", MUG, Symmetries.none(), spacing=0.004, points=20)
    world = World(MUG, GripperShape(), HEIGHT, 0.004)
    world.reset(torch.tensor([0.286, 0.0195, -0.01]), torch.tensor([0.4, 0.0, yaw]))
    before = world.world_T_object()
    track = world.move(straight().double(), 1.0, 0.1)
    felt = reading(track.configuration.float())
    off = {}
    for name, choice in (("quasi-static", "auto"), ("displacement", "displacement"), ("engine", "mujoco")):
        planner = RummagingSettings(push_model=choice)
        predict = pushed_motion(planner, mug, Tool(torch.tensor([[0.0, -0.5], [1.0, 0.5]])), HEIGHT, 0.0)
        motion = predict(belief(yaw), felt)
        assert motion.shape == felt.tool_pose.shape and motion.dtype == felt.tool_pose.dtype
        still = predict(belief(yaw), reading(straight(), felt=False))
        assert torch.equal(still, torch.eye(4).expand(20, 4, 4))
        off[name] = float(se3.distance(motion[-1].double() @ before, track.world_T_object[-1])[0])
        if name == "displacement":
            torch.testing.assert_close(motion[..., :3, :3], torch.eye(3).expand(20, 3, 3), atol=1e-3, rtol=0)
        else:
            batch = predict(both(belief(yaw), belief(2.5)), reading(torch.stack((straight(), straight()))))
            torch.testing.assert_close(batch[0], predict(belief(yaw), reading(straight())), atol=1e-6, rtol=0)
    assert off["engine"] < 0.003 and max(off["engine"], off["quasi-static"]) < 0.5 * off["displacement"], off


def both(*rows: PoseBelief) -> PoseBelief:
    names = ("world_T_attached", "attached_T_object", "log_weights", "discrepancy")
    return PoseBelief(*(torch.stack([getattr(r, n) for r in rows]) for n in names))


def test_what_was_not_felt_did_not_move(pushed: PushedMotion) -> None:
    motion = pushed(belief(0.5), reading(straight(), felt=False))
    assert torch.equal(motion, torch.eye(4).expand(20, 4, 4))
    away = pushed(belief(0.5), reading(straight() - torch.tensor([0.3, 0.0, 0.0])))
    torch.testing.assert_close(away, torch.eye(4).expand(20, 4, 4), atol=1e-6, rtol=0)


def test_the_seam_of_the_yaw_is_nowhere(pushed: PushedMotion) -> None:
    """A tool that turns through pi does not spin back."""
    path = straight(math.pi - 0.1)
    path[:, 0] -= 0.02
    wrapped = path.clone()
    wrapped[:, 2] = torch.remainder(path[:, 2] + math.pi, 2 * math.pi) - math.pi
    torch.testing.assert_close(pushed(belief(0.5), reading(wrapped)), pushed(belief(0.5), reading(path)))


def test_what_was_sensed_corrects_it(pushed: PushedMotion) -> None:
    """A push that went 8 mm further and 3 degrees round: seen points bring the motion there, at the last instant."""
    start, felt = belief(0.5), reading(straight())
    model = pushed(start, felt)
    more = se3.from_planar(torch.tensor([0.008, 0.004, 0.05], dtype=model.dtype))
    truth = more @ model[-1] @ start.world_T_object[0]
    local = sample_surface(MUG, 200, generator=torch.Generator().manual_seed(0))[0].to(model)
    seen = Observation.of(se3.apply(truth, local), Semantics.SURFACE)
    late = replace(felt, observation=seen, instant=torch.full((len(local),), len(model) - 1))
    descent = DescentSettings(iterations=30)
    found = object_motion("corrected", start, late, MODULE, "SE(2)", descent, pushed)[-1] @ start.world_T_object[0]
    metres, radians = se3.distance(found, truth)
    assert float(metres) < 1e-3 and float(radians) < 5e-3
    alone = object_motion("pushed", start, late, MODULE, "SE(2)", descent, pushed)[-1] @ start.world_T_object[0]
    assert float(se3.distance(alone, truth)[0]) > 0.005
    with pytest.raises(ValueError, match="push model for the motion 'corrected'"):
        object_motion("corrected", start, late, MODULE, "SE(2)", descent)


def test_the_filter_asks_it(pushed: PushedMotion) -> None:
    settings = FilterSettings(motion="pushed", translation_noise_m=0.0, rotation_noise_rad=0.0)
    random = torch.Generator().manual_seed(0)
    start, felt = belief(0.5), reading(straight())
    follow = PoseFilter(settings, [MODULE], "SE(2)", pushed=pushed)
    after, _, info = follow(start, Observation.empty(), felt, generator=random)
    assert bool(info.moved)
    torch.testing.assert_close(after.world_T_attached, pushed(start, felt)[-1] @ start.world_T_attached)
    with pytest.raises(ValueError, match="push model for the motion"):
        object_motion("pushed", start, felt, MODULE, "SE(2)", DescentSettings())
