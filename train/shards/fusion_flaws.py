"""Flaws of scans that are fused from many depth images: drifted views, surfaces that wave, what voxels blur, noise.

Pure functions of (key, cloud), one cloud at a time, as in `augmentation`. Unlike noise of single points, these errors
are shared by neighbors: a decoder that trusts single points learns here not to.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, Int

from train.shards.augmentation import Chance, Cloud
from train.shards.settings import SampleConfig
from train.shards.view_directions import VIEWS

WAVES = 12  # summed
WAVELENGTH = (0.25, 1.0)  # canonical units
SWELL, SWELL_SPREAD = 0.7, 0.6  # shift outward of a whole surface, mean and spread, in sizes of its waves
VARIES = (0.2, 1.8)  # a cloud's own share of a configured size, least and most


def drifted(
    key: Array,
    points: Cloud,
    normals: Cloud,
    view: Int[Array, " n"],
    config: SampleConfig,
    probability: Chance,
) -> tuple[Cloud, Cloud]:
    """Points and normals of every view shifted and turned about the origin by that view's own small motion."""
    happens_key, size_key, shift_key, turn_key = jax.random.split(key, 4)
    size = own_share(size_key) * jax.random.bernoulli(happens_key, probability)
    shift = size * config.drift * jax.random.normal(shift_key, (VIEWS, 3))
    turn = size * jnp.deg2rad(config.drift_deg) * jax.random.normal(turn_key, (VIEWS, 3))
    moved = points + shift[view] + jnp.cross(turn[view], points)
    turned = normals + jnp.cross(
        turn[view], normals
    )  # of first order; `flawed_normals` makes them unit again
    return moved, turned


def fused(
    key: Array, points: Cloud, normals: Cloud, config: SampleConfig, probability: Chance
) -> tuple[Cloud, Cloud]:
    """Points and normals as fusion on a grid of voxels leaves them: waved, then blurred within cells."""
    happens_key, size_key, wave_key, cell_key, offset_key = jax.random.split(key, 5)
    happens = jax.random.bernoulli(happens_key, probability)
    new = waved(wave_key, points, normals, config.fused * own_share(size_key))
    cell = config.voxel * own_share(cell_key)
    new = clustered(*new, cell, cell * jax.random.uniform(offset_key, (3,)))
    moved, turned = (jnp.where(happens, a, b) for a, b in zip(new, (points, normals), strict=True))
    return moved, turned


def waved(key: Array, points: Cloud, normals: Cloud, size: Chance) -> tuple[Cloud, Cloud]:
    """Points moved along their normals by a smooth random field, and the normals of the surface so bent.

    The field is a constant, more often outward, and waves of `WAVELENGTH` of standard deviation `size`. Its slope
    bends the normals: n − ∇w, less its part along n. Normals of zeros, not known, stay, and so do the points there.
    """
    wave_key, phase_key, length_key, mean_key = jax.random.split(key, 4)
    direction = jax.random.normal(wave_key, (WAVES, 3))
    direction /= jnp.linalg.norm(direction, axis=-1, keepdims=True)
    least, most = WAVELENGTH
    length = least * (most / least) ** jax.random.uniform(length_key, (WAVES, 1))
    frequency = 2 * jnp.pi * direction / length
    phase = points @ frequency.T + 2 * jnp.pi * jax.random.uniform(phase_key, (WAVES,))
    height = size * jnp.sqrt(2 / WAVES)
    swell = size * (SWELL + SWELL_SPREAD * jax.random.normal(mean_key))
    wave = swell + height * jnp.sum(jnp.sin(phase), axis=-1)
    slope = height * jnp.cos(phase) @ frequency
    along = jnp.sum(slope * normals, axis=-1, keepdims=True)
    known = jnp.any(normals != 0, axis=-1, keepdims=True)
    bent = normals - known * (slope - along * normals)
    return points + wave[:, None] * normals, bent


def clustered(points: Cloud, normals: Cloud, cell: Chance, offset: Float[Array, " 3"]) -> tuple[Cloud, Cloud]:
    """Points and normals in the means of their cells of a cubic grid, as voxels round edges and join sheets."""
    places = jnp.floor((points + offset) / cell).astype(jnp.int32)
    order = jnp.lexsort(places.T)
    first = jnp.any(places[order][1:] != places[order][:-1], axis=-1)
    number = jnp.zeros(len(points), jnp.int32).at[order[1:]].set(jnp.cumsum(first))
    count = jax.ops.segment_sum(jnp.ones(len(points)), number, num_segments=len(points))
    both = jax.ops.segment_sum(jnp.concatenate([points, normals], axis=1), number, num_segments=len(points))
    mean = (both / jnp.maximum(count, 1)[:, None])[number]
    return mean[:, :3], mean[:, 3:]


def point_noise(
    key: Array, points: Cloud, config: SampleConfig, open_to_flaws: Chance
) -> Float[Array, "n 3"]:
    """Noise of single points: `noise`, or drawn for the cloud up to `most_noise`."""
    noise = jax.random.normal(key, points.shape)
    if config.most_noise <= config.noise:
        return config.noise * noise
    share = jax.random.uniform(jax.random.fold_in(key, 1)) * open_to_flaws
    return config.noise * (config.most_noise / config.noise) ** share * noise


def own_share(key: Array) -> Float[Array, ""]:
    """A cloud's own share of a configured size."""
    return jax.random.uniform(key, minval=VARIES[0], maxval=VARIES[1])
