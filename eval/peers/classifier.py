"""A learned peer of matching: the same encoder trained to name categories, as VN-DGCNN is, and matched by its F_inv.

`python -m eval.peers.classifier --config configs/small.yaml --shards data/real --out runs/classifier.npz`
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array
from jaxtyping import Float, Int
from rich.console import Console
from rich.progress import track

from eval.harness.batched import embed_all
from eval.peers.matching import Matched, Matcher, assigned
from more2_jax.config import PriorConfig, load_config
from more2_jax.network.prior import Prior, encode_ordered, load_prior, save_prior
from more2_jax.types import Instance
from train.run.program import run
from train.run.schedule import learning_rate
from train.run.settings import TrainingConfig, TrainingRun
from train.run.shape_mix import load_mix, open_mix
from train.run.start import started_cold
from train.shards.sampling import TrainingSample, sample_batch
from train.shards.shards import Shapes, open_shards

NAME = "VN-DGCNN, trained on categories"


def main(config: Path, shards: tuple[Path, ...], out: Path, steps: int = 600) -> None:
    """Trains encoder and a linear layer on the categories of partial clouds; leaves the encoder's weights.

    Args:
        config: YAML with `model` and `training`: widths, how shapes are sampled, learning rate.
        shards: folders that `python -m train.prepare` wrote; one that is named twice is drawn from twice as often.
        out: the weight file. Its decoder is random.
        steps: of Adam.
    """
    settings = load_config(config, TrainingRun)
    training = dataclasses.replace(settings.training, steps=steps)
    shapes, rows = load_mix(shards, "train")
    names, labels = categories(list(dict.fromkeys(shards)))
    prior = started_cold(settings, open_mix(shards, "train"), "classifier")
    head = jnp.zeros((prior.config.encoder.code, len(names)))
    params: dict[str, Any] = {"encoder": prior.params["encoder"], "head": head}
    state: Any = optimizer(training).init(params)
    here, of_row = jnp.asarray(rows), jnp.asarray(labels)
    for number in track(range(steps), description=f"{len(names)} categories"):
        sample, index = drawn(
            shapes, here, jnp.asarray(number), config=training, points=prior.config.encoder.points
        )
        params, state, scores = step(
            params, state, sample, of_row[index], model=prior.config, config=training
        )
        if number % 100 == 99:
            Console().print(number + 1, {k: round(float(v), 3) for k, v in scores.items()}, highlight=False)
    out.parent.mkdir(parents=True, exist_ok=True)
    save_prior(dataclasses.replace(prior, params=prior.params | {"encoder": params["encoder"]}), out)


def categories(sources: Sequence[Path]) -> tuple[list[str], Int[np.ndarray, " shapes"]]:
    """The names of all categories, and the number of each training shape's, in the order that shapes are loaded."""
    given = [m["category"] for s in sources for m in open_shards(s, "train").meta]
    names = sorted(set(given))
    return names, np.array([names.index(c) for c in given])


@partial(jax.jit, static_argnames=("config", "points"))
def drawn(
    shapes: Shapes, rows: Int[Array, " r"], number: Int[Array, ""], *, config: TrainingConfig, points: int
) -> tuple[TrainingSample, Int[Array, " b"]]:
    """The batch of a step, and which shapes it is of: functions of (seed, number) alone."""
    index_key, sample_key = jax.random.split(jax.random.fold_in(jax.random.key(config.seed), number))
    index = rows[jax.random.randint(index_key, (config.batch,), 0, len(rows))]
    return sample_batch(sample_key, shapes, index, config, points), index


def optimizer(config: TrainingConfig) -> optax.GradientTransformation:
    """Adam with clipped gradients."""
    return optax.chain(optax.clip_by_global_norm(config.clip), optax.adam(learning_rate(config)))


@partial(jax.jit, static_argnames=("model", "config"), donate_argnames=("params", "state"))
def step(
    params: dict[str, Any],
    state: Any,
    sample: TrainingSample,
    category: Int[Array, " b"],
    *,
    model: PriorConfig,
    config: TrainingConfig,
) -> tuple[dict[str, Any], Any, dict[str, Array]]:
    """One step of Adam on the cross-entropy of both clouds of every shape: parameters, state, scores."""
    label = jnp.repeat(category[:, None], 2, axis=1)

    def loss(params: dict[str, Any]) -> tuple[Float[Array, ""], Float[Array, ""]]:
        prior = Prior(params={"encoder": params["encoder"]}, config=model)
        codes = jax.vmap(jax.vmap(partial(encode_ordered, prior)))(sample.points, sample.mask)
        logits = model.inv_gain * codes.inv @ params["head"]
        right = (jnp.argmax(logits, axis=-1) == label).mean()
        return optax.softmax_cross_entropy_with_integer_labels(logits, label).mean(), right

    (value, right), gradient = jax.value_and_grad(loss, has_aux=True)(params)
    update, state = optimizer(config).update(gradient, state, params)
    return optax.apply_updates(params, update), state, {"loss": value, "right": right}  # pyright: ignore[reportReturnType]


def classifier(weights: Path, batch: int) -> Matcher:
    """Hungarian on the cosine of F_inv. Raises ValueError if `weights` is no weight file."""
    prior = load_prior(weights)

    def match(one: Sequence[Instance], other: Sequence[Instance]) -> Matched:
        codes = embed_all(prior, [i.points for s in (one, other) for i in s], batch)
        inv = np.stack([np.asarray(c.inv, float) for c in codes])
        inv /= np.maximum(np.linalg.norm(inv, axis=1, keepdims=True), 1e-12)
        return assigned(one, other, -inv[: len(one)] @ inv[len(one) :].T)

    return match


if __name__ == "__main__":
    run(main)
