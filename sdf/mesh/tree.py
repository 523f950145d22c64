"""Bounding volume hierarchy of triangles, with a dipole a node for winding numbers."""

import math
from typing import NamedTuple

import numpy as np

_LEAF = 2
# of the diagonal: longer triangles are split, unless they are so few that groups gain nothing
_LONGEST, _FEW = 1.0 / 24.0, 256
_MOST_PIECES = 1 << 17


class Tree(NamedTuple):
    """A complete binary tree: node 1 is the root, nodes 2 i and 2 i + 1 are the children of node i.

    Leaf number j holds pieces j L up to (j + 1) L, L of them each. A triangle may have several pieces, and some pieces
    are mere points.

    Attributes:
        corners: (P, 9), metres, of the pieces.
        owner: (P,), which triangle each is a piece of.
        boxes: (N, 6), metres, lower and upper corner of each node.
        dipoles: (N, 7): centre, metres; sum of area vectors, square metres; and radius about the centre, metres.
    """

    corners: np.ndarray
    owner: np.ndarray
    boxes: np.ndarray
    dipoles: np.ndarray

    @property
    def for_distance(self) -> tuple[np.ndarray, ...]:
        """What the search for the nearest takes."""
        return self.corners, self.owner, self.boxes

    @property
    def for_winding(self) -> tuple[np.ndarray, ...]:
        """What the winding number takes."""
        return self.corners, self.dipoles


def has_long(corners: np.ndarray) -> bool:
    """Whether `split` splits any of some triangles (F, 3, 3)."""
    sides = corners[:, [1, 2, 0]] - corners
    limit = _LONGEST * float(np.linalg.norm(np.ptp(corners.reshape(-1, 3), 0)))
    return len(corners) > _FEW and bool(np.einsum("fck,fck->fc", sides, sides).max() > limit * limit)


def build_tree(corners: np.ndarray, *, split: bool = False) -> Tree:
    """Groups by the median along the longest side of their box, again and again.

    Args:
        corners: (F, 3, 3), metres.
        split: split long triangles first. For dipoles that pays, since a group with a long one is never far enough
            away to count as one; for boxes it does not.
    """
    pieces, owner = np.asarray(corners, dtype=np.float64), np.arange(len(corners))
    if split:
        pieces, owner = split_long(corners, _LONGEST * float(np.linalg.norm(np.ptp(corners.reshape(-1, 3), 0))))
    depth = max(0, int(math.log2(len(pieces) / _LEAF)))
    # leaves of one size: what is lacking are points, which are no nearer than what they lie on and wind about nothing
    spare = -len(pieces) % (1 << depth)
    points = np.broadcast_to(pieces[-1, 0], (spare, 3, 3))
    pieces, owner = np.concatenate((pieces, points)), np.concatenate((owner, np.repeat(owner[-1:], spare)))
    a, b, c = pieces[:, 0], pieces[:, 1], pieces[:, 2]
    order = _order((a + b + c) / 3.0, depth)
    a, b, c, owner = a[order], b[order], c[order], owner[order]
    boxes, dipoles = np.zeros((2 << depth, 6)), np.zeros((2 << depth, 7))
    vector = 0.5 * np.cross(b - a, c - a)
    # a hair of weight for pieces without area, so that a group of such has a centre
    area = np.linalg.norm(vector, axis=1, keepdims=True) + 1e-300
    low, high = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
    sums = np.concatenate(((a + b + c) / 3.0 * area, vector, area), 1)
    for level in reversed(range(depth + 1)):
        here, groups = slice(1 << level, 2 << level), (1 << level, -1)
        low, high = low.reshape(*groups, 3).min(1), high.reshape(*groups, 3).max(1)
        sums = sums.reshape(*groups, 7).sum(1)
        boxes[here] = np.concatenate((low, high), 1)
        dipoles[here, :3], dipoles[here, 3:6] = sums[:, :3] / sums[:, 6:], sums[:, 3:6]
        far = np.zeros(1 << level)
        for corner in (a, b, c):
            away = corner.reshape(*groups, 3) - dipoles[here, None, :3]
            far = np.maximum(far, np.einsum("gpk,gpk->gp", away, away).max(1))
        dipoles[here, 6] = np.sqrt(far)
    return Tree(np.concatenate((a, b, c), 1), owner, boxes, dipoles)


def split_long(corners: np.ndarray, longest: float) -> tuple[np.ndarray, np.ndarray]:
    """Triangles halved at their longest side until none is longer than asked for, or there are very many.

    Returns:
        pieces (P, 3, 3), metres, and which triangle each is a piece of (P).
    """
    pieces, owner = np.asarray(corners, dtype=np.float64), np.arange(len(corners))
    done: list[tuple[np.ndarray, np.ndarray]] = []
    total = len(pieces)
    while len(pieces):
        length = ((np.roll(pieces, -1, 1) - pieces) ** 2).sum(-1)
        long = length.max(1) > longest * longest
        if total + int(long.sum()) > max(_MOST_PIECES, 2 * len(corners)):
            long[:] = False
        done.append((pieces[~long], owner[~long]))
        pieces, owner, side = pieces[long], owner[long], length[long].argmax(1)
        total += len(pieces)
        rows = np.arange(len(pieces))
        a, b, c = (pieces[rows, (side + k) % 3] for k in range(3))
        middle = 0.5 * (a + b)
        pieces = np.concatenate((np.stack((a, middle, c), 1), np.stack((middle, b, c), 1)))
        owner = np.concatenate((owner, owner))
    return np.concatenate([part for part, _ in done]), np.concatenate([part for _, part in done])


def _order(middle: np.ndarray, depth: int) -> np.ndarray:
    """Pieces, a whole number for each leaf, such that every node's are in a row."""
    order = np.arange(len(middle))
    for level in range(depth):
        groups = middle[order].reshape(1 << level, -1, 3)
        axis = np.ptp(groups, axis=1).argmax(-1)
        along = np.take_along_axis(groups, axis[:, None, None], 2)[..., 0]
        half = np.argpartition(along, along.shape[1] // 2, axis=1)
        order = np.take_along_axis(order.reshape(1 << level, -1), half, 1).reshape(-1)
    return order
