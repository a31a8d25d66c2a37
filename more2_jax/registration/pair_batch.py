"""Objects and pairs of objects as the device sees them: padded once, each about an origin of its own."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int

from more2_jax.geometry.free_space import padded_sights
from more2_jax.geometry.padding import MAX_POINTS, bucket, pad_clouds
from more2_jax.geometry.poses import local_poses, world_poses
from more2_jax.network.prior import Prior, encode
from more2_jax.registration.search import AlignableObject
from more2_jax.types import Embedding, LocalBatch, ObservedObject, PointCloud, Sight, pytree, quantity

AROUND_POINTS = 1024  # of what lies around an object


@pytree
class PairBatch:
    """Pairs of objects: row i of `source` is to be moved onto row i of `target`."""

    source: LocalBatch = quantity("record")
    target: LocalBatch = quantity("record")
    stayed: jaxlie.SE3 = quantity("pose")  # (*batch,): "it did not move", source's local frame to target's
    # (*batch, k): poses found before, which registration refines; None: it searches for its own.
    candidates: jaxlie.SE3 | None = quantity("pose", default=None)
    # (*batch,): known not to have moved, whatever fits closer; None: of none.
    stands: Bool[Array | np.ndarray, "*batch"] | None = quantity("invariant", default=None)
    # Source and target as the search that found the candidates prepared them; None: registration does.
    prepared: tuple[AlignableObject, AlignableObject] | None = quantity("record", default=None)

    def __len__(self) -> int:
        return self.source.cloud.points.shape[0]

    def local(self) -> PairBatch:
        """Without the origins: what compiled programs take."""
        source, target = (dataclasses.replace(side, origin=None) for side in (self.source, self.target))
        return dataclasses.replace(self, source=source, target=target)

    def to_world(self, poses: jaxlie.SE3) -> Float[np.ndarray, "*batch 4 4"]:
        """Poses T_target_source between the scans' own frames, float64, from local ones: (batch,) or (batch, k)."""
        origins = [host_origin(side) for side in (self.target, self.source)]
        if len(poses.wxyz_xyz.shape) == 3:
            origins = [o[:, None] for o in origins]
        return world_poses(poses, *origins)


def pair_up(
    source: LocalBatch,
    target: LocalBatch,
    T_target_source: Float[np.ndarray, "4 4"] | Float[np.ndarray, "b 4 4"] | None = None,
    candidates: jaxlie.SE3 | None = None,
) -> PairBatch:
    """Pairs row i of `source` with row i of `target`.

    `T_target_source` is the pose of the source's scan in the target's frame, so that of an object that did not move;
    by default both scans share a frame. `candidates` (b, k) are local poses. Raises ValueError if the batches differ.
    """
    sizes = [len(x) for side in (source, target) for x in (side.cloud.points, side.code.scale)]
    if len(set(sizes)) != 1:
        raise ValueError(f"pair_up got {sizes} clouds and codes of sources and targets; needed equal numbers")
    # Objects without an origin are about the zero of their scan's frame.
    origins = [np.zeros((sizes[0], 3)) if s.origin is None else s.origin for s in (source, target)]
    if any(isinstance(o, Tracer) for o in origins):
        shift = jnp.asarray(origins[0]) - jnp.asarray(origins[1])
        stayed = jaxlie.SE3.from_rotation_and_translation(jaxlie.SO3.identity((len(shift),)), shift)
    else:
        T = np.broadcast_to(np.eye(4) if T_target_source is None else T_target_source, (sizes[0], 4, 4))
        stayed = local_poses(T, np.asarray(origins[1]), np.asarray(origins[0]))
    return PairBatch(source=source, target=target, stayed=stayed, candidates=candidates)


def host_origin(batch: LocalBatch) -> Float[np.ndarray, "b 3"]:
    """Where each object's local zero lies in its scan's frame; a batch without origins lies about that frame's zero."""
    if batch.origin is None:
        return np.zeros((len(batch.cloud.points), 3))
    return np.asarray(batch.origin, np.float64)


def local_batch(
    objects: Sequence[ObservedObject],
    size: int | None = None,
    part_of: Sequence[ObservedObject] | None = None,
) -> LocalBatch:
    """Objects as one batch of one shape for all scenes: (size, `MAX_POINTS`, 3), on the host.

    Fillers repeat the first object; `size` is by default the next power of two. `part_of`: the objects of the whole
    scan; what any of these has (normals, what sensors saw, what lies around) the batch has too, blank where its own
    have none.
    """
    every = objects if part_of is None else part_of
    known = None if all(o.normals is None for o in every) else [o.normals for o in objects]
    padded = pad_clouds([o.points for o in objects], MAX_POINTS, known)
    at = np.arange(size or bucket(len(objects)))
    at = np.where(at < len(objects), at, 0)
    # On the host: every size would be compiled anew.
    cloud = jax.tree.map(lambda x: np.asarray(x)[at], padded)
    origin = np.asarray(cloud.origin)
    code = jax.tree.map(lambda *x: np.stack(x), *(objects[k].embedding for k in at))
    sight = padded_sights([o.sight for o in objects], origin, any(o.sight is not None for o in every))
    around = None
    if any(o.around is not None for o in every):
        around = padded_around([objects[k].around for k in at], origin)
    return dataclasses.replace(batch_of(cloud, code, sight), around=around)


def padded_around(
    around: Sequence[Float[np.ndarray, "_ 3"] | None], origin: Float[np.ndarray, "b 3"]
) -> PointCloud:
    """What lies around every object, about its origin, thinned evenly to `AROUND_POINTS`."""
    rows = np.zeros((len(origin), AROUND_POINTS, 3), np.float32)
    mask = np.zeros((len(origin), AROUND_POINTS), bool)
    for k, points in enumerate(around):
        if points is not None and len(points):
            some = points[np.linspace(0, len(points) - 1, min(len(points), AROUND_POINTS)).astype(int)]
            rows[k, : len(some)], mask[k, : len(some)] = some - origin[k], True
    return PointCloud(points=rows, mask=mask)  # type: ignore[arg-type]


def observe(prior: Prior, clouds: Sequence[Float[np.ndarray, "_ 3"]]) -> LocalBatch:
    """Pads and encodes clouds (meters, in their scans' frames) as one batch of objects (paper §3.1).

    Raises ValueError as `pad_clouds` does.
    """
    cloud = pad_clouds(clouds, MAX_POINTS)
    return batch_of(cloud, encode(prior, cloud))


def batch_of(cloud: PointCloud, code: Embedding, sight: Sight | None = None) -> LocalBatch:
    """Clouds and their codes as one batch about the clouds' origins, as `sight` (from `padded_sights`) is already."""
    return LocalBatch(
        cloud=dataclasses.replace(cloud, origin=None),
        code=about(code, cloud.origin),
        sight=sight,
        origin=cloud.origin,
    )


def about(code: Embedding, origin: Float[Array | np.ndarray, "*b 3"] | None) -> Embedding:
    """The code relative to another origin, which it then leaves to its batch; host differences are float64."""
    if code.origin is None or origin is None:
        return dataclasses.replace(code, origin=None)
    if isinstance(code.origin, Tracer) or isinstance(origin, Tracer):
        shift = jnp.asarray(code.origin) - jnp.asarray(origin)
    else:
        shift = np.asarray(np.asarray(code.origin, np.float64) - np.asarray(origin), np.float32)
    return dataclasses.replace(code, center=code.center + shift, origin=None)


def take_pairs(pairs: PairBatch, rows: Sequence[int]) -> PairBatch:
    """The pairs in `rows`, in that order."""
    at = np.asarray(rows, int)
    rest = {k: getattr(pairs, k) for k in ("stayed", "candidates", "stands", "prepared")}
    chosen = jax.tree.map(lambda x: x[at], rest)
    return PairBatch(source=pairs.source.take(at), target=pairs.target.take(at), **chosen)


def paired_rows(
    source: LocalBatch, target: LocalBatch, pairs: Int[np.ndarray, "p 2"], T: Float[np.ndarray, "4 4"]
) -> PairBatch:
    """The pairs (row of `source`, row of `target`) of two batches; `T` as `pair_up` takes it."""
    return pair_up(source.take(pairs[:, 0]), target.take(pairs[:, 1]), T)
