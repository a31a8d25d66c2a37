"""The weights a run begins with: random ones whose scale is right at step 0, or trained ones."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from more2_jax.config import DecoderConfig, PriorConfig
from more2_jax.network.prior import Prior, encode_ordered, init_prior, load_prior, points_read
from more2_jax.network.two_decoders import with_rows_for_normals, without_normals
from train.run.settings import TrainingConfig, TrainingRun
from train.run.shape_mix import ShapeMix
from train.shards.sampling import sample_batch
from train.shards.shards import Shapes

CALIBRATED = 32  # training shapes, by which the encoder's output constant is chosen


def started_cold(settings: TrainingRun, train: ShapeMix, name: str) -> Prior:
    """Random weights, F_s being about 1."""
    model = calibrated(settings.model, settings.training, train)
    return init_prior(model, jax.random.key(settings.training.seed), name)


def started_warm(model: PriorConfig, weights: str, name: str) -> Prior:
    """Weights that were trained before; with rows of zeros for what the decoder is to look up and did not.

    Of two decoders both where the model has two. Raises ValueError if they are not of this model.
    """
    prior = load_prior(weights)
    prior = prior if model.bare_decoder else one_decoder(prior, model.decoder.normals)
    if with_its_look_ups(prior, model) != prior.config.decoder:
        prior = looking_up_more(prior, model)
    scale = prior.config.encoder.output_scale  # measured at the start of their training, and theirs for good
    wanted = dataclasses.replace(model, encoder=dataclasses.replace(model.encoder, output_scale=scale))
    if different := [
        f
        for f in ("encoder", "decoder", "eqv_gain", "inv_gain", "bare_decoder")
        if getattr(wanted, f) != getattr(prior.config, f)
    ]:
        raise ValueError(
            f"--warm-start {weights}: its {different[0]} is {getattr(prior.config, different[0])}; needed"
            f" {getattr(wanted, different[0])}, as configured"
        )
    return dataclasses.replace(prior, name=name)


def with_its_look_ups(prior: Prior, model: PriorConfig) -> DecoderConfig:
    """The settings of the prior's decoder, looking up what `model` looks up besides."""
    own, wanted = prior.config.decoder, model.decoder
    more: dict[str, Any] = {"normals": True} if wanted.normals else {}
    if wanted.surface_points and not own.surface_points:
        more |= {k: getattr(wanted, k) for k in ("surface_points", "surface_bandwidths")}
    return dataclasses.replace(own, **more)


def looking_up_more(prior: Prior, model: PriorConfig) -> Prior:
    """The same distances from a decoder that looks up more: what it reads of it has weights of zero."""
    config = dataclasses.replace(prior.config, decoder=with_its_look_ups(prior, model))
    fresh = init_prior(config, jax.random.key(0)).params["decoder"]
    params = with_rows_for_normals(prior.params["decoder"], fresh)
    return dataclasses.replace(prior, params=prior.params | {"decoder": params}, config=config)


def one_decoder(prior: Prior, normals: bool) -> Prior:
    """Of a prior with two decoders the one that reads normals, or the one that reads none; any other prior as it is."""
    if not prior.config.bare_decoder:
        return prior
    params = {
        "encoder": prior.params["encoder"],
        "decoder": prior.params["decoder" if normals else "bare_decoder"],
    }
    seeing = dataclasses.replace(prior.config, bare_decoder=False)
    return dataclasses.replace(
        prior, params=params, config=seeing if normals else without_normals(prior.config)
    )


def calibrated(model: PriorConfig, training: TrainingConfig, train: ShapeMix) -> PriorConfig:
    """Chooses the encoder's output constant so that F_s ≈ 1 at step 0 on the training shapes (paper §3.1)."""
    unit = dataclasses.replace(model, encoder=dataclasses.replace(model.encoder, output_scale=1.0))
    prior = init_prior(unit, jax.random.key(training.seed))
    shapes = train.read(np.linspace(0, len(train) - 1, min(CALIBRATED, len(train))).astype(int))
    index = jnp.arange(len(shapes.views))
    shapes = jax.tree.map(jnp.asarray, shapes)

    @jax.jit
    def mean_scale(key: jax.Array, shapes: Shapes) -> Float[jax.Array, ""]:
        sample = sample_batch(key, shapes, index, training, points_read(model))
        return jax.vmap(partial(encode_ordered, prior))(sample.points[:, 0], sample.mask[:, 0]).scale.mean()

    constant = float(f"{1 / float(mean_scale(jax.random.key(training.seed), shapes)):.3g}")
    return dataclasses.replace(model, encoder=dataclasses.replace(model.encoder, output_scale=constant))
