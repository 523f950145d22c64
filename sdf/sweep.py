"""Swept collision of a disc with rectangles, in closed form: where it first touches on a straight way."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sdf.batch import broadcast_shapes
from sdf.check import check_shape


class Sweep(NamedTuple):
    """First contact of a moving disc; where it meets nothing all but `hit` is of the way's end.

    Attributes:
        hit: (*b), whether it touches at all.
        distance: (*b), metres that its centre goes until then; the whole way where it touches nothing.
        point: (*b, D), on the object.
        normal: (*b, D), from there to the ball's centre, unit: the object's outward normal on a face.
    """

    hit: Bool[Tensor, "*b"]
    distance: Float[Tensor, "*b"]
    point: Float[Tensor, "*b D"]
    normal: Float[Tensor, "*b D"]


def sweep_rectangle(
    poses: Float[Tensor, "*#b 3"],
    half: Float[Tensor, "2"],
    start: Float[Tensor, "*#b 2"],
    end: Float[Tensor, "*#b 2"],
    radius: float,
) -> Sweep:
    """First contact of a disc with rectangles, exact: a ray against a rectangle with rounded corners.

    A disc that overlaps from the start touches at once, with the normal by which it gets out soonest.

    Args:
        poses: (x, y, yaw) of the rectangles' middles.
        half: half of the edges, metres.
        start: of the disc's centre.
        end: of its way.
        radius: of the disc, metres.
    """
    for name, value, size in (("poses", poses, 3), ("start", start, 2), ("end", end, 2)):
        check_shape(name, value, f"(*b, {size})", last=(size,))
    turn = turned(-poses[..., 2])
    begin = (turn @ (start - poses[..., :2])[..., None])[..., 0]
    way = (end - start).norm(dim=-1)
    along = (end - start) / way.clamp_min(torch.finfo(way.dtype).tiny)[..., None]
    ray = (turn @ along[..., None])[..., 0]
    shape = broadcast_shapes(begin.shape[:-1], ray.shape[:-1])
    begin, ray, way = begin.expand(*shape, 2), ray.expand(*shape, 2), way.expand(shape)
    time, normal = _ray(begin, ray, half, radius)
    foot, out, gap = nearest_on_rectangle(begin, half)
    within = gap <= radius
    hit = within | (time <= way)
    distance = torch.where(within, 0.0, torch.where(hit, time, way))
    normal = torch.where(within[..., None], out, torch.where(hit[..., None], normal, -ray))
    point = begin + distance[..., None] * ray - radius * normal
    point = torch.where(within[..., None], foot, point)
    back = turn.mT
    point_w = (back @ point[..., None])[..., 0] + poses[..., :2]
    return Sweep(hit, distance, point_w, (back @ normal[..., None])[..., 0])


def nearest_on_rectangle(
    points_o: Float[Tensor, "*b 2"], half: Float[Tensor, "2"]
) -> tuple[Float[Tensor, "*b 2"], Float[Tensor, "*b 2"], Float[Tensor, "*b"]]:
    """Nearest point of a rectangle's border (*b, 2), the outward normal there (*b, 2), signed distance (*b).

    Args:
        points_o: from the middle, along the edges, metres.
        half: half of the edges.
    """
    clamped = torch.minimum(torch.maximum(points_o, -half), half)
    apart = points_o - clamped
    inside = (apart == 0).all(-1)
    # the length of nothing has no slope of second order
    away = torch.where(inside[..., None], torch.ones_like(apart), apart).norm(dim=-1)
    depth = half - points_o.abs()
    towards = torch.where(points_o < 0, -1.0, 1.0).to(points_o)
    side = _one_hot(depth.argmin(-1), points_o) * towards
    foot = torch.where(inside[..., None], torch.where(side != 0, side * half, points_o), clamped)
    normal = torch.where(inside[..., None], side, apart / away.clamp_min(torch.finfo(away.dtype).tiny)[..., None])
    return foot, normal, torch.where(inside, -depth.amin(-1), away)


def _one_hot(axis: Tensor, like: Tensor) -> Float[Tensor, "*b 2"]:
    """Unit vectors along axes; the library's look at the values."""
    return (axis[..., None] == torch.arange(2, device=axis.device)).to(like)


def turned(yaw: Float[Tensor, "*b"]) -> Float[Tensor, "*b 2 2"]:
    """Rotations by yaw, radians."""
    cos, sin = yaw.cos(), yaw.sin()
    return torch.stack((torch.stack((cos, -sin), -1), torch.stack((sin, cos), -1)), -2)


def _ray(
    begin: Float[Tensor, "*b 2"], ray: Float[Tensor, "*b 2"], half: Float[Tensor, "2"], radius: float
) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b 2"]]:
    """Way until a ray enters the rounded rectangle (inf where it does not), and the normal there; from outside."""
    grown = half + radius
    still = ray.abs() < torch.finfo(ray.dtype).eps
    safe = torch.where(still, 1.0, ray)
    one, two = (-grown - begin) / safe, (grown - begin) / safe
    beside = still & (begin.abs() > grown)
    into = torch.where(still, -torch.inf, torch.minimum(one, two)).masked_fill(beside, torch.inf)
    out_of = torch.where(still, torch.inf, torch.maximum(one, two))
    enter, axis = into.max(-1)
    met = (enter <= out_of.amin(-1)) & (out_of.amin(-1) >= 0)
    # where the ray begins within the grown rectangle, it begins beside a rounded corner
    enter = torch.where(met, enter.clamp_min(0.0), 0.0)
    at = begin + enter[..., None] * ray
    corner = half * torch.where(at < 0, -1.0, 1.0).to(at)
    beyond = (at.abs() > half).all(-1)
    face = _one_hot(axis, ray) * -torch.sign(ray)
    # |begin + t ray - corner| = radius, the first root
    apart = begin - corner
    middle = -(apart * ray).sum(-1)
    rest = radius**2 - (apart + middle[..., None] * ray).square().sum(-1)
    on_arc = middle - rest.clamp_min(0.0).sqrt()
    round_hit = (rest >= 0) & (on_arc >= 0)
    time = torch.where(beyond, on_arc.masked_fill(~round_hit, torch.inf), enter).masked_fill(~met, torch.inf)
    centre = begin + torch.where(time.isfinite(), time, 0.0)[..., None] * ray
    arc = (centre - corner) / max(radius, 1e-12)
    return time, torch.where(beyond[..., None], arc, face)
