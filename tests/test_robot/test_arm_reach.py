"""What arms of any make reach, from their URDF or MJCF."""

import math
from dataclasses import replace

import pytest
import torch

pytest.importorskip("pytorch_kinematics")

from rumi.errors import UsageError
from rumi.robot.arm import Arm, ArmGeometry
from rumi.robot.arm_reach import ArmReach, ArmReachSettings
from rumi.robot.tool import Tool
from sdf import se3
from tests.fixtures.arms import FIVE, SIX, six_mjcf

BOUNDS = torch.tensor([[0.25, -0.15, 0.06], [0.85, 0.45, 0.06]])
FEW, COARSE = ArmReachSettings(spacing_m=0.05, yaw_steps=12), ArmReachSettings(spacing_m=0.15, yaw_steps=4)

RAIL = (
    '<link name="slider"/><joint name="rail" type="prismatic"><parent link="base"/><child link="slider"/>'
    '<origin xyz="0 0 0" rpy="0 0 0"/><axis xyz="1 0 0"/><limit lower="0" upper="1.2" effort="1" velocity="1"/></joint>'
    '<link name="link1"/>'
)


@pytest.fixture(scope="module")
def six():
    return ArmReach.of_urdf(SIX, "tool", BOUNDS, settings=FEW)


def test_what_is_reached_is_where_inverse_kinematics_gets(six):
    """At nodes and between them; every solution within the arm's own limits, which are not the same either way."""
    arm, random = Arm(SIX, "tool"), torch.Generator().manual_seed(0)
    u = torch.rand(60, 3, generator=random, dtype=torch.float64)
    q = BOUNDS[0].double() + u * torch.tensor([0.6, 0.6, 0.0], dtype=torch.float64)
    q[:, 2] = math.pi * (2 * u[:, 2] - 1)
    starts = arm.low + (arm.high - arm.low) * torch.rand(40, 6, generator=random, dtype=torch.float64)
    goals = se3.from_planar(q, 0.06)
    found = arm.solve(goals.repeat_interleave(40, 0), starts.repeat(60, 1, 1).reshape(-1, 6), iterations=60)
    assert bool(((found.joints >= arm.low) & (found.joints <= arm.high)).all())
    left = (found.position_error + 0.1 * found.rotation_error).reshape(60, 40).amin(-1)
    claimed = six.double().reachable(q)
    assert 5 < int(claimed.sum()) < 55
    # what is claimed to be reached is; what is not, may be, as between a node that is and one that is not
    assert float((left[claimed] < 0.006).double().mean()) > 0.95
    assert int((~claimed & (left < 1e-3)).sum()) < 20


def test_limits_that_are_not_the_same_either_way_matter():
    wide = SIX.replace('lower="-3.92" upper="0.19"', 'lower="-0.19" upper="3.92"')
    assert wide != SIX
    mirrored = ArmReach.of_urdf(wide, "tool", BOUNDS, settings=FEW)
    plain = ArmReach.of_urdf(SIX, "tool", BOUNDS, settings=FEW)
    assert not torch.allclose(mirrored.left, plain.left, atol=1e-3)


def test_the_compiled_steps_are_the_plain_ones(six):
    """The kernel of the planner and the executor's step read the same table."""
    from rumi.robot.tool_numba import step_within
    from sdf.compiled import interpreted

    tool = Tool(BOUNDS[:, :2].double(), six.double(), height_m=0.06)
    arrays, random = tool.arm_arrays(), torch.Generator().manual_seed(1)
    for _ in range(200):
        u = torch.rand(6, generator=random, dtype=torch.float64)
        q = torch.tensor([0.2, -0.2, -4.0]) + u[:3] * torch.tensor([0.4, 0.4, 8.0])
        control = 2.0 * u[3:] - 1.0
        path = tool.free_path(q, control[None], 1)[0]
        aim = q + control * tool.scale
        left = float(six.residual(q))
        found = interpreted(step_within)(
            *q[:2].tolist(), 0.0, float(q[2]), *aim[:2].tolist(), 0.0, float(aim[2]), left, arrays
        )
        torch.testing.assert_close(torch.tensor([found[0], found[1], found[3]]).double(), path, atol=1e-6, rtol=0)


def test_an_mjcf_is_read_as_mujoco_reads_it(generator):
    """Wherever a joint acts on its body: the tip is where MuJoCo has it."""
    mujoco = pytest.importorskip("mujoco")
    from rumi.robot.mjcf import urdf_of_mjcf

    text = six_mjcf(at=(0.02, -0.01, 0.05))
    model = mujoco.MjModel.from_xml_string(text)
    data, arm = mujoco.MjData(model), Arm(urdf_of_mjcf(text, "tool"), "tip")
    joints = arm.low + (arm.high - arm.low) * torch.rand(10, 6, generator=generator, dtype=torch.float64)
    for row, pose in zip(joints, arm.forward(joints), strict=True):
        data.qpos[:] = row.numpy()
        mujoco.mj_kinematics(model, data)
        torch.testing.assert_close(pose[:3, 3], torch.from_numpy(data.site("tool").xpos), atol=1e-6, rtol=0)
        turn = torch.from_numpy(data.site("tool").xmat.reshape(3, 3))
        torch.testing.assert_close(pose[:3, :3], turn, atol=1e-6, rtol=0)
    assert ArmReach.of_mjcf(six_mjcf(), "tool", BOUNDS[:, :3], settings=COARSE).reached > 0.0
    with pytest.raises(UsageError, match=r"no body or site 'hand'.*tool"):
        ArmReach.of_mjcf(six_mjcf(), "hand", BOUNDS)


def test_a_tool_that_is_round_needs_five_joints_only():
    """Five joints turn a tool about z as they have to; to a stick that is all the same."""
    stiff = FIVE.replace('lower="-2.9" upper="2.9"', 'lower="-0.4" upper="0.4"')
    near = torch.stack((BOUNDS[0], torch.tensor([0.5, 0.15, 0.06])))
    any_yaw, own_yaw = (
        ArmReach.of_urdf(stiff, "tool", near, settings=replace(FEW, round=turns)) for turns in (True, False)
    )
    assert stiff != FIVE and any_yaw.reached > 0.9 > 3.0 * own_yaw.reached > 0.0
    q = torch.tensor([[0.4, 0.0, 0.0], [0.4, 0.0, 2.0]])
    assert float((any_yaw.residual(q)[0] - any_yaw.residual(q)[1]).abs()) < 1e-6


def test_arms_in_space_and_on_a_wall():
    tall = torch.tensor([[0.30, -0.05, 0.05], [0.40, 0.05, 0.20]])
    mount = se3.make(
        torch.tensor([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]), torch.tensor([-0.2, 0.0, 0.35])
    )
    for base in ((0.0, 0.0, 0.0), mount):
        reach = ArmReach.of_urdf(SIX, "tool", tall, base=base, settings=FEW)
        assert len(reach.heights_m) >= 2 and 0.1 < reach.reached <= 1.0
        tool = Tool(tall, reach)
        q = torch.tensor([0.35, 0.0, 0.1, 0.0])
        assert tool.free_path(q, torch.zeros(1, 4), 2).shape == (2, 4)
        assert reach.field(torch.tensor([[0.35, 0.0, 0.1]])).shape == (1,)


def ball(urdf, link, radius):
    shape = f'<collision><geometry><sphere radius="{radius}"/></geometry></collision>'
    return urdf.replace(f'<link name="{link}"/>', f'<link name="{link}">{shape}</link>')


def test_the_floor_and_the_arm_itself_are_in_the_way(six):
    assert "neither self-collision nor the floor is checked" in six.checked
    wrist = ball(SIX, "link6", 0.2)  # the flange is 0.18 m above the floor
    low, high = (ArmReach.of_urdf(wrist, "tool", BOUNDS, settings=replace(FEW, floor=on)) for on in (True, False))
    assert low.reached == 0.0 and high.reached == six.reached
    assert "0 pairs of shapes, the floor for 1" in low.checked and "no floor" in high.checked
    folded = ArmReach.of_urdf(ball(ball(SIX, "base", 0.35), "link6", 0.1), "tool", BOUNDS, settings=FEW)
    lost = (six.left <= 0.005) & (folded.left > 0.005)
    near = (BOUNDS[0, :2] + 0.05 * lost.nonzero()[:, 1:3]).norm(dim=-1)
    assert "1 pairs" in folded.checked and int(lost.sum()) > 0 and float(near.max()) < 0.45 + 0.05


def test_an_arm_whose_mesh_is_missing_is_not_checked_against_itself(six):
    shape = '<link name="link6"><collision><geometry><mesh filename="none.stl"/></geometry></collision></link>'
    reach = ArmReach.of_urdf(SIX.replace('<link name="link6"/>', shape), "tool", BOUNDS, settings=FEW)
    assert "neither self-collision nor the floor is checked" in reach.checked and "none.stl" in reach.checked
    assert reach.reached == six.reached


@pytest.mark.parametrize(
    ("urdf", "far"),
    [
        (ArmGeometry().urdf(), 0.8),  # seven joints
        (SIX.replace('parent link="base"', 'parent link="slider"').replace('<link name="link1"/>', RAIL), 1.6),
    ],
    ids=["seven", "rail"],
)
def test_more_joints_and_joints_that_slide(urdf, far):
    """A rail takes an arm of 0.7 m to where it does not get by itself."""
    bounds = torch.tensor([[far - 0.3, -0.1, 0.06], [far, 0.1, 0.06]])
    assert ArmReach.of_urdf(urdf, "tool", bounds, settings=COARSE).reached > 0.3
    if "slider" in urdf:
        assert ArmReach.of_urdf(SIX, "tool", bounds, settings=COARSE).reached == 0.0


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('lower="-3.92" upper="0.19"', 'lower="0.19" upper="-3.92"', "joint3"),
        ('name="joint3" type="revolute"', 'name="joint3" type="floating"', "joint3"),
        ('<link name="tool"/>', "", "no link 'tool'"),
        ("<robot", "<ro bot", "could not read|Expected a URDF"),
    ],
)
def test_what_is_no_arm_is_refused(old, new, said):
    assert old in SIX
    with pytest.raises(UsageError, match=said):
        ArmReach.of_urdf(SIX.replace(old, new), "tool", BOUNDS)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"base": (math.nan, 0.0, 0.0)}, "base"),
        ({"base": (math.inf, 0.0, 0.0)}, "base"),
        ({"tip_T_tool": torch.zeros(4, 4)}, "tip_T_tool"),
        ({"tip_T_tool": torch.diag(torch.tensor([1.0, 1.0, -1.0, 1.0]))}, "tip_T_tool"),
    ],
)
def test_frames_that_are_none_are_refused(given, said):
    with pytest.raises(UsageError, match=f"Expected {said} to turn and shift alone"):
        ArmReach.of_urdf(SIX, "tool", BOUNDS, **given)


@pytest.mark.parametrize("axis", ["nan 1 0", "0 0 0"])
def test_an_axis_that_is_none_is_refused(axis):
    with pytest.raises(UsageError, match="no axis zero"):
        ArmReach.of_urdf(SIX.replace('<axis xyz="0 0 1"/>', f'<axis xyz="{axis}"/>', 1), "tool", BOUNDS)


def test_tables_are_kept(tmp_path):
    first, second = (ArmReach.of_urdf(SIX, "tool", BOUNDS, settings=FEW, cache_dir=tmp_path) for _ in range(2))
    assert torch.equal(first.left, second.left) and len(list(tmp_path.iterdir())) == 1


@pytest.mark.slow
@pytest.mark.sim
@pytest.mark.outcome
@pytest.mark.parametrize("urdf", [SIX, FIVE], ids=["six", "five"])
def test_it_finds_a_mug_with_an_arm_of_another_make(urdf):
    """The embedded mug, nearer, before an arm of six joints with limits of its own each way, and one of five."""
    pytest.importorskip("mujoco")
    import rumi
    from rumi.tasks.rummage.build import make_task
    from rumi.tasks.rummage.scenes import find_task

    box = torch.tensor([[0.15, -0.35, 0.045], [0.70, 0.35, 0.045]])
    near = {"start": (0.46, 0.03, 0.14), "tool_start": (0.25, 0.0, 0.0), "bounds": ((0.15, -0.35), (0.70, 0.35))}
    spec = replace(find_task("mug-0"), **near)
    workspace = rumi.Workspace.from_bounds(box, 0.01, planar_height=0.045)
    arm = ArmReach.of_urdf(urdf, "tool", box, settings=ArmReachSettings(spacing_m=0.05))
    agent = rumi.rummager(spec.object_factory(), workspace, arm=arm, motion="measured")
    result = rumi.run(make_task(spec, tool=agent.tool, model=agent.model), agent, seed=1000, steps=20)
    assert result.stopped_by == "sure" and result.right
