"""Farthest points, nearest neighbors, Kabsch, chamfer: for one cloud or one pair; vmap outside."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import jaxlie
from jax import Array
from jaxtyping import Bool, Float, Int

from more2_jax.geometry.full_precision import full_precision
from more2_jax.geometry.transform import transform
from more2_jax.types import Sampled

TINY = 1e-30
FAR = 1e30  # squared distance to a row that is not there: larger than any, yet finite
ROWS_AT_ONCE = 64  # of distances, on CPUs: what XLA joins with their minimum stays in the caches


def farthest_points(
    points: Float[Array, "n 3"], mask: Bool[Array, " n"], count: int
) -> tuple[Float[Array, "count 3"], Bool[Array, " count"]]:
    """Farthest-point sampling from the first real row; any prefix of the result is itself such a sample.

    Exact duplicates are taken once: rows beyond the distinct points repeat one and are masked out.
    """
    points = cleared(points, mask)
    index, real = farthest_rows(points, mask, count)
    return points[index], real


def cleared(rows: Float[Array, "n 3"], mask: Bool[Array, " n"]) -> Float[Array, "n 3"]:
    """Zeros in masked rows: whatever stands there, even NaN, goes no further."""
    return jnp.where(mask[:, None], rows, 0.0)


def farthest_rows(
    points: Float[Array, "n 3"], mask: Bool[Array, " n"], count: int
) -> tuple[Int[Array, " count"], Bool[Array, " count"]]:
    """Which rows `farthest_points` takes, for what else stands in them; masked points must be finite."""
    x, y, z = fixed = jax.lax.stop_gradient(points).T
    row = jnp.arange(len(points), dtype=jnp.int32)

    def body(carry: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        nearest, chosen = carry
        at = fixed[:, chosen]
        nearest = jnp.minimum(nearest, (x - at[0]) ** 2 + (y - at[1]) ** 2 + (z - at[2]) ** 2)
        # The first row of the maximum, as argmax finds it; two plain reductions are many times faster on a CPU.
        most = jnp.max(nearest)
        first = jnp.min(jnp.where(nearest == most, row, len(points) - 1))
        return (nearest, first), (chosen, most > 0)

    start = (jnp.where(mask, jnp.inf, -1.0).astype(points.dtype), jnp.argmax(mask).astype(jnp.int32))
    _, (index, more) = jax.lax.scan(body, start, length=count)
    real = jnp.concatenate([jnp.any(mask)[None], more[:-1]])
    return index, real


def sample(points: Float[Array, "n 3"], mask: Bool[Array, " n"], count: int) -> Sampled:
    """`count` farthest points of a cloud, beside nothing more."""
    sparse, sparse_mask = farthest_points(points, mask, count)
    return Sampled(points=sparse, mask=sparse_mask, dense=sparse, dense_mask=sparse_mask)


def thin(mask: Bool[Array, " n"], count: int) -> tuple[Int[Array, " count"], Bool[Array, " count"]]:
    """`count` of the real rows, evenly by their order, and which of them are real: all rows where there are fewer."""
    order = jnp.argsort(~mask, stable=True)  # the real ones first
    real, at = mask.sum(), jnp.arange(count)
    at = jnp.where(real > count, at * real // count, jnp.minimum(at, len(mask) - 1))
    return order[at], jnp.arange(count) < real


def nearest(
    a: Float[Array, "n 3"], a_mask: Bool[Array, " n"], b: Float[Array, "m 3"], b_mask: Bool[Array, " m"]
) -> tuple[Int[Array, " n"], Float[Array, " n"]]:
    """Index of the nearest real row of `b` for every row of `a`, and the squared distance (`FAR` where masked).

    The distance has a gradient, the index none. Distances equal to within 2⁻¹¹ count as a tie.
    """
    index = nearest_index(*jax.lax.stop_gradient((a, b)), b_mask)
    squared = jnp.sum((a - b[index]) ** 2, axis=-1)
    return index, jnp.where(a_mask & b_mask[index], squared, FAR)


def nearest_index(
    a: Float[Array, "n d"], b: Float[Array, "m d"], b_mask: Bool[Array, " m"]
) -> Int[Array, " n"]:
    """Index of the nearest real row of `b` for every row of `a`; ties as in `nearest`."""
    a, b = jax.lax.stop_gradient((a, b))
    # The bits of floats ≥ 0 are ordered as the floats are. With the row's number in the lowest bits one plain
    # minimum gives value and place: a third of the time of argmin on a CPU.
    last, low = jnp.iinfo(jnp.int32).max, (1 << max(len(b) - 1, 1).bit_length()) - 1

    def nearer(best: Int[Array, " n"], some: tuple[Array, Array, Array]) -> tuple[Int[Array, " n"], None]:
        points, real, row = some
        squared = sum(
            (a[None, :, i] - points[:, None, i]).astype(jnp.float32) ** 2 for i in range(a.shape[1])
        )
        key = (jax.lax.bitcast_convert_type(squared, jnp.int32) & ~low) | row[:, None]
        return jnp.minimum(best, jnp.where(real[:, None], key, last).min(axis=0)), None

    def nearer_if_any(
        best: Int[Array, " n"], some: tuple[Array, Array, Array]
    ) -> tuple[Int[Array, " n"], None]:
        # Clouds are filled up to one size; what is padding is skipped, unless masks are mapped over.
        return jax.lax.cond(some[1].any(), nearer, lambda best, _: (best, None), best, some)

    # The whole matrix of keys would be written to memory and read again, and takes five times as long.
    at_once = min(ROWS_AT_ONCE, len(b)) if jax.default_backend() == "cpu" else len(b)
    rows = (b, b_mask, jnp.arange(len(b), dtype=jnp.int32))
    blocks = [jnp.pad(x, ((0, -len(b) % at_once), *[(0, 0)] * (x.ndim - 1))) for x in rows]
    blocks = [x.reshape(-1, at_once, *x.shape[1:]) for x in blocks]
    start = jnp.full(len(a), last, jnp.int32)
    best, _ = jax.lax.scan(nearer_if_any, start, (blocks[0], blocks[1], blocks[2]))
    return jnp.minimum(best & low, len(b) - 1)


def trimmed(squared: Float[Array, " n"], share: float) -> Bool[Array, " n"]:
    """True for the smallest `share` of the real squared distances (those below `FAR`)."""
    real = squared < FAR
    if share >= 1.0:
        return real
    last = jnp.ceil(share * real.sum()).astype(int) - 1
    return real & (squared <= jnp.sort(squared)[jnp.maximum(last, 0)])


def two_way_rms(a: Sampled, b: Sampled, share: float) -> Float[Array, ""]:
    """Trimmed root mean square nearest distance, meters: of a's sample to b and of b's to a, then their mean.

    The mean, not the worse: where one scan saw more of an object than the other, only the way from the smaller to
    the larger tells right from wrong.
    """
    total = jnp.zeros((), a.points.dtype)
    for one, other in ((a, b), (b, a)):
        _, squared = nearest(one.points, one.mask, other.dense, other.dense_mask)
        kept = trimmed(squared, share)
        mean = jnp.where(kept, squared, 0.0).sum() / jnp.maximum(kept.sum(), 1)
        total += 0.5 * jnp.sqrt(jnp.maximum(mean, TINY))
    return total


def chamfer_distance(
    a: Float[Array, "n 3"],
    a_mask: Bool[Array, " n"],
    b: Float[Array, "m 3"],
    b_mask: Bool[Array, " m"],
    squared: bool = False,
) -> Float[Array, ""]:
    """Mean nearest distance a → b plus mean nearest distance b → a, meters; gradient 0 at coincidence.

    `squared`: the means of the squares instead, square meters (paper, supplement).
    """
    total = jnp.zeros((), a.dtype)
    for (x, x_mask), (y, y_mask) in (((a, a_mask), (b, b_mask)), ((b, b_mask), (a, a_mask))):
        _, square = nearest(x, x_mask, y, y_mask)
        gap = square if squared else jnp.sqrt(jnp.where(x_mask, jnp.maximum(square, TINY), 1.0))
        total += jnp.where(x_mask, gap, 0.0).sum() / jnp.maximum(x_mask.sum(), 1)
    return total


@full_precision
def kabsch(
    source: Float[Array, "n 3"], target: Float[Array, "n 3"], weight: Float[Array, " n"]
) -> jaxlie.SE3:
    """The `T_target_source` that best maps `source[i]` onto `target[i]`, weights ≥ 0 (paper §3.3).

    All weights 0 gives the identity rotation and no translation.
    """
    weight = weight / jnp.maximum(weight.sum(), TINY)
    source_mean, target_mean = weight @ source, weight @ target
    rotation = kabsch_rotation(source - source_mean, target - target_mean, weight)
    return jaxlie.SE3.from_rotation_and_translation(rotation, target_mean - rotation @ source_mean)


@full_precision
def kabsch_rotation(
    source: Float[Array, "n 3"], target: Float[Array, "n 3"], weight: Float[Array, " n"] | None = None
) -> jaxlie.SO3:
    """The rotation that best turns `source[i]` onto `target[i]`, about the origin.

    Horn's quaternion: the top eigenvector of a symmetric 4×4 matrix. It is never a reflection, also when the
    points lie on a plane, a line or a point, and by repeated squaring its gradient is finite where that of an
    SVD is not (equal singular values).
    """
    weighted = source if weight is None else weight[:, None] * source
    return jaxlie.SO3(dominant_eigenvector(horn_matrix(jnp.matmul(weighted.T, target, precision="highest"))))


def horn_matrix(h: Float[Array, "3 3"]) -> Float[Array, "4 4"]:
    """Horn's symmetric matrix of a covariance Σ sᵢ tᵢᵀ; its top eigenvector is the quaternion (w, x, y, z)."""
    trace = jnp.trace(h)
    vector = jnp.stack([h[1, 2] - h[2, 1], h[2, 0] - h[0, 2], h[0, 1] - h[1, 0]])
    block = h + h.T - trace * jnp.eye(3, dtype=h.dtype)
    return jnp.block([[trace[None, None], vector[None]], [vector[:, None], block]])


def dominant_eigenvector(matrix: Float[Array, "d d"]) -> Float[Array, " d"]:
    """Unit eigenvector of the largest eigenvalue of a symmetric matrix; its gradient is finite everywhere.

    Where the largest eigenvalue is repeated, some unit vector of its space; of a zero matrix, (1, 0, …).
    """
    size = jnp.sqrt(jnp.sum(matrix * matrix) + TINY)
    power = matrix / size + jnp.eye(
        len(matrix), dtype=matrix.dtype
    )  # eigenvalues in [0, 2]: the largest dominates
    for _ in range(20):
        power = jnp.matmul(power, power, precision="highest")
        power = power / jnp.trace(power)
    # Every column is the eigenvector times one of its components; the longest is the safest.
    column = power[:, jnp.argmax(jnp.diagonal(power))]
    return column / jnp.sqrt(jnp.sum(column * column) + TINY)


def cloud_radius(points: Float[Array, "n 3"], mask: Bool[Array, " n"]) -> Float[Array, ""]:
    """Largest distance from the mean, meters; at least 1e-6, so that a single point can be divided by it."""
    weight = mask / jnp.maximum(mask.sum(), 1)
    squared = jnp.sum((points - weight @ points) ** 2, axis=-1)
    return jnp.sqrt(jnp.maximum(jnp.where(mask, squared, 0.0).max(), 1e-12))


@full_precision
def transformed(T_a_b: jaxlie.SE3, points: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """The points in frame a: `T_a_b @ points`, with the rotation's matrix made once and not for every point."""
    R = T_a_b.rotation().as_matrix()
    return jnp.matmul(points, R.T, precision="highest") + T_a_b.translation()


@full_precision
def icp_step(T: jaxlie.SE3, source: Sampled, target: Sampled, share: float) -> jaxlie.SE3:
    """One step of trimmed point-to-point ICP with correspondences both ways; returns the new `T_target_source`."""
    moved = transform(source, T)
    to_target, d_source = nearest(moved.points, moved.mask, target.dense, target.dense_mask)
    to_source, d_target = nearest(target.points, target.mask, moved.dense, moved.dense_mask)
    a = jnp.concatenate([moved.points, moved.dense[to_source]])
    b = jnp.concatenate([target.dense[to_target], target.points])
    weight = jnp.concatenate([trimmed(d_source, share), trimmed(d_target, share)]).astype(a.dtype)
    return kabsch(a, b, weight) @ T


def icp(T: jaxlie.SE3, source: Sampled, target: Sampled, share: float, steps: int) -> jaxlie.SE3:
    """`steps` of `icp_step` from `T`; differentiable, the correspondences held."""

    def body(T: jaxlie.SE3, _: None) -> tuple[jaxlie.SE3, None]:
        return icp_step(T, source, target, share), None

    return jax.lax.scan(body, T, length=steps)[0]
