"""Measure signed distances of meshes against libigl's exact ones.

    python -m scripts.mesh_distances accuracy          # one JSON line a shape in scripts/results/mesh_distances.jsonl
    python -m scripts.mesh_distances show              # Markdown, with what mesh_times.py has timed

Needs libigl, and the environment variable RUMI_DATA for the drill. A line of a shape replaces an older one.
"""

import json
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import tyro

from rumi.bench.machine import environment
from rumi.cli import script
from scripts.bench import meshes
from scripts.bench.mug_mesh import damaged, mug_mesh
from sdf.base import SDF
from sdf.mesh.build import from_mesh
from sdf.mesh.mesh import TriangleMesh, load_mesh
from sdf.mesh.mesh_sdf import MeshSDF
from sdf.mesh.triangles import Triangles
from sdf.primitives import Mug
from sdf.surface import sample_triangles

RESULTS = Path(__file__).resolve().parent / "results" / "mesh_distances.jsonl"
SPACINGS_MM = (1.0, 2.0, 3.0, 5.0)
NEAR_M, PADDING_M, HOLE_M, LOST = 0.003, 0.02, 0.012, 0.01


class Shape(NamedTuple):
    """A mesh to measure, and the parts whose union is the truth: good meshes, each closed."""

    mesh: TriangleMesh
    truth: tuple[TriangleMesh, ...]
    closed_form: SDF | None = None


@dataclass(frozen=True)
class Accuracy:
    """Measure wrong signs, and errors of tables.

    Attributes:
        shapes: which; by default all.
        points: near the surface, and as many in the whole box.
        out: file of results.
    """

    shapes: tuple[str, ...] = ()
    points: int = 20_000
    out: Path = RESULTS


@dataclass(frozen=True)
class Show:
    """Print the tables."""

    results: Path = RESULTS


@cache
def drill() -> TriangleMesh:
    """The drill."""
    folder = os.environ.get("RUMI_DATA")
    if not folder:
        raise SystemExit("Expected RUMI_DATA to name the folder with ycb_power_drill")
    return load_mesh(Path(folder) / "ycb_power_drill" / "power_drill.obj")


def random(seed: int = 0) -> torch.Generator:
    """A generator of its own for each use."""
    return torch.Generator().manual_seed(seed)


def _mug() -> Shape:
    mug = Mug().double()
    mesh = meshes.one_surface(mug)
    return Shape(mesh, (mesh,), mug)


def _drill() -> Shape:
    return Shape(drill(), (drill(),))


def _overlap() -> Shape:
    _, handle = meshes.parts_of(mug_mesh(Mug()))
    parts = (meshes.cup_part(Mug()), handle)
    return Shape(meshes.together(*parts), parts)


def _holed() -> Shape:
    good = drill()
    return Shape(damaged(good, share=LOST, hole_m=HOLE_M), (good,))


def _flipped() -> Shape:
    return Shape(meshes.turned(drill(), generator=random()), (drill(),))


def _partly_flipped() -> Shape:
    return Shape(meshes.turned(drill(), 0.3, generator=random()), (drill(),))


def _tetrahedron() -> Shape:
    mesh = meshes.tetrahedron(0.08)
    return Shape(mesh, (mesh,))


def _cube() -> Shape:
    mesh = meshes.box((0.1, 0.1, 0.1))
    return Shape(mesh, (mesh,))


def _slice() -> Shape:
    mesh = meshes.box((0.05, 0.05, 0.002))
    return Shape(mesh, (mesh,))


SHAPES: dict[str, Callable[[], Shape]] = {
    "mug": _mug,
    "drill": _drill,
    "cup + overlapping handle": _overlap,
    "drill, 1 % of faces and 12 mm hole": _holed,
    "drill, every face turned": _flipped,
    "drill, 30 % of faces turned": _partly_flipped,
    "tetrahedron, 80 mm": _tetrahedron,
    "cube, 200 mm, in its slice z = 0": _cube,
    "slice of a cube, 4 mm thick": _slice,
}


class Exact(NamedTuple):
    """libigl's answer at some points: signed distance, and where it is beyond doubt."""

    distance: torch.Tensor
    known: torch.Tensor


def exact(parts: tuple[TriangleMesh, ...], points: torch.Tensor) -> Exact:
    """Signed distance from the union of closed parts.

    Outside it is the least of the distances. Inside it is the depth in the part where that is greatest, provided that
    the nearest point of that part's surface is in no other part; where it is, the truth is not known.
    """
    import igl

    places = np.ascontiguousarray(points.double().numpy())
    signed, feet = [], []
    for part in parts:
        vertices, faces = part.vertices.numpy(), part.faces.numpy()
        squared, _, foot = igl.point_mesh_squared_distance(places, vertices, faces)
        side = np.where(igl.winding_number(vertices, faces, places) > 0.5, -1.0, 1.0)
        signed.append(torch.from_numpy(side * np.sqrt(squared)))
        feet.append(np.ascontiguousarray(foot))
    every = torch.stack(signed)
    least, which = every.min(0)
    known = torch.ones(len(points), dtype=torch.bool)
    for number, foot in enumerate(feet):
        for other, part in enumerate(parts):
            if other != number:
                around = igl.winding_number(part.vertices.numpy(), part.faces.numpy(), foot)
                known &= ~((which == number) & (least < 0) & torch.from_numpy(around > 0.5))
    return Exact(least, known)


def places(parts: tuple[TriangleMesh, ...], count: int, slice_only: bool) -> tuple[torch.Tensor, torch.Tensor]:
    """Points near the surface and points of the whole box, where a table has its nodes."""
    generator = random(1)
    every = torch.cat([part.corners for part in parts])
    on, _ = sample_triangles(Triangles(every), count, generator=generator)
    step = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    reach = NEAR_M * torch.rand(count, 1, generator=generator, dtype=torch.float64)
    near = on + reach * torch.nn.functional.normalize(step, dim=-1)
    corners = every.reshape(-1, 3)
    low, high = corners.amin(0) - PADDING_M, corners.amax(0) + PADDING_M
    far = low + (high - low) * torch.rand(count, 3, generator=generator, dtype=torch.float64)
    if slice_only:
        near[:, 2] = far[:, 2] = 0.0
    return near, far


_ASKED: dict[tuple[int, ...], tuple[torch.Tensor, Exact]] = {}


def asked(parts: tuple[TriangleMesh, ...], count: int, slice_only: bool) -> tuple[torch.Tensor, Exact]:
    """Points about a shape and the truth there, the same for every mesh of it."""
    key = (*map(id, parts), count, slice_only)
    if key not in _ASKED:
        points = torch.cat(places(parts, count, slice_only))
        _ASKED[key] = points, exact(parts, points)
    return _ASKED[key]


def measure(name: str, shape: Shape, count: int) -> dict[str, Any]:
    """Wrong signs and errors of one shape."""
    points, truth = asked(shape.truth, count, "in its slice" in name)
    ours = MeshSDF(shape.mesh)
    found = ours.distance(points)
    wrong = ((found < 0) != (truth.distance < 0)) & (truth.distance.abs() > 1e-9)
    error = (found - truth.distance).abs()[truth.known]
    row: dict[str, Any] = {
        "shape": name,
        "faces": len(shape.mesh.faces),
        "points": len(points),
        "wrong_signs": float(wrong.double().mean()),
        "deepest_wrong_mm": 1e3 * float(truth.distance[wrong].abs().max()) if bool(wrong.any()) else 0.0,
        "exact_p95_mm": 1e3 * float(error.quantile(0.95)),
        "exact_max_mm": 1e3 * float(error.max()),
        "unknown": float((~truth.known).double().mean()),
        "tables": {},
    }
    close = (truth.distance.abs() <= NEAR_M) & truth.known
    if shape.closed_form is not None:
        beyond = (truth.distance - shape.closed_form.distance(points))[truth.distance > 0].abs()
        row["closed_form_p95_mm"] = 1e3 * float(beyond.quantile(0.95))
    for spacing in SPACINGS_MM:
        table = from_mesh(ours, spacing=1e-3 * spacing)
        looked_up = table.distance(points)
        miss = (looked_up - truth.distance).abs()
        flips = (looked_up < 0) != (truth.distance < 0)
        row["tables"][f"{spacing:g}"] = {
            "near_p95_mm": 1e3 * float(miss[close].quantile(0.95)),
            "all_p95_mm": 1e3 * float(miss[truth.known].quantile(0.95)),
            "near_flips": float(flips[close].double().mean()),
            "deepest_flip_mm": 1e3 * float(truth.distance[flips].abs().max()) if bool(flips.any()) else 0.0,
            "nodes": list(table.values.shape),
        }
        say(f"{name}: {spacing:g} mm done")
    return row


def accuracy(options: Accuracy) -> None:
    """Measure shapes and keep the lines."""
    for name in options.shapes or SHAPES:
        if name not in SHAPES:
            raise SystemExit(f"Expected one of {', '.join(SHAPES)}, got {name}")
        keep(options.out, {"kind": "accuracy", **measure(name, SHAPES[name](), options.points)}, "shape")


def keep(path: Path, row: dict[str, Any], key: str) -> None:
    """Write a line in place of older ones of the same kind, name and threads."""
    row = {**row, "machine": environment(torch.device("cpu"))}
    lines = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    same = ("kind", key, "threads")
    lines = [line for line in lines if any(line.get(name) != row.get(name) for name in same)]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(json.dumps(line) + "\n" for line in [*lines, row]))


def show(options: Show) -> None:
    """Both tables as Markdown."""
    lines = [json.loads(line) for line in options.results.read_text().splitlines()]
    out = [
        "| mesh | faces | wrong signs, deepest | distance: p95, max error | table of 1, 2, 3, 5 mm: p95 error | "
        "its sign flips | deepest |",
        "|---|---|---|---|---|---|---|",
    ]
    order = list(SHAPES)
    measured = [line for line in lines if line["kind"] == "accuracy"]
    for row in sorted(measured, key=lambda line: order.index(line["shape"])):
        tables = [row["tables"][f"{spacing:g}"] for spacing in SPACINGS_MM]
        out.append(
            f"| {row['shape']} | {row['faces']} | {100 * row['wrong_signs']:.2g} %, {row['deepest_wrong_mm']:.2g} mm | "
            f"{row['exact_p95_mm']:.0e}, {row['exact_max_mm']:.1g} mm | {_several(tables, 'near_p95_mm')} mm | "
            f"{_several(tables, 'near_flips', 100.0)} % | {_several(tables, 'deepest_flip_mm')} mm |"
        )
    out += ["", "| what | threads | seconds | of the processors | memory |", "|---|---|---|---|---|"]
    for row in lines:
        if row["kind"] == "time":
            memory = f"{row['peak_gib']:.2f} GiB at most" if "peak_gib" in row else ""
            out.append(
                f"| {row['what']} | {row['threads']} | {row['seconds']:.3g} | {row['processor_seconds']:.3g} | "
                f"{memory} |"
            )
    sys.stdout.write("\n".join(out) + "\n")


def _several(tables: list[dict[str, Any]], name: str, unit: float = 1.0) -> str:
    numbers = [unit * table[name] for table in tables]
    return ", ".join("0" if number < 1e-3 else f"{number:.2g}" for number in numbers)


def say(text: str) -> None:
    """Tell how far it is."""
    sys.stderr.write(text + "\n")
    sys.stderr.flush()


def main() -> None:
    """Measure or show."""
    chosen = tyro.extras.subcommand_cli_from_dict({"accuracy": Accuracy, "show": Show})
    {Accuracy: accuracy, Show: show}[type(chosen)](chosen)


if __name__ == "__main__":
    script(main)
