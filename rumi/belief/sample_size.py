"""Sample size of a particle filter by the Kullback-Leibler distance (KLD-sampling; Fox 2003).

Of a distribution over k cells as many draws as this have, with a probability of 99 %, an empirical distribution within
a given Kullback-Leibler distance of it: a belief that has settled needs few of the particles that a prior does.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.belief.trajectory_settings import PoseTrajectorySettings
from rumi.belief.trajectory_starts import is_narrow
from rumi.resampling import systematic

_QUANTILE = 2.326  # of a standard normal, at 99 %
_FEWER, _SPARE = 3, 1.3  # times fewer where it is narrow, without a sampling error; times that are no harm, with one
_CELL = (0.005, 0.005, 0.1, 1.0, 1.0, 0.1)  # metres, metres, radians; resting pose, edge; radians of tilt


def kld_sample_size(cells: int, error: float) -> int:
    """Draws of a distribution over some cells that come within a Kullback-Leibler distance of it; 1 of one cell.

    Args:
        cells: k, in which there is something.
        error: the distance, in nats, above 0.
    """
    if cells <= 1:
        return 1
    spare = 2.0 / (9.0 * (cells - 1))
    return math.ceil((cells - 1) / (2.0 * error) * (1.0 - spare + math.sqrt(spare) * _QUANTILE) ** 3)


def occupied_cells(poses: Float[Tensor, "N 6"]) -> int:
    """Number of cells of 5 mm, 5 mm and .1 rad in which poses lie, by resting pose, edge and tilt.

    Poses that symmetries map to each other lie in cells of their own.
    """
    cells = (poses / poses.new_tensor(_CELL)).round().long()
    low = cells.amin(0)
    spans = (cells.amax(0) - low + 1).tolist()
    strides = [math.prod(spans[k + 1 :]) for k in range(len(spans))]
    if math.prod(spans) < 2**62:
        return len(torch.unique(((cells - low) * torch.tensor(strides)).sum(-1)))
    return len(torch.unique(cells, dim=0))


def particles_wanted(
    poses: Float[Tensor, "M 6"], log_weights: Float[Tensor, "M"], own: PoseTrajectorySettings, shown: int
) -> tuple[int, int]:
    """Sample size of a particle filter, at least and at most: by KLD-sampling, or by whether it is narrow.

    Args:
        poses: of its particles.
        log_weights: of them.
        own: the settings.
        shown: draws by which it is narrow or not.
    """
    many, error = own.unseen_particles, own.sampling_error
    if error == 0:
        narrow = is_narrow(poses[systematic(log_weights, 0.5, min(shown, len(poses)))])
        count = max(1, many // _FEWER) if narrow else many
        return count, count
    cells = occupied_cells(poses[systematic(log_weights, 0.5, many)])
    count = min(many, max(own.fewest_particles, kld_sample_size(cells, error)))
    return count, int(_SPARE * count)
