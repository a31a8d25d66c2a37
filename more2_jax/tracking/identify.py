"""A new scan against the objects known so far: who is who (paper §3.2), and where (paper §3.3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import jax
import numpy as np
from jaxtyping import Float
from scipy.special import expit

from more2_jax.config import SceneConfig
from more2_jax.geometry.free_space import padded_sights
from more2_jax.geometry.poses import Pose, apply_pose, world_pose
from more2_jax.geometry.transform import moved
from more2_jax.matching.assignment import assign, interchangeable, unmatched
from more2_jax.matching.code_assignment import match_instances
from more2_jax.matching.color import color_of
from more2_jax.network.embedding_batch import padded, stack, with_origin
from more2_jax.network.prior import Prior
from more2_jax.registration.register import register
from more2_jax.tracking.objects import (
    SCENE_FRAME,
    accumulated_points,
    last_center,
    observation_in,
    place_of,
    points_of,
)
from more2_jax.tracking.scan_frame import Rooms, common_frame, settled_frame
from more2_jax.types import (
    Embedding,
    Frame,
    Instance,
    Observation,
    ObservedObject,
    PointCloud,
    Registration,
    SceneObject,
)

NO_ROOMS = Rooms()


@dataclass(frozen=True, kw_only=True)
class Found:
    """An instance of a scan that is an object known before."""

    object: int
    instance: int
    score: float  # `paper`: H; `robust`: probability of being one object
    interchangeable: bool = False  # another assignment explains the scans as well: identical copies


@dataclass(frozen=True, kw_only=True)
class Identified:
    """Who is who in a scan. What is left over has a probability only where geometry was asked (`robust`)."""

    found: tuple[Found, ...] = ()
    gone: dict[int, float] = field(default_factory=dict)  # object → probability that it is not in the scan
    new: dict[int, float] = field(default_factory=dict)  # instance → probability that it is no known object
    frame: Frame = SCENE_FRAME  # of the scan


def match_scan(
    prior: Prior,
    objects: Sequence[SceneObject],
    instances: Sequence[Instance],
    embeddings: Sequence[Embedding],
    config: SceneConfig,
    rooms: Rooms = NO_ROOMS,
) -> Identified:
    """One assignment of all objects, present or absent just now, to the instances of a scan."""
    if config.matching.verify:
        return verified(prior, objects, instances, embeddings, config, rooms)
    old, real_old = stack([o.embedding for o in objects])
    new, real_new = stack(embeddings)
    bonus = np.zeros((len(real_old), len(real_new)), np.float32)
    centers = np.stack([i.points.mean(axis=0) for i in instances])
    bonus[: len(objects), : len(instances)] = -config.matching.motion_weight * distances(objects, centers)
    matches = match_instances(old, new, config.matching, real_old, real_new, bonus)
    index, score = np.asarray(matches.target_index), np.asarray(matches.score)
    pairs = [(k, int(index[k])) for k in range(len(objects)) if index[k] >= 0]
    return Identified(found=tuple(Found(object=k, instance=i, score=float(score[k])) for k, i in pairs))


def verified(
    prior: Prior,
    objects: Sequence[SceneObject],
    instances: Sequence[Instance],
    embeddings: Sequence[Embedding],
    config: SceneConfig,
    rooms: Rooms,
) -> Identified:
    """The assignment that geometry finds likeliest, with probabilities, and the frame of the scan."""
    old = [last_seen(o)[0] for o in objects]
    new = [
        ObservedObject(points=i.points, embedding=e, color=color_of(i.colors))
        for i, e in zip(instances, embeddings, strict=True)
    ]
    frame, fits = common_frame(prior, old, new, config, rooms)
    odds = fits.odds
    centers = apply_pose(frame.T_scene_scan, np.stack([i.points.mean(axis=0) for i in instances]))
    pairs = assign(odds, distances(objects, centers), config.matching.motion_weight)
    copies = interchangeable(odds, pairs)
    gone, fresh = unmatched(odds, pairs)
    found = tuple(
        Found(object=int(k), instance=int(i), score=float(expit(odds[k, i])), interchangeable=c)
        for (k, i), c in zip(pairs, copies, strict=True)
    )
    return Identified(found=found, gone=gone, new=fresh, frame=frame)


def distances(objects: Sequence[SceneObject], centers: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, "n m"]:
    """Meters between where every object was last seen and the instances' `centers`, in the scene's frame."""
    here = np.stack([last_center(o) for o in objects])
    return np.linalg.norm(here[:, None] - centers[None], axis=-1)


def last_seen(o: SceneObject) -> tuple[ObservedObject, Pose]:
    """All accumulated of an object, where it last stood in the scene, and the pose from there to its own frame."""
    T_scene_ref = place_of(o.observations[-1])
    known = ObservedObject(points=accumulated_points(o), embedding=o.embedding, color=o.color, sight=o.sight)
    return moved(known, T_scene_ref), np.linalg.inv(T_scene_ref)


def target_of(o: SceneObject, config: SceneConfig) -> tuple[ObservedObject, Pose]:
    """What a new observation is laid onto: all seen so far, or (`paper`) the reference observation; and its frame."""
    if config.accumulate_target:
        return last_seen(o)
    reference = observation_in(o, o.reference_scan)
    if reference is None:
        raise ValueError(f"{o.id} has no observation in its reference scan {o.reference_scan}; needed one")
    T_scene_ref = reference.frame.T_scene_scan
    known = ObservedObject(points=points_of(o, reference), embedding=o.embedding)
    return moved(known, T_scene_ref), np.linalg.inv(T_scene_ref)


def register_scan(
    prior: Prior,
    objects: Sequence[SceneObject],
    instances: Sequence[Instance],
    embeddings: Sequence[Embedding],
    found: Sequence[Found],
    scan: int,
    config: SceneConfig,
    frame: Frame = SCENE_FRAME,
) -> list[Observation]:
    """Registers all that was found in one call: an observation each. `frame`: of the scan and its embeddings."""
    if not found:
        return []
    new = [
        ObservedObject(points=i.points, embedding=e, sight=i.sight)
        for i, e in ((instances[f.instance], embeddings[f.instance]) for f in found)
    ]
    here = [moved(k, frame.T_scene_scan) for k in new]
    known, frames = zip(*(target_of(objects[f.object], config) for f in found), strict=True)
    source = padded([k.points for k in here])
    target = padded([k.points for k in known])
    source_code = with_origin(stack([k.embedding for k in here])[0], np.asarray(source.origin))
    target_code = with_origin(stack([k.embedding for k in known])[0], np.asarray(target.origin))
    result = register(
        prior,
        source,
        target,
        source_code,
        target_code,
        config.registration,
        config.upright,
        source_sight=padded_sights([k.sight for k in here], np.asarray(source.origin)),
        target_sight=padded_sights([k.sight for k in known], np.asarray(target.origin)),
    )
    result = jax.device_get(result)
    return [
        _observation(result, n, source, target, frames[n], f, scan, instances[f.instance].id, frame)
        for n, f in enumerate(found)
    ]


def register_in_frame(
    prior: Prior,
    objects: Sequence[SceneObject],
    instances: Sequence[Instance],
    embeddings: Sequence[Embedding],
    identified: Identified,
    scan: int,
    config: SceneConfig,
) -> tuple[list[Observation], Frame]:
    """Registers all that was found, and settles the frame of the scan by what stayed in it.

    If that changes the frame, all is registered again: "it did not move" is another pose then.
    """
    found, frame = identified.found, identified.frame
    seen = register_scan(prior, objects, instances, embeddings, found, scan, config, frame)
    if not config.matching.verify or not seen:
        return seen, frame
    places = [
        place_of(objects[f.object].observations[-1]) @ s.T_ref_scan for f, s in zip(found, seen, strict=True)
    ]
    centers = np.stack([instances[f.instance].points.mean(axis=0) for f in found])
    settled = settled_frame(frame, places, centers, [s.sigma_m for s in seen], config.upright)
    if not np.array_equal(settled.T_scene_scan, frame.T_scene_scan):
        seen = register_scan(prior, objects, instances, embeddings, found, scan, config, settled)
    return [
        replace(s, frame=settled, accumulated=s.misfit <= config.accumulate_misfit) for s in seen
    ], settled


def _observation(
    result: Registration,
    n: int,
    source: PointCloud,
    target: PointCloud,
    T_ref_target: Pose,
    found: Found,
    scan: int,
    instance: int,
    frame: Frame,
) -> Observation:
    """Pair `n` of a registration, in the scans' own frames."""
    T = jax.tree.map(lambda x: x[n], result.T_target_source)
    sigma_m = sigma_rad = 0.0
    if result.covariance is not None:
        variance = np.diagonal(np.asarray(result.covariance)[n])
        sigma_m, sigma_rad = np.sqrt(variance[:3].sum()), np.sqrt(variance[3:].sum())
    pose = world_pose(T, np.asarray(target.origin)[n], np.asarray(source.origin)[n])
    return Observation(
        scan=scan,
        instance=instance,
        T_ref_scan=T_ref_target @ pose @ frame.T_scene_scan,
        score=found.score,
        rms_m=float(result.rms_m[n]),
        converged=bool(result.converged[n]),
        interchangeable=found.interchangeable,
        sigma_m=float(sigma_m),
        sigma_deg=float(np.rad2deg(sigma_rad)),
        frame=frame,
        misfit=0.0 if result.misfit is None else float(result.misfit[n]),
    )
