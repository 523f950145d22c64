"""Run time against error, drawn."""

import statistics
from collections import defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from rumi.tasks.rummage.settings import PRESETS, preset
from rumi.viz import style
from scripts.reproduce.intervals import wilson
from scripts.store import Store

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Row = dict[str, Any]
_WHERE = {"part", "situation", "points", "seed", "threads", "commit", "machine"}  # what does not make another setting
_MARKS = {"default": "*", "fast": "D", "paper": "P"}


class Dot(NamedTuple):
    """Settings with their time and their error.

    Attributes:
        settings: what tells it from others.
        seconds: that it takes.
        error: mean over situations and seeds.
    """

    settings: Row
    seconds: float
    error: float


def draw(store: Store, out: Path) -> list[Path]:
    """Draw what a store of `scripts.bench.pareto` holds.

    Args:
        store: measurements; a panel without any is left empty.
        out: folder of the pictures; made if need be.

    Returns:
        the files written.
    """
    out.mkdir(parents=True, exist_ok=True)
    path = out / "pareto.png"
    with style.figure(15.0, 3.8) as made:
        fields, shares, runs = made.subplots(1, 3)
        _fields(field_dots(store), fields)
        _beliefs(store, shares)
        _runs(store.of("run"), runs)
        made.savefig(path)
    return [path]


def front(dots: Iterable[Dot]) -> list[Dot]:
    """Those than which no other is both quicker and better, quickest first."""
    best: list[Dot] = []
    for dot in sorted(dots, key=lambda d: (d.seconds, d.error)):
        if not best or dot.error < best[-1].error:
            best.append(dot)
    return best


def field_dots(store: Store) -> list[Dot]:
    """Mean error of the information, nats, of the filter's fields."""
    rows, timed = store.of("field"), store.of("field-time")
    names = [n for n in timed[0] if n not in _WHERE and not n.endswith("seconds")] if timed else []
    seconds = {tuple(row[n] for n in names): row["seconds"] for row in timed}
    errors: dict[tuple[Any, ...], list[float]] = defaultdict(list)
    for row in rows:
        errors[tuple(row[n] for n in names)].append(row["information_mean"])
    return [
        Dot(dict(zip(names, key, strict=True)), seconds[key], statistics.fmean(values))
        for key, values in errors.items()
        if key in seconds
    ]


def _of_preset(name: str, dot: Dot) -> bool:
    """Whether a preset's settings are those of a dot, as far as it has them."""
    settings, own = preset(name), dot.settings
    values = {
        "particles": settings.initialise.particles,
        "lattice_m": 0.010,
        "sdf_m": 0.002,
        "look_up": "trilinear",
        "precision": settings.dtype,
        "source": "filter",
    }
    return all(own[n] == values[n] for n in own if n in values)


def _scatter(dots: Sequence[Dot], ax: "Axes", colour: str, label: str) -> None:
    ax.scatter(
        [1e3 * d.seconds for d in dots], [d.error for d in dots], s=18, color=colour, lw=0, label=label, zorder=3
    )


def _finish(dots: Sequence[Dot], ax: "Axes") -> None:
    """The front and the presets."""
    best = front(dots)
    ax.step(
        [1e3 * d.seconds for d in best],
        [d.error for d in best],
        where="post",
        color=style.QUIET,
        lw=1.0,
        label="front",
        zorder=1,
    )
    for name in PRESETS:
        own = [dot for dot in dots if _of_preset(name, dot)]
        if own:
            place = [1e3 * own[0].seconds], [own[0].error]
            look: dict[str, Any] = {"s": 110, "facecolor": "none", "edgecolor": style.CONTACT, "lw": 1.4}
            ax.scatter(*place, marker=_MARKS.get(name, "o"), label=f"preset {name}", zorder=4, **look)
    ax.set_xscale("log")
    ax.grid(color=style.FAINT, lw=0.6)
    ax.set_axisbelow(True)
    ax.legend(loc="best", fontsize=7)


def _fields(dots: Sequence[Dot], ax: "Axes") -> None:
    ax.set_title("information field")
    ax.set_xlabel("time of the field, one thread [ms]")
    ax.set_ylabel("mean error [nats]")
    if not dots:
        return
    plain = [d for d in dots if d.settings["look_up"] == "trilinear" and d.settings["precision"] == "float32"]
    for spacing, colour in ((0.005, style.NLL), (0.010, style.EXPECTED), (0.020, style.APC)):
        some = [d for d in plain if d.settings["lattice_m"] == spacing]
        _scatter(some, ax, colour, f"lattice of {1e3 * spacing:g} mm")
    _scatter([d for d in dots if d.settings["look_up"] == "nearest"], ax, style.QUIET, "nearest node, 10 mm")
    _scatter([d for d in dots if d.settings["precision"] == "float64"], ax, style.TOOL, "float64, 10 mm")
    _finish(dots, ax)


def _beliefs(store: Store, ax: "Axes") -> None:
    """Total variation over the number of particles: filter, and independent draws."""
    ax.set_title("belief against the reference posterior")
    ax.set_xlabel("particles")
    ax.set_ylabel("total variation")
    rows = [r for r in store.of("belief") if r["sdf_m"] == 0.002 and r["precision"] == "float32"]
    rows = [r for r in rows if r["starts"] == 2000]
    for source, colour in (("filter", style.NLL), ("draws", style.EXPECTED)):
        for name, dashes, words in (
            ("total_variation", "-", "2 mm, 2 mm, 10°"),
            ("total_variation_yaw", "--", "yaw alone, 10°"),
        ):
            by_count: dict[int, list[float]] = defaultdict(list)
            for row in rows:
                if row["source"] == source:
                    by_count[row["particles"]].append(row[name])
            if by_count:
                counts = sorted(by_count)
                means = [statistics.fmean(by_count[n]) for n in counts]
                who = "filter" if source == "filter" else "independent draws"
                ax.plot(counts, means, color=colour, ls=dashes, marker="o", ms=3.5, lw=1.4, label=f"{who}: {words}")
    if rows:
        ax.set_xscale("log")
        ax.set_ylim(0, 1)
        ax.grid(color=style.FAINT, lw=0.6)
        ax.legend(loc="best", fontsize=7)


def _runs(rows: Sequence[Row], ax: "Axes") -> None:
    """Share of runs that end right, over the seconds of an action."""
    ax.set_title("whole runs of the mug tasks")
    ax.set_xlabel("processor time of an action, all included, one thread [s]")
    ax.set_ylabel("runs that end right")
    for name, colour in zip(PRESETS, (style.CONTACT, style.NLL, style.QUIET), strict=False):
        own = [row for row in rows if row["preset"] == name]
        if not own:
            continue
        seconds = sum(r["processor_s"] for r in own) / max(1, sum(r["actions"] for r in own))
        right = sum(bool(r["right"]) for r in own)
        low, high = wilson(right, len(own))
        share = right / len(own)
        bars = [[share - low], [high - share]]
        words = f"{name}: {right} of {len(own)}"
        ax.errorbar([seconds], [share], bars, color=colour, marker=_MARKS.get(name, "o"), ms=7, lw=1.2, label=words)
    if rows:
        ax.set_ylim(-0.02, 1.02)
        ax.set_xlim(left=0)
        ax.grid(color=style.FAINT, lw=0.6)
        ax.legend(loc="best", fontsize=8)
