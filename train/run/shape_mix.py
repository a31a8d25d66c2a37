"""The shapes a run draws from: every source once, drawn from as often as it is named."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from train.shards.packed_shapes import read_shapes
from train.shards.shards import MAPPED, Shapes, ShardView, open_shards

MOST_QUERIES = 16_000  # of each kind, a shape: the first ones, their order being random already


@dataclass(frozen=True, kw_only=True)
class ShapeMix:
    """The shapes of several sources, on disk until they are read."""

    views: tuple[ShardView, ...]  # of each source
    rows: Int[np.ndarray, " rows"]  # to draw from: a shape of a source named twice stands there twice
    # How many rows of each of a shape's arrays are read: queries, or views and points.
    sizes: Mapping[str, tuple[int, ...]]

    def __len__(self) -> int:
        return sum(map(len, self.views))

    @property
    def nbytes(self) -> int:
        """Of all shapes in memory."""
        return sum(array.nbytes for array in vars(self.read([0])).values()) * len(self)

    def read(self, index: Iterable[int]) -> Shapes:
        """The shapes `index`, as NumPy arrays; one after the other, so that no second copy is made."""
        first = np.cumsum([0, *map(len, self.views)])
        rows: dict[str, list[np.ndarray]] = {name: [] for name in MAPPED}
        scanned = list[bool]()
        for i in index:
            source = int(np.searchsorted(first, i, side="right")) - 1
            stored = self.views[source][i - first[source]]
            for name, kept in rows.items():
                kept.append(repeated(stored[name], self.sizes[name]))
            scanned.append(bool(stored.get("scanned", False)))
        return Shapes(**{name: np.stack(kept) for name, kept in rows.items()}, scanned=np.array(scanned))  # pyright: ignore[reportArgumentType]


def open_mix(sources: Sequence[Path], split: str) -> ShapeMix:
    """Opens the shapes of a split ('train', 'val', 'test').

    A source is a folder of shards, which stays on disk, or a file of `train.tools.pack`. Where sources differ in views,
    points or queries a shape, the rows of the smaller ones are repeated. Raises ValueError where the split is empty.
    """
    once = list(dict.fromkeys(sources))
    views = tuple(
        in_memory(read_shapes(s, split)) if s.suffix == ".npz" else open_shards(s, split) for s in once
    )
    first = np.cumsum([0, *map(len, views)])
    rows = np.concatenate([np.arange(first[k], first[k + 1]) for k in map(once.index, sources)])
    shapes = [{name: view[0][name].shape[:-1] for name in MAPPED} for view in views]
    largest = {name: np.max([s[name] for s in shapes], axis=0).tolist() for name in MAPPED}
    sizes = {n: tuple(size if len(size) > 1 else [min(MOST_QUERIES, *size)]) for n, size in largest.items()}
    return ShapeMix(views=views, rows=rows, sizes=sizes)


def repeated(rows: np.ndarray, sizes: tuple[int, ...]) -> np.ndarray:
    """The first rows of every axis but the last, so many; from the first again where there are fewer."""
    return rows[np.ix_(*(np.arange(n) % have for n, have in zip(sizes, rows.shape, strict=False)))]


def in_memory(shapes: Shapes) -> ShardView:
    """Shapes that are read already, as a view of one shard."""
    arrays = {name: np.asarray(array) for name, array in vars(shapes).items()}
    rows = tuple((0, k) for k in range(len(arrays["views"])))
    return ShardView(shards=(arrays,), rows=rows, meta=({},) * len(rows))


def load_mix(sources: Sequence[Path], split: str) -> tuple[Shapes, Int[np.ndarray, " rows"]]:
    """The shapes of a split on the default device, and the rows to draw from. ValueError as `open_mix`."""
    mix = open_mix(sources, split)
    return jax.tree.map(jnp.asarray, mix.read(range(len(mix)))), mix.rows
