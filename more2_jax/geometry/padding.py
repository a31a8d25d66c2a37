"""Buckets, padding, masks: the only place that knows clouds are ragged, and that frames lie far from zero."""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from more2_jax.types import PointCloud

MIN_POINTS = 256  # the smallest bucket of points
MAX_POINTS = 2048  # what a stage looks at of one object; more is kept by the scene, and thinned evenly here


def bucket(count: int, smallest: int = 1) -> int:
    """The next power of two, so that few programs are compiled."""
    return max(smallest, 1 << max(count - 1, 0).bit_length())


def pad_clouds(clouds: Sequence[Float[np.ndarray, "_ 3"]], size: int | None = None) -> PointCloud:
    """Batches ragged clouds: (objects, bucket, 3), centered on each cloud's own `origin` (float64).

    The point farthest from the mean comes first: farthest-point sampling starts there, so that the order of
    a cloud's points does not matter. Clouds beyond `MAX_POINTS` are thinned evenly by index. `size` sets the
    bucket. Raises ValueError on an empty list, a shape that is not (n, 3), no points, or points that are not finite.
    """
    if not len(clouds):
        raise ValueError("pad_clouds got no clouds; needed at least one")
    checked = [_check(np.asarray(cloud, np.float64), i) for i, cloud in enumerate(clouds)]
    size = size or bucket(max(map(len, checked)), MIN_POINTS)
    rows = [_pad(cloud, size) for cloud in checked]
    points, masks, origins = (np.stack(part) for part in zip(*rows, strict=True))
    return PointCloud(points=jnp.asarray(points), mask=jnp.asarray(masks), origin=origins)


def _check(cloud: np.ndarray, index: int) -> np.ndarray:
    if cloud.ndim != 2 or cloud.shape[1] != 3 or len(cloud) == 0:
        raise ValueError(f"cloud {index} has shape {cloud.shape}; needed (n, 3) with n ≥ 1")
    if bad := int((~np.isfinite(cloud).all(axis=1)).sum()):
        raise ValueError(f"cloud {index} has {bad} points that are not finite; needed finite coordinates")
    if len(cloud) > MAX_POINTS:
        cloud = cloud[np.linspace(0, len(cloud) - 1, MAX_POINTS).astype(int)]
    return cloud


def _pad(cloud: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    if len(cloud) > size:
        raise ValueError(f"a cloud has {len(cloud)} points; needed at most the bucket's {size}")
    origin = cloud.mean(axis=0)
    centered = cloud - origin
    first = int(np.argmax((centered**2).sum(axis=1)))
    order = np.r_[first, np.delete(np.arange(len(cloud)), first), np.full(size - len(cloud), first)]
    return centered[order].astype(np.float32), np.arange(size) < len(cloud), origin


def pad_batch(cloud: PointCloud, count: int) -> PointCloud:
    """Repeats the first cloud until the batch has `count`; callers drop the fillers' results."""
    index = np.r_[np.arange(len(cloud.points)), np.zeros(count - len(cloud.points), int)]
    return take(cloud, index)


def take(cloud: PointCloud, index: np.ndarray | Sequence[int]) -> PointCloud:
    """The clouds of a batch named by `index`, with their float64 origins."""
    chosen = np.asarray(index, int)
    return PointCloud(
        points=cloud.points[jnp.asarray(chosen)],
        mask=cloud.mask[jnp.asarray(chosen)],
        origin=np.asarray(cloud.origin)[chosen],
    )
