"""Volume, centroid and inertia of the inside of a signed distance function."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from sdf.base import SDF

_CHUNK = 1 << 18
_NODES = 100  # along the diagonal of the bounds


class Solid(NamedTuple):
    """A body of even density, float64.

    Attributes:
        volume: m^3.
        center: (3,), centre of mass, metres.
        inertia: (3, 3), about that centre and for one kilogram, m^2.
    """

    volume: float
    center: Float[Tensor, "3"]
    inertia: Float[Tensor, "3 3"]


def solid(sdf: SDF, spacing: float | None = None) -> Solid:
    """Sums over a lattice; right for any SDF whose sign is, so also for one of a mesh with holes.

    A cell that the surface passes counts in part, by the distance of its middle: exact where the surface is flat and
    along the axes.

    Args:
        sdf: of the object.
        spacing: of the lattice, metres; by default a hundredth of the diagonal of the SDF's bounds. A wall thinner than
            that counts as up to twice as thick.

    Raises:
        ValueError: there is nothing inside.
    """
    low, high = sdf.bounds.detach().double().cpu()
    step = sdf.diagonal / _NODES if spacing is None else spacing
    axes = []
    for start, end in zip(low.tolist(), high.tolist(), strict=True):
        count = max(1, round((end - start) / step)) + 2
        # evenly about the middle, beyond the bounds on both sides
        axes.append(0.5 * (start + end) + step * (torch.arange(count, dtype=torch.float64) - 0.5 * (count - 1)))
    total = torch.zeros(10, dtype=torch.float64)
    middle = 0.5 * (low + high)
    for part in torch.cartesian_prod(*axes).split(_CHUNK):
        with torch.no_grad():
            distance = sdf.distance(part.to(sdf.bounds)).to(part)
        share = (0.5 - distance / step).clamp(0.0, 1.0)
        place = part - middle
        first = share @ place
        second = (share[:, None] * place).mT @ place
        total += torch.cat((share.sum()[None], first, second[*torch.triu_indices(3, 3)]))
    if not total[0] > 0:
        raise ValueError(f"Expected something inside the surface, found nothing every {step:g} m within its bounds")
    mean = total[1:4] / total[0]
    moments = torch.zeros(3, 3, dtype=torch.float64)
    moments[*torch.triu_indices(3, 3)] = total[4:] / total[0]
    spread = moments + moments.triu(1).mT - mean[:, None] * mean + step**2 / 12.0 * torch.eye(3, dtype=torch.float64)
    inertia = spread.trace() * torch.eye(3, dtype=torch.float64) - spread
    return Solid(float(total[0]) * step**3, middle + mean, inertia)
