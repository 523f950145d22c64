"""Robot arm: kinematics and batched inverse kinematics, which set how far the tool gets."""

import math
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rumi.errors import UsageError
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
    """Kinematics of a serial arm, forward and inverse, batched, float64 on the CPU; needs pytorch-kinematics.

    Attributes:
        low, high: (J), limits of the joints, radians, or metres of joints that slide; infinite where there is none.

    Args:
        urdf: text of the robot's URDF; by default of the `ArmGeometry`.
        tip: the link at the end of the arm.

    Raises:
        UsageError: it is no URDF, or no arm that ends in the tip.
    """

    def __init__(self, urdf: str | None = None, tip: str = "tool") -> None:
        pytorch_kinematics = optional("pytorch_kinematics", "The arm's reach")
        text = ArmGeometry().urdf() if urdf is None else urdf
        joints = _joints_to(text, tip)
        self.joints = tuple(str(joint.get("name")) for joint in joints)
        limits = torch.tensor([_limits(joint) for joint in joints], dtype=torch.float64)
        self.low, self.high = limits.unbind(-1)
        try:
            chain = pytorch_kinematics.build_serial_chain_from_urdf(text.encode(), tip)
        except Exception as error:  # it raises whatever it stumbles over
            raise UsageError(f"Expected a URDF whose links hang together by joints, got: {error}") from error
        self.chain = chain.to(dtype=torch.float64, device="cpu")

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
        low: Float[Tensor, "J"] | None = None,
        high: Float[Tensor, "J"] | None = None,
        rotation_scale_m: float = 0.1,
        iterations: int = 40,
        tolerance_m: float = 1e-5,
        about: Float[Tensor, "3"] | None = None,
    ) -> IKResult:
        """Damped least squares from one start a goal; the joints never leave their limits.

        Minimises |position error|^2 + (rotation_scale_m * rotation error)^2 by Levenberg-Marquardt with a damping
        of its own for each row; a joint at its limit that would go beyond it is left out of the step. A goal out of
        reach ends at the nearest pose in that sense, so look at the errors.

        Args:
            base_T_goal: (n, 4, 4), where the tool should be.
            starts: (n, J), radians.
            low: (J), lower limits of the joints, where they should be tighter than the arm's.
            high: (J), upper limits.
            rotation_scale_m: metres that one radian counts as.
            iterations: at most so many steps.
            tolerance_m: a row whose weighted error is below this is done.
            about: (3,), unit axis of the tip's frame about which the tip may be turned in any way; None for none.
        """
        low = self.low if low is None else torch.maximum(low.to(self.low), self.low)
        high = self.high if high is None else torch.minimum(high.to(self.high), self.high)
        joints = starts.clamp(low, high)
        scale = base_T_goal.new_tensor([1.0] * 3 + [rotation_scale_m] * 3)

        def errors(joints: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
            jacobian, pose = self.linearised(joints)
            if about is None:
                turn = so3.log(goal[:, :3, :3] @ pose[:, :3, :3].mT)
            else:
                is_, aim = pose[:, :3, :3] @ about, goal[:, :3, :3] @ about
                turn = _swing(is_, aim)
                jacobian = jacobian.clone()
                jacobian[:, 3:] -= is_[..., None] * (is_[:, None] @ jacobian[:, 3:])
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
            free = ~_blocked(joints, slope, low, high)
            masked = jacobian * free[:, None, :]
            weighted = torch.linalg.solve(masked @ masked.mT + damping[:, None, None] * eye, error[..., None])
            step = (masked.mT @ weighted)[..., 0].clamp(-0.5, 0.5)
            tried = (joints + step).clamp(low, high)
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


def _swing(a: Float[Tensor, "n 3"], b: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Least turns that bring unit vectors a to b, as rotation vectors; of opposite ones, some half turn."""
    across = torch.linalg.cross(a, b)
    sine, cosine = across.norm(dim=-1, keepdim=True), (a * b).sum(-1, keepdim=True)
    aside = torch.linalg.cross(a, torch.eye(3).to(a)[a.abs().argmin(-1)])
    axis = torch.where(sine > 1e-9, across, aside * (cosine < 0))
    return torch.nn.functional.normalize(axis, dim=-1) * torch.atan2(sine, cosine)


def _blocked(
    joints: Float[Tensor, "n J"], slope: Float[Tensor, "n J"], low: Float[Tensor, "J"], high: Float[Tensor, "J"]
) -> Bool[Tensor, "n J"]:
    return ((joints <= low + 1e-9) & (slope < 0)) | ((joints >= high - 1e-9) & (slope > 0))


def _joints_to(urdf: str, tip: str) -> list[ElementTree.Element]:
    """The joints that move between a URDF's root and a link, the root's first."""
    try:
        root = ElementTree.fromstring(urdf)
    except ElementTree.ParseError as error:
        raise UsageError(f"Expected a URDF, could not read it: {error}") from error
    links = [str(link.get("name")) for link in root.findall("link")]
    if tip not in links:
        raise UsageError(f"There is no link {tip!r} in the URDF; its links are {', '.join(links) or 'none'}")
    above = {_end(joint, "child"): joint for joint in root.findall("joint")}
    found: list[ElementTree.Element] = []
    at = tip
    while at in above and len(found) <= len(above):
        found.append(above[at])
        at = _end(above[at], "parent")
    moving = [joint for joint in reversed(found) if joint.get("type") != "fixed"]
    if not moving:
        raise UsageError(f"Expected joints that move between the URDF's root and {tip!r}, got none")
    return moving


def _end(joint: ElementTree.Element, side: str) -> str:
    found = joint.find(side)
    return "" if found is None else str(found.get("link"))


def _limits(joint: ElementTree.Element) -> tuple[float, float]:
    """Lower and upper limit of a joint that turns or slides."""
    name, kind, limit = joint.get("name"), joint.get("type"), joint.find("limit")
    if kind not in ("revolute", "continuous", "prismatic"):
        raise UsageError(f"Expected joints that turn or slide, got {name!r}, which is {kind}")
    if joint.find("mimic") is not None:
        raise UsageError(f"Expected joints that move by themselves, got {name!r}, which mimics another")
    if kind == "continuous":
        return -math.inf, math.inf
    try:
        low, high = (float(str(limit.get(side, 0.0))) for side in ("lower", "upper")) if limit is not None else (0, 0)
    except ValueError:
        low, high = math.nan, math.nan
    if not (low < high and math.isfinite(high - low)):
        raise UsageError(f"Expected a lower limit below the upper one for the joint {name!r}, got {low} and {high}")
    return low, high
