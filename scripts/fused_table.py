"""The fused run against each of its sensors alone, seed by seed; resumable.

    python -m scripts.fused_table run --seeds 1000-1009 --seconds 120   # a line a run in scripts/results/fused.jsonl
    python -m scripts.fused_table run --sensors 'all, noise-free'       # with sensors that make no errors
    python -m scripts.fused_table show                                  # Markdown
    python -m scripts.fused_table draw                                  # scripts/docs/figures/fused.png
    python -m scripts.fused_table senses --pushes 100                   # how far each sense and the grasp are off

Tune on seeds of 1000 and more.
"""

import hashlib
import statistics
import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch

from rumi import loop
from rumi.agent import Parts
from rumi.cache import cache_folder
from rumi.cli import script
from rumi.errors import DegenerateBeliefError
from rumi.runs.json_settings import FORMER_KEYS
from rumi.seeding import split
from rumi.tasks.handle.agent import HandleAgent
from rumi.tasks.handle.build import build_handle
from rumi.tasks.handle.gripper import HandleGripper
from rumi.tasks.handle.settings import SENSORS, HandleSettings, SensorName, task_of
from rumi.tasks.handle.simulated import HandleTask
from rumi.tasks.rummage.scenes import make_tool
from scripts.experiment import FIGURES, RESULTS, Experiment, Line
from scripts.reproduce.cells import rate, table
from scripts.reproduce.intervals import bootstrap_mean
from scripts.store import Store
from sdf import se3
from sensors.contact_reading import ContactReading
from sensors.semantics import Semantics

USED: dict[str, tuple[SensorName, ...]] = {"all": SENSORS, **{name: (name,) for name in SENSORS}}
_FREE = ", noise-free"
VARIANTS = (*USED, *(name + _FREE for name in USED))


@dataclass(frozen=True)
class Draw:
    """Draw nll over the actions.

    Attributes:
        results: where the lines are.
        out: of the figure.
    """

    results: Path = RESULTS / "fused.jsonl"
    out: Path = FIGURES / "fused.png"


@dataclass(frozen=True)
class Senses:
    """Push mugs by chance, and hold what wrist and joints say against the truth; then grasp where they truly are.

    Attributes:
        pushes: how many.
        seed: the first mug's.
    """

    pushes: int = 100
    seed: int = 1000


@cache
def parts_of(sensors: str) -> Parts[HandleTask, HandleAgent]:
    """What the runs of a kind share."""
    return build_handle(settings_of(sensors), cache_dir=cache_folder())


def measure(sensors: str, seed: int) -> dict[str, Any]:
    """One run."""
    parts = parts_of(sensors)
    began, used = time.perf_counter(), time.process_time()
    try:
        found = loop.run_to_end(*parts, seed=seed).as_dict()
    except (DegenerateBeliefError, ValueError) as error:
        found = {"right": False, "lifted": False, "stopped_by": "error", "error": str(error)[:200]}
    found.pop("timings_s", None)
    seconds = {"seconds": time.perf_counter() - began, "cpu_s": time.process_time() - used}
    return {key: round(value, 2) for key, value in seconds.items()} | {k: rounded(v) for k, v in found.items()}


def _ended(line: dict[str, Any]) -> str:
    """Why a run stopped; lines of before have it by another name."""
    return line.get("ended") or line["stopped_by"]


def rounded(value: Any) -> Any:  # noqa: ANN401  (of a result)
    """The same with numbers of few digits."""
    if isinstance(value, list):
        return [rounded(part) for part in value]
    return round(value, 4) if isinstance(value, float) else value


def show(lines: list[Line], chosen: Mapping[str, tuple[str, ...]]) -> str:
    """Each kind of run, and all sensors against each alone, seed by seed."""
    current = [x for x in lines if x["settings"] == stamp(x["sensors"])]
    by = {name: {x["seed"]: x for x in current if x["sensors"] == name} for name in VARIANTS}
    heads = (
        "sensors", "runs", "nll summed up: mean, median", "right", "stopped on a wrong pose", "lifted",
        "actions, median", "seconds on the clock, median", "off, median (mm, degrees)",
    )  # fmt: skip
    rows = []
    for name, runs in by.items():
        own = [x for x in runs.values() if _ended(x) != "error"]
        if not own:
            continue
        total = [x["total_nll"] for x in own]
        off = [statistics.median(x[key] for x in own) for key in ("position_error_mm", "rotation_error_deg")]
        rows.append(
            [
                name,
                str(len(runs)),
                f"{statistics.mean(total):.0f}, {statistics.median(total):.0f}",
                rate([x["right"] for x in runs.values()]),
                str(sum(_ended(x) == "sure" and not x["right"] for x in own)),
                rate([x["lifted"] for x in runs.values()]),
                f"{statistics.median(x['steps'] for x in own):g}",
                f"{statistics.median(x['total_s'] for x in own):.0f}",
                f"{off[0]:.1f}, {off[1]:.1f}",
            ]
        )
    pairs = ("nll summed up, all sensors less", "pairs", "mean difference [95 %]", "median", "all sensors lower in")
    fused, apart = by["all"], {}
    for name in SENSORS:
        seeds = [s for s in sorted(fused) if s in by[name] and "total_nll" in fused[s] and "total_nll" in by[name][s]]
        apart[name] = [fused[s]["total_nll"] - by[name][s]["total_nll"] for s in seeds]
    return f"{table(heads, rows)}\n" + table(
        pairs,
        (
            [
                name,
                str(len(x)),
                "{:.0f} [{:.0f}, {:.0f}]".format(*bootstrap_mean(x, resamples=20_000)),
                f"{statistics.median(x):.0f}",
                f"{sum(one < 0 for one in x)} of {len(x)}",
            ]
            for name, x in apart.items()
            if x
        ),
    )


def draw(options: Draw) -> None:
    """Mean nll after each action, of all sensors and of each alone; a run that stopped keeps its last."""
    from rumi.viz import style

    lines = Store(options.results).flat()
    with style.figure(6.4, 3.6) as figure:
        axes = figure.subplots()
        for name in USED:
            own = [x["nll"] for x in lines if x["sensors"] == name and x["settings"] == stamp(name) and "nll" in x]
            if own:
                steps = settings_of(name).steps + 1
                held = np.array([(nll + nll[-1:] * steps)[:steps] for nll in own])
                axes.plot(held.mean(0).clip(0.1), label=f"{name} ({len(own)} runs)", lw=2.4 if name == "all" else 1.2)
        axes.set(xlabel="actions", ylabel="mean nll", yscale="log")
        axes.legend()
        figure.savefig(options.out, metadata={"Software": "rumi"})


def senses(options: Senses) -> None:
    """Markdown: touches by the wrench, signals of the joints, free points, grasps of the true pose."""
    torch.set_num_threads(1)
    settings = HandleSettings()
    tool = make_tool(task_of(settings), cache_dir=cache_folder())
    task = HandleTask(settings, tool, task_of(settings).object_factory())
    gripper = HandleGripper(task.model.exact, task.world.body, task.spec.physics)
    touches, said, turned, inside, told, lifted = [], [], [], [], [], []
    for seed in range(options.seed, options.seed + options.pushes):
        task.reset(seed)
        random = split(seed, "senses")
        angle = 1.2 * (torch.rand((), generator=random) - 0.5)
        way, aside = torch.stack((angle.cos(), angle.sin())), 0.03 * torch.randn((), generator=random)
        place = torch.tensor(task.spec.start[:2]) - 0.10 * way + aside * torch.stack((-way[1], way[0]))
        task.world.reset(torch.cat((place, angle[None])), torch.tensor(task.spec.start))
        result = task.step(torch.tensor([1.0, 0.0, 0.0]))
        reading, truth = result.reading, result.truth
        assert isinstance(reading, ContactReading) and reading.signals is not None
        motion, felt = reading.object_motion, task.world.trace
        assert motion is not None and truth is not None and felt is not None
        now = se3.inverse(truth) @ motion[-1] @ se3.inverse(motion)
        own = now[reading.wrench.instant]
        points = se3.apply(own, reading.wrench.points[:, None])[:, 0].requires_grad_()
        distance = task.model.exact.distance(points)
        (normal,) = torch.autograd.grad(distance.sum(), points)
        facing = se3.rotate(own, reading.wrench.normals[:, None])[:, 0]
        touches += distance.abs().tolist()
        turned += (normal * facing).sum(-1).clamp(-1.0, 1.0).acos().rad2deg().tolist()
        said += reading.wrench.point_sd.tolist()
        free = reading.observation.of_class(Semantics.FREE)
        at = se3.apply(now[reading.instant[free]], reading.observation.points[free][:, None])[:, 0]
        inside += task.model.exact.distance(at).tolist()
        ends = [0, *(int(end) + 1 for end in felt.ends)]
        force = [float(np.linalg.norm(felt.wrench[a:b, :3].mean(0))) for a, b in pairwise(ends)]
        told += [(f, max(force[max(0, k - 3) : k + 1]), bool(reading.signals[k])) for k, f in enumerate(force)]
        where = task.world.world_T_object()
        lifted.append(gripper.grasp(se3.to_planar(where), where))
    far = np.abs(np.array(touches)) * 1e3
    free_mm = np.array(inside) * 1e3
    hit, quiet = [s for f, _, s in told if f > 1.0], [s for _, lately, s in told if lately == 0.0]
    rows = (
        ("touches by the wrench", f"{len(far)}"),
        ("off the mug, mm: median, 95 %", f"{np.median(far):.1f}, {np.quantile(far, 0.95):.1f}"),
        ("said by the sensor's noise alone, mm: median", f"{1e3 * statistics.median(said):.1f}"),
        ("normals off, degrees: median, 95 %", f"{np.median(turned):.0f}, {np.quantile(turned, 0.95):.0f}"),
        ("signal of the joints where the mean force is above 1 N", rate(hit)),
        ("signal where nothing touches, nor did for 0.15 s", rate(quiet)),
        ("free points; of them inside the mug by more than 1, 2, 3 mm",
         f"{len(free_mm)}; " + ", ".join(str(int((free_mm < -depth).sum())) for depth in (1, 2, 3))),
        ("grasps of the true pose after a push that lift", rate(lifted)),
    )  # fmt: skip
    print(table((f"{len(lifted)} pushes", ""), rows), end="")


def settings_of(name: str) -> HandleSettings:
    """Of a kind of run."""
    return HandleSettings(sensors=USED[name.removesuffix(_FREE)], noise_free=name.endswith(_FREE))


def stamp(name: str) -> str:
    """Of the settings."""
    # results on record are kept under the names that settings had then
    told = repr(settings_of(name)).replace("HandleSettings(", "FusedSettings(")
    for former, now in FORMER_KEYS["HandleSettings"].items():
        told = told.replace(f"{now}=", f"{former}=")
    return hashlib.sha256(told.encode()).hexdigest()[:8]


EXPERIMENT = Experiment(
    __doc__,
    "fused.jsonl",
    {"sensors": VARIANTS},
    measure,
    show,
    seeds="1000-1009",
    usual={"sensors": tuple(USED)},
    identity=lambda variant: {"settings": stamp(variant["sensors"])},
    commands={"draw": (Draw, draw), "senses": (Senses, senses)},
)

if __name__ == "__main__":
    script(EXPERIMENT.main)
