"""The loss of learned peers on shapes that no training draws from, the same samples for all weights of a network.

`python -m eval.peers.learned.validation vn_dgcnn runs/vn_dgcnn.npz --shards train/shapes/open.npz`
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jax import Array
from jaxtyping import Float, Int
from rich.console import Console

from eval.peers.learned.registry import LearnedPeer, Params, Trained, Training, load, start
from eval.peers.learned.train import drawn
from train.run.program import run
from train.run.shape_mix import load_mix
from train.shards.sampling import TrainingSample
from train.shards.shards import Shapes


def main(
    weights: Annotated[tuple[str, ...], tyro.conf.Positional],
    shards: tuple[Path, ...],
    batches: int = 40,
    seed: int = 0,
) -> None:
    """Says the validation loss of weights, and before them that of the random ones training starts from.

    Args:
        weights: names of shipped weights, or files of `eval.peers.learned.train`.
        shards: folders of `python -m train.prepare` or files of `train.tools.pack`; their validation shapes are drawn.
        batches: so many samples of a training step are averaged over.
        seed: of the samples, and of the random weights.
    """
    if batches < 2:
        raise ValueError(f"batches {batches}; needed 2 or more, for a standard error")
    given = list(map(load, weights))
    shapes, rows = load_mix(shards, "val")
    none = Training(steps=0, minutes=0.0, shapes=0, clouds=0, loss=float("nan"))
    first = [
        Trained(name=name, params=start(name, seed), training=none)
        for name in dict.fromkeys(t.name for t in given)
    ]
    for one in sorted((*first, *given), key=lambda t: t.name):
        losses = losses_of(one, shapes, jnp.asarray(rows), batches, seed)
        error = losses.std(ddof=1) / batches**0.5
        Console().print(
            f"{one.peer.title}, {one.training.steps} steps: {losses.mean():.3f} ± {error:.3f}",
            highlight=False,
        )


def losses_of(
    trained: Trained, shapes: Shapes, rows: Int[Array, " r"], batches: int, seed: int
) -> Float[np.ndarray, " batches"]:
    """The loss of every batch; which samples these hold is decided by the seed alone."""
    peer, found = trained.peer, []
    for i in range(batches):
        keys = jax.random.split(jax.random.fold_in(jax.random.key(seed), i))
        sample = drawn(shapes, rows, keys[0], batch=peer.batch, points=peer.points)
        found.append(float(loss(trained.params, sample, keys[1], peer=peer)))
    return np.array(found)


@partial(jax.jit, static_argnames="peer")
def loss(params: Params, sample: TrainingSample, key: Array, *, peer: LearnedPeer) -> Float[Array, ""]:
    """Of one batch."""
    return peer.loss(peer.network, params, sample, key)


if __name__ == "__main__":
    run(main)
