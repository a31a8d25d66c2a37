"""Training samples as a pure function of (key, shapes): partial clouds with real scans' flaws, and queries.

One shape at a time; vmap outside. Nothing here waits for the host.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from more2_jax.config import TrainingConfig
from more2_jax.data.shards import Shapes
from more2_jax.geometry import farthest_points
from more2_jax.types import pytree

Cloud = Float[Array, "n 3"]
Kept = Bool[Array, " n"]


@pytree
class TrainingSample:
    """Two partial clouds of one shape, in farthest-point order, and points of known signed distance."""

    points: Float[Array, "*b 2 n 3"]
    mask: Bool[Array, "*b 2 n"]
    queries: Float[Array, "*b 2 q 3"]
    sdf: Float[Array, "*b 2 q"]


def sample_batch(
    key: Array, shapes: Shapes, index: Int[Array, " b"], config: TrainingConfig, points: int
) -> TrainingSample:
    """Samples shapes `index`; sample i depends on (key, i) alone. `points` is the encoder's input size."""
    keys = jax.vmap(lambda i: jax.random.fold_in(key, i))(jnp.arange(len(index)))
    others = shapes.views[jnp.roll(index, 1)]  # whose fragments may lie beside the shape
    return jax.vmap(lambda k, i, other: _sample(k, shapes, i, other, config, points))(keys, index, others)


def _sample(
    key: Array, shapes: Shapes, index: Int[Array, ""], other: Array, config: TrainingConfig, count: int
) -> TrainingSample:
    cloud_key, query_key = jax.random.split(key)
    views = shapes.views[index]
    points, mask = jax.vmap(lambda k: partial_cloud(k, views, other, config, count))(
        jax.random.split(cloud_key)
    )
    query, sdf = jax.vmap(lambda k: _queries(k, shapes, index, config.queries))(jax.random.split(query_key))
    return TrainingSample(points=points, mask=mask, queries=query, sdf=sdf)


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
    key: Array, views: Float[Array, "v n 3"], other: Array, config: TrainingConfig, count: int
) -> tuple[Cloud, Kept]:
    """A few views merged, noise, then cuts and junk; `count` points in farthest-point order."""
    keys = jax.random.split(key, 5)
    points = merge_views(keys[0], views, config.max_views, config.raw_points)
    points = points + config.noise * jax.random.normal(keys[1], points.shape)
    kept = ~half_space(keys[2], points, config.crop_probability)
    kept &= ~ball(keys[3], points, config.ball_probability)
    points, kept = add_junk(keys[4], points, kept, other, config.junk_probability)
    return farthest_points(*start_far_out(points, kept), count)


def merge_views(key: Array, views: Float[Array, "v n 3"], max_views: int, count: int) -> Cloud:
    """`count` points drawn from 1 to `max_views` random views."""
    number_key, view_key, row_key, point_key = jax.random.split(key, 4)
    number = jax.random.randint(number_key, (), 1, max_views + 1)
    chosen = jax.random.randint(view_key, (max_views,), 0, views.shape[0])
    view = chosen[jax.random.randint(row_key, (count,), 0, number)]
    return views[view, jax.random.randint(point_key, (count,), 0, views.shape[1])].astype(jnp.float32)


def half_space(key: Array, points: Cloud, probability: float) -> Kept:
    """True beyond a random plane that cuts off 5 to 40 % of the points, with `probability`."""
    happens_key, direction_key, share_key = jax.random.split(key, 3)
    along = points @ jax.random.normal(direction_key, (3,))
    share = jax.random.uniform(share_key, minval=0.6, maxval=0.95)
    return (along > jnp.quantile(along, share)) & jax.random.bernoulli(happens_key, probability)


def ball(key: Array, points: Cloud, probability: float) -> Kept:
    """True in a ball about a random point, with `probability`."""
    happens_key, center_key, radius_key = jax.random.split(key, 3)
    center = points[jax.random.randint(center_key, (), 0, len(points))]
    radius = jax.random.uniform(radius_key, minval=0.05, maxval=0.2)
    near = jnp.sum((points - center) ** 2, axis=-1) < radius**2
    return near & jax.random.bernoulli(happens_key, probability)


def add_junk(key: Array, points: Cloud, kept: Kept, other: Array, probability: float) -> tuple[Cloud, Kept]:
    """Replaces up to 15 % of the rows by a fragment of another shape, or by a patch of floor."""
    happens_key, kind_key, count_key, fragment_key, floor_key = jax.random.split(key, 5)
    fragment = _fragment(fragment_key, points, other.reshape(-1, 3).astype(jnp.float32))
    junk = jnp.where(jax.random.bernoulli(kind_key), fragment, _floor(floor_key, points))
    share = jax.random.uniform(count_key, maxval=0.15) * jax.random.bernoulli(happens_key, probability)
    is_junk = jnp.arange(len(points)) < share * len(points)
    return jnp.where(is_junk[:, None], junk, points), kept | is_junk


def _fragment(key: Array, points: Cloud, other: Cloud) -> Cloud:
    from_key, to_key, shift_key, pick_key = jax.random.split(key, 4)
    center = other[jax.random.randint(from_key, (), 0, len(other))]
    offset = other[jax.random.randint(pick_key, (len(points),), 0, len(other))] - center
    # Points far from the fragment's centre are pulled in along their ray, so that all lie within 0.15.
    length = jnp.linalg.norm(offset, axis=-1, keepdims=True)
    offset = offset * jnp.minimum(1.0, 0.15 / jnp.maximum(length, 1e-6))
    beside = points[jax.random.randint(to_key, (), 0, len(points))]
    return beside + 0.15 * jax.random.normal(shift_key, (3,)) + offset


def _floor(key: Array, points: Cloud) -> Cloud:
    low, high = points.min(axis=0), points.max(axis=0)
    spread = jax.random.uniform(key, points.shape, minval=-0.1, maxval=1.1)
    return (low + spread * (high - low)).at[:, 2].set(low[2])


def start_far_out(points: Cloud, kept: Kept) -> tuple[Cloud, Kept]:
    """Copies the kept point farthest from the mean to row 0, where farthest-point sampling starts."""
    weight = kept / jnp.maximum(kept.sum(), 1)
    distance = jnp.where(kept, jnp.sum((points - weight @ points) ** 2, axis=-1), -1.0)
    first = jnp.argmax(distance)
    return points.at[0].set(points[first]), kept.at[0].set(True)
