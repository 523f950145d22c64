"""RUMI's discrepancy between posed objects and semantic points."""

import math
from typing import TypeGuard

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sdf import backend, compiled
from sdf.base import SDF
from sdf.check import check_shape, is_eager
from sdf.grid_sdf import GridSDF
from sdf.grid_sdf import takes as grid_takes
from sdf.numbers import Numbers, Range
from sdf.posed import posed_distance
from sdf.precision import full_precision
from sensors.observation import Observation, compact
from sensors.semantics import Semantics

# of temporary tables over poses and points, where there is no graph to be kept
CHUNK_BYTES = 64 * 2**20


def discrepancy_terms(
    distance: Float[Tensor, "*b"],
    semantics: Int[Tensor, "*b"],
    free_scale: float | Tensor = 10.0,
    alpha: float | Tensor = 0.0,
) -> Float[Tensor, "*b"]:
    """Cost of each point, metres times scale (RUMI, Eqs 4-6).

    Free points cost `C max(0, alpha - v)`, occupied ones `C max(0, alpha + v)`, surface ones `|v|`.

    Args:
        distance: signed distance v of each point to the posed object, metres.
        semantics: `Semantics` values.
        free_scale: C, of the free and occupied terms.
        alpha: metres. The paper calls alpha > 0 a tolerance, but it then penalises free points outside the
            surface; a tolerance is alpha <= 0.
    """
    sign = 1.0 - 2.0 * (semantics == int(Semantics.FREE)).to(distance.dtype)
    hinge = free_scale * (alpha + sign * distance).clamp_min(0.0)
    return torch.where(semantics == int(Semantics.SURFACE), distance.abs(), hinge)


def residuals(
    distance: Float[Tensor, "*#b"],
    semantics: Int[Tensor, "*#b"],
    free_scale: float | Tensor = 10.0,
    alpha: float | Tensor = 0.0,
) -> tuple[Float[Tensor, "*#b"], Float[Tensor, "*#b"]]:
    """Residual and weight whose half weighted square has the gradients of RUMI's Eqs 7-9.

    Eqs 7-9 are not the derivatives of Eqs 4-6 but of `C/2 max(0, .)^2` and `v^2 / 2`: a belief is weighed by
    Eqs 4-6 and optimised by this objective, as the paper does.

    Returns:
        r, signed so that dr/dv = 1 where r is not 0, and w, of the shape of `semantics`: the objective is
        sum(w r^2 / 2).
    """
    surface, free = semantics == Semantics.SURFACE, semantics == Semantics.FREE
    zero, far = distance.new_zeros(()), distance.new_full((), math.inf)
    # free points count below their bound, occupied ones above, surface ones anywhere: one pass over all pairs
    low = torch.where(surface | free, -far, zero)
    high = torch.where(free, zero, far)
    shift = torch.where(surface, zero, torch.where(free, zero - alpha, zero + alpha))
    weight = torch.where(surface, zero + 1.0, zero + free_scale)
    return (distance + shift).clamp(low, high), weight


class Discrepancy(Numbers):
    """C^(X, T) of RUMI's Eq 3: a sum in metres over free, occupied and surface points, for many poses.

    A sum, not a mean, since only a sum is additive (Eq 11). Free points that no pose can reach (further from
    every pose's origin than the object's radius) cost nothing and are not looked up.

    Args:
        sdf: the object's signed distance function.
        radius: greatest distance of the object's surface from its origin, metres.
        free_scale: C.
        tolerance: metres by which a free or occupied point may be violated (alpha = -tolerance); below half
            the thinnest wall, or free points refute nothing.
        trainable: train free_scale and tolerance, within their range (`sdf.numbers.Numbers`).
    """

    free_scale: Tensor
    tolerance: Tensor

    def __init__(
        self, sdf: SDF, radius: float, *, free_scale: float = 10.0, tolerance: float = 0.0, trainable: bool = False
    ) -> None:
        super().__init__()
        if tolerance < 0:
            raise ValueError(f"Expected a tolerance of 0 m or more, got {tolerance}")
        self.sdf = sdf
        self.radius = radius
        for name, value in (("free_scale", free_scale), ("tolerance", tolerance)):
            self.enter(name, value, Range.POSITIVE if trainable else None)

    @full_precision
    def forward(self, frame_T_object: Float[Tensor, "*b N 4 4"], observation: Observation) -> Float[Tensor, "*b N"]:
        """Discrepancy of each pose; points and poses are in the same frame. No points give 0.

        Raises:
            ValueError: a shape does not fit, or points are of another float type than the poses.
        """
        check_shape("frame_T_object", frame_T_object, "(*b, N, 4, 4)")
        check_shape("points", observation.points, "(*b, M, 3)")
        tensors = (frame_T_object, observation.points, *self.parameters(), *self.buffers())
        return backend.dispatch("discrepancy", *tensors)(self, frame_T_object, observation)

    def within_reach(self, frame_T_object: Float[Tensor, "*b N 4 4"], observation: Observation) -> Observation:
        """The observation less the free points outside the ball that holds the object at every pose (exact)."""
        if len(observation) == 0 or frame_T_object.shape[-3] == 0:
            return observation
        origin = frame_T_object[..., :3, 3]
        centre = 0.5 * (origin.amin(-2) + origin.amax(-2))
        reach = self.radius + (origin - centre[..., None, :]).norm(dim=-1).amax(-1)
        far = (observation.points - centre[..., None, :]).norm(dim=-1) > reach[..., None]
        useless = far & (observation.semantics == Semantics.FREE)
        return compact(
            Observation(observation.points, observation.semantics, observation.attached, observation.valid & ~useless)
        )


@backend.register("discrepancy")
def _discrepancy(
    module: Discrepancy, frame_T_object: Float[Tensor, "*b N 4 4"], observation: Observation
) -> Float[Tensor, "*b N"]:
    near = module.within_reach(frame_T_object, observation) if is_eager() else observation
    free_scale, alpha = module.free_scale.to(near.points), -module.tolerance.to(near.points)
    parts = []
    every = (frame_T_object,) if not is_eager() else frame_T_object.split(poses_at_once(frame_T_object, len(near)), -3)
    for poses in every:
        distance = posed_distance(module.sdf, poses, near.points)
        cost = discrepancy_terms(distance, near.semantics[..., None, :].expand(distance.shape), free_scale, alpha)
        parts.append(torch.where(near.valid[..., None, :], cost, torch.zeros_like(cost)).sum(-1))
    return torch.cat(parts, dim=-1)


def poses_at_once(frame_T_object: Float[Tensor, "*b N 4 4"], points: int, temporaries: int = 6) -> int:
    """How many poses to take at a time over some points, so that as many temporary tables stay within a budget."""
    scenes = math.prod(frame_T_object.shape[:-3])
    return max(1, CHUNK_BYTES // (frame_T_object.element_size() * temporaries * max(1, scenes * points)))


def takes(sdf: SDF, frame_T_object: Tensor, points: Tensor) -> TypeGuard[GridSDF]:
    """Whether compiled versions apply: a tabulated SDF, and some poses and points of the same scenes and float type."""
    alike = frame_T_object.shape[:-3] == points.shape[:-2]
    return alike and points.numel() > 0 and frame_T_object.numel() > 0 and grid_takes(sdf, frame_T_object, points)


@backend.register("discrepancy", "numba", compiled.supports)
def _discrepancy_numba(module: Discrepancy, frame_T_object: Tensor, observation: Observation) -> Tensor:
    points, semantics, valid = observation.points, observation.semantics, observation.valid
    if not takes(module.sdf, frame_T_object, points):
        return _discrepancy(module, frame_T_object, observation)
    from sensors import discrepancy_numba

    ready = discrepancy_numba.prepare(module.sdf, frame_T_object, points, semantics, valid)
    return discrepancy_numba.discrepancy(ready, frame_T_object, float(module.free_scale), -float(module.tolerance))
