"""Time and memory over size, drawn."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from rumi.viz import style
from scripts.bench.scaling_work import SIZES, WORK
from scripts.store import Store

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_COLOURS = (style.NLL, style.EXPECTED, style.APC, style.CONTACT, style.TOOL, style.INK, style.QUIET, style.FREE)
_DASHES = ("-", (0, (4, 2)), (0, (1, 1)))
_LEAST_BYTES = 1 << 20


def draw(store: Store, out: Path) -> list[Path]:
    """Draw what a store of `scripts.bench.scaling_study` holds: time above, memory beside the result below, by axis.

    Args:
        store: measurements.
        out: folder of the picture; made if need be.

    Returns:
        the files written.
    """
    out.mkdir(parents=True, exist_ok=True)
    path = out / "scaling.png"
    rows = store.of("scaling")
    with style.figure(15.0, 6.4) as made:
        axes = made.subplots(2, len(SIZES), sharex="col", sharey="row", squeeze=False)
        for column, axis in enumerate(SIZES):
            own = [row for row in rows if row["axis"] == axis]
            _panel(own, axes[0, column], "processor_s")
            _panel(own, axes[1, column], "extra_bytes")
            axes[1, column].set_xlabel({"points": "workspace points"}.get(axis, axis))
        axes[0, 0].set_ylabel("processor time, one thread [s]")
        axes[1, 0].set_ylabel("peak memory beside the result [MB]")
        lines = {line.get_label(): line for ax in axes[0] for line in ax.get_lines()}
        lines.pop("_", None)  # the marks of where a series ended
        made.legend(lines.values(), lines.keys(), loc="outside right center", fontsize=7.5)
        made.savefig(path)
    return [path]


def extra_bytes(row: dict[str, Any]) -> int:
    """The most memory that a call took beside its result; a megabyte at least, below which nothing is told."""
    return max(int(row["peak_bytes"]) - int(row["result_bytes"]), _LEAST_BYTES)


def _seconds(row: dict[str, Any]) -> float:
    """Processor time; of the shortest calls wall time, as the processor's clock may tick by milliseconds."""
    return float(row["processor_s"] if row["processor_s"] > 0.005 else row["seconds"])


def _panel(rows: list[dict[str, Any]], ax: "Axes", what: str) -> None:
    for place, name in enumerate(WORK):
        own = sorted((row for row in rows if row["op"] == name), key=lambda row: row["size"])
        done = [row for row in own if row["ended"] == "done"]
        if not done:
            continue
        values = [_seconds(row) if what == "processor_s" else extra_bytes(row) / 1e6 for row in done]
        colour, dashes = _COLOURS[place % len(_COLOURS)], _DASHES[place // len(_COLOURS)]
        ax.plot([row["size"] for row in done], values, color=colour, ls=dashes, lw=1.3, marker="o", ms=2.5, label=name)
        if own[-1]["ended"] != "done":  # where the series was ended
            mark = "x" if own[-1]["ended"] == "time" else "s"
            ax.plot([done[-1]["size"]], [values[-1]], color=colour, marker=mark, ms=7, ls="", label="_")
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.grid(color=style.FAINT, lw=0.6)
    ax.set_axisbelow(True)
