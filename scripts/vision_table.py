"""How far off what cameras, clouds and bubbles report is, on scenes in closed form, and how long it takes.

    python -m scripts.vision_table run                  # a line a cell in scripts/results/vision.jsonl, once
    OMP_NUM_THREADS=2 python -m scripts.vision_table times --threads 2    # on an otherwise idle machine
    python -m scripts.vision_table show                 # Markdown

Every image has 1 % of its pixels lost, and half of those at edges mix the two depths, the noise apart.
"""

import statistics
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import torch

from rumi.bench.machine import environment
from rumi.bench.timing import fitting_clock
from rumi.cli import script
from scripts.bench.known_scenes import SCENES, SceneView, pressed_bubble, scene_view, with_noise
from scripts.experiment import RESULTS, Experiment, Line, newest
from scripts.reproduce.cells import table
from scripts.reproduce.code import code_of
from scripts.store import Store
from sdf import se3
from sdf.primitives import Capsule
from sensors.observation import Observation
from sensors.semantics import Semantics
from sensors.touch.bubble import Bubble, bubble_patch
from sensors.vision.camera import pixel_points
from sensors.vision.cloud import cloud_observation
from sensors.vision.robot_body import RobotBody
from sensors.vision.view import Image, KnownScene, ViewSettings, view_observation

FAR_M = 0.006
NOISES_MM = (0.0, 0.5, 1.0, 2.0, 4.0)
BOUNDS = torch.tensor([[0.2, -0.2, 0.0], [0.6, 0.2, 0.16]])
DRAWS = 10
FRAMES = 14  # at 30 Hz: the last of them is more than 0.4 s after the first


@dataclass(frozen=True)
class Times:
    """Time the converters.

    Attributes:
        threads: of PyTorch and OpenCV.
        frames: each is a sample.
        results: where the line goes.
    """

    threads: int = 2
    frames: int = 40
    results: Path = RESULTS / "vision.jsonl"


def measure(way: str, scene: str, noise_mm: float) -> dict[str, float]:
    """Means over some draws of the noise."""
    seeds = [1000] if noise_mm == 0 and way == "bubble" else range(1000, 1000 + DRAWS)
    found = [figures(*WAYS[way](scene, 1e-3 * noise_mm, torch.Generator().manual_seed(seed))) for seed in seeds]
    line = {name: statistics.fmean(x[name] for x in found) for name in found[0]}
    line["deepest_mm"] = min(x["deepest_mm"] for x in found)
    line["inside"] = sum(x["inside"] for x in found)
    return {name: round(value, 4) for name, value in line.items()} | {"seeds": len(found)}


def figures(observation: Observation, distance: Callable[[torch.Tensor], torch.Tensor]) -> dict[str, float]:
    """How far surface points are off, and free ones in."""
    surface, free = (observation.points[observation.of_class(s)] for s in (Semantics.SURFACE, Semantics.FREE))
    off, clear = distance(surface).abs(), distance(free)
    return {
        "points": float(len(surface)),
        "mean_mm": 1e3 * float(off.mean()),
        "p95_mm": 1e3 * float(off.quantile(0.95)),
        "far": 100.0 * float((off > FAR_M).double().mean()),
        "free": float(len(free)),
        "inside": float((clear < 0).sum()),
        "deepest_mm": 1e3 * float(clear.min()),
    }


_scene = cache(scene_view)


def _noisy(scene: SceneView, noise_m: float, generator: torch.Generator) -> torch.Tensor:
    return with_noise(scene.depth, noise_m, lost=0.01, mixed=True, generator=generator).float()


def _camera(settings: ViewSettings) -> Callable[..., tuple[Observation, Callable[[torch.Tensor], torch.Tensor]]]:
    def way(name: str, noise_m: float, generator: torch.Generator) -> tuple[Observation, Any]:
        scene, memory = _scene(name), None
        for frame in range(FRAMES if settings.persist_s > 0 else 1):
            view = view_observation(
                Image(_noisy(scene, noise_m, generator), scene.intrinsics, scene.color, scene.mask, frame / 30.0),
                scene.world_T_camera,
                settings,
                KnownScene(bounds=BOUNDS),
                memory=memory,
                generator=generator,
            )
            memory = view.memory
        return view.observation, scene.distance

    return way


def _cloud(name: str, noise_m: float, generator: torch.Generator) -> tuple[Observation, Any]:
    scene = _scene(name)
    depth = _noisy(scene, noise_m, generator)
    there = (depth > 0) & torch.isfinite(depth)
    points = pixel_points(depth, there, scene.intrinsics)
    order = torch.randperm(len(points), generator=generator)
    settings = ViewSettings("plane")
    view = cloud_observation(
        points[order], scene.world_T_camera, settings, KnownScene(bounds=BOUNDS), generator=generator
    )
    return view.observation, scene.distance


def _bubble(name: str, noise_m: float, generator: torch.Generator) -> tuple[Observation, Any]:
    pressed = pressed_bubble(name)
    bubble = Bubble.of(pressed.rest, pressed.intrinsics, se3.identity())
    depth = with_noise(pressed.depth, noise_m, lost=0.01, generator=generator)
    return bubble_patch(bubble, depth, se3.identity()).observation, pressed.distance


WAYS: dict[str, Callable[..., tuple[Observation, Any]]] = {
    "camera, mask, no filter": _camera(ViewSettings(edges=None)),
    "camera, mask": _camera(ViewSettings()),
    "camera, colour": _camera(ViewSettings("color", (200.0, 260.0))),
    "camera, plane and cluster": _camera(ViewSettings("plane")),
    "camera, colour, 0.4 s": _camera(ViewSettings("color", (200.0, 260.0), persist_s=0.4)),
    "cloud without order, plane": _cloud,
    "bubble": _bubble,
}


def times(options: Times) -> None:
    """Time frames with all filters, and pairs of bubbles: by the processor's clock with one thread, else the wall's."""
    import cv2

    torch.set_num_threads(options.threads)
    cv2.setNumThreads(options.threads)
    clock = fitting_clock(options.threads)
    scene, random = _scene("box"), torch.Generator().manual_seed(1000)
    depth = _noisy(scene, 0.001, random).nan_to_num(posinf=0.0)
    millimetres = (1e3 * depth).round().to(torch.int32).numpy().astype("uint16")
    body = RobotBody([Capsule((0.0, 0.0, 0.0), (0.0, 0.0, 0.3), 0.06) for _ in range(8)])
    links = torch.eye(4).repeat(8, 1, 1)
    links[:, 0, 3] = torch.linspace(0.0, 0.25, 8)
    colour = ViewSettings("color", (200.0, 260.0), persist_s=0.4)
    cells = {"colour": colour, "plane and cluster": replace(colour, segmentation="plane")}
    found: dict[str, list[float]] = {}
    for name, settings in cells.items():
        memory, stamps = None, iter(range(10_000))

        def frame(settings: ViewSettings = settings, stamps: Iterator[int] = stamps) -> None:
            nonlocal memory
            view = view_observation(
                Image(millimetres, scene.intrinsics, scene.color, stamp=next(stamps) / 30.0),
                scene.world_T_camera,
                settings,
                KnownScene(body=body, world_T_links=links, bounds=BOUNDS),
                memory=memory,
                generator=random,
            )
            memory = view.memory
            assert view.memory is not None

        found[f"640 x 480 depth, {name}, 8 links, 0.4 s, free points"] = _samples(frame, options.frames, clock)
    pressed = pressed_bubble("sphere")
    bubble = Bubble.of(pressed.rest, pressed.intrinsics, se3.identity())
    images = [with_noise(pressed.depth, 0.0005, generator=random).float() for _ in range(2)]

    def pair() -> None:
        for image in images:
            bubble_patch(bubble, image, se3.identity())

    found["pair of bubbles, 224 x 171 each"] = _samples(pair, options.frames, clock)
    milliseconds = {
        name: {"median": round(1e3 * statistics.median(x), 2), "least": round(1e3 * min(x), 2)}
        for name, x in found.items()
    }
    settings = {"code": code_of("vision"), "threads": options.threads}
    Store(options.results).add(settings, {"made_on": environment(torch.device("cpu")), "milliseconds": milliseconds})
    sys.stdout.write(f"{milliseconds}\n")


def _samples(call: Callable[[], None], count: int, clock: Callable[[], float]) -> list[float]:
    for _ in range(15):
        call()
    seconds = []
    for _ in range(count):
        began = clock()
        call()
        seconds.append(clock() - began)
    return seconds


def show(lines: list[Line], chosen: Mapping[str, tuple[object, ...]]) -> str:
    """Errors and times, by the newest code."""
    lines = newest(lines)
    heads = (
        "way", "noise (mm)", "surface points", "mean off (mm)", "95 % within (mm)", "beyond 6 mm (%)", "free points",
        "of them inside", "nearest (mm)",
    )  # fmt: skip
    columns = (("points", 0), ("mean_mm", 2), ("p95_mm", 2), ("far", 2), ("free", 0), ("inside", 0))
    rows = []
    for way, noise in dict.fromkeys((x["way"], x["noise_mm"]) for x in lines if "scene" in x):
        own = {x["scene"]: x for x in lines if "scene" in x and (x["way"], x["noise_mm"]) == (way, noise)}
        cells = [own[name] for name in SCENES if name in own]
        each = [", ".join(f"{x[name]:.{digits}f}" for x in cells) for name, digits in columns]
        rows.append([way, f"{noise:g}", *each, f"{min(x['deepest_mm'] for x in cells):.1f}"])
    parts = [table(heads, rows)]
    for threads, timed in {x["threads"]: x for x in lines if "milliseconds" in x}.items():
        made = timed["made_on"]
        parts.append(f"{made['processor']}, threads: {threads}, the {made['clock']}'s clock, load {made['load']}\n")
        times = ([name, f"{x['median']:g}", f"{x['least']:g}"] for name, x in timed["milliseconds"].items())
        parts.append(table(("work", "median (ms)", "least (ms)"), times))
    return "\n".join(parts)


EXPERIMENT = Experiment(
    __doc__,
    "vision.jsonl",
    {"way": tuple(WAYS), "scene": SCENES, "noise_mm": NOISES_MM},
    measure,
    show,
    identity=lambda variant: {"code": code_of("vision")},
    commands={"times": (Times, times)},
)

if __name__ == "__main__":
    script(EXPERIMENT.main)
