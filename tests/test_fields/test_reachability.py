"""The arm's reach: against inverse kinematics without a table, geometry in closed form, and a slow loop."""

import logging
import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from rumi.robot import reach_table as reach_table_module
from rumi.robot.arm import Arm, ArmGeometry
from rumi.robot.reach import YAWS_RAD, Reach, reachability
from rumi.robot.reach_table import SECTOR_RAD, ReachSettings, ReachTable, reach_table, solve_table, table_shape
from sdf import se3, so3

pytest.importorskip("pytorch_kinematics")

SMALL = ReachSettings(radius_step_m=0.02, yaw_steps=30, coarse=3)
BASE = (-0.45, 0.1, 0.2)


@pytest.fixture(scope="module")
def table():
    return solve_table(SMALL)


@pytest.fixture(scope="module")
def reach(table):
    return Reach(table, SMALL, BASE).double()


@pytest.fixture(scope="module")
def arm():
    return Arm()


def poses_about_base(count, seed, *, base=BASE, sector=1.2):
    """Random (x, y, yaw) in front of the base, at any yaw."""
    generator = torch.Generator().manual_seed(seed)
    u = torch.rand(count, 3, generator=generator, dtype=torch.float64)
    radius, direction = 0.15 + 1.15 * u[:, 0], base[2] + sector * (2 * u[:, 1] - 1)
    return torch.stack(
        (base[0] + radius * direction.cos(), base[1] + radius * direction.sin(), math.pi * (2 * u[:, 2] - 1)), -1
    )


def test_golden(golden):
    case = golden("rumi.reach")
    inputs = case["inputs"]
    r = reachability(
        torch.tensor(inputs["e_x"], dtype=torch.float64),
        torch.tensor(inputs["e_R"], dtype=torch.float64),
        inputs["alpha_R"],
        inputs["e_m"],
    )
    expected = torch.tensor(case["expected"]["r"], dtype=torch.float64)
    torch.testing.assert_close(r, expected, atol=case["atol"], rtol=0)


def test_arm_stands_upright_at_zero(arm):
    pose = arm.forward(torch.zeros(1, 7, dtype=torch.float64))[0]
    geometry = ArmGeometry()
    height = sum(geometry.offsets_m) + geometry.flange_m + geometry.tool_m
    torch.testing.assert_close(pose[:3, 3], torch.tensor([0.0, 0.0, height], dtype=torch.float64))
    # the flange points up: the tool's x is bent away from it by the pitch
    assert float(pose[2, 0]) == pytest.approx(math.cos(geometry.tool_pitch_rad))


def test_jacobian_against_finite_differences(arm):
    joints = torch.tensor([[0.3, 0.7, -0.4, 1.1, 0.2, -0.8, 0.5]], dtype=torch.float64)
    jacobian, _ = arm.linearised(joints)
    step = 1e-5
    for index in range(7):
        ends = []
        for sign in (1, -1):
            moved = joints.clone()
            moved[0, index] += sign * step
            ends.append(arm.forward(moved)[0])
        velocity = (ends[0] - ends[1])[:3, 3] / (2 * step)
        omega = so3.log(ends[0][:3, :3] @ ends[1][:3, :3].mT) / (2 * step)
        torch.testing.assert_close(torch.cat((velocity, omega)), jacobian[0, :, index], atol=1e-7, rtol=0)


def test_solutions_keep_the_limits_and_reach_the_goal(arm):
    generator = torch.Generator().manual_seed(1)
    inside = arm.high * (torch.rand(200, 7, generator=generator, dtype=torch.float64) * 1.6 - 0.8)
    goals = arm.forward(inside)
    result = arm.solve(goals, inside + 0.2 * torch.randn(200, 7, generator=generator, dtype=torch.float64))
    assert bool((result.joints.abs() <= arm.high + 1e-12).all())
    assert float((result.position_error < 1e-4).double().mean()) > 0.95
    left = se3.distance(arm.forward(result.joints), goals)
    torch.testing.assert_close(left[0], result.position_error, atol=1e-9, rtol=0)
    torch.testing.assert_close(left[1], result.rotation_error, atol=1e-7, rtol=0)


def test_tighter_limits_hold(arm):
    limits = arm.high.clone()
    limits[0] = 0.1
    goal = se3.from_planar(torch.tensor([[0.0, 0.7, math.pi / 2]], dtype=torch.float64), 0.045)
    result = arm.solve(goal, torch.zeros(1, 7, dtype=torch.float64), low=-limits, high=limits)
    assert float(result.joints[0, 0].abs()) <= 0.1 + 1e-12


def test_table_agrees_with_inverse_kinematics_at_any_pose(arm, reach):
    """Two axes are enough: full solutions at random directions from the base, joint 1 within its full limits."""
    q = poses_about_base(80, seed=2)
    local = se3.inverse(se3.from_planar(torch.tensor(BASE, dtype=torch.float64))) @ se3.from_planar(q, SMALL.height_m)
    generator = torch.Generator().manual_seed(3)
    starts = torch.rand(16, 7, generator=generator, dtype=torch.float64) * 3.0 - 1.5
    starts = torch.cat((starts, torch.tensor(reach_table_module.STARTS, dtype=torch.float64)))
    every = arm.solve(local.repeat(len(starts), 1, 1), starts.repeat_interleave(len(q), 0))
    error = torch.stack((every.position_error, every.rotation_error)).reshape(2, len(starts), -1)
    best = (error[0].square() + (0.1 * error[1]).square()).argmin(0)
    index = torch.arange(len(q))
    direct = error[0][best, index] + 0.1 * error[1][best, index]
    tabled = reach.residual(q)
    assert float((tabled - direct).abs().max()) < 0.006
    clear = (direct < 0.001) | (direct > SMALL.tolerance_m + 0.006)
    assert int(clear.sum()) > 70
    assert bool(((direct <= SMALL.tolerance_m) == reach.reachable(q))[clear].all())


@pytest.mark.parametrize("yaw_deg", [0, 30, 60, 90, 120])
def test_outer_limit_is_the_stretched_elbow(reach, yaw_deg):
    """The wrist lies behind the tool and above it; the arm is spent where it is two links from the shoulder."""
    geometry = ArmGeometry()
    behind = geometry.offsets_m[6] + geometry.flange_m + geometry.tool_m
    shoulder, upper = sum(geometry.offsets_m[:2]), sum(geometry.offsets_m[2:4])
    lower = sum(geometry.offsets_m[4:6])
    wrist = SMALL.height_m + behind * math.sin(geometry.tool_pitch_rad)
    level = math.sqrt((upper + lower) ** 2 - (shoulder - wrist) ** 2)
    hand, yaw = behind * math.cos(geometry.tool_pitch_rad), math.radians(yaw_deg)
    limit = hand * math.cos(yaw) + math.sqrt(level**2 - (hand * math.sin(yaw)) ** 2)
    radius = torch.linspace(0.65 if yaw_deg < 90 else 0.5, 1.2, 2000, dtype=torch.float64)
    direction = BASE[2] + 0.3
    q = torch.stack(
        (
            BASE[0] + radius * math.cos(direction),
            BASE[1] + radius * math.sin(direction),
            torch.full_like(radius, direction + yaw),
        ),
        -1,
    )
    # the table interpolates across the limit, so that the residual rises a little before it
    farthest = float(radius[reach.residual(q) <= 0.002].max())
    assert farthest == pytest.approx(limit, abs=0.008)


def test_moves_with_the_base(table):
    q = poses_about_base(200, seed=4, base=(0.0, 0.0, 0.0))
    here = Reach(table, SMALL).double()
    there = Reach(table, SMALL, (0.3, -0.2, 0.7)).double()
    moved = se3.to_planar(se3.from_planar(torch.tensor([0.3, -0.2, 0.7], dtype=torch.float64)) @ se3.from_planar(q))
    torch.testing.assert_close(there.residual(moved), here.residual(q), atol=1e-6, rtol=0)
    torch.testing.assert_close(there.errors(moved)[1], here.errors(q)[1], atol=1e-5, rtol=0)


def test_mirror_image(table):
    q = poses_about_base(200, seed=5, base=(0.0, 0.0, 0.0))
    reach = Reach(table, SMALL).double()
    mirrored = q * torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)
    torch.testing.assert_close(reach.residual(mirrored), reach.residual(q), atol=1e-9, rtol=0)


def test_mirror_image_of_the_arm(arm):
    """What the table relies on: the joints about z and the mirrored ones change sign, and the pose is mirrored."""
    generator = torch.Generator().manual_seed(6)
    joints = torch.rand(20, 7, generator=generator, dtype=torch.float64) * 2 - 1
    turned = joints * torch.tensor([-1.0, 1.0, -1.0, 1.0, -1.0, 1.0, -1.0], dtype=torch.float64)
    mirror = torch.diag(torch.tensor([1.0, -1.0, 1.0, 1.0], dtype=torch.float64))
    torch.testing.assert_close(arm.forward(turned), mirror @ arm.forward(joints) @ mirror)


def test_beyond_table_and_sector(reach):
    far = torch.tensor([[BASE[0] + 3.0, BASE[1], BASE[2]]], dtype=torch.float64)
    assert float(reach.errors(far)[0]) > 1.5
    angle = BASE[2] + SECTOR_RAD + 0.3
    behind = torch.tensor(
        [[BASE[0] + 0.8 * math.cos(angle), BASE[1] + 0.8 * math.sin(angle), angle]], dtype=torch.float64
    )
    assert not bool(reach.reachable(behind))
    assert bool(
        reach.reachable(
            behind.new_tensor([[BASE[0] + 0.8 * math.cos(BASE[2]), BASE[1] + 0.8 * math.sin(BASE[2]), BASE[2]]])
        )
    )


def test_field_against_a_loop(reach):
    q = poses_about_base(12, seed=7)
    points = torch.cat((q[:, :2], torch.full((12, 1), 0.045, dtype=torch.float64)), -1).reshape(3, 4, 3)
    field = reach.field(points)
    for i in range(3):
        for j in range(4):
            total = 0.0
            for yaw in YAWS_RAD:
                goal = torch.cat((points[i, j, :2], points.new_tensor([BASE[2] + yaw])))
                position, rotation = reach.errors(goal)
                total += float(position) + 0.1 * float(rotation)
            assert float(field[i, j]) == pytest.approx(max(0.0, 0.4 - total / len(YAWS_RAD)) / 0.4, abs=1e-6)
    assert bool(((field >= 0) & (field <= 1)).all())
    # the farther out, the less reachable
    line = torch.tensor([[BASE[0] + r, BASE[1], 0.0] for r in (0.8, 1.0, 1.1, 1.2, 1.6)], dtype=torch.float64)
    values = reach.field(line)
    assert bool((values[1:] < values[:-1]).all()) and float(values[0]) > 0.95 and float(values[-1]) == 0.0


@given(
    position=st.lists(st.floats(0, 1), min_size=3, max_size=3),
    rotation=st.lists(st.floats(0, 3.2), min_size=3, max_size=3),
)
def test_reachability_falls_with_error(position, rotation):
    e_x, e_R = torch.tensor(position, dtype=torch.float64), torch.tensor(rotation, dtype=torch.float64)
    r = reachability(e_x, e_R)
    assert 0.0 <= float(r) <= 1.0
    assert float(reachability(e_x + 0.1, e_R)) <= float(r)
    assert float(reachability(torch.zeros(3), torch.zeros(3))) == 1.0


def test_field_needs_orientations_and_points(reach, no_shape_check):
    with pytest.raises(ValueError, match="yaws"):
        reach.field(torch.zeros(2, 3), yaws=())
    with pytest.raises(ValueError, match=r"points_w.*\(\*b, 3\)"):
        reach.field(torch.zeros(2, 2))


TINY = ReachSettings(radius_step_m=0.35, yaw_steps=2, coarse=1)


def fake(settings):
    shape = table_shape(settings)
    values = torch.arange(shape[0] * shape[1], dtype=torch.float64).reshape(shape)
    return ReachTable(values, 0.1 * values)


def test_cache_keeps_the_table(tmp_path, monkeypatch):
    solved = []
    monkeypatch.setattr(reach_table_module, "solve_table", lambda settings: solved.append(settings) or fake(settings))
    first = reach_table(TINY, cache_dir=tmp_path / "cache")
    second = reach_table(TINY, cache_dir=tmp_path / "cache")
    assert len(solved) == 1
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))
    # other settings have a table of their own, the tolerance apart, which is not in it
    reach_table(
        ReachSettings(radius_step_m=0.35, yaw_steps=2, coarse=1, tolerance_m=0.01), cache_dir=tmp_path / "cache"
    )
    assert len(solved) == 1
    bent = ReachSettings(ArmGeometry(tool_pitch_rad=0.0), radius_step_m=0.35, yaw_steps=2, coarse=1)
    reach_table(bent, cache_dir=tmp_path / "cache")
    assert len(solved) == 2
    assert len(list((tmp_path / "cache").iterdir())) == 2  # no temporary file stays behind


def test_no_cache_touches_no_disk(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(reach_table_module, "solve_table", fake)
    reach_table(TINY)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("damage", ["garbage", "truncated", "shape", "nan", "pickle"])
def test_damaged_cache_is_solved_again(tmp_path, monkeypatch, caplog, damage):
    monkeypatch.setattr(reach_table_module, "solve_table", fake)
    good = reach_table(TINY, cache_dir=tmp_path)
    (path,) = tmp_path.iterdir()
    if damage == "garbage":
        path.write_bytes(b"not a table")
    elif damage == "truncated":
        path.write_bytes(path.read_bytes()[:100])
    elif damage == "shape":
        np.savez(path, position=np.zeros((2, 2)), rotation=np.zeros((2, 2)))
    elif damage == "nan":
        np.savez(path, position=np.full(table_shape(TINY), np.nan), rotation=np.zeros(table_shape(TINY)))
    else:
        np.savez(path, position=np.array([{}], dtype=object), rotation=np.zeros(1))
    with caplog.at_level(logging.WARNING):
        again = reach_table(TINY, cache_dir=tmp_path)
    assert "it again" in caplog.text or "it out again" in caplog.text
    assert torch.equal(again.position, good.position)
    caplog.clear()
    reach_table(TINY, cache_dir=tmp_path)
    assert not caplog.text


def test_moves_to_another_dtype(table):
    reach = Reach(table, SMALL, BASE)
    q = poses_about_base(50, seed=8)
    assert reach.residual(q.float()).dtype == torch.float32
    double = Reach(table, SMALL, BASE).to(torch.float64)
    torch.testing.assert_close(double.residual(q).float(), reach.residual(q.float()), atol=1e-5, rtol=0)
