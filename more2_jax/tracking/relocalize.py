"""Where the objects found in a new scan are now (paper §3.3), and the frame of the scan by what stayed in it."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import jax
import numpy as np
from jaxtyping import Float

from more2_jax.config import EvidenceMatcher, SceneConfig
from more2_jax.geometry.poses import Points, Pose, local_poses
from more2_jax.geometry.transform import transform
from more2_jax.network.prior import Prior
from more2_jax.registration.pair_batch import PairBatch, local_batch, pair_up
from more2_jax.registration.register_pairs import register
from more2_jax.tracking.identify import Found, Identified
from more2_jax.tracking.objects import accumulated_normals, accumulated_points, observation_in, place_of
from more2_jax.tracking.scan_frame import settled_frame
from more2_jax.types import Frame, Instance, Observation, ObservedObject, Registration, SceneObject, Sight

PAIR_MB = 2  # of a pair ready to be registered: both clouds, codes, and what sensors saw (1.2 MB)


def known_object(
    o: SceneObject, sight: Sight | None, config: SceneConfig, around: Points | None = None
) -> tuple[ObservedObject, Pose]:
    """An object as a new scan is compared with it, in the scene's frame, and the pose from there to its own frame.

    All seen so far where it last stood, or (`accumulate_target` False) the reference observation.
    """
    if config.accumulate_target:
        points, normals = accumulated_points(o), accumulated_normals(o)
        T_scene_ref = place_of(o.observations[-1])
    else:
        reference = observation_in(o, o.reference_scan)
        if reference is None:
            raise ValueError(
                f"{o.id} has no observation in its reference scan {o.reference_scan}; needed one"
            )
        rows, T_scene_ref = o.point_scan == reference.scan, place_of(reference)
        points, normals = o.points[rows], None if o.normals is None else o.normals[rows]
    own = ObservedObject(
        points=points, embedding=o.embedding, color=o.color, sight=sight, normals=normals, around=around
    )
    return transform(own, T_scene_ref), np.linalg.inv(T_scene_ref)


def pairs_found(
    identified: Identified,
    old: Sequence[ObservedObject],
    new: Sequence[ObservedObject],
    found: Sequence[Found] | None = None,
) -> PairBatch:
    """The pairs of a scan to register, with the poses that matching found of them; of those `found`, by default all."""
    found, T = identified.found if found is None else found, identified.frame.T_scene_scan
    if identified.aligned is not None:
        pairs = identified.aligned.take([(f.object, f.instance) for f in found])
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
    objects: Sequence[SceneObject],
    old: Sequence[tuple[ObservedObject, Pose]],
    instances: Sequence[Instance],
    new: Sequence[ObservedObject],
    identified: Identified,
    scan: int,
    config: SceneConfig,
) -> tuple[list[Observation], Frame]:
    """Registers all that was found, and settles the frame of the scan by what stayed in it: an observation each.

    If that changes the frame, the poses are refined once more: "it did not move" is another pose then.
    """
    found, frame = identified.found, identified.frame
    if not found:
        return [], frame
    result, T_scene_scan = registered(prior, identified, old, new, config, frame)
    if isinstance(config.matching, EvidenceMatcher):
        frame = settled(objects, old, found, T_scene_scan, result, frame, new, config)
        if not np.array_equal(frame.T_scene_scan, identified.frame.T_scene_scan):
            result, T_scene_scan = registered(prior, identified, old, new, config, frame)
    return [
        observation(
            result, n, old[f.object][1] @ T_scene_scan[n], f, scan, instances[f.instance].id, frame, config
        )
        for n, f in enumerate(found)
    ], frame


def registered(
    prior: Prior,
    identified: Identified,
    old: Sequence[tuple[ObservedObject, Pose]],
    new: Sequence[ObservedObject],
    config: SceneConfig,
    frame: Frame,
) -> tuple[Registration, Float[np.ndarray, "p 4 4"]]:
    """All that was found registered, `frame` being the scan's; and the poses of instances in the scene's frame.

    In batches of as many pairs as `config.memory_mb` holds.
    """
    known, found, parts = [o for o, _ in old], identified.found, list[tuple[Registration, np.ndarray]]()
    at_once = max(1, config.memory_mb // PAIR_MB)
    for start in range(0, len(found), at_once):
        pairs = pairs_found(identified, known, new, found[start : start + at_once])
        if frame is not identified.frame:
            pairs = with_frame(pairs, frame.T_scene_scan)
        result = jax.device_get(register(prior, pairs, config.registration, config.motion))
        parts.append((result, pairs.to_world(result.T_target_source)))
    return parts[0] if len(parts) == 1 else jax.tree.map(lambda *x: np.concatenate(x), *parts)


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


def observation(
    result: Registration,
    n: int,
    T_ref_scan: Pose,
    found: Found,
    scan: int,
    instance: int,
    frame: Frame,
    config: SceneConfig,
) -> Observation:
    """Pair `n` of a registration as an observation of its object."""
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
        accumulated=misfit <= config.accumulate_misfit,
    )
