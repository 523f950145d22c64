"""Run time against error, drawn."""

import statistics
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from rumi.tasks.rummage.settings import PRESETS, preset
from rumi.viz import style
from scripts.reproduce.intervals import wilson
from scripts.store import Store

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Row = dict[str, Any]
_WHERE = {"part", "situation", "points", "seed", "threads"}  # what does not make another setting
_MARKS = {"default": "*", "fast": "D", "paper": "P"}


class Dot(NamedTuple):
    """Settings with their time and their error.

    Attributes:
        settings: what tells it from others.
        seconds: that it takes.
        error: mean over situations and seeds.
        standard_error: of that mean.
    """

    settings: Row
    seconds: float
    error: float
    standard_error: float = 0.0


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
    with style.figure(11.0, 7.2) as made:
        (fields, shares), (plans, runs) = made.subplots(2, 2)
        _fields(field_dots(store), fields)
        _beliefs(store, shares)
        _plans(plan_dots(store), plans)
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
    return _joined(store.of("field"), store.of("field-time"), "seconds", lambda row: row["information_mean"])


def plan_dots(store: Store) -> list[Dot]:
    """Share of what the best plan gains over standing still that a first plan loses."""
    beliefs: dict[tuple[str, int], tuple[float, float]] = {}
    for row in store.of("best-plan"):
        beliefs[(row["situation"], row["seed"])] = row["least"], row["still"]
    plans = [row for row in store.of("plan") if (row["situation"], row["seed"]) in beliefs]
    for row in plans:  # a plan may beat the search for the best one
        least, still = beliefs[(row["situation"], row["seed"])]
        beliefs[(row["situation"], row["seed"])] = min(least, row["cost"]), still

    def lost(row: Row) -> float:
        least, still = beliefs[(row["situation"], row["seed"])]
        return (row["cost"] - least) / (still - least)

    return _joined(plans, store.of("plan-time"), "pass_s", lost)


def _joined(rows: Sequence[Row], timed: Sequence[Row], clock: str, error: Callable[[Row], float]) -> list[Dot]:
    """Settings that have both errors and a time."""
    names = [n for n in timed[0] if n not in _WHERE and not n.endswith(("_s", "seconds"))] if timed else []
    seconds = {tuple(row[n] for n in names): row[clock] for row in timed}
    errors: dict[tuple[Any, ...], list[float]] = defaultdict(list)
    for row in rows:
        errors[tuple(row[n] for n in names)].append(error(row))
    return [
        Dot(dict(zip(names, key, strict=True)), seconds[key], statistics.fmean(values), _standard_error(values))
        for key, values in errors.items()
        if key in seconds
    ]


def _standard_error(values: Sequence[float]) -> float:
    return statistics.stdev(values) / len(values) ** 0.5 if len(values) > 1 else 0.0


def _of_preset(name: str, dot: Dot) -> bool:
    """Whether a preset's settings are those of a dot, as far as it has them."""
    settings, own = preset(name), dot.settings
    values = {
        "particles": settings.initialise.particles,
        "samples": settings.planner.mppi.samples,
        "rollouts": settings.planner.suited("displacement").rollouts,
        "mini_steps": settings.planner.push.mini_steps,
        "warmup_iterations": settings.planner.mppi.warmup_iterations,
        "iterations": settings.planner.mppi.iterations,
        "starts": settings.initialise.starts,
        "polished": settings.initialise.polished,
        "lattice_m": 0.010,
        "sdf_m": 0.002,
        "look_up": "trilinear",
        "precision": settings.dtype,
        "source": "filter",
    }
    plans = "samples" in own
    same = all(own[n] == values[n] for n in own if n in values and (plans or n not in ("starts", "polished")))
    # another objective: its plans are not judged by this one
    return same and not (plans and name == "paper")


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


def _plans(dots: Sequence[Dot], ax: "Axes") -> None:
    ax.set_title("plan")
    ax.set_xlabel("time of a planning pass, one thread [ms]")
    ax.set_ylabel("share of the best plan's gain that is lost")
    if not dots:
        return
    bars = [d.standard_error for d in dots]
    ax.errorbar([1e3 * d.seconds for d in dots], [d.error for d in dots], bars, fmt="none", color=style.FAINT, zorder=0)
    groups = {
        "fewer or more rollouts": lambda s: s["samples"] == 500 and s["rollouts"] != 5,
        "fewer or more samples": lambda s: s["samples"] != 500 and s["rollouts"] == 5,
        "both": lambda s: s["samples"] != 500 and s["rollouts"] != 5,
    }
    left = list(dots)
    for (words, chosen), colour in zip(groups.items(), (style.NLL, style.EXPECTED, style.APC), strict=True):
        some = [d for d in left if chosen(d.settings)]
        left = [d for d in left if not chosen(d.settings)]
        _scatter(some, ax, colour, words)
    _scatter(left, ax, style.QUIET, "other settings")
    _finish(dots, ax)


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
