"""Animation of a run."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rumi.garbage import give_back
from rumi.records import StepRecord
from rumi.runs.files import whole_file
from rumi.runs.scene_geometry import SceneGeometry
from rumi.viz import style
from rumi.viz.curves import highest_nll, nll_curve
from rumi.viz.scene import Extent, information_at, interesting, legend_entries, scene_from_above
from sdf.extras import optional

_DPI = 90
_MOST_FRAMES = 60
_STEP_MS = 600


def animate(
    steps: Sequence[StepRecord],
    geometry: SceneGeometry,
    path: Path,
    *,
    extent: Extent | None = None,
    heading: str = "",
    ending: str = "",
) -> Path:
    """Write a GIF: one picture a step (60 at most, evenly spread), the last one held.

    Args:
        steps: of a run, from the first view on.
        geometry: of its scene.
        path: of the file.
        extent: what to show; by default all that matters in the run.
        heading: line on top.
        ending: what the line goes on with once the last step is shown.
    """
    Image = optional("PIL.Image", "An animation")
    extent = interesting(steps, geometry) if extent is None else extent
    across, up = extent[1] - extent[0], extent[3] - extent[2]
    height = 4.6
    width = height * across / up
    threshold = geometry.thresholds.get("nll")
    shown_steps = _evenly(len(steps), _MOST_FRAMES)
    palette, indexed = None, []
    with style.figure(width + 4.2, height + 1.2, dpi=_DPI) as figure:
        scene, curve = figure.subplots(1, 2, width_ratios=(width, 3.0))
        title = figure.suptitle(heading, fontsize=9, x=0.01, ha="left", color=style.INK)
        # the last step has all that is ever drawn: it makes the layout, the legend and the palette
        for step in (shown_steps[-1], *shown_steps):
            for ax in (scene, curve):
                ax.clear()
            give_back()  # what the frame before was drawn with, circles of references too
            so_far = steps[: step + 1]
            title.set_text(heading + (ending if step == shown_steps[-1] else ""))
            scene_from_above(so_far, geometry, scene, information=information_at(steps, step), extent=extent)
            nll_curve(so_far, curve, threshold=threshold, last=steps[-1].step)
            curve.set_ylim(0, 1.12 * highest_nll(steps, threshold))
            curve.legend(loc="upper right")
            if not figure.legends:
                figure.legend(*legend_entries(scene), loc="outside lower center", ncols=4, handlelength=1.6)
            figure.canvas.draw()
            figure.set_layout_engine("none")
            frame = Image.fromarray(np.asarray(figure.canvas.buffer_rgba())[..., :3])
            if palette is None:
                palette = frame.quantize(255)
                colours = np.array(palette.getpalette()).reshape(-1, 3)
                colours[colours.sum(-1).argmax()] = 255  # paper stays white
                palette.putpalette(colours.reshape(-1).tolist())
            else:  # at once: a byte a pixel is kept, not three
                indexed.append(frame.quantize(palette=palette, dither=Image.Dither.NONE))
    durations = [_STEP_MS] * (len(indexed) - 1) + [5 * _STEP_MS]
    with whole_file(path) as aside:
        indexed[0].save(aside, save_all=True, append_images=indexed[1:], duration=durations, loop=0, optimize=False)
    return path


def _evenly(count: int, most: int) -> list[int]:
    """Indices of at most so many of `count` things, first and last included."""
    return sorted({round(index) for index in np.linspace(0, count - 1, min(count, most)).tolist()})
