"""Spheres of several sizes, in the layout of training shards."""

import json
from pathlib import Path

import numpy as np


def sphere_shards(folder: Path) -> Path:
    """Writes one shard of 40 spheres, every fifth of the validation split."""
    rng = np.random.default_rng(0)
    radius = rng.uniform(0.2, 0.45, 40)
    unit = rng.normal(size=(40, 4, 64, 3))
    unit /= np.linalg.norm(unit, axis=-1, keepdims=True)
    queries = rng.uniform(-0.55, 0.55, (40, 200, 3))
    distance = np.linalg.norm(queries, axis=-1) - radius[:, None]
    sdf = np.concatenate([queries, distance[..., None]], axis=-1).astype(np.float16)
    arrays = {"views": unit * radius[:, None, None, None], "sdf_uniform": sdf, "sdf_near": sdf}
    shard = folder / "shard_000"
    shard.mkdir()
    for name, array in arrays.items():
        np.save(shard / f"{name}.npy", array.astype(np.float16))
    meta = [
        {"name": f"sphere_{k}", "category": f"ball {k % 2}", "split": "val" if k % 5 == 0 else "train"}
        for k in range(40)
    ]
    (shard / "meta.json").write_text(json.dumps(meta))
    return folder
