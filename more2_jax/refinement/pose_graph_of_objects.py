"""Pose-graph optimization of accumulated objects, before their meshes are made: batches of them, and back."""

from __future__ import annotations

import dataclasses
import os
from collections import defaultdict
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from more2_jax.config import SceneConfig
from more2_jax.geometry.observations import seen_from, with_poses
from more2_jax.geometry.outliers import inliers
from more2_jax.geometry.padding import bucket
from more2_jax.geometry.poses import Pose
from more2_jax.meshing.extract import GRADIENT_CHUNK, lowest_height, observed_surface
from more2_jax.meshing.object_mesh import object_floor
from more2_jax.meshing.observed_surface import ObservedSurface, uniform_subsample
from more2_jax.network.embedding_batch import SMALLEST_BATCH, embed
from more2_jax.network.prior import Prior
from more2_jax.network.row_map import chunked
from more2_jax.refinement.pose_graph import OrientedObservations, optimize_pose_graphs
from more2_jax.types import AccumulatedObject

# Of an observation: points that planes are laid through (4,096 leave poses of exact points twice as far off, see "What
# a mesh costs" in docs/developing/notebook/speed_scene.md), and of these the ones that are compared with the other
# observations'.
SURFACE_POINTS, COMPARED_POINTS = 8192, 1024
SLOPES_ASKED = GRADIENT_CHUNK  # points: one call of the prior on CPUs
MAX_OBSERVATIONS = 32  # of an object: its first, and the last of the others; more stay as registered
MIN_OBSERVATIONS = 4  # of the padded batch: objects seen two to four times share one compiled program
OBJECTS_A_CALL = (
    1  # optimized together: on a CPU one after the other, so that nothing is worked on to fill a call
)
# Poses are made better here, not found: among noise an observation that would turn farther has slipped along the
# others (docs/developing/notebook/pose_graph.md has a table of such limits).
MAX_TURN_DEG = 3.0


def refine_object_poses(
    prior: Prior, objects: Sequence[AccumulatedObject], config: SceneConfig
) -> list[AccumulatedObject]:
    """The objects with poses of their observations that agree with one another, the first held.

    Without `meshing.mls_bandwidth` there are no planes to compare; then all stays as it is. Where codes are of all
    that was accumulated, they are made anew.
    """
    result = list[AccumulatedObject]()
    for start in range(0, len(objects), SMALLEST_BATCH):
        result += with_poses_refined(prior, objects[start : start + SMALLEST_BATCH], config)
    if not (config.accumulate_target and result):
        return result
    codes = embed(prior, [o.points for o in result], [o.normals for o in result])
    return [dataclasses.replace(o, embedding=code) for o, code in zip(result, codes, strict=True)]


def with_poses_refined(
    prior: Prior, objects: Sequence[AccumulatedObject], config: SceneConfig
) -> list[AccumulatedObject]:
    """A few of the objects with poses that agree: what planes and batches take of memory does not grow with a scene."""
    result = list(objects)
    several = [n for n, o in enumerate(objects) if len(o.poses) > 1]  # one observation agrees with itself
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        found = pool.map(lambda n: list(observation_surfaces(prior, objects[n], config)), several)
        surfaces = dict(zip(several, found, strict=True))
    batches: dict[int, list[int]] = defaultdict(list)  # by the number of observations, padded
    for n, row in surfaces.items():
        batches[bucket(len(row), MIN_OBSERVATIONS)].append(n)
    for count, rows in batches.items():
        batch = oriented_batch([surfaces[n] for n in rows], count)
        optimized = partial(optimize_pose_graphs, steps=config.pose_graph.steps, motion=config.motion)
        for n, motions in zip(rows, chunked(optimized, OBJECTS_A_CALL, batch), strict=True):
            result[n] = with_motions(objects[n], motions, max_turn_deg(surfaces[n]))
    return result


def optimized_observations(o: AccumulatedObject) -> list[int]:
    """Which of an object's observations are optimized, its first one first."""
    count = len(o.poses)
    return [0, *range(max(1, count - MAX_OBSERVATIONS + 1), count)]


def observation_surfaces(
    prior: Prior, o: AccumulatedObject, config: SceneConfig
) -> Iterator[ObservedSurface | None]:
    """Oriented planes of what each of these observations saw, by its own points alone."""
    sensors, lowest = seen_from(o), lowest_height(o.embedding, object_floor(o, config))
    for k in optimized_observations(o):
        own = uniform_subsample(np.flatnonzero(o.observation == k), SURFACE_POINTS)
        own = own[inliers(o.points[own], config.meshing.outlier_factor)]
        eyes = None if sensors is None else sensors[own]
        sides = None if o.normals is None else o.normals[own]
        yield observed_surface(
            prior, o.embedding, o.points[own], config.meshing, lowest, eyes, sides, SLOPES_ASKED
        )


def max_turn_deg(surfaces: Sequence[ObservedSurface | None]) -> float:
    """By how much an observation of an object may turn: any angle, if most of the observations have no noise.

    What fits exact points better is right; among noise it may have slipped.
    """
    noiseless = [s.noiseless for s in surfaces if s is not None]
    return np.inf if 2 * sum(noiseless) > len(noiseless) else MAX_TURN_DEG


def oriented_batch(rows: Sequence[Sequence[ObservedSurface | None]], most: int) -> OrientedObservations:
    """Observations of several objects as one padded batch: `COMPARED_POINTS` each, `most` of an object."""
    shape = (len(rows), most, COMPARED_POINTS)
    points, normals = np.zeros((2, *shape, 3), np.float32)
    mask, residual = np.zeros(shape, bool), np.zeros(shape[0], np.float32)
    for n, row in enumerate(rows):
        there = [(j, surface) for j, surface in enumerate(row) if surface is not None]
        residual[n] = np.median([surface.residual for _, surface in there] or [0.0])
        for j, surface in there:
            kept = uniform_subsample(np.arange(len(surface.points)), COMPARED_POINTS)
            points[n, j, : len(kept)], normals[n, j, : len(kept)] = surface.points[kept], surface.normal[kept]
            mask[n, j, : len(kept)] = True
    return OrientedObservations(points=points, normals=normals, mask=mask, residual=residual)  # type: ignore[arg-type]


def with_motions(o: AccumulatedObject, motions: np.ndarray, max_turn_deg: float) -> AccumulatedObject:
    """The object with its observations moved, in canonical units about its center; its cloud follows.

    A motion that is not finite, or turns farther than `max_turn_deg`, is none.
    """
    scale = float(o.embedding.scale)
    center = o.embedding.scan_center()
    poses: list[Pose] = list(o.poses)
    for j, k in enumerate(optimized_observations(o)):
        T = np.asarray(motions[j], np.float64)
        if not j or not np.isfinite(T).all():
            continue
        turn = Rotation.from_matrix(T[:3, :3])
        if turn.magnitude() <= np.deg2rad(max_turn_deg):
            T[:3, :3] = turn.as_matrix()  # to the last bit of float64, however often poses are optimized
            T[:3, 3] = scale * T[:3, 3] + center - T[:3, :3] @ center
            poses[k] = T @ poses[k]
    return with_poses(o, poses)
