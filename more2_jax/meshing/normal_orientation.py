"""Which side of a scanned surface is outside: by who saw it, by what lies behind it, by the field, by its neighbors.

A surface faces the sensor that saw it. Where sensors are not known, points alone do not tell: along the normal, matter
ends sooner than free space does, a board's other face is nearer than the next shelf. Where nothing lies on either
side, the field's slope decides. Votes are then made to agree over a signed graph of neighbors (after Hoppe et al.,
1992; here one sparse linear system instead of a spanning tree).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_matrix, csr_matrix, diags
from scipy.sparse.linalg import cg
from scipy.spatial import KDTree

Points = Float[np.ndarray, "n 3"]
Neighbors = tuple[Float[np.ndarray, "n k"], Int[np.ndarray, "n k"]]  # distances and indices, nearest first

STEP, STEPS, FARTHEST = (
    1.35,
    16,
    0.9,
)  # radii at which the normal is followed: times the last; canonical units
WIDTH = 0.45  # of what counts as met, times the way to it: a cone
LINE_OF_SIGHT = 0.25  # and when a sensor is looked for: what stands in its way
OF_FIELD = 0.3  # what the field's slope weighs, against 1 of the ratio of the ways to what is met
OF_SURROUNDINGS = 0.25  # what both weigh where sensors are known, against 1 of a sensor
GRAZING = 0.2  # cosine from which on a sensor sees a side for sure
VOTERS = 4096  # points that look around; the others hear them
NEIGHBORS = 10  # of a point, in the graph
OWN_VOTE = 0.05  # what a vote weighs, against its neighbors' sum
SHARP = 8  # power of the agreement of two normals that makes an edge's weight: none across a crease


def outward_signs(
    tree: KDTree,
    normal: Points,
    slope: Float[np.ndarray, " n"],
    gap: float,
    lowest: float,
    seen_from: Float[np.ndarray, "n s 3"] | None = None,
    known: Neighbors | None = None,
) -> Float[np.ndarray, " n"]:
    """+1 where a point's normal goes outward, −1 where inward.

    `tree` holds the points (canonical units); `slope` is by how much the field rises along the normal, −1 to 1; `gap`
    is the least way that counts; below the height `lowest` there is no free space. One of the places `seen_from`, if
    they are known, saw the point; NaN fills up. `known`: the points' neighbors, if they were searched before.
    """
    points, few = np.asarray(tree.data), np.arange(0, tree.n, -(-tree.n // VOTERS))
    seen = np.zeros(len(few))
    if seen_from is not None:
        seen = side_seen(tree, points[few], normal[few], seen_from[few], gap)
    unsure = few[np.abs(seen) < 1]
    ways = [first_met(tree, points[unsure], side * normal[unsure], gap, lowest) for side in (1, -1)]
    vote = OF_FIELD * np.clip(slope, -1, 1)
    vote[unsure] += np.clip(np.log(ways[0] / ways[1]), -1, 1)
    vote *= 1.0 if seen_from is None else OF_SURROUNDINGS
    vote[few] += seen
    agreed, _ = cg(*graph(points, normal, vote, known or neighbors_in(tree)), x0=vote, rtol=1e-3, maxiter=200)
    return np.where(agreed < 0, -1.0, 1.0)


def side_seen(
    tree: KDTree, points: Points, normal: Points, seen_from: Float[np.ndarray, "n s 3"], gap: float
) -> Float[np.ndarray, " n"]:
    """From −1 to 1: whether the sensors that may have seen a point stand on the side its normal goes to; 0: not known.

    Where some stand on either side, those count that nothing in `tree` hides.
    """
    way = seen_from - points[:, None]
    way = way / np.maximum(np.linalg.norm(way, axis=2, keepdims=True), 1e-12)
    side = np.nan_to_num(np.clip(np.einsum("nsi,ni->ns", way, normal) / GRAZING, -1, 1))
    disputed = (side > 0).any(axis=1) & (side < 0).any(axis=1)
    for sensor in range(side.shape[1]):
        asked = np.flatnonzero(disputed & (side[:, sensor] != 0))
        hidden = first_met(tree, points[asked], way[asked, sensor], gap, -np.inf, LINE_OF_SIGHT) < 1
        side[asked[hidden], sensor] = 0.0
    return np.clip(side.sum(axis=1), -1, 1)


def first_met(
    tree: KDTree, points: Points, direction: Points, gap: float, lowest: float, width: float = WIDTH
) -> Float[np.ndarray, " n"]:
    """How far along `direction` the first other points lie, in a cone of `width` times the way; 1 where none do."""
    found, asked = np.ones(len(points)), np.arange(len(points))
    ways = gap * STEP ** np.arange(STEPS)
    for way in ways[ways < FARTHEST]:
        there = points[asked] + way * direction[asked]
        met = tree.query(there, distance_upper_bound=width * way)[0] < np.inf
        met |= there[:, 2] < lowest
        found[asked[met]] = way
        asked = asked[~met]
    return found


def neighbors_in(tree: KDTree) -> Neighbors:
    """Of every point, itself first."""
    distance, near = tree.query(np.asarray(tree.data), k=min(NEIGHBORS + 1, tree.n))
    return np.asarray(distance), np.asarray(near)


def graph(
    points: Points, normal: Points, vote: Float[np.ndarray, " n"], known: Neighbors
) -> tuple[csr_matrix, Float[np.ndarray, " n"]]:
    """The linear system whose solution weighs every vote against those of neighbors, and its right-hand side.

    An edge's sign: whether two normals go to one side of a circle's arc through both points.
    """
    distance, near = (x[:, 1 : NEIGHBORS + 1] for x in known)
    i, j, d = np.repeat(np.arange(len(points)), near.shape[1]), near.ravel(), distance.ravel()
    along = (points[j] - points[i]) / np.maximum(d, 1e-12)[:, None]
    mirrored = normal[j] - 2 * np.einsum("ei,ei->e", normal[j], along)[:, None] * along
    agree = np.einsum("ei,ei->e", normal[i], mirrored)
    weight = np.sign(agree) * np.abs(agree) ** SHARP * np.exp(-0.5 * (d / max(2 * np.median(d), 1e-12)) ** 2)
    edges = coo_matrix((weight, (i, j)), shape=(len(points), len(points)))
    edges = (edges + edges.T) / 2
    degree = np.asarray(abs(edges).sum(axis=1)).ravel()
    return csr_matrix(diags(degree + OWN_VOTE) - edges), OWN_VOTE * vote
