"""Overlay of observations on their model: from above, from the front and from the side."""

from pathlib import Path
from typing import TYPE_CHECKING

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.metrics.alignment import GROSS_M, Alignment
from rumi.viz import style
from sdf import se3
from sdf.object_model import ObjectModel
from sensors.observation import Observation
from sensors.semantics import Semantics

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_VIEWS = (("from above", 0, 1), ("from the front", 1, 2), ("from the side", 0, 2))
_MOST = 4000  # points of a kind that a picture can show
_MARGIN = 0.03


def draw_overlay(
    points: Observation,
    world_T_object: Float[Tensor, "4 4"],
    model: ObjectModel,
    found: Alignment,
    path: Path,
    *,
    title: str = "",
) -> Path:
    """Draw observations over a model, and save the picture.

    Surface points are coloured by how far off the surface they are, dark where they lie on it; free points are shown
    where they are inside of the object, which cannot be.

    Args:
        points: in the world frame.
        world_T_object: (4, 4).
        model: the object.
        found: how well they fit.
        path: of the picture.
        title: above it.

    Raises:
        UsageError: matplotlib is missing.
    """
    with style.figure(11.0, 4.4) as figure:
        from matplotlib.lines import Line2D

        axes = figure.subplots(1, 3)
        for ax, (name, across, up) in zip(axes, _VIEWS, strict=True):
            _draw_view(ax, points, world_T_object, model, found, across, up)
            ax.set_title(name)
        drawn = axes[0].collections[1]
        figure.colorbar(drawn, ax=list(axes), shrink=0.8, label="off the surface [mm]: − inside, + outside")
        handles = [
            Line2D([], [], color=style.BODY, marker="o", ms=4, lw=0, label="model"),
            Line2D([], [], color=style.INK, marker="o", ms=3, lw=0, label="observed surface: dark lies on the model"),
            Line2D([], [], color=style.CONTACT, marker="x", ms=4, lw=0, label="known to be free, and inside"),
        ]
        figure.legend(handles=handles, loc="outside lower center", ncols=3)
        if title:
            figure.suptitle(title)
        path.parent.mkdir(parents=True, exist_ok=True)
        return style.save(figure, path, dpi=120)


def _draw_view(
    ax: "Axes",
    points: Observation,
    world_T_object: Tensor,
    model: ObjectModel,
    found: Alignment,
    across: int,
    up: int,
) -> None:
    body = se3.apply(world_T_object.cpu().float(), model.surface_points.cpu().float())
    ax.scatter(*body[:, [across, up]].T.numpy(), s=9, c=style.BODY, linewidths=0, zorder=1)
    surface = points.points[points.of_class(Semantics.SURFACE)].cpu()
    stride = max(1, len(surface) // _MOST)
    shown, off = surface[::stride], 1e3 * found.surface[::stride]
    limit = 1e3 * GROSS_M
    ax.scatter(
        *shown[:, [across, up]].T.numpy(), s=5, c=off.numpy(), cmap=style.residual_map(), vmin=-limit, vmax=limit,
        linewidths=0, zorder=3,
    )  # fmt: skip
    free = points.points[points.of_class(Semantics.FREE)].cpu()[(found.free < 0).cpu()][:_MOST]
    ax.scatter(*free[:, [across, up]].T.numpy(), s=14, c=style.CONTACT, marker="x", linewidths=0.8, zorder=4)
    everything = torch.cat((body, shown))[:, [across, up]]
    low, high = everything.amin(0) - _MARGIN, everything.amax(0) + _MARGIN
    ax.set_xlim(float(low[0]), float(high[0]))
    ax.set_ylim(float(low[1]), float(high[1]))
    ax.set_aspect("equal")
    ax.set_xlabel("xyz"[across] + " [m]")
    ax.set_ylabel("xyz"[up] + " [m]")
