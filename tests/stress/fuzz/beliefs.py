"""Beliefs, fields, entropies and statistics under tensors of any value."""

import math
from collections.abc import Iterable

import torch
from torch import Tensor

from rumi.belief.particles import PoseBelief
from rumi.fields.information import InformationSettings, information_field
from rumi.fields.normal import expected_normal
from rumi.information.binary_gain import binary_gain
from rumi.information.entropy import SharedSupport
from rumi.information.neighbours import StateMetric
from rumi.metrics.likelihood import negative_log_likelihood, self_agreement
from rumi.resampling import resample_systematic
from rumi.weights import boltzmann
from scripts.reproduce.correlation import pearson, run_correlation, spearman
from scripts.reproduce.intervals import bootstrap_median, mcnemar, wilson
from tests.fixtures.channel import channel_capacity
from tests.fixtures.entropies import ENTROPIES, entropies
from tests.stress.fuzz.draw import Draw, choice, log_weights, number, poses, sizes, tensor
from tests.stress.fuzz.entered import out, table, target


@target
def _beliefs(draw: Draw) -> Iterable[Tensor]:
    count = sizes(draw)
    start = PoseBelief.uniform(poses(draw, count))
    wild = draw.integer(0, 1) == 1
    weighed = start.reweighted(log_weights(draw, count, wild=wild).to(start.log_weights))
    cost = tensor(draw, count, wild=wild).abs().to(start.log_weights)
    again = weighed.reweighted(boltzmann(cost, abs(number(draw)) + 1e-9))
    index = resample_systematic(again.log_weights, generator=torch.Generator().manual_seed(0))
    if bool((index < 0).any()) or bool((index >= count).any()):
        raise AssertionError("a particle that there is none of")
    return again.weights, again.ess(), again.mode(), again.mean(), again.resampled(index).world_T_object


@target
def _fields(draw: Draw) -> Iterable[Tensor]:
    count = draw.integer(1, 5)
    at, points = poses(draw, count), tensor(draw, sizes(draw), 3, wild=True)
    belief = PoseBelief.uniform(at).reweighted(log_weights(draw, count).to(at))
    settings = InformationSettings(
        mode=choice(draw, ("sensor_mi", "surrogate", "reverse_kl", "forward_kl")),
        peakiness=abs(number(draw)),
        free_scale=abs(number(draw)),
        tolerance=abs(number(draw)) * 0.01,
        sharpness=abs(number(draw)) + 1e-3,
        tail=choice(draw, (0.0, 1e-6)),
    )
    fields = information_field(table(at), at, belief.log_weights, points.to(at), settings)
    normal = expected_normal(table(at), at, belief.log_weights, points.to(at))
    return fields.semantics, fields.information, *out((points,), normal)


@target
def _metrics(draw: Draw) -> Iterable[Tensor]:
    count = draw.integer(1, 4)
    at = poses(draw, count)
    belief = PoseBelief.uniform(at).reweighted(log_weights(draw, count).to(at))
    surface = 0.1 * tensor(draw, draw.integer(1, 5), 3).to(at)
    nll = negative_log_likelihood(at, belief.log_weights, at[0], surface, table(at))
    return (nll, *self_agreement(belief, surface, table(at)))


@target
def _entropies(draw: Draw) -> Iterable[Tensor]:
    count = draw.integer(1, 6)
    states = tensor(draw, count, 3)
    if draw.integer(0, 1):
        states[-1] = states[0]
    log = log_weights(draw, count).to(states)
    log[0] = 0.0
    support = SharedSupport(StateMetric.planar(0.1), draw.integer(2, 5), floor=1e-3)
    chance = tensor(draw, count).abs().clamp(0.0, 1.0).to(states)
    gain = binary_gain(log, chance)
    estimate = entropies(support)[choice(draw, ENTROPIES)](states, log)
    return estimate, gain


@target
def _channels(draw: Draw) -> Iterable[Tensor]:
    rates = [number(draw, wild=True) if draw.integer(0, 3) == 0 else draw.integer(0, 10**9) * 1e-9 for _ in range(2)]
    return (torch.tensor(channel_capacity(min(rates), max(rates))),)


@target
def _statistics(draw: Draw) -> Iterable[Tensor]:
    wild = draw.integer(0, 3) == 0
    values = [number(draw, wild=wild) for _ in range(sizes(draw))]
    others = [number(draw, wild=wild) for _ in range(len(values) if draw.integer(0, 3) else sizes(draw))]
    low, high = wilson(draw.integer(-1 if wild else 0, 2), draw.integer(2, 4))
    mcnemar([v > 0 for v in values], [v > 0 for v in others])
    found = [low, high, *bootstrap_median(values, resamples=5)]
    # not numbers where there is no correlation, as documented
    both = [pearson(values, others), spearman(values, others), *run_correlation([(values, others)], resamples=5)]
    if any(math.isinf(x) for x in both):
        raise AssertionError("an infinite correlation")
    return (torch.tensor([x for x in found if abs(x) < 1e30]),)
