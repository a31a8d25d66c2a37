"""The shapes a run draws from: every source once in memory, drawn from as often as it is named."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from train.shards.packed_shapes import read_shapes
from train.shards.shards import Shapes, load_shapes


def load_mix(sources: Sequence[Path], split: str) -> tuple[Shapes, Int[np.ndarray, " rows"]]:
    """The shapes of a split, and the rows to draw from: those of a source named twice stand there twice.

    A source is a folder of shards or a file of `train.tools.pack`. Raises ValueError where the split is empty or
    sources differ in views or points a shape; queries are cut to the smallest source's.
    """
    once = list(dict.fromkeys(sources))
    loaded = [read_shapes(s, split) if s.suffix == ".npz" else load_shapes(s, split) for s in once]
    if len({s.views.shape[1:] for s in loaded}) > 1:
        got = ", ".join(f"{path}: {s.views.shape[1:3]}" for path, s in zip(once, loaded, strict=True))
        raise ValueError(f"views and points a shape differ ({got}); needed the same in all sources")
    first = np.cumsum([0, *(len(s.views) for s in loaded)])
    rows = [np.arange(first[k], first[k + 1]) for k in map(once.index, sources)]
    least = {name: min(getattr(s, name).shape[1] for s in loaded) for name in ("sdf_uniform", "sdf_near")}
    cut = [
        dataclasses.replace(s, **{name: getattr(s, name)[:, :n] for name, n in least.items()}) for s in loaded
    ]
    if len(cut) == 1:  # a copy less of what may be gigabytes
        return cut[0], np.concatenate(rows)
    return jax.tree.map(lambda *arrays: jnp.concatenate(arrays), *cut), np.concatenate(rows)
