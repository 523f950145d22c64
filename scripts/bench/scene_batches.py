"""Belief updates, rollouts, plans and runs of scenes, alone and together: python -m scripts.bench.scene_batches."""

import json
import time
from collections.abc import Callable
from typing import Any

import torch

import rumi
from kmppi import MPPI, MPPISettings
from kmppi.types import Objective
from rumi.belief.mixed_filter import MixedFilter
from rumi.belief.particles import PoseBelief
from rumi.belief.pose_filter import FilterSettings, PoseFilter
from rumi.cache import cache_folder
from rumi.dynamics.outline import GridOutline, support_of
from rumi.dynamics.quasi_static import QuasiStaticRollouts, QuasiStaticSettings
from rumi.loop import run_to_end
from rumi.robot.tool import Tool
from rumi.session import run_scenes
from sdf import se3
from sdf.containers import index
from sdf.grid_sdf import GridSDF
from sdf.primitives import Box, Cylinder, Mug, Sphere
from sensors.discrepancy import Discrepancy
from sensors.observation import Observation
from sensors.reading import Reading
from sensors.semantics import Semantics

SHAPES = (Box((0.03, 0.04, 0.05)), Sphere(0.045), Mug(), Cylinder(0.04, 0.05), Box((0.02, 0.06, 0.04)))
STEPS = 5


def scenes(count: int, particles: int, points: int, seed: int = 0) -> tuple[PoseBelief, list[Reading]]:
    """Beliefs about objects at the origin, and readings of surface and free points; some move the object."""
    random = torch.Generator().manual_seed(seed)
    spread = torch.tensor([0.01, 0.01, 0.3])
    belief = PoseBelief.uniform(se3.from_planar(spread * torch.randn(count, particles, 3, generator=random), 0.0))
    readings = []
    for step in range(STEPS):
        way = torch.nn.functional.normalize(torch.randn(count, points, 3, generator=random), dim=-1)
        kind = torch.where(torch.arange(points) % 2 == 0, int(Semantics.SURFACE), int(Semantics.FREE)).expand(count, -1)
        places = way * torch.where(kind == Semantics.FREE, 0.08, 0.045)[..., None]
        yes = torch.ones(count, points, dtype=torch.bool)
        shift = torch.zeros(count, 3)
        shift[:, 0] = 0.005 * (step % 2) * (torch.arange(count) % 2)
        readings.append(
            Reading(
                Observation(places, kind, yes, yes),
                torch.zeros(count, points, dtype=torch.long),
                se3.identity((count, 1)),
                torch.ones(count, 1, dtype=torch.bool),
                se3.from_planar(shift)[:, None],
                torch.zeros(count, 3),
                torch.zeros(count),
                torch.full((count,), float(step)),
            )
        )
    return belief, readings


def seconds(work: Callable[[], Any], rounds: int = 3) -> float:
    """Least CPU time of a few rounds."""
    taken = []
    for _ in range(rounds):
        start = time.process_time()
        work()
        taken.append(time.process_time() - start)
    return min(taken)


def case(filters: list[PoseFilter], count: int, particles: int, points: int) -> dict[str, float]:
    """Updates a second of as many scenes, of the objects in turn, and how much longer one takes alone."""
    mixed, of = MixedFilter(filters), torch.arange(count) % len(filters)
    belief, readings = scenes(count, particles, points)

    def together() -> float:
        """Share of updates that resampled."""
        own, memory, redrawn = belief, Observation.empty((count,)), 0.0
        random = [torch.Generator().manual_seed(row) for row in range(count)]
        for reading in readings:
            own, memory, info = mixed(own, memory, reading, of, generator=random)
            redrawn += float(info.resampled.float().mean()) / STEPS
        return redrawn

    few = range(min(count, 20))

    def alone() -> None:
        for row in few:
            own, memory = index(belief, row), Observation.empty()
            random = torch.Generator().manual_seed(row)
            for reading in readings:
                own, memory, _ = filters[of[row]](own, memory, index(reading, row), generator=random)

    with torch.no_grad():
        redrawn = together()
        batch, single = seconds(together) / (count * STEPS), seconds(alone) / (len(few) * STEPS)
    return {
        "scenes": count,
        "particles": particles,
        "points": points,
        "objects": len(filters),
        "resampled": round(redrawn, 2),
        "updates_a_second": round(1.0 / batch),
        "times_alone": round(single / batch, 1),
    }


def compared(part: str, count: int, together: Callable[[], Any], alone: Callable[[int], Any]) -> dict[str, float | str]:
    """Milliseconds of a scene in a batch, and how much longer one takes alone; the least of three rounds."""
    batch = seconds(together) / count
    single = seconds(lambda: [alone(row) for row in range(count)]) / count
    return {"part": part, "scenes": count, "ms": round(1e3 * batch, 3), "times_alone": round(single / batch, 1)}


def pushes(count: int, samples: int, horizon: int, rollouts: int, mini_steps: int) -> dict[str, float | str]:
    """Quasi-static rollouts of mugs before a gripper."""
    random, height = torch.Generator().manual_seed(0), 0.045
    mug, tool = GridSDF.from_sdf(Mug(), 0.004), Tool(torch.tensor([[0.0, -0.4], [0.8, 0.4]]), height_m=height)
    shape = GridOutline.of_slice(mug, height), support_of(mug)
    settings = QuasiStaticSettings(mini_steps=mini_steps)
    planar = torch.tensor([0.4, 0.0, 0.0]) + torch.tensor([0.02, 0.02, 1.0]) * torch.randn(
        count, 100, 3, generator=random
    )
    poses, weights = se3.from_planar(planar), torch.zeros(count, 100).log_softmax(-1)
    start = torch.tensor([0.25, 0.0, 0.0]).expand(count, 3)
    controls = (torch.randn(count, samples, horizon, 3, generator=random) + torch.tensor([0.5, 0.0, 0.0])).clamp(-1, 1)

    def whole(rows: slice | int) -> None:
        model = QuasiStaticRollouts(*shape, tool, poses[rows], weights[rows], settings)
        model.rollout(start[rows], controls[rows], rollouts=rollouts)

    name = f"push rollouts, {samples} x {rollouts} of {horizon} actions"
    return compared(name, count, lambda: whole(slice(None)), whole)


def plans(count: int, samples: int) -> dict[str, float | str]:
    """Two iterations of KMPPI, whose costs take next to no time."""
    planner, targets = (
        MPPI(MPPISettings(samples=samples, iterations=2), 3),
        torch.linspace(-0.5, 0.5, 3 * count).view(-1, 3),
    )
    random = [torch.Generator().manual_seed(row) for row in range(count)]
    start = planner.initial(generator=random)

    def toward(targets: torch.Tensor) -> Objective:
        return lambda controls: (controls - targets[..., None, None, :]).square().sum((-2, -1))

    return compared(
        f"KMPPI, 2 iterations of {samples} samples",
        count,
        lambda: planner.plan(start, toward(targets), generator=random),
        lambda row: planner.plan(planner.from_knots(start.knots[row]), toward(targets[row]), generator=random[row]),
    )


def runs(count: int, steps: int) -> dict[str, float | str]:
    """Whole runs with drawn mugs, simulators included: side by side, and each by itself."""
    parts = [
        rumi.build(rumi.preset("default", task="mug", steps=steps), cache_dir=cache_folder()) for _ in range(count)
    ]
    tasks, agents = [one.task for one in parts], [one.agent for one in parts]

    def together() -> None:
        run_scenes(tasks, agents, seeds=range(1000, 1000 + count), steps=steps)

    return compared(
        f"whole runs of {steps} actions",
        count,
        together,
        lambda row: run_to_end(tasks[row], agents[row], seed=1000 + row, steps=steps),
    )


def main() -> None:
    """Print a JSON line for each case."""
    torch.set_num_threads(1)
    print(json.dumps(runs(4, 4)), flush=True)
    for samples in (32, 500):
        print(json.dumps(plans(64, samples)), flush=True)
    for sizes in ((2, 5, 2, 4), (62, 15, 8, 16)):
        print(json.dumps(pushes(64, *sizes)), flush=True)
    settings = FilterSettings(trigger=0.3)
    filters = [
        PoseFilter(settings, [Discrepancy(GridSDF.from_sdf(shape, 0.004, outer=0.06), 0.1)], "SE(2)")
        for shape in SHAPES
    ]
    for count, particles, points, objects in ((64, 20, 50, 1), (64, 100, 600, 1), (64, 20, 50, 5), (1000, 100, 20, 5)):
        print(json.dumps(case(filters[:objects], count, particles, points)), flush=True)


if __name__ == "__main__":
    main()
