"""Marginal likelihood of an action under another motion prior, or of part of what it sensed.

Sequential Monte Carlo from the belief before the action, with physics and noise drawn afresh from the filter's prior,
through the action's segments. With a much wider prior of how the object slides (`PoseTrajectoryFilter.doubting`) it
tells whether the push model is what is wrong: where pushes go as expected the ordinary prior predicts each by some nats
better.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.belief.pose_trajectories import Trajectories
from rumi.belief.pose_trajectory_filter import PoseTrajectoryFilter
from rumi.belief.trajectory_history import History
from rumi.resampling import systematic
from rumi.weights import equal_weights


def predicted(
    before: Trajectories,
    log_weights: Float[Tensor, "N"],
    history: History,
    pose_filter: PoseTrajectoryFilter,
    generator: torch.Generator,
) -> Trajectories:
    """Particles after an action, with the log marginal likelihood of its readings.

    Args:
        before: particles before the action.
        log_weights: of them.
        history: the action alone.
        pose_filter: of whose prior the action is.
        generator: of the draws.
    """
    rows = systematic(log_weights.double(), 0.5, len(before))
    start, errors = before.pose[rows].clone(), before.systematic[rows]
    now = Trajectories.drawn(start, History.empty(history.tool.shape[-1]), generator, systematic=errors)
    return followed(now, history, pose_filter, generator)


def followed(
    now: Trajectories, history: History, pose_filter: PoseTrajectoryFilter, generator: torch.Generator
) -> Trajectories:
    """Particles, equally weighted, that have some of an action's segments behind them, after the others.

    Args:
        now: particles, whose history is the first of these segments.
        history: the action alone.
        pose_filter: of whose prior the action is.
        generator: of the draws.
    """
    weights, last = equal_weights(len(now)), len(history) - 1
    for number in range(len(now.history), len(history)):
        segment, opens = history.segment(number), int(history.action[number]) == number
        closes = number == last or int(history.action[number + 1]) == number + 1
        now, weights = pose_filter.with_segment(now, weights, segment, generator, opens=opens, closes=closes)
    return now
