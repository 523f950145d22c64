"""Registration from contact points: global starts, descent, and all modes that explain the points."""

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from rumi import seeding
from rumi.registration.archive import super_fibonacci
from rumi.registration.contact_modes import Localization
from rumi.registration.contact_posterior import (
    distinct,
    gather_modes,
    laplace_covariance,
    log_likelihood,
    mixture,
    noise_scale,
    plausible_modes,
    touches_off,
)
from rumi.registration.contact_terms import LocalizeSettings as LocalizeSettings
from rumi.registration.contact_terms import TouchFit, touch_terms
from rumi.registration.descent import DescentSettings, Terms, gauss_newton
from rumi.registration.mode_draws import nearby
from rumi.registration.touch_surface import TouchSurface
from sdf import se3
from sdf.check import check_near
from sdf.mesh.mesh import TriangleMesh
from sdf.mesh.mesh_sdf import MeshSDF
from sdf.symmetry import Symmetries

# of the object's diagonal: points further apart than the first were not all on it; nearer together than the second say
# nothing; and of the points' length, what they need across for a plane
_APART, _TOGETHER, _ACROSS = 2.0, 1e-3, 1e-3
_MOST_NEAR = 2.0 / 3.0  # share of the points that has to be near the others, for those far off to be left out
_UNIT = 0.02
_SCALES = {"millimetres": 0.001, "centimetres": 0.01, "inches": 0.0254}
# looks about the plausible modes; how far, as part of what makes one mode; how many draws of each go on; and pairs of
# poses and touches in a look at most
_LOOKS, _ABOUT, _BEST, _PAIRS = 2, 0.3, 10, 20_000
_SMOOTH_M = 3e-5  # of the kink in the distance
_TURNS = 997  # that the starts' orientations may be turned by, all of them alike


class PositionPrior(NamedTuple):
    """Prior of the position of the mesh's frame: uniform in a box.

    Attributes:
        center: (3,), metres.
        radius: (3,), half of its edges, metres.
    """

    center: Float[Tensor, "3"]
    radius: Float[Tensor, "3"]


def localize(
    shape: TouchSurface | MeshSDF | TriangleMesh | str | Path,
    points_w: Float[Tensor, "K 3"],
    *,
    normals: Float[Tensor, "K 3"] | None = None,
    prior: PositionPrior | None = None,
    clip: bool = False,
    symmetries: Symmetries | None = None,
    settings: LocalizeSettings | None = None,
    generator: torch.Generator | None = None,
) -> Localization:
    """All poses of an object that explain where it was touched, over all of SE(3).

    A few touches may be bad: the likelihood is a mixture of a Laplace distribution of distances and a share of outliers
    (`LocalizeSettings.outlier`), and those too far from the others to be on the object are left out (`left_out`).

    Starts turned evenly all over, the middle of the object's box about the points' mean, descend on squared distances
    to the surface, then on a loss in which touches that are far off count less; the best of them, and the best of what
    is unlike those, on distances; and so do the likeliest of draws about the plausible ones. Poses alike up to the
    object's symmetries then make a mode, which weighs as much as the posterior about it (`mode_draws.masses`).

    Args:
        shape: a file, a mesh in metres, or a `TouchSurface` made of it, which saves what depends on the mesh alone.
        points_w: (K, 3), metres, of a spherical tip its centres brought to the surface; 3 or more.
        normals: (K, 3), outward, unit, if they are known.
        prior: where some of the starts are.
        clip: leave out poses whose origin is outside of the prior.
        symmetries: of the object, in the mesh's frame, where they are known better than found.
        settings: counts and tolerances.
        generator: draws the starts; by default one of seed 0.

    Raises:
        ValueError: points, normals or a prior that cannot be, with what to do; or no pose within a prior that clips.
        sdf.mesh.mesh.MeshError: as `TouchSurface.of`.
    """
    settings = settings or LocalizeSettings()
    generator = seeding.generator(0) if generator is None else generator
    surface = TouchSurface.of(shape, symmetries)
    if symmetries is not None:
        surface = replace(surface, symmetries=symmetries.to(torch.float64))
    every, facing, near = check_contacts(surface, points_w, normals)
    points, facing = every[near], _of(facing, near)
    if clip and prior is None:
        raise ValueError("Expected a prior to clip by, got none: give its centre and radius")
    box = None if prior is None else _checked(prior)
    sample, rest = (
        _thinned(points, settings.coarse_points, generator),
        _thinned(points, settings.fine_points, generator),
    )

    # of normals, the noise in proportion to that of points is what counts; at first the paper's
    noise = settings.noise_m or 0.005
    reach = 0.0 if facing is None else noise / settings.normal_noise_rad
    poses = starting_poses(surface, points, box, settings, generator=generator)
    square = TouchFit("square", False, reach, noise)
    poses = descended(surface, poses, points[sample], _of(facing, sample), square, settings.coarse)
    first = square
    if settings.outlier and settings.robust:
        # a touch that is far off pulls squares out of the right basin
        about = max(settings.robust_m, settings.noise_m or 0.0)
        first = mixture(surface, about, settings, normals=facing is not None)
        first = replace(first, exact=False, smooth_m=about)
        poses = descended(surface, poses, points[sample], _of(facing, sample), first, settings.robust)
    rough = touch_terms(surface, poses, points[sample], _of(facing, sample), first).objective
    absolute = TouchFit("absolute", True, reach, noise)
    poses = poses[_to_polish(surface, poses, rough, settings)]
    poses = descended(surface, poses, points[rest], _of(facing, rest), absolute, settings.fine)
    scale = noise_scale(surface, poses, points[rest], _of(facing, rest), settings)
    if settings.outlier:
        fit = mixture(surface, scale, settings, normals=facing is not None)
        poses = _settled(surface, poses, points[rest], _of(facing, rest), fit, settings, generator)
    if clip and box is not None:
        origin = surface.uncentred(poses)[:, :3, 3]
        inside = ((origin - box.center).abs() <= box.radius).all(-1)
        if not bool(inside.any()):
            raise ValueError(
                "Expected poses with the mesh's origin within the prior, every one found lies outside of it: leave "
                "out clip (the prior then only seeds starts), or widen the prior"
            )
        poses = poses[inside]
    found = gather_modes(surface, poses, points, facing, settings, scale, generator=generator)
    if bool(near.all()):
        return found
    off, _ = touches_off(surface, surface.centred(found.world_T_object), every, None, 0.0)
    return replace(found, points=len(every), off_m=off, left_out=~near)


def gain_of_turned_normals(
    surface: TouchSurface,
    points_w: Float[Tensor, "K 3"],
    normals: Float[Tensor, "K 3"],
    found: Localization,
    *,
    settings: LocalizeSettings | None = None,
    generator: torch.Generator | None = None,
) -> float:
    """By how many nats the best pose is likelier with all normals turned round, than the best with them as they are.

    Sensors and meshes differ in which way a normal points; normals into the object lead to a pose that is wrong. Looks
    from a quarter of the starts.

    Args:
        surface: of the object.
        points_w: (K, 3), metres.
        normals: (K, 3), as they were given.
        found: with them, whose noise is taken for both.
        settings: that it was found with.
        generator: draws the starts; by default one of seed 0.
    """
    settings = settings or LocalizeSettings()
    fewer = replace(settings, starts=max(1, settings.starts // 4), noise_m=found.noise_m)
    turned = localize(surface, points_w, normals=-normals, settings=fewer, generator=generator)
    return float(turned.log_likelihood.max() - found.log_likelihood.max())


def starting_poses(
    surface: TouchSurface,
    points_w: Float[Tensor, "K 3"],
    prior: PositionPrior | None,
    settings: LocalizeSettings,
    *,
    generator: torch.Generator,
) -> Float[Tensor, "N 4 4"]:
    """Poses of the surface's middle: orientations spread evenly, places about the points' mean or from the prior."""
    count = settings.starts
    # a spread of its own for every seed: all of it turned alike, by a rotation drawn evenly
    turn = int(torch.randint(_TURNS, (), generator=generator))
    rotation = super_fibonacci(_TURNS, points_w)[turn] @ super_fibonacci(count, points_w)
    deviation = settings.spread * 0.5 * surface.diagonal
    place = points_w.mean(0) + deviation * seeding.normal((count, 3), generator=generator, dtype=torch.float64)
    poses = se3.make(rotation, place)
    if prior is not None:
        # spread over the orientations, as their order follows a spiral
        some = torch.randperm(count, generator=generator)[: round(settings.from_prior * count)]
        draw = 2.0 * seeding.uniform((len(some), 3), generator=generator, dtype=torch.float64) - 1.0
        poses[some] = surface.centred(se3.make(rotation[some], prior.center + draw * prior.radius))
    return poses


def descended(
    surface: TouchSurface,
    poses: Float[Tensor, "N 4 4"],
    points: Float[Tensor, "K 3"],
    normals: Float[Tensor, "K 3"] | None,
    fit: TouchFit,
    iterations: int,
) -> Float[Tensor, "N 4 4"]:
    """Poses of the middle after damped Gauss-Newton steps on a loss of touches."""

    def terms(at: Tensor) -> Terms:
        return touch_terms(surface, at, points, normals, fit)

    limits = DescentSettings(iterations=iterations, step_limit_m=0.25 * surface.diagonal, step_limit_rad=0.6)
    # what is added to the Hessian: of as many points, and for turns by an arm of a thousandth of the object
    weight = len(points) * (1.0 if fit.loss == "square" else 1.0 / surface.diagonal)
    floor = torch.tensor([1e-6] * 3 + [(1e-3 * surface.diagonal) ** 2] * 3, dtype=poses.dtype) * weight
    return gauss_newton(terms, poses, "SE(3)", limits, floor[None])


def _settled(
    surface: TouchSurface,
    poses: Tensor,
    points: Tensor,
    normals: Tensor | None,
    fit: TouchFit,
    settings: LocalizeSettings,
    generator: torch.Generator,
) -> Tensor:
    """The poses and the minima of the mixture's loss that they and draws about the plausible ones lead to."""
    smooth = replace(fit, smooth_m=_SMOOTH_M)
    _, unlike = plausible_modes(surface, poses, points, normals, fit, settings)
    poses = torch.cat((poses, descended(surface, poses[unlike], points, normals, smooth, settings.fine)))
    for _ in range(_LOOKS):
        _, unlike = plausible_modes(surface, poses, points, normals, fit, settings)
        modes = poses[unlike[: settings.kept]]
        draws = min(settings.nearby, _PAIRS // max(1, len(modes) * len(points)))
        if draws < 1:
            break
        covariance, _ = laplace_covariance(surface, modes, points, normals, fit)
        wide = [(_ABOUT * settings.mode_m) ** 2] * 3 + [(_ABOUT * settings.mode_rad) ** 2] * 3
        near = nearby(
            modes,
            covariance + torch.diag(modes.new_tensor(wide)),
            lambda at: log_likelihood(surface, at, points, normals, fit),
            draws=draws,
            kept=_BEST,
            generator=generator,
        )
        poses = torch.cat((poses, descended(surface, near, points, normals, smooth, settings.fine // 2)))
    return poses


def _to_polish(surface: TouchSurface, poses: Tensor, rough: Tensor, settings: LocalizeSettings) -> Tensor:
    """The best half as they come, the other the best that are unlike those before them."""
    order = rough.argsort(stable=True)
    best = order[: max(1, settings.polished // 2)]
    unlike = distinct(surface, poses[order], settings.mode_m, settings.mode_rad, settings.polished - len(best))
    return torch.cat((best, order[unlike])).unique()


def _thinned(points: Tensor, most: int, generator: torch.Generator) -> Tensor:
    return torch.randperm(len(points), generator=generator)[:most].sort().values


def _of(normals: Tensor | None, index: Tensor) -> Tensor | None:
    return None if normals is None else normals[index]


def _checked(prior: PositionPrior) -> PositionPrior:
    center, radius = (torch.as_tensor(x, dtype=torch.float64).cpu() for x in prior)
    if center.shape != (3,) or radius.shape != (3,) or not bool(torch.isfinite(torch.cat((center, radius))).all()):
        raise ValueError(f"Expected a prior of three finite numbers each, got center {center} and radius {radius}")
    if not bool((radius > 0).all()):
        raise ValueError(
            f"Expected a prior with a radius above 0 along each axis, got {radius.tolist()}: give half of the edges of "
            "the box that the mesh's origin is in, or no prior"
        )
    return PositionPrior(center, radius)


def check_contacts(
    surface: TouchSurface, points: Tensor, normals: Tensor | None
) -> tuple[Tensor, Tensor | None, Tensor]:
    """Points and normals in float64 on the CPU, and which points are near enough to the others to be on the object.

    Raises:
        ValueError: what is wrong with them, and what to do.
    """
    points = _finite_rows("points", points)
    if len(points) < 3:
        raise ValueError(f"Expected 3 contact points or more, got {len(points)}: fewer leave the pose wide open")
    if normals is not None:
        normals = _finite_rows("normals", normals)
        if len(normals) != len(points):
            raise ValueError(f"Expected a normal for each of the {len(points)} points, got {len(normals)}")
        off = (normals.norm(dim=-1) - 1.0).abs()
        if bool((off > _UNIT).any()):
            worst = int(off.argmax())
            raise ValueError(
                f"Expected unit normals, got {int((off > _UNIT).sum())} of {len(normals)} that are not, such as number "
                f"{worst + 1} of length {float(normals[worst].norm()):.4g}: divide each by its length"
            )
        normals = torch.nn.functional.normalize(normals, dim=-1)
    # of all that touch one object none is farther than its diagonal from the median; a few may touch another thing
    near = (points - points.median(0).values).norm(dim=-1) <= surface.diagonal
    if int(near.sum()) < max(3, _MOST_NEAR * len(points)) or _size(points) <= _APART * surface.diagonal:
        near = torch.ones_like(near)
    size = _size(points[near])
    if size > _APART * surface.diagonal:
        fits = [f"{name} ({x:g})" for name, x in _SCALES.items() if size * x <= _APART * surface.diagonal]
        guess = f"are they in {' or '.join(fits)}, or the mesh in another unit?" if fits else "are they on one object?"
        raise ValueError(
            f"Expected points in metres on one object of {surface.diagonal:.4g} m across, got {size:.4g} m from first "
            f"to last: {guess} Scale them (on the command line --points-scale ...)"
        )
    inner = points[near]
    spread = torch.linalg.svdvals(inner - inner.mean(0))
    if not float(spread[0]) > _TOGETHER * surface.diagonal:
        raise ValueError(
            f"Expected points at different places, got all {len(inner)} within {1e3 * size:.3g} mm: touch elsewhere, "
            "or are they in another unit (on the command line --points-scale ...)?"
        )
    if float(spread[1]) < _ACROSS * float(spread[0]):
        raise ValueError(
            f"Expected points that are not all on one line, got {len(points)} on one: the object could turn about it "
            "as it likes; touch beside it too"
        )
    return points, normals, near


def _size(points: Tensor) -> float:
    return float((points.amax(0) - points.amin(0)).norm())


def _finite_rows(name: str, values: Tensor) -> Tensor:
    given = torch.as_tensor(values).detach()
    values = given.double().cpu()
    if values.ndim != 2 or values.shape[1] != 3:
        raise ValueError(f"Expected {name} of shape (K, 3), got {tuple(values.shape)}")
    bad = int((~torch.isfinite(values)).any(-1).sum())
    if bad:
        raise ValueError(f"Expected finite {name}, got {bad} of {len(values)} with NaN or infinity: leave them out")
    if given.is_floating_point():
        check_near(name, given)
    return values
