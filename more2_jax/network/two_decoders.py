"""Decoder weights by what is known of an object: those trained with normals where some are, else others of their own.

A decoder trained to read the anchors' normals answers worse where none is known than one that never saw any. A prior
with `bare_decoder` holds both behind one encoder, and every object is asked by the weights that fit it.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from flax.traverse_util import flatten_dict, unflatten_dict
from jax import Array
from jaxtyping import Bool

from more2_jax.config import PriorConfig
from more2_jax.types import Embedding

Weights = dict[str, Any]


def without_normals(config: PriorConfig) -> PriorConfig:
    """The settings of the second decoder alone, which looks up neither normals nor the surface."""
    return dataclasses.replace(
        config,
        decoder=dataclasses.replace(config.decoder, normals=False, surface_points=0),
        bare_decoder=False,
    )


def knows_normals(embedding: Embedding) -> Bool[Array, ""]:
    """Whether the normal of any anchor of one object is known."""
    known = [jnp.any(a.normal != 0) for a in embedding.anchors if a.normal is not None]
    return jnp.any(jnp.stack(known)) if known else jnp.zeros((), bool)


def decoder_weights(params: Weights, config: PriorConfig, known: Bool[Array, ""]) -> Weights:
    """The decoder's weights for an object of which normals are known, or none."""
    seeing = params["decoder"]
    if not config.bare_decoder:
        return seeing
    bare = with_rows_for_normals(params["bare_decoder"], seeing)
    return jax.tree.map(lambda a, b: jnp.where(known, a, b), seeing, bare)


def with_rows_for_normals(bare: Weights, seeing: Weights) -> Weights:
    """The same distances in the shapes of a decoder that looks up more: what it reads of that has weights of zero.

    Rows for normals, then for the surface, come last in every kernel. Columns keep their lengths, which weight
    normalization needs.
    """
    known: dict[tuple[str, ...], Array] = dict(flatten_dict(bare))  # type: ignore[arg-type]
    wanted: dict[tuple[str, ...], Array] = dict(flatten_dict(seeing))  # type: ignore[arg-type]
    filled = {}
    for name, like in wanted.items():
        own = known.get(name, like)
        missing = like.shape[:1] != own.shape[:1]
        filled[name] = jnp.pad(own, ((0, len(like) - len(own)), (0, 0))) if missing else own
    return unflatten_dict(filled)
