"""Entropies of weighted states: collapsed dimensions, duplicates, wrapped angles, fewer states than neighbours."""

import math
from functools import partial
from typing import Any

import torch
from torch import Tensor

from rumi.information.binary_gain import binary_gain
from rumi.information.entropy import SharedSupport, weights_entropy
from rumi.information.neighbours import StateMetric
from sdf import backend
from tests.fixtures.channel import channel_capacity
from tests.fixtures.entropies import ENTROPIES, entropies
from tests.stress import exact, measures
from tests.stress.draws import choice, integer, log_uniform, log_weights, mixed, normal, uniform
from tests.stress.subjects.distances import VERSIONS
from tests.stress.sweep import Inputs, Sweep, register

F64 = torch.float64
FLOOR = (1e-4, 1e-4, 1e-3)
"""Metres and radians at which states are told apart."""
METRIC = StateMetric.planar(0.1)


def _of_numbers(got: Tensor, wanted: Tensor, inputs: Inputs) -> Tensor:
    return measures.absolute(got.reshape(-1, 1), wanted.reshape(-1, 1))


def _draw_weights(generator: torch.Generator) -> Inputs:
    count = int(choice(generator, (1, 2, 40, 3000)))
    return {"log_weights": log_weights(generator, 32, count).float()}


def _exact_entropy(inputs: Inputs) -> Tensor:
    log = torch.log_softmax(inputs["log_weights"].double(), -1)
    return -torch.where(log > -math.inf, log.exp() * log, 0.0).sum(-1)


def _draw_states(least: float, generator: torch.Generator) -> Inputs:
    """States about a place, half of them copies; a dimension collapsed or not; angles about half a turn."""
    count, rows = int(choice(generator, (1, 2, 3, 5, 60))), 8
    spread = log_uniform(generator, rows, 1, 3, low=least, high=0.3)
    states = normal(generator, rows, count, 3) * spread
    states = torch.where(uniform(generator, rows, 1, 3) < 0.2, 0.0, states)
    first = torch.randint(count, (rows, count), generator=generator)
    copied = torch.gather(states, 1, first[..., None].expand_as(states))
    states = torch.where(uniform(generator, rows, count, 1) < 0.4, copied, states)
    states[..., :2] += uniform(generator, rows, 1, 2, low=-1.0, high=1.0)
    states[..., 2] += mixed(generator, [torch.full((rows, 1), math.pi, dtype=F64), uniform(generator, rows, 1)])
    states[..., 2] = torch.remainder(states[..., 2] + math.pi, 2 * math.pi) - math.pi
    return {"states": states.float(), "log_weights": log_weights(generator, rows, count).float()}


def _entropy(name: str, version: str, dtype: torch.dtype, inputs: Inputs) -> Tensor:
    support = SharedSupport(METRIC, floor=FLOOR)
    with backend.force(version):
        return entropies(support)[name](inputs["states"].to(dtype), inputs["log_weights"].to(dtype))


def _exact_neighbour(inputs: Inputs) -> Tensor:
    """The neighbour estimate by loops over states and pairs, the weights as logarithms throughout."""
    return torch.tensor(
        [_by_loops(*pair) for pair in zip(inputs["states"].double(), inputs["log_weights"].double(), strict=True)]
    )


def _by_loops(states: Tensor, log_weights: Tensor) -> float:
    log = torch.log_softmax(log_weights, -1)
    kept: list[Tensor] = []
    parts: list[list[Tensor]] = []
    for state, weight in zip(states, log, strict=True):
        if weight == -math.inf:
            continue
        same = [k for k, other in enumerate(kept) if bool((METRIC.difference(state, other) == 0).all())]
        if same:
            parts[same[0]].append(weight)
        else:
            kept.append(state)
            parts.append([weight])
    weights = [torch.logsumexp(torch.stack(part), 0) for part in parts]
    used, dims = min(4, len(kept) - 1), 3
    size = 1.0 / sum(float(w.exp()) ** 2 for w in weights)
    ball = 0.5 * dims * math.log(math.pi) - math.lgamma(0.5 * dims + 1.0) + sum(map(math.log, METRIC.scales))
    total, counted = ball, 0.0
    if used > 0:
        size = max(size, 1.0 + 1e-6)
        gammas = [float(torch.digamma(torch.tensor(x, dtype=F64))) for x in (size, float(used))]
        counted = gammas[0] - math.log(size - 1.0) + math.log(used) - gammas[1]
    for k, (state, weight) in enumerate(zip(kept, weights, strict=True)):
        others = [j for j in range(len(kept)) if j != k]
        apart = [float(METRIC.whitened(METRIC.difference(kept[j], state)).norm()) for j in others]
        near = sorted(range(len(others)), key=lambda n: apart[n])[:used]
        each = dims * math.log(max(apart[near[-1]] if near else 0.0, 1e-9))
        if near:
            mass = torch.logsumexp(torch.stack([weights[others[n]] for n in near]), 0)
            each -= float(mass - torch.logsumexp(torch.stack([weights[j] for j in others]), 0))
        total += float(weight.exp()) * each
    return total + counted


def _size(inputs: Inputs) -> Tensor:
    return torch.tensor([float(inputs["log_weights"].shape[-1])])


# what a reading tells


def _draw_outcome(generator: torch.Generator) -> Inputs:
    """Chances of contact that are almost the same for all states, at 0 or 1, or any."""
    count, rows = integer(generator, 1, 100), 32
    base, spread = uniform(generator, rows, 1), log_uniform(generator, rows, 1, low=1e-6, high=1.0)
    near = (base + spread * (uniform(generator, rows, count) - 0.5)).clamp(0.0, 1.0)
    ends = torch.where(uniform(generator, rows, count) < 0.5, 0.0, 1.0).double()
    rare = log_uniform(generator, rows, count, low=1e-12, high=1e-3)
    return {
        "log_weights": log_weights(generator, rows, count).float(),
        "probability": mixed(generator, [near, ends, rare, 1.0 - rare]).float(),
    }


def _gain(inputs: Inputs) -> Tensor:
    return binary_gain(inputs["log_weights"], inputs["probability"])


def _exact_gain(inputs: Inputs) -> Tensor:
    """Mean divergence of each state's outcome from the mean one, in float64; 0 log 0 is 0."""
    weights = torch.softmax(inputs["log_weights"].double(), -1)
    total = torch.zeros(len(weights), dtype=F64)
    for chance in (inputs["probability"].double(), 1.0 - inputs["probability"].double()):
        mean = (weights * chance).sum(-1, keepdim=True)
        ratio = torch.where(chance > 0, chance / torch.where(mean > 0, mean, 1.0), 1.0)
        total += (weights * chance * ratio.log()).sum(-1)
    return total


def _gain_error(got: Tensor, wanted: Tensor, inputs: Inputs) -> Tensor:
    """Nats; what is below 0 counts ten times, since no reading can take information away."""
    return torch.maximum((got.double() - wanted).abs(), -10.0 * got.double())


def _draw_channel(generator: torch.Generator) -> Inputs:
    low = float(
        choice(generator, (0.0, float(uniform(generator, 1)), float(log_uniform(generator, 1, low=1e-9, high=1.0))))
    )
    gap = float(log_uniform(generator, 1, low=1e-8, high=1.0))
    return {"low": low, "high": min(1.0, low + gap)}


def _exact_capacity(inputs: Inputs) -> Tensor:
    m = exact.mp()
    low, high = m.mpf(inputs["low"]), m.mpf(inputs["high"])

    def coin(p: Any) -> Any:  # noqa: ANN401  (numbers of mpmath)
        return -sum(q * m.log(q) for q in (p, 1 - p) if q > 0)

    if low == high:
        return torch.zeros(1, dtype=F64)
    mean = 1 / (1 + m.exp((coin(high) - coin(low)) / (high - low)))
    share = min(max((mean - low) / (high - low), m.mpf(0)), m.mpf(1))
    return torch.tensor([float(coin(mean) - (1 - share) * coin(low) - share * coin(high))], dtype=F64)


def _enter() -> None:
    register(Sweep(
        "entropy-of-weights", _draw_weights, lambda i: weights_entropy(i["log_weights"]), _exact_entropy,
        _of_numbers, 1e-5, "nats", _size, "states",
    ))  # fmt: skip
    for version in VERSIONS:
        for name in ENTROPIES:
            neighbour = name == "neighbour"
            # a state on the edge of another's box counts or not: a last digit decides
            limit = 0.1 if name == "kernel" else 1e-3
            # near the last digit two neighbours are equally far, and either is the farthest
            draw = partial(_draw_states, 1e-3 if neighbour else 1e-7)
            wanted = _exact_neighbour if neighbour else partial(_entropy, name, "torch", F64)
            register(Sweep(
                f"entropy-{name}-{version}", draw, partial(_entropy, name, version, torch.float32), wanted,
                _of_numbers, limit, "nats", _size, "states",
            ))  # fmt: skip
    register(Sweep(
        "entropy-expected-gain", _draw_outcome, _gain, _exact_gain, _gain_error, 2e-6, "nats",
        lambda i: i["probability"].double().amax(-1) - i["probability"].double().amin(-1), "spread of the chances",
    ))  # fmt: skip
    if exact.available():
        register(Sweep(
            "entropy-channel-capacity", _draw_channel,
            lambda i: torch.tensor([channel_capacity(i["low"], i["high"])], dtype=F64), _exact_capacity,
            _of_numbers, 1e-9, "nats", lambda i: torch.tensor([i["high"] - i["low"]]), "gap of the chances",
        ))  # fmt: skip


_enter()
