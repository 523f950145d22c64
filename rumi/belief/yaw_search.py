"""Search of start poses all round: the likeliest place at each yaw, by grids that become finer."""

import math
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.belief.pose_trajectories import Trajectories
from rumi.belief.pushed_model import Pushed
from rumi.belief.trajectory_history import History
from rumi.belief.trajectory_settings import PoseTrajectorySettings

_YAWS = 72
_GRIDS = ((4, 0.005), (2, 0.002), (2, 0.0007))  # steps to each side, and metres of a step


def all_round(
    fitted: Float[Tensor, "F 3"], history: History, model: Pushed, own: PoseTrajectorySettings
) -> Float[Tensor, "72 3"]:
    """The likeliest place of an upright object at each of many yaws, by what was sensed while it stood still.

    Registration follows a discrepancy of its own, which a view that is off may lead past the right yaw.

    Args:
        fitted: poses by registration, about whose middle is searched.
        history: the view.
        model: object and tool.
        own: of the sensors.
    """
    exact = replace(
        own, tool_off_m=0.0, tool_off_rad=0.0, worn=(0.0, 0.0), size_off=0.0, view_off_m=0.0, view_off_rad=0.0
    )
    yaw = torch.arange(_YAWS, dtype=torch.float64) * (2.0 * math.pi / _YAWS)
    best = torch.cat((fitted[:, :2].median(0).values.expand(_YAWS, 2), yaw[:, None]), -1)
    for steps, metres in _GRIDS:
        side = metres * torch.arange(-steps, steps + 1, dtype=torch.float64)
        shift = torch.cat((torch.cartesian_prod(side, side), torch.zeros(len(side) ** 2, 1)), -1)
        tried = (best[:, None] + shift).flatten(0, 1)
        given = Trajectories.still(tried, history)
        given = given.replayed(model, exact, history, torch.zeros(len(tried), dtype=torch.long))
        found = given.log_likelihood.sum(-1).view(_YAWS, -1).argmax(-1)
        best = best + shift[found]
    return best
