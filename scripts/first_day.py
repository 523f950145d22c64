"""Fifteen objects that a laboratory may bring on its first day, found by `rumi run mug-0 --mesh` with default settings.

    python -m scripts.first_day run --seeds 0-2 --jobs 2        # a line a run in scripts/results/first_day.jsonl
    python -m scripts.first_day run --objects can ball --seeds 1000
    python -m scripts.first_day show                            # Markdown

Their meshes are made here. With --motions measured a sensor reports exactly how an object moved, with the others none
does. A run ends found (sure, the pose within the task's tolerance modulo the object's symmetries), unsure (it says so),
refused (before anything is run, with what to do), wrong (sure, the pose is not) or as a crash. An object fell where its
z axis is more than 20 degrees off upright after an action, be it that it rolled. Tune on seeds of 1000 and more; seeds
0-2 are for the record.
"""

import math
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from rumi import loop
from rumi.belief.remarks import least_tilt
from rumi.cache import cache_folder
from rumi.cli import script
from rumi.errors import DegenerateBeliefError, UsageError
from rumi.records import RunResult, StepRecord
from rumi.tasks.rummage.agent import Rummager
from rumi.tasks.rummage.build import build
from rumi.tasks.rummage.objects import ObjectSettings
from rumi.tasks.rummage.settings import Settings, preset
from scripts.experiment import Experiment, Line
from scripts.reproduce.cells import table
from scripts.reproduce.code import code_of
from sdf.drill import Drill

PART = "first-day"
MOTIONS = ("measured", "trajectory", "corrected")
FELL_RAD = math.radians(20.0)
OUTCOMES = ("found", "unsure", "refused", "wrong", "crash")
Mesh = Any  # trimesh has no types


@dataclass(frozen=True)
class Item:
    """An object.

    Attributes:
        file: of its mesh; what is made and how it is written.
        make: its mesh.
        about: what a user says of it, as `ObjectSettings` has it.
    """

    file: str
    make: Callable[[], Mesh]
    about: Mapping[str, Any] = field(default_factory=dict)


def box(size: Sequence[float], at: Sequence[float] = (0.0, 0.0, 0.0)) -> Mesh:
    """A box about a point."""
    import trimesh

    return trimesh.creation.box(size, trimesh.transformations.translation_matrix(at))


def turned(mesh: Mesh, angle: float, axis: Sequence[float], at: Sequence[float] = (0.0, 0.0, 0.0)) -> Mesh:
    """A mesh turned about the origin, then moved."""
    import trimesh

    mesh.apply_transform(trimesh.transformations.rotation_matrix(angle, axis))
    mesh.apply_translation(at)
    return mesh


def joined(*parts: Mesh) -> Mesh:
    """One mesh of several that overlap."""
    import trimesh

    return trimesh.util.concatenate(parts)


def bracket() -> Mesh:
    """An angle of two sheets of 5 mm, in millimetres."""
    return joined(box((80, 40, 5), (40, 0, 2.5)), box((5, 40, 60), (2.5, 0, 30)))


def bottle() -> Mesh:
    """A bottle with a ring for a handle."""
    import trimesh

    profile = [(0, 0), (0.04, 0), (0.042, 0.01), (0.042, 0.14), (0.03, 0.17), (0.015, 0.19), (0.015, 0.22), (0, 0.22)]
    ring = turned(trimesh.creation.torus(0.035, 0.007), 0.5 * math.pi, (1, 0, 0), (0.05, 0.0, 0.10))
    return joined(trimesh.creation.revolve(np.array(profile), sections=48), ring)


def bottle_with_holes() -> Mesh:
    """The same without 3 % of its faces, and with a hole of 40 mm in its side."""
    mesh = bottle()
    kept = np.random.default_rng(0).random(len(mesh.faces)) > 0.03
    kept &= np.linalg.norm(mesh.triangles_center - (-0.042, 0.0, 0.08), axis=1) >= 0.02
    mesh.update_faces(kept)
    mesh.remove_unreferenced_vertices()
    return mesh


def spray() -> Mesh:
    """A flattened spray bottle with a head and a trigger."""
    import trimesh

    profile = [(0, 0), (0.04, 0), (0.04, 0.15), (0.014, 0.19), (0.014, 0.22), (0, 0.22)]
    body = trimesh.creation.revolve(np.array(profile), sections=40)
    body.apply_scale((1.0, 0.65, 1.0))
    trigger = turned(box((0.008, 0.012, 0.05)), 0.5, (0, 1, 0), (0.045, 0.0, 0.20))
    return joined(body, box((0.085, 0.025, 0.03), (0.015, 0.0, 0.235)), trigger)


def hammer() -> Mesh:
    """A round handle along x and a round head across it, in millimetres."""
    import trimesh

    handle = turned(trimesh.creation.cylinder(12, 280, sections=32), 0.5 * math.pi, (0, 1, 0))
    return joined(
        handle, turned(trimesh.creation.cylinder(16, 100, sections=32), 0.5 * math.pi, (1, 0, 0), (140, 0, 0))
    )


def round_body(radius: float, height: float) -> Mesh:
    """A cylinder that stands."""
    import trimesh

    return trimesh.creation.cylinder(radius, height)


def ball() -> Mesh:
    """A ball of 80 mm."""
    import trimesh

    return trimesh.creation.icosphere(3, 0.04)


def spoon() -> Mesh:
    """A flat spoon."""
    return joined(box((0.15, 0.008, 0.003)), turned(round_body(0.02, 0.006), 0.0, (0, 0, 1), (0.085, 0.0, 0.0)))


def drill() -> Mesh:
    """The built-in drill, of a box and capsules."""
    import trimesh

    own = Drill()
    parts = [box(own.base, (0.0, 0.0, 0.5 * own.base[2]))]
    for start, end, radius in own.capsules:
        way = np.subtract(end, start)
        part = trimesh.creation.capsule(np.linalg.norm(way), radius)
        part.apply_translation(-part.bounds.mean(0))
        part.apply_transform(trimesh.geometry.align_vectors((0.0, 0.0, 1.0), way))
        part.apply_translation(0.5 * np.add(start, end))
        parts.append(part)
    return joined(*parts)


OBJECTS: dict[str, Item] = {
    "L-bracket in mm": Item("bracket.stl", bracket, {"scale": 0.001, "mass_kg": 0.08}),
    "bottle with handle": Item("bottle.obj", bottle),
    "bottle with holes": Item("bottle_holes.ply", bottle_with_holes),
    "spray bottle": Item("spray.obj", spray),
    "hammer, lying": Item("hammer.stl", hammer, {"scale": 0.001}),
    "hammer, standing": Item("hammer.stl", hammer, {"scale": 0.001, "upright": (0.0, 90.0, 0.0)}),
    "can": Item("can.stl", lambda: round_body(0.035, 0.12)),
    "ball": Item("ball.stl", ball),
    "plate 2 mm": Item("plate.stl", lambda: box((0.16, 0.10, 0.002))),
    "spoon": Item("spoon.stl", spoon),
    "nut": Item("nut.stl", lambda: joined(box((0.02, 0.012, 0.02)), box((0.01, 0.006, 0.006), (0.013, 0.0, -0.006)))),
    "box 0.6 m": Item("big.stl", lambda: joined(box((0.5, 0.3, 0.4)), box((0.1, 0.1, 0.2), (0.3, 0.0, -0.1)))),
    "sheet 0.8 mm": Item("sheet.stl", lambda: box((0.0008, 0.10, 0.10))),
    "thin post": Item("post.stl", lambda: round_body(0.012, 0.18), {"friction": 0.9, "mass_kg": 0.2}),
    "drill": Item("drill.stl", drill, {"mass_kg": 0.9}),
    "bracket of 50 kg": Item("bracket.stl", bracket, {"scale": 0.001, "mass_kg": 50.0}),
}
"""By name: the fifteen, the hammer in two ways."""


def settings_of(name: str, motion: str, seed: int, folder: Path) -> Settings:
    """Settings of a run; its mesh is written into a folder."""
    item = OBJECTS[name]
    item.make().export(folder / item.file)
    own = ObjectSettings(mesh=str(folder / item.file), **item.about)
    default = preset(task="mug-0", seed=seed, object=own)
    told = replace(default.simulator, measures_motion=motion == "measured")
    return replace(default, filter=replace(default.filter, motion=motion), simulator=told)


def measure(object: str, motion: str, seed: int) -> dict[str, Any]:
    """How a run ends, and what it says."""
    begun = time.perf_counter()
    try:
        with tempfile.TemporaryDirectory() as folder:
            parts = build(settings_of(object, motion, seed, Path(folder)), cache_dir=cache_folder())
    except UsageError as error:
        return {"outcome": "refused", "said": str(error)}
    except Exception as error:  # whatever it is, it is what is looked for
        return {"outcome": "crash", "said": f"{type(error).__name__}: {error}"}
    ready, off_upright = time.perf_counter(), list[float]()
    try:
        with parts:
            result = loop.run_to_end(
                *parts, seed=seed, steps=parts.agent.steps, on_step=lambda step: off_upright.append(tilt(step))
            )
    except DegenerateBeliefError as error:
        return {"outcome": "unsure", "said": str(error)}
    except Exception as error:
        return {"outcome": "crash", "said": f"{type(error).__name__}: {error}"}
    told = result.as_dict()
    names = ("right", "stopped_by", "steps", "contacts", "position_error_mm", "rotation_error_deg", "final_nll")
    return {
        "outcome": outcome(parts.agent, result),
        **{name: told[name] for name in names},
        "said": "",
        "warnings": list(told.get("warnings", ())),
        "remarks": [remark.name for remark in result.remarks],
        "tips_at": next((remark.step for remark in result.remarks if remark.name == "tips"), None),
        "fell_at": next((step for step, angle in enumerate(off_upright) if angle > FELL_RAD), None),
        "build_s": ready - begun,
        "run_s": time.perf_counter() - ready,
    }


def tilt(step: StepRecord) -> float:
    """Angle of the true object's z axis off upright at the end of an action, radians; no run is told."""
    return least_tilt(step.truth[None]) if step.truth is not None and step.truth.shape[-1] == 4 else 0.0


def outcome(agent: Rummager, result: RunResult) -> str:
    """Of a run that ended by itself or after its last action."""
    if result.stopped_by != "sure":
        return "unsure"
    metres, degrees = 1e-3 * (result.position_error_mm or 0.0), result.rotation_error_deg or 0.0
    near = metres <= agent.position_tolerance_m and math.radians(degrees) <= agent.rotation_tolerance_rad
    return "found" if near else "wrong"


def show(lines: list[Line], chosen: Mapping[str, tuple[str, ...]]) -> str:
    """A row an object, the sum, and what was said; of runs that were done again, with other code, the last counts."""
    lines = list({(line["object"], line["motion"], line.get("seed")): line for line in lines}.values())
    motions = [motion for motion in MOTIONS if any(line["motion"] == motion for line in lines)]
    names = [name for name in OBJECTS if any(line["object"] == name for line in lines)]
    told = (*(f"motion {motion}" for motion in motions), "actions", "wrong, with a warning")
    heads = ("object", *told, "tips said: fell, stood", "remarks")
    rows = [_row(name, motions, [line for line in lines if line["object"] == name]) for name in names]
    said = sorted({f"- {line['object']}, {line['outcome']}: {line['said']}" for line in lines if line["said"]})
    sums = table(heads, [*rows, _row("all", motions, lines)] if rows else [])
    return "\n".join([sums, *said])


def _row(name: str, motions: Sequence[str], lines: Sequence[Line]) -> list[str]:
    steps = [str(line["steps"]) for line in lines if "steps" in line]
    wrong = [bool(line["warnings"]) for line in lines if line["outcome"] == "wrong"]
    odd = Counter(remark for line in lines for remark in line.get("remarks", ()))
    return [
        name,
        *(", ".join(_counted(line["outcome"] for line in lines if line["motion"] == motion)) for motion in motions),
        f"{min(steps, key=int)} to {max(steps, key=int)}" if steps else "-",
        f"{sum(wrong)} of {len(wrong)}" if wrong else "-",
        _tips(lines),
        ", ".join(f"{remark} {count}" for remark, count in sorted(odd.items())) or "-",
    ]


def _tips(lines: Sequence[Line]) -> str:
    """Of runs without a sensor of the motion, how many said `tips` where the object fell or rolled, and where not."""
    some = [line for line in lines if line["motion"] != "measured" and "fell_at" in line]
    both = ([line for line in some if (line["fell_at"] is None) is stood] for stood in (False, True))
    counts = [f"{sum(line['tips_at'] is not None for line in part)} of {len(part)}" for part in both]
    return ", ".join(counts) if some else "-"


def _counted(outcomes: Iterator[str]) -> list[str]:
    counts = Counter(outcomes)
    return [f"{counts[name]} {name}" for name in OUTCOMES if counts[name]] or ["-"]


EXPERIMENT = Experiment(
    __doc__,
    "first_day.jsonl",
    {"object": tuple(OBJECTS), "motion": MOTIONS},
    measure,
    show,
    seeds="0-2",
    identity=lambda variant: {"part": PART, "code": code_of(PART)},
)

if __name__ == "__main__":
    script(EXPERIMENT.main)
