"""Reinitialisation: new particles by all evidence, at the first contact and to verify a sure belief."""

from dataclasses import dataclass, field, replace
from typing import Annotated

import torch
from annotated_types import Gt
from jaxtyping import Float, Int
from torch import Tensor

from rumi.belief.particles import PoseBelief
from rumi.belief.pose_filter import PoseFilter
from rumi.belief.prior import PosePrior
from rumi.registration.archive import fill
from rumi.registration.descent import DescentSettings, retract
from rumi.registration.register import RegisterSettings, pose_cells, register, subsample
from rumi.seeding import Generators, normal
from rumi.weights import boltzmann
from sdf import se3
from sdf.bounds import Checked, Count, ShareAbove0
from sensors.evidence import Evidence, in_attached_frame
from sensors.observation import Observation, concatenate
from sensors.semantics import Semantics

_FREE = 4000  # points that are no surface, by which poses are refined
_STEPS = [(0.005 * 0.8**k, 0.1 * 0.8**k) for k in range(12)]
"""Metres and radians of the steps by which poses are refined, one after the other."""


@dataclass(frozen=True)
class ReinitialiseSettings(Checked):
    """Settings of reinitialisation from the prior; without a prior there is none.

    A resampling can lose a mode that no observation refutes, and the optimiser does not find it again.

    Attributes:
        at_contact: draw anew at the first contact: particles from before it stand too far apart to fit it.
        challenge: before the run stops, put poses drawn anew beside the particles; it stops if they leave it sure.
        starts: poses drawn from the prior.
        coarse: descent of these on the felt points alone.
        polished: poses that go on to the fine descent.
        fine: descent of those on all points.
        bin_rad, bin_m: cells of orientation and place, each of which keeps its best pose.
        plausible: least weight, relative to the best pose's, of a pose that is kept.
    """

    at_contact: bool = True
    challenge: bool = True
    starts: Count = 1500
    coarse: DescentSettings = field(default_factory=lambda: DescentSettings(iterations=5, margin_m=0.05))
    polished: Count = 400
    fine: DescentSettings = field(default_factory=lambda: DescentSettings(iterations=6, margin_m=0.02))
    bin_rad: Annotated[float, Gt(0.0)] = 0.26
    bin_m: Annotated[float, Gt(0.0)] = 0.02
    plausible: ShareAbove0 = 0.02

    @classmethod
    def never(cls) -> "ReinitialiseSettings":
        """The paper's: particles are drawn once."""
        return cls(at_contact=False, challenge=False)


def prior_belief(
    pose_filter: PoseFilter, memory: Observation, particles: int, *, generator: torch.Generator
) -> PoseBelief:
    """The belief of one scene before anything is felt: poses evenly where the prior has them, weighed by it."""
    belief = PoseBelief.uniform(_prior(pose_filter).spread_poses(particles, generator=generator))
    return _weighed(pose_filter, belief, belief.attached_T_object, pose_filter.total(belief, memory))


def redraw(
    pose_filter: PoseFilter,
    belief: PoseBelief,
    memory: Observation,
    settings: ReinitialiseSettings,
    *,
    generator: torch.Generator,
) -> PoseBelief:
    """As many particles as the belief has, drawn from the prior and registered to all points of one scene."""
    prior = _prior(pose_filter)
    here = in_attached_frame(memory, belief.world_T_attached)
    found = register(
        pose_filter.discrepancy,
        here,
        pose_filter.settings.peakiness,
        RegisterSettings(
            kept=belief.log_weights.shape[-1],
            starts=settings.starts,
            coarse=settings.coarse,
            coarse_points=250,
            coarse_free=0,
            polished=settings.polished,
            fine=settings.fine,
            bin_rad=settings.bin_rad,
            bin_m=settings.bin_m,
            plausible=settings.plausible,
            bins="SE(3)",
        ),
        starts=prior.spread_poses(settings.starts, generator=generator),
        search=pose_filter.search,
        further=lambda poses: pose_filter.prior_and_evidence_cost(poses, belief.evidence),
        settled=lambda poses: refine_poses(pose_filter, poses, here, belief.evidence, generator=generator),
        generator=generator,
    )
    renewed = _weighed(pose_filter, belief, found.frame_T_object, found.discrepancy)
    if not bool(pose_filter.tipped(belief)):
        return renewed
    poses = pose_filter.descend(renewed, here, settings.fine)
    return _weighed(pose_filter, belief, poses, pose_filter.cost(poses, here, belief.evidence))


def verify(
    pose_filter: PoseFilter,
    belief: PoseBelief,
    memory: Observation,
    settings: ReinitialiseSettings,
    *,
    generator: torch.Generator,
) -> PoseBelief:
    """Verify a belief by poses drawn anew beside its particles; of both, all cells that are plausible stay."""
    rivals = redraw(pose_filter, belief, memory, settings, generator=generator)
    poses = torch.cat((belief.attached_T_object, rivals.attached_T_object))
    cost = torch.cat((pose_filter.total(belief, memory), rivals.discrepancy))
    margin = -torch.tensor(settings.plausible).log().item() / pose_filter.settings.peakiness
    kept = _spread(pose_filter, poses, cost, margin, belief.log_weights.shape[-1], settings)
    return _weighed(pose_filter, belief, poses[kept], cost[kept])


def refine_poses(
    pose_filter: PoseFilter,
    attached_T_object: Float[Tensor, "N 4 4"],
    here: Observation,
    evidence: Evidence | None,
    *,
    generator: Generators,
) -> Float[Tensor, "N 4 4"]:
    """Refine poses by all evidence: steps at random, as free as the filter's search, kept where the cost falls.

    Points leave poses free along some ways, where a touch's normal or a signal asks for a place to the millimetre.
    Without evidence beside points they stay as they are.

    Args:
        pose_filter: says what a pose costs.
        attached_T_object: (N, 4, 4), after their descent on points.
        here: points in the attached frame.
        evidence: of other kinds, in the same frame.
        generator: of the steps.
    """
    if evidence is None:
        return attached_T_object
    surface = here.of_class(Semantics.SURFACE)
    here = concatenate([here[surface], subsample(here[here.valid & ~surface], _FREE)])
    poses, cost = attached_T_object, pose_filter.cost(attached_T_object, here, evidence)
    shifts, turns = (2, 1) if pose_filter.search == "SE(2)" else (3, 3)
    for shift_m, turn_rad in _STEPS:
        sigma = torch.tensor([shift_m] * shifts + [turn_rad] * turns).to(poses)
        noise = normal((*poses.shape[:-2], len(sigma)), generator=generator, dtype=poses.dtype, device=poses.device)
        tried = se3.renormalised(retract(poses, sigma * noise, pose_filter.search))
        there = pose_filter.cost(tried, here, evidence)
        better = there < cost
        poses = torch.where(better[..., None, None], tried, poses)
        cost = torch.where(better, there, cost)
    return poses


def _spread(
    pose_filter: PoseFilter,
    poses: Float[Tensor, "N 4 4"],
    cost: Float[Tensor, "N"],
    margin: float | Tensor,
    count: int,
    settings: ReinitialiseSettings,
) -> Int[Tensor, "count"]:
    middle = pose_filter.discrepancy.sdf.bounds.mean(0)
    cells = pose_cells(poses, middle, settings.bin_rad, settings.bin_m, "SE(3)")
    return fill(cells, cost, margin, count)


def _weighed(pose_filter: PoseFilter, belief: PoseBelief, poses: Tensor, cost: Tensor) -> PoseBelief:
    renewed = replace(belief, attached_T_object=poses, discrepancy=cost)
    return renewed.reweighted(boltzmann(cost, pose_filter.settings.peakiness))


def _prior(pose_filter: PoseFilter) -> PosePrior:
    if pose_filter.prior is None:
        raise ValueError("Expected a filter with a prior to draw from, got none: give it one, or renew nothing")
    return pose_filter.prior
