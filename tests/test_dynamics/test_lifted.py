"""A head lifted from below: the foot slides or the head slips on the tool, held against MuJoCo and its own statics."""

import itertools
import math
from dataclasses import replace

import pytest
import torch

from rumi.belief.pose_trajectories import NOISE, PHYSICS, Trajectories
from rumi.belief.prior import lying
from rumi.belief.toppled_object import ToppledObject
from rumi.belief.trajectory_history import History, Segment
from rumi.belief.trajectory_settings import PoseTrajectorySettings
from rumi.dynamics.resting import RestingPoses
from rumi.dynamics.sliding import Sliding
from rumi.dynamics.toppling import Leaning, push_in_space
from rumi.robot.gripper import GripperShape
from rumi.seeding import generator
from sdf import backend, se3
from sdf.drill import drill_model
from sdf.grid_sdf import GridSDF
from sdf.primitives import Box, Placed, Sphere, Union
from sdf.surface import sample_surface
from sdf.symmetry import Symmetries

DOUBLE = {"dtype": torch.float64}
POST, HEAD, MIDDLE = (0.037, 0.028, 0.06), (0.07, 0.028, 0.02), (0.03, 0.0, 0.14)  # half sides; middle of the head
RADIUS, UNDER = 0.01, 0.12  # of the tool, a ball; height of the head's underside


@pytest.fixture(scope="module")
def post() -> tuple[GridSDF, RestingPoses]:
    """A post with a head that juts out along x."""
    low, high = (se3.make(torch.eye(3), torch.tensor(place)) for place in ((0.0, 0.0, POST[2]), MIDDLE))
    shape = Union((Placed(Box(POST), low), Placed(Box(HEAD), high)))
    sdf = GridSDF.from_sdf(shape, 0.002)
    return sdf, RestingPoses.of(sdf, lying(shape.bounds)[None], Symmetries.none())


def lifted(post, friction: float, way: tuple[float, float], off: float, steps: int = 20):
    """State after a ball below the head, 60 mm from the middle, has gone (x, z) so far; mass above (off - 37 mm, 0)."""
    sdf, rests = post
    rests = replace(rests, centre=torch.tensor([[off - POST[0], 0.0]], **DOUBLE).expand_as(rests.centre))
    points, _ = sample_surface(Sphere(RADIUS), 200, generator=generator(0))
    ball = torch.cat((points.double(), torch.tensor([[0.0, 0.0, RADIUS]], **DOUBLE)))
    one, rest = torch.ones(1, **DOUBLE), torch.tensor([[0.0, -1.0, 0.0]], **DOUBLE)
    state = Leaning(torch.zeros(1, 3, **DOUBLE), rest)
    body = Sliding(torch.zeros(1, 2, **DOUBLE), 0.04 * one, friction * one)
    at = [(0.06 + way[0] * k / steps, 0.0, 0.0, UNDER - RADIUS + way[1] * k / steps) for k in range(steps + 1)]
    tools = torch.tensor(at, **DOUBLE)
    for before, after in itertools.pairwise(tools):
        state = push_in_space(sdf, rests, ball, state, before, after, body, one, 0.001 * one, 0.0 * one).state
    return state


def in_mujoco(friction: float, way: tuple[float, float], off: float, steps: int = 4000) -> tuple[float, float]:
    """How far the foot slides along x, and the tilt, of the same post by the same ball, slowly."""
    mujoco = pytest.importorskip("mujoco")
    geoms = "".join(
        f'<geom type="box" size="{half[0]} {half[1]} {half[2]}" pos="{at[0]} {at[1]} {at[2]}" mass="0"/>'
        for half, at in ((POST, (0.0, 0.0, POST[2])), (HEAD, MIDDLE))
    )
    model = mujoco.MjModel.from_xml_string(f"""
<mujoco><option timestep="0.0005" integrator="implicitfast" cone="elliptic" impratio="10"/>
  <default><geom condim="4" friction="{friction} 0.005 0.0001"/></default>
  <worldbody><geom type="plane" size="1 1 .1"/>
    <body name="object"><freejoint/>
      <inertial pos="{off - POST[0]} 0 .08" mass=".9" diaginertia=".003 .003 .002"/>{geoms}</body>
    <body pos="0.06 0 {UNDER - RADIUS - 0.001}" gravcomp="1">
      <joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/>
      <geom type="sphere" size="{RADIUS}" mass="1e6" contype="2" conaffinity="1"/></body>
  </worldbody></mujoco>""")
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 400)
    start, seconds = data.qpos[0], steps * model.opt.timestep
    data.qvel[6:] = way[0] / seconds, (way[1] + 0.001) / seconds  # as heavy as it is, nothing slows it
    mujoco.mj_step(model, data, steps)
    return float(data.qpos[0] - start), 2.0 * math.asin(math.hypot(*data.qpos[4:7]))


@pytest.mark.sim
@pytest.mark.parametrize(
    ("friction", "way", "off"),
    [(0.3, (0.0, 0.006), 0.05), (0.6, (0.0, 0.006), 0.05), (0.45, (0.004, 0.006), 0.05), (0.45, (-0.003, 0.006), 0.05)],
)
def test_the_foot_of_a_post_slides_towards_the_tool_that_lifts_its_head_as_in_mujoco(post, friction, way, off):
    state = lifted(post, friction, way, off)
    slid, tilt = in_mujoco(friction, way, off)
    assert slid > 0.003
    # the tilt turns it about its edge: what is left of the origin's way is how far that slid
    about = POST[0] * (1.0 - math.cos(tilt))
    assert float(state.planar[0, 0]) == pytest.approx(slid + about, abs=0.0015)
    assert float(state.lying[0, 2]) == pytest.approx(tilt, rel=0.2)


@pytest.mark.sim
def test_a_head_that_the_tool_carries_lightly_slips_on_it_and_the_foot_stays_as_in_mujoco(post):
    # 20 mm from the edge to the mass, 97 mm to the tool
    state = lifted(post, 0.3, (0.0, 0.006), 0.02)
    slid, tilt = in_mujoco(0.3, (0.0, 0.006), 0.02)
    assert abs(slid) < 0.0005 and float(state.planar[0].abs().max()) == 0.0
    assert float(state.lying[0, 2]) == pytest.approx(tilt, rel=0.2)


@pytest.mark.parametrize("rise", [-1e-6, 0.0, 1e-6])
def test_a_level_way_below_a_head_carries_nothing_whatever_its_last_digit(post, rise):
    state = lifted(post, 0.5, (-0.003, rise), 0.05, steps=2)
    assert float(state.planar[0].abs().max()) == 0.0


def test_a_foot_never_slides_away_from_the_tool_that_lifts(post):
    state = lifted(post, 0.6, (0.012, 0.004), 0.05)  # it goes ahead faster than the head goes back
    assert float(state.planar[0, 0]) >= 0.0
    inward = lifted(post, 0.6, (-0.012, 0.004), 0.05)
    assert float(inward.planar[0, 0]) == 0.0


def test_what_is_carried_stays_on_the_tool(post):
    """A point of the underside goes as far along x as the tool does, whatever it tilts."""
    _, rests = post
    for ahead in (0.004, 0.0, -0.002):
        state = lifted(post, 0.5, (ahead, 0.006), 0.05)
        pose = rests.world_T_object(state.planar, state.lying)[0]
        there = pose @ torch.tensor([0.06, 0.0, UNDER, 1.0], **DOUBLE)
        assert float(there[0]) - 0.06 == pytest.approx(ahead, abs=0.0012)


def test_the_compiled_replay_of_a_lifted_drill_is_the_plain_one():
    model, random, count = drill_model(), generator(1), 30
    ways = lying(model.exact.bounds)[None]
    drill = ToppledObject.of(model.sdf, GripperShape(), ways, model.symmetries, spacing_m=0.008, pad_spacing_m=0.006)
    tool = torch.zeros(17, 4, **DOUBLE)  # below its head, which points at it
    tool[:, 0], tool[:, 3] = torch.linspace(-0.078, -0.073, 17, **DOUBLE), torch.linspace(0.10, 0.124, 17, **DOUBLE)
    none = torch.zeros(0, dtype=torch.long)
    path = torch.stack((tool[:-1], tool[1:]), 1)
    told = History.empty(4).appended(
        Segment(path, True, torch.zeros(0, 3, **DOUBLE), none, none, torch.zeros(0, **DOUBLE))
    )
    start = torch.randn(count, 6, generator=random, **DOUBLE) * torch.tensor([0.004, 0.01, 0.3, 0, 0, 0], **DOUBLE)
    start += torch.tensor([0.0, 0.0, math.pi, 0.0, -1.0, 0.0], **DOUBLE)
    physics = torch.randn(count, PHYSICS, generator=random, **DOUBLE)
    noise = 0.3 * torch.randn(count, 1, NOISE, generator=random, **DOUBLE)
    given = Trajectories(physics, noise, start[:, None].repeat(1, 2, 1), start.new_zeros(count, 1), told, start)
    own, first, found = PoseTrajectorySettings(), torch.zeros(count, dtype=torch.long), []
    for version in ("torch", "numba"):
        with backend.force(version):
            found.append(given.replayed(drill, own, told, first))
    one, other = (replayed.pose for replayed in found)
    torch.testing.assert_close(one, other, atol=1e-4, rtol=0)
    # without noise, what leans slides only where it is carried
    still = replace(given, noise=torch.zeros_like(noise)).replayed(drill, own, told, first).pose
    assert int(((still[:, 4] >= 0) & ((still - start)[:, 0] < -0.003)).sum()) >= 5
    assert not torch.allclose(still[:, :3], one[:, :3], atol=1e-3)
