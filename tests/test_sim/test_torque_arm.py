"""The arm under torque control: kinematics, tracking, what it feels, and that force stops it."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

pytestmark = pytest.mark.sim
pytest.importorskip("mujoco")
from rumi.errors import UsageError  # noqa: E402
from rumi.robot.arm import Arm, ArmGeometry  # noqa: E402
from rumi.sim.arm_motion import HandDownKinematics, joint_path  # noqa: E402
from rumi.sim.arm_scene import ArmPhysics  # noqa: E402
from rumi.sim.torque_arm import TorqueArm, TorqueSettings  # noqa: E402

EXACT = TorqueSettings(
    torque_noise_nm=0.0,
    torque_bias_nm=0.0,
    velocity_noise=0.0,
    mass_error=0.0,
    friction_nm=0.0,
    threshold_nm=0.3,
)
HALF, HEIGHT = (0.03, 0.08), 0.1


def line(start: tuple[float, float, float], end: tuple[float, float, float], yaw: float, knots: int) -> np.ndarray:
    share = np.linspace(0.0, 1.0, knots)[:, None]
    return np.concatenate((np.array(start) + share * (np.array(end) - start), np.full((knots, 1), yaw)), 1)


def ready(settings: TorqueSettings, start: np.ndarray, friction: float = 0.4) -> tuple[TorqueArm, np.ndarray]:
    """An arm at rest at the first pose of a path, and the joints along it; the box is at (0.5, 0.1)."""
    arm = TorqueArm(HALF, HEIGHT, settings=settings)
    for name in ("floor", "left", "right"):
        arm.model.pair_friction[arm.model.pair(name).id][:2] = friction
    arm.seed(1000)
    arm.put_box(torch.tensor([0.5, 0.1, 0.0]))
    joints = arm.kinematics.follow(start)
    arm.stand(joints[0], 0.01)
    arm.rest(0.1, joints[0])
    return arm, joints


def test_the_hand_is_where_the_urdf_of_the_arm_says() -> None:
    pytest.importorskip("pytorch_kinematics")
    physics = ArmPhysics(base=(0.2, -0.3, 0.7))
    kinematics = HandDownKinematics(physics)
    chain = Arm(ArmGeometry(tool_m=physics.hand_m).urdf())
    joints = np.random.default_rng(0).uniform(-1.5, 1.5, (5, 7))
    for row, base_T_tool in zip(joints, chain.forward(torch.from_numpy(joints)), strict=True):
        x, y, z = base_T_tool[:3, 3].tolist()
        turned = (0.2 + math.cos(0.7) * x - math.sin(0.7) * y, -0.3 + math.sin(0.7) * x + math.cos(0.7) * y, z)
        assert kinematics.place(row)[0] == pytest.approx(turned, abs=1e-7)


def test_the_jacobian_is_the_derivative_of_the_place() -> None:
    kinematics = HandDownKinematics(ArmPhysics())
    joints = np.random.default_rng(1).uniform(-1.0, 1.0, 7)
    jacobian = kinematics.jacobian(joints)
    for index in range(7):
        off = 1e-6 * np.eye(7)[index]
        found = (kinematics.place(joints + off)[0] - kinematics.place(joints - off)[0]) / 2e-6
        assert jacobian[:3, index] == pytest.approx(found, abs=1e-8)


def test_inverse_kinematics_reaches_what_can_be_reached() -> None:
    kinematics = HandDownKinematics(ArmPhysics())
    path = line((0.35, 0.2, 0.0), (0.55, 0.1, 0.0), 0.4, 9)
    joints = kinematics.follow(path)
    assert np.abs(joints).max() < max(ArmGeometry().limits_rad)
    for row, pose in zip(joints, path, strict=True):
        assert kinematics.pose(row) == pytest.approx(pose, abs=2e-4)
        assert kinematics.place(row)[1][2, 2] == pytest.approx(1.0, abs=1e-6)
    assert kinematics.follow(line((0.5, 0.0, 0.0), (1.2, 0.0, 0.0), 0.0, 9)) is None


def test_splines_go_through_their_knots_smoothly() -> None:
    knots = np.random.default_rng(2).standard_normal((6, 7))
    path = joint_path(knots, 1000)
    assert path.end == 5.0
    for index, knot in enumerate(knots):
        assert path.at(float(index))[0] == pytest.approx(knot)
    assert np.gradient(path.position, 1e-3, axis=0)[1:-1] == pytest.approx(path.first[1:-1], abs=1e-4)
    assert np.gradient(path.first, 1e-3, axis=0)[1:-1] == pytest.approx(path.second[1:-1], abs=1e-2)
    assert path.at(9.0)[0] == pytest.approx(knots[-1])
    assert joint_path(knots[:2]).at(0.25)[0] == pytest.approx(0.75 * knots[0] + 0.25 * knots[1])


def test_a_good_model_tracks_well_and_feels_nothing_in_free_air() -> None:
    arm, joints = ready(EXACT, line((0.35, -0.2, 0.0), (0.55, -0.2, 0.0), 0.0, 21))
    motion = arm.follow(joint_path(joints), 8.0)
    assert motion.ended == "end"
    assert len(motion.parts) in (20, 21)
    assert float(motion.tracking_m.max()) < 5e-4
    assert max(part.norm_nm for part in motion.parts) < 0.05
    assert not any(part.touching or part.signal for part in motion.parts)
    assert motion.parts[-1].pose == pytest.approx([0.55, -0.2, 0.0, 0.0], abs=1e-3)


def test_a_push_is_felt_with_its_force() -> None:
    arm, joints = ready(EXACT, line((0.40, 0.1, 0.0), (0.52, 0.1, 0.0), 0.5 * math.pi, 25))
    motion = arm.follow(joint_path(joints), 16.0)
    # on the floor the friction is 0.4, and the box has half a kilogram
    steady = [part.force_n for part in motion.parts[-10:-2]]
    assert float(np.mean(steady)) == pytest.approx(0.4 * 0.5 * 9.81, rel=0.2)
    touched = [part.touching for part in motion.parts]
    first = touched.index(True)
    assert not any(part.signal for part in motion.parts[:first])
    assert [part.signal for part in motion.parts[first + 1 : -2]] == [True] * (len(motion.parts) - first - 3)
    assert float(arm.box_pose()[0]) > 0.51
    # one finger is before the other, turned as the hand is
    assert float(arm.box_pose()[0]) == pytest.approx(float(motion.parts[-1].pose[0]) + 0.05, abs=1e-3)


def test_force_ends_an_action_early() -> None:
    # down onto the box
    arm, joints = ready(EXACT, line((0.5, 0.1, 0.15), (0.5, 0.1, 0.0), 0.0, 13))
    motion = arm.follow(joint_path(joints), 8.0)
    assert motion.ended == "force"
    assert float(motion.parts[-1].pose[2]) > 0.06
    assert len(motion.parts) < 13
    assert max(part.force_n for part in motion.parts) > EXACT.force_limit_n


def test_who_asked_for_a_motion_can_end_it() -> None:
    arm, joints = ready(EXACT, line((0.35, -0.2, 0.0), (0.55, -0.2, 0.0), 0.0, 21))
    motion = arm.follow(joint_path(joints), 8.0, lambda parts: len(parts) < 5, ramp_s=0.05)
    assert motion.ended == "asked"
    assert len(motion.parts) == 6  # with what it took to stop
    assert 0.4 < float(motion.parts[4].pose[0]) < float(motion.parts[5].pose[0]) < 0.41


def test_the_same_seed_feels_the_same() -> None:
    norms = []
    for seed in (1000, 1000, 1001):
        arm, joints = ready(TorqueSettings(), line((0.35, -0.2, 0.0), (0.40, -0.2, 0.0), 0.0, 6))
        arm.seed(seed)
        arm.rest(0.1, joints[0])
        norms.append([part.norm_nm for part in arm.follow(joint_path(joints), 16.0).parts])
    assert norms[0] == norms[1]
    assert norms[0] != norms[2]


@pytest.mark.slow
def test_calibration_mends_masses_friction_and_bias() -> None:
    settings = TorqueSettings(torque_noise_nm=0.05, velocity_noise=0.0005, mass_error=0.05, friction_known=0.5)
    settings = replace(settings, motor_side=True)
    norms = []
    for calibrated in (False, True):
        arm, joints = ready(settings, line((0.35, -0.2, 0.0), (0.55, -0.1, 0.0), 0.5, 21))
        if calibrated:
            found = arm.calibrate()
            assert arm.friction == pytest.approx(np.full(7, 0.5), abs=0.1)
            assert found.factors[1:] != pytest.approx(np.ones(6), abs=0.005)
            # the bias that the sensors were drawn with
            assert found.rest_nm == pytest.approx(-arm._bias, abs=0.25)
            # box and floor are where they were
            assert arm.box_pose().tolist() == pytest.approx([0.5, 0.1, 0.0], abs=1e-4)
        arm.stand(joints[0], 0.01)
        arm.rest(0.1, joints[0])
        norms.append(np.mean([part.norm_nm for part in arm.follow(joint_path(joints), 16.0).parts]))
    assert norms[1] < 0.6 * norms[0]


def test_what_makes_no_arm_is_refused() -> None:
    with pytest.raises(UsageError, match="masses_kg"):
        ArmPhysics(masses_kg=(1.0,))
    with pytest.raises(UsageError, match="threshold_nm"):
        TorqueSettings(threshold_nm=0.0)
    with pytest.raises(UsageError, match="friction_nm"):
        TorqueSettings(friction_nm=-1.0)
