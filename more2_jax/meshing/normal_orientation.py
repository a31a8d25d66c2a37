"""Consistent orientation of normals: by sensors and the scan's own normals, free ways, the field, the neighbors.

A surface faces the sensor that saw it, and a scan's normals say so. Where neither is known, points alone do not tell:
along the normal, matter ends sooner than free space does, a board's other face is nearer than the next shelf. Where
nothing lies on either side, the field's gradient decides. These votes are then made to agree over a signed graph of
neighbors (after Hoppe et al., "Surface reconstruction from unorganized points", 1992; one sparse linear system instead
of a spanning tree).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_matrix, csr_matrix, diags
from scipy.spatial import KDTree

Points = Float[np.ndarray, "n 3"]
Values = Float[np.ndarray, " n"]
Neighbors = tuple[Float[np.ndarray, "n k"], Int[np.ndarray, "n k"]]  # distances and indices, nearest first

# The values behind the tables of docs/developing/notebook/mesh_sides.md; lengths in canonical units.
STEP_RATIO, MAX_STEPS, MAX_DISTANCE = (
    1.35,
    16,
    0.9,
)  # of the distances at which a ray is tested, each times the last
CONE_SLOPE = 0.45  # a point this share of the distance off a ray counts as hit
LINE_OF_SIGHT_SLOPE = 0.25  # and where the ray goes to a sensor
FIELD_WEIGHT = 0.3  # of the field's gradient, against 1 of the ratio of free distances
GEOMETRY_WEIGHT = 0.25  # of both, where sensors are known, against 1 of a sensor
GRAZING_COSINE = 0.2  # from here on a sensor, or a scan's normal, tells a side for sure
MAX_VOTERS = 4096  # points that cast rays; the others follow them. 1,024 turn up to 6 % of a noisy cloud's (there, too)
GRAPH_NEIGHBORS = 10
VOTE_WEIGHT = 0.05  # of a point's own vote, against the sum of its neighbors'
CREASE_POWER = 8  # of the agreement of two normals, which makes an edge's weight: none across a crease
TOLERANCE, MAX_ITERATIONS = 1e-3, 200  # of the linear system: only signs are asked for


def outward_signs(
    tree: KDTree,
    normal: Points,
    slope: Values,
    min_distance: float,
    lowest: float,
    sensors: Float[np.ndarray, "n s 3"] | None = None,
    known: Neighbors | None = None,
    given: Points | None = None,
) -> Values:
    """+1 where a point's normal goes outward, −1 where inward.

    `tree` holds the points (canonical units); `slope` is by how much the field rises along the normal, −1 to 1; rays
    are tested from `min_distance` on; below the height `lowest` there is no free space. One of the positions `sensors`,
    if they are known, saw the point; NaN fills up. `known`: the points' neighbors, if they were searched before.
    `given`: the normals that the scan has, outward; zeros where it has none.
    """
    points, voters = np.asarray(tree.data), np.arange(0, tree.n, -(-tree.n // MAX_VOTERS))
    by_view = np.zeros(len(voters))
    if sensors is not None:
        by_view = sensor_votes(tree, points[voters], normal[voters], sensors[voters], min_distance)
    if given is not None:
        along = np.einsum("ni,ni->n", given[voters], normal[voters])
        by_view = np.clip(by_view + np.clip(along / GRAZING_COSINE, -1, 1), -1, 1)
    unsure = voters[np.abs(by_view) < 1]
    free = [
        free_distance(tree, points[unsure], sign * normal[unsure], min_distance, lowest) for sign in (1, -1)
    ]
    vote = FIELD_WEIGHT * np.clip(slope, -1, 1)
    vote[unsure] += np.clip(np.log(free[0] / free[1]), -1, 1)
    vote *= 1.0 if sensors is None and given is None else GEOMETRY_WEIGHT
    vote[voters] += by_view
    matrix, right = signed_graph(points, normal, vote, known or nearest_neighbors(tree))
    return np.where(conjugate_gradients(matrix, right, vote) < 0, -1.0, 1.0)


def sensor_votes(
    tree: KDTree, points: Points, normal: Points, sensors: Float[np.ndarray, "n s 3"], min_distance: float
) -> Values:
    """From −1 to 1: whether the sensors that may have seen a point stand on the side its normal goes to; 0: not known.

    Where some stand on either side, those count whose line of sight no other point of `tree` blocks.
    """
    ray = sensors - points[:, None]
    ray = ray / np.maximum(np.linalg.norm(ray, axis=2, keepdims=True), 1e-12)
    side = np.nan_to_num(np.clip(np.einsum("nsi,ni->ns", ray, normal) / GRAZING_COSINE, -1, 1))
    disputed = (side > 0).any(axis=1) & (side < 0).any(axis=1)
    for sensor in range(side.shape[1]):
        asked = np.flatnonzero(disputed & (side[:, sensor] != 0))
        free = free_distance(
            tree, points[asked], ray[asked, sensor], min_distance, -np.inf, LINE_OF_SIGHT_SLOPE
        )
        side[asked[free < 1], sensor] = 0.0
    return np.clip(side.sum(axis=1), -1, 1)


def free_distance(
    tree: KDTree,
    points: Points,
    direction: Points,
    min_distance: float,
    lowest: float,
    slope: float = CONE_SLOPE,
) -> Values:
    """How far along `direction` the first other points lie, in a cone of that `slope`; 1 where none do."""
    found, asked = np.ones(len(points)), np.arange(len(points))
    distances = min_distance * STEP_RATIO ** np.arange(MAX_STEPS)
    for distance in distances[distances < MAX_DISTANCE]:
        there = points[asked] + distance * direction[asked]
        hit = tree.query(there, distance_upper_bound=slope * distance)[0] < np.inf
        hit |= there[:, 2] < lowest
        found[asked[hit]] = distance
        asked = asked[~hit]
    return found


def nearest_neighbors(tree: KDTree) -> Neighbors:
    """Of every point, itself first."""
    distance, index = tree.query(np.asarray(tree.data), k=min(GRAPH_NEIGHBORS + 1, tree.n))
    return np.asarray(distance), np.asarray(index)


def signed_graph(points: Points, normal: Points, vote: Values, known: Neighbors) -> tuple[csr_matrix, Values]:
    """The linear system whose solution weighs every vote against those of neighbors, and its right-hand side.

    An edge's sign: whether two normals go to one side of a circle's arc through both points.
    """
    distance, neighbor = (x[:, 1 : GRAPH_NEIGHBORS + 1] for x in known)
    i, j, d = np.repeat(np.arange(len(points)), neighbor.shape[1]), neighbor.ravel(), distance.ravel()
    along = (points[j] - points[i]) / np.maximum(d, 1e-12)[:, None]
    mirrored = normal[j] - 2 * np.einsum("ei,ei->e", normal[j], along)[:, None] * along
    agree = np.einsum("ei,ei->e", normal[i], mirrored)
    nearness = np.exp(-0.5 * (d / max(2 * np.median(d), 1e-12)) ** 2)
    weight = np.sign(agree) * np.abs(agree) ** CREASE_POWER * nearness
    edges = coo_matrix((weight, (i, j)), shape=(len(points), len(points)))
    edges = (edges + edges.T) / 2
    degree = np.asarray(abs(edges).sum(axis=1)).ravel()
    return csr_matrix(diags(degree + VOTE_WEIGHT) - edges), VOTE_WEIGHT * vote


def conjugate_gradients(matrix: csr_matrix, right: Values, start: Values) -> Values:
    """The solution of a positive definite system, as `scipy.sparse.linalg.cg` has it.

    Not by it: its dot products come from BLAS, which shares those of more than 10,000 numbers out to threads. Where
    objects are worked on side by side these wait for one another (1.2 s of processor time instead of 0.01).
    """
    x, residual = start, right - matrix @ start
    direction, squared = residual, np.einsum("n,n->", residual, residual)
    enough = TOLERANCE**2 * np.einsum("n,n->", right, right)
    for _ in range(MAX_ITERATIONS):
        if squared <= enough:
            break
        moved = matrix @ direction
        step = squared / np.einsum("n,n->", direction, moved)
        x, residual = x + step * direction, residual - step * moved
        before, squared = squared, np.einsum("n,n->", residual, residual)
        direction = residual + squared / before * direction
    return x
