"""Residuals of poses against contact points, with the gradient and normal equations of a Gauss-Newton descent."""

import math
from dataclasses import dataclass
from typing import Annotated, Literal

import torch
from annotated_types import Interval
from jaxtyping import Float
from torch import Tensor

from rumi.registration.descent import Terms
from rumi.registration.touch_surface import TouchSurface
from sdf import backend, compiled, so3
from sdf.bounds import Checked, Count, CountOr0, Positive, Share, ShareAbove0, ShareBelow1
from sdf.mesh.touched import touched_face
from sdf.mesh.triangles import closest_point

# pairs of a pose and a point at once
_PAIRS = 1 << 17
# metres: nearer than this, the direction to the surface is the triangle's normal
_ON, _LEAST = 1e-9, 1e-12
_FAR = 500.0  # nats: farther out an outlier is one, and exponentials would not be finite


NOISE_M = (1e-9, 1e3)
"""Least and greatest noise of touches, metres: beyond these likelihoods are lost in rounding."""


_SIX_DEGREES = math.radians(6.0)


@dataclass(frozen=True)
class LocalizeSettings(Checked):
    """Settings of registration from contacts.

    Attributes:
        starts: poses that the descent starts from.
        spread: of the starts' places about the points' mean, as part of half the diagonal.
        from_prior: share of the starts that a prior seeds, if there is one.
        coarse_points: points that all starts descend on; a sample where there are more.
        coarse: steps of that descent, on squared distances.
        polished: poses that go on.
        fine_points: points that those descend on, at most.
        fine: steps of that descent, on distances.
        noise_m: how far touches are off, the scale of a Laplace distribution, within `NOISE_M`; by default what the
            best pose leaves, and `least_noise_m` at least.
        least_noise_m: lower bound of an estimated `noise_m`.
        normal_noise_rad: how far normals are off, a standard deviation (the paper's 6 degrees).
        outlier: share of touches that may be anywhere on or about the object, 0 for none: a touch beside it, or of
            another thing.
        mode_m, mode_rad: poses nearer to each other than both, up to the object's symmetries, are one mode.
        plausible: least likelihood of a mode that is kept, relative to the best.
        kept: modes that are kept at most, the heaviest.
        robust: steps of the first descent that follow, on a loss in which touches farther off than `robust_m` count
            ever less.
        robust_m: see there.
        nearby: poses drawn about each mode, in search of better ones, at most.
        draws: poses drawn about all modes to weigh them, at most; 0 to weigh each by its curvature alone.
    """

    starts: Count = 800
    spread: float = 0.25
    from_prior: Share = 1.0 / 3.0
    coarse_points: Count = 100
    coarse: int = 12
    polished: Count = 80
    fine_points: Count = 1000
    fine: int = 20
    noise_m: Annotated[float, Interval(ge=NOISE_M[0], le=NOISE_M[1])] | None = None
    least_noise_m: Annotated[float, Interval(gt=0.0, le=NOISE_M[1])] = 0.001
    normal_noise_rad: Positive = _SIX_DEGREES
    outlier: ShareBelow1 = 0.05
    mode_m: Positive = 0.01
    mode_rad: Positive = 0.2
    plausible: ShareAbove0 = 1e-6
    kept: Count = 30
    robust: CountOr0 = 4
    robust_m: Positive = 0.004
    nearby: CountOr0 = 30
    draws: CountOr0 = 4000

    def outlier_odds(self, noise_m: float | Tensor, diagonal_m: float, *, normals: bool) -> float | Tensor:
        """Odds of an outlier, even over signed distances of a diagonal and all normals, against a touch on the surface.

        Args:
            noise_m: scale of the Laplace distribution of distances.
            diagonal_m: of the object's box.
            normals: whether touches have them.
        """
        beside = 0.5 * self.normal_noise_rad**2 if normals else 1.0
        return self.outlier / (1.0 - self.outlier) * beside * (2.0 / diagonal_m) * noise_m


@dataclass(frozen=True)
class TouchFit:
    """Loss of the fit of poses to touches.

    Attributes:
        loss: "square" for half the squared distance, "absolute" for the distance.
        exact: take the triangle that fits best rather than the one that the surface's table has.
        reach_m: sigma_p / sigma_n, by which normals count where there are some.
        noise_m: sigma_p, by which distances weigh against normals in the absolute loss.
        smooth_m: the absolute loss is sqrt(d^2 + smooth^2); 0 for the distance itself, which has a kink.
        outlier: gamma, odds of an outlier against a touch that lies on the surface; 0 for none. A touch then counts by
            its chance of being none, 1 / (1 + gamma e^l) with l nats of the absolute loss, and costs -log(e^-l + gamma)
            there, which is bounded (a mixture likelihood).
    """

    loss: Literal["square", "absolute"] = "square"
    exact: bool = False
    reach_m: float = 0.0
    noise_m: float = 0.005
    smooth_m: float = 3e-5
    outlier: float = 0.0

    @property
    def normal_nats(self) -> float:
        """Of a squared chord between normals."""
        return 0.5 * (self.reach_m / self.noise_m) ** 2

    @property
    def normal_weight(self) -> float:
        """Of a squared chord between normals, in the loss's unit."""
        return 0.5 * self.reach_m**2 / (1.0 if self.loss == "square" else self.noise_m)


def touch_terms(
    surface: TouchSurface,
    world_T_middle: Float[Tensor, "N 4 4"],
    points_w: Float[Tensor, "K 3"],
    normals_w: Float[Tensor, "K 3"] | None,
    fit: TouchFit,
) -> Terms:
    """The loss of each pose, with its gradient and Gauss-Newton Hessian by (shift, turn about the middle).

    A touch's loss is that of its distance to a triangle, inside or out, plus `normal_weight` times the squared chord
    between its normal and the triangle's.

    Args:
        surface: what was touched.
        world_T_middle: poses of its frame.
        points_w: metres.
        normals_w: outward, unit, if they are known.
        fit: which loss.
    """
    facing = points_w.new_zeros(points_w.shape) if normals_w is None else normals_w
    if normals_w is None and fit.reach_m:
        raise ValueError(f"Expected normals for a reach of {fit.reach_m} m, got none")
    version = backend.dispatch("touch_terms", world_T_middle, points_w, facing)
    with torch.no_grad():
        return version(surface, world_T_middle, points_w, facing, fit)


@backend.register("touch_terms")
def _terms_plain(surface: TouchSurface, pose: Tensor, points: Tensor, normals: Tensor, fit: TouchFit) -> Terms:
    size = max(1, _PAIRS // max(1, len(points)))
    parts = [_terms_of(surface, part, points, normals, fit) for part in pose.split(size)]
    if not parts:
        return Terms(pose.new_zeros(0), pose.new_zeros(0, 6), pose.new_zeros(0, 6, 6))
    return Terms(*(torch.cat(column) for column in zip(*parts, strict=True)))


def _terms_of(surface: TouchSurface, pose: Tensor, points: Tensor, normals: Tensor, fit: TouchFit) -> Terms:
    rotation, place = pose[:, None, :3, :3], pose[:, None, :3, 3]
    arm = points - place
    own = (rotation.mT @ arm[..., None])[..., 0]
    owner = torch.from_numpy(surface.triangles.tree.owner).to(pose.device)
    if fit.exact:
        found = touched_face(own, (rotation.mT @ normals[:, :, None])[..., 0], surface.triangles, fit.reach_m)
        face, point = found.face, found.point
    else:
        face = owner[surface.pieces(own)]
        point = closest_point(own, surface.triangles.corners.to(own)[face])
    facing = (rotation @ surface.triangles.normals.to(own)[face][..., None])[..., 0]
    offset = (rotation @ (own - point)[..., None])[..., 0]
    distance = offset.norm(dim=-1)
    away = torch.where(distance[..., None] > _ON, offset / distance.clamp_min(_ON)[..., None], facing)
    rows = -torch.cat((away, torch.linalg.cross(arm, away)), -1)
    if fit.loss == "square":
        weight, loss = torch.ones_like(distance), 0.5 * distance.square()
    else:
        loss = (distance.square() + fit.smooth_m**2).sqrt()
        weight = 1.0 / loss.clamp_min(_LEAST)
    amount, chord = (fit.normal_weight if fit.reach_m else 0.0), (normals - facing).square().sum(-1)
    loss, share = loss + amount * chord, torch.ones_like(distance)
    if fit.outlier:
        nats = (distance.square() + fit.smooth_m**2).sqrt() / fit.noise_m + fit.normal_nats * chord
        share = 1.0 / (1.0 + fit.outlier * nats.clamp_max(_FAR).exp())
        bounded = -fit.noise_m * ((-nats).exp() + fit.outlier).log()
        loss = bounded if fit.loss == "absolute" else share * loss
    gradient = ((share * weight * distance)[..., None] * rows).sum(-2)
    hessian = ((share * weight)[..., None] * rows).mT @ rows
    if fit.reach_m:
        turned = torch.linalg.cross(facing, normals.expand_as(facing))
        gradient[:, 3:] -= 2.0 * amount * (share[..., None] * turned).sum(-2)
        cross = so3.hat(facing)
        hessian[:, 3:, 3:] += 2.0 * amount * (share[..., None, None] * (cross.mT @ cross)).sum(-3)
    return Terms(loss.sum(-1), gradient, hessian)


@backend.register("touch_terms", "numba", compiled.supports)
def _terms_numba(surface: TouchSurface, pose: Tensor, points: Tensor, normals: Tensor, fit: TouchFit) -> Terms:
    from rumi.registration.contact_terms_numba import terms_kernel

    places = [x.detach().double().contiguous().numpy() for x in (pose, points, normals)]
    triangles = surface.triangles
    result = [torch.zeros(len(pose), *shape, dtype=torch.float64) for shape in ((), (6,), (6, 6))]
    terms_kernel(
        *places,
        *triangles.tree.for_distance,
        triangles.corners.double().reshape(-1, 9).contiguous().numpy(),
        triangles.normals.double().contiguous().numpy(),
        surface.cells.contiguous().numpy(),
        surface.low.double().numpy(),
        float(surface.step),
        fit.exact,
        float(fit.reach_m),
        fit.loss == "absolute",
        float(fit.smooth_m),
        float(fit.normal_weight) if fit.reach_m else 0.0,
        float(fit.normal_nats),
        float(fit.noise_m),
        float(fit.outlier),
        *(x.numpy() for x in result),
    )
    return Terms(*(x.to(pose) for x in result))
