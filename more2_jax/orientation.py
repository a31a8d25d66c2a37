"""Which side of a scanned surface is outside: by what lies behind it, by the field, and by what neighbours say.

Points alone do not tell. Along the normal, matter ends sooner than free space does: a board's other face is nearer than
the next shelf. Where nothing lies on either side, the field's slope decides. Votes are then made to agree over a
signed graph of neighbours (after Hoppe et al., 1992; here one sparse linear system instead of a spanning tree).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.sparse import coo_matrix, csr_matrix, diags
from scipy.sparse.linalg import cg
from scipy.spatial import KDTree

Points = Float[np.ndarray, "n 3"]

STEP, STEPS, FARTHEST = (
    1.35,
    16,
    0.9,
)  # radii at which the normal is followed: times the last; canonical units
WIDTH = 0.45  # of what counts as met, times the way to it: a cone
OF_FIELD = 0.3  # what the field's slope weighs, against 1 of the ratio of the ways to what is met
NEIGHBOURS = 10  # of a point, in the graph
OWN_VOTE = 0.05  # what a vote weighs, against its neighbours' sum
SHARP = 8  # power of the agreement of two normals that makes an edge's weight: none across a crease


def outward_signs(
    tree: KDTree, normal: Points, slope: Float[np.ndarray, " n"], gap: float, lowest: float
) -> Float[np.ndarray, " n"]:
    """+1 where a point's normal goes outward, −1 where inward.

    `tree` holds the points (canonical units); `slope` is by how much the field rises along the normal, −1 to 1; `gap`
    is the least way that counts; below the height `lowest` there is no free space.
    """
    points = np.asarray(tree.data)
    ways = [first_met(tree, points, side * normal, gap, lowest) for side in (1, -1)]
    vote = np.clip(np.log(ways[0] / ways[1]), -1, 1) + OF_FIELD * np.clip(slope, -1, 1)
    agreed, _ = cg(*graph(tree, normal, vote), x0=vote, rtol=1e-3, maxiter=200)
    return np.where(agreed < 0, -1.0, 1.0)


def first_met(
    tree: KDTree, points: Points, direction: Points, gap: float, lowest: float
) -> Float[np.ndarray, " n"]:
    """How far along `direction` the first other points lie; 1 where none do."""
    found = np.ones(len(points))
    ways = gap * STEP ** np.arange(STEPS)
    for way in ways[ways < FARTHEST][::-1]:
        there = points + way * direction
        met = tree.query(there, distance_upper_bound=WIDTH * way, workers=-1)[0] < np.inf
        found[met | (there[:, 2] < lowest)] = way
    return found


def graph(
    tree: KDTree, normal: Points, vote: Float[np.ndarray, " n"]
) -> tuple[csr_matrix, Float[np.ndarray, " n"]]:
    """The linear system whose solution weighs every vote against those of neighbours, and its right-hand side.

    An edge's sign: whether two normals go to one side of a circle's arc through both points.
    """
    points = np.asarray(tree.data)
    count = min(NEIGHBOURS + 1, len(points))
    distance, near = tree.query(points, k=count, workers=-1)
    i = np.repeat(np.arange(len(points)), count - 1)
    j, d = np.asarray(near)[:, 1:].ravel(), np.asarray(distance)[:, 1:].ravel()
    along = (points[j] - points[i]) / np.maximum(d, 1e-12)[:, None]
    mirrored = normal[j] - 2 * np.einsum("ei,ei->e", normal[j], along)[:, None] * along
    agree = np.einsum("ei,ei->e", normal[i], mirrored)
    weight = np.sign(agree) * np.abs(agree) ** SHARP * np.exp(-0.5 * (d / max(2 * np.median(d), 1e-12)) ** 2)
    edges = coo_matrix((weight, (i, j)), shape=(len(points), len(points)))
    edges = (edges + edges.T) / 2
    degree = np.asarray(abs(edges).sum(axis=1)).ravel()
    return csr_matrix(diags(degree + OWN_VOTE) - edges), OWN_VOTE * vote
