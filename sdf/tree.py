"""A tree over triangles: groups of ever fewer of them, with their boxes and dipoles."""

import math
from typing import NamedTuple

import numpy as np

_LEAF = 4
# of the diagonal: longer triangles are split, since a group with a long one is near to everything
_LONGEST = 1.0 / 24.0
_MOST_PIECES = 1 << 17


class Tree(NamedTuple):
    """A complete binary tree: node 1 is the root, nodes 2 i and 2 i + 1 are the children of node i.

    Leaf number j of 2^depth holds pieces floor(j P / 2^depth) up to the same of j + 1. A triangle that is long for
    the size of the whole has several pieces.

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


def build_tree(corners: np.ndarray) -> Tree:
    """Split at the median of the longest side, again and again.

    Args:
        corners: (F, 3, 3), metres.
    """
    pieces, owner = split_long(corners, _LONGEST * float(np.linalg.norm(np.ptp(corners.reshape(-1, 3), 0))))
    count = len(pieces)
    depth = max(0, int(math.log2(count / _LEAF)))
    order = _order(pieces, depth)
    pieces, owner = pieces[order], owner[order]
    boxes = np.zeros((2 << depth, 6))
    dipoles = np.zeros((2 << depth, 7))
    first = _starts(count, depth)[:-1]
    leaves = slice(1 << depth, 2 << depth)
    boxes[leaves, :3] = np.minimum.reduceat(pieces.min(1), first)
    boxes[leaves, 3:] = np.maximum.reduceat(pieces.max(1), first)
    vector = 0.5 * np.cross(pieces[:, 1] - pieces[:, 0], pieces[:, 2] - pieces[:, 0])
    # a hair of weight for pieces without area, so that a group of such has a centre
    area = np.linalg.norm(vector, axis=1) + 1e-300
    moments = np.concatenate((pieces.mean(1) * area[:, None], vector, area[:, None]), 1)
    sums = np.zeros((2 << depth, 7))
    sums[leaves] = np.add.reduceat(moments, first)
    for level in reversed(range(depth)):
        here = slice(1 << level, 2 << level)
        left, right = slice(2 << level, 4 << level, 2), slice((2 << level) + 1, 4 << level, 2)
        boxes[here, :3] = np.minimum(boxes[left, :3], boxes[right, :3])
        boxes[here, 3:] = np.maximum(boxes[left, 3:], boxes[right, 3:])
        sums[here] = sums[left] + sums[right]
    dipoles[1:, :3] = sums[1:, :3] / sums[1:, 6:]
    dipoles[1:, 3:6] = sums[1:, 3:6]
    for level in range(depth + 1):
        starts = _starts(count, level)
        centre = np.repeat(dipoles[1 << level : 2 << level, :3], np.diff(starts), axis=0)
        far = np.sqrt(((pieces - centre[:, None]) ** 2).sum(-1).max(-1))
        dipoles[1 << level : 2 << level, 6] = np.maximum.reduceat(far, starts[:-1])
    return Tree(np.ascontiguousarray(pieces.reshape(-1, 9)), owner, boxes, dipoles)


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


def _starts(count: int, level: int) -> np.ndarray:
    """First piece of each node of a level, and the number of pieces."""
    return np.arange((1 << level) + 1, dtype=np.int64) * count >> level


def _order(pieces: np.ndarray, depth: int) -> np.ndarray:
    """Pieces such that every node's are in a row."""
    middle = pieces.mean(1)
    order = np.arange(len(pieces))
    for level in range(depth):
        starts = _starts(len(pieces), level)
        sizes = np.diff(starts)
        low = np.minimum.reduceat(middle[order], starts[:-1])
        high = np.maximum.reduceat(middle[order], starts[:-1])
        axis = np.repeat((high - low).argmax(1), sizes)
        node = np.repeat(np.arange(len(sizes)), sizes)
        order = order[np.lexsort((middle[order, axis], node))]
    return order
