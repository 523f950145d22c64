"""The pose filter: predict, weigh, resample, optimise (RUMI, Algs 1-4 and 6)."""

import copy
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple, Self, cast

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from rumi.belief.filter_settings import FilterSettings
from rumi.belief.free_points import possible, stationary
from rumi.belief.motion import Predictor, object_motion
from rumi.belief.particles import PoseBelief
from rumi.belief.prior import PosePrior
from rumi.belief.scene_rows import bare, differ, generators_of, put, put_rows, where_rows
from rumi.errors import DegenerateBeliefError
from rumi.registration.descent import SEARCHES, DescentSettings, Search, descend, retract
from rumi.resampling import resample_systematic
from rumi.seeding import Generators, normal
from rumi.weights import boltzmann
from sdf import numbers, se3, skipped_work
from sdf.check import check_near
from sdf.containers import index
from sdf.precision import full_precision
from sensors.discrepancy import Discrepancy
from sensors.evidence import Evidence, EvidenceModel, SemanticPoints, gather, in_attached_frame
from sensors.observation import Observation, attach, compact, merge
from sensors.reading import Reading

__all__ = ["FilterInfo", "FilterSettings", "PoseFilter"]


class FilterInfo(NamedTuple):
    """Diagnostics of a filter step.

    Attributes:
        moved: (*b), whether the object moved.
        resampled: (*b), whether the belief was resampled.
        added: the points that were new.
    """

    moved: Bool[Tensor, "*b"]
    resampled: Bool[Tensor, "*b"]
    added: Observation


class PoseFilter(nn.Module):
    """Particle filter of an object's pose; holds settings, never the belief.

    Evidence of each kind adds -log L / lambda to a pose's cost: semantic points their discrepancy C^, others
    (`PoseBelief.evidence`) their log-likelihood, as the prior does. Eq 10 then gives all of it its own weight,
    exp(-lambda C) times L, in weighing, resampling and drawing anew, also at every later step. The descent of poses
    follows the points alone.

    Gradients of what comes out, in learning code: weights have theirs, to poses, points, the evidence's numbers and the
    settings' peakiness and process noise. A resampling keeps the slope of the weights that it drew by
    (`rumi.weights.resampled_weights`); which particles it drew has none, and so does the trigger. The descent stops the
    gradient: a pose that it moved counts as given. Both bias the gradient of a loss by what they leave out.

    Args:
        settings: of the posterior, its motion model, resampling and descent.
        evidence: measurement models, in the order in which their evidence is summed. The first is that of semantic
            points: C^, with the settings' scale and tolerance. A new kind of evidence is one more `EvidenceModel`.
        search: "SE(2)" or "SE(3)".
        prior: of the pose at the start; its part is added to the discrepancy, as if it were an observation.
        pushed: says how far the object was pushed; needed for the motions "pushed" and "corrected".
    """

    lattice: Tensor

    def __init__(
        self,
        settings: FilterSettings,
        evidence: Sequence[Discrepancy | EvidenceModel],
        search: Search,
        prior: PosePrior | None = None,
        pushed: Predictor | None = None,
    ) -> None:
        super().__init__()
        if settings.motion == "auto":
            raise ValueError("Expected a motion by which poses are followed, got 'auto', which tasks settle: name one")
        if search not in SEARCHES:
            raise ValueError(f"Expected search to be one of {', '.join(SEARCHES)}, got {search!r}")
        points, further = evidence[0] if evidence else None, evidence[1:]
        if not isinstance(points, Discrepancy) or any(isinstance(model, Discrepancy) for model in further):
            raise TypeError(f"Expected one Discrepancy, of semantic points, as the first evidence, got {evidence}")
        self.discrepancy = points
        self.further = cast(tuple[EvidenceModel, ...], tuple(further))
        self.search: Search = "SE(2)" if prior is not None and settings.lies_flat else search
        self.settings = settings
        self.prior = prior
        self.pushed = pushed
        lattice = (settings.free_spacing_m, settings.free_spacing_m, settings.surface_spacing_m)
        self.register_buffer("lattice", torch.tensor(lattice))

    def with_evidence(self, *models: EvidenceModel) -> Self:
        """The same filter with further evidence, that of these models, in place of what it had beside points."""
        other = copy.copy(self)
        other.further = models
        return other

    def begin(self, belief: PoseBelief, memory: Observation, *, generator: Generators) -> PoseBelief:
        """The belief after a first view, from poses that were fitted to it; these themselves."""
        return belief

    @full_precision
    def forward(
        self, belief: PoseBelief, memory: Observation, reading: Reading, *, generator: Generators
    ) -> tuple[PoseBelief, Observation, FilterInfo]:
        """One whole filter step.

        Args:
            belief: before the reading.
            memory: all points so far; attached ones in the object-attached frame.
            reading: what the action's sensors reported.
            generator: one, or one a scene.

        Returns:
            the belief after, the memory after, and what was done.

        Raises:
            ValueError: the world's origin is so far that rounding moves the object (`sdf.check.check_near`).
        """
        settings = self.settings
        check_near("the belief's poses", belief.attached_T_object[..., :3, 3])
        motion = object_motion(
            settings.motion, belief, reading, self.discrepancy, self.search, settings.descent, self.pushed
        )
        frames = motion @ belief.world_T_attached[..., None, :, :]
        new = attach(reading.observation, reading.instant, frames)
        belief = replace(belief, evidence=gather(self.further, belief.evidence, reading, frames))
        before = belief
        belief, moved = self.predict(belief, motion[..., -1, :, :], generator=generator)
        if settings.free_points == "dropped":
            memory = possible(stationary(memory, before.world_T_attached), self.discrepancy.sdf, belief.world_T_object)
            new = stationary(new, belief.world_T_attached)
        memory, added = merge(memory, new, self.lattice)
        belief = self.weigh(belief, before, memory, added)
        trigger_belief = belief if settings.weigh_before_resampling else replace(belief, log_weights=before.log_weights)
        belief, resampled = self.resample(belief, trigger_belief, memory, generator=generator)
        return belief, memory, FilterInfo(moved, resampled, added)

    def predict(
        self, belief: PoseBelief, motion: Float[Tensor, "*b 4 4"], *, generator: Generators
    ) -> tuple[PoseBelief, Bool[Tensor, "*b"]]:
        """Move the attached frame by the motion, and add process noise where it is a move (Alg 1, lines 12-14).

        Particles and points ride in the attached frame: `T_i <- dT_sigma T_i M^-1` for all particles, where the
        paper's `dT T_i` would move each along its own axes.
        """
        identity = se3.identity(motion.shape[:-2], dtype=motion.dtype, device=motion.device)
        shift, turn = se3.distance(motion, identity)
        # a motion about a far origin shifts nearby points: measure it at the object
        at_object = belief.mean()
        shift = torch.minimum(shift, (motion @ at_object - at_object)[..., :3, 3].norm(dim=-1))
        moved = (shift > self.settings.still_m) | (turn > self.settings.still_rad)
        belief = belief.moved(motion)
        poses = self.perturb(belief, generator=generator, rows=moved)
        return replace(belief, attached_T_object=poses), moved

    def perturb(
        self, belief: PoseBelief, *, generator: Generators, rows: Bool[Tensor, "*b"]
    ) -> Float[Tensor, "*b N 4 4"]:
        """Poses with process noise about each object's origin in the scenes `rows` (Alg 3; sigmas are deviations).

        Level noise is that of the world where a prior lets objects tip, and otherwise of the frame that rides along.
        """
        poses = belief.attached_T_object
        shift, turn = self.settings.translation_noise_m, self.settings.rotation_noise_rad
        if (shift == 0 and turn == 0) or not bool(rows.any()):
            return poses
        if differ(rows, generator):  # the others draw nothing, as each does alone
            few = replace(index(bare(belief), rows), evidence=belief.evidence)
            here = torch.ones(len(few.log_weights), dtype=torch.bool, device=rows.device)
            return put(poses, rows, self.perturb(few, generator=generators_of(generator, rows), rows=here))
        shift, turn = numbers.like(shift, poses), numbers.like(turn, poses)
        sigma = [shift, shift, turn] if self.search == "SE(2)" else [shift] * 3 + [turn] * 3
        shape = (*poses.shape[:-2], len(sigma))
        noise = normal(shape, generator=generator, dtype=poses.dtype, device=poses.device)
        noise = noise * torch.stack(sigma)
        if self.prior is None:
            moved = se3.renormalised(retract(poses, noise, self.search))
            return torch.where(rows[..., None, None, None], moved, poses)
        back = se3.inverse(belief.world_T_attached)[..., None, :, :]
        moved = se3.renormalised(back @ retract(belief.world_T_object, noise, self.search))
        return torch.where(rows[..., None, None, None], moved, poses)

    def descend(self, belief: PoseBelief, here: Observation, settings: DescentSettings) -> Float[Tensor, "*b N 4 4"]:
        """Poses optimised on points that are in the attached frame as well (Alg 4)."""
        poses = descend(self.discrepancy, belief.attached_T_object, here, self.search, settings)
        tipped = self.tipped(belief)
        if self.search == "SE(3)" or not bool(tipped.any()):
            return poses
        world_T_attached = belief.world_T_attached
        there = replace(here, points=se3.apply(world_T_attached, here.points))
        level = descend(self.discrepancy, world_T_attached[..., None, :, :] @ poses, there, "SE(2)", settings)
        level = se3.inverse(world_T_attached)[..., None, :, :] @ level
        return torch.where(tipped[..., None, None, None], level, poses)

    def tipped(self, belief: PoseBelief) -> Bool[Tensor, "*b"]:
        """Whether the frame that rides with the object has tilted since the start; never without a prior."""
        upright = belief.world_T_attached[..., 2, 2]
        return (upright < math.cos(self.settings.level_within_rad)) & (self.prior is not None)

    def weigh(self, belief: PoseBelief, before: PoseBelief, memory: Observation, added: Observation) -> PoseBelief:
        """Weights by the discrepancy (Alg 2), of which only the new points' part is computed where it adds up.

        Where no particle moved in the attached frame and no point is fixed in the world, the discrepancy of the
        old points carries over exactly (Eq 11 and move invariance); further evidence may change without any.
        """
        anew = (memory.valid & ~memory.attached).any(-1)
        if belief.attached_T_object is not before.attached_T_object:
            anew = anew | (belief.attached_T_object != before.attached_T_object).any(-1).any(-1).any(-1)
        if belief.evidence is not None or self.settings.free_points == "dropped":
            anew = torch.ones_like(anew)
        with skipped_work.work("old_points") as work:
            if not bool(anew.any()):
                total = belief.discrepancy + self.discrepancy(belief.attached_T_object, added)
                work.count(len(added), len(memory))
            elif bool(anew.all()):
                total = self.total(belief, memory)
                work.count(len(memory), len(memory))
            else:  # by row: what one scene needs costs the others nothing
                few, rest = index(belief, anew), index(belief, ~anew)
                old = rest.discrepancy + self.discrepancy(rest.attached_T_object, compact(index(added, ~anew)))
                total = put(belief.discrepancy, ~anew, old)
                total = put(total, anew, self.total(few, compact(index(memory, anew))))
                share = float(anew.float().mean())
                work.count(share * len(memory) + (1.0 - share) * len(added), len(memory))
        return self._weighted(replace(belief, discrepancy=total), total - before.discrepancy)

    def log_chance(self, belief: PoseBelief) -> float:
        """Log of the p-value of what was sensed at the best particle, an upper bound; 0 where costs tell of the fit."""
        return 0.0

    def total(self, belief: PoseBelief, memory: Observation) -> Float[Tensor, "*b N"]:
        """Cost of each particle by all evidence and the prior."""
        here = in_attached_frame(memory, belief.world_T_attached)
        return self.cost(belief.attached_T_object, here, belief.evidence)

    def cost(
        self, attached_T_object: Float[Tensor, "*b N 4 4"], here: Observation, evidence: Evidence | None
    ) -> Float[Tensor, "*b N"]:
        """Negative log-posterior of poses over lambda, up to a constant: of points, prior and further evidence.

        Args:
            attached_T_object: poses.
            here: points that are in the attached frame as well.
            evidence: of other kinds.
        """
        total = SemanticPoints(here, self.discrepancy, self.settings.peakiness).cost(attached_T_object)
        if self.prior is None and evidence is None:
            return total
        return total + self.prior_and_evidence_cost(attached_T_object, evidence)

    def prior_and_evidence_cost(
        self, attached_T_object: Float[Tensor, "*b N 4 4"], evidence: Evidence | None
    ) -> Float[Tensor, "*b N"]:
        """The cost by prior (the attached frame is the world's at the start) and evidence other than points."""
        part = torch.zeros_like(attached_T_object[..., 0, 0])
        if self.prior is not None:
            part = self.prior.negative_log_density(attached_T_object) / self.settings.peakiness
        return part if evidence is None else part - evidence.log_likelihood(attached_T_object) / self.settings.peakiness

    def _weighted(self, belief: PoseBelief, change: Float[Tensor, "*b N"]) -> PoseBelief:
        if not bool(torch.isfinite(belief.discrepancy).any(-1).all()):
            raise DegenerateBeliefError("No particle has a finite discrepancy: check the observation's points")
        if self.settings.weighing == "incremental":
            return belief.reweighted(belief.log_weights + boltzmann(change, self.settings.peakiness))
        return belief.reweighted(boltzmann(belief.discrepancy, self.settings.peakiness))

    def resample(
        self, belief: PoseBelief, weights: PoseBelief, memory: Observation, *, generator: Generators
    ) -> tuple[PoseBelief, Bool[Tensor, "*b"]]:
        """Resample, perturb, optimise and weigh again the scenes whose belief fits badly (Alg 1, line 16; Alg 4)."""
        settings = self.settings
        level = torch.quantile(belief.discrepancy, settings.trigger_percentile, dim=-1)
        rows = level > settings.trigger
        if not bool(rows.any()):
            return belief, rows
        if belief.evidence is None and differ(rows, generator):
            few, drawn_by = index(belief, rows), index(bare(weights), rows)
            fresh = self._renewed(few, drawn_by, compact(index(memory, rows)), generator=generators_of(generator, rows))
            return put_rows(belief, rows, fresh), rows
        return where_rows(rows, self._renewed(belief, weights, memory, generator=generator), belief), rows

    def _renewed(
        self, belief: PoseBelief, weights: PoseBelief, memory: Observation, *, generator: Generators
    ) -> PoseBelief:
        """All scenes resampled by `weights`, perturbed, optimised and weighed."""
        settings = self.settings
        drawn = resample_systematic(weights.log_weights, generator=generator)
        fresh = belief.resampled(drawn, weights.log_weights)
        every = torch.ones(fresh.log_weights.shape[:-1], dtype=torch.bool, device=fresh.log_weights.device)
        fresh = replace(fresh, attached_T_object=self.perturb(fresh, generator=generator, rows=every))
        here = in_attached_frame(memory, belief.world_T_attached)
        poses = self.descend(fresh, here, settings.descent)
        total = self.cost(poses, here, belief.evidence)
        fresh = replace(fresh, attached_T_object=poses, discrepancy=total)
        if settings.weighing == "scratch" and settings.weigh_before_resampling:
            log = boltzmann(total, settings.peakiness)
            if fresh.log_weights.requires_grad:  # the slope of the weights before, whose value is 1
                log = log + (fresh.log_weights - fresh.log_weights.detach())
            fresh = fresh.reweighted(log)
        return fresh
