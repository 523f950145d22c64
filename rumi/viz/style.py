"""Style of all figures: colours that colour-blind readers tell apart, and readable fonts."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rumi.garbage import give_back
from rumi.runs.files import whole_file
from sdf.extras import optional

if TYPE_CHECKING:
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure

INK = "#222222"
QUIET = "#8a8f98"
FAINT = "#e7e9ed"
BODY = "#d3d7de"
TRUTH = "#000000"
SURFACE = "#00707a"
FREE = "#9fb4c4"
TOOL = "#5b4a7d"
PATH = "#7a4fa3"
CONTACT = "#c2185b"
NLL = "#0b5fa5"
EXPECTED = "#e08214"
APC = "#00707a"

_RC = {
    "font.family": "sans-serif",
    "font.size": 9.0,
    "axes.titlesize": 9.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelsize": 9.0,
    "axes.labelcolor": INK,
    "axes.edgecolor": QUIET,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "xtick.color": INK,
    "ytick.color": INK,
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "xtick.major.width": 0.7,
    "ytick.major.width": 0.7,
    "grid.color": FAINT,
    "grid.linewidth": 0.6,
    "legend.fontsize": 8.0,
    "legend.frameon": False,
    "figure.dpi": 100,
    "savefig.dpi": 180,
    "pdf.fonttype": 42,
}


@contextmanager
def figure(width: float, height: float, dpi: float | None = None) -> Iterator["Figure"]:
    """A new figure of a size in inches, in the house style, drawn without a display; let go of after the block.

    Raises:
        ModuleNotFoundError: matplotlib is not installed.
    """
    mpl = optional("matplotlib", "A figure")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with mpl.rc_context(_RC):
        made = Figure(figsize=(width, height), dpi=dpi, layout="constrained")
        FigureCanvasAgg(made)
        yield made
    del made
    give_back()  # a figure is a circle of references, and megabytes: else the next ones come on top of it


def save(figure: "Figure", path: Path, **options: Any) -> Path:  # noqa: ANN401  (of `savefig`)
    """Write a figure in one go; its path.

    Raises:
        UsageError: it cannot be written.
    """
    give_back()  # what laying it out left, before its pixels come on top
    with whole_file(path) as aside:
        figure.savefig(aside, metadata={"Software": "rumi"} if path.suffix == ".png" else None, **options)
    return path


@cache
def information_map() -> "Colormap":
    """White to deep orange: nothing to learn is paper."""
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list("information", ["#ffffff", "#fdebd0", "#fbc98b", "#f29a4a", "#c9601c"])


@cache
def likelihood_map() -> "Colormap":
    """Pale to dark blue: the likeliest is darkest."""
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list("likelihood", ["#c3d7ea", "#7fb0dc", "#3b7fc4", "#11408b", "#081d58"])


@cache
def residual_map() -> "Colormap":
    """Blue through dark to orange: what is off by nothing is seen on paper and on a pale model."""
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list("residual", ["#2f9df4", "#1f5f96", "#1b1b1b", "#a24a12", "#ff7f1f"])
