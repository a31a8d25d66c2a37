"""Which triangles a cell of marching cubes gets, by the signs of its corners: made by rule, closed over all cells.

On a face whose corners change sign four times either of two ways is right, as long as both cells beside it go the same
one: here corners inside are kept apart. Cells then fit together whatever the field is, so that a surface has neither
holes nor edges of more than two triangles. (Lorensen and Cline, 1987, leave that open; scikit-image decides by values.)
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Int

Corner = tuple[int, ...]
Triangle = tuple[int, int, int]  # of edges, counterclockwise as seen from outside the body

CORNERS: tuple[Corner, ...] = tuple(itertools.product((0, 1), repeat=3))  # of a cell; corner 4 x + 2 y + z
# Of a cell: the axis each runs along, and the corner it begins at.
EDGES = tuple((axis, corner) for axis in range(3) for corner in CORNERS if not corner[axis])


def edge_between(a: Corner, b: Corner) -> int:
    """The number of the edge that joins two corners."""
    axis = next(i for i in range(3) if a[i] != b[i])
    return EDGES.index((axis, min(a, b)))


def cell_faces() -> Iterator[tuple[Corner, ...]]:
    """The corners of each face of a cell, counterclockwise as seen from outside."""
    for axis, side in itertools.product(range(3), (0, 1)):
        around = [(0, 0), (1, 0), (1, 1), (0, 1)][:: 1 if side else -1]
        for_axis = []
        for u, v in around:
            corner = [side] * 3
            corner[(axis + 1) % 3], corner[(axis + 2) % 3] = u, v
            for_axis.append(tuple(corner))
        yield tuple(for_axis)


def loops(case: int) -> list[list[int]]:
    """The closed ways over a cell's faces that its surface begins at, as edges; bit i of `case`: corner i is inside."""
    inside = {corner: bool(case >> i & 1) for i, corner in enumerate(CORNERS)}
    following = dict[int, int]()
    for face in cell_faces():
        for i in range(4):
            if inside[face[i]] or not inside[face[(i + 1) % 4]]:
                continue
            last = next(j for j in range(i + 1, i + 4) if not inside[face[(j + 1) % 4]])
            entered = edge_between(face[i], face[(i + 1) % 4])
            following[entered] = edge_between(face[last % 4], face[(last + 1) % 4])
    found = []
    while following:
        loop = [min(following)]
        while (step := following.pop(loop[-1], None)) is not None and step != loop[0]:
            loop.append(step)
        found.append(loop)
    return found


def triangulated(loop: Sequence[int]) -> list[Triangle] | None:
    """Triangles of a loop none of whose inner sides lies in a face of the cell: the next cell might have it, too.

    None if there are no such triangles.
    """
    if len(loop) < 3:
        return []
    first, last = loop[0], loop[-1]
    for k in range(1, len(loop) - 1):
        inner = [(first, loop[k])] * (k > 1) + [(loop[k], last)] * (k < len(loop) - 2)
        if any(in_one_face(a, b) for a, b in inner):
            continue
        before, after = triangulated(loop[: k + 1]), triangulated(loop[k:])
        if before is not None and after is not None:
            return [(first, loop[k], last), *before, *after]
    return None


def in_one_face(a: int, b: int) -> bool:
    """Whether two edges belong to one face of the cell."""
    return any(a in edges and b in edges for edges in FACE_EDGES)


def triangle_table() -> Int[np.ndarray, "256 t 3"]:
    """Edges of each case's triangles; −1 fills up."""
    rows = list[list[Triangle]]()
    for case in range(256):
        found = [triangulated(loop) for loop in loops(case)]
        rows.append([t for some in found for t in some or []])
        assert None not in found
    table = np.full((256, max(map(len, rows)), 3), -1, np.int32)
    for row, triangles in zip(table, rows, strict=True):
        row[: len(triangles)] = np.reshape(triangles, (-1, 3))
    return table


FACE_EDGES = tuple({edge_between(face[i], face[(i + 1) % 4]) for i in range(4)} for face in cell_faces())
TRIANGLES = triangle_table()
