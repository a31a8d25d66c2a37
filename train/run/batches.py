"""The shapes of every step: all in memory, or read from disk a batch at a time where memory is too small for them.

Both ways give a step the same numbers. Which shapes it sees depends on the seed and on the step's number alone.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator

import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array, Int

from train.run.devices import everywhere, to_read
from train.run.settings import TrainingConfig
from train.run.shape_mix import ShapeMix
from train.shards.shards import Shapes

Batch = tuple[Shapes, Int[Array, " b"]]  # on every device: shapes, and which of them are the batch
Batches = Callable[[int], Iterator[Batch]]  # from a step on

READERS, AHEAD = 2, 4  # threads that read from disk, and batches that wait ready


def chosen(rows: Int[np.ndarray, " rows"], config: TrainingConfig, step: int) -> Int[np.ndarray, " b"]:
    """The shapes of a step's batch; one that stands in `rows` twice is drawn twice as often."""
    return np.random.default_rng((config.seed, step)).choice(rows, config.batch)


def resident(mix: ShapeMix, config: TrainingConfig, mesh: Mesh) -> Batches:
    """Batches of shapes that are all in memory, read once, here."""
    shapes = to_read(mesh, mix.read(range(len(mix))))

    def batches(step: int) -> Iterator[Batch]:
        for number in itertools.count(step):
            yield shapes, everywhere(mesh, jnp.asarray(chosen(mix.rows, config, number)))

    return batches


def streamed(mix: ShapeMix, config: TrainingConfig, mesh: Mesh) -> Batches:
    """Batches read from disk by threads ahead of the step that takes them. Raises ValueError if grain is missing."""
    try:
        import grain.python as grain
    except ImportError as error:
        raise ValueError("grain is not installed; needed: pip install 'more2-jax[train]'") from error
    options = grain.ReadOptions(num_threads=READERS, prefetch_buffer_size=AHEAD)

    def batches(step: int) -> Iterator[Batch]:
        steps = grain.MapDataset.range(step, config.steps)
        index = everywhere(mesh, jnp.arange(config.batch))
        for shapes in steps.map(lambda n: mix.read(chosen(mix.rows, config, n))).to_iter_dataset(options):
            yield to_read(mesh, shapes), index

    return batches


def batches_of(mix: ShapeMix, config: TrainingConfig, mesh: Mesh, most_bytes: float) -> Batches:
    """From memory where the shapes take at most `most_bytes`, from disk otherwise."""
    return (resident if mix.nbytes <= most_bytes else streamed)(mix, config, mesh)
