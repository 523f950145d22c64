"""A descent as arrays, for the kernel that takes each pose all the way."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rumi.registration.descent import DescentSettings, Search
from rumi.registration.descent_numba import descend as kernel
from sdf.grid_sdf import GridSDF
from sensors.discrepancy import Discrepancy
from sensors.discrepancy_numba import prepare
from sensors.observation import Observation


def descend(
    sdf: GridSDF,
    discrepancy: Discrepancy,
    frame_T_object: Float[Tensor, "*b N 4 4"],
    observation: Observation,
    search: Search,
    settings: DescentSettings,
) -> Float[Tensor, "*b N 4 4"]:
    """What `descent.descend` gives by Gauss-Newton; each pose stops by itself.

    Skipped, with the same result: free and occupied points that a pose cannot violate within the margin, ball by ball.
    """
    points, semantics, valid = observation.points, observation.semantics, observation.valid
    ready = prepare(sdf, frame_T_object, points, semantics, valid)
    kind = ready.poses.dtype.type
    origin = torch.from_numpy(ready.poses)[..., :3, 3]
    centre = 0.5 * (origin.amin(1) + origin.amax(1))
    reach = discrepancy.radius + (origin - centre[:, None]).norm(dim=-1).amax(1)
    result = torch.empty_like(torch.from_numpy(ready.poses))
    passes = np.empty(ready.poses.shape[:2], np.int64)
    kernel(
        *ready,
        kind(float(discrepancy.free_scale)),
        kind(-float(discrepancy.tolerance)),
        kind(settings.margin_m),
        centre.contiguous().numpy(),
        reach.numpy(),
        np.array((0, 1, 5) if search == "SE(2)" else (0, 1, 2, 3, 4, 5)),
        settings.lever_m,
        settings.iterations,
        np.array((settings.step_limit_m, settings.step_limit_rad)),
        settings.enough,
        result.numpy(),
        passes,
    )
    return result.view(frame_T_object.shape)
