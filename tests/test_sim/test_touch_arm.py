"""The arm of the touch-alone task: pokes, what it does where it cannot, and grasps."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

pytestmark = pytest.mark.sim
pytest.importorskip("mujoco")
from rumi.sim.torque_arm import TorqueSample, TorqueSettings  # noqa: E402
from rumi.tasks.touch_box.arm_robot import ArmRobot  # noqa: E402
from rumi.tasks.touch_box.robot import Touched, TouchRobot  # noqa: E402
from rumi.tasks.touch_box.scene import BoxTruth, TouchTask  # noqa: E402

F64 = torch.float64
TASK = TouchTask()
TRUTH = BoxTruth(torch.tensor([0.5, 0.1, 0.0], dtype=F64), 0.4, 0.4, 0.5)
# without a calibration, which takes most of the time
EXACT = TorqueSettings(
    torque_noise_nm=0.0, torque_bias_nm=0.0, velocity_noise=0.0, mass_error=0.0, friction_nm=0.0, threshold_nm=0.3
)


@pytest.fixture(scope="module")
def robot() -> ArmRobot:
    made = ArmRobot(TASK, EXACT)
    made.arm.calibrate = lambda: None  # type: ignore[method-assign, assignment, return-value]
    return made


def poke(angle: float, until: float = 0.0, count: int = 21) -> Tensor:
    """Towards the box's middle, up to so far before it."""
    ahead = torch.tensor([math.cos(angle), math.sin(angle)], dtype=F64)
    way = torch.linspace(-0.1, 0.0, count, dtype=F64)[:, None] * ahead
    place = TRUTH.pose[:2] + way - until * ahead
    return torch.cat((place, torch.full((count, 1), angle, dtype=F64)), -1)


def test_a_poke_feels_the_box_and_pushes_it(robot: ArmRobot) -> None:
    assert isinstance(robot, TouchRobot)
    robot.reset(TRUTH, 1000)
    torch.testing.assert_close(robot.box_pose(), TRUTH.pose, atol=1e-3, rtol=0)
    path = poke(0.0)
    assert robot.feasible(path[None]).tolist() == [True]
    asked = []

    def go_on(touched: Touched) -> bool:
        asked.append(len(touched.contact))
        return True

    touched = robot.execute(path, go_on)
    assert touched.stopped == "end"
    assert not touched.blocked
    assert asked == list(range(1, 20))
    assert touched.path.shape == (len(touched.contact) + 1, 3)
    torch.testing.assert_close(touched.path[:21], path, atol=2e-3, rtol=0)
    # the fingers reach 10 mm ahead, the box 30 mm towards them
    first = int(touched.contact.to(torch.uint8).argmax())
    assert float(touched.path[first + 1, 0]) == pytest.approx(0.46, abs=0.007)
    assert not bool(touched.contact[:first].any())
    assert float(robot.box_pose()[0]) == pytest.approx(0.54, abs=3e-3)


def test_who_watches_ends_a_poke(robot: ArmRobot) -> None:
    robot.reset(TRUTH, 1000)
    touched = robot.execute(poke(0.0), lambda touched: not bool(touched.contact.any()))
    assert touched.stopped == "belief"
    assert touched.contact.tolist().index(True) >= len(touched.contact) - 2
    assert float(robot.box_pose()[0]) < 0.52


def test_it_does_not_come_down_on_the_box(robot: ArmRobot) -> None:
    robot.reset(TRUTH, 1000)
    touched = robot.execute(poke(0.5 * math.pi, until=-0.1), lambda touched: True)
    assert touched.blocked
    assert touched.stopped == "blocked"
    assert len(touched.contact) == 0
    torch.testing.assert_close(robot.box_pose(), TRUTH.pose, atol=5e-3, rtol=0)


def test_it_goes_as_far_as_it_can(robot: ArmRobot) -> None:
    robot.reset(TRUTH, 1000)
    far = poke(0.0)
    far[:, :2] += torch.tensor([0.2, 0.3], dtype=F64)
    beyond = far.clone()
    beyond[:, 0] += 0.5
    assert robot.feasible(torch.stack((far, beyond, poke(0.3)))).tolist() == [False, False, True]
    touched = robot.execute(far, lambda touched: True)
    assert 1 < len(touched.path) < 21
    assert not bool(touched.contact.any())
    nowhere = robot.execute(beyond, lambda touched: True)
    assert nowhere.path.shape == (1, 3)
    # it did not move: what it would have met there, nobody knows
    assert nowhere.blocked is None
    assert nowhere.stopped == "reach"


def test_a_measured_yaw_does_not_jump_by_a_turn(robot: ArmRobot) -> None:
    def felt(yaw: float, k: int = 0) -> TorqueSample:
        return TorqueSample(np.array([0.5, 0.1 + 0.01 * k, 0.0, yaw]), 0.0, 0.0, False, False)

    yaws = [math.pi - 1e-3, -math.pi + 1e-3, math.pi - 2e-3, -math.pi + 2e-3]
    parts = tuple(felt(yaw, k) for k, yaw in enumerate(yaws[1:]))
    start = torch.tensor([0.5, 0.09, yaws[0]], dtype=F64)
    path = robot._touched(start, parts, 0.0, "end").path
    expected = torch.tensor([yaw % (2.0 * math.pi) for yaw in yaws], dtype=F64)
    torch.testing.assert_close(path[:, 2], expected)
    # where it does not, a reading is told to the last digit as it was measured
    level = tuple(felt(yaw) for yaw in (0.1, -0.1, 3.0))
    path = robot._touched(start.new_tensor([0.5, 0.09, 0.3]), level, 0.0, "end").path
    assert path[:, 2].tolist() == [0.3, 0.1, -0.1, 3.0]


def test_it_lifts_the_box_where_that_is_and_not_elsewhere(robot: ArmRobot) -> None:
    robot.reset(TRUTH, 1000)
    assert not robot.grasp(torch.tensor([0.5, -0.2, 0.0], dtype=F64))
    assert not robot.grasp(torch.tensor([1.5, 0.0, 0.0], dtype=F64))
    assert robot.grasp(TRUTH.pose + torch.tensor([0.004, 0.01, 0.05], dtype=F64))
    robot.close()


def test_the_arm_has_rates_of_its_own() -> None:
    made = ArmRobot(TASK)
    assert 0 < made.rates[1] < made.rates[0] < 1
    assert made.pusher.radius == TASK.fingers.radius
