"""A new scan against the objects known so far: who is who (paper §3.2), and where (paper §3.3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Float
from scipy.special import expit

from more2_jax.config import SceneConfig
from more2_jax.encoding import padded, stack, with_origin
from more2_jax.matching import match_instances
from more2_jax.metrics import apply_pose
from more2_jax.objects import Pose, last_center, observation_in, points_of
from more2_jax.prior import Prior
from more2_jax.registration import register, world_pose
from more2_jax.types import (
    Embedding,
    Instance,
    Observation,
    PointCloud,
    Registration,
    SceneObject,
    move_embedding,
)
from more2_jax.verification import Known, assign, interchangeable, pair_log_odds, unmatched


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


def match_scan(
    objects: Sequence[SceneObject],
    instances: Sequence[Instance],
    embeddings: Sequence[Embedding],
    config: SceneConfig,
) -> Identified:
    """One assignment of all objects, present or absent just now, to the instances of a scan."""
    if config.matching.verify:
        return verified(objects, instances, embeddings, config)
    old, real_old = stack([o.embedding for o in objects])
    new, real_new = stack(embeddings)
    bonus = np.zeros((len(real_old), len(real_new)), np.float32)
    bonus[: len(objects), : len(instances)] = -config.matching.motion_weight * distances(objects, instances)
    matches = match_instances(old, new, config.matching, real_old, real_new, bonus)
    index, score = np.asarray(matches.target_index), np.asarray(matches.score)
    pairs = [(k, int(index[k])) for k in range(len(objects)) if index[k] >= 0]
    return Identified(found=tuple(Found(object=k, instance=i, score=float(score[k])) for k, i in pairs))


def verified(
    objects: Sequence[SceneObject],
    instances: Sequence[Instance],
    embeddings: Sequence[Embedding],
    config: SceneConfig,
) -> Identified:
    """The assignment that geometry finds likeliest, with probabilities."""
    old = [last_seen(o)[0] for o in objects]
    new = [Known(points=i.points, embedding=e) for i, e in zip(instances, embeddings, strict=True)]
    odds = pair_log_odds(old, new, config)
    pairs = assign(odds, distances(objects, instances), config.matching.motion_weight)
    copies = interchangeable(odds, pairs)
    gone, fresh = unmatched(odds, pairs)
    found = tuple(
        Found(object=int(k), instance=int(i), score=float(expit(odds[k, i])), interchangeable=c)
        for (k, i), c in zip(pairs, copies, strict=True)
    )
    return Identified(found=found, gone=gone, new=fresh)


def distances(objects: Sequence[SceneObject], instances: Sequence[Instance]) -> Float[np.ndarray, "n m"]:
    """Metres between where every object was last seen and every instance, in the frame the scans share."""
    here = np.stack([last_center(o) for o in objects])
    there = np.stack([i.points.mean(axis=0) for i in instances])
    return np.linalg.norm(here[:, None] - there[None], axis=-1)


def last_seen(o: SceneObject) -> tuple[Known, Pose]:
    """All that was seen of an object, where it last stood, and the pose from there to its reference frame."""
    T_ref_last = o.observations[-1].T_ref_scan
    T_last_ref = np.linalg.inv(T_ref_last)
    turn = jaxlie.SE3.from_rotation(jaxlie.SO3.from_matrix(jnp.asarray(T_last_ref[:3, :3], jnp.float32)))
    moved = move_embedding(o.embedding, turn)  # about its origin, which moves along in float64
    origin = apply_pose(T_last_ref, np.asarray(o.embedding.origin)[None])[0]
    embedding = jax.tree.map(np.asarray, replace(moved, origin=origin))
    return Known(points=apply_pose(T_last_ref, o.points), embedding=embedding), T_ref_last


def target_of(o: SceneObject, config: SceneConfig) -> tuple[Known, Pose]:
    """What a new observation is laid onto: all seen so far, or (`paper`) the reference observation; and its frame."""
    if config.accumulate_target:
        return last_seen(o)
    reference = observation_in(o, o.reference_scan)
    if reference is None:
        raise ValueError(f"{o.id} has no observation in its reference scan {o.reference_scan}; needed one")
    return Known(points=points_of(o, reference), embedding=o.embedding), np.eye(4)


def register_scan(
    prior: Prior,
    objects: Sequence[SceneObject],
    instances: Sequence[Instance],
    embeddings: Sequence[Embedding],
    found: Sequence[Found],
    scan: int,
    config: SceneConfig,
) -> list[Observation]:
    """Registers all that was found in one call: an observation each."""
    if not found:
        return []
    known, frames = zip(*(target_of(objects[f.object], config) for f in found), strict=True)
    source = padded([instances[f.instance].points for f in found])
    target = padded([k.points for k in known])
    source_code = with_origin(stack([embeddings[f.instance] for f in found])[0], np.asarray(source.origin))
    target_code = with_origin(stack([k.embedding for k in known])[0], np.asarray(target.origin))
    result = register(prior, source, target, source_code, target_code, config.registration, config.upright)
    result = jax.device_get(result)
    return [
        _observation(result, n, source, target, frames[n], f, scan, instances[f.instance].id)
        for n, f in enumerate(found)
    ]


def _observation(
    result: Registration,
    n: int,
    source: PointCloud,
    target: PointCloud,
    T_ref_target: Pose,
    found: Found,
    scan: int,
    instance: int,
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
        T_ref_scan=T_ref_target @ pose,
        score=found.score,
        rms_m=float(result.rms_m[n]),
        converged=bool(result.converged[n]),
        interchangeable=found.interchangeable,
        sigma_m=float(sigma_m),
        sigma_deg=float(np.rad2deg(sigma_rad)),
    )
