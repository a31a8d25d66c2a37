"""Clouds of a scene to embeddings and back: padded batches in, one embedding per object out (host arrays)."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import partial

import jax
import numpy as np
from jaxtyping import Bool

from more2_jax.geometry.padding import MAX_POINTS, Rows, bucket, pad_batch, pad_clouds
from more2_jax.network.prior import Prior, encode
from more2_jax.network.row_map import chunked
from more2_jax.types import Embedding, PointCloud

SMALLEST_BATCH = 8  # of `padded` and `stack`: scenes of any size share their compiled programs
# Encoded in a call: many ask for one cloud or two. On accelerators so many times as many.
CLOUDS_A_CALL, WIDER = 2, 32
PADDED_TOGETHER = 64  # clouds, a whole number of calls also on accelerators


def padded(
    clouds: Sequence[Rows], smallest: int = SMALLEST_BATCH, normals: Sequence[Rows | None] | None = None
) -> PointCloud:
    """Ragged clouds as one batch of one shape for all scenes: (bucket, `MAX_POINTS`, 3). Fillers repeat the first."""
    return pad_batch(pad_clouds(clouds, MAX_POINTS, normals), bucket(len(clouds), smallest))


def embed(
    prior: Prior, clouds: Sequence[Rows], normals: Sequence[Rows | None] | None = None
) -> list[Embedding]:
    """One embedding per cloud; `normals` as `pad_clouds` takes them."""
    found = list[Embedding]()
    for start in range(0, max(len(clouds), 1), PADDED_TOGETHER):
        some = slice(start, start + PADDED_TOGETHER)
        batch = pad_clouds(clouds[some], MAX_POINTS, None if normals is None else normals[some])
        batch, origin = dataclasses.replace(batch, origin=None), batch.origin
        codes = chunked(partial(encode, prior), CLOUDS_A_CALL, batch, WIDER)
        found += unstack(dataclasses.replace(codes, origin=origin), len(clouds[some]))
    return found


def unstack(batch: Embedding, count: int) -> list[Embedding]:
    """The first `count` embeddings of a batch, as host arrays of their own: none keeps the batch in memory."""
    host = jax.device_get(batch)
    return [jax.tree.map(lambda x, k=k: np.array(x[k]), host) for k in range(count)]


def stack(
    embeddings: Sequence[Embedding], smallest: int = SMALLEST_BATCH
) -> tuple[Embedding, Bool[np.ndarray, " b"]]:
    """A batch of fixed size and which of its rows are real; the fillers repeat the first."""
    count = bucket(len(embeddings), smallest)
    rows = [*embeddings, *[embeddings[0]] * (count - len(embeddings))]
    return jax.tree.map(lambda *x: np.stack(x), *rows), np.arange(count) < len(embeddings)
