"""How much sooner an object's lever and friction are known by the force at the tip: information, and pushes measured.

python -m scripts.push_forces run     # needs RUMI_DATA; again to go on
python -m scripts.push_forces show

Of the MIT sets: observed information a push and a pair of wrench and twist, at the set's fit. Of the triangle on known
supports: the library's prior after n pushes, ten times, with and without what the tip felt, scored on all others.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch

from rumi.cli import script
from rumi.dynamics.push_posterior import PushPosterior
from rumi.dynamics.push_registration import Registration
from rumi.seeding import split
from scripts.bench.push_forces import (
    SUPPORTS,
    force_pushes,
    pairs_of,
    slip_log_likelihood,
    triangle_body,
    true_lever_m,
)
from scripts.bench.real_pushes import SETS, push_set, scores, wrench_log_likelihood, wrench_twists
from scripts.experiment import Experiment, Line
from scripts.real_pushes import fits
from scripts.reproduce.cells import table

OBJECTS = (*SUPPORTS, *(name for name in SETS if not name.endswith("tri2")))
COUNTS = (1, 3, 10)
KNOWN = ("pushes", "and forces")
_DRAWS, _PARTICLES, _STEP = 10, 1024, 0.15


def measure(object: str) -> dict[str, Any]:
    """Information of a set, or what is known after pushes of the triangle."""
    return _learnt(object) if object in SUPPORTS else _information(object)


def _information(name: str) -> dict[str, float]:
    """Of the log of lever and of friction, a datum, by second differences of the log-likelihood."""
    own, pairs, fitted = push_set(name), wrench_twists(name), torch.tensor(fits()[name], dtype=torch.float64)
    pushes = own.observed(torch.arange(len(own.start)))
    at = fitted.repeat(5, 1)
    for row, (column, step) in enumerate(((0, -_STEP), (0, _STEP), (1, -_STEP), (1, _STEP)), 1):
        at[row, column] += step
    known = PushPosterior(at, at.new_zeros(5), registration=Registration().learnt(pushes, own.body))
    motion = known.log_likelihood(pushes, own.body) / (known.residual.power * len(pushes))
    rows = torch.arange(len(pairs.wrench))
    wrench = wrench_log_likelihood(at, rows, pairs, own.body) / len(rows)

    def bend(values: torch.Tensor, row: int) -> float:
        return float((2.0 * values[0] - values[row] - values[row + 1]) / _STEP**2)

    return {"lever_push": bend(motion, 3), "lever_pair": bend(wrench, 3), "friction_push": bend(motion, 1)}


def _learnt(support: str) -> dict[str, Any]:
    """Posterior deviations of log lever and log friction, and errors on all other pushes, means of draws."""
    own, body, prior = force_pushes(support), triangle_body(), PushPosterior.prior(_PARTICLES)
    pushes, pairs = [one.push for one in own], pairs_of(own)
    tangent, slips = torch.tensor([one.tangent for one in own]).double(), torch.tensor([one.slips for one in own])
    friction = prior.parameters[:, 0].exp()
    found: dict[str, Any] = {}
    for count in COUNTS:
        for known in KNOWN:
            rows = []
            for draw in range(_DRAWS):
                order = torch.randperm(len(own), generator=split(draw, f"forces {support}"))
                learnt, rest = order[:count], order[count:]
                seen = [pushes[i] for i in learnt.tolist()]
                after = replace(prior, registration=prior.registration.learnt(seen, body))
                weighed = after.log_likelihood(seen, body)
                if known != "pushes":
                    felt = wrench_log_likelihood(prior.parameters, learnt, pairs, body)
                    felt = felt + slip_log_likelihood(friction, tangent[learnt], slips[learnt])
                    weighed = weighed + prior.residual.power * felt
                after = replace(after, log_weights=weighed.log_softmax(-1))
                weights, logs = after.log_weights.exp(), after.parameters[:, :2]
                middle = weights @ logs
                spread = (weights @ (logs - middle).square()).sqrt()
                start, path, end = (torch.stack([getattr(pushes[i], n) for i in rest.tolist()]) for n in _PARTS)
                off = scores(after.predict(start, path, body).mean(), end, path)
                numbers = (*spread.tolist(), *middle.exp().tolist(), off.place_mm.mean(), off.turn_deg.mean())
                rows.append([float(number) for number in numbers])
            names = ("friction_spread", "lever_spread", "friction", "lever", "mm", "degrees")
            found[f"{count} {known}"] = dict(zip(names, torch.tensor(rows).mean(0).tolist(), strict=True))
    truth = true_lever_m(support)
    return found | {"pushes": len(own), "true_lever": None if truth is None else truth / body.support.spread}


_PARTS = ("start", "path", "end")


def show(lines: list[Line], chosen: Mapping[str, tuple[Any, ...]]) -> str:
    """The information of the sets, means; and of each support what is known after pushes."""
    sets = [line for line in lines if "lever_push" in line]
    rows = []
    for line in lines:
        if "true_lever" not in line:
            continue
        truth = "-" if line["true_lever"] is None else f"{line['true_lever']:.2f}"
        for known in KNOWN:
            own = [line[f"{count} {known}"] for count in COUNTS]
            cells = [
                f"{one['lever']:.2f} ({one['lever_spread']:.2f}), {one['friction']:.2f} "
                f"({one['friction_spread']:.2f}); {one['mm']:.2f}, {one['degrees']:.2f}"
                for one in own
            ]
            rows.append([line["object"], truth, known, *cells])
    text = table(("support", "lever by statics", "known", *(f"after {count}" for count in COUNTS)), rows)
    if sets:
        means = {name: sum(line[name] for line in sets) / len(sets) for name in ("lever_push", "lever_pair")}
        friction = sum(line["friction_push"] for line in sets) / len(sets)
        text += (
            f"\nInformation of {len(sets)} sets, a datum: log lever {means['lever_push']:.1f} a push, "
            f"{means['lever_pair']:.1f} a pair; log friction {friction:.1f} a push\n"
        )
    return text


EXPERIMENT = Experiment(__doc__, "push_forces.jsonl", {"object": OBJECTS}, measure, show)

if __name__ == "__main__":
    script(EXPERIMENT.main)
