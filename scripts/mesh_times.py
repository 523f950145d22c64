"""Time tables of meshes, and the exact shape beside libigl.

    python -m scripts.mesh_times --threads 2                 # all of it: minutes
    python -m scripts.mesh_times --what table --threads 2    # the drill's table of 128^3 nodes, and from the cache

Needs the environment variable RUMI_DATA for the drill, and libigl to compare with. A line of a timing replaces an older
one with as many threads in scripts/results/mesh_distances.jsonl; mesh_distances.py shows them.
"""

import os
import resource
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
import tyro

from rumi.cli import script
from scripts.bench import meshes
from scripts.experiment import RESULTS
from scripts.mesh_distances import PADDING_M
from scripts.store import Store
from sdf.mesh.build import from_mesh
from sdf.mesh.mesh import load_mesh
from sdf.mesh.mesh_sdf import MeshSDF
from sdf.primitives import Mug


@dataclass(frozen=True)
class Time:
    """Measure times and memory.

    Attributes:
        what: "table" (the drill's, and from the cache), "peers" (48^3 nodes, and libigl's time), "large" (many faces).
        threads: of torch and of compiled loops; libigl takes IGL_NUM_THREADS.
        faces: of the largest mesh, roughly.
        results: file of the results.
    """

    what: tuple[Literal["table", "peers", "large"], ...] = ("table", "peers", "large")
    threads: int = 2
    faces: int = 1_000_000
    results: Path = RESULTS / "mesh_distances.jsonl"


def timings(options: Time) -> None:
    """Time tables and keep the lines."""
    torch.set_num_threads(options.threads)
    path = Path(os.environ["RUMI_DATA"]) / "ycb_power_drill" / "power_drill.obj"
    from_mesh(meshes.box((0.02, 0.02, 0.02)), spacing=0.004)  # compiles
    works = {"table": _time_table, "peers": _time_peers, "large": lambda file: _time_large(file, options.faces)}
    for what in options.what:
        for row in works[what](path):
            said = f"{row['what']}: {row['seconds']:.3g} s ({row['processor_seconds']:.3g} s of the processors)\n"
            sys.stderr.write(said)
            Store(options.results).add({"kind": "time", "threads": options.threads, "what": row.pop("what")}, row)


def _timed(name: str, work: Callable[[], Any], repeats: int = 1) -> dict[str, Any]:
    """The least of a few times, seconds."""
    found = []
    for _ in range(repeats):
        wall, processor = time.perf_counter(), time.process_time()
        work()
        found.append((time.perf_counter() - wall, time.process_time() - processor))
    wall, processor = min(found)
    return {"what": name, "seconds": wall, "processor_seconds": processor}


def _time_table(path: Path) -> Iterator[dict[str, Any]]:
    """The drill's table of 128^3 nodes, from its file and from the cache."""
    spacing = 0.00195
    nodes = from_mesh(path, spacing=spacing).values.numel()
    yield {**_timed("drill, 128^3 nodes", lambda: from_mesh(path, spacing=spacing), 3), "nodes": nodes / 128**3}
    with tempfile.TemporaryDirectory() as cache:
        from_mesh(path, spacing=spacing, cache_dir=cache)
        yield _timed("the same from the cache", lambda: from_mesh(path, spacing=spacing, cache_dir=cache), 5)


def _time_peers(path: Path) -> Iterator[dict[str, Any]]:
    """Distance and sign at 48^3 nodes, ours and libigl's."""
    import igl

    for name, mesh in (("drill", load_mesh(path)), ("cup of long faces", meshes.cup_part(Mug()))):
        low, high = mesh.bounds[0] - PADDING_M, mesh.bounds[1] + PADDING_M
        axes = [torch.linspace(a, b, 48, dtype=torch.float64) for a, b in zip(low.tolist(), high.tolist(), strict=True)]
        nodes = torch.cartesian_prod(*axes)
        parts, grid = (mesh.vertices.numpy(), mesh.faces.numpy()), nodes.numpy()
        shape = MeshSDF(mesh)
        shape.distance(nodes[:10])
        yield _timed(f"{name}, 48^3 nodes: distance and sign", lambda s=shape, n=nodes: s.distance(n), 3)
        yield _timed(
            f"{name}, 48^3 nodes: libigl's distance",
            lambda p=parts, g=grid: igl.point_mesh_squared_distance(g, *p),
            3,
        )
        yield _timed(
            f"{name}, 48^3 nodes: libigl's winding number", lambda p=parts, g=grid: igl.fast_winding_number(*p, g)
        )


def _time_large(path: Path, least: int) -> Iterator[dict[str, Any]]:
    """The drill's table from very many faces; with the most memory that this process took."""
    import trimesh

    mesh = load_mesh(path)
    vertices, faces = mesh.vertices, mesh.faces
    while len(faces) < least:
        vertices, faces = _quartered(vertices, faces)
    told: list[str] = []
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "large.ply"
        trimesh.Trimesh(vertices.numpy(), faces.numpy(), process=False).export(file)
        row = _timed(
            f"drill of {len(faces)} faces, a node every 2 mm",
            lambda: from_mesh(file, spacing=0.002, progress=lambda what, share: told.append(f"{what} {share:.0%}")),
        )
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    yield {**row, "peak_gib": peak, "told": told}


def _quartered(vertices: torch.Tensor, faces: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Each face as four."""
    edges = torch.stack((faces, faces.roll(-1, 1)), -1).reshape(-1, 2).sort(-1).values
    ends, number = edges.unique(dim=0, return_inverse=True)
    middle = number.reshape(-1, 3) + len(vertices)
    a, b, c = faces.unbind(-1)
    ab, bc, ca = middle.unbind(-1)
    parts = ((a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca))
    return torch.cat((vertices, vertices[ends].mean(1))), torch.cat([torch.stack(part, -1) for part in parts])


if __name__ == "__main__":
    script(lambda: timings(tyro.cli(Time, description=__doc__)))
