"""Trains one learned peer on the shapes, samples and flaws that the prior is trained on.

`python -m eval.peers.learned.train vn_dgcnn --shards train/shapes/open.npz --out runs/vn_dgcnn.npz --minutes 15`
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro
from jax import Array
from jaxtyping import Float, Int
from rich.console import Console

from eval.peers.learned.registry import (
    LearnedPeer,
    Params,
    Trained,
    Training,
    load,
    parameters,
    peer_named,
    save,
    start,
)
from train.run.program import run
from train.run.shape_mix import load_mix
from train.shards.sampling import TrainingSample, sample_batch
from train.shards.settings import SampleConfig
from train.shards.shards import Shapes

# As `configs/small.yaml` has them: a peer sees the clouds that the shipped prior saw.
SAMPLES = SampleConfig(queries=384, raw_points=768, max_views=4, one_view_probability=0.4)
WARMUP, LAST = (
    0.02,
    0.01,
)  # share of the run in which the rate rises; share of the peak that the cosine ends at
CLIP = 1.0  # of the gradient's norm
SAVE_EVERY_S = 60.0  # of processor time


def main(
    name: Annotated[str, tyro.conf.Positional],
    shards: tuple[Path, ...],
    out: Path,
    minutes: float = 15.0,
    steps: int = 0,
    seed: int = 0,
    begin: Path | None = None,
) -> None:
    """Trains a learned peer, and leaves its weights.

    Args:
        name: vn_dgcnn, vn_onet, … as `eval.peers.learned.registry` lists them.
        shards: folders of `python -m train.prepare` or files of `train.tools.pack`; one that is named twice is drawn
            from twice as often.
        out: the weight file, written every minute, too.
        minutes: of one core's time, after compiling; the learning rate falls with it.
        steps: so many instead, if above 0: then a run repeats exactly.
        seed: of weights and samples.
        begin: weights of an earlier run, also one that was stopped, to go on from; its minutes are added.
    """
    peer = peer_named(name)
    if steps < 0 or minutes <= 0:
        raise ValueError(f"steps {steps}, minutes {minutes}; needed 0 steps or more, and minutes above 0")
    shapes, rows = load_mix(shards, "train")
    first = begun(name, seed, begin)
    Console().print(
        f"{peer.title}: {parameters(first.params):,} parameters, {len(shapes.views)} shapes", highlight=False
    )
    done = fit(first, shapes, jnp.asarray(rows), Length(steps=steps, minutes=minutes), seed, out)
    save(done, out)
    Console().print(f"{done.training}", highlight=False)


def begun(name: str, seed: int, begin: Path | None) -> Trained:
    """Weights that a run begins with: random ones, or those of an earlier run. ValueError if these are another's."""
    if begin is None:
        none = Training(steps=0, minutes=0.0, shapes=0, clouds=0, loss=float("nan"))
        return Trained(name=name, params=start(name, seed), training=none)
    found = load(str(begin))
    if found.name != name:
        raise ValueError(f"{begin}: weights of {found.peer.title}; needed those of {peer_named(name).title}")
    return found


@dataclass(frozen=True, kw_only=True)
class Length:
    """How long a run is: of so many steps, or, where these are 0, of so many minutes."""

    steps: int
    minutes: float  # of processor time

    def share(self, steps: int, began: float) -> float:
        """How much of it is behind after so many steps since `began`."""
        return steps / self.steps if self.steps else (time.process_time() - began) / (60 * self.minutes)


def fit(
    first: Trained, shapes: Shapes, rows: Int[Array, " r"], length: Length, seed: int, out: Path
) -> Trained:
    """The peer after a run; what it has learned so far is written to `out` every minute."""
    peer, params, past = first.peer, first.params, first.training.steps
    key = jax.random.key(seed)
    state: Any = optimizer().init(params)
    losses: list[float] = []
    began = saved = time.process_time()
    while (share := length.share(len(losses), began)) < 1:
        keys = jax.random.split(jax.random.fold_in(key, past + len(losses)))  # other samples than before
        sample = drawn(shapes, rows, keys[0], batch=peer.batch, points=peer.points)
        learning_rate = jnp.float32(rate(share) * peer.learning_rate)
        params, state, loss = step(params, state, sample, keys[1], learning_rate, peer=peer)
        losses.append(float(loss))
        if len(losses) == 1:  # compiling is not training
            began = saved = time.process_time()
        if time.process_time() - saved > SAVE_EVERY_S:
            saved = time.process_time()
            save(trained(first, params, losses, began, len(shapes.views)), out)
            Console().print(f"{len(losses)} steps, loss {np.mean(losses[-100:]):.4f}", highlight=False)
    return trained(first, params, losses, began, len(shapes.views))


def trained(first: Trained, params: Params, losses: list[float], began: float, shapes: int) -> Trained:
    """The weights as they are, with how they came about."""
    past = first.training
    training = Training(
        steps=past.steps + len(losses),
        minutes=round(past.minutes + (time.process_time() - began) / 60, 2),
        shapes=shapes,
        clouds=past.clouds + 2 * first.peer.batch * len(losses),
        loss=float(np.mean(losses[-max(len(losses) // 100, 1) :])),
    )
    return Trained(name=first.name, params=params, training=training)


def rate(share: float) -> float:
    """Of the peak, after this share of a run: a rise in a line, then half a cosine."""
    rising = min(share / WARMUP, 1.0)
    return rising * (LAST + (1 - LAST) * 0.5 * (1 + np.cos(np.pi * share)))


def optimizer() -> optax.GradientTransformation:
    """Adam with clipped gradients and a rate of 1, which every step multiplies by its own; see `train.run.state`."""
    return optax.apply_if_finite(
        optax.chain(optax.clip_by_global_norm(CLIP), optax.scale_by_adam()), max_consecutive_errors=20
    )


@partial(jax.jit, static_argnames=("batch", "points"))
def drawn(shapes: Shapes, rows: Int[Array, " r"], key: Array, *, batch: int, points: int) -> TrainingSample:
    """The samples of a step, a program of its own that all peers of one size share: decided by the key alone."""
    index_key, sample_key = jax.random.split(key)
    index = rows[jax.random.randint(index_key, (batch,), 0, len(rows))]
    return sample_batch(sample_key, shapes, index, SAMPLES, points)


@partial(jax.jit, static_argnames="peer", donate_argnames=("params", "state"))
def step(
    params: Params,
    state: Any,
    sample: TrainingSample,
    key: Array,
    learning_rate: Float[Array, ""],
    *,
    peer: LearnedPeer,
) -> tuple[Params, Any, Float[Array, ""]]:
    """One step of Adam: parameters, state, loss. A gradient that is not finite changes nothing."""
    loss, gradient = jax.value_and_grad(lambda p: peer.loss(peer.network, p, sample, key))(params)
    direction, state = optimizer().update(gradient, state, params)
    update = jax.tree.map(lambda x: -learning_rate * x, direction)
    return optax.apply_updates(params, update), state, loss


if __name__ == "__main__":
    run(main)
