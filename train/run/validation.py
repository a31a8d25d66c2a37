"""Scores of a prior on shapes it was not trained on: distance, sign, matching, orientation."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from more2_jax.geometry.full_precision import full_precision
from more2_jax.geometry.points import kabsch_rotation
from more2_jax.network.prior import Prior, points_read
from train.run.settings import TrainingConfig
from train.shards.losses import BARE, predict
from train.shards.sampling import TrainingSample, sample_batch
from train.shards.shards import Shapes

GROUP = 8  # objects a scene, for matching
MOST_VALIDATED = 192  # shapes
BATCH = 32


def validate(prior: Prior, shapes: Shapes, config: TrainingConfig) -> dict[str, float]:
    """Means over up to `MOST_VALIDATED` shapes, clean clouds of up to three views: the same samples at every call.

    Where the decoder looks up normals, `bare_*` are the scores of the same clouds without them, by the second decoder
    if there is one.
    """
    clean = dataclasses.replace(
        config,
        min_views=1,
        max_views=3,
        augment_probability=0.0,
        normals_unknown_probability=0.0,
        queries=1024,
    )
    count = min(MOST_VALIDATED, len(shapes.views)) // GROUP * GROUP
    batch = min(BATCH, count)
    rows = [
        _scores(prior, shapes, jnp.arange(i, i + batch), i, clean) for i in range(0, count - batch + 1, batch)
    ]
    return {k: float(jnp.mean(jnp.concatenate([r[k] for r in rows]))) for k in rows[0]}


def total_score(scores: dict[str, float]) -> float:
    """One figure to choose a checkpoint by: the mean of the shares that the three tasks live by."""
    return (scores["near_sign"] + scores["matching"] + scores["kabsch_10deg"]) / 3


def _scores(
    prior: Prior, shapes: Shapes, index: Array, seed: int, config: TrainingConfig
) -> dict[str, Array]:
    key = jax.random.fold_in(jax.random.key(1), seed)
    sample = jax.jit(sample_batch, static_argnames=("config", "points"))(
        key, shapes, index, config, points_read(prior.config)
    )
    return _sample_scores(prior, sample)


def field_scores(
    predicted: Float[Array, "b 2 q"], truth: Float[Array, "b 2 q"]
) -> dict[str, Float[Array, " b"]]:
    """Error of the distance, and share of right signs among the second half of the queries, near the surface."""
    sign = (predicted < 0) == (truth < 0)
    return {
        "sdf_l1": jnp.abs(predicted - truth).mean(axis=(1, 2)),
        "near_sign": sign[..., truth.shape[-1] // 2 :].mean(axis=(1, 2)),
    }


@jax.jit
@full_precision
def _sample_scores(prior: Prior, sample: TrainingSample) -> dict[str, Array]:
    embedding, predicted = predict(prior, sample, jax.random.key(0), train=False)
    if prior.config.decoder.normals and not prior.config.bare_decoder:
        blind = dataclasses.replace(sample, normals=jnp.zeros_like(sample.normals))
        predicted[BARE] = predict(prior, blind, jax.random.key(0), train=False)[1][""]
    scores = {
        f"{of}{k}": v for of, field in predicted.items() for k, v in field_scores(field, sample.sdf).items()
    }
    inv = embedding.inv / jnp.linalg.norm(embedding.inv, axis=-1, keepdims=True)
    inv = inv.reshape(-1, GROUP, *inv.shape[1:])
    cosine = jnp.einsum("gic,gjc->gij", inv[:, :, 0], inv[:, :, 1])
    rotation = jax.vmap(lambda e: kabsch_rotation(e[0].T, e[1].T).as_matrix())(embedding.eqv)
    trace = jnp.trace(rotation, axis1=-2, axis2=-1)
    angle_deg = jnp.rad2deg(jnp.arccos(jnp.clip((trace - 1) / 2, -1, 1)))
    return scores | {
        "matching": (jnp.argmax(cosine, axis=-1) == jnp.arange(GROUP)).reshape(-1),
        "kabsch_10deg": angle_deg < 10,
        "kabsch_deg": angle_deg,
        "scale": embedding.scale.mean(axis=1),
        "center": jnp.linalg.norm(embedding.center, axis=-1).mean(axis=1),
    }
