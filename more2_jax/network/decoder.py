"""Decoder Ψ (paper §3.1): a shape code and a point to the signed distance, in canonical units."""

from __future__ import annotations

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float

from more2_jax.config import PriorConfig
from more2_jax.network.local_field import LocalField, LocalLookup, local_width
from more2_jax.network.surface_lookup import SurfaceField, SurfaceLookup, surface_width
from more2_jax.network.two_decoders import knows_normals
from more2_jax.network.vector_neurons import linear
from more2_jax.types import Embedding, pytree

Affine = tuple[Float[Array, "4 h"], Float[Array, " h"]]


@pytree
class ObjectField:
    """What the decoder needs of one object: code and point enter by a (3 + 1) → hidden affine map.

    ⟨F_eqv, q⟩ W = q (F_eqv W) and F_inv W is constant, so both layers that see the input collapse.
    """

    first: Affine
    skip: Affine
    scale: Float[Array, ""]
    center: Float[Array, "3"]
    known: Bool[Array, ""]  # whether any anchor's normal is known
    local: tuple[LocalField, ...] = ()
    surface: SurfaceField | None = None


def product(h: Float[Array, "n i"], kernel: Float[Array, "i o"], train: bool) -> Float[Array, "n o"]:
    """h @ kernel; in training, accelerators multiply in bfloat16 and add in float32.

    That changes distances by 0.2 % and the gradient far less than another batch does (`eval.bfloat16`). Not when a
    trained field is queried: poses are found by its slope, and imported weights should agree with their origin.
    """
    if not train:
        return h @ kernel
    return jax.lax.platform_dependent(h, kernel, cpu=linear, default=bfloat16_product)


def bfloat16_product(h: Float[Array, "n i"], kernel: Float[Array, "i o"]) -> Float[Array, "n o"]:
    """Factors rounded to bfloat16, their products added in float32; as the input is otherwise."""
    factors = h.astype(jnp.bfloat16), kernel.astype(jnp.bfloat16)
    return jnp.matmul(*factors, preferred_element_type=jnp.float32).astype(h.dtype)


class WeightNormDense(nn.Module):
    """Dense layer with weight normalization: kernel = gain · direction / |direction|, a column an output."""

    features: int

    @nn.compact
    def __call__(self, inputs: int) -> tuple[Float[Array, "i o"], Float[Array, " o"]]:
        direction = self.param("direction", nn.initializers.he_normal(), (inputs, self.features))
        length = jnp.linalg.norm(direction, axis=0)
        gain = self.param("gain", lambda _key: jnp.linalg.norm(direction, axis=0))
        bias = self.param("bias", nn.initializers.zeros, (self.features,))
        return direction * (gain / length), bias


class Decoder(nn.Module):
    """Ψ as three steps: kernels once, an affine map per object (`field`), points through it (`distance`)."""

    config: PriorConfig

    def setup(self) -> None:
        d, e = self.config.decoder, self.config.encoder
        self.lookups = [
            LocalLookup(d.local_channels, d.bandwidths, e.widths[i], d.normals, name=f"local_{i}")
            for i in d.local_blocks
        ]
        self.local_width = len(d.local_blocks) * local_width(d.local_channels, len(d.bandwidths), d.normals)
        self.surface = SurfaceLookup(d.surface_bandwidths) if d.surface_points else None
        self.local_width += surface_width(len(d.surface_bandwidths)) if d.surface_points else 0
        self.code_width = 2 * e.code + 1
        self.input_width = self.code_width + self.local_width
        widths = [d.hidden] * d.layers
        if d.narrow_skip:
            # So that the skip layer's input is `hidden` wide again.
            widths[d.skip_layer - 1] -= self.input_width
        self.hidden = [WeightNormDense(w, name=f"layer_{i}") for i, w in enumerate(widths)]
        self.output = nn.Dense(1, name=f"layer_{d.layers}")
        self.dropout = nn.Dropout(d.dropout)

    def kernels(self) -> list[tuple[Float[Array, "i o"], Float[Array, " o"]]]:
        """Every hidden layer's kernel and bias, weight normalization applied."""
        d = self.config.decoder
        inputs = [self.input_width] + [d.hidden] * (d.layers - 1)
        if not d.narrow_skip:
            inputs[d.skip_layer] += self.input_width
        return [dense(i) for dense, i in zip(self.hidden, inputs, strict=True)]

    def field(self, embedding: Embedding) -> ObjectField:
        """Folds one object's code into the two layers that see it."""
        kernels, d = self.kernels(), self.config.decoder
        first, bias = kernels[0]
        skip, skip_bias = kernels[d.skip_layer]
        return ObjectField(
            first=self._affine(embedding, first, bias),
            skip=self._affine(embedding, skip[-self.input_width :], skip_bias),
            scale=embedding.scale,
            center=embedding.center,
            known=knows_normals(embedding),
            local=tuple(
                lookup.tabulate(a, embedding.scale)
                for lookup, a in zip(self.lookups, embedding.anchors[: len(self.lookups)], strict=True)
            ),
            surface=self.surface and self.surface.tabulate(embedding.anchors[-1], embedding.scale),
        )

    def _affine(self, e: Embedding, kernel: Float[Array, "i h"], bias: Float[Array, " h"]) -> Affine:
        code = self.config.encoder.code
        of_inv, of_eqv, of_length = kernel[:code], kernel[code : 2 * code], kernel[2 * code : 2 * code + 1]
        matrix = jnp.concatenate([self.config.eqv_gain * (e.eqv @ of_eqv), of_length])
        return matrix, self.config.inv_gain * (e.inv @ of_inv) + bias

    def distance(
        self, field: ObjectField, points: Float[Array, "n 3"], train: bool = False
    ) -> Float[Array, " n"]:
        """Signed distance at `points` (frame of the code's `center`), canonical units, negative inside."""
        d, kernels = self.config.decoder, self.kernels()
        q = (points - field.center) / field.scale
        length = jnp.sqrt(jnp.maximum(jnp.sum(q * q, axis=-1, keepdims=True), 1e-30))
        local_features = self._looked_up(field, q)
        q = jnp.concatenate([q, length], axis=-1)
        first, skip = (k[len(k) - self.local_width :] for k in (kernels[0][0], kernels[d.skip_layer][0]))
        h = self._activate(q @ field.first[0] + field.first[1] + local_features @ first, train)
        for i in range(1, d.layers):
            kernel, bias = kernels[i]
            if i == d.skip_layer:
                kept = product(h, kernel[: -self.input_width], train)
                h = kept + q @ field.skip[0] + field.skip[1] + local_features @ skip
            else:
                h = product(h, kernel, train) + bias
            h = self._activate(h, train)
        return jnp.tanh(self.output(h)[..., 0])

    def _looked_up(self, field: ObjectField, q: Float[Array, "n 3"]) -> Float[Array, "n l"]:
        local = [lookup.query(f, q) for lookup, f in zip(self.lookups, field.local, strict=True)]
        surface = (
            [] if self.surface is None or field.surface is None else [self.surface.query(field.surface, q)]
        )
        # What normals and the surface say comes last: rows that a decoder without them does not have.
        return jnp.concatenate([q[:, :0], *(f for f, _ in local), *(h for _, h in local), *surface], axis=-1)

    def _activate(self, h: Float[Array, "n h"], train: bool) -> Float[Array, "n h"]:
        return self.dropout(jax.nn.relu(h), deterministic=not train)

    def __call__(
        self, embedding: Embedding, points: Float[Array, "n 3"], train: bool = False
    ) -> Float[Array, " n"]:
        """Signed distance of one object at `points`; canonical units: meters are the value times `scale`."""
        return self.distance(self.field(embedding), points, train)
