"""Data association of contacts by a tree, compiled for the CPU; `touched.py` has the definition."""

import numpy as np

from sdf.compiled import Kernel, bare
from sdf.mesh.tree_numba import closest, next_leaf, to_box
from sdf.part_numba import indices

_BLOCK = 64
# of a path from the root with the sibling of each node on it: enough for 2^60 leaves
_STACK = 64


@bare
def _chord(nx, ny, nz, facing, face):
    """Squared length between two normals."""
    return (nx - facing[face, 0]) ** 2 + (ny - facing[face, 1]) ** 2 + (nz - facing[face, 2]) ** 2


@bare
def search(px, py, pz, nx, ny, nz, square, corners, owner, boxes, facing, start, stack, gaps, found, trial):
    """The best piece, given one to begin with; `found` gets the point on it.

    What a triangle costs is at least its squared distance, so that boxes further than the best cost are passed by.
    """
    size = len(corners) // (len(boxes) // 2)
    best = closest(px, py, pz, corners, start, np.inf, found)
    if square > 0.0:
        best += square * _chord(nx, ny, nz, facing, owner[start])
    piece = start
    stack[0], gaps[0] = 1, to_box(px, py, pz, boxes, 1)
    leaf, top = next_leaf(px, py, pz, boxes, best, stack, gaps, 1)
    while leaf >= 0:
        for at in range(leaf * size, (leaf + 1) * size):
            extra = square * _chord(nx, ny, nz, facing, owner[at]) if square > 0.0 else 0.0
            if extra >= best:
                continue
            left = best - extra
            gap = closest(px, py, pz, corners, at, left, trial)
            if gap < left:
                best, piece = extra + gap, at
                found[0], found[1], found[2] = trial[0], trial[1], trial[2]
        leaf, top = next_leaf(px, py, pz, boxes, best, stack, gaps, top)
    return piece


def _touched(points, normals, corners, owner, boxes, facing, reach, face, found, part):
    """Blocks of points, each begun with what the point before it had."""
    count = len(points)
    for block in indices(part, (count + _BLOCK - 1) // _BLOCK):
        stack, gaps, trial = np.empty(_STACK, np.int64), np.empty(_STACK), np.empty(3)
        piece = 0
        for i in range(block * _BLOCK, min((block + 1) * _BLOCK, count)):
            x, y, z = points[i, 0], points[i, 1], points[i, 2]
            piece = search(
                x, y, z, normals[i, 0], normals[i, 1], normals[i, 2], reach * reach,
                corners, owner, boxes, facing, piece, stack, gaps, found[i], trial,
            )  # fmt: skip
            face[i] = owner[piece]


touched_kernel = Kernel(_touched)
