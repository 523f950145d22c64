"""Batched descent of poses on the discrepancy: Gauss-Newton, and the paper's Adam."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sdf import backend, compiled, se3, so3
from sdf.bounds import Checked, Count, CountOr0, ShareBelow1
from sdf.numbers import refuse_trained
from sdf.posed import posed_distance, posed_query
from sdf.precision import full_precision
from sensors.discrepancy import Discrepancy, poses_at_once, residuals
from sensors.observation import Observation
from sensors.semantics import Semantics

Search = Literal["SE(2)", "SE(3)"]
SEARCHES: tuple[str, ...] = ("SE(2)", "SE(3)")


@dataclass(frozen=True)
class DescentSettings(Checked):
    """Settings of the descent of poses.

    Attributes:
        method: "gauss-newton" (damped, exact objective of Eqs 7-9) or "adam" (the paper's and CHSEL's).
        iterations: steps.
        rounds: how often Adam does its iterations, its moments new each time.
        learning_rate: of Adam, metres and radians a step.
        step_limit_m, step_limit_rad: greatest Gauss-Newton step.
        margin_m: free and occupied points further than this from being violated at the start are left out.
        lever_m: rotations that move the surface by less than this a radian are damped out.
        enough: part of its objective that a pose's next Gauss-Newton step must promise, or the pose is done. By
            default what float32 cannot tell from none.
    """

    method: Literal["gauss-newton", "adam"] = "gauss-newton"
    iterations: CountOr0 = 6
    rounds: Count = 1
    learning_rate: float = 0.01
    step_limit_m: float = 0.03
    step_limit_rad: float = 0.3
    margin_m: float = 0.008
    lever_m: float = 0.001
    enough: ShareBelow1 = 1e-6

    def __post_init__(self) -> None:
        """Refuse what has no meaning, and what would drop a gradient."""
        refuse_trained(self)
        super().__post_init__()


class Terms(NamedTuple):
    """Objective, gradient and Gauss-Newton Hessian on the search space's D degrees of freedom."""

    objective: Float[Tensor, "*b N"]
    gradient: Float[Tensor, "*b N D"]
    hessian: Float[Tensor, "*b N D D"]


class Pairs(NamedTuple):
    """The free and occupied points that may matter, one row a pair with a pose (flat over scenes and poses)."""

    pose: Int[Tensor, "K"]
    points: Float[Tensor, "K 3"]
    semantics: Int[Tensor, "K"]


@full_precision
def descend(
    discrepancy: Discrepancy,
    frame_T_object: Float[Tensor, "*b N 4 4"],
    observation: Observation,
    search: Search,
    settings: DescentSettings,
) -> Float[Tensor, "*b N 4 4"]:
    """Move every pose downhill on the half-square objective (RUMI, Eqs 7-9; Alg 4's optimisation).

    The objective never grows over a Gauss-Newton descent: a step that raises it is undone and damped.

    Args:
        discrepancy: C^, whose SDF, scale and tolerance are used.
        frame_T_object: starts, (*b, N, 4, 4).
        observation: points in the same frame.
        search: "SE(2)" keeps height and tilt, "SE(3)" moves all.
        settings: method, iterations and damping.
    """
    if search not in SEARCHES:
        raise ValueError(f"Expected search to be one of {', '.join(SEARCHES)}, got {search!r}")
    if settings.iterations == 0 or len(observation) == 0:
        return frame_T_object
    with torch.no_grad():
        tensors = (frame_T_object, observation.points, *discrepancy.parameters(), *discrepancy.buffers())
        version = backend.dispatch("descend", *tensors)
        return version(discrepancy, frame_T_object, observation, search, settings)


@backend.register("descend")
def _descend(
    discrepancy: Discrepancy,
    frame_T_object: Float[Tensor, "*b N 4 4"],
    observation: Observation,
    search: Search,
    settings: DescentSettings,
) -> Float[Tensor, "*b N 4 4"]:
    size = poses_at_once(frame_T_object, len(observation), temporaries=16)
    if size < frame_T_object.shape[-3]:
        parts = frame_T_object.split(size, dim=-3)
        return torch.cat([_descend(discrepancy, part, observation, search, settings) for part in parts], dim=-3)
    pairs = violable_pairs(discrepancy, frame_T_object, observation, settings.margin_m)
    is_surface = observation.of_class(Semantics.SURFACE)
    count = int(is_surface.sum(-1).max()) if is_surface.numel() else 0
    order = torch.argsort((~is_surface).to(torch.uint8), dim=-1, stable=True)[..., :count]
    points = torch.gather(observation.points, -2, order[..., None].expand(*order.shape, 3))
    valid = torch.gather(is_surface, -1, order)

    def terms(pose: Float[Tensor, "*b N 4 4"]) -> Terms:
        return _add(
            _surface_terms(discrepancy, pose, points, valid, search), _pair_terms(discrepancy, pose, pairs, search)
        )

    damping_floor = _damping_floor(valid, search, settings.lever_m, frame_T_object)
    if settings.method == "adam":
        return _adam(terms, frame_T_object, search, settings)
    return gauss_newton(terms, frame_T_object, search, settings, damping_floor)


@backend.register("descend", "numba", compiled.supports)
def _descend_numba(
    discrepancy: Discrepancy,
    frame_T_object: Tensor,
    observation: Observation,
    search: Search,
    settings: DescentSettings,
) -> Tensor:
    from sensors.discrepancy import takes

    sdf = discrepancy.sdf
    if not takes(sdf, frame_T_object, observation.points):
        return _descend(discrepancy, frame_T_object, observation, search, settings)
    if settings.method == "adam":
        from rumi.registration.adam_numba import descend as compiled
    else:
        from rumi.registration.descent_numba import descend as compiled
    return compiled(sdf, discrepancy, frame_T_object, observation, search, settings)


def violable_pairs(
    discrepancy: Discrepancy, frame_T_object: Float[Tensor, "*b N 4 4"], observation: Observation, margin_m: float
) -> Pairs:
    """Pairs of a pose and a free or occupied point that lies within `margin_m` of violating it."""
    near = discrepancy.within_reach(frame_T_object, observation)
    hinged = near.valid & (near.semantics != Semantics.SURFACE)
    flat = frame_T_object.reshape(-1, 4, 4)
    empty = Pairs(
        torch.zeros(0, dtype=torch.long, device=flat.device),
        flat.new_zeros(0, 3),
        torch.zeros(0, dtype=torch.long, device=flat.device),
    )
    if not bool(hinged.any()):
        return empty
    distance = posed_distance(discrepancy.sdf, frame_T_object, near.points)
    sign = torch.where(near.semantics == Semantics.FREE, 1.0, -1.0).to(distance)
    chosen = hinged[..., None, :] & (sign[..., None, :] * distance < margin_m)
    rows = chosen.reshape(-1, chosen.shape[-1]).nonzero()
    count = frame_T_object.shape[-3]
    scene = rows[:, 0] // count
    where = scene * len(near) + rows[:, 1]
    return Pairs(rows[:, 0], near.points.reshape(-1, 3)[where], near.semantics.reshape(-1)[where])


def retract(
    frame_T_object: Float[Tensor, "*b N 4 4"], step: Float[Tensor, "*b N D"], search: Search
) -> Float[Tensor, "*b N 4 4"]:
    """Shift the origin by v and turn about it by omega; in SE(2) the step is (v_x, v_y, omega_z)."""
    if search == "SE(2)":
        zero = torch.zeros_like(step[..., 0])
        shift = torch.stack((step[..., 0], step[..., 1], zero), -1)
        turn = torch.stack((zero, zero, step[..., 2]), -1)
    else:
        shift, turn = step[..., :3], step[..., 3:]
    return se3.make(so3.exp(turn) @ frame_T_object[..., :3, :3], frame_T_object[..., :3, 3] + shift)


def _rows(normal: Float[Tensor, "*b 3"], arm: Float[Tensor, "*b 3"], search: Search) -> Float[Tensor, "*b D"]:
    if search == "SE(2)":
        spin = arm[..., 0] * normal[..., 1] - arm[..., 1] * normal[..., 0]
        return -torch.cat((normal[..., :2], spin[..., None]), -1)
    return -torch.cat((normal, torch.linalg.cross(arm, normal, dim=-1)), -1)


def _surface_terms(
    discrepancy: Discrepancy,
    pose: Float[Tensor, "*b N 4 4"],
    points: Float[Tensor, "*b S 3"],
    valid: Bool[Tensor, "*b S"],
    search: Search,
) -> Terms:
    query = posed_query(discrepancy.sdf, pose, points)
    residual = query.distance * valid[..., None, :]
    normal = query.gradient @ pose[..., :3, :3].mT
    arm = points[..., None, :, :] - pose[..., None, :3, 3]
    rows = _rows(normal, arm, search) * valid[..., None, :, None]
    gradient = (rows.mT @ residual[..., None])[..., 0]
    return Terms(0.5 * (residual**2).sum(-1), gradient, rows.mT @ rows)


def _pair_terms(discrepancy: Discrepancy, pose: Float[Tensor, "*b N 4 4"], pairs: Pairs, search: Search) -> Terms:
    batch, size = pose.shape[:-2], 3 if search == "SE(2)" else 6
    flat = pose.reshape(-1, 4, 4)
    own = flat[pairs.pose]
    arm = pairs.points - own[:, :3, 3]
    query = discrepancy.sdf((own[:, :3, :3].mT @ arm[..., None])[..., 0])
    residual, weight = residuals(
        query.distance, pairs.semantics, discrepancy.free_scale.to(arm), -discrepancy.tolerance.to(arm)
    )
    hit = (residual != 0).nonzero()[:, 0]
    residual, weight, index = residual[hit], weight[hit], pairs.pose[hit]
    normal = (own[hit, :3, :3] @ query.gradient[hit][..., None])[..., 0]
    rows = _rows(normal, arm[hit], search)
    weighted = rows * weight[..., None]
    objective = flat.new_zeros(len(flat)).index_add(0, index, 0.5 * weight * residual**2)
    gradient = flat.new_zeros(len(flat), size).index_add(0, index, weighted * residual[..., None])
    hessian = flat.new_zeros(len(flat), size * size).index_add(
        0, index, (weighted[..., :, None] * rows[..., None, :]).flatten(1)
    )
    return Terms(objective.reshape(batch), gradient.reshape(*batch, size), hessian.reshape(*batch, size, size))


def _add(a: Terms, b: Terms) -> Terms:
    return Terms(a.objective + b.objective, a.gradient + b.gradient, a.hessian + b.hessian)


def _damping_floor(
    valid: Bool[Tensor, "*b S"], search: Search, lever_m: float, like: Float[Tensor, "*b N 4 4"]
) -> Float[Tensor, "*b 1 D"]:
    # of as many points as were seen: a shift seen by one point in a million, a turn seen by a lever of lever_m
    count = valid.sum(-1).clamp_min(1).to(like.dtype)[..., None, None]
    parts = [1e-6, 1e-6, lever_m**2] if search == "SE(2)" else [1e-6] * 3 + [lever_m**2] * 3
    return count * torch.tensor(parts, dtype=like.dtype, device=like.device)


def _limit(step: Float[Tensor, "*b D"], search: Search, settings: DescentSettings) -> Float[Tensor, "*b D"]:
    split = 2 if search == "SE(2)" else 3
    shift, turn = step[..., :split], step[..., split:]
    size = shift.norm(dim=-1, keepdim=True).clamp_min(1e-12) / settings.step_limit_m
    angle = turn.norm(dim=-1, keepdim=True).clamp_min(1e-12) / settings.step_limit_rad
    return torch.cat((shift / size.clamp_min(1.0), turn / angle.clamp_min(1.0)), -1)


def gauss_newton(
    terms: Callable[[Tensor], Terms], start: Tensor, search: Search, settings: DescentSettings, floor: Tensor
) -> Tensor:
    """Damped steps on any objective; a step that raises it is undone.

    Args:
        terms: objective, gradient and Hessian of poses, by the steps that `retract` takes.
        start: (*b, N, 4, 4).
        search: "SE(2)" or "SE(3)".
        settings: iterations, limits and when it is enough.
        floor: (*b, 1, D), what is added to the Hessian's diagonal at least.
    """
    pose, best = start, terms(start)
    damping = torch.full_like(best.objective, 1e-3)
    for iteration in range(settings.iterations):
        diagonal = best.hessian.diagonal(dim1=-2, dim2=-1)
        system = best.hessian + torch.diag_embed(damping[..., None] * diagonal + floor)
        step = _limit(torch.linalg.solve(system, -best.gradient[..., None])[..., 0], search, settings)
        bend = (best.hessian @ step[..., None])[..., 0]
        promising = -((best.gradient + 0.5 * bend) * step).sum(-1) > settings.enough * best.objective
        candidate = retract(pose, step, search)
        trial = terms(candidate)
        better = promising & (trial.objective < best.objective)
        pose = torch.where(better[..., None, None], candidate, pose)
        best = Terms(
            torch.where(better, trial.objective, best.objective),
            torch.where(better[..., None], trial.gradient, best.gradient),
            torch.where(better[..., None, None], trial.hessian, best.hessian),
        )
        damping = torch.where(better, damping * 0.2, damping * 20.0).clamp(1e-6, 1e6)
        if not bool(promising.any()) or (iteration > 0 and not bool(better.any())):
            break
    return pose


def _adam(terms: Callable[[Tensor], Terms], start: Tensor, search: Search, settings: DescentSettings) -> Tensor:
    pose = start
    for iteration in list(range(1, settings.iterations + 1)) * settings.rounds:
        if iteration == 1:
            first = second = torch.zeros(())
        gradient = terms(pose).gradient
        first = 0.9 * first + 0.1 * gradient
        second = 0.999 * second + 0.001 * gradient**2
        mean = first / (1 - 0.9**iteration)
        spread = (second / (1 - 0.999**iteration)).sqrt()
        pose = retract(pose, -settings.learning_rate * mean / (spread + 1e-8), search)
    return pose
