"""Wrench contact on a tool of several convex parts: on the part that the line of force meets first."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sensors.force.force_torque import WrenchContact, WrenchSettings, WrenchStatus, wrench_contact
from sensors.force.tool_surface import ConvexTool, ToolSurface


def parts_contact(
    wrench: Float[Tensor, "K 6"],
    parts: Sequence[ToolSurface],
    covariance: Float[Tensor, "6 6"],
    settings: WrenchSettings | None = None,
) -> tuple[WrenchContact, Int[Tensor, "K"]]:
    """The touched point of each wrench on the part that its line of force meets first, and which part that is.

    Two touches at once have a resultant whose line goes between them: it may pass all parts by (MISS), lean too far on
    one (FRICTION), or look like one touch somewhere in between, which a wrench alone cannot tell.

    Args:
        wrench: (K, 6), of contact alone (`sensors.force.force_torque`).
        parts: convex, in the sensor's frame; one or more.
        covariance: (6, 6), of the wrench's noise.
        settings: when a wrench counts as a touch.
    """
    if not parts:
        raise ValueError("Expected one or more parts of the tool, got none")
    found = [wrench_contact(wrench, part, covariance, settings) for part in parts]
    force = wrench[:, :3]
    direction = force / force.norm(dim=-1, keepdim=True).clamp_min(torch.finfo(wrench.dtype).tiny)
    # a part that is passed by counts only where all are
    along = torch.stack(
        [
            torch.where(one.status == int(WrenchStatus.MISS), torch.inf, (one.point_s * direction).sum(-1))
            for one in found
        ]
    )
    first = along.argmin(0)
    rows = torch.arange(len(wrench), device=wrench.device)
    return WrenchContact(*(torch.stack(field)[first, rows] for field in zip(*found, strict=True))), first


def ellipsoid_tool(center_s: Float[Tensor, "3"], half_axes: Sequence[float], faces: int = 1000) -> ConvexTool:
    """A polyhedron about an ellipsoid whose axes are the sensor's: planes that touch it, spread evenly over directions.

    Args:
        center_s: (3,), metres.
        half_axes: along x, y and z, metres.
        faces: how many; the surface is off by about half an axis times 4 / faces.
    """
    index = torch.arange(faces, dtype=torch.float64) + 0.5
    height, angle = 1.0 - 2.0 * index / faces, math.pi * (1.0 + math.sqrt(5.0)) * index
    level = (1.0 - height.square()).sqrt()
    normals = torch.stack((level * angle.cos(), level * angle.sin(), height), -1)
    axes = torch.tensor(list(half_axes), dtype=torch.float64)
    # normals that are as even over the surface as the directions are over the ball
    normals = torch.nn.functional.normalize(normals / axes, dim=-1)
    offset = (normals * axes).norm(dim=-1) + normals @ center_s.double().cpu()
    return ConvexTool(torch.cat((normals, offset[:, None]), -1))


def rod_tool(a_s: Sequence[float], b_s: Sequence[float], radius_m: float, sides: int = 24) -> ConvexTool:
    """A prism about a round rod: planes that touch it, and one beyond each end.

    Args:
        a_s: one end of its axis, in the sensor's frame, metres.
        b_s: the other end.
        radius_m: of the rod, by which it reaches beyond both ends too.
        sides: how many; the surface is off by about 5 radii over their square.
    """
    a, b = (torch.tensor(list(end), dtype=torch.float64) for end in (a_s, b_s))
    if not float((b - a).norm()) > 0.0:
        raise ValueError(f"Expected two ends of a rod's axis, got {tuple(a_s)} twice")
    axis = torch.nn.functional.normalize(b - a, dim=0)
    across = torch.linalg.svd(axis[None]).Vh[1:]  # two unit vectors across it
    angle = torch.arange(sides, dtype=torch.float64) * (2.0 * math.pi / sides)
    normals = torch.cat((torch.stack((angle.cos(), angle.sin()), -1) @ across, axis[None], -axis[None]))
    offset = torch.maximum(normals @ a, normals @ b) + radius_m
    return ConvexTool(torch.cat((normals, offset[:, None]), -1))


def box_tool(center_s: Float[Tensor, "3"], sides_m: Sequence[float]) -> ConvexTool:
    """A box whose edges are along the sensor's axes; faces in the order +x, -x, +y, -y, +z, -z."""
    normals = torch.eye(3, dtype=torch.float64).repeat_interleave(2, 0)
    normals = normals * torch.tensor([1.0, -1.0], dtype=torch.float64).repeat(3)[:, None]
    half = 0.5 * torch.tensor(list(sides_m), dtype=torch.float64).repeat_interleave(2)
    return ConvexTool(torch.cat((normals, (half + normals @ center_s.double().cpu())[:, None]), -1))
