"""A new scan against the objects known so far: who is who (paper §3.2), and where (paper §3.3)."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from more2_jax.config import SceneConfig
from more2_jax.encoding import at_zero, padded, stack, with_origin
from more2_jax.matching import match_instances
from more2_jax.objects import last_center, observation_in, points_of
from more2_jax.prior import Prior
from more2_jax.registration import pairwise_misfit, register, world_pose
from more2_jax.types import Embedding, Instance, Observation, PointCloud, Registration, SceneObject

Found = tuple[int, int, float]  # object, instance, score of the match


def match_scan(
    objects: Sequence[SceneObject],
    instances: Sequence[Instance],
    embeddings: Sequence[Embedding],
    config: SceneConfig,
) -> list[Found]:
    """One assignment of all objects, present or absent just now, to the instances of a scan."""
    old, real_old = stack([o.embedding for o in objects])
    new, real_new = stack(embeddings)
    bonus = -config.matching.motion_weight * distances(objects, instances, (len(real_old), len(real_new)))
    if config.matching.misfit_weight:
        bonus -= config.matching.misfit_weight * misfits(objects, instances, old, new, config)
    matches = match_instances(old, new, config.matching, real_old, real_new, bonus)
    index, score = np.asarray(matches.target_index), np.asarray(matches.score)
    return [(k, int(index[k]), float(score[k])) for k in range(len(objects)) if index[k] >= 0]


def distances(
    objects: Sequence[SceneObject], instances: Sequence[Instance], shape: tuple[int, int]
) -> Float[np.ndarray, "n m"]:
    """Metres between where every object was last seen and every instance, in the frame the scans share."""
    here = np.stack([last_center(o) for o in objects])
    there = np.stack([i.points.mean(axis=0) for i in instances])
    result = np.zeros(shape, np.float32)
    result[: len(here), : len(there)] = np.linalg.norm(here[:, None] - there[None], axis=-1)
    return result


def misfits(
    objects: Sequence[SceneObject],
    instances: Sequence[Instance],
    old: Embedding,
    new: Embedding,
    config: SceneConfig,
) -> Float[np.ndarray, "n m"]:
    """`pairwise_misfit` of every instance with every object; 1 at most, so that one bad pair decides nothing else."""
    source, target = (
        padded([i.points for i in instances]),
        padded([target_points(o, config) for o in objects]),
    )
    codes = [at_zero(with_origin(e, np.asarray(c.origin))) for e, c in ((new, source), (old, target))]
    flat = [dataclasses.replace(c, origin=jnp.zeros((len(c.points), 3))) for c in (source, target)]
    return np.minimum(pairwise_misfit(*flat, *codes, config.registration, config.upright), 1.0)


def target_points(o: SceneObject, config: SceneConfig) -> Float[np.ndarray, "n 3"]:
    """What a new observation is laid onto: all seen so far, or (`paper`) the reference observation."""
    if config.accumulate_target:
        return o.points
    reference = observation_in(o, o.reference_scan)
    if reference is None:
        raise ValueError(f"{o.id} has no observation in its reference scan {o.reference_scan}; needed one")
    return points_of(o, reference)


def register_scan(
    prior: Prior,
    objects: Sequence[SceneObject],
    instances: Sequence[Instance],
    embeddings: Sequence[Embedding],
    pairs: Sequence[Found],
    scan: int,
    config: SceneConfig,
) -> list[tuple[int, int, Observation]]:
    """Registers all pairs in one call; a pair that no pose explains (`reject_residual`) is not one object."""
    if not pairs:
        return []
    source = padded([instances[i].points for _, i, _ in pairs])
    target = padded([target_points(objects[k], config) for k, _, _ in pairs])
    source_code = with_origin(stack([embeddings[i] for _, i, _ in pairs])[0], np.asarray(source.origin))
    target_code = with_origin(
        stack([objects[k].embedding for k, _, _ in pairs])[0], np.asarray(target.origin)
    )
    result = register(prior, source, target, source_code, target_code, config.registration, config.upright)
    result = jax.device_get(result)
    limit = _largest_residual(target, config)
    return [
        (k, i, _observation(result, n, source, target, scan, instances[i].id, score))
        for n, (k, i, score) in enumerate(pairs)
        if result.rms_m[n] <= limit[n]
    ]


def _largest_residual(target: PointCloud, config: SceneConfig) -> Float[np.ndarray, " b"]:
    points, mask = np.asarray(target.points), np.asarray(target.mask)
    radius = np.linalg.norm(np.where(mask[..., None], points, 0), axis=-1).max(axis=-1)
    return (config.matching.reject_residual or np.inf) * radius


def _observation(
    result: Registration,
    n: int,
    source: PointCloud,
    target: PointCloud,
    scan: int,
    instance: int,
    score: float,
) -> Observation:
    """Pair `n` of a registration, in the scans' own frames."""
    T = jax.tree.map(lambda x: x[n], result.T_target_source)
    return Observation(
        scan=scan,
        instance=instance,
        T_ref_scan=world_pose(T, np.asarray(target.origin)[n], np.asarray(source.origin)[n]),
        score=score,
        rms_m=float(result.rms_m[n]),
        converged=bool(result.converged[n]),
    )
