"""A `GridSDF` as the arrays that fused CPU kernels take; `grid_numba.py` says how."""

from typing import TypeGuard

import numpy as np
import torch
from torch import Tensor

from sdf.base import SDF
from sdf.grid_sdf import GridSDF

# lattices of more nodes than 32 bits can count are left to the plain version
_MOST_NODES = 2**31 - 1

Arrays = tuple[np.ndarray, ...]


def takes(sdf: SDF, *tensors: Tensor) -> TypeGuard[GridSDF]:
    """Whether the fused look-ups can: the SDF is a table, not too large, and the tensors are of one float type."""
    return isinstance(sdf, GridSDF) and sdf.values.numel() <= _MOST_NODES and len({t.dtype for t in tensors}) == 1


def grid_arguments(sdf: GridSDF, dtype: torch.dtype) -> Arrays:
    """Values (X * Y * Z), numbers of the lattice (15), both of `dtype`, and sizes (3): what look-ups take."""
    numbers, sizes = _numbers(sdf)
    flat = sdf.values.detach().to(dtype).contiguous().view(-1)
    return flat.numpy(), torch.tensor(numbers, dtype=dtype).numpy(), np.array(sizes)


def layer_arguments(sdf: GridSDF, z: float | Tensor, dtype: torch.dtype) -> Arrays:
    """The layer at a height (X * Y), its slopes along z (X * Y), and (offset, rate) along z, all of `dtype`.

    Args:
        sdf: the table.
        z: height in the object frame, metres.
        dtype: of the arrays.
    """
    height = torch.as_tensor(z, dtype=dtype).detach()
    layer, rise, level = sdf.layer(height)
    return layer.view(-1).numpy(), rise.view(-1).numpy(), level.numpy()


def _numbers(sdf: GridSDF) -> tuple[list[float], list[int]]:
    """What `lattice_of` expects, in its order, and the table's sizes."""
    scale = 1.0 / sdf.spacing
    ratio = sdf.spacing / sdf.outer_spacing if sdf.outer else 1.0
    sizes = list(sdf.values.shape)
    numbers = [
        scale,
        *(sdf.outer - start * scale for start in sdf.origin),
        float(sdf.outer),
        *(float(n - 1 - sdf.outer) for n in sizes),
        sdf.outer / ratio,
        ratio,
        sdf.spacing,
        sdf.inset / sdf.spacing,
        *(float(n - 2) for n in sizes),
    ]
    return numbers, sizes
