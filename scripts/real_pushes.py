"""How far push models are from 5400 real pushes of 7 shapes on two surfaces, and how sure of it they are.

python -m scripts.real_pushes run     # needs RUMI_DATA; again to go on
python -m scripts.real_pushes show

Priors of a shape, and all that is chosen, are fitted to the other six on both surfaces; "after n" learns from n random
pushes of the set, 20 times (5 for 1 and 3), and is scored on all others of it (its regions on every second, after n on
every eighth of those).
`--models fit` and `coverage` come first, in this order: the others read them.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rumi.cli import script
from rumi.dynamics.along_path import displace_along_path
from rumi.dynamics.push_density import PushPrediction
from rumi.dynamics.push_posterior import PushPosterior
from rumi.dynamics.sliding import Sliding
from rumi.seeding import split
from scripts.bench.push_priors import FACTORS, chosen_factor, fit, for_other_tools, prior_of, without
from scripts.bench.real_pushes import (
    SETS,
    SHAPES,
    Scores,
    fixed,
    predicted,
    push_set,
    scores,
    wrench_log_likelihood,
    wrench_twists,
)
from scripts.experiment import RESULTS, Experiment, Line
from scripts.reproduce.cells import table
from scripts.store import Store

FILE = "real_pushes.jsonl"
FIT, HELD = "fit", "coverage"
FIXED = {
    "lever 1.5 friction 0.5": (0.5, 1.5),
    "lever 1.5 friction 0.3": (0.3, 1.5),
    "lever 1.0 friction 0.2": (0.2, 1.0),
}
"""Friction and lever ratio by what a table calls them."""
LEARNT = {"never seen": 0, "after 1": 1, "after 3": 3, "after 10": 10}
SHIPPED = {"library prior": 0, "library after 10": 10}
"""The library's own prior, as it is without the shape: a friction as wide as tools are; and after pushes."""
FAR = {"library, another shape less": 0, "library, another shape less, after 10": 10}
"""The same, without one more shape: the mean over each of the others."""
OTHER = {"library of the other surface": 0, "library of the other surface, after 10": 10}
"""The same, of the other shapes on the other surface."""
WRENCHES = {"10 pushes": False, "10 pushes and wrenches": True}
"""Learnt alike by weights alone, with and without 10 measured pairs of wrench and twist of the same set."""
MODELS = (
    FIT,
    HELD,
    "stays",
    "displacement",
    *FIXED,
    "Zhou by 600 wrenches",
    *LEARNT,
    *SHIPPED,
    *FAR,
    *OTHER,
    *WRENCHES,
)
DRAWS, FEWER = {0: 1, 1: 5, 3: 5, 10: 20}, {0: 1, 10: 3}
"""Times that so many pushes are drawn to learn from; of what is no part of the protocol's table."""
PARTICLES = 128
"""Particles that learn and predict."""
SHARES = (0.5, 0.9, 0.95)


def measure(model: str, set: str) -> dict[str, Any]:
    """Scores of a model on a set."""
    own = push_set(set)
    if model == FIT:
        return {"parameters": list(fit(own))}
    rows = torch.arange(len(own.start))
    if model == "stays":
        return _summary([scores(own.start, own.end, own.path)])
    if model == "displacement":
        # of this model the outline alone tells: how the object slides plays no part
        slides = Sliding(torch.zeros(2), torch.ones(()), torch.ones(())).to(own.start)
        carried = displace_along_path(own.start, own.path, own.body.pusher, own.body.outline, slides)
        return _summary([scores(carried.track[:, -1], own.end, own.path)])
    if model.startswith("Zhou"):
        return _summary([scores(own.zhou, own.end, own.path)])
    if model in WRENCHES:
        return _with_wrenches(set, known=WRENCHES[model])
    if model in FIXED:
        return _summary([scores(predicted(fixed(*FIXED[model]), own, rows).mean(), own.end, own.path)])
    if model == HELD:
        return {"held": _held(set)}
    surface, shape = set.split()
    count = (SHIPPED | LEARNT | FAR | OTHER)[model]
    if model in FAR:
        return _averaged(
            [_believed(set, prior_without((shape, other)), count, FEWER[count]) for other in SHAPES if other != shape]
        )
    prior = prior_without((shape,), surface if model in OTHER else "", library=model not in LEARNT)
    return _believed(set, prior, count, (FEWER if model in OTHER else DRAWS)[count])


def prior_without(
    shapes: tuple[str, ...], surface: str = "", *, library: bool = True, count: int = PARTICLES
) -> PushPosterior:
    """By the fits of all other shapes (on all other surfaces), with what they choose."""
    prior = prior_of(without(fits(), shapes, surface), factor_without(shapes), count)
    return for_other_tools(prior) if library else prior


def _believed(name: str, prior: PushPosterior, count: int, draws: int) -> dict[str, Any]:
    """Scores of a prior after some pushes of a set, drawn so many times."""
    own, found, densities, levels, numbers = push_set(name), [], [], [], []
    for draw in range(draws):
        generator = split(draw, f"real pushes {name}")
        order = torch.randperm(len(own.start), generator=generator)
        learnt, rest = order[:count], order[count:]
        posterior = prior.update(own.observed(learnt), own.body, generator)
        shown = predicted(posterior.thinned(PARTICLES), own, rest)
        end = own.end[rest]
        found.append(scores(shown.mean(), end, own.path[rest]))
        densities.append(float(shown.log_density(end).mean()))
        every = slice(None, None, 8 if count else 2)
        some = shown._replace(ends=shown.ends[every], scale=shown.scale[every], heading=shown.heading[every])
        levels.append(some.level(end[every], generator, draws=200))
        numbers.append(posterior.quantiles((0.5,))[0, :2].exp())
    held = {f"held_{share:g}": float((torch.cat(levels) <= share).double().mean()) for share in SHARES}
    middle = torch.stack(numbers).mean(0).tolist()
    return _summary(found) | held | {"log_density": float(np.mean(densities)), "friction_lever": middle}


def _averaged(found: list[dict[str, Any]]) -> dict[str, Any]:
    """Means of figures; of lists, of each part."""
    return {name: np.mean([one[name] for one in found], axis=0).tolist() for name in found[0]}


def _held(name: str) -> dict[str, dict[str, float]]:
    """Of each factor, without a set's shape and one other: share of pushes, after 0, 3 and 10, that 90 % regions hold.

    Factors change what is predicted alone, not what is learnt: that saves most of the time.
    """
    found: dict[str, dict[str, float]] = {}
    for other in _others(name):
        shown, generator = _inner(name, other, 16), split(1000, f"levels {name}")
        found[other] = {}
        for factor in FACTORS:
            levels = [_wider(each, factor).level(end, generator, draws=200) for each, end in shown]
            found[other][f"{factor:g}"] = float((torch.cat(levels) <= 0.9).double().mean())
    return found


def _inner(name: str, other: str, every: int) -> list[tuple[PushPrediction, Tensor]]:
    """Some pushes of a set as they are predicted without its shape and one other, after 0, 3 and 10; their ends."""
    own, generator = push_set(name), split(1000, f"real pushes {name}")
    order = torch.randperm(len(own.start), generator=generator)
    rest = order[10:][::every]
    prior = prior_of(without(fits(), (name.split()[1], other)), 1.0, PARTICLES)
    learnt = [prior.update(own.observed(order[:some]), own.body, generator) for some in (0, 3, 10)]
    return [(predicted(posterior.thinned(PARTICLES), own, rest), own.end[rest]) for posterior in learnt]


def _wider(shown: PushPrediction, factor: float) -> PushPrediction:
    return shown._replace(scale=factor * shown.scale)


def _others(name: str) -> list[str]:
    return [shape for shape in SHAPES if shape != name.split()[1]]


def _with_wrenches(name: str, *, known: bool) -> dict[str, Any]:
    own, pairs = push_set(name), wrench_twists(name)
    prior = prior_without((name.split()[1],), library=False, count=1024)
    found = []
    for draw in range(5):
        generator = split(draw, f"real pushes {name}")
        order = torch.randperm(len(own.start), generator=generator)
        learnt, rest = order[:10], order[10:]
        weighed = prior.log_weights + prior.log_likelihood(own.observed(learnt), own.body)
        rows = torch.randperm(len(pairs.wrench), generator=generator)[:10]
        if known:
            weighed = weighed + prior.residual.power * wrench_log_likelihood(prior.parameters, rows, pairs, own.body)
        posterior = replace(prior, log_weights=weighed.log_softmax(-1))
        found.append(scores(predicted(posterior.thinned(PARTICLES), own, rest).mean(), own.end[rest], own.path[rest]))
    return _summary(found)


@cache
def fits() -> dict[str, tuple[float, ...]]:
    """Parameters of each set, on record.

    Raises:
        ValueError: some are not yet.
    """
    lines = {line["set"]: tuple(line["parameters"]) for line in Store(RESULTS / FILE).flat() if line["model"] == FIT}
    if set(lines) != set(SETS):
        raise ValueError("Expected a fit of every set on record: python -m scripts.real_pushes run --models fit")
    return lines


def factor_without(shapes: tuple[str, ...]) -> float:
    """The factor that the other shapes choose, on record."""
    return chosen_factor(_recorded(HELD, "held"), shapes)


@cache
def _recorded(model: str, figure: str) -> dict[str, dict[str, dict[str, float]]]:
    """A figure of each set.

    Raises:
        ValueError: some are not on record yet.
    """
    lines = {line["set"]: line[figure] for line in Store(RESULTS / FILE).flat() if line["model"] == model}
    if set(lines) != set(SETS):
        raise ValueError(f"Expected all sets on record: python -m scripts.real_pushes run --models {model}")
    return lines


def _summary(found: list[Scores]) -> dict[str, Any]:
    whole: list[Tensor] = [torch.cat(parts) for parts in zip(*found, strict=True)]
    place, turn, along, across = whole
    return {
        "pushes": len(found[0].place_mm),
        "mm": float(place.mean()),
        "mm_median": float(place.median()),
        "mm_90": float(place.quantile(0.9)),
        "degrees": float(turn.mean()),
        "degrees_90": float(turn.quantile(0.9)),
        "along_mm": float(along.abs().mean()),
        "across_mm": float(across.abs().mean()),
    }


def over_sets(lines: list[Line], name: str) -> float:
    """Mean of a figure over pushes."""
    return sum(line["pushes"] * line[name] for line in lines) / sum(line["pushes"] for line in lines)


def interval(lines: list[Line], name: str) -> str:
    """The same with a 95 % interval: shapes are drawn anew (bootstrap, 2000 times)."""
    by_shape = [[line for line in lines if line["set"].endswith(shape)] for shape in SHAPES]
    draws = np.random.default_rng(0).integers(len(SHAPES), size=(2000, len(SHAPES)))
    means = [over_sets([line for i in draw for line in by_shape[i]], name) for draw in draws]
    low, high = np.quantile(means, (0.025, 0.975))
    return f"{over_sets(lines, name):.2f} [{low:.2f}, {high:.2f}]"


def show(lines: list[Line], chosen: Mapping[str, tuple[Any, ...]]) -> str:
    """A row for each model that has done all sets; medians and 90 % are means of the sets'."""
    rows, covered = [], []
    for model in chosen.get("model", MODELS):
        own = [line for line in lines if line["model"] == model]
        if model in (FIT, HELD) or len({line["set"] for line in own}) < (12 if model in WRENCHES else len(SETS)):
            continue
        density = f"{over_sets(own, 'log_density'):.2f}" if "log_density" in own[0] else "-"
        cells = [f"{over_sets(own, name):.2f}" for name in ("mm_median", "mm_90", "along_mm", "across_mm")]
        rows.append([model, interval(own, "mm"), *cells, interval(own, "degrees"), density])
        if "held_0.9" in own[0]:
            each = [over_sets([line for line in own if line["set"].endswith(s)], "held_0.9") for s in SHAPES]
            shares = [f"{100 * over_sets(own, f'held_{share:g}'):.0f}" for share in SHARES]
            covered.append([model, *shares, f"{100 * min(each):.0f} to {100 * max(each):.0f}"])
    heads = ("model", "mean, mm", "median", "90 %", "along", "across", "turn, degrees", "log density")
    regions = ("model", "50 % regions hold, %", "90 %", "95 %", "90 %, each shape")
    return table(heads, rows) + ("\n" + table(regions, covered) if covered else "")


EXPERIMENT = Experiment(
    __doc__,
    FILE,
    {"model": MODELS, "set": SETS},
    measure,
    show,
    possible=lambda variant: variant["model"] not in WRENCHES or not variant["set"].endswith("tri2"),
)

if __name__ == "__main__":
    script(EXPERIMENT.main)
