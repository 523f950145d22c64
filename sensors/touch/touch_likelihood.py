"""Likelihood of contact points with normals at every pose: on the faces of a mesh, a box or a rectangle."""

import math
from dataclasses import dataclass
from typing import Annotated

import torch
from annotated_types import Interval
from jaxtyping import Float
from torch import Tensor

from sdf import numbers
from sdf.bounds import Checked, TrainedShareBelow1
from sdf.check import check_finite, check_shape
from sdf.mesh.touched import touched_face
from sdf.mesh.triangles import Triangles
from sdf.precision import full_precision

_SIX_DEGREES = math.radians(6.0)

# squares of less, and logs of more, are no numbers
_Scale = Annotated[float | Tensor, Interval(gt=1e-12, lt=1e12)]


@dataclass(frozen=True)
class TouchNoise(Checked):
    """Noise of a touch: its point and its normal; numbers, or tensors of one number each, to which gradients go.

    Attributes:
        point_m: sigma_p, metres.
        normal_rad: sigma_n, radians; it scales the chord between two unit normals, which for small angles is the angle.
        outlier: share of touches that tell nothing.
        extent_m: an outlier's distance is uniform up to this, and its chord over all chords.
    """

    point_m: _Scale = 0.005
    normal_rad: _Scale = _SIX_DEGREES
    outlier: TrainedShareBelow1 = 0.0
    extent_m: _Scale = 0.5

    def log_likelihood(
        self, squared_distance: Float[Tensor, "*b"], squared_chord: Float[Tensor, "*b"] | None
    ) -> Float[Tensor, "*b"]:
        """Log-likelihood (*b) of one face, nats, without the constants of Eqs. 3 and 4, which cancel in all uses."""
        log = -0.5 * squared_distance / self.point_m**2
        if squared_chord is not None:
            log = log - 0.5 * squared_chord / self.normal_rad**2
        return log

    def with_outliers(self, log: Float[Tensor, "*b"], normals: bool) -> Float[Tensor, "*b"]:
        """The same where some of the touches tell nothing; in units of the same constants."""
        if not isinstance(self.outlier, Tensor) and self.outlier == 0.0:
            return log
        floor = numbers.log(self.outlier * math.sqrt(2.0 * math.pi) * self.point_m / self.extent_m)
        if normals:
            floor = floor + numbers.log(math.sqrt(2.0 * math.pi) * self.normal_rad / 2.0)
        return torch.logaddexp(log + numbers.log1p(-self.outlier), numbers.like(floor, log))

    def tensors(self) -> tuple[Tensor, ...]:
        """Those of its numbers that are tensors."""
        parts = (self.point_m, self.normal_rad, self.outlier, self.extent_m)
        return tuple(part for part in parts if isinstance(part, Tensor))


@full_precision
def touch_log_likelihoods(
    world_T_object: Float[Tensor, "*b 4 4"],
    points_w: Float[Tensor, "K 3"],
    normals_w: Float[Tensor, "K 3"] | None,
    triangles: Triangles,
    noise: TouchNoise | None = None,
) -> Float[Tensor, "*b K"]:
    """Log-likelihood of each touch at each pose (*b, K), nats: the face that explains point and normal best together.

    Time allocation, Eqs. 2-5: max over faces of -dist^2 / (2 sigma_p^2) - |n - n_f|^2 / (2 sigma_n^2), the faces finite
    triangles. Touches are independent: add them up. Autograd reaches poses, points and normals, the face held fixed.

    Args:
        world_T_object: poses.
        points_w: metres.
        normals_w: outward, unit; None where they are not known, then the nearest face counts.
        triangles: of the object, in its own frame, facing outward.
        noise: of the touches.

    Raises:
        ValueError: a shape does not fit, or a point or normal is not finite.
    """
    check_shape("points_w", points_w, "(K, 3)")
    check_finite("points_w", points_w)
    if normals_w is not None:
        check_finite("normals_w", normals_w)
    noise = noise or TouchNoise()
    rotation, place = world_T_object[..., None, :3, :3], world_T_object[..., None, :3, 3]
    own = (rotation.mT @ (points_w - place)[..., None])[..., 0]
    if normals_w is None:
        found = touched_face(own, torch.zeros_like(own), triangles, 0.0)
        log = noise.log_likelihood((own - found.point).square().sum(-1), None)
    else:
        facing = (rotation.mT @ normals_w[..., None])[..., 0]
        found = touched_face(own, facing, triangles, noise.point_m / noise.normal_rad)
        chord = (facing - triangles.normals.to(facing)[found.face]).square().sum(-1)
        log = noise.log_likelihood((own - found.point).square().sum(-1), chord)
    return noise.with_outliers(log, normals_w is not None)


def box_face_log_likelihoods(
    points_o: Float[Tensor, "*b D"],
    normals_o: Float[Tensor, "*b D"] | None,
    half: Float[Tensor, "D"],
    noise: TouchNoise,
) -> Float[Tensor, "*b F"]:
    """The same for each face of a rectangle (D = 2) or a box (D = 3), (*b, 2 D), in closed form and without outliers.

    Args:
        points_o: in the object's own frame, whose origin is its middle, metres.
        normals_o: outward, unit, in that frame.
        half: half of the edges, metres.
        noise: of the touches.

    Returns:
        Faces in the order +x, -x, +y, -y, +z, -z.
    """
    size = points_o.shape[-1]
    if size not in (2, 3) or half.shape != (size,):
        raise ValueError(f"Expected points of 2 or 3 numbers and as many half edges, got {size} and {half.shape}")
    out = torch.eye(size, dtype=points_o.dtype, device=points_o.device).repeat_interleave(2, 0)
    out = out * torch.tensor([1.0, -1.0]).repeat(size).to(out)[:, None]
    clamped = torch.minimum(torch.maximum(points_o, -half), half)[..., None, :]
    feet = torch.where(out != 0, out * half, clamped)
    distance = (points_o[..., None, :] - feet).square().sum(-1)
    chord = None if normals_o is None else (normals_o[..., None, :] - out).square().sum(-1)
    return noise.log_likelihood(distance, chord)


def box_log_likelihoods(
    points_o: Float[Tensor, "*b D"],
    normals_o: Float[Tensor, "*b D"] | None,
    half: Float[Tensor, "D"],
    noise: TouchNoise | None = None,
) -> Float[Tensor, "*b"]:
    """Log-likelihood (*b) of touches of a rectangle or box, as of its mesh, with outliers; arguments as above."""
    noise = noise or TouchNoise()
    best = box_face_log_likelihoods(points_o, normals_o, half, noise).amax(-1)
    return noise.with_outliers(best, normals_o is not None)
