"""Nearest-node look-up in a tabulated SDF: what rumi does not do, for comparison."""

import torch
from jaxtyping import Float
from torch import Tensor

from sdf.base import SDF
from sdf.grid_sdf import GridSDF


class NearestGrid(SDF):
    """The value at the node next to a point, with no gradient; beyond the lattice, that plus the way to it.

    Args:
        grid: whose table is looked up.
    """

    def __init__(self, grid: GridSDF) -> None:
        super().__init__(grid.bounds.clone())
        self.grid = grid

    def distance(self, points_o: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
        """Value (*b) of the nearest node, metres."""
        grid, flat = self.grid, torch.zeros(points_o.shape[:-1], dtype=torch.long, device=points_o.device)
        beyond = points_o.new_zeros(points_o.shape[:-1])
        for plane, start, count in zip(points_o.unbind(-1), grid.origin, grid.values.shape, strict=True):
            last = count - 1 - 2 * grid.outer
            fine = (plane - start) / grid.spacing
            over = (fine - fine.clamp(0.0, last)) * (grid.spacing / grid.outer_spacing)
            place = fine.clamp(0.0, last) + over + grid.outer
            kept = place.clamp(0.0, count - 1.0)
            beyond = beyond + ((place - kept) * grid.outer_spacing).square()
            flat = flat * count + torch.round(kept).long()
        return grid.values.reshape(-1)[flat] + beyond.sqrt()
