"""Likelihood of a rectangle's centre under unknown yaw, given contacts and free ways."""

import math
from dataclasses import dataclass, replace
from typing import Self

import torch
from jaxtyping import Float
from torch import Tensor

from sdf.check import check_finite, is_eager
from sdf.so3 import arccos


def width_share(distance: Float[Tensor, "*b"], half: Float[Tensor, "2"]) -> Float[Tensor, "*b"]:
    """Share of yaws (*b) at which a rectangle reaches less far than a distance from its middle, to one given side.

    It reaches |half_x cos| + |half_y sin| of the angle: half the shorter edge at least, the bounding circle at most.

    Args:
        distance: metres.
        half: half of the edges.
    """
    circle: float | Tensor
    lean: float | Tensor
    if is_eager() and not half.requires_grad:
        circle, lean = float(half.norm()), math.atan2(float(half[1]), float(half[0]))
    else:
        circle, lean = half.norm(), torch.atan2(half[1], half[0])
    past = arccos(distance / circle)
    within = past.clamp_max(lean) + past.clamp_max(0.5 * math.pi - lean)
    return 1.0 - within / (0.5 * math.pi)


@dataclass(frozen=True, eq=False)
class CircleTouches:
    """All that was felt of a rectangle of any yaw, as evidence on (x, y) of its middle.

    Attributes:
        half: half of the edges, metres.
        radius: of the ball that touches, metres.
        sigma_m: of a touched point.
        points_w: (K, 2), touched.
        normals_w: (K, 2), outward there.
        ways_w: (W, 2, 2), straight ways of the ball's centre on which it met nothing.
    """

    half: Float[Tensor, "2"]
    radius: float
    sigma_m: float
    points_w: Float[Tensor, "K 2"]
    normals_w: Float[Tensor, "K 2"]
    ways_w: Float[Tensor, "W 2 2"]

    @classmethod
    def none(cls, half: Float[Tensor, "2"], radius: float, sigma_m: float) -> Self:
        """Nothing felt yet."""
        return cls(half, radius, sigma_m, half.new_zeros(0, 2), half.new_zeros(0, 2), half.new_zeros(0, 2, 2))

    def with_way(self, start_w: Float[Tensor, "2"], end_w: Float[Tensor, "2"]) -> Self:
        """A way more on which nothing was met."""
        check_finite("start_w", start_w)
        check_finite("end_w", end_w)
        return replace(self, ways_w=torch.cat((self.ways_w, torch.stack((start_w, end_w))[None])))

    def with_touch(self, point_w: Float[Tensor, "2"], normal_w: Float[Tensor, "2"]) -> Self:
        """A touch more."""
        check_finite("point_w", point_w)
        check_finite("normal_w", normal_w)
        points, normals = torch.cat((self.points_w, point_w[None])), torch.cat((self.normals_w, normal_w[None]))
        return replace(self, points_w=points, normals_w=normals)

    def log_likelihood(self, places: Float[Tensor, "N 2"]) -> Float[Tensor, "N"]:
        """Of all readings together (N), nats, up to a constant.

        A way meets nothing with the share of yaws that leave it clear. A touched point is no nearer to the middle than
        half the shorter edge and no farther than the circle, measured along its normal and in all.
        """
        total = places.new_zeros(len(places))
        if len(self.ways_w):
            start, way = self.ways_w[:, None, 0], (self.ways_w[:, 1] - self.ways_w[:, 0])[:, None]
            apart = places - start
            share = (apart * way).sum(-1) / way.square().sum(-1).clamp_min(torch.finfo(way.dtype).tiny)
            gap = (apart - share.clamp(0.0, 1.0)[..., None] * way).norm(dim=-1) - self.radius
            total = total + width_share(gap, self.half).clamp_min(torch.finfo(way.dtype).tiny).log().sum(0)
        if len(self.points_w):
            apart = self.points_w[:, None] - places
            near, far = self.half.min(), self.half.norm()
            for reach in (apart.norm(dim=-1), (apart * self.normals_w[:, None]).sum(-1)):
                beyond = (near - reach).clamp_min(0.0) + (reach - far).clamp_min(0.0)
                total = total - 0.5 * (beyond / self.sigma_m).square().sum(0)
        return total
