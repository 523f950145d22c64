"""Expected information gain of a motion by touch, exact over both outcomes of a binary reading (touch-only, Alg 1)."""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rumi.information.entropy import SharedSupport
from rumi.weights import check_weights
from sdf.batch import broadcast_shapes
from sdf.check import check_shape, is_eager


def binary_gain(log_weights: Float[Tensor, "*#b N"], probability: Float[Tensor, "*#b N"]) -> Float[Tensor, "*b"]:
    """Entropy of the weights, nats, that one binary reading is expected to take away, in O(N) (Eqs 7-8).

    It is the mutual information of reading and state.

    The paper lets every particle in turn be the truth, which takes O(N^2) and one draw of the reading each; a binary
    reading leads to two posteriors only, and both are worked out. An outcome that cannot happen counts nothing.

    Args:
        log_weights: of the states, normalised or not.
        probability: that the reading says contact, for each state.

    Raises:
        ValueError: see `rumi.weights.check_weights`.
    """
    check_weights(log_weights)
    log = log_weights.log_softmax(-1)
    weights = log.exp()
    # the gain is the mean divergence of a state's outcome from the mean one: as a difference of the two entropies,
    # which are larger by far, it would be lost to rounding
    shape = broadcast_shapes(log.shape, probability.shape)
    weights, probability = weights.expand(shape), probability.expand(shape)
    gain = weights.new_zeros(shape[:-1])
    for chance in (probability, 1.0 - probability):
        mean = (weights * chance).sum(-1, keepdim=True)
        held = (weights * chance > 0) & (mean > 0)
        apart = chance - mean
        # the log of a ratio near 1 from how far it is from there, of any other as the difference of logs
        close = held & (apart.abs() < 0.5 * mean)
        near = torch.where(close, apart / torch.where(close, mean, 1.0), 0.0).log1p()
        log_ratio = torch.where(close, near, torch.where(held, chance, 1.0).log() - torch.where(held, mean, 1.0).log())
        # p log(p / q) - (p - q), of which the second part adds up to nothing
        gain = gain + (weights * (torch.where(held, chance * log_ratio, 0.0) - apart)).sum(-1)
    return gain


class ExpectedGain(NamedTuple):
    """Expected information gain of candidate motions; entry t of a step axis is after t + 1 steps.

    Attributes:
        weights: (C, T), gain of the weights term, which one reading at that step brings.
        volume: (C, T), gain of the density term, which the motion until then brings.
        best_step: (C), steps after which a candidate's gain is highest, and at which it is cut off; 0 for staying.
        value: (C), gain there, 0 or more.
    """

    weights: Float[Tensor, "C T"]
    volume: Float[Tensor, "C T"]
    best_step: Int[Tensor, "C"]
    value: Float[Tensor, "C"]


def expected_gain(
    states: Float[Tensor, "C T1 N D"],
    log_weights: Float[Tensor, "N"],
    probability: Float[Tensor, "C T N"],
    support: SharedSupport | None,
    *,
    every: int = 1,
) -> ExpectedGain:
    """Entropy that candidate motions are expected to take away, one reading at the best step each (Alg 1, corrected).

    The reading at a step updates the weights as they are now, as if none had come before. As printed, the weights
    entropy takes the states before the step, not those after it, and a motion that only loses is returned all the
    same; here there is "stay", worth 0.

    Skipped, with the same result: the density term of steps at which no particle of a candidate moved.

    Args:
        states: of the particles now and after each step, for each candidate.
        log_weights: of the particles now.
        probability: of reading contact after each step.
        support: gives the density term; None leaves it out (the weights-only ablation).
        every: steps from one density term to the next; those between take the one before (1 is exact).
    """
    check_shape("probability", probability, "(C, T, N)", last=(states.shape[1] - 1, states.shape[2]))
    if every < 1:
        raise ValueError(f"Expected every to be 1 or more, got {every}")
    weights = binary_gain(log_weights, probability)
    volume = torch.zeros_like(weights)
    if support is not None and weights.numel() > 0:
        volume = _volume_gain(states, log_weights, support, every)
    total = weights + volume
    if total.shape[1] == 0:
        nothing = total.new_zeros(len(total))
        return ExpectedGain(weights, volume, nothing.long(), nothing)
    value, step = total.max(-1)
    gains = value > 0
    best_step = torch.where(gains, step + 1, 0)
    value = torch.where(gains, value, 0.0)
    return ExpectedGain(weights, volume, best_step, value)


def _volume_gain(
    states: Float[Tensor, "C T1 N D"], log_weights: Float[Tensor, "N"], support: SharedSupport, every: int
) -> Float[Tensor, "C T"]:
    candidates, instants = states.shape[:2]
    moved = (states[:, 1:] != states[:, :-1]).flatten(2).any(-1)
    instant = torch.arange(instants, device=states.device)
    # the density terms that are worked out: the start's, and those of later steps at which something had moved
    changed = torch.nn.functional.pad(moved.long().cumsum(1), (1, 0))
    never = torch.zeros_like(changed[:, 0], dtype=torch.bool)
    looked = [index % every == 0 or index == instants - 1 for index in range(instants)]
    before = [max(0, (index - 1) // every * every) for index in range(instants)]
    columns = [changed[:, k] != changed[:, before[k]] if looked[k] and k else never for k in range(instants)]
    since = torch.stack(columns, 1)
    # where nothing was worked out, the last that was holds
    latest = torch.where(since, instant, torch.zeros_like(instant)).cummax(1).values
    if not is_eager():  # what is traced works all out
        log_volume = support(states, log_weights).log_volume
        return log_volume[:, :1] - log_volume.gather(1, latest)[:, 1:]
    if bool((states[:, 0] == states[:1, 0]).all()):
        start = support(states[0, 0], log_weights).log_volume.expand(candidates)
    else:
        start = support(states[:, 0], log_weights).log_volume
    log_volume = start[:, None].expand(candidates, instants).clone()
    rows = since.nonzero(as_tuple=True)
    if len(rows[0]):
        log_volume[rows] = support(states[rows], log_weights).log_volume
    return start[:, None] - log_volume.gather(1, latest)[:, 1:]
