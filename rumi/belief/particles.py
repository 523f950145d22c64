"""The belief over one object's pose: weighted particles in SE(3)."""

import math
from dataclasses import dataclass, replace
from typing import Self

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rumi.errors import DegenerateBeliefError
from rumi.registration.pose_summary import PoseSummary, mass_within, summarise_particles
from rumi.resampling import systematic
from rumi.weights import effective_sample_size, normalise, resampled_weights
from sdf import se3
from sdf.check import is_eager
from sdf.containers import Ragged, container
from sdf.precision import full_precision
from sdf.symmetry import Symmetries
from sensors.evidence import EvidenceSet

# bytes that a chunk of a table over pairs of particles may take, temporaries included
CHUNK_BYTES = 64 * 2**20
_TEMPORARIES = 12  # numbers of a pair that live at once
_ROUNDING = 1e-12  # of squared distances


# a particle that pads a belief weighs nothing
@container(
    {"attached_T_object": Ragged(-3, None), "log_weights": Ragged(-1, -math.inf), "discrepancy": Ragged(-1, None)}
)
@dataclass(frozen=True)
class PoseBelief:
    """Weighted pose particles of each scene, kept in a frame that rides with the object.

    A measured motion of the object changes `world_T_attached` alone, so that particles, observations in the
    attached frame and discrepancies carry over (RUMI's move invariance, for every particle and class).

    Attributes:
        world_T_attached: (*b, 4, 4), motion measured since the start.
        attached_T_object: (*b, N, 4, 4), one pose a particle.
        log_weights: (*b, N), normalised: logsumexp is 0.
        discrepancy: (*b, N), of all observations so far (RUMI, Eq 3), metres times scale.
        evidence: of all that was sensed so far but points, in the frame that rides with the object; None without any.
    """

    world_T_attached: Float[Tensor, "*b 4 4"]
    attached_T_object: Float[Tensor, "*b N 4 4"]
    log_weights: Float[Tensor, "*b N"]
    discrepancy: Float[Tensor, "*b N"]
    evidence: EvidenceSet | None = None

    @classmethod
    def uniform(cls, world_T_object: Float[Tensor, "*b N 4 4"]) -> Self:
        """Equal weights; the attached frame starts as the world."""
        batch, count = world_T_object.shape[:-3], world_T_object.shape[-3]
        if count == 0:
            raise ValueError("Expected at least one particle, got 0: set the number of particles to 1 or more")
        flat = world_T_object.new_zeros(*batch, count)
        start = se3.identity(batch, dtype=world_T_object.dtype, device=world_T_object.device)
        return cls(start, world_T_object, torch.log_softmax(flat, -1), flat)

    @property
    @full_precision
    def world_T_object(self) -> Float[Tensor, "*b N 4 4"]:
        """Pose of every particle in the world."""
        return self.world_T_attached[..., None, :, :] @ self.attached_T_object

    @property
    def weights(self) -> Float[Tensor, "*b N"]:
        """Weights, summing to 1."""
        return self.log_weights.exp()

    def ess(self) -> Float[Tensor, "*b"]:
        """Effective sample size, between 1 and N."""
        return effective_sample_size(self.log_weights)

    def mode(self, radius_m: float = 0.01, radius_rad: float = 0.175) -> Float[Tensor, "*b 4 4"]:
        """World pose of the best-weighted mode: the mean of the particles about the one with most weight around it.

        Args:
            radius_m: particles this near, and
            radius_rad: turned no more than this, belong together.
        """
        pose = self.world_T_object
        count, batch = pose.shape[-3], pose.shape[:-3]
        # the nine numbers of two rotations by an angle t are 2 sqrt(2) sin(t / 2) apart
        place, turn = (pose[..., :3, 3] - pose[..., :1, :3, 3]).double(), pose[..., :3, :3].flatten(-2).double()
        apart = 2.0 * math.sqrt(2.0) * math.sin(0.5 * radius_rad) if radius_rad < math.pi else math.inf
        rows = max(1, CHUNK_BYTES // (pose.element_size() * _TEMPORARIES * max(1, count * math.prod(batch))))
        most: Tensor | None = None
        chosen: Tensor | None = None
        for first in range(0, count, rows):
            some = slice(first, first + rows)
            near = _within(place[..., some, :], place, radius_m) & _within(turn[..., some, :], turn, apart)
            near = near.to(pose.dtype) * self.weights[..., None, :]
            # ties go to the heavier particle, and then to the first
            score, best = (near.sum(-1) + 1e-6 * self.weights[..., some]).max(-1)
            index = best[..., None, None].expand(*best.shape, 1, count)
            own = torch.gather(near, -2, index)[..., 0, :]
            if most is None or chosen is None:
                most, chosen = score, own
            else:
                better = score > most
                most, chosen = torch.where(better, score, most), torch.where(better[..., None], own, chosen)
        assert chosen is not None
        return se3.mean(pose, chosen / chosen.sum(-1, keepdim=True))

    def mean(self) -> Float[Tensor, "*b 4 4"]:
        """Weighted mean world pose (chordal mean of rotations); means little where there are several modes."""
        return se3.mean(self.world_T_object, self.weights)

    def summary(
        self,
        symmetries: Symmetries | None = None,
        *,
        within_m: float = 0.005,
        within_rad: float = math.radians(10.0),
    ) -> PoseSummary:
        """Best pose (`mode`), covariance, mass within a tolerance, and modes, of one scene's belief.

        Args:
            symmetries: turns after which the object looks the same.
            within_m: metres that the mass is within; until a belief's width is calibrated it is no frequency.
            within_rad: radians that it is within.
        """
        poses, best = self.world_T_object, self.mode()
        return summarise_particles(poses, self.log_weights, best, symmetries, within_m=within_m, within_rad=within_rad)

    def probability_right(self, symmetries: Symmetries, *, within_m: float, within_rad: float) -> float:
        """The `probability` of one scene's `summary` alone: that the best pose is right, by the belief itself."""
        poses, weights = (
            se3.renormalised(self.world_T_object.double().cpu()),
            self.log_weights.double().cpu().softmax(-1),
        )
        at = se3.renormalised(self.mode().double().cpu())
        return mass_within(poses, weights, at, symmetries.to(torch.float64), within_m, within_rad)

    def moved(self, motion: Float[Tensor, "*b 4 4"]) -> Self:
        """The belief after a known world motion: `world_T_object' = motion @ world_T_object`."""
        return replace(self, world_T_attached=se3.compose(motion, self.world_T_attached))

    def reweighted(self, log_weights: Float[Tensor, "*b N"]) -> Self:
        """The same particles under other, not necessarily normalised, log-weights.

        Raises:
            DegenerateBeliefError: a scene's are all -inf, or some are NaN or +inf.
        """
        top = log_weights.amax(-1)
        if is_eager() and not bool(torch.isfinite(top).all()):
            raise DegenerateBeliefError(
                f"Expected a finite log-weight in each scene and none that is NaN or +inf, got {float(top.min())} as "
                "the greatest: no particle fits what was observed, or a reading is none"
            )
        return replace(self, log_weights=normalise(log_weights))

    def resampled(self, index: Int[Tensor, "*b N"], log_weights: Float[Tensor, "*b N"] | None = None) -> Self:
        """Particles `index` with equal weights, which keep the slope of those before (`resampled_weights`).

        Args:
            index: drawn.
            log_weights: that they were drawn by; the belief's own by default.
        """
        poses = torch.gather(self.attached_T_object, -3, index[..., None, None].expand(*index.shape, 4, 4))
        return replace(
            self,
            attached_T_object=poses,
            log_weights=resampled_weights(self.log_weights if log_weights is None else log_weights, index),
            discrepancy=torch.gather(self.discrepancy, -1, index),
        )

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Self:
        """Move to a device and a floating dtype."""
        return replace(
            self,
            world_T_attached=self.world_T_attached.to(device=device, dtype=dtype),
            attached_T_object=self.attached_T_object.to(device=device, dtype=dtype),
            log_weights=self.log_weights.to(device=device, dtype=dtype),
            discrepancy=self.discrepancy.to(device=device, dtype=dtype),
            evidence=None if self.evidence is None else self.evidence.to(device, dtype),
        )


def _within(some: Float[Tensor, "*b n D"], every: Float[Tensor, "*b N D"], radius: float) -> Bool[Tensor, "*b n N"]:
    """Which of all points are within a radius of each of some, by their products, float64."""
    squares = some.square().sum(-1)[..., None] + every.square().sum(-1)[..., None, :]
    return squares - 2.0 * (some @ every.mT) <= radius * radius + _ROUNDING


def subsample(belief: PoseBelief, count: int) -> PoseBelief:
    """One scene's belief with at most `count` particles, evenly by weight; itself if it has no more.

    Nothing is random: each particle counts as often as teeth of the comb (k + 1/2) / count fall on it.
    """
    if count < 1:
        raise ValueError(f"Expected count to be 1 or more, got {count}")
    if count >= belief.log_weights.shape[-1]:
        return belief
    index, times = systematic(belief.log_weights, 0.5, count).unique_consecutive(return_counts=True)
    return PoseBelief(
        belief.world_T_attached,
        belief.attached_T_object[index],
        normalise(times.to(belief.log_weights).log()),
        belief.discrepancy[index],
        belief.evidence,
    )
