"""The compiled CPU versions of contacts of a rectangle and of ways past it; definitions in `rectangle_touch.py`."""

import math

import numpy as np

from sdf.compiled import Kernel, bare
from sdf.part_numba import indices


@bare
def _face(along, across, reach, width, facing, other):
    """Cost of a face at +reach of the first axis: squared distance, and squared chord."""
    over = max(abs(across) - width, 0.0)
    return (along - reach) ** 2 + over * over, (facing - 1.0) ** 2 + other * other


def _touches(poses, points, normals, hx, hy, per_point, per_normal, corners, out, part):
    for k in indices(part, len(points)):
        for i in range(len(poses)):
            c, s = math.cos(poses[i, 2]), math.sin(poses[i, 2])
            dx, dy = points[k, 0] - poses[i, 0], points[k, 1] - poses[i, 1]
            x, y = c * dx + s * dy, c * dy - s * dx
            nx = c * normals[k, 0] + s * normals[k, 1]
            ny = c * normals[k, 1] - s * normals[k, 0]
            best = math.inf
            for side in range(4):
                if side == 0:
                    gap, chord = _face(x, y, hx, hy, nx, ny)
                elif side == 1:
                    gap, chord = _face(-x, y, hx, hy, -nx, ny)
                elif side == 2:
                    gap, chord = _face(y, x, hy, hx, ny, nx)
                else:
                    gap, chord = _face(-y, x, hy, hx, -ny, nx)
                best = min(best, per_point * gap + per_normal * chord)
            if corners:
                cx = -hx if nx < 0.0 else hx
                cy = -hy if ny < 0.0 else hy
                best = min(best, per_point * ((x - cx) ** 2 + (y - cy) ** 2))
            out[k, i] = -best


touches_kernel = Kernel(_touches)


@bare
def _beside(x, y, hx, hy):
    """Distance of a point from the rectangle, 0 inside."""
    ox, oy = max(abs(x) - hx, 0.0), max(abs(y) - hy, 0.0)
    return math.sqrt(ox * ox + oy * oy)


def _clearances(poses, ways, hx, hy, out, part):
    tiny = np.finfo(np.float64).tiny
    for w in indices(part, len(ways)):
        for i in range(len(poses)):
            c, s = math.cos(poses[i, 2]), math.sin(poses[i, 2])
            ax, ay = ways[w, 0, 0] - poses[i, 0], ways[w, 0, 1] - poses[i, 1]
            bx, by = ways[w, 1, 0] - poses[i, 0], ways[w, 1, 1] - poses[i, 1]
            ax, ay = c * ax + s * ay, c * ay - s * ax
            bx, by = c * bx + s * by, c * by - s * bx
            apart = max(max(min(ax, bx) - hx, -hx - max(ax, bx)), max(min(ay, by) - hy, -hy - max(ay, by)))
            vx, vy = bx - ax, by - ay
            square = vx * vx + vy * vy
            if square > 0.0:
                length = math.sqrt(square)
                tx, ty = -vy / length, vx / length
                apart = max(apart, abs(ax * tx + ay * ty) - abs(tx) * hx - abs(ty) * hy)
            if apart > 0.0:
                least = min(_beside(ax, ay, hx, hy), _beside(bx, by, hx, hy))
                for corner in range(4):
                    px = hx if corner & 1 else -hx
                    py = hy if corner & 2 else -hy
                    share = ((px - ax) * vx + (py - ay) * vy) / max(square, tiny)
                    share = min(max(share, 0.0), 1.0)
                    gx, gy = px - ax - share * vx, py - ay - share * vy
                    least = min(least, math.sqrt(gx * gx + gy * gy))
                apart = least
            out[w, i] = apart


clearances_kernel = Kernel(_clearances)
