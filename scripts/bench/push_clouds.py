"""Draw real pushes of three shapes: the predicted cloud before and after 1, 3 and 10 pushes of the object, the truth.

python -m scripts.bench.push_clouds     # needs RUMI_DATA

The prior is the library's as it is without the shape (`scripts.real_pushes`).
"""

import torch

from rumi.cli import script
from rumi.seeding import split
from rumi.viz import style
from rumi.viz.pushes import draw_push, scale_bar
from scripts.bench.real_pushes import push_set
from scripts.experiment import FIGURES
from scripts.real_pushes import prior_without

SHOWN = ("abs rect3", "abs ellip2", "plywood tri1")
COUNTS = (0, 1, 3, 10)


def draw() -> None:
    """Of each set the push that turns the object by the most of twenty random ones; ten others are learnt from."""
    with style.figure(9.0, 6.6) as figure:
        axes = figure.subplots(len(SHOWN), len(COUNTS))
        for ax, count in zip(axes[0], COUNTS, strict=True):
            ax.set_title(f"after {count} push{'es' * (count > 1)}" if count else "never seen")
        for row, name in zip(axes, SHOWN, strict=True):
            own, generator = push_set(name), split(0, f"clouds {name}")
            order = torch.randperm(len(own.start), generator=generator)
            some = order[10:30]
            turns = (own.end[some, 2] - own.start[some, 2]).abs()
            prior = prior_without((name.split()[1],), count=256)
            push = own.observed(some[turns.argmax()][None])[0]
            for ax, count in zip(row, COUNTS, strict=True):
                belief = prior.update(own.observed(order[:count]), own.body, split(1, name))
                draw_push(ax, belief, push, own.body)
            row[0].set_ylabel(name)
            scale_bar(row[0], 0.05)
        figure.savefig(FIGURES / "push_clouds.png", dpi=90)


if __name__ == "__main__":
    script(draw)
