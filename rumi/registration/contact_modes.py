"""Modes of a pose posterior: clusters of poses with weights and uncertainties."""

import math
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rumi.registration.contact_terms import LocalizeSettings, TouchFit, touch_terms
from rumi.registration.pose_summary import COVARIANCE_ORDER, PoseMode, pose_lines
from rumi.registration.touch_surface import TouchSurface
from sdf import se3, so3
from sdf.mesh.touched import touched_face
from sdf.symmetry import Symmetries

# what is known of an orientation without touches: the variance of an angle anywhere on the circle, about
_ANY_TURN = math.pi**2 / 3.0
# of its size without touches, that a direction's standard deviation may keep before it counts as open
_OPEN = 0.5
_HELD = 1e10  # per square radian
_ROUNDS = 10  # of EM
_SUSPECT = 3.0  # times the noise
FEWEST, FEWEST_WITH_NORMALS = 20, 8
"""Touches from which weights were right with one bad one among them (scripts/docs/localize.md)."""


@dataclass(frozen=True, eq=False)
class Localization:
    """All plausible poses, the heaviest first.

    A mode stands for all poses that the object's symmetries make alike: world_T_object @ S for each S of them, a whole
    family where they have an axis.

    Attributes:
        world_T_object: (M, 4, 4), of the mesh's own frame.
        weights: (M,), which add up to 1: likelihood times the volume that the mode fills.
        distance_m: (M,), mean distance of the points from the surface.
        normal_rad: (M,), mean angle between normals and the faces that explain the touches; None without normals.
        log_likelihood: (M,), nats, up to a constant.
        covariance: (M, 6, 6), of the middle of the object's box (metres) and of its turn (radians), world frame; turns
            about an axis of symmetry count as none. `mode` has that of the mesh's origin.
        open_directions: (M,), of the six, those of which the touches say next to nothing.
        symmetries: of the object.
        noise_m: scale of the points' noise that the weights and the covariance are of.
        found: how many modes were plausible, of which the heaviest are here.
        points: how many there were.
        off_m: (M, K), distance of each of them from the surface.
        left_out: (K), whether a point is too far from the others to be on the object, and was not used.
        middle_o: (3,), middle of the object's box, in the mesh's own frame.
    """

    world_T_object: Float[Tensor, "M 4 4"]
    weights: Float[Tensor, "M"]
    distance_m: Float[Tensor, "M"]
    normal_rad: Float[Tensor, "M"] | None
    log_likelihood: Float[Tensor, "M"]
    covariance: Float[Tensor, "M 6 6"]
    open_directions: Int[Tensor, "M"]
    symmetries: Symmetries
    noise_m: float
    found: int
    points: int
    off_m: Float[Tensor, "M K"]
    left_out: Bool[Tensor, "K"]
    middle_o: Float[Tensor, "3"]

    def __len__(self) -> int:
        return len(self.weights)

    @property
    def best(self) -> int:
        """Which mode has the likeliest pose: without normals that of the least distance; the weights may differ."""
        return int(self.log_likelihood.argmax())

    @property
    def spread_m(self) -> Float[Tensor, "M"]:
        """Standard deviation of the middle's place in the direction in which it is largest."""
        return torch.linalg.eigvalsh(self.covariance[:, :3, :3])[:, -1].clamp_min(0.0).sqrt()

    @property
    def spread_rad(self) -> Float[Tensor, "M"]:
        """Standard deviation of the turn about the axis about which it is largest."""
        return torch.linalg.eigvalsh(self.covariance[:, 3:, 3:])[:, -1].clamp_min(0.0).sqrt()

    @property
    def suspects(self) -> list[int]:
        """Which points the best pose leaves farther off than three times the noise, the farthest first."""
        off = self.off_m[self.best]
        far = ((off > _SUSPECT * self.noise_m) | self.left_out).nonzero()[:, 0]
        return [int(k) for k in far[off[far].argsort(descending=True, stable=True)]]

    @property
    def trusted(self) -> bool:
        """Whether there were as many points as weights can be trusted from (`fewest`)."""
        return self.points >= self.fewest

    @property
    def fewest(self) -> int:
        """Points from which the weights can be trusted, one bad one among them."""
        return FEWEST if self.normal_rad is None else FEWEST_WITH_NORMALS

    def mode(self, index: int) -> PoseMode:
        """A mode with the covariance about the mesh's origin, as `rumi result` has those of a belief."""
        pose = self.world_T_object[index]
        across = torch.eye(6, dtype=pose.dtype)
        across[:3, 3:] = so3.hat(pose[:3, :3] @ self.middle_o)
        return PoseMode(pose, float(self.weights[index]), across @ self.covariance[index] @ across.mT)

    @property
    def family(self) -> bool:
        """Whether every mode is a continuous family: the object looks the same after any turn about an axis."""
        return self.symmetries.axis is not None or self.symmetries.ball

    def alike(self, mode: int, *, turns: int = 36) -> Float[Tensor, "K 4 4"]:
        """The poses that a mode stands for: all of a finite group, or `turns` about the axis for each.

        Args:
            mode: which.
            turns: how many of a continuous family; of a ball's only the pose itself comes.
        """
        own = self.symmetries
        rotations = own.rotations
        if own.axis is not None:
            angles = 2.0 * math.pi * torch.arange(turns, dtype=torch.float64)[:, None] / turns
            rotations = (rotations[:, None] @ so3.exp(angles * own.axis)).flatten(0, 1)
        shift = own.center - (rotations @ own.center[:, None])[..., 0]
        return self.world_T_object[mode] @ se3.make(rotations, shift)

    def to_dict(self) -> dict[str, Any]:
        """Everything, as JSON takes it."""
        own, off = self.symmetries, self.off_m[self.best]
        modes = [
            {
                **self.mode(i).as_dict(),
                "mean_distance_mm": 1e3 * float(self.distance_m[i]),
                "mean_normal_deg": None if self.normal_rad is None else math.degrees(float(self.normal_rad[i])),
                "log_likelihood": float(self.log_likelihood[i]),
                "spread_mm": 1e3 * float(self.spread_m[i]),
                "spread_deg": math.degrees(float(self.spread_rad[i])),
                "open_directions": int(self.open_directions[i]),
            }
            for i in range(len(self))
        ]
        symmetries = {
            "words": own.words(),
            "center": own.center.tolist(),
            "axis": None if own.axis is None else own.axis.tolist(),
            "ball": own.ball,
            "rotations": own.rotations.tolist(),
        }
        return {
            "frame": "world",
            "covariance_order": COVARIANCE_ORDER,
            "points": self.points,
            "weights_from_points": self.fewest,
            "suspects": [
                {"touch": k + 1, "off_mm": 1e3 * float(off[k]), "left_out": bool(self.left_out[k])}
                for k in self.suspects
            ],
            "noise_mm": 1e3 * self.noise_m,
            "found": self.found,
            "best": self.best,
            "family": self.family,
            "symmetries": symmetries,
            "modes": modes,
        }

    def text(self) -> str:
        """For people."""
        count = f"{len(self)} mode{'s' if len(self) != 1 else ''}"
        more = f" of {self.found} plausible ones" if self.found > len(self) else ""
        lines = [f"{count}{more} from {self.points} points; noise taken for {1e3 * self.noise_m:.3g} mm"]
        if not self.symmetries.trivial:
            whole = "; each mode is a family of poses" if self.family else "; each mode is all poses alike by these"
            lines.append(f"object looks the same after: {self.symmetries.words()}{whole}")
        normals = "" if self.normal_rad is None else "  normals"
        lines.append(f"weight  mean off{normals}  spread               origin x, y, z (mm)       quaternion x, y, z, w")
        turns = so3.quaternion(self.world_T_object[:, :3, :3])
        for i in range(len(self)):
            place = " ".join(f"{1e3 * x:8.1f}" for x in self.world_T_object[i, :3, 3].tolist())
            turn = " ".join(f"{x:7.4f}" for x in turns[i].tolist())
            angle = "" if self.normal_rad is None else f"  {math.degrees(float(self.normal_rad[i])):4.1f} deg"
            wide = f"{1e3 * float(self.spread_m[i]):5.1f} mm {math.degrees(float(self.spread_rad[i])):5.1f} deg"
            open_ = f"  {int(self.open_directions[i])} of 6 directions open" if self.open_directions[i] else ""
            lines.append(
                f"{float(self.weights[i]):6.4f}  {1e3 * float(self.distance_m[i]):5.2f} mm{angle}  {wide}  {place}  "
                f"{turn}{open_}"
            )
        lines += ["heaviest:", *pose_lines(self.world_T_object[0], self.mode(0).covariance)]
        if self.suspects:
            off = self.off_m[self.best]
            named = [
                f"{k + 1} ({1e3 * float(off[k]):.3g} mm{', left out' * bool(self.left_out[k])})" for k in self.suspects
            ]
            more = f", and {len(named) - 8} more" if len(named) > 8 else ""
            lines.append(
                f"suspect touches, farther off the best pose than three times the noise: {', '.join(named[:8])}{more}"
            )
        if not self.trusted:
            kind = "points alone" if self.normal_rad is None else "points with normals"
            lines.append(f"weights can be trusted from {self.fewest} {kind} on, one bad one among them: touch more")
        return "\n".join(lines)


def gather_modes(
    surface: TouchSurface,
    world_T_middle: Float[Tensor, "N 4 4"],
    points_w: Float[Tensor, "K 3"],
    normals_w: Float[Tensor, "K 3"] | None,
    settings: LocalizeSettings,
    noise_m: float | None = None,
) -> Localization:
    """Put poses together that are alike, best first, and weigh what there is.

    Distances are taken to have a Laplace distribution of scale `noise_m`, normals (chords) a normal one, but for a
    share of outliers, which may be anywhere (`LocalizeSettings.outlier`). A mode's volume and covariance come from the
    Fisher information of both at its best pose, each touch by its chance of being no outlier, and from next to nothing
    known before: a standard deviation of the diagonal for the place, of any angle for the turn.
    """
    nearest = TouchFit("absolute", True, 0.0, smooth_m=0.0)
    distance = touch_terms(surface, world_T_middle, points_w, None, nearest).objective / len(points_w)
    noise = noise_m or noise_scale(surface, world_T_middle, points_w, normals_w, settings)
    fit = mixture(surface, noise, settings, normals=normals_w is not None)
    likelihood, modes = plausible_modes(surface, world_T_middle, points_w, normals_w, fit, settings)
    reach, poses = fit.reach_m, world_T_middle[modes]
    square = replace(fit, loss="square")
    information = touch_terms(surface, poses, points_w, normals_w, square).hessian
    prior = torch.tensor([surface.diagonal**-2] * 3 + [1.0 / _ANY_TURN] * 3, dtype=poses.dtype)
    covariance = torch.linalg.inv(information / noise**2 + torch.diag(prior) + _family(surface, poses))
    scaled = covariance * prior.sqrt() * prior.sqrt()[:, None]
    open_ = (torch.linalg.eigvalsh(scaled) > _OPEN**2).sum(-1)
    weights = torch.softmax(likelihood[modes] + 0.5 * torch.linalg.slogdet(covariance).logabsdet, 0)
    heavy = weights.argsort(descending=True, stable=True)[: settings.kept]
    chosen = modes[heavy]
    off, turned = touches_off(surface, world_T_middle[chosen], points_w, normals_w, reach)
    return Localization(
        surface.uncentred(world_T_middle[chosen]),
        weights[heavy] / weights[heavy].sum(),
        distance[chosen],
        None if normals_w is None else turned.mean(-1),
        likelihood[chosen],
        covariance[heavy],
        open_[heavy],
        surface.symmetries,
        float(noise),
        len(modes),
        len(points_w),
        off,
        torch.zeros(len(points_w), dtype=torch.bool),
        surface.middle_o.double(),
    )


def mixture(surface: TouchSurface, noise_m: float, settings: LocalizeSettings, *, normals: bool) -> TouchFit:
    """The loss whose sum over touches, by the noise, is the negative log-likelihood of a pose, outliers among them."""
    reach = noise_m / settings.normal_noise_rad if normals else 0.0
    odds = float(settings.outlier_odds(noise_m, surface.diagonal, normals=normals))
    return TouchFit("absolute", True, reach, noise_m, smooth_m=1e-12, outlier=odds)


def plausible_modes(
    surface: TouchSurface,
    world_T_middle: Float[Tensor, "N 4 4"],
    points_w: Float[Tensor, "K 3"],
    normals_w: Float[Tensor, "K 3"] | None,
    fit: TouchFit,
    settings: LocalizeSettings,
) -> tuple[Float[Tensor, "N"], Int[Tensor, "M"]]:
    """Log-likelihood of each pose, and which of them are plausible and unlike any that is likelier, best first."""
    likelihood = -touch_terms(surface, world_T_middle, points_w, normals_w, fit).objective / fit.noise_m
    order = likelihood.argsort(descending=True, stable=True)
    order = order[likelihood[order] >= likelihood[order[0]] + math.log(settings.plausible)]
    return likelihood, order[distinct(surface, world_T_middle[order], settings.mode_m, settings.mode_rad, len(order))]


def noise_scale(
    surface: TouchSurface,
    world_T_middle: Float[Tensor, "N 4 4"],
    points_w: Float[Tensor, "K 3"],
    normals_w: Float[Tensor, "K 3"] | None,
    settings: LocalizeSettings,
) -> float:
    """Scale of the distances that the likeliest pose leaves: maximum likelihood of the mixture, by EM for each pose."""
    if settings.noise_m is not None:
        return settings.noise_m
    with_normals = normals_w is not None
    off, turned = touches_off(surface, world_T_middle, points_w, normals_w, 0.005 / settings.normal_noise_rad)
    nats = 2.0 * ((0.5 * turned).sin() / settings.normal_noise_rad).square()  # half a squared chord, by its variance
    scale = (off.median(-1).values / math.log(2.0)).clamp_min(settings.least_noise_m)[:, None]
    for _ in range(_ROUNDS):
        odds = settings.outlier_odds(scale, surface.diagonal, normals=with_normals)
        share = 1.0 / (1.0 + odds * (off / scale + nats).clamp_max(500.0).exp())
        mean = (share * off).sum(-1, keepdim=True) / share.sum(-1, keepdim=True).clamp_min(1e-9)
        scale = mean.clamp_min(settings.least_noise_m)
    odds = settings.outlier_odds(scale, surface.diagonal, normals=with_normals)
    likelihood = (((-(off / scale + nats)).exp() + odds) / scale).log().sum(-1)
    return float(scale[likelihood.argmax(), 0])


def distinct(
    surface: TouchSurface, world_T_middle: Float[Tensor, "N 4 4"], near_m: float, near_rad: float, most: int
) -> Int[Tensor, "M"]:
    """Indices of poses none of which is like one before it, up to the object's symmetries; `most` of them at most.

    Alike are two whose middles are less than `near_m` apart, and their turns less than `near_rad`.
    """
    poses = surface.uncentred(world_T_middle)
    left = torch.arange(len(poses))
    kept: list[Tensor] = []
    while len(left) and len(kept) < most:
        first = left[0]
        kept.append(first)
        # of the poses that the first may as well be, the nearest to each
        own = surface.symmetries.nearest(poses[first].expand(len(left), 4, 4), poses[left])
        apart = (surface.centred(own)[:, :3, 3] - world_T_middle[left, :3, 3]).norm(dim=-1)
        turned = so3.angle(own[:, :3, :3].mT @ poses[left, :3, :3])
        far = (apart >= near_m) | (turned >= near_rad)
        far[0] = False
        left = left[far]
    return torch.stack(kept) if kept else torch.zeros(0, dtype=torch.long)


def _family(surface: TouchSurface, poses: Float[Tensor, "M 4 4"]) -> Float[Tensor, "M 6 6"]:
    """Information that holds turns about an axis of symmetry at none: poses that differ by one are the same."""
    own, held = surface.symmetries, poses.new_zeros(len(poses), 6, 6)
    if own.ball:
        held[:, 3:, 3:] = _HELD * torch.eye(3, dtype=poses.dtype)
    elif own.axis is not None:
        axis = poses[:, :3, :3] @ own.axis
        held[:, 3:, 3:] = _HELD * axis[:, :, None] * axis[:, None]
    return held


def touches_off(
    surface: TouchSurface, poses: Float[Tensor, "N 4 4"], points: Tensor, normals: Tensor | None, reach: float
) -> tuple[Float[Tensor, "N K"], Float[Tensor, "N K"]]:
    """Distance of each touch from the triangle that explains it, and angle between their normals (0 without)."""
    rotation, place = poses[:, None, :3, :3], poses[:, None, :3, 3]
    own = (rotation.mT @ (points - place)[..., None])[..., 0]
    facing = torch.zeros_like(own) if normals is None else (rotation.mT @ normals[:, :, None])[..., 0]
    found = touched_face(own, facing, surface.triangles, 0.0 if normals is None else reach)
    off = (own - found.point).norm(dim=-1)
    if normals is None:
        return off, torch.zeros_like(off)
    cosine = (facing * surface.triangles.normals[found.face]).sum(-1)
    return off, cosine.clamp(-1.0, 1.0).arccos()
