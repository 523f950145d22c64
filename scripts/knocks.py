"""A pushed slider that is knocked by hand: how soon a filter of its pose notices, and how often it is wrong about it.

python -m scripts.knocks run       # needs RUMI_DATA for "recorded"; again to go on
python -m scripts.knocks show
python -m scripts.knocks figure

A belief covers again once its 95 % region holds the truth over five readings. Recorded runs are thinned to 50 Hz, and
normal noise of 1 mm and 1 degree is added to every pose of the tracker, anew by the seed; how they are labelled stands
in scripts/bench/real_knocks.py. "faultless" and "knocked" are 50 s each of pushes of the same square, simulated by the
filter's own model with a drawn way of sliding, a drawn place of the tool, 0.5 % of outliers and 2 % of repeated
readings; knocks of 8 to 40 mm and up to 30 degrees, over 60 ms, come every 5 s.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
import tyro

from rumi.belief.pushed_pose import PushedPoseFilter, PushedPoseSettings
from rumi.belief.pushed_pose_reading import PushedPoseBelief
from rumi.cli import script
from rumi.dynamics.along_path import push_along_path
from rumi.dynamics.push_parameters import sliding_of
from rumi.seeding import split
from scripts.bench import real_knocks
from scripts.bench.real_knocks import Knock
from scripts.bench.real_pushes import square_body
from scripts.experiment import FIGURES, Experiment, Line
from scripts.reproduce.cells import rate, table

KINDS = ("recorded", "faultless", "knocked")
STEP_S, SECONDS, PART_S = 0.02, 50.0, 5.0
FOUND_S, COVERED_S = 0.2, 1.0
NOISE = (1e-3, 1e-3, math.radians(1.0))
_SPEED_M = 0.05 * STEP_S


class Readings(NamedTuple):
    """Readings at 50 Hz.

    Attributes:
        tip: (n, 3), the tool's path.
        pose: (n, 3), what the tracker said.
        truth: (n, 3), where the slider was.
        knocks: when it was knocked.
        good: (n), whether nothing was wrong.
    """

    tip: torch.Tensor
    pose: torch.Tensor
    truth: torch.Tensor
    knocks: list[Knock]
    good: np.ndarray


def recorded(name: str, seed: int) -> Readings:
    """A recorded run with the noise of a seed: a pose that the tracker repeats keeps its noise."""
    run = real_knocks.runs()[name]
    fresh = np.concatenate(([True], (np.diff(run.pose, axis=0) != 0).any(1)))
    generator = split(seed, f"knocks {name}")
    noise = torch.randn((int(fresh.sum()), 3), generator=generator, dtype=torch.float64).numpy() * NOISE
    times = np.arange(0.0, run.time[-1], STEP_S)
    read, true = run._replace(pose=run.pose + noise[np.cumsum(fresh) - 1]).at(times), run.at(times)
    tip = torch.tensor(np.concatenate((read.tip, np.zeros((len(times), 1))), 1))
    good = real_knocks.faultless(run, times)
    return Readings(tip, torch.tensor(read.pose), torch.tensor(true.pose), real_knocks.knocks(run), good)


def simulated(seed: int, *, knocked: bool) -> Readings:
    """Pushes of the square from all sides, drawn from the filter's model."""
    generator, body, own = split(seed, f"simulated knocks {knocked}"), square_body(), PushedPoseSettings()

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(shape, generator=generator, dtype=torch.float64)

    def even(low: float, high: float) -> float:
        return low + (high - low) * float(torch.rand((), generator=generator))

    prior = PushedPoseFilter(body).prior
    drawn = torch.tensor(prior.mean) + torch.tensor(prior.deviation) * normal(1, 8)
    sliding, place = sliding_of(drawn, body.support), torch.cat((own.tool_m * normal(2), torch.zeros(1)))
    tips: list[torch.Tensor] = []
    truths: list[torch.Tensor] = []
    reads: list[torch.Tensor] = []
    spans: list[Knock] = []
    pose = torch.zeros(1, 3, dtype=torch.float64)
    count, part = round(SECONDS / STEP_S), round(PART_S / STEP_S)
    tip, heading, left = torch.zeros(3, dtype=torch.float64), 0.0, torch.zeros(3, dtype=torch.float64)
    for k in range(count):
        before = tip
        if k % part == 0:  # lifted, and put down on another side
            heading, aside = even(-math.pi, math.pi), even(-0.02, 0.02)
            along = torch.tensor([math.cos(heading), math.sin(heading), 0.0], dtype=torch.float64)
            across = torch.tensor([-math.sin(heading), math.cos(heading), 0.0], dtype=torch.float64)
            tip = before = pose[0] * torch.tensor([1.0, 1.0, 0.0]) - 0.075 * along + aside * across
        else:
            heading += 0.02 * float(normal())
            tip = tip + _SPEED_M * torch.tensor([math.cos(heading), math.sin(heading), 0.0], dtype=torch.float64)
        if knocked and k % part == part // 2 + seed % 7:
            way, size = even(-math.pi, math.pi), even(0.008, 0.04)
            left = torch.tensor([size * math.cos(way), size * math.sin(way), math.radians(even(-30.0, 30.0))]) / 3.0
            spans.append(Knock(STEP_S * (k - 1), STEP_S * (k + 2)))
        path = torch.stack((before, tip)) + place
        moved = push_along_path(pose, path[None], body.pusher, body.outline, sliding, substeps=1).track[:, -1]
        pose = moved + PushedPoseFilter(body).model.motion.variance(moved - pose).sqrt() * normal(1, 3)
        if spans and STEP_S * k <= spans[-1].end:
            pose = pose + left
        read = pose[0] + torch.tensor(NOISE, dtype=torch.float64) * normal(3)
        chance = even(0.0, 1.0)
        if chance < 0.005:
            read = pose[0] + torch.tensor((own.outlier_m[0], own.outlier_m[0], own.outlier_rad[0])) * normal(3)
        elif chance < 0.025 and reads:
            read = reads[-1]
        for found, value in ((tips, tip), (truths, pose[0]), (reads, read)):
            found.append(value)
    times = STEP_S * np.arange(count)
    good = np.ones(count, dtype=bool)
    for span in spans:
        good &= (times < span.begin - 0.05) | (times > span.end + 0.5)
    return Readings(torch.stack(tips), torch.stack(reads), torch.stack(truths), spans, good)


def lifted(tip: torch.Tensor) -> np.ndarray:
    """Whether the tool was lifted and put down elsewhere just before each reading."""
    return np.concatenate(([False], (tip.diff(dim=0).norm(dim=-1) > 0.03).numpy()))


def follow(readings: Readings, seed: int, each: Callable[[PushedPoseBelief], Any]) -> list[Any]:
    """What is asked of the belief after each reading."""
    generator, own = split(seed, "knocks filter"), PushedPoseFilter(square_body())
    belief = own.initial(readings.pose[0], generator=generator)
    found, jumps = [each(belief)], lifted(readings.tip)
    for k in range(1, len(readings.pose)):
        path = readings.tip[[k if jumps[k] else k - 1, k]]
        belief = own.step(belief, path, readings.pose[k], generator=generator)
        found.append(each(belief))
    return found


def covers(belief: PushedPoseBelief, truth: torch.Tensor, level: float = 7.815) -> bool:
    """Whether the ellipse that holds 95 % of a normal belief holds the truth."""
    off = belief.mean() - truth
    off[2] = (off[2] + math.pi) % (2.0 * math.pi) - math.pi
    root = belief.covariance() + 1e-12 * torch.eye(3, dtype=torch.float64)
    return float(off @ torch.linalg.solve(root, off)) <= level


def counted(readings: Readings, seed: int) -> dict[str, Any]:
    """Knocks found, alarms without, and how well the belief covers."""
    truths = iter(readings.truth)
    seen = follow(readings, seed, lambda belief: (belief.alarm, belief.fault, covers(belief, next(truths))))
    times = STEP_S * np.arange(len(seen))
    alarm, good = np.array([flag for flag, _, _ in seen]), readings.good
    covered = np.array([inside for _, _, inside in seen])
    delays, named, again = [], [], []
    for knock in readings.knocks:
        rows = np.flatnonzero(alarm & (times >= knock.begin) & (times <= knock.begin + 0.5))
        delays.append(float(times[rows[0]] - knock.begin) if len(rows) else math.inf)
        named.append(seen[rows[0]][1] if len(rows) else None)
        after = np.flatnonzero(times > knock.end)[: round(COVERED_S / STEP_S)]
        again.append(
            next((round(float(times[row] - knock.end), 3) for row in after if covered[row : row + 5].all()), None)
        )
    false = alarm & good
    return {
        "delays": [round(delay, 3) if delay < math.inf else None for delay in delays],
        "named": named,
        "covers_again_s": again,
        "good_s": STEP_S * float(good.sum()),
        "false_alarms": int(false.sum()),
        "false_named": [seen[row][1] for row in np.flatnonzero(false)],
        "other_s": STEP_S * float((~good).sum()),
        "covered": float(covered[good].mean()),
    }


def measure(readings: str, seed: int) -> dict[str, Any]:
    """Sums over the recorded runs, or over one simulated one."""
    if readings != "recorded":
        return counted(simulated(seed, knocked=readings == "knocked"), seed)
    each = [counted(recorded(name, seed), seed) for name in real_knocks.runs()]
    joined = {
        name: [value for own in each for value in own[name]] for name in each[0] if isinstance(each[0][name], list)
    }
    sums = {name: sum(own[name] for own in each) for name in ("good_s", "false_alarms", "other_s")}
    covered = sum(own["covered"] * own["good_s"] for own in each) / sums["good_s"]
    return joined | sums | {"covered": covered}


def show(lines: list[Line], chosen: Mapping[str, tuple[Any, ...]]) -> str:
    """A row for each kind of readings."""
    rows = []
    for kind in chosen.get("readings", KINDS):
        own = [line for line in lines if line["readings"] == kind]
        if not own:
            continue
        delays = [delay for line in own for delay in line["delays"]]
        soon = [delay is not None and delay <= FOUND_S + 1e-9 for delay in delays]
        known = sorted(delay for delay in delays if delay is not None)
        named = [name == "knocked" for line in own for name in line["named"]]
        again = [value is not None for line in own for value in line["covers_again_s"]]
        good = sum(line["good_s"] for line in own)
        cells = ["-"] * 4
        if delays:
            middle = f"{1e3 * known[len(known) // 2]:.0f} ms" if known else "-"
            cells = [rate(soon), middle, rate(named), rate(again)]
        covered = sum(line["covered"] * line["good_s"] for line in own) / good
        rows.append(
            [kind, *cells, f"{sum(line['false_alarms'] for line in own)} in {good:.0f} s", f"{100 * covered:.0f} %"]
        )
    heads = ("readings", "knocks found within 0.2 s", "median", 'named "knocked"', "covers again after 1 s")
    return table((*heads, "alarms without a fault", "95 % region holds"), rows)


@dataclass(frozen=True)
class Figure:
    """Draw a run that is knocked, notices, and finds the slider again."""

    run: str = "StraightLineBigPertubations"
    seed: int = 0
    out: Annotated[Path, tyro.conf.arg(help="image file")] = FIGURES / "knocks.png"


def draw(options: Figure) -> None:
    """Evidence, error and region over time, and the slider before and after."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    readings = recorded(options.run, options.seed)
    test = PushedPoseFilter(square_body()).test
    seen = follow(
        readings,
        options.seed,
        lambda belief: (
            float(test.log_evidence(belief.evidence)),
            belief.alarm,
            belief.mean().numpy(),
            2.0 * belief.covariance().diagonal().sqrt().numpy(),
        ),
    )
    times, truth = STEP_S * np.arange(len(seen)), readings.truth.numpy()
    mean, wide = (np.stack([own[part] for own in seen]) for part in (2, 3))
    alarms = times[[own[1] for own in seen]]
    figure, axes = plt.subplots(3, 1, figsize=(8.0, 6.5), sharex=True, constrained_layout=True)
    for axis, part, scale, label in (
        (axes[0], 1, 1e3, "across the line, mm"),
        (axes[1], 2, 180 / math.pi, "yaw, degrees"),
    ):
        axis.plot(times, scale * readings.pose[:, part], ".", ms=2, color="0.6", label="readings")
        axis.plot(times, scale * truth[:, part], "k", lw=1, label="tracker without noise")
        low, high = scale * (mean - wide)[:, part], scale * (mean + wide)[:, part]
        axis.fill_between(times, low, high, color="C0", alpha=0.4, lw=0, label="belief, 2 deviations")
        axis.set_ylabel(label)
    axes[2].plot(times, [own[0] for own in seen], "C0", lw=1)
    axes[2].axhline(test.threshold, color="0.5", lw=1, ls="--")
    axes[2].set_ylabel("evidence of a fault, nats")
    axes[2].set_xlabel("time, s")
    for axis in axes:
        for knock in readings.knocks:
            axis.axvspan(*knock, color="C1", alpha=0.25, lw=0)
        for time in alarms:
            axis.axvline(time, color="C3", lw=0.8)
    axes[0].legend(frameon=False, fontsize=8)
    figure.savefig(options.out, dpi=120)
    plt.close(figure)


EXPERIMENT = Experiment(
    __doc__, "knocks.jsonl", {"readings": KINDS}, measure, show, seeds="0-19", commands={"figure": (Figure, draw)}
)

if __name__ == "__main__":
    script(EXPERIMENT.main)
