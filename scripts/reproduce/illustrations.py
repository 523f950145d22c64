"""Figures 2, 4, 6, 7 and 14 of RUMI by this simulator: sensor model, first view, resampling, reach, GP."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from jaxtyping import Float
from torch import Tensor

from rumi import loop
from rumi.fields.information import InformationSettings, information_field, information_from_distances
from rumi.planning.gpvr import GPVRSettings
from rumi.planning.implicit_surface import (
    Hyperparameters,
    Labelled,
    labelled,
    next_to_nodes,
    predictive_mean,
    predictive_variance,
)
from rumi.records import StepRecord
from rumi.runs.memory import memory
from rumi.runs.scene_geometry import SceneGeometry
from rumi.tasks.rummage.agent import Rummager
from rumi.tasks.rummage.build import build
from rumi.tasks.rummage.geometry import scene_geometry
from rumi.tasks.rummage.scenes import find_task
from rumi.tasks.rummage.settings import Settings, preset
from rumi.viz import scene, style
from rumi.viz.outlines import bounding_box, object_outline
from rumi.weights import boltzmann
from sensors.observation import Observation, concatenate
from sensors.semantics import Semantics

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MOST_STEPS = 20
"""Actions of the run that Figure 6 is of, in which a touch is to ask for a resampling."""


@dataclass(frozen=True)
class Seen:
    """The beginning of a run, and whose it is."""

    steps: list[StepRecord]
    rummager: Rummager
    geometry: SceneGeometry


def begin(settings: Settings, steps: int, cache_dir: Path) -> Seen:
    """The first steps of a run."""
    seen: list[StepRecord] = []
    with build(settings, cache_dir=cache_dir) as (world, rummager):
        loop.run_to_end(world, rummager, seed=settings.seed, steps=steps, on_step=seen.append)
        return Seen(seen, rummager, scene_geometry(rummager))


def sensor_model(distance: Float[Tensor, "V"]) -> Float[Tensor, "V 3"]:
    """p(free, occupied, surface) at signed distances (metres) from one pose."""
    own = InformationSettings()
    one = torch.zeros(1, dtype=distance.dtype)
    return information_from_distances(
        distance[None], one, sharpness=own.sharpness_of(), surface_tolerance=own.surface_tolerance
    ).semantics


def draw_sensor_model(task: str, seed: int, cache_dir: Path, path: Path) -> str:
    """Figure 2: the chance of each class by signed distance."""
    distance = torch.linspace(-0.06, 0.06, 481, dtype=torch.float64)
    chances = sensor_model(distance)
    with style.figure(5.0, 2.6) as figure:
        ax = figure.subplots()
        for k, (name, colour) in enumerate((("free", style.NLL), ("occupied", style.PATH), ("surface", style.SURFACE))):
            ax.plot(1e3 * distance, chances[:, k], color=colour, label=name)
        ax.set(xlabel="signed distance [mm]", ylabel="probability", title="Sensor model")
        ax.legend()
        style.save(figure, path)
    own = InformationSettings()
    return (
        f"Within {1e3 * own.surface_tolerance:g} mm a point counts as surface for sure; farther off that falls by a "
        f"factor of e in {1e3 / own.sharpness_of():g} mm."
    )


def draw_first_view(task: str, seed: int, cache_dir: Path, path: Path) -> str:
    """Figure 4: what the first view shows, and where a touch would tell of the pose."""
    seen = begin(preset("paper", task=task, seed=seed), 1, cache_dir)
    first = seen.steps[:1]
    with style.figure(8.0, 3.8) as figure:
        left, right = figure.subplots(1, 2, sharex=True, sharey=True)
        for ax in (left, right):
            _frame(ax, _about(first, seen.geometry))
            scene.draw_truth(first[0], seen.geometry, ax)
        scene.draw_observations(first, left)
        scene.draw_fields(scene.information_at(seen.steps, 0), replace(seen.geometry, reachability=None), right)
        left.set_title("First view")
        right.set_title("Information")
        left.legend(*scene.legend_entries(left), loc="lower left")
        style.save(figure, path)
    return f"{task}, seed {seed}, preset `paper`, 100 particles. The true outline is dashed."


def draw_resampling(task: str, seed: int, cache_dir: Path, path: Path) -> str:
    """Figure 6: particles before a touch, by their weights after it, and resampled."""
    seen = begin(preset("paper", task=task, seed=seed), MOST_STEPS, cache_dir)
    at = touch_resampled(seen.steps)
    if at is None:
        return f"No touch within {MOST_STEPS} actions of {task}, seed {seed}, asked for a resampling."
    before, after = seen.steps[at - 1], seen.steps[at]
    following = seen.rummager.filter
    carried = replace(before.belief, world_T_attached=after.belief.world_T_attached)
    costs = following.total(carried, _as_kept(seen.steps[: at + 1]))
    weighed = replace(after, belief=carried.reweighted(boltzmann(costs, following.settings.peakiness)))
    panels = (("Before the touch", before), ("Weights after it", weighed), ("Resampled", after))
    extent = _about([before, after], seen.geometry)
    with style.figure(10.5, 3.8) as figure:
        for ax, (title, step) in zip(figure.subplots(1, 3, sharex=True, sharey=True), panels, strict=True):
            _frame(ax, extent)
            scene.draw_particles(step, seen.geometry, ax, 100)
            scene.draw_truth(step, seen.geometry, ax)
            ax.set_title(title)
        style.save(figure, path)
    return f"{task}, seed {seed}, preset `paper`, action {after.step}; dark particles are the heavy ones."


def draw_reach(task: str, seed: int, cache_dir: Path, path: Path) -> str:
    """Figure 7: reachability of the workspace."""
    seen = begin(preset("paper", task=task, seed=seed), 0, cache_dir)
    reach = seen.geometry.reachability
    with style.figure(5.2, 4.4) as figure:
        ax = figure.subplots()
        _map(ax, seen, reach, "Reachability r(x)")
        scene.draw_truth(seen.steps[0], seen.geometry, ax)
        style.save(figure, path)
    base = find_task(task).base[0]
    return f"{task}; the arm's base is at x = {base:g} m, the object's true outline is dashed."


def draw_process(task: str, seed: int, cache_dir: Path, path: Path) -> str:
    """Figure 14: mean and variance of GPVR's process at the first view, with its level 0, the surface."""
    seen = begin(preset("paper", task=task, seed=seed, method="gpvr"), 1, cache_dir)
    data, found = process(seen)
    points, workspace = seen.rummager.workspace.points, seen.rummager.workspace
    mean, variance = predictive_mean(data, found, points), predictive_variance(data, found, points)
    share = [float(variance.quantile(level) / variance.amax()) for level in (0.5, 0.9)]
    with style.figure(9.6, 4.0) as figure:
        left, right = figure.subplots(1, 2, sharex=True, sharey=True)
        _map(left, seen, mean, "Mean: 0 on the surface, 1 in free space")
        _map(right, seen, variance, "Variance")
        axes = [workspace.points[:, axis].unique() for axis in (0, 1)]
        layer = mean.reshape(workspace.shape).amin(-1)
        left.contour(*axes, layer.T, levels=[0.0], colors=style.CONTACT, linewidths=1.2)
        for label, colour in ((0.0, style.SURFACE), (1.0, style.FREE)):
            some = data.points[data.labels == label]
            left.scatter(some[:, 0], some[:, 1], s=3, color=colour, lw=0)
        for ax in (left, right):
            scene.draw_truth(seen.steps[0], seen.geometry, ax)
        style.save(figure, path)
    return (
        f"{task}, seed {seed}, preset `paper`, {len(data.points)} points; red is the level 0 of the mean. Half of the "
        f"workspace has more than {share[0]:.2f} of the largest variance, a tenth of it more than {share[1]:.2f}."
    )


def process(seen: Seen) -> tuple[Labelled, Hyperparameters]:
    """What the first plan's process was fitted to, and what was found."""
    first, plan, workspace = seen.steps[0], seen.steps[1].plan, seen.rummager.workspace
    if plan is None:
        raise ValueError("Expected a first plan")
    settings, belief, kept = GPVRSettings(), first.belief, memory([first])
    field = information_field(
        seen.rummager.model.sdf, belief.world_T_object, belief.log_weights, workspace.points, InformationSettings()
    )
    known = workspace.points[field.semantics[..., 0] > settings.free_probability]
    free = torch.cat((kept.points[kept.of_class(Semantics.FREE)], known))
    thin = next_to_nodes(free, settings.free_spacing * workspace.spacing, workspace.bounds)
    data = labelled(kept.points[kept.of_class(Semantics.SURFACE)], thin, settings.max_points)
    return data, Hyperparameters(*plan.info["gp_hyperparameters"])


def touch_resampled(steps: list[StepRecord]) -> int | None:
    """The first step at which something was touched and particles were resampled."""
    return next((k for k, step in enumerate(steps) if step.resampled and bool(step.reading.in_contact.any())), None)


DRAWN: dict[str, Callable[[str, int, Path, Path], str]] = {
    "fig2": draw_sensor_model,
    "fig4": draw_first_view,
    "fig6": draw_resampling,
    "fig7": draw_reach,
    "fig14": draw_process,
}
"""What draws each for a task and a seed to a path; it gives what is to be said below."""


def _about(steps: list[StepRecord], geometry: SceneGeometry) -> scene.Extent:
    """The part of the scene about the object, wherever the tool is."""
    poses = torch.cat([step.belief.world_T_object for step in steps])
    return bounding_box([line for pose in poses for line in object_outline(geometry, pose)], 0.03)


def _frame(ax: "Axes", extent: scene.Extent) -> None:
    left, right, bottom, top = extent
    ax.set(xlim=(left, right), ylim=(bottom, top), aspect="equal", xlabel="x [m]", ylabel="y [m]")


def _map(ax: "Axes", seen: Seen, values: Float[Tensor, "V"] | None, title: str) -> None:
    """Values over the whole workspace, from above; of several layers the largest."""
    workspace = seen.rummager.workspace
    low, high = workspace.bounds[:, :2].tolist()
    if values is not None:
        shown = values.reshape(workspace.shape).amax(-1).float().numpy()
        image = ax.imshow(shown.T, origin="lower", extent=(low[0], high[0], low[1], high[1]), cmap="viridis")
        ax.figure.colorbar(image, ax=ax, shrink=0.8)
    ax.set(title=title, xlabel="x [m]", ylabel="y [m]")


def _as_kept(steps: list[StepRecord]) -> Observation:
    """All points up to the last of some steps, as the filter keeps them."""
    return concatenate([step.added for step in steps])
