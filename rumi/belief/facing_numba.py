"""Building blocks of compiled replays: points that a camera saw; `trajectory_likelihood.facing_distance` has it."""

import math

import numpy as np

from rumi.belief.trajectory_likelihood import FACING
from sdf.compiled import bare
from sdf.grid_numba import between, fast
from sdf.grid_numba import value as distance_at
from sdf.intrinsics_numba import at, put


@bare
def toward_camera(x, y, cos, sin, eye, step):
    """A step from the object towards the camera, in the object's frame."""
    dx, dy, dz = eye[0] - x, eye[1] - y, eye[2]
    size = step / max(math.sqrt(dx * dx + dy * dy + dz * dz), 1e-12)
    return np.float32(size * (cos * dx + sin * dy)), np.float32(size * (cos * dy - sin * dx)), np.float32(size * dz)


@fast
def _begun(first, last, pose, toward, points, near, ahead, flat, lattice):
    """Find the distances of seen points from the surface, and what they are a step nearer to the camera."""
    x, y, cos, sin = pose
    step_x, step_y, step_z = toward
    count = len(points) // 3
    for m in range(first, last):
        dx, dy, z = at(points, m) - x, at(points, count + m) - y, at(points, 2 * count + m)
        place_x, place_y = cos * dx + sin * dy, cos * dy - sin * dx
        put(near, m - first, distance_at(place_x, place_y, z, flat, lattice))
        put(ahead, m - first, distance_at(place_x + step_x, place_y + step_y, z + step_z, flat, lattice))


@fast
def _ahead(first, some, turn, pose, toward, points, ahead, flat, lattice):
    """Find the distances of some of them so many steps nearer to the camera."""
    x, y, cos, sin = pose
    step_x, step_y, step_z = toward
    count, way = len(points) // 3, np.float32(turn)
    for k in range(len(some)):
        m = first + at(some, k)
        dx, dy, z = at(points, m) - x, at(points, count + m) - y, at(points, 2 * count + m)
        place_x, place_y = cos * dx + sin * dy, cos * dy - sin * dx
        put(ahead, k, distance_at(place_x + way * step_x, place_y + way * step_y, z + way * step_z, flat, lattice))


@fast
def _priced(first, near, worn, weight, row, logs, inverse):
    """Log-likelihood of points by their distances."""
    priced, nodes = logs.reshape(-1), logs.shape[1]
    half, top = np.float32(0.5 * (nodes - 1)) + worn * inverse, np.float32(nodes - 1.01)
    total = np.float32(0.0)
    for k in range(len(near)):
        m = first + k
        total += at(weight, m) * between(near[k] * inverse + half, top, priced, at(row, m))
    return total


@bare
def told_by_view(first, last, pose, worn, toward, step, points, weight, row, logs, inverse, flat, lattice, room):
    """Log-likelihood of seen points from one to before another, of their distances from the side that faces the camera.

    Only those that come nearer to the surface by a step are followed by the next one.
    """
    near, ahead, going = room
    _begun(first, last, pose, toward, points, near, ahead, flat, lattice)
    many = 0
    for k in range(last - first):
        going[many] = k
        many += 1 if ahead[k] < near[k] else 0
    for k in range(many):
        near[going[k]] = ahead[going[k]]
    for turn in range(2, FACING + 2):
        if turn <= FACING:
            _ahead(first, going[:many], turn, pose, toward, points, ahead, flat, lattice)
        kept, gone = 0, np.float32(turn - 1) * step
        for k in range(many):
            place = going[k]
            if turn <= FACING and ahead[k] < near[place]:
                near[place] = ahead[k]
                going[kept] = place
                kept += 1
            else:
                near[place] -= gone
        many = kept
    return _priced(first, near[: last - first], worn, weight, row, logs, inverse)
