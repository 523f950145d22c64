"""Width of the belief over trajectories against a reference posterior: volumes of 90 % regions after recorded updates.

python -m scripts.trajectory_widths record      # closed loops of `mug`: their readings
python -m scripts.trajectory_widths run         # the filter on them, and long chains
python -m scripts.trajectory_widths show

The reference after an update with contact is a long chain: the filter's own particles of two independent runs, each
moved by 40 more whole sweeps under the full history, whose kernels leave the posterior as it is; the first ten are left
out. Volumes are by the density of near neighbours in (x, y, yaw), of as many particles each.
"""

import math
import statistics
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.belief.pose_trajectories import PoseTrajectoryBelief
from rumi.belief.pose_trajectory_filter import PoseTrajectoryFilter
from rumi.belief.trajectory_moves import Moves
from rumi.cli import script
from rumi.loop import run_to_end
from rumi.resampling import systematic
from rumi.seeding import split
from rumi.tasks.rummage.build import build
from rumi.tasks.rummage.first_belief import first_belief
from scripts.experiment import Experiment
from scripts.reproduce.cells import table
from scripts.reproduce.seeds import seeds_of
from scripts.store import Figures, Line
from scripts.trajectory_runs import DEFAULTS, Options, settings_of
from sdf.so3 import wrap

EPISODES = Path("runs/trajectory_widths")
_SWEEPS, _BURN_IN, _EVERY, _STREAMS = 40, 10, 5, 2
_NEIGHBOUR, _SHARE = 12, 0.9
_SCALE = (1e-3, 1e-3, math.radians(1.5))  # that count as equal distances


@dataclass(frozen=True)
class Record:
    """Record the readings of closed loops of `mug`, of those seeds that have none yet.

    Attributes:
        seeds: such as 1000-1009.
    """

    seeds: str = "1000-1009"


def record(options: Record) -> None:
    """Readings of closed loops, a file each."""
    EPISODES.mkdir(parents=True, exist_ok=True)
    for seed in seeds_of(options.seeds):
        if (path := _path(seed)).is_file():
            continue
        readings: list[Any] = []
        with build(settings_of(Options(), "trajectory", seed), cache_dir=Path("runs/cache")) as (task, agent):
            run_to_end(task, agent, seed=seed, on_step=lambda step, kept=readings: kept.append(step.reading))
        torch.save(readings, path)


def volume(poses: Float[Tensor, "N 3"]) -> float:
    """Volume of the region of 90 % of a population of (x, y, yaw): mean inverse density of its densest 90 %."""
    off = torch.cat((poses[:, :2], wrap(poses[:, 2:] - poses[:1, 2:])), -1) / poses.new_tensor(_SCALE)
    radius = torch.cdist(off, off).fill_diagonal_(torch.inf).kthvalue(min(_NEIGHBOUR, len(off) - 1), -1).values
    dense = radius.sort().values[: max(1, round(_SHARE * len(off)))]
    return float(dense.pow(3).sum()) * 4.0 / 3.0 * math.pi / _NEIGHBOUR


def widths(particles: int, rounds: int, seed: int) -> Figures:
    """Of every update of an episode with contact: the belief's volume, and the reference's by each stream."""
    readings = torch.load(_path(seed), weights_only=False)
    updates: dict[int, dict[str, list[Any]]] = {}
    effort = f"filter.trajectories.particles={particles}", f"filter.trajectories.rounds={rounds}"
    with build(settings_of(Options(set=effort), "trajectory", seed), cache_dir=Path("runs/cache")) as (_, agent):
        follow = agent.filter
        assert isinstance(follow, PoseTrajectoryFilter)
        for stream in range(_STREAMS):
            random = split(seed, f"widths {stream}")
            belief, memory = first_belief(agent, readings[0], generator=random)
            for index, reading in enumerate(readings[1:], 1):
                belief, memory, _ = follow(belief, memory, reading, generator=random)
                if bool(reading.in_contact.any()):
                    assert isinstance(belief, PoseTrajectoryBelief)
                    found, chain = reference(follow, belief, random)
                    own = updates.setdefault(index, {"belief": [], "reference": [], "deviations": [], "of": []})
                    own["belief"].append(round(volume(found), 4))
                    own["reference"].append([round(volume(part), 4) for part in chain])
                    own["deviations"].append(_deviations(found))
                    own["of"].append(_deviations(torch.cat(chain)))
    return {"updates": [{"action": index, **own} for index, own in updates.items()]}


def reference(
    follow: PoseTrajectoryFilter, belief: PoseTrajectoryBelief, random: torch.Generator
) -> tuple[Tensor, list[Tensor]]:
    """Equally weighted poses (N, 3) of a belief, and of populations of as many along a long chain from there."""
    assert belief.trajectories is not None
    now = belief.trajectories.at(systematic(belief.log_weights.double(), 0.5, len(belief.trajectories)))
    own, moves = now.pose, Moves(follow.model, follow.own, random)
    chain: list[Tensor] = []
    for sweep in range(_SWEEPS):
        now = moves.sweep(now, now.history, whole=True, rounds=2)
        if sweep >= _BURN_IN and sweep % _EVERY == 0:
            chain.append(now.pose)
    return own, chain


def _path(seed: int) -> Path:
    return EPISODES / f"mug-{seed}.pt"


def _deviations(poses: Float[Tensor, "N 3"]) -> list[float]:
    off = torch.cat((poses[:, :2], wrap(poses[:, 2:] - poses[:1, 2:])), -1) / poses.new_tensor(_SCALE)
    return [round(value, 4) for value in off.std(0).tolist()]


def show(lines: list[Line], chosen: Mapping[str, tuple[Any, ...]]) -> str:
    """Ratios of volumes and deviations, and what two streams' references differ by."""
    rows = []
    for effort in dict.fromkeys((line["particles"], line["rounds"]) for line in lines):
        every = [own for line in lines if (line["particles"], line["rounds"]) == effort for own in line["updates"]]
        ratios, apart, deviations = [], [], []
        for own in every:
            means = [statistics.mean(chain) for chain in own["reference"]]
            off = [math.log(value / statistics.mean(means)) for value in own["belief"]]
            ratios.append(math.exp(statistics.mean(off)))
            apart.append(means[0] / means[1])
            pairs = (zip(*own[name], strict=True) for name in ("deviations", "of"))
            deviations.append([sum(a) / sum(b) for a, b in zip(*pairs, strict=True)])
        within = sum(0.7 <= value <= 1.5 for value in ratios) / len(ratios)
        low, high = _interval(ratios)
        axes = ", ".join(f"{statistics.median(column):.2f}" for column in zip(*deviations, strict=True))
        middle = f"{statistics.median(ratios):.2f} [{low:.2f}, {high:.2f}]"
        rows.append(
            [*map(str, effort), str(len(ratios)), middle, _tails(ratios), f"{100 * within:.0f} %", axes, _tails(apart)]
        )
    head = (
        "particles",
        "rounds",
        "updates",
        "volume over the reference's, median",
        "10, 50, 90 %",
        "within 0.7 to 1.5",
    )
    return table((*head, "deviations of x, y, yaw over its", "one reference over the other: 10, 50, 90 %"), rows)


def _tails(values: list[float]) -> str:
    ordered = sorted(values)
    return ", ".join(f"{ordered[min(len(ordered) - 1, int(share * len(ordered)))]:.2f}" for share in (0.1, 0.5, 0.9))


def _interval(values: list[float]) -> tuple[float, float]:
    """Of the median, by drawing updates anew: 95 %."""
    random = torch.Generator().manual_seed(0)
    some = torch.tensor(values)[torch.randint(len(values), (1000, len(values)), generator=random)].median(-1).values
    return float(some.quantile(0.025)), float(some.quantile(0.975))


EXPERIMENT = Experiment(
    __doc__,
    "trajectory_widths.jsonl",
    {"particles": (150, 300), "rounds": (2, 4)},
    widths,
    show,
    seeds="1000-1009",
    usual={"particles": (150,), "rounds": (2,)},
    identity=lambda variant: {"defaults": DEFAULTS},
    commands={"record": (Record, record)},
)

if __name__ == "__main__":
    script(EXPERIMENT.main)
