"""A posterior beyond doubt for upright objects: a grid over (x, y, yaw), refined until it stands still."""

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sdf import compiled, se3
from sdf.base import SDF
from sdf.posed import posed_distance
from sdf.primitives import Mug
from sensors.discrepancy import discrepancy_terms
from sensors.observation import Observation
from sensors.semantics import Semantics

LogDensity = Callable[[Float[Tensor, "G 3"]], Float[Tensor, "G"]]
"""Log density, up to a constant, of (x, y, yaw); metres and radians."""

_BLOCK = 512  # poses that share one choice of the free points that may matter


@dataclass(frozen=True, eq=False)
class GridPosterior:
    """Probability mass on the cells of a lattice of (x, y, yaw).

    Attributes:
        planar: (G, 3), centres of the cells, metres and radians in (-pi, pi].
        log_weights: (G,), log of their mass; sums to 1.
        size: (3,), lengths of a cell's edges.
        change: total variation against the lattice with cells twice as long, on whose cells both are compared.
        dropped: bound by estimate of the mass in cells that were left out.
    """

    planar: Float[Tensor, "G 3"]
    log_weights: Float[Tensor, "G"]
    size: Float[Tensor, "3"]
    change: float
    dropped: float

    @property
    def poses(self) -> Float[Tensor, "G 4 4"]:
        """Centres of the cells as upright poses on the floor."""
        return se3.from_planar(self.planar)

    def drawn(self, count: int, *, generator: torch.Generator) -> Float[Tensor, "count 3"]:
        """Independent draws: a cell by its mass, a place in it evenly."""
        index = torch.multinomial(self.log_weights.exp(), count, replacement=True, generator=generator)
        share = torch.rand(count, 3, generator=generator, dtype=self.planar.dtype) - 0.5
        return self.planar[index] + share * self.size


def boltzmann(
    sdf: SDF,
    memory: Observation,
    *,
    peakiness: float = 2.0,
    free_scale: float = 80.0,
    tolerance: float = 0.001,
) -> LogDensity:
    """-lambda C^(X, T) of upright poses over all points of one scene (RUMI, Eqs 3-6 and 10), in the points' dtype.

    Of the free points those are left out that no pose of a block can violate: moving a pose by at most r moves
    distances by at most r, as no distance function is steeper than 1.

    Args:
        sdf: exact, or at least nowhere steeper than 1.
        memory: all points, in the frame of the poses.
        peakiness: lambda, nats per metre.
        free_scale: C.
        tolerance: metres by which a free or occupied point may be violated.
    """
    lever = float(sdf.bounds.abs()[:, :2].amax(0).norm())
    surface = memory.of_class(Semantics.SURFACE)
    kept, hinged = memory.points[surface], memory.points[memory.valid & ~surface]
    kinds = memory.semantics[memory.valid & ~surface]
    sign = torch.where(kinds == Semantics.FREE, 1.0, -1.0).to(hinged)

    totals = _mug_totals(sdf) if isinstance(sdf, Mug) and compiled.supports(kept) else _totals(sdf)

    def log_density(planar: Float[Tensor, "G 3"]) -> Float[Tensor, "G"]:
        result = planar.new_zeros(len(planar))
        for block in _blocks(planar):
            middle = 0.5 * (planar[block].amin(0) + planar[block].amax(0))
            off = planar[block] - middle
            radius = float((off[:, :2].norm(dim=-1) + lever * off[:, 2].abs()).max())
            nearness = sign * posed_distance(sdf, se3.from_planar(middle)[None], hinged)[0]
            near = nearness < radius - tolerance
            result[block] = totals(planar[block], kept, hinged[near], kinds[near], free_scale, tolerance)
        return -peakiness * result

    return log_density


Totals = Callable[[Tensor, Tensor, Tensor, Tensor, float, float], Tensor]


def _totals(sdf: SDF) -> Totals:
    """C^ of upright poses (G, 3), from any distance function."""

    def totals(
        planar: Tensor, surface: Tensor, hinged: Tensor, kinds: Tensor, free_scale: float, tolerance: float
    ) -> Tensor:
        poses = se3.from_planar(planar)
        distance = posed_distance(sdf, poses, hinged)
        hinge = discrepancy_terms(distance, kinds.expand(distance.shape), free_scale, -tolerance)
        return posed_distance(sdf, poses, surface).abs().sum(-1) + hinge.sum(-1)

    return totals


def _mug_totals(mug: Mug) -> Totals:
    """The same of a mug by its closed form, in one kernel."""
    shape = (mug.outer_radius, mug.height, mug.wall, mug.base, mug.tube_radius, mug.ring_radius, mug.half_angle)

    def totals(
        planar: Tensor, surface: Tensor, hinged: Tensor, kinds: Tensor, free_scale: float, tolerance: float
    ) -> Tensor:
        from scripts.bench.reference_numba import mug_totals

        sign = torch.where(kinds == Semantics.FREE, 1.0, -1.0).to(planar)
        result = planar.new_zeros(len(planar))
        arrays = (part.contiguous().numpy() for part in (planar, surface, hinged, sign))
        mug_totals(*arrays, free_scale, tolerance, shape, result.numpy())
        return result

    return totals


def grid_posterior(
    log_density: LogDensity,
    low: tuple[float, float],
    high: tuple[float, float],
    *,
    first: tuple[float, float, float] = (0.004, 0.004, math.radians(4.0)),
    enough: float = 0.01,
    keep: float = 1e-4,
    largest: int = 2_000_000,
    pilot: LogDensity | None = None,
    pilot_margin: float = 30.0,
) -> GridPosterior:
    """Posterior under an even prior over a box and all yaws, on cells halved until halving them changes nothing.

    A cell's mass is its volume times the density at its centre. Before each halving the cells are dropped that
    together hold less than `keep` and touch none that stays.

    Args:
        log_density: of rows (x, y, yaw).
        low: corner of the box, metres.
        high: the opposite corner.
        first: edges of the first cells, metres, metres, radians; about the third is rounded to divide the circle.
        enough: total variation between two lattices, compared on the coarser one's cells, at which to stop.
        keep: mass that may be dropped at each halving.
        largest: number of cells at which to give up.
        pilot: cheap density for the first lattice alone; cells more than `pilot_margin` nats below its best are
            left out before the real one is asked.
        pilot_margin: nats.

    Raises:
        RuntimeError: `largest` cells do not suffice, or the density is not finite.
    """
    size = torch.tensor(first, dtype=torch.float64)
    turns = round(2 * math.pi / float(size[2]))
    size[2] = 2 * math.pi / turns
    shape = [math.ceil((b - a) / float(step)) for a, b, step in zip(low, high, size[:2], strict=True)]
    origin = torch.tensor((*low, -math.pi), dtype=torch.float64)
    index = torch.cartesian_prod(torch.arange(shape[0]), torch.arange(shape[1]), torch.arange(turns))
    if pilot is not None:
        guess = pilot(origin + (index + 0.5) * size)
        index = _with_neighbours(index[guess > guess.max() - pilot_margin], turns)
    before: Tensor | None = None
    parent: Tensor | None = None
    dropped = 0.0
    while True:
        planar = origin + (index + 0.5) * size
        log = log_density(planar)
        if not bool(torch.isfinite(log).all()):
            raise RuntimeError("Expected a finite log density everywhere, got NaN or infinity")
        log = torch.log_softmax(log, 0)
        change = math.inf
        if before is not None and parent is not None:
            mass = torch.zeros_like(before).index_add_(0, parent, log.exp())
            change = 0.5 * float((mass - before).abs().sum())
        if change < enough:
            return GridPosterior(planar, log, size, change, dropped)
        order = log.argsort()
        small = log[order].exp().cumsum(0) < keep
        dropped += float(log[order[small]].exp().sum()) if before is not None else 0.0
        chosen = _with_neighbours(index[order[~small]], turns)
        # cells never seen before start from no mass
        known = {key: row for row, key in enumerate(_keys(index).tolist())}
        rows = [known.get(key, -1) for key in _keys(chosen).tolist()]
        rows_t = torch.tensor(rows)
        before = torch.where(rows_t >= 0, log.exp()[rows_t.clamp_min(0)], torch.zeros(()))
        if 8 * len(chosen) > largest:
            raise RuntimeError(f"Expected {largest} cells to suffice, still changed by {change:.3f}: raise `largest`")
        corners = torch.tensor(list(itertools.product((0, 1), repeat=3)))
        index = (2 * chosen[:, None] + corners).reshape(-1, 3)
        parent = torch.arange(len(chosen)).repeat_interleave(8)
        size, turns = size / 2, turns * 2


def _with_neighbours(index: Int[Tensor, "G 3"], turns: int) -> Int[Tensor, "G2 3"]:
    """The cells and all that share a face with them, yaw going round."""
    steps = torch.cat((torch.zeros(1, 3, dtype=torch.long), torch.eye(3, dtype=torch.long), -torch.eye(3).long()))
    grown = (index[:, None] + steps).reshape(-1, 3)
    grown[:, 2] %= turns
    return torch.unique(grown, dim=0)


def _keys(index: Int[Tensor, "G 3"]) -> Int[Tensor, "G"]:
    shifted = index + (1 << 19)
    return (shifted[:, 0] << 40) | (shifted[:, 1] << 20) | shifted[:, 2]


def _blocks(planar: Float[Tensor, "G 3"]) -> list[Int[Tensor, "B"]]:
    """Rows in groups that lie close together: by yaw, then by place."""
    yaw = torch.round(planar[:, 2] / math.radians(1.0))
    x, y = (torch.round(planar[:, axis] / 0.002) for axis in (0, 1))
    order = torch.arange(len(planar))
    for part in (y, x, yaw):
        order = order[part[order].argsort(stable=True)]
    return list(order.split(_BLOCK))
