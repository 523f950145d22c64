"""Dynamics from MJCF and URDF against a two-link arm in closed form, and the observer on a simulated one."""

import math
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch

from rumi.errors import UsageError
from sensors.force.momentum_observer import MomentumObserver

pytestmark = pytest.mark.sim
mujoco = pytest.importorskip("mujoco")
from rumi.sim.robot_dynamics import MujocoDynamics  # noqa: E402

F64 = torch.float64
LENGTH, CENTER, MASS, INERTIA, ARMATURE, DAMPING = 0.4, 0.25, (2.0, 1.5), 0.02, 0.1, 0.3

MJCF = f"""<mujoco><option timestep="0.001" integrator="Euler"/>
<default><joint axis="0 -1 0" armature="{ARMATURE}" damping="{DAMPING}"/></default>
<worldbody><body name="upper"><joint name="shoulder"/>
  <inertial pos="{CENTER} 0 0" mass="{MASS[0]}" diaginertia="{INERTIA} {INERTIA} {INERTIA}"/>
  <body name="fore" pos="{LENGTH} 0 0"><joint name="elbow"/>
    <inertial pos="{CENTER} 0 0" mass="{MASS[1]}" diaginertia="{INERTIA} {INERTIA} {INERTIA}"/>
    <site name="tip" pos="{LENGTH} 0 0"/></body></body></worldbody>
<actuator><motor joint="shoulder"/><motor joint="elbow"/></actuator></mujoco>"""


def link(name: str, mass: float) -> str:
    return f"""<link name="{name}"><inertial><origin xyz="{CENTER} 0 0"/><mass value="{mass}"/>
    <inertia ixx="{INERTIA}" iyy="{INERTIA}" izz="{INERTIA}" ixy="0" ixz="0" iyz="0"/></inertial>
    <visual><geometry><mesh filename="package://nowhere/{name}.stl"/></geometry></visual>
    <collision><geometry><mesh filename="package://nowhere/{name}.stl"/></geometry></collision></link>"""


def joint(name: str, parent: str, child: str, x: float) -> str:
    return f"""<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/>
    <origin xyz="{x} 0 0"/><axis xyz="0 -1 0"/><limit lower="-3" upper="3" effort="9" velocity="9"/>
    <dynamics damping="{DAMPING}"/></joint>"""


URDF = (
    f'<robot name="arm"><link name="base"/>{link("upper", MASS[0])}{link("fore", MASS[1])}'
    f"{joint('shoulder', 'base', 'upper', 0.0)}{joint('elbow', 'upper', 'fore', LENGTH)}</robot>"
)


def closed_form(position: torch.Tensor, velocity: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Mass matrix and bias of two links that turn in a vertical plane (Spong, Robot Modeling and Control)."""
    (q1, q2), (v1, v2) = position.tolist(), velocity.tolist()
    m1, m2 = MASS
    both = m2 * LENGTH * CENTER
    m22 = m2 * CENTER**2 + INERTIA
    m12 = m22 + both * math.cos(q2)
    m11 = m1 * CENTER**2 + INERTIA + m22 + m2 * LENGTH**2 + 2 * both * math.cos(q2)
    h = -both * math.sin(q2)
    g2 = 9.81 * m2 * CENTER * math.cos(q1 + q2)
    g1 = 9.81 * (m1 * CENTER + m2 * LENGTH) * math.cos(q1) + g2
    mass = torch.tensor([[m11, m12], [m12, m22]], dtype=F64)
    bias = torch.tensor([h * (2 * v1 * v2 + v2**2) + g1 + DAMPING * v1, -h * v1**2 + g2 + DAMPING * v2], dtype=F64)
    return mass, bias


@pytest.mark.parametrize("text", [MJCF, URDF], ids=["mjcf", "urdf"])
def test_terms_are_those_of_the_closed_form(text: str, tmp_path: Path, generator: torch.Generator) -> None:
    armature = ARMATURE * torch.eye(2, dtype=F64) * (text is MJCF)
    file = tmp_path / "arm.xml"
    file.write_text(text)
    for source in (text, file):
        dynamics = MujocoDynamics.load(source)
        assert dynamics.joints == ("shoulder", "elbow")
        for _ in range(5):
            position, velocity = (torch.randn(2, generator=generator, dtype=F64) for _ in range(2))
            found, (mass, bias) = dynamics(position, velocity), closed_form(position, velocity)
            torch.testing.assert_close(found.mass, mass + armature, rtol=1e-9, atol=1e-12)
            torch.testing.assert_close(found.bias, bias, rtol=1e-9, atol=1e-12)


def test_joints_come_in_the_order_asked_for(generator: torch.Generator) -> None:
    position, velocity = (torch.randn(2, generator=generator, dtype=F64) for _ in range(2))
    usual = MujocoDynamics.load(MJCF)(position, velocity)
    turned = MujocoDynamics.load(MJCF, ("elbow", "shoulder"))(position.flip(0), velocity.flip(0))
    torch.testing.assert_close(turned.mass, usual.mass.flip(0, 1))
    torch.testing.assert_close(turned.bias, usual.bias.flip(0))
    # a joint that is left out stands still where the model has it
    alone = MujocoDynamics.load(MJCF, ("elbow",))(position[:1], velocity[:1])
    still = closed_form(torch.tensor([0.0, float(position[0])]), torch.tensor([0.0, float(velocity[0])]))
    assert float(alone.bias) == pytest.approx(float(still[1][1]))


def simulated(pushed: np.ndarray, gain: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Residuals of an arm that swings about under motors, and J^T f of a force at its tip, filtered exactly."""
    model = mujoco.MjModel.from_xml_string(MJCF)
    data = mujoco.MjData(model)
    data.qpos[:] = (0.4, -0.9)
    site, body = model.site("tip").id, model.body("fore").id
    rows, wanted, jacobian = [], [], np.zeros((3, 2))
    filtered, share = np.zeros(2), -math.expm1(-gain * 0.001)
    for index in range(1500):
        mujoco.mj_forward(model, data)
        time = 0.001 * index
        goal = np.array([0.4 + 0.3 * math.sin(3.0 * time), -0.9 + 0.4 * math.sin(5.0 * time)])
        data.ctrl[:] = data.qfrc_bias + 150.0 * (goal - data.qpos) - 15.0 * data.qvel
        force = pushed * (time > 0.5)
        mujoco.mj_jacSite(model, data, jacobian, None, site)
        data.xfrc_applied[body, :3] = force
        data.xfrc_applied[body, 3:] = np.cross(data.site_xpos[site] - data.xipos[body], force)
        rows.append(np.concatenate((data.qpos, data.qvel, data.ctrl)))
        wanted.append(filtered.copy())
        filtered += share * (jacobian.T @ force - filtered)
        mujoco.mj_step(model, data)
    values = torch.from_numpy(np.array(rows))
    dynamics, observer = MujocoDynamics.load(MJCF), MomentumObserver(gain)
    state = observer.start(dynamics(values[0, :2], values[0, 2:4]), values[0, 2:4])
    found = [state.residual]
    for before, now in pairwise(values):
        # the engine holds a torque until the next sample
        state = observer.step(state, dynamics(now[:2], now[2:4]), now[2:4], before[4:], 0.001)
        found.append(state.residual)
    return torch.stack(found), torch.from_numpy(np.array(wanted))


@pytest.mark.parametrize("gain", [25.0, 100.0])
def test_a_force_at_the_tip_shows_as_its_joint_torques(gain: float) -> None:
    found, wanted = simulated(np.array([4.0, 0.0, -6.0]), gain)
    assert float(wanted.abs().max()) > 2.0
    assert float((found - wanted).abs().max()) < 0.03
    free, _ = simulated(np.zeros(3), gain)
    assert float(free.abs().max()) < 0.03


def test_what_is_no_robot_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="none"):
        MujocoDynamics.load(tmp_path / "nothing.urdf")
    with pytest.raises(UsageError, match="can read"):
        MujocoDynamics.load("<mujoco><worldbody><nonsense/></worldbody></mujoco>")
    with pytest.raises(UsageError, match="can read"):
        MujocoDynamics.load("<robot><link")
    with pytest.raises(UsageError, match="elbow, shoulder"):
        MujocoDynamics.load(MJCF, ("wrist",))
    free = '<mujoco><worldbody><body><freejoint name="free"/><geom size="1"/></body></worldbody></mujoco>'
    with pytest.raises(UsageError, match="hinges"):
        MujocoDynamics.load(free)
    with pytest.raises(UsageError, match="with joints"):
        MujocoDynamics.load("<mujoco/>")
