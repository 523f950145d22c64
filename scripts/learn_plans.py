"""A plan proposal network in KMPPI, trained on long plans and by gradient through pushing: better plans at equal time?

    python -m scripts.learn_plans                       # record, train, judge, whole runs: lines and a figure
    python -m scripts.learn_plans --episodes 4 --scenes 40 --imitation 50 --steps 20 --beliefs 5 --runs 2 --out learnt \
        --figures learnt

Beliefs are those of runs of the task `mug`, whose scene the seed draws. The network (`scripts/plan_proposals.py`) gives
a set of nominal plans; KMPPI samples around the best of these and its own. A plan is judged by the planner's own cost,
with more poses, of beliefs that were not trained on; its time is the processor's, fields and network included.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
import tyro
from torch import Tensor

from rumi.cli import script
from rumi.tasks.rummage.agent import Rummager
from scripts.plan_judging import (
    Method,
    Moment,
    judge,
    moments,
    one_of,
    paired,
    parts,
    plan_cost,
    planned,
    whole_run,
)
from scripts.plan_proposals import ProposalNetwork, Scenes, policy_of
from scripts.plan_training import descend, imitate
from scripts.store import Line, Store

RECORDING = (100, 1, 4)  # samples and iterations of the planner that episodes are recorded by
LONG = Method(False, 125, 6, narrow=False)  # by which plans are made to learn from
USUAL = (500, 2, 10)  # samples, iterations of a later plan and of the first, as the settings have them
ALONE = {(500, False): (1, 2, 3), (125, False): (4, 8), (125, True): (4, 8)}
WITH = {(125, True): (1, 3)}
IN_RUNS = (Method(False, 500, 2, narrow=False), Method(True, 125, 3, narrow=True))
FIRST = 8  # iterations of a run's first plan, with the network


@dataclass(frozen=True)
class Options:
    """Learn to propose plans.

    Attributes:
        episodes: recorded to train on, seeds from 2000 on.
        scenes: made of their beliefs, with long plans; in every second one the object is turned by any angle.
        fresh: further ones, all turned, without plans: the soft cost needs none.
        imitation: steps of the optimiser towards long plans, of 64 scenes.
        steps: further ones by gradient of the soft cost, of 20 fresh scenes.
        beliefs: held out, one of a run each, seeds from 1300 on.
        runs: whole ones, with and without the network, seeds from 1400 on.
        work: folder that keeps episodes, scenes, held-out beliefs and the network.
        out: folder of plan_proposals.jsonl.
        figures: folder of plan_proposals.png.
    """

    episodes: int = 120
    scenes: int = 1200
    fresh: int = 3000
    imitation: int = 1200
    steps: int = 100
    beliefs: int = 100
    runs: int = 60
    work: Path = Path("build/plan_proposals")
    out: Path = Path("scripts/results")
    figures: Path = Path("scripts/docs/figures")


def scenes_of(
    agent: Rummager, recorded: Sequence[Moment], count: int, random: torch.Generator, *, plans: bool = True
) -> Scenes:
    """Scenes to train on, with long plans, one from the plan before where there is one and one from noise, or none."""
    made = []
    order = torch.randperm(len(recorded), generator=random).tolist()
    for k in range(count):
        moment = recorded[order[k // 2 % len(order)]]
        if k % 2 or not plans:
            moment = moment.turned(2.0 * math.pi * float(torch.rand((), generator=random)))
        policy, knots = LONG.policy(agent, None), torch.zeros(0, policy_of(agent).settings.mppi.knots or 0, 3)
        found = [planned(agent, policy, moment, warm=warm) for warm in (True, False)] if plans else []
        costs = torch.tensor([plan_cost(agent, moment, plan.controls) for plan in found])
        if found:
            knots = torch.stack([plan.warm_start.knots for plan in found if plan.warm_start is not None])
        made.append(Scenes.of(agent, moment.belief, moment.configuration, knots, costs, random))
        if k % 100 == 99:
            print(f"{k + 1} scenes", flush=True)
    return Scenes.from_parts([torch.cat(part) for part in zip(*(scene.parts for scene in made), strict=True)])


def kept(file: Path, make: Callable[[], Any]) -> Any:  # noqa: ANN401  (what torch keeps)
    """What a file holds; made and kept where there is none."""
    if not file.is_file():
        file.parent.mkdir(parents=True, exist_ok=True)
        torch.save(make(), file)
    return torch.load(file, weights_only=True)


def trained(options: Options) -> ProposalNetwork:
    """The network, trained on recorded episodes; both are kept, and so are the scenes."""
    _, agent = parts(*USUAL)
    kind = "_".join(str(value) for value in about(options).values())

    def empty() -> ProposalNetwork:
        return ProposalNetwork(policy_of(agent).settings.mppi)

    def record() -> list[tuple[Any, ...]]:
        task, recorder = parts(*RECORDING)
        return [tuple(one) for seed in range(2000, 2000 + options.episodes) for one in moments(task, recorder, seed)]

    def made(count: int, seed: int, plans: bool) -> Scenes:
        def make() -> tuple[Tensor, ...]:
            recorded = [Moment(*one) for one in kept(options.work / f"episodes_{options.episodes}.pt", record)]
            return scenes_of(agent, recorded, count, torch.Generator().manual_seed(seed), plans=plans).parts

        name = f"{'scenes' if plans else 'fresh'}_{options.episodes}_{count}.pt"
        return Scenes.from_parts(kept(options.work / name, make))

    def learn(descends: bool) -> dict[str, Tensor]:
        scenes = made(options.scenes, 0, True)
        before = kept(options.work / f"imitating_{kind}.pt", lambda: learn(False)) if descends else None
        torch.manual_seed(int(descends))
        network, random = empty(), torch.Generator().manual_seed(int(descends))
        if before is None:
            imitate(agent, network, scenes, options.imitation, random)
        else:
            network.load_state_dict(before)
            descend(agent, network, scenes, made(options.fresh, 1, False), options.steps, random)
        return network.state_dict()

    network = empty()
    network.load_state_dict(kept(options.work / f"network_{kind}.pt", lambda: learn(True)))
    return network.eval()


def held_out(options: Options) -> list[Moment]:
    """Beliefs of runs that were not trained on, one of each."""

    def record() -> list[tuple[Any, ...]]:
        task, agent = parts(*RECORDING)
        return [tuple(one_of(task, agent, seed)) for seed in range(1300, 1300 + options.beliefs)]

    return [Moment(*one) for one in kept(options.work / f"held_out_{options.beliefs}.pt", record)]


def methods_of(own: bool) -> list[Method]:
    """Planners to compare, with the network or alone."""
    kinds = WITH if own else ALONE
    return [Method(own, samples, k, narrow) for (samples, narrow), counts in kinds.items() for k in counts]


def judge_all(options: Options, network: ProposalNetwork, store: Store) -> None:
    """Judge all methods by every belief, from noise and where there is one from the plan before."""
    _, agent = parts(*USUAL)
    methods = [*methods_of(False), *methods_of(True)]
    recorded = held_out(options)
    judge(agent, network, recorded[0], methods[-1], warm=False)  # kernels are loaded
    for warm in (False, True):
        for moment in recorded:
            if warm and moment.knots is None:
                continue
            settings = {"part": "belief", "seed": moment.seed, "step": moment.step, "warm": warm} | about(options)

            def work(moment: Moment = moment, warm: bool = warm) -> dict[str, Any]:
                return {one.name: judge(agent, network, moment, one, warm=warm) for one in methods}

            store.measure(settings, work)


def about(options: Options) -> dict[str, Any]:
    """What tells a line of one network from those of others."""
    names = ("episodes", "scenes", "fresh", "imitation", "steps")
    return {name: getattr(options, name) for name in names}


def run_all(options: Options, network: ProposalNetwork, store: Store) -> None:
    """Whole runs with and without proposals."""
    task, agent = parts(*USUAL)
    for seed in range(1400, 1400 + options.runs):
        for method in IN_RUNS:
            policy = method.policy(agent, network, FIRST if method.network else USUAL[2])
            store.measure(
                {"part": "run", "seed": seed, "network": method.network} | about(options),
                partial(whole_run, task, agent, policy, seed),
            )


def at_equal_time(lines: Sequence[Line], names: Sequence[str], seconds: float) -> list[float] | None:
    """Cost by belief of methods of rising time at a time between, linear between the means of their times.

    The quickest one's cost where there is less time than it takes, and None where there is more than the last takes.
    """
    times = [mean_of(lines, name, "seconds") for name in names]
    if seconds > times[-1]:
        return None
    if seconds <= times[0]:
        return [line[names[0]]["cost"] for line in lines]
    for (early, late), (name, following) in zip(pairwise(times), pairwise(names), strict=True):
        if seconds <= late:
            part = (seconds - early) / (late - early)
            return [(1.0 - part) * line[name]["cost"] + part * line[following]["cost"] for line in lines]
    return None


def best_alone(lines: Sequence[Line], seconds: float) -> list[float] | None:
    """Cost by belief, at some time, of that kind of KMPPI alone which is best on these very beliefs; None past all."""
    kinds = [[Method(False, *kind[:1], k, kind[1]).name for k in counts] for kind, counts in ALONE.items()]
    found = [costs for names in kinds if (costs := at_equal_time(lines, names, seconds)) is not None]
    return min(found, key=sum) if found else None


def mean_of(lines: Sequence[Line], name: str, of: str) -> float:
    """Mean of a figure of a method over beliefs."""
    return sum(line[name][of] for line in lines) / len(lines)


def table(lines: Sequence[Line]) -> str:
    """Markdown: cost and time by method, and by how much a network's plan is cheaper at equal and at twice the time."""
    heads = ("from", "beliefs", "planner", "cost", "ms", "cheaper at equal time by", "p", "at twice the time", "p")
    rows = ["| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    for warm, start in ((False, "noise"), (True, "the plan before")):
        some = [line for line in lines if line["part"] == "belief" and line["warm"] == warm]
        for one in [*methods_of(False), *methods_of(True)] if some else ():
            cost, seconds = (mean_of(some, one.name, of) for of in ("cost", "seconds"))
            cells = [start, str(len(some)), one.name, f"{cost:.3f}", f"{1e3 * seconds:.0f}"]
            for times in (1.0, 2.0):
                other = best_alone(some, times * seconds) if one.network else None
                if other is None:
                    cells += ["", ""]
                    continue
                test = paired([b - line[one.name]["cost"] for line, b in zip(some, other, strict=True)])
                cells += ["{mean:.3f} [{low:.3f}, {high:.3f}]".format(**test), f"{test['p']:.2g}"]
            rows.append("| " + " | ".join(cells) + " |")
    return "\n".join(rows)


def runs_table(lines: Sequence[Line]) -> str:
    """Markdown: whole runs."""
    rows = ["| planner | runs | right | sure and wrong | actions | seconds of a run |", "|---|---|---|---|---|---|"]
    for method in IN_RUNS:
        some = [line for line in lines if line["part"] == "run" and line["network"] == method.network]
        if not some:
            continue
        wrong = sum(line["sure"] and not line["right"] for line in some)
        each = [sum(line[of] for line in some) / len(some) for of in ("actions", "seconds")]
        cells = (method.name, len(some), sum(line["right"] for line in some), wrong, f"{each[0]:.2f}", f"{each[1]:.2f}")
        rows.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(rows)


def draw(lines: Sequence[Line], file: Path) -> None:
    """Cost over time of both, from noise and from the plan before."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, 2, figsize=(7, 3.4), layout="constrained", sharey=True)
    for axis, warm, title in zip(axes, (False, True), ("first plan, from noise", "from the plan before"), strict=True):
        some = [line for line in lines if line["part"] == "belief" and line["warm"] == warm]
        methods = [*methods_of(False), *methods_of(True)] if some else []
        for family in dict.fromkeys(one.family for one in methods):
            names = [one.name for one in methods if one.family == family]
            cost, seconds = ([mean_of(some, one, of) for one in names] for of in ("cost", "seconds"))
            axis.plot([1e3 * value for value in seconds], cost, "o-", label=family)
        axis.set(title=title, xlabel="processor time of a plan, ms")
    axes[0].set_ylabel("cost of the plan")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    figure.savefig(file, dpi=150)
    pyplot.close(figure)


def main(options: Options) -> None:
    """Do what is not done yet, print tables, draw."""
    torch.set_num_threads(1)
    store, network = Store(options.out / "plan_proposals.jsonl"), trained(options)
    judge_all(options, network, store)
    run_all(options, network, store)
    lines = [line for line in store.flat() if about(options).items() <= line.items()]
    print(table(lines), runs_table(lines), sep="\n\n")
    options.figures.mkdir(parents=True, exist_ok=True)
    draw(lines, options.figures / "plan_proposals.png")


if __name__ == "__main__":
    script(lambda: main(tyro.cli(Options)))
