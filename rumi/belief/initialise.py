"""Initial belief: all plausible poses of the object under the first view."""

import math
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.belief.particles import PoseBelief
from rumi.belief.prior import kronecker_sequence
from rumi.registration.descent import DescentSettings, Search
from rumi.registration.register import RegisterSettings, register
from rumi.weights import boltzmann
from sdf import se3
from sdf.bounds import Checked, Count, ShareAbove0
from sensors.discrepancy import Discrepancy
from sensors.observation import Observation


@dataclass(frozen=True)
class InitialiseSettings(Checked):
    """Settings of the initial belief.

    Attributes:
        particles: P, number of pose particles.
        starts: poses that the descent starts from.
        coarse: descent of all starts, on a sample of the surface points alone.
        coarse_points: size of that sample.
        polished: poses that go on to the fine descent.
        fine: descent of those on all points.
        bin_rad: width of the archive's orientation bins.
        plausible: least weight, relative to the best pose's, of a pose that is kept.
    """

    particles: Count = 100
    starts: Count = 2000
    coarse: DescentSettings = field(default_factory=lambda: DescentSettings(iterations=8))
    coarse_points: int = 250
    polished: Count = 300
    fine: DescentSettings = field(default_factory=lambda: DescentSettings(iterations=10))
    bin_rad: float = 0.0873
    plausible: ShareAbove0 = 0.01


def view_starts(
    surface: Float[Tensor, "S 3"], count: int, reach_m: float, height_m: float, *, generator: torch.Generator
) -> Float[Tensor, "count 4 4"]:
    """Upright starts: every yaw, origins spread over a disc about the seen points' centre.

    Several origins, since one view shows one side only: an origin a wall too near is a local minimum.

    Args:
        surface: seen surface points.
        count: how many starts.
        reach_m: radius of the disc: as far as the object's origin can be from its surface.
        height_m: z of the origin of an upright object.
        generator: shifts the spread.
    """
    index = torch.arange(count, dtype=surface.dtype, device=surface.device)
    share = kronecker_sequence(index, generator=generator)
    angle, radius = 2 * torch.pi * share[:, 1], reach_m * share[:, 2].sqrt()
    centre = 0.5 * (surface.amin(0) + surface.amax(0))
    planar = torch.stack(
        (centre[0] + radius * angle.cos(), centre[1] + radius * angle.sin(), 2 * torch.pi * share[:, 0] - torch.pi), -1
    )
    return se3.from_planar(planar, height_m)


def initialise(
    discrepancy: Discrepancy,
    observation: Observation,
    starts: Float[Tensor, "N 4 4"],
    search: Search,
    peakiness: float | Tensor,
    settings: InitialiseSettings,
    *,
    generator: torch.Generator,
) -> PoseBelief:
    """Particles over all plausible poses of one scene, in the manner of CHSEL (RUMI, Alg 1, line 2).

    All starts descend on a sample of the surface points, the best of every orientation bin descend on
    all points, and the elites of the archive that are plausible fill the belief evenly over orientation. The
    weights are Eq 10's. The attached frame starts as the world.

    Args:
        discrepancy: C^.
        observation: the first view, world frame.
        starts: poses to start from.
        search: "SE(2)" or "SE(3)".
        peakiness: lambda, nats per metre of discrepancy.
        settings: counts.
        generator: draws the sample of points.
    """
    found = register(
        discrepancy,
        observation,
        peakiness,
        RegisterSettings(
            kept=settings.particles,
            starts=len(starts),
            coarse=settings.coarse,
            coarse_points=settings.coarse_points,
            coarse_free=0,
            polished=settings.polished,
            fine=settings.fine,
            bin_rad=settings.bin_rad,
            bin_m=math.inf,
            plausible=settings.plausible,
        ),
        starts=starts,
        search=search,
        generator=generator,
    )
    belief = PoseBelief.uniform(found.frame_T_object)
    return replace(belief, discrepancy=found.discrepancy).reweighted(boltzmann(found.discrepancy, peakiness))
