"""Flaws of real scans, put into training clouds (paper §3.1): pure functions of (key, cloud), one cloud at a time.

Lengths in canonical units (longest edge 0.9); each flaw happens with a probability that may be traced. No rotation:
the encoder is equivariant, a turned cloud gives turned features, so turning teaches it nothing.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int

from train.shards.settings import SampleConfig
from train.shards.view_directions import DISTANCE, HALF_FIELD, view_directions

Cloud = Float[Array, "n 3"]
Kept = Bool[Array, " n"]
Seen = tuple[Float[Array, "m 3"], Float[Array, "m 3"]]  # points of a shape, and the unit normals there
Chance = float | Float[Array, ""]

MOST_JUNK = 0.15  # share of the rows
FRAGMENT_POOL = 2048  # points of the other shape among which a fragment is sought
EDGE_CELLS = 24  # a side of the image, for the shadows of nearer surfaces
EDGE_JUMP = 0.1  # a point so far behind another of its cell stands at a depth edge


def merge_views(
    key: Array,
    views: Float[Array, "v n 3"],
    max_views: int,
    count: int,
    one_view: Chance = 0.0,
    min_views: int = 1,
) -> tuple[Cloud, Int[Array, " n"], Int[Array, " n"]]:
    """`count` points drawn from `min_views` to `max_views` random views, and view and place there of each.

    `one_view`: the probability of just one.
    """
    number_key, view_key, row_key, point_key, one_key = jax.random.split(key, 5)
    number = jax.random.randint(number_key, (), min_views, max_views + 1)
    number = jnp.where(jax.random.bernoulli(one_key, one_view), 1, number)
    chosen = jax.random.randint(view_key, (max_views,), 0, views.shape[0])
    view = chosen[jax.random.randint(row_key, (count,), 0, number)]
    point = jax.random.randint(point_key, (count,), 0, views.shape[1])
    return views[view, point].astype(jnp.float32), view, point


def depth_noise(
    key: Array, points: Cloud, view: Int[Array, " n"], config: SampleConfig, probability: Chance
) -> tuple[Cloud, Kept]:
    """Points as a depth camera at their view's eye measures them, and True where it measures nothing.

    Inverse depth gets noise (`depth_noise`) and is rounded to `depth_step`, as a disparity is: along the ray, the
    error grows with the square of the depth. A point behind a nearer surface of its image cell lies in the shadow
    at a depth edge, and is lost.
    """
    happens_key, noise_key = jax.random.split(key)
    toward = jnp.asarray(view_directions(), jnp.float32)[view]
    ray = points - DISTANCE * toward
    depth = -jnp.sum(ray * toward, axis=-1)
    disparity = 1 / depth + config.depth_noise * jax.random.normal(noise_key, depth.shape)
    measured = 1 / (jnp.maximum(jnp.round(disparity / config.depth_step), 1.0) * config.depth_step)
    noisy = DISTANCE * toward + ray * (measured / depth)[:, None]
    happens = jax.random.bernoulli(happens_key, probability)
    return jnp.where(happens, noisy, points), behind_an_edge(points, view) & happens


def behind_an_edge(points: Cloud, view: Int[Array, " n"]) -> Kept:
    """True for points more than `EDGE_JUMP` behind another point of the same view in the same image cell."""
    toward = view_directions()
    across = np.cross(toward, np.where(np.abs(toward[:, 2:]) < 0.95, [0.0, 0, 1], [1.0, 0, 0]))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    frame = np.stack([across, np.cross(across, toward), -toward], axis=1).astype(np.float32)
    offset = points - jnp.asarray(DISTANCE * toward, jnp.float32)[view]
    x, y, depth = jnp.moveaxis(jnp.sum(jnp.asarray(frame)[view] * offset[:, None], axis=-1), -1, 0)
    column, row = (
        jnp.clip((a / depth / HALF_FIELD + 1) / 2 * EDGE_CELLS, 0, EDGE_CELLS - 1).astype(int) for a in (x, y)
    )
    cell = (view * EDGE_CELLS + row) * EDGE_CELLS + column
    front = jax.ops.segment_min(depth, cell, num_segments=len(toward) * EDGE_CELLS**2)
    return depth > front[cell] + EDGE_JUMP


def half_space(key: Array, points: Cloud, probability: Chance) -> Kept:
    """True beyond a random plane that cuts off 5 to 40 % of the points, with `probability`."""
    happens_key, direction_key, share_key = jax.random.split(key, 3)
    along = points @ jax.random.normal(direction_key, (3,))
    share = jax.random.uniform(share_key, minval=0.6, maxval=0.95)
    return (along > jnp.quantile(along, share)) & jax.random.bernoulli(happens_key, probability)


def ball(key: Array, points: Cloud, probability: Chance) -> Kept:
    """True in a ball of radius 0.05 to 0.2 about a random point, with `probability`."""
    happens_key, center_key, radius_key = jax.random.split(key, 3)
    center = points[jax.random.randint(center_key, (), 0, len(points))]
    radius = jax.random.uniform(radius_key, minval=0.05, maxval=0.2)
    near = jnp.sum((points - center) ** 2, axis=-1) < radius**2
    return near & jax.random.bernoulli(happens_key, probability)


def add_junk(
    key: Array, points: Cloud, normals: Cloud, kept: Kept, other: Seen, probability: Chance
) -> tuple[Cloud, Cloud, Kept]:
    """Replaces up to 15 % of the rows by a piece of another shape or by a patch of floor or wall, one half each.

    Junk has its own true normals, as in a scan: it is not told by them.
    """
    happens_key, kind_key, count_key, fragment_key, plane_key = jax.random.split(key, 5)
    most = fragment_rows(len(points))
    fragment = local_piece(fragment_key, points, *other, most)
    patch = plane_patch(plane_key, points, most)
    is_fragment = jax.random.bernoulli(kind_key)
    junk, of_junk = (jnp.where(is_fragment, a, b) for a, b in zip(fragment, patch, strict=True))
    share = jax.random.uniform(count_key, maxval=MOST_JUNK) * jax.random.bernoulli(happens_key, probability)
    is_junk = jnp.arange(len(points)) < share * len(points)

    def mixed(rows: Cloud, of_junk: Cloud) -> Cloud:
        return rows.at[:most].set(jnp.where(is_junk[:most, None], of_junk, rows[:most]))

    return mixed(points, junk), mixed(normals, of_junk), kept | is_junk


def fragment_rows(rows: int) -> int:
    """Rows that junk may take at most."""
    return int(np.ceil(MOST_JUNK * rows))


def local_piece(
    key: Array, points: Cloud, other: Float[Array, "m 3"], normals: Float[Array, "m 3"], count: int
) -> tuple[Float[Array, "count 3"], Float[Array, "count 3"]]:
    """The `count` points of `other` nearest to a random one of them, nearest first, moved beside `points`.

    Their normals, too. They are sought among `FRAGMENT_POOL` random points of it (all, if there are no more).
    """
    from_key, to_key, shift_key, pool_key = jax.random.split(key, 4)
    if len(other) > FRAGMENT_POOL:
        pool = jax.random.randint(pool_key, (FRAGMENT_POOL,), 0, len(other))
        other, normals = other[pool], normals[pool]
    other = other.astype(jnp.float32)
    offset = other - other[jax.random.randint(from_key, (), 0, len(other))]
    _, nearest = jax.lax.top_k(-jnp.sum(offset * offset, axis=-1), min(count, len(other)))
    beside = points[jax.random.randint(to_key, (), 0, len(points))]
    piece = beside + 0.15 * jax.random.normal(shift_key, (3,)) + offset[nearest]
    return jnp.resize(piece, (count, 3)), jnp.resize(normals[nearest], (count, 3))


def plane_patch(
    key: Array, points: Cloud, count: int
) -> tuple[Float[Array, "count 3"], Float[Array, "count 3"]]:
    """A rectangle of floor (half the time) or of an upright wall that touches the cloud from outside; z is up.

    Also its normal at every point, which faces the cloud.
    """
    kind_key, turn_key, beside_key, size_key, place_key = jax.random.split(key, 5)
    turn = jax.random.uniform(turn_key, maxval=2 * jnp.pi)
    across = jnp.stack([jnp.cos(turn), jnp.sin(turn), 0.0])
    level = jnp.stack([-jnp.sin(turn), jnp.cos(turn), 0.0])
    up = jnp.array([0.0, 0.0, 1.0])
    floor = jax.random.bernoulli(kind_key)
    outward, second = jnp.where(floor, -up, across), jnp.where(floor, across, up)
    beside = points[jax.random.randint(beside_key, (), 0, len(points))]
    center = beside + outward * ((points - beside) @ outward).max()
    half = jax.random.uniform(size_key, (2,), minval=0.1, maxval=0.5)
    place = half * jax.random.uniform(place_key, (count, 2), minval=-1.0, maxval=1.0)
    patch = center + place[:, :1] * level + place[:, 1:] * second
    return patch, jnp.broadcast_to(-outward, patch.shape)


def flawed_normals(
    key: Array, normals: Cloud, points: Cloud, config: SampleConfig, open_to_flaws: Chance
) -> Cloud:
    """Normals as fused scans give them: tilted, some inward, some or all of them not known (zeros)."""
    keys = jax.random.split(key, 8)
    tilt = jnp.deg2rad(config.normal_noise_deg) * jax.random.uniform(keys[0], minval=0.3, maxval=1.7)
    tilted = normals + tilt * jax.random.normal(keys[1], normals.shape)
    tilted /= jnp.sqrt(jnp.maximum(jnp.sum(tilted**2, axis=-1, keepdims=True), 1e-12))
    inward = ball(keys[2], points, open_to_flaws * config.flip_probability)
    inward ^= jax.random.bernoulli(keys[3], open_to_flaws * config.flipped, inward.shape)
    share = jax.random.bernoulli(keys[4], open_to_flaws * config.normals_lost_probability)
    lost = jax.random.bernoulli(keys[5], share * jax.random.uniform(keys[6], maxval=0.5), inward.shape)
    lost |= jax.random.bernoulli(keys[7], config.normals_unknown_probability)
    lost |= ~jnp.any(normals != 0, axis=-1)
    return jnp.where(lost[:, None], 0.0, jnp.where(inward[:, None], -tilted, tilted))


def start_far_out(points: Cloud, normals: Cloud, kept: Kept) -> tuple[Cloud, Cloud, Kept]:
    """Copies the kept point farthest from the mean to row 0, where farthest-point sampling starts."""
    weight = kept / jnp.maximum(kept.sum(), 1)
    distance = jnp.where(kept, jnp.sum((points - weight @ points) ** 2, axis=-1), -1.0)
    first = jnp.argmax(distance)
    points, normals = (rows.at[0].set(rows[first]) for rows in (points, normals))
    return points, normals, kept.at[0].set(True)
