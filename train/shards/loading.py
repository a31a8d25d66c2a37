"""Training batches from shards on disk: grain orders, shards and prefetches, NumPy reads, `sampling` does the rest.

Step s of seed k is the same batch in every run, however often it was stopped and over however many processes:
global sample n = s · batch + row is shape order(n), each epoch a permutation of its own (a batch may span two).
Process p of P holds rows [p · batch / P, (p + 1) · batch / P): joined in the order of p they are the global batch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np
from jax import Array

from train.shards.sampling import TrainingSample, row_keys, sample_rows
from train.shards.settings import SampleConfig
from train.shards.shards import Shapes, ShardView, open_shards

if TYPE_CHECKING:
    import grain.python as grain

WINDOW = 8  # rows read for every one drawn, of either kind of query


@dataclass(frozen=True, kw_only=True)
class BatchReader:
    """Reads the rows of one process from a global batch."""

    view: ShardView
    queries: int
    seed: int
    first: int  # row of the global batch
    count: int

    def __call__(self, step: int, shapes: np.ndarray) -> dict[str, Any]:
        """The arrays of global batch `step` (indices `shapes`) that this process needs.

        Row 0 is the shape before the first, whose fragments may lie beside it; then this process's rows.
        """
        batch = len(shapes)
        rows = [(self.first + i) % batch for i in range(-1, self.count)]
        records = [self._record(int(shapes[row]), step * batch + row) for row in rows]
        arrays = {name: np.stack([r[name] for r in records]) for name in records[0]}
        return arrays | {"step": step, "rows": np.arange(self.first, self.first + self.count)}

    def _record(self, shape: int, sample: int) -> dict[str, np.ndarray]:
        # Stored queries are in random order, so a window of them is a fair draw, and one read from disk.
        rng = np.random.default_rng((self.seed, sample))
        stored, record = self.view[shape], {}
        for name in ("sdf_uniform", "sdf_near"):
            length = min(len(stored[name]), max(1, WINDOW * self.queries // 2))
            start = int(rng.integers(len(stored[name]) - length + 1))
            record[name] = np.asarray(stored[name][start : start + length])
        return {"views": np.asarray(stored["views"]), **record}


def training_records(
    view: ShardView,
    config: SampleConfig,
    seed: int,
    batch: int,
    process_index: int = 0,
    process_count: int = 1,
) -> grain.MapDataset[dict[str, Any]]:
    """What `sample_records` needs, a row a step without end: `dataset[s]` is step s. NumPy only.

    Raises ValueError if grain is missing or the processes do not divide the batch.
    """
    try:
        import grain.python as grain
    except ImportError as error:
        raise ValueError("grain is not installed; needed: pip install 'more2-jax[train]'") from error
    if not 0 <= process_index < process_count:
        raise ValueError(f"process {process_index} of {process_count}; needed 0 <= index < count")
    if batch < 1 or batch % process_count:
        raise ValueError(f"batch {batch} for {process_count} processes; needed a positive multiple")
    if not 0 <= seed < 2**32:
        raise ValueError(f"seed {seed}; needed 0 <= seed < 2**32")
    share = batch // process_count
    reader = BatchReader(
        view=view, queries=config.queries, seed=seed, first=process_index * share, count=share
    )
    order = grain.MapDataset.range(len(view)).shuffle(seed=seed).repeat()
    return order.batch(batch).map_with_index(reader)


def step_key(seed: int, step: int) -> Array:
    """The key of a step's global batch, as `sample_batch` takes it."""
    return jax.random.fold_in(jax.random.key(seed), step)


def sample_records(records: dict[str, Any], seed: int, config: SampleConfig, points: int) -> TrainingSample:
    """The samples of what `training_records` read, computed where its arrays are (NumPy: the default device)."""
    arrays = {name: records[name] for name in ("views", "sdf_uniform", "sdf_near")}
    return _sample(arrays, records["rows"], seed, records["step"], config, points)


@jax.jit(static_argnames=("config", "points"))
def _sample(
    arrays: dict[str, Array], rows: Array, seed: Array, step: Array, config: SampleConfig, points: int
) -> TrainingSample:
    keys = row_keys(jax.random.fold_in(jax.random.key(seed), step), rows)
    index = np.arange(1, len(rows) + 1)
    return sample_rows(keys, Shapes(**arrays), index, index - 1, config, points)  # type: ignore[arg-type]


def training_samples(
    folders: str | Path | Sequence[str | Path],
    split: str,
    config: SampleConfig,
    points: int,
    seed: int,
    batch: int,
    process_index: int = 0,
    process_count: int = 1,
    start_step: int = 0,
    threads: int = 2,
    ahead: int = 4,
) -> grain.DatasetIterator[TrainingSample]:
    """An endless iterator of this process's batches from `start_step` on, made on the CPU by `threads` threads.

    `points` is the encoder's input size; `batch` counts over all processes; `ahead` batches wait ready. get_state()
    is {"next_index": step}, so the number of the step is all that a checkpoint must hold. For training on an
    accelerator, `training_records` with `sample_records` in the step leaves the host only the reading.

    Raises ValueError for shards, processes or a batch that do not fit, or where JAX has no CPU to compute on.
    """
    records = training_records(open_shards(folders, split), config, seed, batch, process_index, process_count)
    if start_step < 0 or threads < 1 or ahead < 1:
        raise ValueError(
            f"start_step {start_step}, threads {threads}, ahead {ahead}; needed >= 0, >= 1, >= 1"
        )
    import grain.python as grain

    cpu = host()

    def sample(read: dict[str, Any]) -> TrainingSample:
        with jax.default_device(cpu):
            return jax.block_until_ready(sample_records(read, seed, config, points))

    sample(dict(records[start_step] or {}))  # compiled once, here, and not by every thread at the same time
    options = grain.ReadOptions(num_threads=threads, prefetch_buffer_size=ahead)
    iterator = iter(records.map(sample).to_iter_dataset(options))
    iterator.set_state({"next_index": start_step})
    return iterator


def host() -> Any:
    """JAX's CPU device. ValueError where JAX was told to leave it out."""
    try:
        return jax.local_devices(backend="cpu")[0]
    except RuntimeError as error:
        raise ValueError("JAX has no CPU backend; needed JAX_PLATFORMS that names cpu too") from error
