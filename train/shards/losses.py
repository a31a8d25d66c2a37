"""Training losses (paper §3.1), for one shape seen twice or a batch of codes."""

from __future__ import annotations

import dataclasses
from typing import Any, Literal

import jax
import jax.numpy as jnp
import optax
from jax import Array
from jax.sharding import Mesh
from jaxtyping import Float

from more2_jax.network.decoder import Decoder
from more2_jax.network.prior import Prior, encode_ordered
from more2_jax.network.row_map import in_blocks, in_turn
from more2_jax.network.two_decoders import without_normals
from more2_jax.types import Embedding
from train.shards.sampling import TrainingSample
from train.shards.settings import LossConfig

AT_ONCE = 1024  # points of clouds that a CPU encodes side by side
BARE = "bare_"  # what the terms of the decoder without normals begin with
LEAST_CORRELATION = 0.05  # of two F_eqv, whose norms are 1: below it their rotation is noise, and pulls less


def sdf_loss(
    predicted: Float[Array, "*b q"], truth: Float[Array, "*b q"], near_surface: float
) -> Float[Array, ""]:
    """Mean of λ|error|; λ = 1 where |truth| < `near_surface`, else 0.5. Canonical units."""
    weight = jnp.where(jnp.abs(truth) < near_surface, 1.0, 0.5)
    return jnp.mean(weight * jnp.abs(predicted - truth))


def sign_loss(predicted: Float[Array, "*b q"], truth: Float[Array, "*b q"], width: float) -> Float[Array, ""]:
    """Mean cross-entropy of inside or outside, the logit being −distance / `width`.

    The error of a distance hardly tells the two sides of a thin board apart; this does.
    """
    return optax.sigmoid_binary_cross_entropy(-predicted / width, truth < 0).mean()


def up_loss(eqv: Float[Array, "b 2 3 c"]) -> Float[Array, ""]:
    """Mean squared distance between the mean direction of the first third of F_eqv and the shape's vertical.

    Shapes are canonical, z up. Two of a rotation's three degrees of freedom then follow from semantics, which a
    partial cloud keeps better than its moments.
    """
    c = eqv.shape[-1]
    up = eqv[..., : c // 3].mean(axis=-1) * jnp.sqrt(1.0 * c)
    return jnp.mean(jnp.sum((up - jnp.array([0.0, 0.0, 1.0])) ** 2, axis=-1))


def scale_loss(scale: Float[Array, "*b"], error: Literal["log", "absolute"]) -> Float[Array, ""]:
    """Mean of |log F_s|, or of the paper's |1 − F_s|.

    Both have the same minimum and slope there. But a scale that shrinks toward 0, where |1 − F_s| has no pull left on
    the product of all layers, is pushed back by the logarithm.
    """
    return jnp.mean(jnp.abs(jnp.log(scale) if error == "log" else 1.0 - scale))


def contrast_loss(
    first: Float[Array, "b c"], second: Float[Array, "b c"], temperature: float
) -> Float[Array, ""]:
    """InfoNCE both ways: row i of one view should be nearest in angle to row i of the other."""
    a, b = (x / jnp.maximum(jnp.linalg.norm(x, axis=-1, keepdims=True), 1e-12) for x in (first, second))
    logits = a @ b.T / temperature
    labels = jnp.arange(len(a))
    cross_entropy = optax.softmax_cross_entropy_with_integer_labels
    return 0.5 * (cross_entropy(logits, labels).mean() + cross_entropy(logits.T, labels).mean())


def turn_loss(eqv: Float[Array, "b 2 3 c"]) -> Float[Array, ""]:
    """Mean of ‖F_eqv − F_eqv'‖²: both clouds have the shape's own orientation. 0 at best, 2 if unrelated."""
    return jnp.mean(jnp.sum((eqv[:, 0] - eqv[:, 1]) ** 2, axis=(-2, -1)))


def rotation_loss(eqv: Float[Array, "b 2 3 c"]) -> Float[Array, ""]:
    """Mean of 1 − ⟨M, I⟩ / (‖M‖‖I‖), M = F_eqv F_eqv'ᵀ being what Kabsch's algorithm reads the rotation from.

    `turn_loss` is lowered as well by vectors that all point along one axis, which says nothing of the turn about it:
    here they score 0.42. 0 where M is a multiple of the identity, about 1 if the two are unrelated.
    """
    M = jnp.einsum("bic,bjc->bij", eqv[:, 0], eqv[:, 1])
    length = jnp.sqrt(jnp.sum(M**2, axis=(-2, -1)) + LEAST_CORRELATION**2)
    return 1.0 - jnp.mean(jnp.trace(M, axis1=-2, axis2=-1) / (jnp.sqrt(3.0) * length))


def total_loss(
    prior: Prior,
    sample: TrainingSample,
    config: LossConfig,
    dropout_key: Array,
    mesh: Mesh | None = None,
) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
    """The training loss of a batch and its terms; shapes are canonical, so F_c → 0 and F_s → 1.

    `mesh`: the devices that share the batch.
    """
    embedding, predicted = predict(prior, sample, dropout_key, train=True, mesh=mesh)
    terms = {
        f"{of}{term}": loss
        for of, field in predicted.items()
        for term, loss in {
            "sdf": sdf_loss(field, sample.sdf, config.near_surface),
            "sign": sign_loss(field, sample.sdf, config.sign_width),
        }.items()
    }
    terms |= {} if config.train == "decoder" else code_terms(embedding, config)
    return sum((weight_of(k, config) * v for k, v in terms.items()), jnp.zeros(())), terms


def weight_of(term: str, config: LossConfig) -> float:
    """Of a term in the loss, the same for both decoders; that of the distance is the unit."""
    term = term.removeprefix(BARE)
    return 1.0 if term == "sdf" else getattr(config, f"{term}_weight")


def code_terms(embedding: Embedding, config: LossConfig) -> dict[str, Float[Array, ""]]:
    """The terms that say what codes should be."""
    return {
        "center": jnp.mean(jnp.linalg.norm(embedding.center + 1e-12, axis=-1)),
        "scale": scale_loss(embedding.scale, config.scale_error),
        "contrast": contrast_loss(embedding.inv[:, 0], embedding.inv[:, 1], config.contrast_temperature),
        "turn": turn_loss(embedding.eqv),
        "rotation": rotation_loss(embedding.eqv),
        "up": up_loss(embedding.eqv),
    }


def predict(
    prior: Prior, sample: TrainingSample, dropout_key: Array, train: bool, mesh: Mesh | None = None
) -> tuple[Embedding, dict[str, Float[Array, "b 2 q"]]]:
    """Encodes both clouds of every shape and decodes the queries with each cloud's own code.

    The distances are named "". Where a second decoder serves objects without normals, all clouds are asked of it
    too: named `BARE`.
    """
    decoders = {"": ("decoder", Decoder(prior.config))}
    if prior.config.bare_decoder:
        decoders[BARE] = "bare_decoder", Decoder(without_normals(prior.config))

    def one(params: dict[str, Any], cloud: tuple[Array, ...]) -> tuple[Embedding, dict[str, Array]]:
        points, mask, normals, queries, key = cloud
        e = encode_ordered(dataclasses.replace(prior, params=params), points, mask, normals, train)

        def distances(weights: str, decoder: Decoder) -> Array:
            def asked(some: Array) -> Array:
                return decoder.apply({"params": params[weights]}, e, some, train, rngs={"dropout": key})  # type: ignore[return-value]

            # Blocks would drop the same units of every block.
            return asked(queries) if decoder.config.decoder.dropout else in_blocks(asked, queries)

        return e, {of: distances(*asked) for of, asked in decoders.items()}

    keys = jax.random.split(dropout_key, sample.sdf.shape[:2])
    by_shape = (sample.points, sample.mask, sample.normals, sample.queries, keys)
    clouds = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), by_shape)
    found = in_turn(one, prior.params, clouds, max(1, AT_ONCE // sample.points.shape[2]), mesh)
    return jax.tree.map(lambda x: x.reshape(-1, 2, *x.shape[1:]), found)
