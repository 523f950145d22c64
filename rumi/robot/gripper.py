"""Gripper: a palm and two rounded pads, as points, signed distances, polyhedra and bodies of a simulator."""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rumi.errors import UsageError
from rumi.robot.tool_shape import ToolShape
from sdf import se3
from sdf.base import SDF
from sdf.primitives import Box, Placed
from sensors.force.tool_parts import box_tool, ellipsoid_tool
from sensors.force.tool_surface import ConvexTool


@dataclass(frozen=True)
class GripperShape:
    """A box for a palm and an ellipsoid for each of two pads; the tool frame lies between the pads, x forward.

    Attributes:
        palm_m: length (x), width (y) and height (z) of the palm.
        palm_front_m: x of the palm's front face.
        pad_m: half axes of a pad along x, y and z.
        pad_offset_m: distance of each pad's centre from the tool frame, along y.
    """

    palm_m: tuple[float, float, float] = (0.09, 0.10, 0.04)
    palm_front_m: float = -0.025
    pad_m: tuple[float, float, float] = (0.035, 0.018, 0.022)
    pad_offset_m: float = 0.024

    @property
    def palm_center_m(self) -> float:
        """Where the palm's centre is along x."""
        return self.palm_front_m - 0.5 * self.palm_m[0]

    @property
    def pad_centers(self) -> tuple[tuple[float, float, float], ...]:
        """Centres of the pads in the tool frame."""
        return ((0.0, self.pad_offset_m, 0.0), (0.0, -self.pad_offset_m, 0.0))

    def in_palm(self, points: Float[Tensor, "*b D"]) -> Bool[Tensor, "*b"]:
        """Whether points (*b, 2 or 3) of the tool frame, metres, are in or on the palm."""
        center = points.new_tensor((self.palm_center_m, 0.0, 0.0)[: points.shape[-1]])
        half = points.new_tensor([0.5 * side for side in self.palm_m[: points.shape[-1]]])
        return ((points - center).abs() <= half + 1e-9).all(-1)

    def section(self, spacing: float) -> Float[Tensor, "n 2"]:
        """Points of the palm's and the pads' section at z = 0, borders included, about `spacing` metres apart."""
        length, width, _ = self.palm_m
        x = torch.linspace(self.palm_front_m - length, self.palm_front_m, _count(length, spacing), dtype=torch.float64)
        y = torch.linspace(-0.5 * width, 0.5 * width, _count(width, spacing), dtype=torch.float64)
        palm = torch.stack(torch.meshgrid(x, y, indexing="ij"), -1).reshape(-1, 2)
        return torch.cat((palm, self.pad_section(spacing)))

    def pad_section(self, spacing: float) -> Float[Tensor, "n 2"]:
        """Points of the pads' section at z = 0 outside the palm, borders included, about `spacing` metres apart."""
        a, b, _ = self.pad_m
        rows = []
        for x in torch.linspace(-a, a, _count(2.0 * a, spacing), dtype=torch.float64).tolist():
            half = b * math.sqrt(max(0.0, 1.0 - (x / a) ** 2))
            y = torch.linspace(-half, half, _count(2.0 * half, spacing) if half > 0 else 1, dtype=torch.float64)
            rows.append(torch.stack((torch.full_like(y, x), y), -1))
        pad = torch.cat(rows)
        both = torch.cat([pad + pad.new_tensor(center[:2]) for center in self.pad_centers])
        return both[~self.in_palm(both)]

    def solid(self, spacing: float) -> Float[Tensor, "n 3"]:
        """Points of the palm and the pads, borders included, about `spacing` metres apart."""
        length, width, height = self.palm_m
        axes = [
            torch.linspace(low, high, _count(high - low, spacing), dtype=torch.float64)
            for low, high in (
                (self.palm_front_m - length, self.palm_front_m),
                (-0.5 * width, 0.5 * width),
                (-0.5 * height, 0.5 * height),
            )
        ]
        palm = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
        return torch.cat((palm, self.pad_solid(spacing)))

    def pad_solid(self, spacing: float) -> Float[Tensor, "n 3"]:
        """Points of the pads outside the palm, borders included, about `spacing` metres apart."""
        deep = self.pad_m[2]
        poles = torch.tensor([center[:2] for center in self.pad_centers], dtype=torch.float64)
        layers = []
        for z in torch.linspace(-deep, deep, _count(2.0 * deep, spacing), dtype=torch.float64).tolist():
            share = math.sqrt(max(0.0, 1.0 - (z / deep) ** 2))
            scaled = (share * self.pad_m[0], share * self.pad_m[1], deep)
            flat = replace(self, pad_m=scaled).pad_section(spacing) if share > 0 else poles
            layers.append(torch.cat((flat, torch.full_like(flat[:, :1], z)), -1))
        points = torch.cat(layers)
        return points[~self.in_palm(points)]

    def outline(self, spacing: float) -> Float[Tensor, "n 2"]:
        """Points on the border of the palm's and the pads' section at z = 0, about `spacing` metres apart."""
        length, width, _ = self.palm_m
        x = torch.linspace(self.palm_front_m - length, self.palm_front_m, _count(length, spacing), dtype=torch.float64)
        y = torch.linspace(-0.5 * width, 0.5 * width, _count(width, spacing), dtype=torch.float64)
        sides = [torch.stack((x, torch.full_like(x, float(end))), -1) for end in (y[0], y[-1])]
        sides += [torch.stack((torch.full_like(y[1:-1], float(end)), y[1:-1]), -1) for end in (x[0], x[-1])]
        a, b, _ = self.pad_m
        fine = torch.linspace(0.0, 2.0 * math.pi, 1441, dtype=torch.float64)
        around = torch.stack((a * fine.cos(), b * fine.sin()), -1)
        along = torch.cat((torch.zeros(1, dtype=torch.float64), (around[1:] - around[:-1]).norm(dim=-1).cumsum(0)))
        count = max(4, math.ceil(float(along[-1]) / spacing))
        pad = around[torch.searchsorted(along, torch.arange(count, dtype=torch.float64) * (along[-1] / count))]
        both = torch.cat([pad + pad.new_tensor(center[:2]) for center in self.pad_centers])
        hidden = torch.stack(
            [
                ((both - both.new_tensor(c[:2])) / both.new_tensor((a, b))).square().sum(-1) < 1.0 - 1e-9
                for c in self.pad_centers
            ]
        ).any(0)
        palm = torch.cat(sides)
        covered = torch.stack(
            [
                ((palm - palm.new_tensor(c[:2])) / palm.new_tensor((a, b))).square().sum(-1) < 1.0
                for c in self.pad_centers
            ]
        ).any(0)
        return torch.cat((palm[~covered], both[~self.in_palm(both) & ~hidden]))

    def surface(self, spacing: float) -> Float[Tensor, "n 3"]:
        """Points on pads and palm, about `spacing` metres apart; those of the palm that the pads cover are left in."""
        sides = torch.tensor(self.palm_m, dtype=torch.float64)
        axes = [torch.linspace(-0.5, 0.5, max(2, math.ceil(side / spacing) + 1), dtype=torch.float64) for side in sides]
        lattice = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
        palm = lattice[(lattice.abs() == 0.5).any(-1)] * sides
        palm[:, 0] += self.palm_center_m
        return torch.cat((self.pad_shell(spacing), palm))

    def pad_shell(self, spacing: float) -> Float[Tensor, "n 3"]:
        """Points on the pads' surface outside the palm, about `spacing` metres apart."""
        a, b, c = self.pad_m
        angle = torch.linspace(0.0, math.pi, 721, dtype=torch.float64)
        # rings about the long axis, evenly spaced along the surface's profile
        profile = torch.stack((a * angle.cos(), 0.5 * (b + c) * angle.sin()), -1)
        along = torch.cat((torch.zeros(1, dtype=torch.float64), (profile[1:] - profile[:-1]).norm(dim=-1).cumsum(0)))
        rings = []
        for place in torch.linspace(0.0, float(along[-1]), _count(float(along[-1]), spacing)).tolist():
            index = min(int(torch.searchsorted(along, place)), len(angle) - 1)
            latitude = float(angle[index])
            sine = math.sin(latitude)
            count = max(1, round(math.pi * (b + c) * sine / spacing))
            turn = torch.arange(count, dtype=torch.float64) * (2.0 * math.pi / count)
            height = torch.full_like(turn, a * math.cos(latitude))
            rings.append(torch.stack((height, b * sine * turn.cos(), c * sine * turn.sin()), -1))
        pad = torch.cat(rings)
        both = torch.cat([pad + pad.new_tensor(center) for center in self.pad_centers])
        return both[~self.in_palm(both)]

    def pad_normals(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Outward unit normals of the pads at points of their surface, each of the nearer pad."""
        offsets = torch.stack([points - points.new_tensor(center) for center in self.pad_centers])
        nearer = offsets.norm(dim=-1).argmin(0)
        offset = offsets[nearer, torch.arange(len(points), device=points.device)]
        return torch.nn.functional.normalize(offset / points.new_tensor(self.pad_m).square(), dim=-1)

    def volume(self, spacing: float) -> Float[Tensor, "n 3"]:
        """Points inside the palm and the pads: centres of a lattice of cubes of `spacing` metres."""
        a, b, c = self.pad_m
        low = (self.palm_front_m - self.palm_m[0], -max(0.5 * self.palm_m[1], self.pad_offset_m + b))
        deep = max(0.5 * self.palm_m[2], c)
        spans = ((low[0], a), (low[1], -low[1]), (-deep, deep))
        axes = [
            torch.arange(_cells(end - start, spacing), dtype=torch.float64) * spacing + start + 0.5 * spacing
            for start, end in spans
        ]
        lattice = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
        inside = self.in_palm(lattice)
        for center in self.pad_centers:
            scaled = (lattice - lattice.new_tensor(center)) / lattice.new_tensor(self.pad_m)
            inside |= scaled.square().sum(-1) <= 1.0
        return lattice[inside]


def gripper_of(shape: ToolShape) -> GripperShape:
    """The shape as the gripper of a palm and two pads, which alone the simulator has.

    Raises:
        UsageError: it is another tool.
    """
    if not isinstance(shape, GripperShape):
        raise UsageError(
            f"Expected the gripper of a palm and two pads, which the simulator has, got a {type(shape).__name__}: "
            "choose the push model 'quasi-static' or 'displacement'"
        )
    return shape


class Ellipsoid(SDF):
    """An ellipsoid about the origin; distances are exact on its surface and to first order off it.

    Args:
        half_axes: along x, y and z, metres.
    """

    def __init__(self, half_axes: tuple[float, float, float]) -> None:
        if not min(half_axes) > 0:
            raise ValueError(f"Expected half axes above 0, got {half_axes}")
        high = torch.tensor(half_axes)
        super().__init__(torch.stack((-high, high)))
        self.half_axes = half_axes

    def distance(self, points_o: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
        """Signed distance (*b), metres: (k - 1) k / |grad|, with k the scaled distance from the middle."""
        axes = points_o.new_tensor(self.half_axes)
        scaled = (points_o / axes).norm(dim=-1)
        steep = (points_o / axes.square()).norm(dim=-1)
        # at the very middle all directions are alike
        inside = -axes.min() * torch.ones_like(scaled)
        return torch.where(steep > 1e-9, scaled * (scaled - 1.0) / steep.clamp_min(1e-9), inside)


def gripper_links(shape: GripperShape) -> tuple[SDF, ...]:
    """Palm and pads in the tool's frame, each a link."""
    a, b, c = shape.pad_m
    palm = Box([0.5 * side for side in shape.palm_m])
    centers = ((shape.palm_center_m, 0.0, 0.0), *shape.pad_centers)
    members: tuple[SDF, ...] = (palm, *(Ellipsoid((a, b, c)) for _ in shape.pad_centers))
    turn = torch.eye(3)
    return tuple(Placed(m, se3.make(turn, torch.tensor(center))) for m, center in zip(members, centers, strict=True))


def gripper_parts(shape: GripperShape, offset_m: Float[Tensor, "3"]) -> list[ConvexTool]:
    """Polyhedra of pads and palm, pads first, for evidence from a wrench.

    Args:
        shape: the gripper's.
        offset_m: (3,), of the tool frame in the sensor's, whose axes are alike.
    """
    offset = offset_m.double()
    pads = [ellipsoid_tool(torch.tensor(c, dtype=torch.float64) + offset, shape.pad_m) for c in shape.pad_centers]
    palm = torch.tensor([shape.palm_center_m, 0.0, 0.0], dtype=torch.float64) + offset
    return [*pads, box_tool(palm, shape.palm_m)]


def gripper_xml(shape: GripperShape, attributes: str) -> str:
    """Palm and pads as geoms of an MJCF body in the tool's frame.

    Args:
        shape: the gripper's.
        attributes: of each geom, such as mass and contact.
    """
    palm = " ".join(f"{0.5 * side:.9g}" for side in shape.palm_m)
    pad = " ".join(f"{side:.9g}" for side in shape.pad_m)
    pads = "\n      ".join(
        f'<geom type="ellipsoid" size="{pad}" pos="{x:.9g} {y:.9g} {z:.9g}" {attributes}/>'
        for x, y, z in shape.pad_centers
    )
    return f'<geom type="box" size="{palm}" pos="{shape.palm_center_m:.9g} 0 0" {attributes}/>\n      {pads}'


def _count(length: float, spacing: float) -> int:
    return max(2, math.ceil(length / spacing - 1e-9) + 1)


def _cells(length: float, spacing: float) -> int:
    return max(1, math.ceil(length / spacing - 1e-9))
