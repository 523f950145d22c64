"""The compiled CPU version of the sums of `contact_terms`, pose by pose; `contact_terms.py` has the definition."""

import math

import numpy as np

from sdf.compiled import Kernel, bare
from sdf.mesh.touched_numba import search
from sdf.mesh.tree_numba import closest
from sdf.part_numba import indices

_STACK = 64
_ON, _LEAST, _FAR = 1e-9, 1e-12, 500.0


@bare
def _cell(x, low, step, count):
    at = (x - low) / step
    # far out, beyond what an integer holds, too
    return int(min(max(at, 0.0), count - 1.0)) if at == at else 0


def _terms(
    poses, points, normals, corners, owner, boxes, faces, facing, cells, low, step, exact, reach, absolute, smooth,
    amount, nats, noise, outlier, objective, gradient, hessian, part,
):  # fmt: skip
    for n in indices(part, len(poses)):
        stack, gaps = np.empty(_STACK, np.int64), np.empty(_STACK)
        found, trial, row = np.empty(3), np.empty(3), np.empty(6)
        pose, total = poses[n], 0.0
        for k in range(len(points)):
            ax, ay, az = points[k, 0] - pose[0, 3], points[k, 1] - pose[1, 3], points[k, 2] - pose[2, 3]
            x = pose[0, 0] * ax + pose[1, 0] * ay + pose[2, 0] * az
            y = pose[0, 1] * ax + pose[1, 1] * ay + pose[2, 1] * az
            z = pose[0, 2] * ax + pose[1, 2] * ay + pose[2, 2] * az
            piece = cells[
                _cell(x, low[0], step, cells.shape[0]),
                _cell(y, low[1], step, cells.shape[1]),
                _cell(z, low[2], step, cells.shape[2]),
            ]
            wx, wy, wz = normals[k, 0], normals[k, 1], normals[k, 2]
            if exact:
                nx = pose[0, 0] * wx + pose[1, 0] * wy + pose[2, 0] * wz
                ny = pose[0, 1] * wx + pose[1, 1] * wy + pose[2, 1] * wz
                nz = pose[0, 2] * wx + pose[1, 2] * wy + pose[2, 2] * wz
                piece = search(
                    x, y, z, nx, ny, nz, reach * reach, corners, owner, boxes, facing, piece, stack, gaps, found, trial
                )
                face = owner[piece]
            else:
                face = owner[piece]
                closest(x, y, z, faces, face, np.inf, found)
            fx = pose[0, 0] * facing[face, 0] + pose[0, 1] * facing[face, 1] + pose[0, 2] * facing[face, 2]
            fy = pose[1, 0] * facing[face, 0] + pose[1, 1] * facing[face, 1] + pose[1, 2] * facing[face, 2]
            fz = pose[2, 0] * facing[face, 0] + pose[2, 1] * facing[face, 1] + pose[2, 2] * facing[face, 2]
            ox, oy, oz = x - found[0], y - found[1], z - found[2]
            square = ox * ox + oy * oy + oz * oz
            distance = math.sqrt(square)
            if distance > _ON:
                ux = (pose[0, 0] * ox + pose[0, 1] * oy + pose[0, 2] * oz) / distance
                uy = (pose[1, 0] * ox + pose[1, 1] * oy + pose[1, 2] * oz) / distance
                uz = (pose[2, 0] * ox + pose[2, 1] * oy + pose[2, 2] * oz) / distance
            else:
                ux, uy, uz = fx, fy, fz
            row[0], row[1], row[2] = -ux, -uy, -uz
            row[3], row[4], row[5] = az * uy - ay * uz, ax * uz - az * ux, ay * ux - ax * uy
            chord = (wx - fx) ** 2 + (wy - fy) ** 2 + (wz - fz) ** 2 if amount > 0.0 else 0.0
            weight, loss = 1.0, 0.5 * square
            rounded = math.sqrt(square + smooth * smooth)
            if absolute:
                loss = rounded
                weight = 1.0 / max(loss, _LEAST)
            share, worth = 1.0, amount
            if outlier > 0.0:
                cost = rounded / noise + nats * chord
                share = 1.0 / (1.0 + outlier * math.exp(min(cost, _FAR)))
                worth = amount * share
                if absolute:
                    total -= noise * math.log(math.exp(-cost) + outlier)
                else:
                    total += share * (loss + amount * chord)
                weight *= share
            else:
                total += loss
            for i in range(6):
                gradient[n, i] += weight * distance * row[i]
                for j in range(6):
                    hessian[n, i, j] += weight * row[i] * row[j]
            if amount > 0.0:
                if outlier == 0.0:
                    total += amount * chord
                gradient[n, 3] -= 2.0 * worth * (fy * wz - fz * wy)
                gradient[n, 4] -= 2.0 * worth * (fz * wx - fx * wz)
                gradient[n, 5] -= 2.0 * worth * (fx * wy - fy * wx)
                all_of = fx * fx + fy * fy + fz * fz
                hessian[n, 3, 3] += 2.0 * worth * (all_of - fx * fx)
                hessian[n, 4, 4] += 2.0 * worth * (all_of - fy * fy)
                hessian[n, 5, 5] += 2.0 * worth * (all_of - fz * fz)
                hessian[n, 3, 4] -= 2.0 * worth * fx * fy
                hessian[n, 4, 3] -= 2.0 * worth * fx * fy
                hessian[n, 3, 5] -= 2.0 * worth * fx * fz
                hessian[n, 5, 3] -= 2.0 * worth * fx * fz
                hessian[n, 4, 5] -= 2.0 * worth * fy * fz
                hessian[n, 5, 4] -= 2.0 * worth * fy * fz
        objective[n] = total


terms_kernel = Kernel(_terms)
