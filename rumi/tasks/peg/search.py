"""The first stage: lanes to and fro over the table until the first touch, and a belief over the block's middle."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.belief.static_filter import ResampleMoveFilter, ResampleMoveSettings, StaticBelief, TemperedEvidence
from rumi.information.contact_gain import ContactKind
from rumi.information.neighbours import StateMetric
from rumi.resampling import resample_systematic
from rumi.tasks.peg.cell import Felt
from rumi.tasks.peg.settings import PegSettings
from sensors.touch.circle_touch import CircleTouches
from sensors.touch.rectangle_touch import RectangleTouches

_YAWS = 40
"""Turns that each place of the first stage is tried with where the stages meet."""
_NEGLIGIBLE = 25.0
"""Nats below the best at which a pose is left out there."""


@dataclass(frozen=True)
class Found:
    """How far the search is.

    Attributes:
        felt: of each leg, the first touch last.
        belief: over (x, y).
        circle: evidence of it.
    """

    felt: tuple[Felt, ...]
    belief: StaticBelief
    circle: CircleTouches


def lanes(settings: PegSettings) -> Float[Tensor, "K 2"]:
    """Corners of the way over the table; the first is beside it, so that the ball begins free.

    Lanes at most the block's width and the ball's apart meet every block whose middle is on the table's part.
    """
    length, width = settings.table_m
    count = math.ceil(width / settings.lane_m)
    beside = 0.5 * length + math.hypot(settings.length_m, settings.width_m) / 2.0 + 2.0 * settings.radius_m
    corners = [(-beside, -0.5 * width + 0.5 * width / count)]
    for k in range(count):
        y = -0.5 * width + (k + 0.5) * width / count
        sign = 1.0 if k % 2 == 0 else -1.0
        corners += [(-0.5 * sign * length, y)] if k else []
        corners += [(0.5 * sign * length, y)]
    return torch.tensor(corners, dtype=torch.float64)


def table_prior(settings: PegSettings) -> ResampleMoveFilter:
    """The filter of the first stage: anywhere on the table's part, as likely."""
    size = torch.tensor(settings.table_m, dtype=torch.float64)

    def log_prior(places: Tensor) -> Tensor:
        on = (places.abs() <= 0.5 * size).all(-1)
        return torch.where(on, 0.0, -torch.inf).to(places)

    return ResampleMoveFilter(StateMetric.euclidean(2), log_prior, ResampleMoveSettings(jitter_m=(1e-3, 0.1)))


def start(settings: PegSettings, *, generator: torch.Generator) -> Found:
    """Before anything is felt."""
    size = torch.tensor(settings.table_m, dtype=torch.float64)
    places = (torch.rand(settings.search_particles, 2, generator=generator, dtype=torch.float64) - 0.5) * size
    circle = CircleTouches.none(settings.block.half(), settings.radius_m, settings.point_m)
    return Found((), table_prior(settings).start(places), circle)


def taken_in(found: Found, felt: Felt, settings: PegSettings, *, generator: torch.Generator) -> Found:
    """After one more leg; every leg, free or not, weighs the belief."""
    new, circle = CircleTouches.none(settings.block.half(), settings.radius_m, settings.point_m), found.circle
    for way in free_ways(felt, settings):
        new, circle = new.with_way(*way), circle.with_way(*way)
    if felt.kind != ContactKind.NOTHING:
        new, circle = (part.with_touch(felt.point, felt.normal) for part in (new, circle))
    belief, _ = table_prior(settings).update(found.belief, new, circle, generator=generator)
    return Found((*found.felt, felt), belief, circle)


def free_ways(felt: Felt, settings: PegSettings) -> list[tuple[Tensor, Tensor]]:
    """The level ways of a motion that were free, without those that leave a side, and cut short of a contact.

    Where the ball rests against the block it is not clear of it by any margin: a way from there, or up to there, would
    push the belief off the block. What the sensor may be off by is left out.
    """
    margin = 3.0 * settings.point_m
    found = []
    for number, (start, end) in enumerate(felt.free):
        length = float((end - start).norm())
        begins = felt.leaving and number == 0
        ends = felt.kind != ContactKind.NOTHING and number == len(felt.free) - 1
        left = length - margin * (begins + ends)
        if left > 0:
            along = (end - start) / length
            found.append((start + margin * begins * along, end - margin * ends * along))
    return found


def joined(
    found: Found,
    follow: ResampleMoveFilter,
    every: RectangleTouches,
    settings: PegSettings,
    *,
    generator: torch.Generator,
) -> StaticBelief:
    """The second stage's belief: the first's places with every yaw, weighed by what a rectangle would have felt.

    Where the first stage took a circle for the block, its likelihood is taken out again and the rectangle's put in.
    That of a sensor more exact than these poses are apart is let in little by little.

    Args:
        found: the first stage.
        follow: the second stage's filter.
        every: all readings so far, as of a rectangle.
        settings: of the task.
        generator: of all draws.
    """
    index = resample_systematic(found.belief.log_weights, generator=generator)
    places = found.belief.states[index]
    count = len(places)
    power = settings.power
    offset = torch.rand(count, _YAWS, generator=generator, dtype=places.dtype)
    yaw = (torch.arange(_YAWS, dtype=places.dtype) + offset) / _YAWS * math.pi - 0.5 * math.pi
    poses = torch.cat((places[:, None].expand(-1, _YAWS, -1), yaw[..., None]), -1).reshape(-1, 3)
    rough = power * every.only_touches().log_likelihood(poses)
    keep = rough > rough.max() - _NEGLIGIBLE
    poses = poses[keep]
    first = found.circle.log_likelihood(places)[:, None].expand(-1, _YAWS).reshape(-1)[keep]
    log = power * every.log_likelihood(poses) - first
    picked = resample_systematic(log, settings.particles, generator=generator)
    partly = TemperedEvidence(every, every, power) if power < 1.0 else every
    belief = follow.start(poses[picked], evidence=partly)
    belief, _ = follow.move(belief, partly, ess=float(len(poses)), generator=generator)
    return follow.update_tempered(belief, every, every, power=power, generator=generator)
