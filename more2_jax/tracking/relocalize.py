"""Where the objects found in a new scan are now (paper §3.3), and the frame of the scan by what stayed in it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from functools import lru_cache, partial

import jax
import numpy as np
from jaxtyping import Float, Int

from more2_jax.config import EvidenceMatcher, SceneConfig, SurfaceRegistration
from more2_jax.freed_memory import give_back
from more2_jax.geometry.poses import Points, Pose, apply_pose, local_poses
from more2_jax.geometry.transform import transform
from more2_jax.matching.places import share_on
from more2_jax.network.prior import Prior
from more2_jax.registration.pair_batch import PairBatch, local_batch, pair_up
from more2_jax.registration.pose_costs import asks_sensors
from more2_jax.registration.register_pairs import register
from more2_jax.tracking.identify import NO_ROOMS, Found, Identified
from more2_jax.tracking.object_views import Views
from more2_jax.tracking.objects import (
    accumulated_normals,
    accumulated_points,
    observation_in,
    place_of,
    seen_again,
)
from more2_jax.tracking.rooms import Rooms
from more2_jax.tracking.scan_frame import settled_frame
from more2_jax.tracking.scan_noise import with_noise
from more2_jax.tracking.still_standing import apart, standing
from more2_jax.types import Frame, Instance, Observation, ObservedObject, Registration, SceneObject, Sight

Sides = tuple[list[ObservedObject], list[ObservedObject]]  # objects, and instances of a new scan
Registered = tuple[Registration, Float[np.ndarray, "_ 4 4"], Float[np.ndarray, "_ 4 4"]]

SAME = 1e-4  # of entries of a pose in meters: "it did not move", but for rounding
PAIR_MB = 2  # of a pair ready to be registered: both clouds, codes, and what sensors saw (1.2 MB)
PAIRS_AT_ONCE = 32  # at most, whatever memory there is: more are not faster
# Of all that is known of an object: if a scan shows so much again, what else it shows belongs to it, however badly a
# sliver and the whole fit both ways (docs/developing/notebook/accumulation.md).
SHOWN_AGAIN = 0.9


def known_object(
    o: SceneObject, sight: Sight | None, config: SceneConfig, around: Points | None = None
) -> tuple[ObservedObject, Pose]:
    """An object as a new scan is compared with it, in the scene's frame, and the pose from there to its own frame.

    All seen so far where it last stood, or (`accumulate_target` False) the reference observation.
    """
    points, normals, T_scene_ref = accumulated_points(o), accumulated_normals(o), compared_at(o, config)
    if not config.accumulate_target:
        rows = o.point_scan == o.reference_scan
        points, normals = o.points[rows], None if o.normals is None else o.normals[rows]
    own = ObservedObject(
        points=points, embedding=o.embedding, color=o.color, sight=sight, normals=normals, around=around
    )
    if np.array_equal(T_scene_ref, np.eye(4)):
        return own, T_scene_ref  # no copy of what did not move since it was first seen
    return transform(own, T_scene_ref), np.linalg.inv(T_scene_ref)


def compared_at(o: SceneObject, config: SceneConfig) -> Pose:
    """T_scene_ref of an object as a new scan is compared with it. Raises ValueError without a reference observation."""
    if config.accumulate_target:
        return place_of(o.observations[-1])
    reference = observation_in(o, o.reference_scan)
    if reference is None:
        raise ValueError(f"{o.id} has no observation in its reference scan {o.reference_scan}; needed one")
    return place_of(reference)


def pairs_found(
    identified: Identified,
    old: Sequence[ObservedObject],
    new: Sequence[ObservedObject],
    found: Sequence[Found] | None = None,
) -> PairBatch:
    """The pairs of a scan to register, with the poses that matching found of them; of those `found`, by default all."""
    found, T = identified.found if found is None else found, identified.frame.T_scene_scan
    if identified.aligned is not None:
        pairs = identified.aligned.take([(f.object, f.instance) for f in found], (new, old))
        return with_frame(pairs, T)
    source, target = (
        local_batch(side) for side in ([new[f.instance] for f in found], [old[f.object] for f in found])
    )
    return pair_up(source, target, T)


def with_frame(pairs: PairBatch, T_scene_scan: Pose) -> PairBatch:
    """The pairs, "it did not move" being what another frame of the scan makes of it."""
    origins = [np.asarray(side.origin, np.float64) for side in (pairs.target, pairs.source)]
    T = np.broadcast_to(T_scene_scan, (len(pairs), 4, 4))
    return dataclasses.replace(pairs, stayed=local_poses(T, *origins))


def relocalize(
    prior: Prior,
    views: Views,
    old: Sequence[tuple[ObservedObject, Pose]],
    new: Sequence[ObservedObject],
    identified: Identified,
    scan: int,
    config: SceneConfig,
    rooms: Rooms = NO_ROOMS,
) -> tuple[list[Observation], Frame]:
    """Registers all that was found, and settles the frame of the scan by what stayed in it: an observation each.

    `views`: the objects and the scan's instances, and what sensors saw of them. If the frame changes by that, all poses
    are refined once more: "it did not move" is another pose then.
    """
    found, frame = identified.found, identified.frame
    if not found:
        return [], frame
    known = [o for o, _ in old]
    sides = lru_cache(maxsize=1)(partial(with_views, known, new, config, views))  # asked twice in a new frame
    placed = registered(prior, identified, sides, config, frame)
    if isinstance(config.matching, EvidenceMatcher):
        frame = settled(views.objects, old, found, placed[2], placed[0], frame, new, config)
        if not np.array_equal(frame.T_scene_scan, identified.frame.T_scene_scan):
            frame = with_noise(frame, rooms.scene_surfaces, rooms.scan)
            placed = registered(prior, identified, sides, config, frame)
    rows = standing_in_place(known, new, found, placed[1], frame, rooms, config)
    result, T_scene_scan, _ = held_in_rows(prior, identified, sides, config, frame, placed, rows)

    def seen(n: int, f: Found) -> Observation:
        T, instance = T_scene_scan[n], views.instances[f.instance].id
        again = shows_again(known[f.object], new[f.instance], T)
        return observation(result, n, old[f.object][1] @ T, f, scan, instance, frame, again, config)

    return [seen(n, f) for n, f in enumerate(found)], frame


def standing_in_place(
    old: Sequence[ObservedObject],
    new: Sequence[ObservedObject],
    found: Sequence[Found],
    T_scene_scan: Float[np.ndarray, "p 4 4"],
    frame: Frame,
    rooms: Rooms,
    config: SceneConfig,
) -> Int[np.ndarray, " q"]:
    """Which of the pairs found are `standing`, though registration moved them in their place.

    `T_scene_scan`: poses of instances by registration.
    """
    method = config.registration
    if not isinstance(method, SurfaceRegistration) or not method.try_stayed:
        return np.zeros(0, int)
    known, shown = ([o.points for o in side] for side in (old, new))
    rows = [
        n
        for n, f in enumerate(found)
        if not np.allclose(T_scene_scan[n], frame.T_scene_scan, atol=SAME)
        and not apart(known[f.object], apply_pose(frame.T_scene_scan, shown[f.instance]))
    ]
    stand = [np.zeros(0, bool)]
    for start in range(0, len(rows), PAIRS_AT_ONCE):  # what lies about every pair is held at once
        some = rows[start : start + PAIRS_AT_ONCE]
        pairs = [(found[n].object, found[n].instance) for n in some]
        stand.append(standing(known, shown, pairs, T_scene_scan[some], frame, rooms))
    return np.array(rows, int)[np.concatenate(stand)]


def registered(
    prior: Prior,
    identified: Identified,
    sides: Callable[[tuple[Found, ...]], Sides],
    config: SceneConfig,
    frame: Frame,
    *,
    stands: bool = False,
) -> Registered:
    """All that was found registered, `frame` being the scan's; and the poses of instances in the scene's frame.

    Last the same poses aligned, where "it did not move" was taken as it is: else each would only confirm the frame.
    In batches of as many pairs as `config.memory_mb` holds. `sides`: objects and instances, some with what sensors saw
    of them. `stands`: whether all are `standing`.
    """
    found, parts = identified.found, list[Registered]()
    at_once = min(PAIRS_AT_ONCE, max(1, config.memory_mb // PAIR_MB))
    for start in range(0, len(found), at_once):
        some = found[start : start + at_once]
        pairs = pairs_found(identified, *sides(some), some)
        if frame is not identified.frame:
            pairs = with_frame(pairs, frame.T_scene_scan)
        if stands:
            pairs = dataclasses.replace(pairs, stands=np.ones(len(pairs), bool))
        result = jax.device_get(register(prior, pairs, config.registration, config.motion))
        T, aligned = result.T_target_source, result.aligned
        parts.append((result, pairs.to_world(T), pairs.to_world(T if aligned is None else aligned)))
        del pairs  # what sensors saw of the next ones takes its place
        give_back(len(found))
    return parts[0] if len(parts) == 1 else jax.tree.map(lambda *x: np.concatenate(x), *parts)


def held_in_rows(
    prior: Prior,
    identified: Identified,
    sides: Callable[[tuple[Found, ...]], Sides],
    config: SceneConfig,
    frame: Frame,
    placed: Registered,
    rows: Int[np.ndarray, " q"],
) -> Registered:
    """What is registered, the pairs in some rows once more as what is `standing`."""
    if not len(rows):
        return placed
    some = dataclasses.replace(identified, found=tuple(identified.found[n] for n in rows))
    others = registered(prior, some, sides, config, frame, stands=True)

    def put(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        x = np.array(x)
        x[rows] = y[: len(rows)]
        return x

    return jax.tree.map(put, placed, others)


def with_views(
    old: Sequence[ObservedObject],
    new: Sequence[ObservedObject],
    config: SceneConfig,
    views: Views,
    found: Sequence[Found],
) -> Sides:
    """The objects and instances, those of `found` with what sensors saw of them where registration asks for it."""
    old, new, method = list(old), list(new), config.registration
    if not isinstance(method, SurfaceRegistration) or not asks_sensors(method.search, config.motion):
        return old, new
    rows, columns = [f.object for f in found], [f.instance for f in found]
    for k, sight in zip(rows, views.of_objects(rows), strict=True):
        there = None if sight is None else transform(sight, compared_at(views.objects[k], config))
        old[k] = dataclasses.replace(old[k], sight=there)
    for i, sight in zip(columns, views.of_instances(columns), strict=True):
        new[i] = dataclasses.replace(new[i], sight=sight)
    return old, new


def settled(
    objects: Sequence[SceneObject],
    old: Sequence[tuple[ObservedObject, Pose]],
    found: Sequence[Found],
    T_scene_new: Float[np.ndarray, "p 4 4"],
    result: Registration,
    frame: Frame,
    new: Sequence[ObservedObject],
    config: SceneConfig,
) -> Frame:
    """The frame by the registered pairs: what stayed since it was last seen says where the scan lies."""
    T_scene_scan = [
        place_of(objects[f.object].observations[-1]) @ old[f.object][1] @ T
        for f, T in zip(found, T_scene_new, strict=True)
    ]
    centers = np.stack([new[f.instance].points.mean(axis=0) for f in found])
    sigma_m = [position_sigma(result, n) for n in range(len(found))]
    return settled_frame(frame, T_scene_scan, centers, sigma_m, config.motion)


def position_sigma(result: Registration, n: int) -> float:
    """Standard error of where pair `n` was put, meters; 0 where registration has none."""
    if result.covariance is None:
        return 0.0
    return float(np.sqrt(np.diagonal(np.asarray(result.covariance)[n])[:3].sum()))


def shows_again(old: ObservedObject, new: ObservedObject, T_scene_scan: Pose) -> bool:
    """Whether an instance shows nearly all that is known of an object, placed where that is."""
    return share_on(old.points, apply_pose(T_scene_scan, new.points)) >= SHOWN_AGAIN


def observation(
    result: Registration,
    n: int,
    T_ref_scan: Pose,
    found: Found,
    scan: int,
    instance: int,
    frame: Frame,
    shown_again: bool,
    config: SceneConfig,
) -> Observation:
    """Pair `n` of a registration as an observation of its object.

    One that fits badly is no part of the object's shape, unless all that is known is `shown_again`.
    """
    turn_sigma = 0.0
    if result.covariance is not None:
        turn_sigma = float(np.sqrt(np.diagonal(np.asarray(result.covariance)[n])[3:].sum()))
    misfit = 0.0 if result.misfit is None else float(result.misfit[n])
    return Observation(
        scan=scan,
        instance=instance,
        T_ref_scan=T_ref_scan,
        score=found.score,
        rms_m=float(result.rms_m[n]),
        converged=bool(result.converged[n]),
        interchangeable=found.interchangeable,
        sigma_m=position_sigma(result, n),
        sigma_deg=float(np.rad2deg(turn_sigma)),
        frame=frame,
        misfit=misfit,
        accumulated=shown_again or misfit <= config.accumulate_misfit,
    )


def with_observations(
    objects: Sequence[SceneObject],
    instances: Sequence[Instance],
    found: Sequence[Found],
    seen: Sequence[Observation],
) -> list[SceneObject]:
    """The objects, those found with what the scan shows of them."""
    known = list(objects)
    for f, observation in zip(found, seen, strict=True):
        known[f.object] = seen_again(known[f.object], instances[f.instance], observation)
    return known


def accumulated_rows(found: Sequence[Found], seen: Sequence[Observation]) -> list[int]:
    """Rows of the objects whose shape an observation adds to."""
    return [f.object for f, s in zip(found, seen, strict=True) if s.accumulated]
