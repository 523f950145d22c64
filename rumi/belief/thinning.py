"""A belief with fewer particles, for work that there is no time to do with all of them."""

from dataclasses import replace

import torch

from rumi.belief.particles import PoseBelief


def thinned(belief: PoseBelief, count: int) -> PoseBelief:
    """One scene's belief with at most `count` particles, evenly by weight; itself if it has no more.

    Nothing is random: each particle counts as often as teeth of the comb (k + 1/2) / count fall on it.
    """
    if count < 1:
        raise ValueError(f"Expected count to be 1 or more, got {count}")
    if count >= belief.log_weights.shape[-1]:
        return belief
    # float64: see `systematic`
    cumulated = torch.softmax(belief.log_weights.double(), -1).cumsum(-1)
    comb = (torch.arange(count, dtype=torch.float64, device=cumulated.device) + 0.5) / count * cumulated[-1]
    teeth = torch.searchsorted(cumulated, comb).clamp_max(len(cumulated) - 1)
    index, times = teeth.unique_consecutive(return_counts=True)
    return replace(
        belief,
        attached_T_object=belief.attached_T_object[index],
        log_weights=torch.log_softmax(times.to(belief.log_weights).log(), -1),
        discrepancy=belief.discrepancy[index],
    )
