"""How far entropy estimates of weighted sets are from the truth, for uniform and Gaussian sets in 1 to 3 dimensions.

python -m scripts.entropy_table                     # Markdown: mean error and standard deviation, nats
python -m scripts.entropy_table --count 400 --neighbours 9 --sets 500
"""

import math
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import torch
import tyro
from jaxtyping import Float
from torch import Tensor

from rumi.cli import script
from rumi.information.entropy import Entropy, NeighbourEntropy, SharedSupport, SpatialEntropy
from rumi.information.neighbours import StateMetric, unique_states
from scripts.reproduce.cells import table


@dataclass(frozen=True)
class Options:
    """What is estimated.

    Attributes:
        count: states in a set, of equal weight.
        neighbours: nearest that make up a box.
        sets: how many sets are drawn.
        seed: of the draws.
    """

    count: int = 100
    neighbours: int = 5
    sets: int = 300
    seed: int = 0


class Row(NamedTuple):
    """Errors of one estimate."""

    shape: str
    dims: int
    estimate: str
    bias: float
    deviation: float


@dataclass(frozen=True)
class KernelEntropy:
    """Plug-in estimate of the mixture's density at the states (Eqs 3-4), each a box of the shared support."""

    support: SharedSupport

    def __call__(self, states: Float[Tensor, "*b N D"], log_weights: Float[Tensor, "*#b N"]) -> Float[Tensor, "*b"]:
        """Entropy of each set."""
        metric = self.support.metric
        unique = unique_states(states, log_weights, metric)
        sides, log_volume = self.support(states, log_weights, unique)
        density = torch.zeros_like(unique.log_weights)
        weights = unique.log_weights.exp()
        for j in range(states.shape[-2]):  # one state at a time: memory for all pairs is not needed
            apart = metric.difference(states, states[..., j : j + 1, :]).abs()
            density = density + weights[..., j : j + 1] * (apart <= 0.5 * sides[..., None, :]).all(-1)
        log = torch.where(unique.first, density.clamp_min(1e-300 if density.dtype == torch.float64 else 1e-38).log(), 0)
        return log_volume - (weights * log).sum(-1)


def estimates(dims: int, neighbours: int) -> dict[str, Entropy]:
    """What is compared, by name."""
    metric = StateMetric.euclidean(dims)
    own = SharedSupport(metric, neighbours)
    return {
        "spatial": SpatialEntropy(own),
        "spatial, without itself": SpatialEntropy(SharedSupport(metric, neighbours, include_self=False)),
        "spatial, geometric mean": SpatialEntropy(SharedSupport(metric, neighbours, mean="geometric")),
        "kernel": KernelEntropy(own),
        "neighbour": NeighbourEntropy(metric, neighbours - 1),
    }


def rows(options: Options) -> Iterator[Row]:
    """Errors of every estimate on every kind of set."""
    generator = torch.Generator().manual_seed(options.seed)
    log_weights = torch.zeros(options.count, dtype=torch.float64)
    for dims in (1, 2, 3):
        shape = (options.sets, options.count, dims)
        uniform = torch.rand(shape, generator=generator, dtype=torch.float64)
        gaussian = torch.randn(shape, generator=generator, dtype=torch.float64)
        truths: dict[str, tuple[Tensor, float]] = {
            "uniform": (uniform, 0.0),
            "Gaussian": (gaussian, 0.5 * dims * math.log(2.0 * math.pi * math.e)),
        }
        for name, (states, truth) in truths.items():
            for estimate, entropy in estimates(dims, options.neighbours).items():
                error = entropy(states, log_weights) - truth
                yield Row(name, dims, estimate, float(error.mean()), float(error.std()))


def markdown(found: list[Row]) -> str:
    """An estimate a line."""
    columns = list(dict.fromkeys((row.shape, row.dims) for row in found))
    cells = {(row.estimate, row.shape, row.dims): f"{row.bias:+.2f} ({row.deviation:.2f})" for row in found}
    names = dict.fromkeys(row.estimate for row in found)
    heads = ("estimate", *(f"{shape}, {dims}-D" for shape, dims in columns))
    return table(heads, ([name, *(cells[(name, *column)] for column in columns)] for name in names))


def main() -> None:
    """Print the table."""
    options = tyro.cli(Options, description=__doc__)
    sys.stdout.write(f"{options.count} states, {options.neighbours} neighbours, {options.sets} sets\n\n")
    sys.stdout.write(markdown(list(rows(options))))


if __name__ == "__main__":
    script(main)
