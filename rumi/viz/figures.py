"""All figures of a run, as files."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rumi.errors import UsageError
from rumi.garbage import set_aside
from rumi.runs.folder import Run
from rumi.runs.scene_geometry import SceneGeometry
from rumi.viz import style
from rumi.viz.animation import animate
from rumi.viz.curves import apc_curve, nll_curve, touched
from rumi.viz.scene import Extent, information_at, interesting, legend_entries, scene_from_above
from rumi.viz.space import BOXES, scene_in_space, tips

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_MAY_BE, _TELLS = "Blue outlines: where the object may be.", "Orange: where a touch would tell most."
_CLOSE_IN = "and the outlines close in on the true one (dashed)."


@set_aside()  # each figure is followed by a collection
def make_figures(run: Run, out: Path | str, steps: Sequence[int] | None = None) -> list[Path]:
    """Draw a run: curves, the scene at some steps, an overview of both, and an animation.

    Args:
        run: as `load_run` gives it.
        out: folder of the pictures; made if need be.
        steps: which scenes to draw; by default the first view, the first contact, the middle and the end.

    Returns:
        the files written.

    Raises:
        UsageError: the run has no step, or not the asked ones; or matplotlib is missing.
    """
    if not run.steps or run.geometry is None:
        raise UsageError(f"{run.folder} holds no whole step yet: nothing to draw")
    chosen = telling_steps(run) if steps is None else sorted(set(steps))
    wrong = [step for step in chosen if not 0 <= step < len(run.steps)]
    if wrong:
        raise UsageError(f"{run.folder} has steps 0 to {len(run.steps) - 1}, got {', '.join(map(str, wrong))}")
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    for old in folder.glob("scene_*.png"):  # of an earlier choice of steps
        if re.fullmatch(r"scene_\d{3,}\.png", old.name):
            old.unlink(missing_ok=True)
    extent = interesting(run.steps, run.geometry)
    written = [_save_curves(run, folder / "curves.png")]
    written += [_save_scene(run, run.geometry, step, extent, folder / f"scene_{step:03d}.png") for step in chosen]
    written.append(_save_overview(run, run.geometry, telling_steps(run), extent, folder / "overview.png"))
    about, how = asked(run), ending(run)
    written.append(animate(run.steps, run.geometry, folder / "run.gif", extent=extent, heading=about, ending=how))
    return written


def telling_steps(run: Run) -> list[int]:
    """The first view, the first contact, half-way from there and the end, filled up to four steps, in order."""
    end = len(run.steps) - 1
    first = next((step.step for step in run.steps if touched(step)), end // 3)
    by_worth = [0, end, first, (first + end + 1) // 2, max(first - 1, 0), first // 2, *range(end)]
    return sorted(list(dict.fromkeys(by_worth))[:4])


def heading(run: Run) -> str:
    """Title of a run: its task, method and outcome."""
    return asked(run) + ending(run)


def asked(run: Run) -> str:
    """What a run was to do: its task, method, preset and seed."""
    names = [str(run.settings[name]) for name in ("task", "method", "preset") if name in run.settings]
    return " · ".join(names) + (f", seed {run.settings['seed']}" if "seed" in run.settings else "")


def ending(run: Run) -> str:
    """How a run ended, to go behind what it was to do."""
    if run.result is None:
        return " · not finished"
    ended = {"steps": "out of actions", "budget": "out of time"}.get(run.result.stopped_by, run.result.stopped_by)
    error = ""
    if run.result.position_error_mm is not None and run.result.rotation_error_deg is not None:
        error = f", off by {run.result.position_error_mm:.1f} mm and {run.result.rotation_error_deg:.1f}°"
    plural = "" if run.result.steps == 1 else "s"
    return f" · {ended} after {run.result.steps} action{plural}{error}"


def to_see(run: Run) -> str:
    """What the scenes of a run show; no field of information where plans rest on none."""
    fields = any(step.plan is not None and "information" in step.plan.fields for step in run.steps)
    middle = f"{_TELLS} The tool goes there, touches," if fields else "The tool touches it,"
    return f"{_MAY_BE} {middle} {_CLOSE_IN}"


def _thresholds(run: Run) -> dict[str, float]:
    return {} if run.geometry is None else run.geometry.thresholds


def _save_curves(run: Run, path: Path) -> Path:
    with style.figure(6.4, 4.2) as figure:
        upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
        _draw_curves(run, upper, lower)
        figure.suptitle(heading(run), fontsize=9, x=0.01, ha="left", color=style.INK)
        return style.save(figure, path)


def _draw_curves(run: Run, upper: "Axes", lower: "Axes") -> None:
    from matplotlib.patches import Patch

    thresholds = _thresholds(run)
    nll_curve(run.steps, upper, threshold=thresholds.get("nll"))
    apc_curve(run.steps, lower, threshold=thresholds.get("apc"))
    upper.set_xlabel("")
    upper.tick_params(labelbottom=False)
    handles, labels = upper.get_legend_handles_labels()
    again = dict(zip(*reversed(lower.get_legend_handles_labels()), strict=True)).get("resampled")
    if again is not None:
        handles, labels = [*handles, again], [*labels, "resampled"]
    if any(touched(step) for step in run.steps):
        handles, labels = [*handles, Patch(color=style.CONTACT, alpha=0.15, lw=0)], [*labels, "contact"]
    upper.legend(
        handles,
        labels,
        loc="lower left",
        bbox_to_anchor=(0, 1.0),
        ncols=4,
        borderaxespad=0.2,
        handlelength=1.6,
        columnspacing=1.1,
    )


def _save_scene(run: Run, geometry: SceneGeometry, step: int, extent: Extent, path: Path) -> Path:
    width, height = _fitting(extent, 4.6)
    with style.figure(width + 2.0, height + 0.8) as figure:
        ax = figure.subplots()
        scene_from_above(
            run.steps[: step + 1], geometry, ax, information=information_at(run.steps, step), extent=extent
        )
        _bars(figure, ax)
        figure.legend(*legend_entries(ax), loc="outside lower center", ncols=4, handlelength=1.6, columnspacing=1.4)
        return style.save(figure, path)


def _save_overview(run: Run, geometry: SceneGeometry, steps: Sequence[int], extent: Extent, path: Path) -> Path:
    width = 3.1
    height = width * (extent[3] - extent[2]) / (extent[1] - extent[0])
    space = 2.9 if tips(run.steps) else 0.0
    heights = [height + 1.0, *([space] if space else []), 2.1]
    with style.figure(max(width * len(steps) + 1.4, 8.0), sum(heights) + 0.3) as figure:
        rows = figure.subfigures(len(heights), 1, height_ratios=heights)
        scenes = rows[0].subplots(1, len(steps), sharey=True, squeeze=False)[0]
        for ax, step in zip(scenes, steps, strict=True):
            scene_from_above(
                run.steps[: step + 1], geometry, ax, information=information_at(run.steps, step), extent=extent
            )
            ax.label_outer()
        _bars(rows[0], scenes)
        rows[0].legend(
            *legend_entries(scenes[-1]), loc="outside lower center", ncols=8, handlelength=1.6, columnspacing=1.6
        )
        if space:
            for ax, step in zip(
                rows[1].subplots(1, len(steps), subplot_kw={"projection": "3d"}, squeeze=False)[0], steps, strict=True
            ):
                scene_in_space(run.steps[step], geometry, ax, extent)
            rows[1].suptitle(
                f"in space: boxes about the {BOXES} likeliest, true one dashed", x=0.01, ha="left", fontsize=8
            )
        _draw_curves(run, *rows[-1].subplots(1, 2))
        for ax in rows[-1].axes:
            ax.set_xlabel("actions")
            ax.tick_params(labelbottom=True)
        figure.suptitle(f"{heading(run)}\n{to_see(run)}", fontsize=10, color=style.INK)
        return style.save(figure, path)


def _fitting(extent: Extent, longest: float) -> tuple[float, float]:
    """Size in inches of an axis that shows an extent, its longer side given."""
    across, up = extent[1] - extent[0], extent[3] - extent[2]
    scale = longest / max(across, up)
    return across * scale, up * scale


def _bars(figure: "Figure | Any", axes: Any) -> None:  # noqa: ANN401  (one axis or several)
    """Colour bars of the particles and, where it is drawn, of the information."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    every = list(axes) if hasattr(axes, "__len__") else [axes]
    weight = figure.colorbar(
        ScalarMappable(Normalize(0, 1), style.likelihood_map()),
        ax=every,
        shrink=0.75,
        aspect=28,
        pad=0.02 if len(every) > 1 else 0.06,  # a share of the axes; room for the other bar's label
        ticks=[0, 0.5, 1],
    )
    weight.set_label("particle's weight / heaviest")
    weight.outline.set_visible(False)
    images = [image for ax in every for image in ax.images if image.norm.vmax]
    if images:
        single = len(every) == 1
        bar = figure.colorbar(images[-1], ax=every, shrink=0.75, aspect=28, pad=0.02)
        if not single:
            bar.set_ticks([0, images[-1].norm.vmax], labels=["0", "max"])
        bar.set_label("information [nats]" if single else "information")
        bar.outline.set_visible(False)
