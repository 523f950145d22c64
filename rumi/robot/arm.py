"""Robot arm: kinematics and batched inverse kinematics, which set how far the tool gets."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sdf import so3
from sdf.extras import optional


@dataclass(frozen=True)
class ArmGeometry:
    """A 7-joint arm with the proportions of a KUKA iiwa, and the tool on its flange; all joints at 0: upright.

    Attributes:
        offsets_m: height of each joint above the one before it.
        axes: axis of each joint in its own frame.
        limits_rad: largest angle of each joint, either way.
        flange_m: from the last joint to the flange.
        tool_m: from the flange to the tool frame (between the pads).
        tool_pitch_rad: bend between flange and tool: with the tool level the flange points down by this angle,
            which keeps the wrist off the table.
    """

    offsets_m: tuple[float, ...] = (0.1575, 0.2025, 0.2045, 0.2155, 0.1845, 0.2155, 0.081)
    axes: tuple[str, ...] = ("0 0 1", "0 1 0", "0 0 1", "0 -1 0", "0 0 1", "0 1 0", "0 0 1")
    limits_rad: tuple[float, ...] = tuple(math.radians(a) for a in (170.0, 120.0, 170.0, 120.0, 170.0, 120.0, 175.0))
    flange_m: float = 0.045
    tool_m: float = 0.155
    tool_pitch_rad: float = 0.5

    def urdf(self) -> str:
        """The arm as URDF text; its last link, `tool`, points along +x with z up."""
        parts = ['<robot name="arm"><link name="base"/>']
        parent = "base"
        for index, (offset, axis, limit) in enumerate(zip(self.offsets_m, self.axes, self.limits_rad, strict=True)):
            child = f"link_{index + 1}"
            parts.append(
                f'<link name="{child}"/><joint name="joint_{index + 1}" type="revolute"><parent link="{parent}"/>'
                f'<child link="{child}"/><origin xyz="0 0 {offset!r}" rpy="0 0 0"/><axis xyz="{axis}"/>'
                f'<limit lower="{-limit!r}" upper="{limit!r}" effort="300" velocity="2"/></joint>'
            )
            parent = child
        reach, turn = self.flange_m + self.tool_m, -0.5 * math.pi - self.tool_pitch_rad
        parts.append(
            f'<link name="tool"/><joint name="mount" type="fixed"><parent link="{parent}"/><child link="tool"/>'
            f'<origin xyz="0 0 {reach!r}" rpy="0 {turn!r} 0"/></joint></robot>'
        )
        return "".join(parts)


class IKResult(NamedTuple):
    """Result of inverse kinematics, one row a goal.

    Attributes:
        joints: (n, J), radians, within the limits.
        position_error: (n), metres left between tool and goal.
        rotation_error: (n), radians left.
    """

    joints: Float[Tensor, "n J"]
    position_error: Float[Tensor, "n"]
    rotation_error: Float[Tensor, "n"]


class Arm:
    """Forward kinematics, Jacobian and inverse kinematics of an `ArmGeometry`; needs pytorch-kinematics.

    Args:
        geometry: the arm.
        dtype: of all it computes.
        device: where.
    """

    def __init__(
        self,
        geometry: ArmGeometry | None = None,
        *,
        dtype: torch.dtype = torch.float64,
        device: torch.device | str = "cpu",
    ) -> None:
        pytorch_kinematics = optional("pytorch_kinematics", "The arm's reach")
        self.geometry = geometry or ArmGeometry()
        text = self.geometry.urdf().encode()
        self.chain = pytorch_kinematics.build_serial_chain_from_urdf(text, "tool").to(dtype=dtype, device=device)
        self.limits = torch.tensor(self.geometry.limits_rad, dtype=dtype, device=device)

    def forward(self, joints: Float[Tensor, "n J"]) -> Float[Tensor, "n 4 4"]:
        """base_T_tool at joint angles (n, J), radians."""
        return self.linearised(joints)[1]

    def linearised(self, joints: Float[Tensor, "n J"]) -> tuple[Float[Tensor, "n 6 J"], Float[Tensor, "n 4 4"]]:
        """Geometric Jacobian (v, omega; base frame) and base_T_tool at joint angles (n, J), radians."""
        jacobian, pose = self.chain.jacobian_tensor(joints, ret_eef_pose=True)
        return jacobian, pose

    def solve(
        self,
        base_T_goal: Float[Tensor, "n 4 4"],
        starts: Float[Tensor, "n J"],
        *,
        limits: Float[Tensor, "J"] | None = None,
        rotation_scale_m: float = 0.1,
        iterations: int = 40,
        tolerance_m: float = 1e-5,
    ) -> IKResult:
        """Damped least squares from one start a goal; the joints never leave their limits.

        Minimises |position error|^2 + (rotation_scale_m * rotation error)^2 by Levenberg-Marquardt with a damping
        of its own for each row; a joint at its limit that would go beyond it is left out of the step. A goal out of
        reach ends at the nearest pose in that sense, so look at the errors.

        Args:
            base_T_goal: (n, 4, 4), where the tool should be.
            starts: (n, J), radians.
            limits: (J), radians either way, where they should be tighter than the arm's.
            rotation_scale_m: metres that one radian counts as.
            iterations: at most so many steps.
            tolerance_m: a row whose weighted error is below this is done.
        """
        limits = self.limits if limits is None else torch.minimum(limits.to(self.limits), self.limits)
        joints = starts.clamp(-limits, limits)
        scale = base_T_goal.new_tensor([1.0] * 3 + [rotation_scale_m] * 3)

        def errors(joints: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
            jacobian, pose = self.linearised(joints)
            turn = so3.log(goal[:, :3, :3] @ pose[:, :3, :3].mT)
            return jacobian * scale[:, None], torch.cat((goal[:, :3, 3] - pose[:, :3, 3], turn), -1) * scale

        best_joints, best_error = joints.clone(), errors(joints, base_T_goal)[1]
        # rows that are done drop out, which saves most of the work
        rows = torch.arange(len(joints), device=joints.device)
        goal = base_T_goal
        jacobian, error = errors(joints, goal)
        cost = error.square().sum(-1)
        damping = torch.full_like(cost, 1e-3)
        eye = torch.eye(6, dtype=joints.dtype, device=joints.device)
        for iteration in range(iterations):
            slope = (jacobian.mT @ error[..., None])[..., 0]
            free = ~_blocked(joints, slope, limits)
            masked = jacobian * free[:, None, :]
            weighted = torch.linalg.solve(masked @ masked.mT + damping[:, None, None] * eye, error[..., None])
            step = (masked.mT @ weighted)[..., 0].clamp(-0.5, 0.5)
            tried = (joints + step).clamp(-limits, limits)
            tried_jacobian, tried_error = errors(tried, goal)
            tried_cost = tried_error.square().sum(-1)
            better = tried_cost < cost
            joints = torch.where(better[:, None], tried, joints)
            jacobian = torch.where(better[:, None, None], tried_jacobian, jacobian)
            error = torch.where(better[:, None], tried_error, error)
            cost = torch.where(better, tried_cost, cost)
            damping = torch.where(better, damping * 0.3, damping * 4.0).clamp(1e-7, 10.0)
            last = iteration == iterations - 1
            if last or iteration % 4 == 3:
                best_joints[rows], best_error[rows] = joints, error
                going = cost > tolerance_m**2
                if last or not bool(going.any()):
                    break
                rows, goal, joints, jacobian = rows[going], goal[going], joints[going], jacobian[going]
                error, cost, damping = error[going], cost[going], damping[going]
        return IKResult(best_joints, best_error[:, :3].norm(dim=-1), best_error[:, 3:].norm(dim=-1) / rotation_scale_m)


def _blocked(
    joints: Float[Tensor, "n J"], slope: Float[Tensor, "n J"], limits: Float[Tensor, "J"]
) -> Bool[Tensor, "n J"]:
    return ((joints <= 1e-9 - limits) & (slope < 0)) | ((joints >= limits - 1e-9) & (slope > 0))
