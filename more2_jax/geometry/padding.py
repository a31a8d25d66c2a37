"""Buckets, padding, masks: the only place that knows clouds are ragged, and that frames lie far from zero."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from more2_jax.types import PointCloud

MIN_POINTS = 256  # the smallest bucket of points
LEAST_LENGTH = 1e-6  # of a normal that is one
MAX_POINTS = 2048  # what a stage looks at of one object; more is kept by the scene, and thinned evenly here


def bucket(count: int, smallest: int = 1) -> int:
    """The next power of two, so that few programs are compiled."""
    return max(smallest, 1 << max(count - 1, 0).bit_length())


Rows = Float[np.ndarray, "_ 3"]


def pad_clouds(
    clouds: Sequence[Rows], size: int | None = None, normals: Sequence[Rows | None] | None = None
) -> PointCloud:
    """Batches ragged clouds: (objects, bucket, 3), centered on each cloud's own `origin` (float64).

    The point farthest from the mean comes first. Farthest-point sampling starts there, so the order of a cloud's
    points does not matter. Clouds beyond `MAX_POINTS` are thinned evenly by index. `size` sets the
    bucket. `normals`: the points' unit normals, outward; None for a cloud, or zeros for a point, where not known.
    Raises ValueError on an empty list, a shape that is not (n, 3), no points, points that are not finite, and normals
    that are not as many as the points.
    """
    if not len(clouds):
        raise ValueError("pad_clouds got no clouds; needed at least one")
    whole = [_check(np.asarray(cloud, np.float64), i) for i, cloud in enumerate(clouds)]
    checked = [cloud[_kept(len(cloud))] for cloud in whole]
    size = size or bucket(max(map(len, checked)), MIN_POINTS)
    orders = [_order(cloud, size) for cloud in checked]
    origins = np.stack([cloud.mean(axis=0) for cloud in checked])
    rows = [(cloud - o)[order] for cloud, o, order in zip(checked, origins, orders, strict=True)]
    masks = np.stack([np.arange(size) < len(cloud) for cloud in checked])
    turned = None
    if normals is not None:
        known = [_directions(n, len(c), i) for i, (n, c) in enumerate(zip(normals, whole, strict=True))]
        turned = np.stack([n[_kept(len(n))][o] for n, o in zip(known, orders, strict=True)])
    # Placed, not converted by jnp: that compiles a program for every number of clouds.
    points, mask, turned = jax.device_put((np.stack(rows).astype(np.float32), masks, turned))
    return PointCloud(points=points, mask=mask, origin=origins, normals=turned)


def _kept(count: int) -> np.ndarray:
    """Rows of a cloud that stay: all, or `MAX_POINTS` of them, evenly."""
    return np.linspace(0, count - 1, min(count, MAX_POINTS)).astype(int)


def _directions(normals: np.ndarray | None, count: int, index: int) -> np.ndarray:
    """Rows of unit length or zero, float32."""
    if normals is None:
        return np.zeros((count, 3), np.float32)
    if normals.shape != (count, 3):
        raise ValueError(
            f"cloud {index} has normals of shape {normals.shape}; needed ({count}, 3), as its points"
        )
    given = np.nan_to_num(np.asarray(normals, np.float64), nan=0.0, posinf=0.0, neginf=0.0)
    length = np.linalg.norm(given, axis=1, keepdims=True)
    return np.where(length > LEAST_LENGTH, given / np.maximum(length, LEAST_LENGTH), 0.0).astype(np.float32)


def _check(cloud: np.ndarray, index: int) -> np.ndarray:
    if cloud.ndim != 2 or cloud.shape[1] != 3 or len(cloud) == 0:
        raise ValueError(f"cloud {index} has shape {cloud.shape}; needed (n, 3) with n ≥ 1")
    if bad := int((~np.isfinite(cloud).all(axis=1)).sum()):
        raise ValueError(f"cloud {index} has {bad} points that are not finite; needed finite coordinates")
    return cloud


def _order(cloud: np.ndarray, size: int) -> np.ndarray:
    """Rows in a bucket's order: the farthest from the mean first, which the filler repeats."""
    if len(cloud) > size:
        raise ValueError(f"a cloud has {len(cloud)} points; needed at most the bucket's {size}")
    first = int(np.argmax(((cloud - cloud.mean(axis=0)) ** 2).sum(axis=1)))
    return np.r_[first, np.delete(np.arange(len(cloud)), first), np.full(size - len(cloud), first)]


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
        normals=None if cloud.normals is None else cloud.normals[jnp.asarray(chosen)],
    )
