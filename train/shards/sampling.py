"""Training samples as a pure function of (key, shapes): partial clouds with real scans' flaws, and queries.

One shape at a time; vmap outside. Nothing here waits for the host, so that it also runs inside a training step.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int, Int8

from more2_jax.geometry.points import cleared, farthest_rows
from more2_jax.types import pytree
from train.shards.augmentation import (
    Chance,
    Cloud,
    Kept,
    add_junk,
    ball,
    depth_noise,
    flawed_normals,
    half_space,
    merge_views,
    start_far_out,
)
from train.shards.fusion_flaws import drifted, fused, point_noise
from train.shards.settings import NORMAL_STEPS, SampleConfig
from train.shards.shards import Shapes

Views = tuple[
    Float[Array, "v n 3"], Int8[Array, "v n 3"]
]  # points and normals of one shape, as shards hold them
LEAST_KEPT = 0.1  # of the points: a cloud of which cuts would leave less stays whole


@pytree
class TrainingSample:
    """Two partial clouds of one shape, in farthest-point order, and points of known signed distance.

    The frame is the shape's own, its center the origin. Nothing is shifted: the encoder centers its cloud itself, so a
    shift of everything would move F_c as much and change nothing else. What makes F_c learned is that partiality moves
    the mean of the cloud.
    """

    points: Float[Array, "*b 2 n 3"]  # canonical units
    normals: Float[Array, "*b 2 n 3"]  # unit, outward; zeros where not known
    mask: Bool[Array, "*b 2 n"]
    queries: Float[Array, "*b 2 q 3"]
    sdf: Float[Array, "*b 2 q"]


def sample_batch(
    key: Array, shapes: Shapes, index: Int[Array, " b"], config: SampleConfig, points: int
) -> TrainingSample:
    """Samples shapes `index`; sample i depends on (key, i) and on the shapes index[i] and index[i − 1] alone.

    `points` is the encoder's input size. Fragments that lie beside shape i are of shape i − 1 of the batch.
    """

    def one(row: Array, i: Array, j: Array) -> TrainingSample:
        pair = jax.random.split(jax.random.fold_in(key, row))
        return jax.vmap(lambda k: _half_sample(k, shapes, i, j, config, points))(pair)

    return jax.vmap(one)(jnp.arange(len(index)), index, jnp.roll(index, 1))


def _half_sample(
    key: Array, shapes: Shapes, index: Int[Array, ""], other: Int[Array, ""], config: SampleConfig, count: int
) -> TrainingSample:
    cloud_key, query_key = jax.random.split(key)
    seen = (shapes.views[index], shapes.normals[index]), (shapes.views[other], shapes.normals[other])
    points, normals, mask = partial_cloud(cloud_key, *seen, config, count, shapes.scanned[index])
    queries, sdf = _queries(query_key, shapes, index, config.queries)
    return TrainingSample(points=points, normals=normals, mask=mask, queries=queries, sdf=sdf)


def _queries(
    key: Array, shapes: Shapes, index: Int[Array, ""], count: int
) -> tuple[Float[Array, "q 3"], Float[Array, " q"]]:
    uniform_key, near_key = jax.random.split(key)
    half = (count // 2,)
    uniform = jax.random.randint(uniform_key, half, 0, shapes.sdf_uniform.shape[1])
    near = jax.random.randint(near_key, half, 0, shapes.sdf_near.shape[1])
    both = jnp.concatenate([shapes.sdf_uniform[index, uniform], shapes.sdf_near[index, near]])
    return both[:, :3].astype(jnp.float32), both[:, 3].astype(jnp.float32)


def partial_cloud(
    key: Array,
    seen: Views,
    other: Views,
    config: SampleConfig,
    count: int,
    scanned: Bool[Array, ""] | bool = False,
) -> tuple[Cloud, Cloud, Kept]:
    """A few views merged, noise, then cuts and junk; `count` points in farthest-point order, and their normals.

    Views that are `scanned` have flaws of their own: their points stay as they are.
    """
    keys, (views, outward) = jax.random.split(key, 7), seen
    open_to_flaws = jax.random.bernoulli(keys[0], config.augment_probability) & ~jnp.asarray(scanned)
    one_view = open_to_flaws * config.one_view_probability
    points, view, place = merge_views(
        keys[1], views, config.max_views, config.raw_points, one_view, config.min_views
    )
    points, lost = depth_noise(keys[2], points, view, config, open_to_flaws * config.depth_noise_probability)
    points, normals = with_fusion_flaws(key, points, unit(outward[view, place]), view, config, open_to_flaws)
    points = points + ~jnp.asarray(scanned) * point_noise(keys[3], points, config, open_to_flaws)
    kept = ~lost & ~half_space(keys[4], points, open_to_flaws * config.crop_probability)
    kept &= ~ball(keys[5], points, open_to_flaws * config.ball_probability)
    # A shelf seen edge-on fits into a ball. What is left of it has no size, and the logarithm of its scale no slope.
    kept = jnp.where(kept.sum() < LEAST_KEPT * len(points), True, kept)
    strange = other[0].reshape(-1, 3), unit(other[1]).reshape(-1, 3)
    points, normals, kept = add_junk(
        keys[6], points, normals, kept, strange, open_to_flaws * config.junk_probability
    )
    # A key of its own: points are what they are without normals.
    normals = flawed_normals(jax.random.fold_in(key, 7), normals, points, config, open_to_flaws)
    points, normals, kept = start_far_out(points, normals, kept)
    points, normals = cleared(points, kept), cleared(normals, kept)
    index, real = farthest_rows(points, kept, count)
    return points[index], normals[index], real


def with_fusion_flaws(
    key: Array,
    points: Cloud,
    normals: Cloud,
    view: Int[Array, " n"],
    config: SampleConfig,
    open_to_flaws: Chance,
) -> tuple[Cloud, Cloud]:
    """The flaws of fusion that the settings ask for; keys of their own, so that all else stays what it is."""
    drift_key, fusion_key = jax.random.fold_in(key, 8), jax.random.fold_in(key, 9)
    if config.drift_probability > 0:
        happens = open_to_flaws * config.drift_probability
        points, normals = drifted(drift_key, points, normals, view, config, happens)
    if config.fused_probability > 0:
        happens = open_to_flaws * config.fused_probability
        points, normals = fused(fusion_key, points, normals, config, happens)
    return points, normals


def unit(steps: Int8[Array, "*n 3"]) -> Float[Array, "*n 3"]:
    """Normals as shards hold them, to a byte's precision of unit length."""
    return steps.astype(jnp.float32) / NORMAL_STEPS
