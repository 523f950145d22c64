"""What plans from families of motions lose of the best that is known, judged more finely than they are made.

python -m scripts.plan_regrets run        # seeds 1300-1319
python -m scripts.plan_regrets show

One belief of a run of `mug` under `lab` for each seed. Variants of `scripts.plan_families` plan from the plan before,
with two iterations, or from noise, with ten. Plans are judged by 32 rollouts on a lattice of 2.5 mm. The best that is
known is the best of all of these plans and of two that 8 times the samples and ten iterations find, with all families
and without. Regret is the share of its gain over standing still that a plan lacks.
"""

import statistics
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch

from rumi.cli import script
from rumi.planning.rummaging import RummagingPolicy
from scripts.experiment import Experiment, Line
from scripts.plan_families import ALL, FAMILIES, families_of
from scripts.plan_judging import moments, paired, parts, planned
from scripts.plan_lattices import Given, judged
from scripts.plan_proposals import policy_of
from scripts.reproduce.cells import table
from scripts.store import clock

AS_IT_IS, NOISE = "as it is", ", from noise"
WARM = (AS_IT_IS, *FAMILIES, ALL)
NAMES = (*WARM, *(name + NOISE for name in WARM))
LARGE = ("large", "large, all three")
JUDGES, FINE = 32, "2.5 mm"
TIMES, ITERATIONS = 8, 10


def measure(seed: int) -> dict[str, Any]:
    """Fine cost of each variant's plan, of the two large searches' and of standing still, and their seconds."""
    task, agent = parts(500, 2, 10)
    found = list(moments(task, agent, seed))
    moment = found[7 * seed % len(found)]
    own = policy_of(agent)
    many = replace(own.settings.mppi, samples=TIMES * own.settings.mppi.samples)
    many = replace(many, iterations=ITERATIONS, warmup_iterations=ITERATIONS)
    plans, seconds = {"still": torch.zeros(own.settings.mppi.horizon, 3)}, {}
    for name in (*NAMES, *LARGE):
        families = ALL if name == LARGE[1] else name.removesuffix(NOISE)
        settings = replace(own.settings, mppi=many) if name in LARGE else own.settings
        policy = RummagingPolicy(own.reachability, settings, proposals=families_of(families, agent))
        policy.push_models = own.push_models
        begun = clock()
        plans[name] = planned(agent, policy, moment, warm=not name.endswith(NOISE)).controls
        seconds[name] = clock() - begun
    here = Given("mug", agent.model, agent.tool, moment.belief, moment.configuration)
    fine = judged(here, "quasi-static", FINE, torch.stack(list(plans.values())), JUDGES)
    worth = dict(zip(plans, (fine.information + fine.reach).tolist(), strict=True))
    return {"step": moment.step, "of": len(found), "worth": worth, "seconds": seconds}


def left(line: Line, name: str) -> tuple[float, float]:
    """What a variant's plan lacks of the best that is known, and what that gains over standing still."""
    worth = line["worth"]
    best = max(worth.values())
    return best - worth[name], best - worth["still"]


def regrets(lines: Sequence[Line], name: str) -> list[float]:
    """Regret of a variant by belief."""
    return [lacks / gain for lacks, gain in (left(line, name) for line in lines)]


def show(lines: list[Line], chosen: object) -> str:
    """A row for each variant, paired by belief with plans as they are, from the plan before or from noise."""
    rows = []
    for name in (*NAMES, *LARGE) if lines else ():
        own = regrets(lines, name)
        error = statistics.stdev(own) / len(own) ** 0.5 if len(own) > 1 else float("nan")
        other = AS_IT_IS + NOISE * name.endswith(NOISE)
        more = [a - b for a, b in zip(own, regrets(lines, other), strict=True)]
        told = "" if name == other else "{mean:+.2f} [{low:+.2f}, {high:+.2f}]".format(**paired(more))
        lacks, gain = (sum(part) for part in zip(*(left(line, name) for line in lines), strict=True))
        ms = 1e3 * statistics.mean(line["seconds"][name] for line in lines)
        others = "" if name == other else str(sum(value != 0.0 for value in more))
        cells = (f"{statistics.mean(own):.2f} +- {error:.2f}", f"{statistics.median(own):.2f}", f"{lacks / gain:.2f}")
        rows.append([name, str(len(own)), *cells, told, others, f"{ms:.0f}"])
    heads = ("plans", "beliefs", "regret, standard error", "median", "of all gains together", "more than as it is")
    return table((*heads, "other plans", "ms"), rows)


EXPERIMENT = Experiment(__doc__, "plan_regrets.jsonl", {}, measure, show, seeds="1300-1319")

if __name__ == "__main__":
    script(EXPERIMENT.main)
