"""Training shards (from `python -m train.prepare`) in memory."""

from __future__ import annotations

from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from more2_jax.types import pytree


@pytree
class Shapes:
    """Training shapes in canonical units (centred, longest edge 0.9), float16."""

    views: Float[Array, "shapes views n 3"]  # back-projected depth maps
    sdf_uniform: Float[Array, "shapes q 4"]  # x y z and signed distance, negative inside
    sdf_near: Float[Array, "shapes q 4"]


def load_shapes(folder: str | Path, split: str) -> Shapes:
    """Loads every finished shard of `folder`, `split` 'train' or 'val'. ValueError if there is none."""
    parts: dict[str, list[np.ndarray]] = {"views": [], "sdf_uniform": [], "sdf_near": []}
    for path in sorted(Path(folder).glob("*.npz")):
        with np.load(path, allow_pickle=False) as shard:
            # A shard whose every mesh was rejected is empty, and its arrays have no shape to speak of.
            if len(chosen := np.flatnonzero(shard["splits"].astype(str) == split)):
                for name, part in parts.items():
                    part.append(shard[name][chosen])
    if not parts["views"]:
        raise ValueError(f"{folder}: no {split} shapes; `python -m train.prepare` makes shards")
    return Shapes(**{name: jnp.asarray(np.concatenate(part)) for name, part in parts.items()})
