"""What the decoder reads of the observed surface itself: many points and their normals, without features.

The encoder's points are few, and as noisy as the sensor. Beside them the decoder sees several times as many of the
same cloud, blended around a query by Gaussian weights of several widths: how far their mean, their plane and the
planes of their normals are (`local_field`). The narrow blends tell the side of a thin board, the wide ones average
noise out; the layers behind weigh them against what the code expects.
"""

from __future__ import annotations

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float

from more2_jax.network.local_field import (
    NORMAL_FEATURES,
    closeness,
    length_of,
    moments,
    plane_features,
    plane_offsets,
    plane_rows,
)
from more2_jax.types import Anchors, pytree

POSITIONAL = 5  # features a bandwidth that need no normals: two distances, also as shares, and the spread
GAIN = 20.0  # brings lengths of some hundredths of the canonical unit to the size of shares and of the code
MOST = 2.0  # of a length that was multiplied by `GAIN`
# Which features are lengths: of those of a bandwidth (`_distances`, then `plane_features`).
LENGTHS = (
    True,
    False,
    True,
    False,
    True,
    *(False, True, False, True, True, False, False, False, True, False, False),
)
NEAR = 0.01  # canonical units: heights up to about this are told apart, and count when training starts


@pytree
class SurfaceField:
    """One object's observed points, ready to be queried: canonical units, relative to the center."""

    position: Float[Array, "a 3"]
    mask: Bool[Array, " a"]
    moments: Float[Array, "a 12"]  # position, and its products with itself
    planes: Float[Array, "a 5"]  # n, n·x and 1 where the normal is known, else zeros
    bandwidth: Float[Array, " h"]
    near_plane: Float[Array, ""]


def surface_width(bandwidths: int) -> int:
    """How many numbers the look-up contributes to the decoder's input."""
    return bandwidths * (POSITIONAL + NORMAL_FEATURES)


class SurfaceLookup(nn.Module):
    """`tabulate` once an object, `query` for many points."""

    bandwidths: tuple[float, ...]

    def setup(self) -> None:
        self.log_bandwidth = self.param("log_bandwidth", lambda _: jnp.log(jnp.array(self.bandwidths)))
        self.log_near_plane = self.param("log_near_plane", lambda _: jnp.log(jnp.full((), NEAR)))

    def tabulate(self, surface: Anchors, scale: Float[Array, ""]) -> SurfaceField:
        """The points in canonical units."""
        position = surface.offset / scale
        return SurfaceField(
            position=position,
            mask=surface.mask,
            moments=moments(position),
            planes=plane_rows(position, surface.normal),
            bandwidth=jnp.exp(self.log_bandwidth),
            near_plane=jnp.exp(self.log_near_plane),
        )

    def query(self, field: SurfaceField, q: Float[Array, "n 3"]) -> Float[Array, "n w"]:
        """Distances for every bandwidth; those by normals are 0 where none is known."""
        near, found = closeness(q, field.position), []
        for bandwidth in field.bandwidth:
            weight = jax.nn.softmax(near / bandwidth**2, axis=-1, where=field.mask)
            # Covariances are small differences of the moments.
            mean = jnp.matmul(weight, field.moments, precision="highest")
            center, second = mean[:, :3], mean[:, 3:].reshape(-1, 3, 3)
            found += [
                _distances(q, center, second, bandwidth),
                plane_features(q, weight, field.planes, field.near_plane, center),
            ]
        every = jnp.concatenate(found, axis=-1)
        return jnp.where(jnp.tile(jnp.array(LENGTHS), len(field.bandwidth)), bounded(every), every)


def bounded(length: Float[Array, "*n w"]) -> Float[Array, "*n w"]:
    """`GAIN` times a short length, `MOST` at most: far from the surface its details have no say."""
    x = GAIN * length
    return x / jnp.sqrt(1.0 + (x / MOST) ** 2)


def _distances(
    q: Float[Array, "n 3"], center: Float[Array, "n 3"], second: Float[Array, "n 3 3"], bandwidth: Array
) -> Float[Array, "n 5"]:
    """From the points around a query, from the plane that they lie in, and how far they spread."""
    offset, normal_offset, variance = plane_offsets(q, center, second)
    distance = length_of(jnp.sum(offset**2, axis=-1) + variance)  # root mean square distance to the points
    height = length_of(jnp.sum(normal_offset**2, axis=-1))
    parts = [
        distance,
        distance / (distance + bandwidth),
        height,
        height / (height + NEAR),
        length_of(variance),
    ]
    return jnp.concatenate(parts, axis=-1)
