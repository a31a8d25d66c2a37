"""Floor, walls and ceiling around a cloud: wide planes of what is no object, behind which the scan has nothing.

Not in the paper. A table's top and a cabinet's front are planes too, and parts of them may lie in the background; but
the table's legs and the room are behind them. Nothing is behind the floor: that tells it without a direction for up.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from more2_jax.geometry.near_points import NearPoints
from more2_jax.geometry.poses import Points
from more2_jax.geometry.room_alignment import threads_for

# Chosen on rooms of regime `real`, docs/developing/notebook/mask_repair.md.
AROUND_M = 0.75  # of the cloud: what is looked at
OFF_M = 0.025  # of a plane: what fusion, drift and a floor's waves leave
FACING = float(np.cos(np.deg2rad(45)))  # to the plane's normal: a leg's side is no floor
BEHIND_M = 0.05  # and farther lies behind a plane
MOST_BEHIND = 0.01  # share of all points around
FEWEST = 60  # points of a plane
LEAST_WIDTH_M = 0.15  # standard deviation of a plane's points the narrower way: of a strip half a meter wide
BEYOND_M = 0.25  # farther from the cloud than what a mask cut off,
LEAST_BEYOND = 0.3  # a floor or wall has such a share of its points
CONTINUES_M = 0.25  # so near the background's own points a plane goes on
NEIGHBORS = 12  # of a point, itself among them: its normal
TRIES, PLANES = 150, 8  # planes tried, at even steps; those found in turn, whether they bound the room or not
BOX_SLACK = 1.001  # times a reach: a box that rounding takes nothing from
JUDGES = 1500  # points at even steps that choose among the planes tried


@dataclass(frozen=True, kw_only=True)
class RoomPlane:
    """`normal · p = offset_m`, near the points of the background that lie on it; unit normal of either sign."""

    normal: Float[np.ndarray, "3"]
    offset_m: float
    points: Points

    def holds(self, points: Points, normals: Points, tolerance: float = 1.0) -> Bool[np.ndarray, " n"]:
        """Which points (with unit normals of either sign) lie on the plane, and where the background shows it.

        `tolerance`: share of `OFF_M`.
        """
        on = lies_on(points, normals, self.normal, self.offset_m, tolerance * OFF_M)
        if on.any():
            on[on] = np.isfinite(KDTree(self.points).query(points[on], distance_upper_bound=CONTINUES_M)[0])
        return on

    def is_near(self, points: Points) -> Bool[np.ndarray, " n"]:
        """Which points lie on the plane or hardly off it, whichever way they face: corners, too, where walls meet."""
        return np.abs(points @ self.normal - self.offset_m) < 2 * OFF_M


def room_planes(cloud: Points, background: Points | NearPoints, room: Points | NearPoints) -> list[RoomPlane]:
    """The planes that bound the room around a cloud; `room` is all of the scan, `background` what is no object.

    By cells (`NearPoints`) where many clouds are asked about.
    """
    tree = KDTree(cloud)
    near, around = (within(tree, p, AROUND_M) for p in (background, room))
    wide = (p for p in planes_of(near) if is_wide(p.points) and goes_on(p, tree))
    return [p for p in wide if behind(p, around) <= MOST_BEHIND]


def planes_of(points: Points) -> Iterator[RoomPlane]:
    """The planes with most points, one after the other: the best of those tried, then least squares."""
    if len(points) < FEWEST:
        return
    normals, free = across(points, points), np.ones(len(points), bool)
    for _ in range(PLANES):
        rows = np.flatnonzero(free)
        if len(rows) < FEWEST:
            return
        normal, offset = fullest_plane(points[rows], normals[rows])
        for _ in range(3):
            on = free & lies_on(points, normals, normal, offset)
            if on.sum() < FEWEST:
                return
            center = points[on].mean(axis=0)
            normal = np.linalg.eigh((points[on] - center).T @ (points[on] - center))[1][:, 0]
            offset = float(center @ normal)
        yield RoomPlane(normal=normal, offset_m=offset, points=points[on])
        free &= np.abs(points @ normal - offset) >= OFF_M


def fullest_plane(points: Points, normals: Points) -> tuple[Float[np.ndarray, "3"], float]:
    """Of the planes through some points, across their normals, the one that most points lie on."""
    tried, judges = (np.arange(0, len(points), -(-len(points) // n)) for n in (TRIES, JUDGES))
    offset = np.einsum("ti,ti->t", points[tried], normals[tried])
    near = np.abs(points[judges] @ normals[tried].T - offset) < OFF_M
    best = int((near & (np.abs(normals[judges] @ normals[tried].T) > FACING)).sum(axis=0).argmax())
    return normals[tried[best]], float(offset[best])


def lies_on(
    points: Points,
    normals: Points,
    normal: Float[np.ndarray, "3"],
    offset_m: float,
    off_m: float = OFF_M,
) -> Bool[np.ndarray, " n"]:
    """Which points lie near a plane and face along it."""
    return (np.abs(points @ normal - offset_m) < off_m) & (np.abs(normals @ normal) > FACING)


def is_wide(points: Points) -> bool:
    """Whether a plane's points spread in it both ways."""
    variance = np.linalg.eigvalsh(np.cov(points.T))
    return bool(np.sqrt(max(variance[1], 0.0)) >= LEAST_WIDTH_M)


def goes_on(plane: RoomPlane, tree: KDTree) -> bool:
    """Whether a plane goes on where the cloud ends; the rest of a tabletop that was cut off does not."""
    near = np.isfinite(
        tree.query(plane.points, distance_upper_bound=BEYOND_M, workers=threads_for(plane.points))[0]
    )
    return float((~near).mean()) >= LEAST_BEYOND


def behind(plane: RoomPlane, room: Points) -> float:
    """Share of the points behind a plane, on the side where fewer are."""
    height = room @ plane.normal - plane.offset_m
    return float(min((height < -BEHIND_M).mean(), (height > BEHIND_M).mean()))


def within(tree: KDTree, points: Points | NearPoints, reach_m: float) -> Points:
    """The points that lie so near those of a tree, in their order.

    Asked of the tree is only what lies in the box around it: scans of a building have a hundred times as much.
    """
    low, high = tree.mins - BOX_SLACK * reach_m, tree.maxes + BOX_SLACK * reach_m
    if isinstance(points, NearPoints):
        points = points.around_box(low, high)
    for axis in range(3):
        points = points[(points[:, axis] >= low[axis]) & (points[:, axis] <= high[axis])]
    return points[
        np.isfinite(tree.query(points, distance_upper_bound=reach_m, workers=threads_for(points))[0])
    ]


def on_planes(
    points: Points, planes: Sequence[RoomPlane], among: Points
) -> tuple[Bool[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Which points lie on any of the planes, and which do within half the tolerance.

    `among`: the cloud that they are part of, which tells how they face.
    """
    on, surely = np.zeros((2, len(points)), bool)
    if len(points) and planes:
        normals = across(points, among)
        for plane in planes:
            on |= plane.holds(points, normals)
            surely |= plane.holds(points, normals, 0.5)
    return on, surely


def across(points: Points, among: Points) -> Points:
    """Unit normals, of either sign, of the surface that a cloud has at some points, by their nearest neighbors."""
    count = min(NEIGHBORS, len(among))
    near = KDTree(among).query(points, k=count, workers=threads_for(points))[1].reshape(len(points), -1)
    centered = among[near] - among[near].mean(axis=1, keepdims=True)
    return np.linalg.eigh(np.einsum("nki,nkj->nij", centered, centered))[1][:, :, 0]
