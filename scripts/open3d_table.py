"""What Open3D makes of a cloud without order, beside this project's own way, on scenes in closed form.

    OMP_NUM_THREADS=1 python -m scripts.open3d_table run     # a line a cell in scripts/results/open3d.jsonl, once
    python -m scripts.open3d_table show                      # Markdown

Both find what stands on the plane that most points show, by more than 10 mm, and keep its largest cluster: here in the
image that the cloud is drawn into, with its edges left out; there by `segment_plane` (RANSAC, 6 mm, 1000 triples) and
`cluster_dbscan` (10 mm, 10 points), with and without `remove_statistical_outlier` (20 neighbours, 2 deviations). One
point in a hundred is lost, and half of those at edges lie between the two surfaces. Open3D has no free points.
"""

import statistics
import time
from collections.abc import Callable, Mapping
from functools import cache

import numpy as np
import torch

from rumi.cli import script
from scripts.bench.known_scenes import SCENES, SceneView, scene_view, with_noise
from scripts.experiment import Experiment, Line, newest
from scripts.reproduce.cells import table
from scripts.reproduce.code import code_of
from sdf import se3
from sensors.semantics import Semantics
from sensors.vision.camera import pixel_points
from sensors.vision.cloud import cloud_observation
from sensors.vision.view import ViewSettings

FAR_M, CLEARANCE_M, TOLERANCE_M, GAP_M = 0.006, 0.010, 0.006, 0.010
NOISES_MM = (0.0, 1.0, 2.0, 4.0)
SEEDS = range(1000, 1005)
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


view_of = cache(scene_view)


def measure(scene: str, noise_mm: float, way: str) -> dict[str, float]:
    """Medians over the seeds."""
    found = [figures(WAYS[way], view_of(scene), 1e-3 * noise_mm, seed) for seed in SEEDS]
    return {key: round(statistics.median(x[key] for x in found), 4) for key in found[0]}


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


def show(lines: list[Line], chosen: Mapping[str, tuple[object, ...]]) -> str:
    """Three figures a cell, one a scene, by the newest code."""
    lines = newest(lines)
    columns = (("found", 0), ("mean_mm", 2), ("p95_mm", 2), ("far", 2), ("ms", 0))
    rows = []
    for noise in NOISES_MM:
        for way in WAYS:
            own = [x for x in lines if (x["way"], x["noise_mm"]) == (way, noise)]
            cells = [", ".join(f"{x[name]:.{digits}f}" for x in own) for name, digits in columns]
            rows.append([way, f"{noise:g}", *cells])
    heads = ("way", "noise (mm)", "found (%)", "mean off (mm)", "95 % within (mm)", "beyond 6 mm (%)", "ms")
    return table(heads, rows)


EXPERIMENT = Experiment(
    __doc__,
    "open3d.jsonl",
    {"scene": SCENES, "noise_mm": NOISES_MM, "way": tuple(WAYS)},
    measure,
    show,
    identity=lambda variant: {"code": code_of("open3d")},
)

if __name__ == "__main__":
    script(EXPERIMENT.main)
