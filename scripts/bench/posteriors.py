"""The reference posterior of a situation, worked out once and kept."""

import logging
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rumi.belief.pose_filter import FilterSettings
from rumi.resampling import systematic
from scripts.bench.reference import GridPosterior, boltzmann, grid_posterior
from scripts.bench.situations import Situation
from sdf import se3
from sensors.semantics import Semantics

_logger = logging.getLogger(__name__)
_HALF_BOX_M = 0.07  # about the seen points: farther than an origin can be from them


def reference_posterior(here: Situation, folder: Path, enough: float = 0.01) -> GridPosterior:
    """Posterior of the filter's likelihood on a grid, from exact distances and all points, in float64.

    Args:
        here: what was sensed.
        folder: that keeps it; one that is there already is read.
        enough: total variation against the lattice of half as fine at which it is fine enough.
    """
    path = folder / f"reference-{here.name.replace('/', '-')}-{here.digest}-{enough:g}.npz"
    if path.exists():
        with np.load(path) as kept:
            planar, log_weights, size = (torch.from_numpy(kept[name]) for name in ("planar", "log_weights", "size"))
            return GridPosterior(planar, log_weights, size, float(kept["change"]), float(kept["dropped"]))
    _logger.info("working out the reference posterior of %s (minutes, once)", here.name)
    settings, memory = FilterSettings(), here.memory.to(dtype=torch.float64)
    seen = memory.points[memory.of_class(Semantics.SURFACE)]
    low, high = seen[:, :2].amin(0), seen[:, :2].amax(0)
    middle = 0.5 * (low + high)
    some = memory[torch.arange(0, len(memory), 10)]
    density, pilot = (
        boltzmann(
            here.model.exact,
            points,
            peakiness=factor * float(settings.peakiness),
            free_scale=settings.free_scale,
            tolerance=settings.tolerance_m,
        )
        for points, factor in ((memory, 1.0), (some, 10.0))
    )
    (x, y), half = middle.tolist(), _HALF_BOX_M
    found = grid_posterior(density, (x - half, y - half), (x + half, y + half), pilot=pilot, enough=enough)
    folder.mkdir(parents=True, exist_ok=True)
    arrays = [part.numpy() for part in (found.planar, found.log_weights, found.size)]
    arrays += [np.array(found.change), np.array(found.dropped)]
    np.savez(path, **dict(zip(("planar", "log_weights", "size", "change", "dropped"), arrays, strict=True)))  # type: ignore[arg-type]
    return found


def stand_ins(posterior: GridPosterior, count: int, offset: float = 0.5) -> Float[Tensor, "count 4 4"]:
    """Equally weighted poses for the posterior: a comb over its cells in order of yaw and place."""
    x, y, yaw = (posterior.planar / posterior.size).round().long().unbind(-1)
    order = torch.arange(len(posterior.planar))
    for part in (y, x, yaw):
        order = order[part[order].argsort(stable=True)]
    chosen = systematic(posterior.log_weights[order], offset, count)
    return se3.from_planar(posterior.planar[order[chosen]])
