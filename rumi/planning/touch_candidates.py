"""Candidate touches: ways of a tool in space to a point of the object's side, as a pose of the belief has it."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rumi import seeding
from rumi.planning.first_contact import TouchingSurface
from rumi.robot.tool import Tool
from sdf import se3
from sdf.bounds import Checked, Count, NotNegative
from sdf.object_model import ObjectModel
from sdf.so3 import wrap

_LEVEL = 0.5  # sine of a normal's elevation, below which a point is on a side
_DRAWN, _TRIES = 4, 3  # ways that are drawn for each candidate, and points for each of them, of which one is on a side
_FRONT_M = 0.012  # behind the foremost point of the pads, along the way, from which on one may be what touches
_MOST_TURN_RAD = 1.5  # that a tool turns to face what it touches
_KINDS = 5  # ways to a touch


@dataclass(frozen=True)
class CandidateSettings(Checked):
    """Settings of candidate touches.

    Attributes:
        count: of candidates, at most.
        clear_m: how far in front of a touch the last straight part of a way begins.
        press_m: how far beyond a touch it ends: where the object is believed to be nearer it ends sooner.
        facing_rad: deviation of the tool's yaw from facing the surface.
        above_m: of the pads' underside over the highest of some points of the object, where a way goes over it.
        back_m: how far a way that first goes back goes.
        actions: that a way may take, at most.
    """

    count: Count = 64
    clear_m: NotNegative = 0.045
    press_m: NotNegative = 0.006
    facing_rad: NotNegative = 0.3
    above_m: NotNegative = 0.02
    back_m: NotNegative = 0.04
    actions: Count = 8


def candidate_touches(
    world_T_object: Float[Tensor, "N 4 4"],
    model: ObjectModel,
    tool: Tool,
    surface: TouchingSurface,
    configuration: Float[Tensor, "4"],
    settings: CandidateSettings,
    *,
    generator: torch.Generator,
) -> tuple[Float[Tensor, "K H 4"], Int[Tensor, "K"]]:
    """Controls of each candidate, followed by zeros, and how many controls each has; at least one candidate.

    Those within the limits of tool and arm alone, where there are any: what goes along a limit leads elsewhere.

    A touch is a point of the surface at a pose, both drawn evenly, that faces sideways if there are any such, met level
    along its normal by one of the pads' foremost points. The tool turns to face it, or not; it goes there straight, or
    by a place in front of it, having gone back before or not, or over the object.

    Args:
        world_T_object: poses, of equal weight.
        model: of the object.
        tool: that moves in space.
        surface: of the tool.
        configuration: where it is now.
        settings: of the candidates.
        generator: of the draws.
    """
    like, count = configuration, _DRAWN * settings.count

    def uniform(*shape: int) -> Tensor:
        return seeding.uniform(shape, generator=generator, dtype=like.dtype, device=like.device)

    def one_of(many: int, size: int) -> Tensor:
        return (uniform(size) * many).long().clamp_max(many - 1)

    pose = world_T_object[one_of(len(world_T_object), _TRIES * count)].to(like)
    points = one_of(len(model.surface_points), _TRIES * count)
    normal = (pose[:, :3, :3] @ model.surface_normals[points].to(like)[..., None])[..., 0]
    sides = (normal[:, 2].abs() < _LEVEL).byte().argsort(descending=True, stable=True)[:count]
    at = se3.apply(pose[sides], model.surface_points[points[sides]].to(like)[:, None])[:, 0]
    inward = -normal[sides, :2]
    inward = inward / inward.norm(dim=-1, keepdim=True).clamp_min(1e-6)

    now = configuration[3]
    noise = seeding.normal((count,), generator=generator, dtype=like.dtype, device=like.device)
    facing = torch.atan2(inward[:, 1], inward[:, 0]) + settings.facing_rad * noise
    turn = wrap(facing - now).clamp(-_MOST_TURN_RAD, _MOST_TURN_RAD)
    yaw = now + torch.where(torch.arange(count, device=like.device) % 2 > 0, turn, torch.zeros_like(turn))

    pads = surface.points[surface.patch >= 0].to(like)
    cos, sin = yaw.cos()[:, None], yaw.sin()[:, None]
    pads = torch.stack((cos * pads[:, 0] - sin * pads[:, 1], sin * pads[:, 0] + cos * pads[:, 1]), -1)
    ahead = (pads @ inward[..., None])[..., 0]
    front = ahead.amax(-1, keepdim=True)
    rank = torch.where(ahead > front - _FRONT_M, uniform(*ahead.shape), -1.0).argmax(-1)
    touching = pads[torch.arange(count, device=like.device), rank]
    touching = touching + (front - ahead.gather(-1, rank[:, None])) * inward

    low, high = tool.bounds.to(like)
    place = at[:, :2] - touching
    height = at[:, 2:].clamp(low[2], high[2])
    end = torch.cat((place + settings.press_m * inward, height, yaw[:, None]), -1)
    before = torch.cat((place - settings.clear_m * inward, height, yaw[:, None]), -1)
    here = configuration.expand(count, 4)
    ahead_of_tool = torch.stack((now.cos(), now.sin(), torch.zeros_like(now), torch.zeros_like(now)))
    back = here - settings.back_m * ahead_of_tool
    few = model.surface_points[:: max(1, len(model.surface_points) // 64)].to(like)
    top = se3.apply(world_T_object.to(like), few.expand(len(world_T_object), -1, 3))[..., 2].max()
    over = torch.maximum(top + settings.above_m - surface.points[:, 2].min().to(like), here[0, 2])

    def lifted(q: Tensor) -> Tensor:
        return torch.cat((q[:, :2], over.expand(count, 1), q[:, 3:]), -1)

    kind = one_of(_KINDS, count)[:, None]
    first = torch.where(kind == 3, lifted(here), torch.where(kind == 4, lifted(back), here))
    first = torch.where(kind == 2, back, first)
    second = torch.where(kind >= 3, lifted(before), first)
    third = torch.where(kind == 1, second, before)
    controls, lengths = _controls(torch.stack((first, second, third, end), 1), tool, configuration, settings.actions)
    ends = here[:, None] + (controls * tool.scale.to(like)).cumsum(1)
    ends = torch.cat((torch.maximum(torch.minimum(ends[..., :3], high), low), ends[..., 3:]), -1)  # but for rounding
    free = tool.within_limits(ends).all(-1)
    kept = (free | ~free.any()).nonzero()[: settings.count, 0]
    return controls[kept], lengths[kept]


def _controls(
    places: Float[Tensor, "K W 4"], tool: Tool, configuration: Float[Tensor, "4"], most: int
) -> tuple[Float[Tensor, "K H 4"], Int[Tensor, "K"]]:
    """Controls that take the tool from place to place, each leg in as few equal ones as may be, and how many.

    Ways that are too long are cut off.
    """
    low, high = tool.bounds.to(places)
    held = torch.cat((torch.maximum(torch.minimum(places[..., :3], high), low), places[..., 3:]), -1)
    legs = torch.diff(held, dim=1, prepend=configuration.expand(len(places), 1, 4)) / tool.scale.to(places)
    parts = (legs.abs().amax(-1) - 1e-4).ceil().clamp_min(0.0).long()
    ends = parts.cumsum(-1)
    lengths = ends[:, -1].clamp(1, most)
    number = torch.arange(int(lengths.max()), device=places.device).expand(len(places), -1).contiguous()
    leg = torch.searchsorted(ends, number, right=True).clamp_max(legs.shape[1] - 1)
    rows = torch.arange(len(places), device=places.device)[:, None]
    controls = (legs[rows, leg] / parts[rows, leg].clamp_min(1)[..., None]).clamp(-1.0, 1.0)
    return torch.where((number < ends[:, -1:])[..., None], controls, torch.zeros_like(controls)), lengths
