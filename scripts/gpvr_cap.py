"""What a cap on the points of GPVR's Gaussian process costs and saves, against the fit to all of them.

    OMP_NUM_THREADS=1 python -m scripts.gpvr_cap --seeds 1000 --actions 0 8

Situations are first views of the mugs, and the state after some actions of GPVR. Of each, the process is fitted to
all points (50 steps from its usual start) and to at most as many as each cap allows, and its variance worked out on the
workspace's lattice; errors are of variances that are normalised to a largest value of 1, as Eq 37 uses them.
"""

import time
from dataclasses import dataclass

import numpy as np
import torch
import tyro

from rumi.belief.particles import PoseBelief
from rumi.cli import script
from rumi.fields.information import information_field
from rumi.planning.gpvr import GPVRPolicy, GPVRSettings
from rumi.planning.implicit_surface import Hyperparameters, Labelled, fit, predictive_variance
from rumi.planning.policy import Scene
from scripts.bench.deadlines import Situations
from scripts.reproduce.cells import table
from scripts.reproduce.correlation import spearman


@dataclass(frozen=True)
class Options:
    """What to measure.

    Attributes:
        tasks: which tasks.
        seeds: of the runs.
        actions: after how many actions of a run.
        caps: numbers of points.
    """

    tasks: tuple[str, ...] = ("mug-0", "mug-1", "mug-2")
    seeds: tuple[int, ...] = (1000,)
    actions: tuple[int, ...] = (0, 8)
    caps: tuple[int, ...] = (100, 150, 200, 300, 500)


def situations(options: Options) -> list[tuple[PoseBelief, Scene]]:
    """Beliefs with their scenes."""
    steps = max(options.actions) + 1
    runs = [Situations(task, "gpvr", seed, steps).given for task in options.tasks for seed in options.seeds]
    return [given[index] for given in runs for index in options.actions if index < len(given)]


def data(belief: PoseBelief, scene: Scene, cap: int) -> Labelled:
    """What GPVR fits its process to; all of it for a cap of 0."""
    policy = GPVRPolicy(gp=GPVRSettings(max_points=cap))
    fields = information_field(
        scene.model.sdf,
        belief.world_T_object,
        belief.log_weights,
        scene.workspace.points,
        policy.settings.information,
    )
    return policy.data(belief, scene, fields)


def timed(points: Labelled, lattice: torch.Tensor) -> tuple[Hyperparameters, np.ndarray, float, float]:
    """A fit, the normalised variance on the lattice, and the seconds of both."""
    start = time.perf_counter()
    found = fit(points)
    middle = time.perf_counter()
    variance = share(points, found, lattice)
    return found, variance, middle - start, time.perf_counter() - middle


def share(points: Labelled, hyperparameters: Hyperparameters, lattice: torch.Tensor) -> np.ndarray:
    """Normalised variance on the lattice."""
    variance = predictive_variance(points, hyperparameters, lattice)
    return np.asarray((variance / variance.max()).numpy())


def main(options: Options) -> None:
    """Measure and print a Markdown table; medians over the situations, the largest error over all."""
    torch.set_num_threads(1)
    rows: dict[int, list[tuple[float, ...]]] = {}
    for belief, scene in situations(options):
        lattice = scene.workspace.points
        whole = data(belief, scene, 0)
        best, full, fit_s, variance_s = timed(whole, lattice)
        rows.setdefault(0, []).append((len(whole.points), 0.0, 0.0, 0.0, 0.0, 1.0, fit_s, variance_s))
        for cap in options.caps:
            some = data(belief, scene, cap)
            _, own, fit_s, variance_s = timed(some, lattice)
            alike = np.abs(share(some, best, lattice) - full)
            apart = np.abs(own - full)
            errors = (alike.mean(), alike.max(), apart.mean(), apart.max(), spearman(own, full))
            rows.setdefault(cap, []).append((len(some.points), *errors, fit_s, variance_s))
    lines = []
    for cap, found in sorted(rows.items(), key=lambda row: row[0] or 10**9):
        values = np.array(found)
        middle, most = np.median(values, axis=0), values.max(0)
        errors = [f"{x:.3f}" for x in (most[2], middle[3], most[4], values[:, 5].min())]
        cells = [str(cap or "none"), f"{middle[0]:.0f}", f"{middle[1]:.4f}", *errors]
        lines.append([*cells, f"{middle[6]:.2f}", f"{middle[7]:.2f}"])
    heads = ("cap", "points", "error at the full fit's hyperparameters: mean", "largest")
    ends = ("error after its own fit: mean", "largest", "rank correlation", "fit, s", "variance, s")
    print(table((*heads, *ends), lines), end="")


if __name__ == "__main__":
    script(lambda: main(tyro.cli(Options, description=__doc__)))
