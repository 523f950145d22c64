"""Primitive shapes: exact signed distance functions in closed form."""

import functools
import math
from collections.abc import Sequence
from typing import cast

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sdf import se3
from sdf.base import SDF, Sized
from sdf.check import FAR, check_shape, is_eager, keep_within_reach


class Sphere(Sized):
    """Ball about the origin.

    Args:
        radius: metres.
    """

    numbers = ("radius",)

    def __init__(self, radius: float) -> None:
        radius = _positive("radius", radius)
        super().__init__(_box((-radius,) * 3, (radius,) * 3))
        self.radius = radius

    def distance(self, points_o: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
        """Signed distance (*b), metres."""
        return safe_norm(object_points(points_o)) - self.radius


class Box(Sized):
    """Axis-aligned box about the origin.

    Args:
        half_extents: three half edge lengths, metres.
    """

    numbers = ("half_extents",)

    def __init__(self, half_extents: Sequence[float]) -> None:
        half = tuple(_positive("half_extents", float(h)) for h in half_extents)
        if len(half) != 3:
            raise ValueError(f"Expected half_extents to have 3 entries, got {len(half)}")
        super().__init__(_box([-h for h in half], half))
        self.half_extents = half

    def distance(self, points_o: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
        """Signed distance (*b), metres."""
        points = object_points(points_o)
        return rectangle(points.abs() - points.new_tensor(self.half_extents))


class Cylinder(Sized):
    """Upright cylinder about the origin, its axis along z.

    Args:
        radius: metres.
        half_height: metres.
    """

    numbers = ("radius", "half_height")

    def __init__(self, radius: float, half_height: float) -> None:
        super().__init__(_box((-radius, -radius, -half_height), (radius, radius, half_height)))
        self.radius = _positive("radius", radius)
        self.half_height = _positive("half_height", half_height)

    def distance(self, points_o: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
        """Signed distance (*b), metres."""
        points = object_points(points_o)
        across = safe_norm(points[..., :2]) - self.radius
        along = points[..., 2].abs() - self.half_height
        return rectangle(torch.stack((across, along), dim=-1))


class Capsule(Sized):
    """Points within a radius of a segment.

    Args:
        a: one end of the segment, metres.
        b: the other end; may equal `a`.
        radius: metres.
    """

    numbers = ("a", "b", "radius")

    def __init__(self, a: Sequence[float], b: Sequence[float], radius: float) -> None:
        _positive("radius", radius)
        if not all(abs(x) < FAR for x in (*a, *b)):
            raise ValueError(f"Expected ends within {FAR:g} m of the origin, got {tuple(a)} and {tuple(b)}")
        low = [min(p, q) - radius for p, q in zip(a, b, strict=True)]
        high = [max(p, q) + radius for p, q in zip(a, b, strict=True)]
        super().__init__(_box(low, high))
        self.a, self.b = tuple(map(float, a)), tuple(map(float, b))
        self.radius = _positive("radius", radius)

    def distance(self, points_o: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
        """Signed distance (*b), metres."""
        points = object_points(points_o)
        start = points.new_tensor(self.a)
        axis = points.new_tensor(self.b) - start
        offset = points - start
        along = (offset * axis).sum(-1) / max(math.dist(self.a, self.b) ** 2, 1e-30)
        return safe_norm(offset - along.clamp(0.0, 1.0)[..., None] * axis) - self.radius


class TorusArc(Sized):
    """Round tube along an arc of a circle in the plane y = 0, its ends rounded.

    Args:
        center: of the circle, metres (its y is where the plane is).
        ring_radius: of the circle, metres.
        tube_radius: of the tube, metres, less than the ring's.
        half_angle: radians in (0, pi], the arc reaches so far to each side of +x.
    """

    numbers = ("center", "half_angle", "ring_radius", "tube_radius")

    def __init__(self, center: Sequence[float], ring_radius: float, tube_radius: float, half_angle: float) -> None:
        if not 0 < half_angle <= math.pi:
            raise ValueError(f"Expected half_angle in (0, pi], got {half_angle}")
        if not 0 < tube_radius < ring_radius < FAR:
            raise ValueError(f"Expected 0 < tube_radius < ring_radius, got {tube_radius} and {ring_radius}")
        x, y, z = map(float, center)
        left = ring_radius * math.cos(half_angle)
        top = ring_radius * (math.sin(half_angle) if half_angle < math.pi / 2 else 1.0)
        super().__init__(
            _box(
                (x + left - tube_radius, y - tube_radius, z - top - tube_radius),
                (x + ring_radius + tube_radius, y + tube_radius, z + top + tube_radius),
            )
        )
        self.center, self.half_angle = (x, y, z), half_angle
        self.ring_radius, self.tube_radius = ring_radius, tube_radius

    def distance(self, points_o: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
        """Signed distance (*b), metres."""
        offset = object_points(points_o) - points_o.new_tensor(self.center)
        x, y, z = offset[..., 0], offset[..., 1], offset[..., 2].abs()
        sine, cosine = math.sin(self.half_angle), math.cos(self.half_angle)
        # within the arc's angle when on the +x side of the ray to its end (rotated by less than half a turn)
        beyond = torch.atan2(z.detach(), x.detach()) > self.half_angle
        to_ring = safe_norm(torch.stack((x, z), dim=-1)) - self.ring_radius
        ring = safe_norm(torch.stack((to_ring, y), dim=-1))
        end = safe_norm(torch.stack((x - self.ring_radius * cosine, y, z - self.ring_radius * sine), dim=-1))
        return torch.where(beyond, end, ring) - self.tube_radius


class Cup(Sized):
    """Open cup: a cylinder about z that stands on z = 0, hollowed from the top down to its base.

    Args:
        outer_radius: metres.
        height: metres.
        wall: thickness of the wall, metres.
        base: thickness of the bottom, metres.
    """

    numbers = ("outer_radius", "height", "wall", "base")

    def __init__(self, outer_radius: float, height: float, wall: float, base: float) -> None:
        if not 0 < wall < outer_radius < FAR or not 0 < base < height < FAR:
            raise ValueError(
                f"Expected 0 < wall < outer_radius and 0 < base < height, got wall {wall}, outer_radius "
                f"{outer_radius}, base {base}, height {height}"
            )
        super().__init__(_box((-outer_radius, -outer_radius, 0.0), (outer_radius, outer_radius, height)))
        self.outer_radius, self.height, self.wall, self.base = outer_radius, height, wall, base

    def distance(self, points_o: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
        """Signed distance (*b), metres: of the cross-section in (r, z), an L of two rectangles.

        Outside, the least of the distances to the two rectangles is exact; inside, that to the boundary of
        "full cylinder without cavity" is.
        """
        points = object_points(points_o)
        r, z = safe_norm(points[..., :2]), points[..., 2]
        inner = self.outer_radius - self.wall
        full = torch.stack((r - self.outer_radius, (z - 0.5 * self.height).abs() - 0.5 * self.height), dim=-1)
        cavity = torch.stack((r - inner, self.base - z), dim=-1)
        inside = torch.maximum(rectangle(full), -rectangle(cavity))
        middle = self.outer_radius - 0.5 * self.wall
        ring = torch.stack(((r - middle).abs() - 0.5 * self.wall, full[..., 1]), dim=-1)
        disc = torch.stack((full[..., 0], (z - 0.5 * self.base).abs() - 0.5 * self.base), dim=-1)
        return torch.where(inside < 0, inside, torch.minimum(rectangle(ring), rectangle(disc)))


class Union(SDF):
    """Everything that is in any member: the least of their distances.

    Exact outside. Inside, where members overlap, its size is a lower bound of the true depth (still 1-Lipschitz).
    """

    def __init__(self, members: Sequence[SDF]) -> None:
        if not members:
            raise ValueError("Expected at least one member, got none")
        bounds = torch.stack([member.bounds for member in members])
        super().__init__(torch.stack((bounds[:, 0].amin(0), bounds[:, 1].amax(0))))
        self.members = nn.ModuleList(members)

    def distance(self, points_o: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
        """Signed distance (*b), metres."""
        return functools.reduce(torch.minimum, [cast(SDF, member).distance(points_o) for member in self.members])


class Placed(SDF):
    """A member somewhere else in the object's frame, as part of a union.

    Args:
        member: in its own frame.
        object_T_member: (4, 4), where that frame is.
    """

    member_T_object: Float[Tensor, "4 4"]

    def __init__(self, member: SDF, object_T_member: Float[Tensor, "4 4"]) -> None:
        check_shape("object_T_member", object_T_member, "(4, 4)")
        x, y, z = member.bounds.unbind(-1)
        corners = se3.apply(object_T_member.to(member.bounds), torch.cartesian_prod(x, y, z))
        super().__init__(torch.stack((corners.amin(0), corners.amax(0))))
        self.member = member
        self.register_buffer("member_T_object", se3.inverse(object_T_member))

    def distance(self, points_o: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
        """Signed distance (*b), metres."""
        transform = self.member_T_object.to(points_o)
        return self.member.distance(object_points(points_o) @ transform[:3, :3].T + transform[:3, 3])


class Mug(Union):
    """Cup with a handle, upright on z = 0, its axis along z, the handle in the plane y = 0 towards +x.

    Exact outside. The handle is a round tube along an arc about the point (outer_radius, 0, height / 2) that ends
    in the wall without poking into the cavity.

    Args:
        outer_radius: of the cup, metres.
        height: of the cup, metres.
        wall: thickness of its wall, metres.
        base: thickness of its bottom, metres.
        tube_radius: of the handle's tube, metres.
        ring_radius: of the arc that the tube follows, metres.
    """

    def __init__(
        self,
        outer_radius: float = 0.041,
        height: float = 0.095,
        wall: float = 0.004,
        base: float = 0.004,
        tube_radius: float = 0.006,
        ring_radius: float = 0.030,
    ) -> None:
        if ring_radius + tube_radius > 0.5 * height:
            raise ValueError(
                f"Expected the handle to fit beside the cup (ring_radius + tube_radius <= height / 2), got "
                f"{ring_radius} + {tube_radius} > {0.5 * height}"
            )
        # the rounded end reaches 9/10 through the wall: fully joined, and clear of the cavity
        start = tube_radius - 0.9 * wall
        half_angle = math.acos(min(max(start / ring_radius, -1.0), 1.0))
        handle = TorusArc((outer_radius, 0.0, 0.5 * height), ring_radius, tube_radius, half_angle)
        super().__init__((Cup(outer_radius, height, wall, base), handle))
        self.outer_radius, self.height, self.wall, self.base = outer_radius, height, wall, base
        self.tube_radius, self.ring_radius, self.half_angle = tube_radius, ring_radius, half_angle


def safe_norm(vectors: Float[Tensor, "*b n"]) -> Float[Tensor, "*b"]:
    """Euclidean norm whose gradient at 0 is 0, not NaN (also the second)."""
    squared = (vectors * vectors).sum(-1)
    if is_eager() and not squared.requires_grad:
        return squared.sqrt()
    zero = squared == 0
    length = torch.where(zero, torch.ones_like(squared), squared).sqrt()
    return torch.where(zero, torch.zeros_like(length), length)


def rectangle(excess: Float[Tensor, "*b n"]) -> Float[Tensor, "*b"]:
    """Signed distance to a box from how far each coordinate is beyond its faces, `|x| - half_extent`."""
    return safe_norm(excess.clamp_min(0.0)) + excess.amax(-1).clamp_max(0.0)


def object_points(points: Tensor) -> Float[Tensor, "*b 3"]:
    """Checked points, those not finite moved very far away, so that no distance is ever NaN."""
    check_shape("points", points, "(*b, 3)")
    return keep_within_reach(points)


def _box(low: Sequence[float], high: Sequence[float]) -> Float[Tensor, "2 3"]:
    return torch.tensor([list(low), list(high)], dtype=torch.get_default_dtype())


def _positive(name: str, value: float) -> float:
    if not 0 < value < FAR:
        raise ValueError(f"Expected {name} to be a positive number of metres, got {value}")
    return float(value)
