"""Pushes from above: where beliefs about an object's push parameters have it end, and where it ended."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.dynamics.push_posterior import PushPosterior
from rumi.dynamics.pushed_body import ObservedPush, PushedBody
from rumi.dynamics.sliding import rotated
from rumi.viz import style
from rumi.viz.outlines import zero_lines

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_DRAWN = 200  # ends of a cloud
_ROWS = 3  # pushes at most


def push_figure(
    beliefs: Sequence[PushPosterior],
    names: Sequence[str],
    pushes: Sequence[ObservedPush],
    body: PushedBody,
    out: Path,
) -> None:
    """A row of pictures for each of the longest pushes, a column for each belief, and last what is believed.

    Args:
        beliefs: posteriors, what was learnt growing.
        names: of them.
        pushes: to draw.
        body: the object and the tool.
        out: picture.
    """
    far = sorted(pushes, key=lambda push: -float((push.end - push.start)[:2].norm()))[:_ROWS]
    with style.figure(2.2 * (len(beliefs) + 1), 2.2 * len(far)) as figure:
        axes = figure.subplots(len(far), len(beliefs) + 1, squeeze=False)
        for ax, name in zip(axes[0], names, strict=False):
            ax.set_title(name)
        for row, push in zip(axes, far, strict=True):
            for ax, belief in zip(row, beliefs, strict=False):
                draw_push(ax, belief, push, body)
            scale_bar(row[0], 0.05)
            row[-1].set_axis_off()
        own = axes[0, -1]
        own.set_axis_on()
        for belief, name, color in zip(beliefs, names, (style.QUIET, style.NLL, style.CONTACT), strict=False):
            friction, lever = belief.draws(_DRAWN)[:, :2].exp().T.tolist()
            own.scatter(friction, lever, s=3, color=color, label=name)
        own.set_xlabel("friction")
        own.set_ylabel("lever, of even pressure's")
        own.legend(markerscale=2)
        style.save(figure, out)


def draw_push(ax: "Axes", belief: PushPosterior, push: ObservedPush, body: PushedBody) -> None:
    """One push: the object before (grey), predicted ends of its origin with some outlines, and the true end (black)."""
    generator = torch.Generator().manual_seed(0)
    drawn = belief.predict(push.start[None], push.path[None], body).sample(_DRAWN, generator)[0]
    for pose in drawn[:20]:
        _outline(ax, body, pose, color=style.NLL, lw=0.4, alpha=0.35)
    _outline(ax, body, push.start, color=style.QUIET, lw=0.8)
    _outline(ax, body, push.end, color=style.TRUTH, lw=1.4)
    ax.scatter(*drawn[:, :2].T.tolist(), s=1.5, color=style.NLL, lw=0)
    ax.scatter(*push.end[:2].tolist(), s=18, color=style.TRUTH, marker="+", zorder=4)
    ax.plot(*push.path[:, :2].T.tolist(), color=style.TOOL, lw=1.4)
    reach = body.outline.radius + 0.035
    middle = 0.5 * (push.start + push.end)
    ax.set_xlim(float(middle[0]) - reach, float(middle[0]) + reach)
    ax.set_ylim(float(middle[1]) - reach, float(middle[1]) + reach)
    ax.set_aspect("equal")
    ax.set_xticks([])
    ax.set_yticks([])


def scale_bar(ax: "Axes", length_m: float) -> None:
    """A bar of a length in a picture's lower left corner."""
    (left, right), (low, high) = ax.get_xlim(), ax.get_ylim()
    x, y = left + 0.06 * (right - left), low + 0.06 * (high - low)
    ax.plot((x, x + length_m), (y, y), color=style.TRUTH, lw=2.0)
    ax.text(x + 0.5 * length_m, y + 0.02 * (high - low), f"{1e3 * length_m:.0f} mm", ha="center", va="bottom")


def _outline(ax: "Axes", body: PushedBody, pose: Float[Tensor, "3"], **line: object) -> None:
    axis = torch.linspace(-body.outline.radius, body.outline.radius, 161, dtype=torch.float64)
    values = body.outline(torch.stack(torch.meshgrid(axis, axis, indexing="ij"), -1)).distance
    for corners in zero_lines(axis.numpy(), axis.numpy(), values.numpy()):
        placed = rotated(torch.as_tensor(corners).to(pose), pose[2]) + pose[:2]
        ax.plot(*placed.T.tolist(), **line)
