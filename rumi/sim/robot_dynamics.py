"""Mass matrix and bias torques of a robot from its MJCF or URDF, by MuJoCo."""

import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rumi.errors import UsageError
from rumi.robot.robot_file import read_robot
from rumi.sim.world import _import_mujoco
from sensors.force.momentum_observer import DynamicsTerms


class MujocoDynamics:
    """A `sensors.force.momentum_observer.RobotDynamics`; float64.

    Dry friction (MuJoCo's frictionloss) is no part of the bias: it shows in the residual. Damping, springs and gravity
    compensation are. Contacts and limits are left out.

    Args:
        model: a MuJoCo model of the robot alone, with a fixed base.
        joints: names in the order of positions and torques; None for all, in the model's order. Others stay where the
            model has them.

    Raises:
        UsageError: there is no such joint, or it is neither a hinge nor a slide.
    """

    def __init__(self, model: Any, joints: Sequence[str] | None = None) -> None:  # noqa: ANN401  (without types)
        self._mujoco = mujoco = _import_mujoco()
        self.model = model
        self.data: Any = mujoco.MjData(model)
        simple = {int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)}
        known = {model.joint(index).name: index for index in range(model.njnt)}
        chosen = list(known) if joints is None else list(joints)
        if not chosen:
            raise UsageError("Expected a robot with joints, got none")
        for name in chosen:
            if name not in known:
                raise UsageError(f"Expected joints among {', '.join(sorted(known))}, got {name!r}")
            if int(model.jnt_type[known[name]]) not in simple:
                raise UsageError(f"Expected hinges and slides, got another kind of joint, {name!r}: leave it out")
        self.joints = tuple(chosen)
        self._place = np.array([int(model.jnt_qposadr[known[name]]) for name in chosen])
        self._dof = np.array([int(model.jnt_dofadr[known[name]]) for name in chosen])
        flags = mujoco.mjtDisableBit
        model.opt.disableflags |= int(flags.mjDSBL_CONSTRAINT) | int(flags.mjDSBL_CONTACT)
        self._mass = np.zeros((model.nv, model.nv))
        self._block = np.ix_(self._dof, self._dof)

    @classmethod
    def load(cls, robot: str | Path, joints: Sequence[str] | None = None) -> Self:
        """From a file, or from the text itself, of MJCF or URDF.

        Meshes of a URDF's links that have inertia are not looked for: they are of no use here.

        Raises:
            UsageError: it cannot be read.
        """
        mujoco = _import_mujoco()
        text, folder = read_robot(robot)
        try:
            if folder is None or "<robot" in text:
                return cls(mujoco.MjModel.from_xml_string(_bare(text)), joints)
            return cls(mujoco.MjModel.from_xml_path(str(robot)), joints)
        except (ValueError, ElementTree.ParseError) as error:
            if isinstance(error, UsageError):
                raise
            raise UsageError(f"Expected MJCF or URDF that MuJoCo can read: {error}") from error

    def __call__(self, position: Float[Tensor, "J"], velocity: Float[Tensor, "J"]) -> DynamicsTerms:
        """The terms at joint positions and velocities, in the order of `joints`."""
        mass, bias = self.terms(position.detach().cpu().numpy(), velocity.detach().cpu().numpy())
        return DynamicsTerms(torch.from_numpy(mass), torch.from_numpy(bias))

    def terms(self, position: np.ndarray, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The same on arrays (J): mass matrix (J, J) and bias (J)."""
        mujoco, model, data = self._mujoco, self.model, self.data
        data.qpos[self._place] = position
        data.qvel[self._dof] = velocity
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        mujoco.mj_fullM(model, data, self._mass)
        return self._mass[self._block], (data.qfrc_bias - data.qfrc_passive)[self._dof]


def _bare(text: str) -> str:
    """A URDF without the shapes of links whose inertia is given; MJCF as it is."""
    root = ElementTree.fromstring(text)
    if root.tag != "robot":
        return text
    for link in root.iter("link"):
        if link.find("inertial") is not None:
            for shape in (*link.findall("visual"), *link.findall("collision")):
                link.remove(shape)
    return ElementTree.tostring(root, encoding="unicode")
