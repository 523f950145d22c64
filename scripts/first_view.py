"""Hold the first belief of the mug tasks against a one-degree sweep of the discrepancy.

    python -m scripts.first_view --seeds 20 --figure scripts/docs/figures/first_view.png

Plausible is a yaw whose best pose weighs at least 1 % of the best pose of all. The particles should cover the plausible
arc without a gap over 15 degrees, and at most 1 % of them should lie outside it.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import torch
import tyro
from torch import Tensor

from rumi.cache import cache_folder
from rumi.cli import script
from rumi.errors import UsageError
from rumi.registration.descent import DescentSettings, descend
from rumi.seeding import split
from rumi.tasks.rummage.build import build
from rumi.tasks.rummage.first_belief import first_belief
from rumi.tasks.rummage.settings import preset
from sdf import se3
from sensors.discrepancy import Discrepancy
from sensors.observation import Observation, merge
from sensors.semantics import Semantics

# a lever this long damps every turn out: the descent then moves x and y alone
SHIFT_ONLY = DescentSettings(iterations=12, lever_m=1e3)


@dataclass(frozen=True)
class Options:
    """How much to check, and where to draw it."""

    tasks: tuple[str, ...] = ("mug-0", "mug-1", "mug-2")
    seeds: int = 20
    figure: Path | None = None


def sweep(discrepancy: Discrepancy, memory: Observation, centre: Tensor, count: int = 360) -> Tensor:
    """Least discrepancy over x and y at each of `count` yaws.

    From `centre`, and from whichever origin of a small cross about it suits the seen surface best: an origin a wall
    too near is a local minimum.
    """
    yaw = torch.arange(count) * (2 * math.pi / count) - math.pi
    cross = torch.tensor([[0.0, 0.0], [0.004, 0.0], [-0.004, 0.0], [0.0, 0.004], [0.0, -0.004]])
    origin = (centre + cross).repeat_interleave(count, 0)
    starts = se3.from_planar(torch.cat((origin, yaw.repeat(len(cross))[:, None]), -1))
    surface = memory[memory.of_class(Semantics.SURFACE).nonzero()[:, 0]]
    shifted = torch.cat([descend(discrepancy, part, surface, "SE(2)", SHIFT_ONLY) for part in starts.split(100)])
    cost = torch.cat([discrepancy(part, surface) for part in shifted.split(100)]).reshape(len(cross), count)
    best = shifted.reshape(len(cross), count, 4, 4)[cost.argmin(0), torch.arange(count)]
    least = []
    for part in torch.cat((starts[:count], best)).split(90):
        found = descend(discrepancy, part, memory, "SE(2)", SHIFT_ONLY)
        least.append(discrepancy(found, memory))
    return torch.cat(least).reshape(2, count).amin(0)


class Judged(NamedTuple):
    """Particles held against a sweep: widest gap in the plausible arc, share outside it, and the arc itself."""

    gap_deg: float
    outside: float
    plausible_deg: int


def judge(weight: Tensor, yaw_deg: Tensor) -> Judged:
    """Hold the particles of one seed against the weights of a sweep."""
    plausible = weight >= 0.01 * weight.max()
    nearest = ((yaw_deg + 180.0).round().long()) % len(weight)
    # a particle half a degree beyond the last plausible yaw of the sweep is not outside
    near = plausible | plausible.roll(1) | plausible.roll(-1)
    outside = float((~near[nearest]).float().mean())
    taken = torch.zeros(len(weight), dtype=torch.bool)
    taken[nearest] = True
    gap = 0
    run = 0
    for at in list(range(len(weight))) * 2:
        run = 0 if taken[at] or not plausible[at] else run + 1
        gap = max(gap, run)
    return Judged(float(gap), outside, int(plausible.sum()))


def main(options: Options) -> list[Judged]:
    """Sweep each task once, initialise it with every seed, print and draw; gives the worst of each task."""
    if options.seeds < 1:
        raise UsageError(f"Expected --seeds of 1 or more, got {options.seeds}")
    drawn, worst = [], []
    for name in options.tasks:
        parts = build(preset("default", task=name), cache_dir=cache_folder())
        task, rummager = parts.task, parts.agent
        reading = task.reset(0).reading
        none = Observation.empty()
        memory, _ = merge(none, reading.observation, rummager.filter.lattice)
        beliefs = [
            first_belief(rummager, reading, generator=split(seed, "initialise"))[0] for seed in range(options.seeds)
        ]
        best = min(beliefs, key=lambda b: float(b.discrepancy.min()))
        centre = best.attached_T_object[best.discrepancy.argmin(), :2, 3]
        cost = sweep(rummager.filter.discrepancy, memory, centre)
        least = torch.minimum(cost.min(), best.discrepancy.min())
        weight = torch.exp(-rummager.filter.settings.peakiness * (cost - least))
        yaws = [torch.rad2deg(se3.to_planar(b.world_T_object)[:, 2]) for b in beliefs]
        figures = [judge(weight, yaw) for yaw in yaws]
        gap, outside = max(f.gap_deg for f in figures), max(f.outside for f in figures)
        worst.append(Judged(gap, outside, figures[0].plausible_deg))
        print(
            f"{name}: plausible {figures[0].plausible_deg} of 360 degrees; worst of {options.seeds} seeds: "
            f"gap {gap:.0f} degrees, outside {100 * outside:.1f} %"
        )
        drawn.append((name, weight, yaws))
        task.close()
    if options.figure is not None:
        draw(drawn, options.figure)
    return worst


def draw(drawn: list[tuple[str, Tensor, list[Tensor]]], path: Path) -> None:
    """One row a task: the sweep's weight over yaw, and every seed's particles below it."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(1, len(drawn), figsize=(4.2 * len(drawn), 3.2), sharey=True, layout="constrained")
    for axis, (name, weight, yaws) in zip(axes if len(drawn) > 1 else [axes], drawn, strict=True):
        degrees = torch.arange(len(weight)) - 180.0
        axis.fill_between(degrees, 1e-4, (weight / weight.max()).clamp_min(1e-4), color="#9ecae1", label="sweep")
        axis.axhline(0.01, color="#636363", lw=0.8, ls="--", label="1 % of the best")
        for seed, yaw in enumerate(yaws):
            axis.plot(yaw, torch.full_like(yaw, 2.0 * 1.28**seed), ".", ms=1.5, color="#d94801", rasterized=True)
        axis.set(yscale="log", ylim=(1e-4, 2.0 * 1.28 ** (len(yaws) + 1)), xlim=(-180, 180), title=name)
        axis.set_xlabel("yaw of the handle [deg]")
        axis.set_xticks(range(-180, 181, 60))
        axis.set_yticks([1e-4, 1e-2, 1.0])
    (axes if len(drawn) > 1 else [axes])[0].set_ylabel("relative weight   |   particles by seed")
    (axes if len(drawn) > 1 else [axes])[0].legend(frameon=False, loc="lower left", fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=160)


if __name__ == "__main__":
    script(lambda: main(tyro.cli(Options, description=__doc__)))
