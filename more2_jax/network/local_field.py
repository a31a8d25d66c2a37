"""What the decoder reads beside the code: the encoder's features at the observed points around a query.

A code of a few hundred numbers says what kind of object this is; where its surface runs is in the points. Around a
query the anchors' features are blended by normalized Gaussian weights, each contributing its own linear function of
the offset, as in moving least squares: F(p) = Σ_j w_j(p) (⟨p − x_j, B_j⟩ + b_j). The same weights give the anchors'
mean and covariance, hence the plane they lie in and where the query stands from it: features that are averages of
positions cannot say that. Where normals n_j of the surface are known, blends of the heights n_j·(p − x_j) over the
anchors' planes say on which side the query stands (`plane_features`). Invariant, since the B_j and n_j turn with the
object, and a few matrix products for any number of queries.
"""

from __future__ import annotations

import dataclasses

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float

from more2_jax.network.vector_neurons import TINY, kernel_init
from more2_jax.types import Anchors, pytree

POSITIONAL = (
    5  # features a bandwidth that say where the query lies: three lengths, two of them also as a share
)
NORMAL_FEATURES = 11  # features a bandwidth that come of the anchors' normals
PLANE_REACH = 0.02  # canonical units: heights over the plane are told apart up to about this
MIN_VARIANCE = (
    1e-4  # of the anchors, canonical units²: below it one anchor has all the weight, and there is no plane
)


NEAR_PLANE = (
    0.015  # at the start of training, canonical units: heights up to about this count in the second blend
)
LEAST_SHARE = 0.02  # of the weight: anchors of known normals that have less of it say little


@pytree
class LocalField:
    """One level's anchors, ready to be queried: canonical units, relative to the center."""

    position: Float[Array, "a 3"]
    mask: Bool[Array, " a"]
    table: Float[Array, "h a t"]  # a row an anchor: columns of the products, for every bandwidth
    bandwidth: Float[Array, " h"]
    planes: Float[Array, "a 5"] | None = None  # n, n·x and 1 where the normal is known, else zeros
    near_plane: Float[Array, ""] | None = None


def local_width(channels: int, bandwidths: int, normals: bool = False) -> int:
    """How many numbers a level contributes to the decoder's input."""
    return bandwidths * (2 * channels + POSITIONAL + normals * NORMAL_FEATURES)


class LocalLookup(nn.Module):
    """One level: `tabulate` once an object, `query` for many points."""

    channels: int
    bandwidths: tuple[float, ...]
    inputs: int  # channels of the anchors' features
    normals: bool = False  # look up the anchors' normals, too

    def setup(self) -> None:
        wide = self.channels * len(self.bandwidths)
        shape = (self.inputs, wide)
        self.slope = self.param("slope", kernel_init, shape)
        self.left = self.param("left", kernel_init, shape)
        self.right = self.param("right", kernel_init, shape)
        self.log_bandwidth = self.param("log_bandwidth", lambda _: jnp.log(jnp.array(self.bandwidths)))
        if self.normals:
            self.log_near_plane = self.param("log_near_plane", lambda _: jnp.log(jnp.full((), NEAR_PLANE)))

    def tabulate(self, anchors: Anchors, scale: Float[Array, ""]) -> LocalField:
        """Every anchor's linear function in absolute form: ⟨p − x, B⟩ + b = ⟨p, B⟩ + (b − ⟨x, B⟩)."""
        assert anchors.features is not None
        features = anchors.features * jnp.sqrt(1.0 * self.inputs)
        position = anchors.offset / scale
        slope = features @ self.slope
        constant = jnp.sum((features @ self.left) * (features @ self.right), axis=-2) / 3.0
        count = len(self.bandwidths)
        by_bandwidth = [jnp.split(x, count, axis=-1) for x in (slope, constant)]
        rows = [
            jnp.concatenate(
                [s.reshape(len(s), -1), _at_anchors(position, s), c, moments(position)],
                axis=-1,
            )
            for s, c in zip(*by_bandwidth, strict=True)
        ]
        field = LocalField(
            position=position,
            mask=anchors.mask,
            table=jnp.stack(rows),
            bandwidth=jnp.exp(self.log_bandwidth),
        )
        if not self.normals:
            return field
        planes = plane_rows(position, anchors.normal)
        return dataclasses.replace(field, planes=planes, near_plane=jnp.exp(self.log_near_plane))

    def query(
        self, field: LocalField, q: Float[Array, "n 3"]
    ) -> tuple[Float[Array, "n w"], Float[Array, "n p"]]:
        """The blended functions and the distance, for every bandwidth; each of order one, near and far.

        The second array has what the normals say: no columns where they are not looked up, zeros where none is known.
        """
        near = closeness(q, field.position)
        blended, heights = [], [q[:, :0]]
        for table, bandwidth in zip(field.table, field.bandwidth, strict=True):
            weight = jax.nn.softmax(near / bandwidth**2, axis=-1, where=field.mask)
            # Positions are in the table, and covariances are small differences of their squares.
            mean = jnp.matmul(weight, table, precision="highest")
            blended.append(self._features(q, mean, bandwidth))
            if field.planes is not None and field.near_plane is not None:
                center = mean[:, 5 * self.channels :][:, :3]
                heights.append(plane_features(q, weight, field.planes, field.near_plane, center))
        return jnp.concatenate(blended, axis=-1), jnp.concatenate(heights, axis=-1)

    def _features(
        self, q: Float[Array, "n 3"], mean: Float[Array, "n t"], bandwidth: Array
    ) -> Float[Array, "n w"]:
        c = self.channels
        slope, of_offset, constant, near = jnp.split(mean, (3 * c, 4 * c, 5 * c), axis=-1)
        slope, center, second = slope.reshape(-1, 3, c), near[:, :3], near[:, 3:].reshape(-1, 3, 3)
        linear = _products(q, slope) - of_offset
        offset, normal_offset, variance = plane_offsets(q, center, second)
        distance = length_of(
            jnp.sum(offset**2, axis=-1) + variance
        )  # root mean square distance to the anchors
        height = length_of(jnp.sum(normal_offset**2, axis=-1))
        return jnp.concatenate(
            [
                linear / (distance + bandwidth) + constant,
                distance,
                distance / (distance + bandwidth),
                _products(normal_offset, slope) / (height + PLANE_REACH),
                height,
                height / (height + PLANE_REACH),
                length_of(variance),
            ],
            axis=-1,
        )


def closeness(q: Float[Array, "n 3"], position: Float[Array, "a 3"]) -> Float[Array, "n a"]:
    """−|q − x|²/2 up to what is the same for all x."""
    return jnp.matmul(q, position.T, precision="highest") - 0.5 * jnp.sum(position**2, axis=-1)


def moments(position: Float[Array, "a 3"]) -> Float[Array, "a 12"]:
    """Positions, and their products with themselves: blended, they give mean and covariance."""
    second = (position[:, :, None] * position[:, None, :]).reshape(-1, 9)
    return jnp.concatenate([position, second], axis=-1)


def plane_offsets(
    q: Float[Array, "n 3"], center: Float[Array, "n 3"], second: Float[Array, "n 3 3"]
) -> tuple[Float[Array, "n 3"], Float[Array, "n 3"], Float[Array, " n"]]:
    """Offsets of queries from their neighborhood's mean, the part of them along its plane's normal, and its variance.

    For points spread evenly in a plane the covariance is v/2 times the projection onto it, v its trace: no
    eigenvectors, so nothing jumps where two of them change places.
    """
    offset = q - center
    covariance = second - center[:, :, None] * center[:, None, :]
    variance = jnp.maximum(jnp.trace(covariance, axis1=-2, axis2=-1), MIN_VARIANCE)
    along_plane = jnp.einsum("nij,nj->ni", covariance, offset, precision="highest")
    normal_offset = offset - 2 * along_plane / variance[:, None]
    return offset, normal_offset, variance


def plane_rows(position: Float[Array, "a 3"], normal: Float[Array, "a 3"] | None) -> Float[Array, "a 5"]:
    """n, n·x and 1 of every anchor whose normal is known, zeros of the others."""
    normal = jnp.zeros_like(position) if normal is None else normal
    known = jnp.any(normal != 0, axis=-1, keepdims=True).astype(position.dtype)
    return jnp.concatenate([normal, jnp.sum(normal * position, axis=-1, keepdims=True), known], axis=-1)


def plane_features(
    q: Float[Array, "n 3"],
    weight: Float[Array, "n a"],
    planes: Float[Array, "a 5"],
    near_plane: Float[Array, ""],
    center: Float[Array, "n 3"],
) -> Float[Array, "n p"]:
    """Where queries stand over the planes of the anchors around them, outside being positive; 0 where none is known.

    Two blends of the heights n·(q − x): by `weight`, and by that times a Gaussian of the height, in which the near
    side of a thin board outweighs the far one. Each is renormalized over the anchors whose normals are known, and goes
    to 0 with the share that they have.
    """
    height = jnp.matmul(q, planes[:, :3].T, precision="highest") - planes[:, 3]
    near = weight * jnp.exp(-0.5 * (height / near_plane) ** 2)
    first, normal, share = _blended_height(q, weight, planes)
    second, near_normal, near_share = _blended_height(q, near, planes)
    spread = length_of(jnp.sum(weight * height**2, axis=-1) / (share[:, 0] + LEAST_SHARE))
    gate = share / (share + LEAST_SHARE)
    over_center = jnp.sum(normal * (q - center), axis=-1, keepdims=True)
    return jnp.concatenate(
        [
            share,
            first,
            first / (jnp.abs(first) + PLANE_REACH),
            over_center,
            spread * gate,
            first / (spread + PLANE_REACH),
            length_of(jnp.sum(normal**2, axis=-1)) * gate,
            near_share,
            second,
            second / (jnp.abs(second) + 0.5 * PLANE_REACH),
            length_of(jnp.sum(near_normal**2, axis=-1)) * gate,
        ],
        axis=-1,
    )


def _blended_height(
    q: Float[Array, "n 3"], weight: Float[Array, "n a"], planes: Float[Array, "a 5"]
) -> tuple[Float[Array, "n 1"], Float[Array, "n 3"], Float[Array, "n 1"]]:
    """Mean height over the planes, mean normal, and the share of `weight` that known normals have."""
    mean = jnp.matmul(weight, planes, precision="highest")
    share = mean[:, 4:]
    mean = mean / (share + LEAST_SHARE)
    normal = mean[:, :3]
    return jnp.sum(q * normal, axis=-1, keepdims=True) - mean[:, 3:4], normal, share


def length_of(squared: Float[Array, " n"]) -> Float[Array, "n 1"]:
    """Square root as a column; its gradient at 0 is 0."""
    return jnp.sqrt(jnp.maximum(squared, TINY))[:, None]


def _at_anchors(position: Float[Array, "a 3"], slope: Float[Array, "a 3 c"]) -> Float[Array, "a c"]:
    return jnp.einsum("ai,aic->ac", position, slope, precision="highest")


def _products(q: Float[Array, "n 3"], vectors: Float[Array, "n 3 c"]) -> Float[Array, "n c"]:
    return q[:, :1] * vectors[:, 0] + q[:, 1:2] * vectors[:, 1] + q[:, 2:] * vectors[:, 2]
