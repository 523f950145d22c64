"""Global registration: all plausible poses of an object under points, by starts, descent and an orientation archive."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Annotated, NamedTuple

import torch
from annotated_types import Gt
from jaxtyping import Float, Int
from torch import Tensor

from rumi.registration.archive import fill, orientation_bins, super_fibonacci
from rumi.registration.descent import DescentSettings, Search, descend
from rumi.seeding import uniform
from sdf import se3
from sdf.bounds import Checked, Count, ShareAbove0
from sdf.check import check_near
from sensors.discrepancy import Discrepancy
from sensors.observation import Observation, concatenate
from sensors.semantics import Semantics


@dataclass(frozen=True)
class RegisterSettings(Checked):
    """Settings of global registration.

    Attributes:
        kept: number of poses that are kept.
        starts: poses that the descent starts from.
        coarse: descent of all starts, on a sample of the points.
        coarse_points: surface points in that sample.
        coarse_free: free and occupied points in it; none by default, since seen surfaces are mostly enough.
        polished: poses that go on to the fine descent.
        fine: descent of those on all points.
        bin_rad: width of the archive's cells, in orientation.
        bin_m: their width in the place of the object's middle, metres; infinite for orientation alone. Where more
            cells are plausible than poses are kept, poses are kept instead that lie as far apart, by these widths,
            as leaves none out.
        plausible: least weight, relative to the best pose's, of a pose that is kept.
        bins: orientations that the archive's cells divide: "SE(2)" those about the upright axis, "SE(3)" all; None for
            those that the search may reach.
    """

    kept: Count = 100
    starts: Count = 32000
    coarse: DescentSettings = field(default_factory=lambda: DescentSettings(iterations=12, margin_m=0.05))
    coarse_points: int = 100
    coarse_free: int = 100
    polished: Count = 8000
    fine: DescentSettings = field(default_factory=lambda: DescentSettings(iterations=20, margin_m=0.05))
    bin_rad: Annotated[float, Gt(0.0)] = 0.35
    bin_m: Annotated[float, Gt(0.0)] = 0.02
    plausible: ShareAbove0 = 0.007
    bins: Search | None = None


class Registered(NamedTuple):
    """Plausible poses; where there are few of them, some come more than once.

    Attributes:
        frame_T_object: (P, 4, 4).
        discrepancy: (P,).
    """

    frame_T_object: Float[Tensor, "P 4 4"]
    discrepancy: Float[Tensor, "P"]


def uniform_starts(
    observation: Observation, bounds: Float[Tensor, "2 3"], count: int, *, generator: torch.Generator
) -> Float[Tensor, "count 4 4"]:
    """Starts evenly over all orientations, at each of which the points' middle lies somewhere in the object's box.

    Args:
        observation: of one scene; the middle is that of the surface and occupied points, of all where there are none.
        bounds: (2, 3), metres, box of the object in its own frame.
        count: how many starts.
        generator: turns the spread of orientations and draws the places.
    """
    touching = observation.valid & (observation.semantics != Semantics.FREE)
    points = observation.points[touching if bool(touching.any()) else observation.valid]
    if len(points) == 0:
        raise ValueError("Expected an observation with points to register, got none")
    draw = uniform((count + 1, 3), generator=generator, dtype=torch.float64, device=points.device)
    # a spread of its own for every seed: all of it turned alike, by a rotation drawn evenly
    turn = super_fibonacci(997, draw)[int(draw[count, 0] * 997)]
    rotation = (turn @ super_fibonacci(count, draw)).to(points)
    middle = 0.5 * (points.amin(0) + points.amax(0))
    low, high = bounds.to(points)
    place = low + draw[:count].to(points) * (high - low)
    return se3.make(rotation, middle - (rotation @ place[..., None])[..., 0])


def register(
    discrepancy: Discrepancy,
    observation: Observation,
    peakiness: float | Tensor,
    settings: RegisterSettings | None = None,
    *,
    starts: Float[Tensor, "N 4 4"] | None = None,
    search: Search = "SE(3)",
    further: Callable[[Float[Tensor, "N 4 4"]], Float[Tensor, "N"]] | None = None,
    settled: Callable[[Float[Tensor, "N 4 4"]], Float[Tensor, "N 4 4"]] | None = None,
    generator: torch.Generator,
) -> Registered:
    """Plausible poses of one scene under its points alone, spread over all orientations that are plausible.

    In the manner of CHSEL: all starts descend on a sample of the points, the best of every orientation bin on
    all points, and the archive's plausible elites are kept round robin, so that no mode is lost for another's sake.

    Args:
        discrepancy: C^.
        observation: one scene's.
        peakiness: lambda, nats per metre of discrepancy: what is plausible weighs `settings.plausible` of the best.
        settings: counts.
        starts: poses to start from; `uniform_starts` by default.
        search: "SE(2)" or "SE(3)".
        further: what to add to the discrepancy of poses, such as a prior's part.
        settled: what to move poses by after the fine descent, such as towards what `further` asks of them.
        generator: draws the starts and the sample of points.

    Raises:
        ValueError: surface points so far from the origin that rounding moves them (`sdf.check.check_near`).
    """
    settings = settings or RegisterSettings()
    check_near("the observation's surface points", observation.points[observation.of_class(Semantics.SURFACE)])
    if starts is None:
        starts = uniform_starts(observation, discrepancy.sdf.bounds, settings.starts, generator=generator)
    check_near("starts", starts[..., :3, 3])
    surface = observation.of_class(Semantics.SURFACE).nonzero()[:, 0]
    others = (observation.valid & (observation.semantics != Semantics.SURFACE)).nonzero()[:, 0]
    sample = drawn(observation, surface, settings.coarse_points, generator=generator)
    scale = len(surface) / max(len(sample), 1)
    seen = sample
    if settings.coarse_free:
        seen = concatenate([sample, drawn(observation, others, settings.coarse_free, generator=generator)])
    poses = descend(discrepancy, starts, seen, search, settings.coarse)
    # the sample stands for all surface points, the free points for themselves
    free = subsample(observation[others], 8000)
    coarse = scale * discrepancy(poses, sample) + discrepancy(poses, free) * (len(others) / max(len(free), 1))
    if further is not None:
        coarse = coarse + further(poses)
    middle = discrepancy.sdf.bounds.mean(0)
    spread: Search = settings.bins or search
    cells = pose_cells(poses, middle, settings.bin_rad, settings.bin_m, spread)
    best = fill(cells, coarse, math.inf, min(settings.polished, len(poses)))
    poses = descend(discrepancy, poses[best], observation, search, settings.fine)
    if settled is not None:
        poses = settled(poses)
    fine = discrepancy(poses, observation)
    if further is not None:
        fine = fine + further(poses)
    margin = -math.log(settings.plausible) / peakiness
    plausible = fine <= fine.min() + margin
    cells = pose_cells(poses, middle, settings.bin_rad, settings.bin_m, spread)
    if len(cells[plausible].unique()) > settings.kept:
        # best first alone, differences of fit that mean nothing would decide which cells are left out
        cells[plausible] = net(poses[plausible], fine[plausible], middle, settings)
    chosen = fill(cells, fine, margin, settings.kept)
    return Registered(poses[chosen], fine[chosen])


def pose_cells(
    frame_T_object: Float[Tensor, "N 4 4"],
    middle_o: Float[Tensor, "3"],
    width_rad: float,
    width_m: float,
    search: Search,
) -> Int[Tensor, "N"]:
    """Cell of each pose: of its orientation and of where it has the object's middle; numbers mean nothing else."""
    bins = orientation_bins(frame_T_object[:, :3, :3], width_rad, search)
    if not math.isfinite(width_m):
        return bins
    places = se3.apply(frame_T_object, middle_o.to(frame_T_object).expand(len(frame_T_object), 1, 3))[:, 0]
    places = torch.floor((places - places.amin(0)) / width_m).long()
    return torch.unique(torch.cat((bins[:, None], places), -1), dim=0, return_inverse=True)[1]


def net(
    frame_T_object: Float[Tensor, "N 4 4"],
    discrepancy: Float[Tensor, "N"],
    middle_o: Float[Tensor, "3"],
    settings: RegisterSettings,
) -> Int[Tensor, "N"]:
    """Which of at most `settings.kept` of the poses each one lies by, all of them as near to theirs as that allows.

    Best first, each pose that none so far is near to becomes one that others are near to. Near is within a multiple
    of `bin_m` and `bin_rad`, the least, to 3 %, at which no more than `kept` are needed.
    """
    order = torch.argsort(discrepancy, stable=True)
    turns = frame_T_object[order, :3, :3].flatten(1)
    middles = se3.apply(frame_T_object[order], middle_o.to(turns).expand(len(order), 1, 3))[:, 0] / settings.bin_m

    def within(radius: float) -> Tensor | None:
        region = torch.full_like(order, -1)
        left, least = torch.arange(len(order), device=order.device), math.cos(min(radius * settings.bin_rad, math.pi))
        for number in range(settings.kept):
            first = left[0]
            near = (middles[left] - middles[first]).norm(dim=-1) <= radius
            near &= turns[left] @ turns[first] >= 1.0 + 2.0 * least - 1e-5
            near[0] = True
            region[left[near]] = number
            left = left[~near]
            if len(left) == 0:
                return region
        return None

    narrow, wide = 0.0, 1.0
    while (region := within(wide)) is None:
        narrow, wide = wide, 2.0 * wide
    while wide - narrow > 0.03 * wide:
        radius = 0.5 * (narrow + wide)
        found = within(radius)
        if found is None:
            narrow = radius
        else:
            wide, region = radius, found
    labels = torch.empty_like(region)
    labels[order] = region
    return labels


def drawn(observation: Observation, index: Tensor, count: int, *, generator: torch.Generator) -> Observation:
    """At most `count` of the points `index`, drawn without replacement, in their order."""
    # drawn where the generator lives, which need not be where the points are
    shuffled = torch.randperm(len(index), generator=generator, device=generator.device).to(index.device)
    return observation[index[shuffled[:count]].sort().values]


def subsample(observation: Observation, count: int) -> Observation:
    """At most `count` of the points, evenly over their order."""
    if len(observation) <= count:
        return observation
    return observation[torch.linspace(0, len(observation) - 1, count, device=observation.points.device).long()]
