"""What Open3D makes of a cloud without order, beside this project's own way, on scenes in closed form.

    OMP_NUM_THREADS=1 python scripts/open3d_table.py run     # a line a cell in scripts/results/open3d.jsonl, once
    python scripts/open3d_table.py show                      # Markdown

Both find what stands on the plane that most points show, by more than 10 mm, and keep its largest cluster: here in the
image that the cloud is drawn into, with its edges left out; there by `segment_plane` (RANSAC, 6 mm, 1000 triples) and
`cluster_dbscan` (10 mm, 10 points), with and without `remove_statistical_outlier` (20 neighbours, 2 deviations). One
point in a hundred is lost, and half of those at edges lie between the two surfaces. Open3D has no free points.
"""

import hashlib
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro

from rumi.runs.jsonlines import append_line, read_lines
from scripts.bench.known_scenes import SCENES, SceneView, scene_view, with_noise
from sdf import se3
from sensors.semantics import Semantics
from sensors.vision.camera import pixel_points
from sensors.vision.cloud import cloud_observation
from sensors.vision.view import ViewSettings

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "scripts" / "results" / "open3d.jsonl"
FAR_M, CLEARANCE_M, TOLERANCE_M, GAP_M = 0.006, 0.010, 0.006, 0.010
NOISES_MM = (0.0, 1.0, 2.0, 4.0)
SEEDS = range(1000, 1005)
CODE = [
    Path(__file__),
    *(ROOT / "sensors" / f"{name}.py" for name in ("cloud", "depth_filters", "segmentation", "view")),
    ROOT / "rumi" / "bench" / "known_scenes.py",
]
Way = Callable[[torch.Tensor, SceneView, int], torch.Tensor]


def ours(points: torch.Tensor, scene: SceneView, seed: int) -> torch.Tensor:
    """World points of the object, by this project; no free points, since the other way has none."""
    random = torch.Generator().manual_seed(seed)
    seen = cloud_observation(points, scene.world_T_camera, ViewSettings("plane"), generator=random).observation
    return seen.points[seen.of_class(Semantics.SURFACE)]


def theirs(points: torch.Tensor, scene: SceneView, seed: int, *, clean: bool) -> torch.Tensor:
    """The same by Open3D."""
    import open3d as o3d

    o3d.utility.random.seed(seed)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points.double().numpy()))
    (a, b, c, d), _ = cloud.segment_plane(TOLERANCE_M, 3, 1000)
    normal = np.array([a, b, c])
    height = np.asarray(cloud.points) @ normal + d
    height *= np.sign(d) / np.linalg.norm(normal)  # the camera, at the origin, is above the plane
    cloud = cloud.select_by_index(np.flatnonzero(height > CLEARANCE_M))
    if clean:
        cloud, _ = cloud.remove_statistical_outlier(20, 2.0)
    label = np.asarray(cloud.cluster_dbscan(GAP_M, 10))
    sizes = np.bincount(label[label >= 0], minlength=1)
    own = np.asarray(cloud.points)[label == sizes.argmax()]
    return se3.apply(scene.world_T_camera, torch.from_numpy(own).to(points))


WAYS: dict[str, Way] = {
    "here": ours,
    "Open3D": lambda *given: theirs(*given, clean=False),
    "Open3D, outliers removed": lambda *given: theirs(*given, clean=True),
}


@dataclass(frozen=True)
class Run:
    """Measure the cells that are missing.

    Attributes:
        out: where the lines go.
    """

    out: Path = RESULTS


@dataclass(frozen=True)
class Show:
    """Print the table.

    Attributes:
        out: where the lines are.
    """

    out: Path = RESULTS


def run(options: Run) -> None:
    """Measure, a line a cell."""
    code = fingerprint()
    done = {(x["way"], x["scene"], x["noise_mm"]) for x, _ in read_lines(options.out) if x.get("code") == code}
    for name in SCENES:
        scene = scene_view(name)
        for noise in NOISES_MM:
            for way, call in WAYS.items():
                if (way, name, noise) in done:
                    continue
                found = [figures(call, scene, 1e-3 * noise, seed) for seed in SEEDS]
                line = {key: round(statistics.median(x[key] for x in found), 4) for key in found[0]}
                append_line(options.out, {"code": code, "way": way, "scene": name, "noise_mm": noise, **line})


def figures(call: Way, scene: SceneView, noise_m: float, seed: int) -> dict[str, float]:
    """How far the points of one cloud are off, how many of the object's are found, and how long it takes."""
    random = torch.Generator().manual_seed(seed)
    depth = with_noise(scene.depth, noise_m, lost=0.01, mixed=True, generator=random).float()
    there = (depth > 0) & torch.isfinite(depth)
    points = pixel_points(depth, there, scene.intrinsics)
    points = points[torch.randperm(len(points), generator=random)]
    began = time.process_time()
    found = call(points, scene, seed)
    seconds = time.process_time() - began
    off = scene.distance(found).abs()
    return {
        "points": float(len(found)),
        "found": 100.0 * len(found) / int((there & scene.mask).sum()),
        "mean_mm": 1e3 * float(off.mean()),
        "p95_mm": 1e3 * float(off.quantile(0.95)),
        "far": 100.0 * float((off > FAR_M).double().mean()),
        "ms": 1e3 * seconds,
    }


def show(options: Show) -> None:
    """Markdown: three figures a cell, one a scene."""
    code = fingerprint()
    lines = [x for x, _ in read_lines(options.out) if x.get("code") == code]
    heads = (
        "way",
        "noise (mm)",
        "found (%)",
        "mean off (mm)",
        "95 % within (mm)",
        "beyond 6 mm (%)",
        "ms",
    )
    text = ["| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    for noise in NOISES_MM:
        for way in WAYS:
            cells: list[dict[str, Any]] = [x for x in lines if (x["way"], x["noise_mm"]) == (way, noise)]
            columns = (("found", 0), ("mean_mm", 2), ("p95_mm", 2), ("far", 2), ("ms", 0))
            told = [", ".join(f"{x[name]:.{digits}f}" for x in cells) for name, digits in columns]
            text.append(f"| {way} | {noise:g} | " + " | ".join(told) + " |")
    sys.stdout.write("\n".join(text) + "\n")


def fingerprint() -> str:
    """Of the code that the figures depend on."""
    digest = hashlib.sha256()
    for path in CODE:
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


if __name__ == "__main__":
    kinds = {"run": Run, "show": Show}
    options = tyro.extras.subcommand_cli_from_dict(kinds, description=__doc__)
    {Run: run, Show: show}[type(options)](options)
