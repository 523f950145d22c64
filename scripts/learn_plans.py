"""A plan proposal network, trained by gradient through pushing, in KMPPI: better plans at equal time?

    python -m scripts.learn_plans                       # record, train, judge, whole runs: lines and a figure
    python -m scripts.learn_plans --episodes 4 --steps 20 --beliefs 5 --runs 2 --out learnt --figures learnt

Beliefs are those of runs of the task `mug`, whose scene the seed draws. The network (`scripts/plan_proposals.py`) gives
further nominal plans; KMPPI samples around the best of these and its own. A plan is judged by the planner's own cost,
with more poses, of beliefs that were not trained on; its time is the processor's, fields and network included.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro
from torch import Tensor

from rumi.cli import script
from rumi.tasks.rummage.agent import Rummager
from scripts.plan_judging import Method, Moment, judge, moments, one_of, paired, parts, whole_run
from scripts.plan_proposals import ProposalNetwork, Scenes, SoftCost, policy_of
from scripts.store import Line, Store

RECORDING = (100, 1, 4)  # samples and iterations of the planner that episodes are recorded by
USUAL = (2, 10)  # iterations of a later plan and of the first


@dataclass(frozen=True)
class Options:
    """Learn to propose plans.

    Attributes:
        episodes: recorded to train on, seeds from 2000 on.
        steps: of the optimiser.
        beliefs: held out, one of a run each, seeds from 1000 on.
        runs: whole ones, with and without the network, seeds from 1100 on.
        samples: of KMPPI.
        iterations: of KMPPI, to compare.
        work: folder that keeps episodes, held-out beliefs and the network.
        out: folder of plan_proposals.jsonl.
        figures: folder of plan_proposals.png.
    """

    episodes: int = 120
    steps: int = 700
    beliefs: int = 100
    runs: int = 4
    samples: int = 500
    iterations: tuple[int, ...] = (1, 2, 3)
    work: Path = Path("build/plan_proposals")
    out: Path = Path("scripts/results")
    figures: Path = Path("scripts/docs/figures")


def scenes_of(agent: Rummager, recorded: Sequence[Moment], random: torch.Generator, turns: int = 2) -> Scenes:
    """Scenes to train on: those recorded, and each turned about the arm's base a few times, by up to 20 degrees."""
    assert agent.tool.reach is not None
    base = agent.tool.reach.base
    angles = (0.7 * torch.rand(turns, len(recorded), generator=random) - 0.35).tolist()
    more = [one.turned(base, angle) for row in angles for one, angle in zip(recorded, row, strict=True)]
    every = [*recorded, *more]
    return Scenes.of([one.belief for one in every], [one.configuration for one in every], agent, random)


def train(
    agent: Rummager, scenes: Scenes, steps: int, random: torch.Generator, *, batch: int = 16, temperature: float = 0.05
) -> ProposalNetwork:
    """Train by the soft cost, whose width shrinks; of a scene's plans the best ones count (a soft minimum)."""
    network, cost = ProposalNetwork(policy_of(agent).settings.mppi), SoftCost(agent)
    optimiser = torch.optim.Adam(network.parameters(), lr=1e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    late = 0.0
    for step in range(steps):
        some = scenes.at(torch.randint(len(scenes.configuration), (batch,), generator=random))
        poses = some.poses[:, torch.randint(some.poses.shape[1], (2,), generator=random)]
        knots = network(some.seen.image, some.seen.tool)
        width = max(0.008, 0.08 * 0.1 ** min(1.0, step / (0.7 * steps)))
        costs = cost(network.planner.controls(knots), some, poses, width)
        optimiser.zero_grad()
        (-temperature * (-costs / temperature).logsumexp(-1)).mean().backward()
        norm = torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        if bool(norm.isfinite()):  # an object that is wedged has slopes without end
            optimiser.step()
        schedule.step()
        late = 0.95 * late + 0.05 * float(costs.detach().amin(-1).mean()) if step else float(costs.detach().mean())
        if step % 50 == 49:
            print(f"step {step + 1}: soft cost of the best {late:.3f}, width {1e3 * width:.0f} mm", flush=True)
    return network


def kept(file: Path, make: Callable[[], Any]) -> Any:  # noqa: ANN401  (what torch keeps)
    """What a file holds; made and kept where there is none."""
    if not file.is_file():
        file.parent.mkdir(parents=True, exist_ok=True)
        torch.save(make(), file)
    return torch.load(file, weights_only=True)


def trained(options: Options) -> ProposalNetwork:
    """The network, trained on recorded episodes; both are kept."""

    def record() -> list[tuple[Any, ...]]:
        task, agent = parts(*RECORDING)
        return [tuple(one) for seed in range(2000, 2000 + options.episodes) for one in moments(task, agent, seed)]

    def learn() -> dict[str, Tensor]:
        recorded = [Moment(*one) for one in kept(options.work / f"episodes_{options.episodes}.pt", record)]
        random = torch.Generator().manual_seed(0)
        torch.manual_seed(0)
        _, agent = parts(options.samples, *USUAL)
        return train(agent, scenes_of(agent, recorded, random), options.steps, random).state_dict()

    _, agent = parts(options.samples, *USUAL)
    network = ProposalNetwork(policy_of(agent).settings.mppi)
    network.load_state_dict(kept(options.work / f"network_{options.episodes}_{options.steps}.pt", learn))
    return network


def held_out(options: Options) -> list[Moment]:
    """Beliefs of runs that were not trained on, one of each."""

    def record() -> list[tuple[Any, ...]]:
        task, agent = parts(*RECORDING)
        return [tuple(one_of(task, agent, seed)) for seed in range(1000, 1000 + options.beliefs)]

    return [Moment(*one) for one in kept(options.work / f"held_out_{options.beliefs}.pt", record)]


def judge_all(options: Options, network: ProposalNetwork, store: Store) -> None:
    """Judge all methods by every belief, from noise and where there is one from the plan before."""
    _, agent = parts(options.samples, *USUAL)
    methods = [Method(own, count) for count in options.iterations for own in (False, True)]
    recorded = held_out(options)
    judge(agent, network, recorded[0], methods[-1], options.samples, warm=False)  # kernels are loaded
    for warm in (False, True):
        for moment in recorded:
            if warm and moment.knots is None:
                continue
            settings = {"part": "belief", "seed": moment.seed, "step": moment.step, "warm": warm} | about(options)

            def work(moment: Moment = moment, warm: bool = warm) -> dict[str, Any]:
                return {one.name: judge(agent, network, moment, one, options.samples, warm=warm) for one in methods}

            store.measure(settings, work)


def about(options: Options) -> dict[str, Any]:
    """What tells a line of one network and planner from those of others."""
    return {"episodes": options.episodes, "steps": options.steps, "samples": options.samples}


def run_all(options: Options, network: ProposalNetwork, store: Store) -> None:
    """Whole runs with and without proposals."""
    task, agent = parts(options.samples, *USUAL)
    for seed in range(1100, 1100 + options.runs):
        for own in (False, True):
            chosen = network if own else None
            store.measure(
                {"part": "run", "seed": seed, "network": own} | about(options),
                lambda seed=seed, chosen=chosen: whole_run(task, agent, chosen, seed),
            )


def at_equal_time(lines: Sequence[Line], iterations: Sequence[int], seconds: float) -> list[float]:
    """Cost of KMPPI alone by belief, linear in time between the numbers of iterations, whose times are means."""
    alone = [Method(False, count).name for count in iterations]
    times = [mean_of(lines, name, "seconds") for name in alone]
    later = next((k for k, time in enumerate(times) if time >= seconds), len(times) - 1)
    early = max(later - 1, 0)
    whole = times[later] - times[early]
    part = min(max((seconds - times[early]) / whole, 0.0), 1.0) if whole > 0 else 1.0
    return [(1.0 - part) * line[alone[early]]["cost"] + part * line[alone[later]]["cost"] for line in lines]


def mean_of(lines: Sequence[Line], name: str, of: str) -> float:
    """Mean of a figure of a method over beliefs."""
    return sum(line[name][of] for line in lines) / len(lines)


def table(options: Options, lines: Sequence[Line]) -> str:
    """Markdown: cost and time by method, and by how much a network's plan is cheaper at equal time."""
    heads = ("from", "beliefs", "planner", "cost", "ms", "cheaper than KMPPI at equal time by", "p")
    rows = ["| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    for warm, start in ((False, "noise"), (True, "the plan before")):
        some = [line for line in lines if line["part"] == "belief" and line["warm"] == warm]
        for one in [Method(own, count) for own in (False, True) for count in options.iterations] if some else ():
            cost, seconds = (mean_of(some, one.name, of) for of in ("cost", "seconds"))
            cells = [start, str(len(some)), one.name, f"{cost:.3f}", f"{1e3 * seconds:.0f}", "", ""]
            if one.network:
                other = at_equal_time(some, options.iterations, seconds)
                test = paired([b - line[one.name]["cost"] for line, b in zip(some, other, strict=True)])
                cells[5:] = ["{mean:.3f} [{low:.3f}, {high:.3f}]".format(**test), f"{test['p']:.2g}"]
            rows.append("| " + " | ".join(cells) + " |")
    return "\n".join(rows)


def runs_table(lines: Sequence[Line]) -> str:
    """Markdown: whole runs."""
    rows = ["| planner | runs | right | sure and wrong | actions | seconds of a run |", "|---|---|---|---|---|---|"]
    for own, name in ((False, "KMPPI"), (True, "network and KMPPI")):
        some = [line for line in lines if line["part"] == "run" and line["network"] == own]
        if not some:
            continue
        wrong = sum(line["sure"] and not line["right"] for line in some)
        each = [sum(line[of] for line in some) / len(some) for of in ("actions", "seconds")]
        cells = (name, len(some), sum(line["right"] for line in some), wrong, f"{each[0]:.2f}", f"{each[1]:.2f}")
        rows.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(rows)


def draw(options: Options, lines: Sequence[Line], file: Path) -> None:
    """Cost over time of both, from noise and from the plan before."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, 2, figsize=(7, 2.8), layout="constrained", sharey=True)
    for axis, warm, title in zip(axes, (False, True), ("first plan, from noise", "from the plan before"), strict=True):
        some = [line for line in lines if line["part"] == "belief" and line["warm"] == warm]
        for own, name in ((False, "KMPPI"), (True, "network and KMPPI")) if some else ():
            names = [Method(own, count).name for count in options.iterations]
            cost, seconds = ([mean_of(some, one, of) for one in names] for of in ("cost", "seconds"))
            axis.plot([1e3 * value for value in seconds], cost, "o-", label=name)
        axis.set(title=title, xlabel="processor time of a plan, ms")
    axes[0].set_ylabel("cost of the plan")
    axes[0].legend()
    figure.savefig(file, dpi=150)
    pyplot.close(figure)


def main(options: Options) -> None:
    """Do what is not done yet, print tables, draw."""
    torch.set_num_threads(1)
    store, network = Store(options.out / "plan_proposals.jsonl"), trained(options)
    judge_all(options, network, store)
    run_all(options, network, store)
    lines = [line for line in store.flat() if about(options).items() <= line.items()]
    print(table(options, lines), runs_table(lines), sep="\n\n")
    options.figures.mkdir(parents=True, exist_ok=True)
    draw(options, lines, options.figures / "plan_proposals.png")


if __name__ == "__main__":
    script(lambda: main(tyro.cli(Options)))
