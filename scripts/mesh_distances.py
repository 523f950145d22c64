"""Measure signed distances of meshes against libigl's exact ones.

    python -m scripts.mesh_distances run               # one JSON line a shape in scripts/results/mesh_distances.jsonl
    python -m scripts.mesh_distances show              # Markdown, with what scripts.mesh_times has timed

Needs libigl, and the environment variable RUMI_DATA for the drill. The newest line of a shape counts.
"""

import os
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from rumi.cli import script
from scripts.bench import meshes
from scripts.bench.mug_mesh import damaged, mug_mesh
from scripts.experiment import Experiment, Line
from scripts.reproduce.cells import table
from scripts.reproduce.code import code_of
from sdf.base import SDF
from sdf.mesh.build import from_mesh
from sdf.mesh.mesh import TriangleMesh, load_mesh
from sdf.mesh.mesh_sdf import MeshSDF
from sdf.mesh.triangles import Triangles
from sdf.primitives import Mug
from sdf.surface import sample_triangles

POINTS = 20_000
"""Near the surface, and as many in the whole box."""

SPACINGS_MM = (1.0, 2.0, 3.0, 5.0)
NEAR_M, PADDING_M, HOLE_M, LOST = 0.003, 0.02, 0.012, 0.01


class Shape(NamedTuple):
    """A mesh to measure, and the parts whose union is the truth: good meshes, each closed."""

    mesh: TriangleMesh
    truth: tuple[TriangleMesh, ...]
    closed_form: SDF | None = None


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


def measure(shape: str, count: int = POINTS) -> dict[str, Any]:
    """Wrong signs and errors of one shape."""
    made = SHAPES[shape]()
    points, truth = asked(made.truth, count, "in its slice" in shape)
    ours = MeshSDF(made.mesh)
    found = ours.distance(points)
    wrong = ((found < 0) != (truth.distance < 0)) & (truth.distance.abs() > 1e-9)
    error = (found - truth.distance).abs()[truth.known]
    row: dict[str, Any] = {
        "faces": len(made.mesh.faces),
        "points": len(points),
        "wrong_signs": float(wrong.double().mean()),
        "deepest_wrong_mm": 1e3 * float(truth.distance[wrong].abs().max()) if bool(wrong.any()) else 0.0,
        "exact_p95_mm": 1e3 * float(error.quantile(0.95)),
        "exact_max_mm": 1e3 * float(error.max()),
        "unknown": float((~truth.known).double().mean()),
        "tables": {},
    }
    close = (truth.distance.abs() <= NEAR_M) & truth.known
    if made.closed_form is not None:
        beyond = (truth.distance - made.closed_form.distance(points))[truth.distance > 0].abs()
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
    return row


def show(lines: list[Line], chosen: Mapping[str, tuple[str, ...]]) -> str:
    """Errors by shape, and times; of the same twice the newest."""
    measured = {line["shape"]: line for line in lines if line["kind"] == "accuracy"}
    rows = []
    for name in (name for name in SHAPES if name in measured):
        row = measured[name]
        spaced = [row["tables"][f"{spacing:g}"] for spacing in SPACINGS_MM]
        rows.append(
            [
                name,
                str(row["faces"]),
                f"{100 * row['wrong_signs']:.2g} %, {row['deepest_wrong_mm']:.2g} mm",
                f"{row['exact_p95_mm']:.0e}, {row['exact_max_mm']:.1g} mm",
                f"{_several(spaced, 'near_p95_mm')} mm",
                f"{_several(spaced, 'near_flips', 100.0)} %",
                f"{_several(spaced, 'deepest_flip_mm')} mm",
            ]
        )
    heads = ("mesh", "faces", "wrong signs, deepest", "distance: p95, max error", "table of 1, 2, 3, 5 mm: p95 error")
    timed = {(line["what"], line["threads"]): line for line in lines if line["kind"] == "time"}
    times = [
        [
            what,
            str(threads),
            f"{row['seconds']:.3g}",
            f"{row['processor_seconds']:.3g}",
            f"{row['peak_gib']:.2f} GiB at most" if "peak_gib" in row else "",
        ]
        for (what, threads), row in timed.items()
    ]
    spent = table(("what", "threads", "seconds", "of the processors", "memory"), times)
    return f"{table((*heads, 'its sign flips', 'deepest'), rows)}\n{spent}"


def _several(tables: list[dict[str, Any]], name: str, unit: float = 1.0) -> str:
    numbers = [unit * table[name] for table in tables]
    return ", ".join("0" if number < 1e-3 else f"{number:.2g}" for number in numbers)


EXPERIMENT = Experiment(
    __doc__,
    "mesh_distances.jsonl",
    {"shape": tuple(SHAPES)},
    measure,
    show,
    identity=lambda variant: {"kind": "accuracy", "code": code_of("mesh")},
)

if __name__ == "__main__":
    script(EXPERIMENT.main)
