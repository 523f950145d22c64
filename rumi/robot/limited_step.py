"""Step of a tool that its bounds and its arm's reach limit: up to the limit, and from there round it."""

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.robot.reach import Reach
from sdf.check import is_eager

LEGS = 8
"""Of a step that meets the arm's limit: each goes straight as far as the arm gets, and from there round the limit."""
PARTS = 16
"""Of a leg, each of which is tried on the straight way to the limit."""
SLACK_M = 1e-6
"""By how much rounding may make a residual grow that is the same all along a circle about the base, metres."""


def limited_step(
    bounds: Float[Tensor, "2 D"],
    reach: Reach | None,
    q: Float[Tensor, "*b Q"],
    wanted: Float[Tensor, "*b Q"],
    residual: Float[Tensor, "*b"] | None,
) -> tuple[Float[Tensor, "*b Q"], Float[Tensor, "*b"] | None]:
    """Where a step from q to `wanted` ends, and the arm's residual there.

    Args:
        bounds: lower and upper corner of where the tool frame may be.
        reach: what the arm can reach; None for a tool that flies freely.
        q: configuration now.
        wanted: configuration that the step is to end at.
        residual: the arm's at q; None without an arm.
    """
    reached = _boxed(bounds, wanted)
    if reach is None or residual is None:
        return reached, None
    left = reach.residual(reached)
    refused = left > _limit(reach, residual)
    if not is_eager():
        shape = (-1, q.shape[-1])
        ends, rest = _legs(bounds, reach, q.reshape(shape), wanted.reshape(shape), residual.reshape(-1))
        reached = torch.where(refused[..., None], ends[-1].reshape(reached.shape), reached)
        return reached, torch.where(refused, rest.reshape(left.shape), left)
    if bool(refused.any()):
        ends, rest = _legs(bounds, reach, q[refused], wanted[refused], residual[refused])
        reached[refused], left[refused] = ends[-1], rest
    return reached, left


def limited_way(
    bounds: Float[Tensor, "2 D"],
    reach: Reach | None,
    q: Float[Tensor, "*b Q"],
    wanted: Float[Tensor, "*b Q"],
    residual: Float[Tensor, "*b"] | None,
) -> Float[Tensor, "*b L Q"]:
    """Where each leg of a step from q to `wanted` ends, even parts where no limit is met; see `limited_step`."""
    reached = _boxed(bounds, wanted)
    share = torch.arange(1, LEGS + 1, dtype=q.dtype, device=q.device)[:, None] / LEGS
    way = q[..., None, :].lerp(reached[..., None, :], share.expand(*q.shape[:-1], LEGS, q.shape[-1]))
    if reach is None or residual is None:
        return way
    refused = reach.residual(reached) > _limit(reach, residual)
    if not is_eager():
        shape = (-1, q.shape[-1])
        legs, _ = _legs(bounds, reach, q.reshape(shape), wanted.reshape(shape), residual.reshape(-1))
        return torch.where(refused[..., None, None], legs.movedim(0, -2).reshape(way.shape), way)
    legs, _ = _legs(bounds, reach, q[refused], wanted[refused], residual[refused])
    way[refused] = legs.movedim(0, -2)
    return way


def _limit(reach: Reach, residual: Tensor) -> Tensor:
    """The residual that a step may end with: where the arm is out of reach already, the one it has."""
    return residual.clamp_min(reach.settings.tolerance_m) + SLACK_M


def _boxed(bounds: Tensor, q: Tensor) -> Tensor:
    return torch.cat((torch.maximum(torch.minimum(q[..., :-1], bounds[1]), bounds[0]), q[..., -1:]), -1)


def _legs(
    bounds: Tensor, reach: Reach, q: Float[Tensor, "n Q"], wanted: Float[Tensor, "n Q"], residual: Float[Tensor, "n"]
) -> tuple[Float[Tensor, "L n Q"], Float[Tensor, "n"]]:
    """Ends of the legs of steps that the arm cannot finish, and the last one's residual."""
    part = (wanted - q) / LEGS
    legs = []
    for _ in range(LEGS):
        limit, aim = _limit(reach, residual), _boxed(bounds, q + part)
        whole = reach.residual(aim)
        ends, left = _up_to_limit(bounds, reach, q, aim, limit)
        allowed = whole <= limit
        q, residual = torch.where(allowed[:, None], aim, ends), torch.where(allowed, whole, left)
        legs.append(q)
    return torch.stack(legs), residual


def _up_to_limit(
    bounds: Tensor, reach: Reach, q: Float[Tensor, "n Q"], wanted: Float[Tensor, "n Q"], limit: Float[Tensor, "n"]
) -> tuple[Float[Tensor, "n Q"], Float[Tensor, "n"]]:
    """Where a leg that the arm cannot finish ends, and the residual there."""
    # as far as the arm gets on the straight way, a sixteenth of the leg at a time
    parts = torch.arange(1, PARTS, dtype=q.dtype, device=q.device)[:, None, None] / PARTS
    residuals = reach.residual(q + parts * (wanted - q))
    passed = (residuals <= limit).to(q.dtype).cumprod(0).sum(0)
    halfway = q + (passed / PARTS)[:, None] * (wanted - q)
    # and from there round the limit
    ways = torch.stack((*_ways_round(bounds, reach.base[:2], halfway, wanted), halfway))
    residuals = reach.residual(ways)
    reached, left = ways[3], residuals[3]
    for way, rest in ((ways[2], residuals[2]), (ways[1], residuals[1]), (ways[0], residuals[0])):
        accepted = rest <= limit
        reached, left = torch.where(accepted[:, None], way, reached), torch.where(accepted, rest, left)
    return reached, left


def _ways_round(
    bounds: Tensor, base: Float[Tensor, "2"], q: Float[Tensor, "n Q"], wanted: Float[Tensor, "n Q"]
) -> tuple[Tensor, ...]:
    """Ends of a leg round the limit: without its turn, along the circle about the base, and turning with that."""
    offset, target = q[..., :2] - base, wanted[..., :2] - base
    radius = offset.norm(dim=-1, keepdim=True)
    on_circle = base + target * (radius / target.norm(dim=-1, keepdim=True).clamp_min(1e-9))
    on_circle = torch.maximum(torch.minimum(on_circle, bounds[1, :2]), bounds[0, :2])
    aside = offset[..., 0] * target[..., 1] - offset[..., 1] * target[..., 0]
    ahead = offset[..., 0] * target[..., 0] + offset[..., 1] * target[..., 1]
    # beside each other: of two that lie by themselves, the library works out several angles at once, otherwise
    swing = torch.atan2(*torch.stack((aside, ahead), -1).unbind(-1))
    straight = torch.cat((wanted[..., :-1], q[..., -1:]), -1)
    turning = torch.cat((on_circle, wanted[..., 2:]), -1)
    carried = torch.cat((on_circle, wanted[..., 2:-1], q[..., -1:] + swing[..., None]), -1)
    return straight, turning, carried
