"""A mesh cut into small smooth pieces (Felzenszwalb & Huttenlocher 2004 on normals, as ScanNet's segmentator does).

Annotators label pieces, not points: labels end where pieces end, not where objects do.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

THRESHOLD = 0.01  # larger makes larger pieces
SMALLEST = 20  # vertices of a piece


def over_segmentation(
    vertices: Float[np.ndarray, "v 3"], normals: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> Int[np.ndarray, " v"]:
    """The piece of every vertex, from 0. Edges join pieces in order of how much normals turn along them."""
    pairs = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    a, b = np.divmod(np.unique(pairs[:, 0] * len(vertices) + pairs[:, 1]), len(vertices))
    turn = 1 - (normals[a] * normals[b]).sum(axis=1)
    convex = ((vertices[b] - vertices[a]) * normals[b]).sum(axis=1) > 0
    weight = np.where(convex, turn**2, turn)  # a convex edge rarely parts two objects
    order = np.argsort(weight, kind="stable")
    return _joined(len(vertices), a[order].tolist(), b[order].tolist(), weight[order].tolist())


def _joined(count: int, a: list[int], b: list[int], weight: list[float]) -> Int[np.ndarray, " v"]:
    """Union-find over edges in ascending weight, then small pieces with their nearest neighbor."""
    parent, size, limit = list(range(count)), [1] * count, [THRESHOLD] * count

    def find(k: int) -> int:
        while parent[k] != k:
            parent[k] = parent[parent[k]]
            k = parent[k]
        return k

    for i, j, w in zip(a, b, weight, strict=True):
        i, j = find(i), find(j)
        if i != j and w <= limit[i] and w <= limit[j]:
            parent[j] = i
            size[i] += size[j]
            limit[i] = w + THRESHOLD / size[i]
    for i, j in zip(a, b, strict=True):
        i, j = find(i), find(j)
        if i != j and min(size[i], size[j]) < SMALLEST:
            parent[j] = i
            size[i] += size[j]
    roots = [find(k) for k in range(count)]
    return np.unique(np.array(roots), return_inverse=True)[1]


def majority(piece: Int[np.ndarray, " v"], label: Int[np.ndarray, " v"]) -> Int[np.ndarray, " v"]:
    """Every vertex's label (from −1) as most vertices of its piece have it; the smallest such label on a tie."""
    votes = np.zeros((piece.max() + 1, label.max() + 2), np.int64)
    np.add.at(votes, (piece, label + 1), 1)
    return votes.argmax(axis=1)[piece] - 1
