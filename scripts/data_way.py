"""The way of a reading to the next action, as a picture for the pages.

python -m scripts.data_way                                # scripts/docs/figures/data_way.png
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from rumi.cli import script
from rumi.viz import style
from scripts.experiment import FIGURES

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True)
class Options:
    """Where the picture goes.

    Attributes:
        out: image file.
    """

    out: Annotated[Path, tyro.conf.arg(metavar="FILE")] = FIGURES / "data_way.png"


@dataclass(frozen=True)
class Part:
    """A box of the picture.

    Attributes:
        title: what it is called.
        lines: what it does, and the type that leaves it.
        room: where its code lies.
        x: of its middle.
        y: of its middle.
        colour: of its edge.
    """

    title: str
    lines: tuple[str, ...]
    room: str
    x: float
    y: float
    colour: str


WIDTH, HEIGHT = 2.5, 1.5
PARTS = {
    "task": Part(
        "Task", ("a simulator, a robot or a log:", "acts and senses"), "rumi/sim, rosbag, yours", 1.5, 4.2, style.INK
    ),
    "sensors": Part(
        "Sensors", ("images, contacts, wrenches,", "torques → Reading"), "sensors/", 5.0, 4.2, style.SURFACE
    ),
    "motion": Part(
        "Motion", ("measured, or by a push model:", "how far the object moved"), "rumi/dynamics", 8.5, 4.2, style.PATH
    ),
    "filter": Part(
        "Filter", ("evidence weighs poses;", "resample, descend"), "rumi/belief, registration", 12.0, 4.2, style.NLL
    ),
    "belief": Part("Belief", ("particles in SE(3)", "and log-weights"), "PoseBelief", 12.0, 1.2, style.NLL),
    "stop": Part("Sure?", ("stop rule;", "the answer with its covariance"), "rumi/information", 8.5, 1.2, style.APC),
    "field": Part(
        "Information", ("what looking or touching", "there would tell"), "rumi/fields", 5.0, 1.2, style.EXPECTED
    ),
    "plan": Part(
        "Planner", ("sampled motions, pushes", "foreseen → Plan"), "rumi/planning, kmppi", 1.5, 1.2, style.CONTACT
    ),
}
WAYS = (
    ("task", "sensors", "what was sensed"),
    ("sensors", "motion", "Reading"),
    ("motion", "filter", "moved by"),
    ("filter", "belief", ""),
    ("belief", "stop", "poses, weights"),
    ("stop", "field", "not yet"),
    ("field", "plan", "nats a place"),
    ("plan", "task", "the next action"),
)


def main() -> None:
    """Draw the picture and say where it is."""
    options = tyro.cli(Options, prog="python -m scripts.data_way")
    with style.figure(10.5, 4.5) as figure:
        axes = figure.add_subplot()
        axes.set_axis_off()
        axes.set_xlim(-0.1, 13.6)
        axes.set_ylim(-0.4, 5.4)
        for part in PARTS.values():
            _box(axes, part)
        for start, end, label in WAYS:
            _arrow(axes, PARTS[start], PARTS[end], label)
        axes.text(
            6.75, -0.2, "Signed distances of the object (sdf/) stand under all of it.", ha="center", color=style.QUIET
        )
        style.save(figure, options.out, dpi=140)
    sys.stdout.write(f"{options.out}\n")


def _box(axes: "Axes", part: Part) -> None:
    from matplotlib.patches import FancyBboxPatch

    corner = (part.x - WIDTH / 2, part.y - HEIGHT / 2)
    axes.add_patch(
        FancyBboxPatch(corner, WIDTH, HEIGHT, boxstyle="round,pad=0.02,rounding_size=0.12", fc="white", ec=part.colour)
    )
    axes.text(part.x, part.y + 0.5, part.title, ha="center", va="center", weight="bold", color=part.colour, size=10.5)
    axes.text(part.x, part.y + 0.02, "\n".join(part.lines), ha="center", va="center", color=style.INK, size=7.8)
    axes.text(part.x, part.y - 0.54, part.room, ha="center", va="center", color=style.QUIET, size=7, family="monospace")


def _arrow(axes: "Axes", start: Part, end: Part, label: str) -> None:
    across = start.y == end.y
    sign = 1 if (end.x > start.x if across else end.y > start.y) else -1
    shift = (sign * WIDTH / 2, 0.0) if across else (0.0, sign * HEIGHT / 2)
    first, last = (start.x + shift[0], start.y + shift[1]), (end.x - shift[0], end.y - shift[1])
    axes.annotate("", last, first, arrowprops={"arrowstyle": "-|>", "color": style.INK, "lw": 1.1})
    middle = ((first[0] + last[0]) / 2, (first[1] + last[1]) / 2)
    if across:
        axes.text(middle[0], middle[1] + 0.12, label.replace(" ", "\n"), ha="center", va="bottom", size=7)
    else:
        axes.text(middle[0] + 0.12, middle[1], label, ha="left", va="center", size=7)


if __name__ == "__main__":
    script(main)
