"""Likelihood of a rectangle's planar pose, given contacts of sides, corners and top, and free ways."""

from dataclasses import dataclass, replace
from typing import Self

import torch
from jaxtyping import Float
from torch import Tensor

from sdf import backend, compiled
from sdf.check import check_finite, check_shape
from sdf.precision import full_precision
from sdf.sweep import nearest_on_rectangle, turned
from sensors.touch.touch_likelihood import TouchNoise, box_face_log_likelihoods

_ALLOWED = 2.0
"""Standard deviations by which a free way may seem to overlap."""


@full_precision
def rectangle_log_likelihoods(
    poses: Float[Tensor, "*#b N 3"],
    points_w: Float[Tensor, "*#b K 2"],
    normals_w: Float[Tensor, "*#b K 2"],
    half: Float[Tensor, "2"],
    noise: TouchNoise,
    *,
    corners: bool = True,
) -> Float[Tensor, "*b K N"]:
    """Log-likelihood of each touch at each pose, nats: the side that explains point and normal best together.

    Time allocation, Eqs. 2-5 in closed form. A ball touches corners too, with any normal between those of their two
    sides, which no side explains: with `corners` such a normal counts as the corner's own. The paper knows none.

    Args:
        poses: (x, y, yaw) of the middle.
        points_w: touched, metres.
        normals_w: outward, unit.
        half: half of the edges, metres.
        noise: of the touches.
        corners: whether corners explain touches.
    """
    check_shape("poses", poses, "(*b, N, 3)")
    check_shape("points_w", points_w, "(*b, K, 2)")
    check_shape("normals_w", normals_w, "(*b, 2)")
    if poses.dim() == 2:
        flat = points_w.reshape(-1, 2), normals_w.expand_as(points_w).reshape(-1, 2)
        version = backend.dispatch("rectangle_touches", poses, *flat, half, *noise.tensors())
        best = version(poses, *flat, half, noise, corners).view(*points_w.shape[:-1], len(poses))
    else:
        best = _touches_plain(poses, points_w, normals_w, half, noise, corners)
    return noise.with_outliers(best, True)


@backend.register("rectangle_touches")
def _touches_plain(
    poses: Float[Tensor, "*#b N 3"],
    points_w: Float[Tensor, "*#b K 2"],
    normals_w: Float[Tensor, "*#b K 2"],
    half: Float[Tensor, "2"],
    noise: TouchNoise,
    corners: bool,
) -> Float[Tensor, "*b K N"]:
    """The same without outliers."""
    back = turned(-poses[..., None, :, 2])
    own = (back @ (points_w[..., :, None, :] - poses[..., None, :, :2])[..., None])[..., 0]
    facing = (back @ normals_w[..., :, None, :, None])[..., 0]
    best = box_face_log_likelihoods(own, facing, half, noise).amax(-1)
    if corners:
        corner = torch.where(facing < 0, -half, half)
        best = torch.maximum(best, noise.log_likelihood((own - corner).square().sum(-1), None))
    return best


@backend.register("rectangle_touches", "numba", compiled.supports)
def _touches_numba(
    poses: Tensor, points_w: Tensor, normals_w: Tensor, half: Tensor, noise: TouchNoise, corners: bool
) -> Tensor:
    from sensors.touch.rectangle_touch_numba import touches_kernel

    arrays = (part.detach().double().contiguous().numpy() for part in (poses, points_w, normals_w))
    found = torch.empty(len(points_w), len(poses), dtype=torch.float64)
    scales = (float(0.5 / noise.point_m**2), float(0.5 / noise.normal_rad**2))
    touches_kernel(*arrays, float(half[0]), float(half[1]), *scales, corners, found.numpy())
    return found.to(points_w)


def way_clearances(
    poses: Float[Tensor, "N 3"], half: Float[Tensor, "2"], ways_w: Float[Tensor, "W 2 2"]
) -> Float[Tensor, "W N"]:
    """`way_clearance` of each way (start, end) from the rectangle at each pose."""
    check_shape("poses", poses, "(N, 3)")
    check_shape("ways_w", ways_w, "(W, 2, 2)")
    version = backend.dispatch("way_clearances", poses, half, ways_w)
    found: Tensor = version(poses, half, ways_w)
    return found


@backend.register("way_clearances")
def _clearances_plain(
    poses: Float[Tensor, "N 3"], half: Float[Tensor, "2"], ways_w: Float[Tensor, "W 2 2"]
) -> Float[Tensor, "W N"]:
    return way_clearance(poses, half, ways_w[:, :1], ways_w[:, 1:])


@backend.register("way_clearances", "numba", compiled.supports)
def _clearances_numba(poses: Tensor, half: Tensor, ways_w: Tensor) -> Tensor:
    from sensors.touch.rectangle_touch_numba import clearances_kernel

    arrays = (part.detach().double().contiguous().numpy() for part in (poses, ways_w))
    found = torch.empty(len(ways_w), len(poses), dtype=torch.float64)
    clearances_kernel(*arrays, float(half[0]), float(half[1]), found.numpy())
    return found.to(poses)


@full_precision
def way_clearance(
    poses: Float[Tensor, "*#b 3"],
    half: Float[Tensor, "2"],
    start: Float[Tensor, "*#b 2"],
    end: Float[Tensor, "*#b 2"],
) -> Float[Tensor, "*b"]:
    """Distance (*b) of straight ways from rectangles, metres; below 0 how far one must move not to cross the other.

    Args:
        poses: (x, y, yaw) of the rectangles' middles.
        half: half of the edges.
        start: of the way.
        end: of the way; a point where it is the start.
    """
    back = turned(-poses[..., 2])
    a = (back @ (start - poses[..., :2])[..., None])[..., 0]
    b = (back @ (end - poses[..., :2])[..., None])[..., 0]
    a, b = torch.broadcast_tensors(a, b)
    # gaps between shadows: along the edges, and across the way
    low, high = torch.minimum(a, b), torch.maximum(a, b)
    gaps = torch.maximum(low - half, -half - high)
    still = (a == b).all(-1, keepdim=True)  # a point, which has no direction
    along = torch.nn.functional.normalize(torch.where(still, torch.ones_like(a), b - a), dim=-1) * ~still
    across = torch.stack((-along[..., 1], along[..., 0]), -1)
    side = (a * across).sum(-1).abs() - (across.abs() * half).sum(-1)
    apart = torch.maximum(gaps.amax(-1), torch.where(across.abs().sum(-1) > 0, side, -torch.inf))
    corners = half * half.new_tensor([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])
    from_a = corners - a[..., None, :]
    way = (b - a)[..., None, :]
    length = way.square().sum(-1).clamp_min(torch.finfo(way.dtype).tiny)
    share = (from_a * way).sum(-1) / torch.where(still, torch.ones_like(length), length)
    to_corner = (from_a - share.clamp(0.0, 1.0)[..., None] * way).norm(dim=-1).amin(-1)
    ends = torch.minimum(*(nearest_on_rectangle(x, half)[2] for x in (a, b)))
    return torch.where(apart > 0, torch.minimum(to_corner, ends), apart)


@dataclass(frozen=True, eq=False)
class RectangleTouches:
    """All that was felt of a rectangle, as evidence on (x, y, yaw); readings add up.

    Attributes:
        half: half of the edges, metres.
        noise: of the touches.
        radius: of the ball, metres.
        points_w: (K, 2), touched on the sides.
        normals_w: (K, 2), outward there.
        over_w: (T, 2), where the ball met the top from above.
        ways_w: (W, 2, 2), straight ways of its centre on which it met nothing.
        corners: whether corners explain touches.
    """

    half: Float[Tensor, "2"]
    noise: TouchNoise
    radius: float
    points_w: Float[Tensor, "K 2"]
    normals_w: Float[Tensor, "K 2"]
    over_w: Float[Tensor, "T 2"]
    ways_w: Float[Tensor, "W 2 2"]
    corners: bool = True

    @classmethod
    def none(cls, half: Float[Tensor, "2"], noise: TouchNoise, radius: float, *, corners: bool = True) -> Self:
        """Nothing felt yet."""
        empty = half.new_zeros(0, 2)
        return cls(half, noise, radius, empty, empty, empty, half.new_zeros(0, 2, 2), corners)

    def with_touch(self, point_w: Float[Tensor, "2"], normal_w: Float[Tensor, "2"]) -> Self:
        """A touch of a side more."""
        check_finite("point_w", point_w)
        check_finite("normal_w", normal_w)
        points, normals = torch.cat((self.points_w, point_w[None])), torch.cat((self.normals_w, normal_w[None]))
        return replace(self, points_w=points, normals_w=normals)

    def with_top(self, over_w: Float[Tensor, "2"]) -> Self:
        """A touch of the top more."""
        check_finite("over_w", over_w)
        return replace(self, over_w=torch.cat((self.over_w, over_w[None])))

    def with_way(self, start_w: Float[Tensor, "2"], end_w: Float[Tensor, "2"]) -> Self:
        """A way more on which nothing was met."""
        check_finite("start_w", start_w)
        check_finite("end_w", end_w)
        return replace(self, ways_w=torch.cat((self.ways_w, torch.stack((start_w, end_w))[None])))

    def only_touches(self) -> Self:
        """What was touched on the sides alone."""
        return replace(self, over_w=self.over_w[:0], ways_w=self.ways_w[:0])

    def joined(self, other: Self) -> Self:
        """Both together."""
        names = ("points_w", "normals_w", "over_w", "ways_w")
        points, normals, over, ways = (torch.cat((getattr(self, name), getattr(other, name))) for name in names)
        return replace(self, points_w=points, normals_w=normals, over_w=over, ways_w=ways)

    def log_likelihood(self, poses: Float[Tensor, "N 3"]) -> Float[Tensor, "N"]:
        """Of all readings together (N), nats, up to a constant.

        The top's is Eq. 3 for a face that faces up, whose normal leaves no doubt. A way met nothing with the chance
        that a ball, whose place is as uncertain as a touch's, was clear of the object all along; that it seems to
        overlap by twice this uncertainty leaves it as good as sure, so that ways close by do not push the object off.
        """
        total = poses.new_zeros(len(poses))
        if len(self.points_w):
            sides = rectangle_log_likelihoods(
                poses, self.points_w, self.normals_w, self.half, self.noise, corners=self.corners
            )
            total = total + sides.sum(-2)
        if len(self.over_w):
            spots = self.over_w[:, None].expand(-1, 2, 2)
            off = way_clearances(poses, self.half, spots).clamp_min(0.0)
            total = total + self.noise.log_likelihood(off.square(), None).sum(-2)
        if len(self.ways_w):
            gap = way_clearances(poses, self.half, self.ways_w) - self.radius
            total = total + torch.special.log_ndtr(gap / self.noise.point_m + _ALLOWED).sum(-2)
        return total
