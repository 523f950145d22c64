"""Outlines from above: of the object at a pose, and of the tool."""

from functools import lru_cache
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rumi.runs.scene_geometry import OutlineMap, SceneGeometry
from sdf import se3


@lru_cache(maxsize=32)
def contours(outline: OutlineMap) -> list[np.ndarray]:
    """Closed lines (M, 2) of an outline, in its own frame."""
    values = outline.values.cpu().double().numpy()
    x, y = (float(outline.origin[axis]) + outline.spacing * np.arange(values.shape[axis]) for axis in (0, 1))
    return zero_lines(x, y, values)


def zero_lines(x: np.ndarray, y: np.ndarray, values: np.ndarray) -> list[np.ndarray]:
    """Lines (M, 2) along which values (X, Y) on a grid are zero."""
    from contourpy import contour_generator

    lines: list[np.ndarray] = contour_generator(x, y, values.T).lines(0.0)
    return lines


def object_outline(geometry: SceneGeometry, world_T_object: Float[Tensor, "4 4"]) -> list[np.ndarray]:
    """Lines (M, 2), world x and y: the object from above.

    Of an upright object the exact silhouette; of a tipped one the hull of its surface points.
    """
    if not upright(world_T_object):
        return [hull(_apply(world_T_object, geometry.surface_points))]
    return placed(geometry.silhouette, world_T_object)


def object_section(geometry: SceneGeometry, world_T_object: Float[Tensor, "4 4"]) -> list[np.ndarray]:
    """Lines (M, 2), world x and y: an upright object cut at the workspace's height; none of a tipped one."""
    return placed(geometry.section, world_T_object) if upright(world_T_object) else []


def placed(outline: OutlineMap, world_T_frame: Float[Tensor, "4 4"]) -> list[np.ndarray]:
    """Lines (M, 2), world x and y, of an outline whose frame stands level at a pose."""
    pose = world_T_frame.cpu().double().numpy()
    return [line @ pose[:2, :2].T + pose[:2, 3] for line in contours(outline)]


def upright(pose: Float[Tensor, "4 4"]) -> bool:
    """Whether the object's z axis is the world's, but for some degrees."""
    return float(pose[2, 2]) > 0.995


def _apply(pose: Float[Tensor, "4 4"], points: Float[Tensor, "S 3"]) -> np.ndarray:
    moved: np.ndarray = se3.apply(pose.cpu().double(), points.cpu().double())[:, :2].numpy()
    return moved


def hull(points: np.ndarray) -> np.ndarray:
    """Closed convex hull (M, 2) of points (N, 2), counter-clockwise."""
    ordered = np.unique(points, axis=0)
    if len(ordered) < 3:
        return np.concatenate((ordered, ordered[:1]))

    def half(rows: np.ndarray) -> list[Any]:
        kept: list[Any] = []
        for row in rows:
            while len(kept) > 1 and _turn(kept[-2], kept[-1], row) <= 0:
                kept.pop()
            kept.append(row)
        return kept[:-1]

    return np.array([*half(ordered), *half(ordered[::-1]), ordered[0]])


def _turn(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> float:
    return float((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))


def bounding_box(lines: list[np.ndarray], margin: float) -> tuple[float, float, float, float]:
    """Left, right, bottom and top of some lines, with a margin."""
    points = np.concatenate(lines)
    (left, bottom), (right, top) = points.min(0) - margin, points.max(0) + margin
    return float(left), float(right), float(bottom), float(top)


def heaviest(log_weights: Float[Tensor, "P"], count: int) -> Tensor:
    """Indices of the heaviest particles, lightest of them first, so that the heaviest is drawn on top."""
    return torch.topk(log_weights, min(count, len(log_weights))).indices.flip(0)
