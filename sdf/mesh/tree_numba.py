"""The nearest of many triangles and the winding number, by a tree, compiled for the CPU."""

import math

import numpy as np

from sdf.compiled import Kernel, bare
from sdf.part_numba import indices

_BLOCK = 256
# of a path from the root with the sibling of each node on it: enough for 2^60 leaves
_STACK = 64


@bare
def closest(px, py, pz, corners, at, best, found):
    """The least of `best` and the squared distance to one triangle; `found` gets the point on it if that is less.

    By the regions of the triangle's plane; Ericson, Real-Time Collision Detection (2005), section 5.1.5.
    """
    ax, ay, az = corners[at, 0], corners[at, 1], corners[at, 2]
    abx, aby, abz = corners[at, 3] - ax, corners[at, 4] - ay, corners[at, 5] - az
    acx, acy, acz = corners[at, 6] - ax, corners[at, 7] - ay, corners[at, 8] - az
    apx, apy, apz = px - ax, py - ay, pz - az
    d1 = abx * apx + aby * apy + abz * apz
    d2 = acx * apx + acy * apy + acz * apz
    bb = abx * abx + aby * aby + abz * abz
    bc = abx * acx + aby * acy + abz * acz
    cc = acx * acx + acy * acy + acz * acz
    # the same for the other corners, from these products
    d3, d4 = d1 - bb, d2 - bc
    d5, d6 = d1 - bc, d2 - cc
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    if d1 <= 0.0 and d2 <= 0.0:
        v, w = 0.0, 0.0
    elif d3 >= 0.0 and d4 <= d3:
        v, w = 1.0, 0.0
    elif vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        v, w = (d1 / (d1 - d3) if d1 > d3 else 0.0), 0.0
    elif d6 >= 0.0 and d5 <= d6:
        v, w = 0.0, 1.0
    elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        v, w = 0.0, (d2 / (d2 - d6) if d2 > d6 else 0.0)
    elif va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        rise = (d4 - d3) + (d5 - d6)
        w = (d4 - d3) / rise if rise > 0.0 else 0.0
        v = 1.0 - w
    else:
        total = va + vb + vc
        v, w = (vb / total, vc / total) if total > 0.0 else (0.0, 0.0)
    fx, fy, fz = ax + v * abx + w * acx, ay + v * aby + w * acy, az + v * abz + w * acz
    gap = (px - fx) ** 2 + (py - fy) ** 2 + (pz - fz) ** 2
    if gap < best:
        found[0], found[1], found[2] = fx, fy, fz
        return gap
    return best


@bare
def to_box(px, py, pz, boxes, node):
    """Squared distance to a node's box, 0 within."""
    x = max(boxes[node, 0] - px, px - boxes[node, 3], 0.0)
    y = max(boxes[node, 1] - py, py - boxes[node, 4], 0.0)
    z = max(boxes[node, 2] - pz, pz - boxes[node, 5], 0.0)
    return x * x + y * y + z * z


@bare
def next_leaf(px, py, pz, boxes, best, stack, gaps, top):
    """The next leaf that is nearer than the best, and how many nodes are left waiting; -1 where there is none.

    `stack` and `gaps` hold the nodes that wait and their squared distances.
    """
    first_leaf = len(boxes) // 2
    while top > 0:
        top -= 1
        node = stack[top]
        if gaps[top] >= best:
            continue
        # down to a leaf by the nearer child; the other waits
        while node < first_leaf:
            node *= 2
            near, far = to_box(px, py, pz, boxes, node), to_box(px, py, pz, boxes, node + 1)
            if far < near:
                near, far = far, near
                other, node = node, node + 1
            else:
                other = node + 1
            if far < best:
                stack[top], gaps[top] = other, far
                top += 1
            if near >= best:
                node = 0
                break
        if node > 0:
            return node - first_leaf, top
    return -1, 0


@bare
def _search(px, py, pz, corners, boxes, start, stack, gaps, found):
    """The nearest piece, given one to begin with."""
    size = len(corners) // (len(boxes) // 2)
    best = closest(px, py, pz, corners, start, np.inf, found)
    piece = start
    stack[0], gaps[0] = 1, to_box(px, py, pz, boxes, 1)
    leaf, top = next_leaf(px, py, pz, boxes, best, stack, gaps, 1)
    while leaf >= 0:
        for at in range(leaf * size, (leaf + 1) * size):
            gap = closest(px, py, pz, corners, at, best, found)
            if gap < best:
                best, piece = gap, at
        leaf, top = next_leaf(px, py, pz, boxes, best, stack, gaps, top)
    return piece


def _nearest(points, corners, owner, boxes, face, found, part):
    """Blocks of points, each begun with what is nearest to the point before it."""
    count = len(points)
    for block in indices(part, (count + _BLOCK - 1) // _BLOCK):
        stack, gaps = np.empty(_STACK, np.int64), np.empty(_STACK)
        piece = 0
        for i in range(block * _BLOCK, min((block + 1) * _BLOCK, count)):
            piece = _search(points[i, 0], points[i, 1], points[i, 2], corners, boxes, piece, stack, gaps, found[i])
            face[i] = owner[piece]


@bare
def _solid_angle(px, py, pz, corners, at):
    """Half the solid angle of a triangle."""
    ax, ay, az = corners[at, 0] - px, corners[at, 1] - py, corners[at, 2] - pz
    bx, by, bz = corners[at, 3] - px, corners[at, 4] - py, corners[at, 5] - pz
    cx, cy, cz = corners[at, 6] - px, corners[at, 7] - py, corners[at, 8] - pz
    la = math.sqrt(ax * ax + ay * ay + az * az)
    lb = math.sqrt(bx * bx + by * by + bz * bz)
    lc = math.sqrt(cx * cx + cy * cy + cz * cz)
    volume = ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx)
    base = (
        la * lb * lc
        + (ax * bx + ay * by + az * bz) * lc
        + (ax * cx + ay * cy + az * cz) * lb
        + (bx * cx + by * cy + bz * cz) * la
    )
    return math.atan2(volume, base)


@bare
def _winding_at(px, py, pz, corners, dipoles, square, stack):
    first_leaf = len(dipoles) // 2
    size = len(corners) // first_leaf
    angle, flux = 0.0, 0.0
    top = 1
    stack[0] = 1
    while top > 0:
        top -= 1
        node = stack[top]
        x, y, z = dipoles[node, 0] - px, dipoles[node, 1] - py, dipoles[node, 2] - pz
        away = x * x + y * y + z * z
        if away > square * dipoles[node, 6] ** 2:
            flux += (x * dipoles[node, 3] + y * dipoles[node, 4] + z * dipoles[node, 5]) / (away * math.sqrt(away))
        elif node < first_leaf:
            stack[top], stack[top + 1] = 2 * node, 2 * node + 1
            top += 2
        else:
            leaf = node - first_leaf
            for at in range(leaf * size, (leaf + 1) * size):
                angle += _solid_angle(px, py, pz, corners, at)
    return (2.0 * angle + flux) / (4.0 * math.pi)


def _winding(points, corners, dipoles, accuracy, result, part):
    count = len(points)
    for block in indices(part, (count + _BLOCK - 1) // _BLOCK):
        stack = np.empty(_STACK, np.int64)
        for i in range(block * _BLOCK, min((block + 1) * _BLOCK, count)):
            result[i] = _winding_at(
                points[i, 0], points[i, 1], points[i, 2], corners, dipoles, accuracy * accuracy, stack
            )


nearest_kernel = Kernel(_nearest)
winding_kernel = Kernel(_winding)
