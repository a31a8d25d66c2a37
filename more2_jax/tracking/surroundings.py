"""What scans show around an object, neither floor nor wall: what a mask that is cut leaves behind, and its neighbors.

Beyond the paper, which takes masks as true. An object's own points are compared with the other's points and with what
lies around those: half a table is explained by a whole one where the other half lies in the background, or in a mask
of its own.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial

import numpy as np
from scipy.spatial import KDTree

from more2_jax.geometry.near_points import Made, NearClouds, NearPoints
from more2_jax.geometry.poses import Points, apply_pose
from more2_jax.geometry.room_planes import AROUND_M, BOX_SLACK, room_planes, within
from more2_jax.network.remembered_rows import digest, once
from more2_jax.tracking.objects import accumulated, points_of
from more2_jax.tracking.scan_nearby import shown_near
from more2_jax.types import ScanRecord, SceneObject

REACH = 0.5  # shares of an object's radius: what lies so near may be a part of it
LEAST_REACH_M = 0.2
OTHER_POINTS = 500  # of another object, about as dense as a scan's background is remembered
NOTHING = np.zeros((0, 3))


def surroundings_of_objects(objects: Sequence[SceneObject], scans: Sequence[ScanRecord]) -> list[Points]:
    """Around every object where its accumulated observations saw it, in its own frame."""
    found: list[list[Points]] = [[NOTHING] for _ in objects]
    for scan in scans:
        there = [
            (k, seen) for k, o in enumerate(objects) for seen in accumulated(o) if seen.scan == scan.index
        ]
        near = shown_around([partial(points_of, objects[k], seen) for k, seen in there], scan.background)
        for (k, seen), points in zip(there, near, strict=True):
            found[k].append(apply_pose(seen.T_ref_scan, points))
    return [np.concatenate(parts) for parts in found]


def surroundings(clouds: Sequence[Points], background: Points) -> list[Points]:
    """What lies around each of a scan's clouds: the background that is neither floor nor wall, and the other clouds."""
    return list(shown_around([partial(np.asarray, c) for c in clouds], background))


def shown_around(clouds: Sequence[Made], background: Points) -> Iterator[Points]:
    """`surroundings` of clouds that are made when they are asked for, one after the other."""
    if not clouds:
        return
    scan, few = NearClouds(clouds, background), [thinned(cloud()) for cloud in clouds]
    others, owner = np.concatenate(few), np.repeat(np.arange(len(few)), [len(c) for c in few])
    near_others, told = NearPoints(others), np.frombuffer(digest([background]), np.uint8)
    for k, room in enumerate(shown_near(clouds, scan, AROUND_M)):
        cloud = clouds[k]()
        # All of the scan is the same, however its masks are joined or divided.
        near = once(background_around, (cloud, told), cloud, scan.rest, room)
        reach = BOX_SLACK * reach_m(cloud)
        rows = near_others.rows_around_box(cloud.min(axis=0) - reach, cloud.max(axis=0) + reach)
        beside = within(KDTree(cloud), others[rows[owner[rows] != k]], reach_m(cloud))
        yield np.concatenate([near, beside])


def thinned(cloud: Points) -> Points:
    """At most `OTHER_POINTS` points, at even steps."""
    return cloud[:: max(1, -(-len(cloud) // OTHER_POINTS))]


def background_around(cloud: Points, background: NearPoints, room: NearPoints) -> Points:
    """Points of the background near a cloud, without floor and walls; `room` is all of the scan around it."""
    near = within(KDTree(cloud), background, reach_m(cloud))
    for plane in room_planes(cloud, background, room):
        near = near[~plane.is_near(near)]
    return near


def around(cloud: Points, background: NearPoints, others: Points, room: NearPoints) -> Points:
    """Points near a cloud, of the background without floor and walls, and of others; `room` is all of the scan."""
    beside = within(KDTree(cloud), others, reach_m(cloud))
    return np.concatenate([background_around(cloud, background, room), beside])


def reach_m(cloud: Points) -> float:
    """How near to a cloud lies what may be a part of it."""
    radius = float(np.linalg.norm(cloud - cloud.mean(axis=0), axis=1).max())
    return max(REACH * radius, LEAST_REACH_M)
