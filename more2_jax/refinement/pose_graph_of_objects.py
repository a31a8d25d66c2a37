"""Every object's observations laid onto one another at once, before its mesh is made: records to batches, and back."""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from more2_jax.config import ClosingConfig, SceneConfig
from more2_jax.geometry.outliers import inliers
from more2_jax.geometry.padding import bucket
from more2_jax.geometry.poses import Pose
from more2_jax.meshing.extract import lowest_height, surface_through
from more2_jax.meshing.observed_surface import SeenSurface, some_of
from more2_jax.network.prior import Prior
from more2_jax.refinement.joint_of_objects import embed_accumulated, repose
from more2_jax.refinement.pose_graph import Sides, close_poses
from more2_jax.tracking.object_views import seen_from
from more2_jax.tracking.objects import accumulated, accumulated_points
from more2_jax.types import ScanRecord, SceneObject

MOST_SEEN = 8192  # points of an observation that planes are laid through
MOST_OBSERVATIONS = 32  # of an object: its first, and the last of the others; more stay as registered


def close_objects(
    prior: Prior,
    objects: Sequence[SceneObject],
    chosen: Sequence[int],
    scans: Sequence[ScanRecord],
    floors: Mapping[int, float | None],
    config: SceneConfig,
) -> list[SceneObject]:
    """The `chosen` objects with poses of their observations that agree with one another, the first held.

    `floors`: the height of each chosen object's floor in its frame, meters, None where it is not known. What was seen
    has no sides where meshes are not drawn to it (`meshing.seen_reach` 0); then all stays as it is. Where codes are of
    all that was accumulated, they are made anew.
    """
    result = list(objects)
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        sides = list(
            pool.map(lambda k: list(sides_seen(prior, objects[k], scans, floors[k], config)), chosen)
        )
    alike: dict[int, list[int]] = defaultdict(list)  # by the number of observations, padded
    for n, seen in enumerate(sides):
        alike[bucket(len(seen), 2)].append(n)
    for most, rows in alike.items():
        batch = gather([sides[n] for n in rows], most, config.closing.points)
        moved = jax.device_get(close_poses(batch, config.closing, config.upright))
        for n, moves in zip(rows, moved, strict=False):  # without the batch's filling
            most = most_turn_deg(sides[n], config.closing)
            result[chosen[n]] = moved_by(objects[chosen[n]], moves, most)
    return embed_accumulated(prior, result, chosen) if config.accumulate_target else result


def few(o: SceneObject) -> list[int]:
    """Which of an object's accumulated observations are laid onto one another, its reference first."""
    count = len(accumulated(o))
    return [0, *range(max(1, count - MOST_OBSERVATIONS + 1), count)]


def sides_seen(
    prior: Prior, o: SceneObject, scans: Sequence[ScanRecord], floor: float | None, config: SceneConfig
) -> Iterator[SeenSurface | None]:
    """What each of these observations saw, as planes with an outside, by its own points alone."""
    points, eyes, seen = accumulated_points(o), seen_from(o, scans), accumulated(o)
    scan = o.point_scan[np.isin(o.point_scan, [s.scan for s in seen])]
    for k in few(o):
        own = np.flatnonzero(scan == seen[k].scan)
        own = some_of(own, MOST_SEEN)
        own = own[inliers(points[own], config.meshing.outlier_factor)]
        there = None if eyes is None else eyes[own]
        lowest = lowest_height(o.embedding, floor)
        yield surface_through(prior, o.embedding, points[own], config.meshing, lowest, there)


def most_turn_deg(seen: Sequence[SeenSurface | None], config: ClosingConfig) -> float:
    """By how much an observation of an object may turn: among noise it may have slipped, as it may where half of the
    observations or fewer are exact; what fits exact points better is right."""
    exact = [s.exact for s in seen if s is not None]
    return np.inf if 2 * sum(exact) > len(exact) else config.most_turn_deg


def gather(rows: Sequence[Sequence[SeenSurface | None]], most: int, size: int) -> Sides:
    """Observations of several objects as one batch: `size` points each, `most` of an object."""
    count = bucket(len(rows))
    points, normals = np.zeros((2, count, most, size, 3), np.float32)
    mask = np.zeros((count, most, size), bool)
    for n, row in enumerate(rows):
        for j, seen in enumerate(row):
            if seen is not None:
                kept = some_of(np.arange(len(seen.points)), size)
                points[n, j, : len(kept)], normals[n, j, : len(kept)] = seen.points[kept], seen.normal[kept]
                mask[n, j, : len(kept)] = True
    roughness = np.zeros(count, np.float32)
    for n, row in enumerate(rows):
        roughness[n] = np.median([seen.roughness for seen in row if seen is not None] or [0.0])
    whole = Sides(points=points, normals=normals, mask=mask, roughness=roughness)  # type: ignore[arg-type]
    return jax.tree.map(jnp.asarray, whole)


def moved_by(o: SceneObject, moves: np.ndarray, most_turn_deg: float) -> SceneObject:
    """The object with its observations moved, in canonical units about its center; its cloud follows.

    A move that is not finite, or turns farther than `most_turn_deg`, is none: poses are made better here, not found.
    """
    scale = float(o.embedding.scale)
    center = o.embedding.scan_center()
    poses: list[Pose] = [seen.T_ref_scan for seen in accumulated(o)]
    for j, k in enumerate(few(o)):
        T = np.asarray(moves[j], np.float64)
        if not j or not np.isfinite(T).all():
            continue
        turn = Rotation.from_matrix(T[:3, :3])
        if turn.magnitude() <= np.deg2rad(most_turn_deg):
            T[:3, :3] = turn.as_matrix()  # to the last bit of float64, however often poses are closed
            T[:3, 3] = scale * T[:3, 3] + center - T[:3, :3] @ center
            poses[k] = T @ poses[k]
    return repose(o, poses)
