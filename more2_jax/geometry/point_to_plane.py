"""Registration on surfaces: normals of a cloud, and robust point-to-plane alignment both ways; one pair, vmapped.

Generalized ICP (Segal et al., 2009) with both covariances flat: what lies off the common tangent plane counts in
full, what slides along it hardly. A Geman-McClure weight, sharpened step by step, takes the place of a maximal
distance: what one scan did not see pulls ever less.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import jaxlie
from jax import Array
from jaxtyping import Bool, Float, Int

from more2_jax.config import MotionModel
from more2_jax.geometry.full_precision import full_precision
from more2_jax.geometry.nearest_grid import NearestGrid, look_up, nearest_grid
from more2_jax.geometry.points import FAR, nearest_index, thin
from more2_jax.types import AnyArray, Sampled, pytree, quantity

ALONG = 0.02  # weight of sliding along the surface, against leaving it
DAMPING = 1e-4  # of the normal equations, in shares of their trace: a ball may turn freely
NO_TILT = (1.0, 1.0, 1.0, 0.0, 0.0, 1.0)  # shift, and turn about the vertical
WRITTEN_OUT = 6  # rows of a system: of a pose; what is larger would compile for longer than it runs
ONE_AXIS = 1e-6  # of matrices of trace 1: what distinguishes eigenvalues by less is rounding
SIDED_COSINE = 0.2  # an estimated normal within so much of a right angle to the scan's own has no side
OPPOSED_COSINE = 0.2  # normals that face apart by more than this beyond a right angle: a front on a back
NEIGHBORHOOD = 2.5  # half width of a normal's neighborhood, in median distances between neighbors


@pytree
class Surface:
    """A cloud with normals, as a sample to compare and in full to be compared with."""

    sampled: Sampled = quantity("record")
    normals: Float[AnyArray, "*b n 3"] = quantity("direction")  # of the sample
    dense_normals: Float[AnyArray, "*b m 3"] = quantity("direction")
    # Whether a normal is known to point outward, else it has no side. None: none is.
    sided: Bool[AnyArray, "*b n"] | None = quantity("invariant", default=None)
    dense_sided: Bool[AnyArray, "*b m"] | None = quantity("invariant", default=None)
    # Of `dense`, what is the cloud's own; the rest lies around it. None: all.
    own: Bool[AnyArray, "*b m"] | None = quantity("invariant", default=None)
    grid: NearestGrid | None = quantity(
        "record", default=None
    )  # names the nearest of `dense`; without it every distance is measured


def whole_surface(
    points: Float[Array, "n 3"], mask: Bool[Array, " n"], outward: Float[Array, "n 3"] | None = None
) -> Surface:
    """A cloud that is its own sample; `thinned` and `coarsened` make of it what is compared.

    `outward`: the scan's own normals, zeros where not known; they say on which side the estimated ones are.
    """
    normals = normal_estimator(points, mask)(points)
    cloud = Sampled(points=points, mask=mask, dense=points, dense_mask=mask)
    if outward is None:
        return Surface(sampled=cloud, normals=normals, dense_normals=normals)
    along = jnp.sum(normals * outward, axis=-1)
    normals = jnp.where(along < 0, -1.0, 1.0)[:, None] * normals
    sided = jnp.abs(along) > SIDED_COSINE
    return Surface(sampled=cloud, normals=normals, dense_normals=normals, sided=sided, dense_sided=sided)


def surrounded(s: Surface, points: Float[Array, "k 3"], mask: Bool[Array, " k"]) -> Surface:
    """A whole cloud amid what its scan shows around it: its own points are compared with all of the other's."""
    cloud = s.sampled
    dense, real = jnp.concatenate([cloud.points, points]), jnp.concatenate([cloud.mask, mask])
    normals = normal_estimator(dense, real)(points)
    none = jnp.zeros(len(points), bool)
    return dataclasses.replace(
        s,
        sampled=dataclasses.replace(cloud, dense=dense, dense_mask=real),
        dense_normals=jnp.concatenate([s.normals, normals]),
        dense_sided=None if s.sided is None else jnp.concatenate([s.sided, none]),
        own=jnp.concatenate([cloud.mask, none]),
    )


def thinned(s: Surface, count: int) -> Surface:
    """With about `count` of its own points for a sample, as densely as each part was seen."""
    cloud = s.sampled
    index, real = thin(cloud.dense_mask if s.own is None else s.own, count)
    sampled = dataclasses.replace(cloud, points=cloud.dense[index], mask=real)
    sided = None if s.dense_sided is None else s.dense_sided[index]
    return dataclasses.replace(s, sampled=sampled, normals=s.dense_normals[index], sided=sided)


def coarsened(s: Surface, count: int, dense: int, cells: int) -> Surface:
    """With about `dense` of all points, found by a table of `cells` a side, and about `count` for a sample."""
    index, real = thin(s.sampled.dense_mask, dense)
    points, normals = s.sampled.dense[index], s.dense_normals[index]
    sided = None if s.dense_sided is None else s.dense_sided[index]
    own = None if s.own is None else s.own[index] & real
    cloud = Sampled(points=points, mask=real, dense=points, dense_mask=real)
    fewer = Surface(
        sampled=cloud, normals=normals, dense_normals=normals, sided=sided, dense_sided=sided, own=own
    )
    return dataclasses.replace(thinned(fewer, count), grid=nearest_grid(points, real, cells))


def normal_estimator(
    cloud: Float[Array, "m 3"], mask: Bool[Array, " m"]
) -> Callable[[Float[Array, "n 3"]], Float[Array, "n 3"]]:
    """Normals at any points: the direction of least spread of the cloud around them, weighted by a Gaussian."""
    width = NEIGHBORHOOD * spacing(cloud, mask)

    def normals(points: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
        # All moments about the cloud's own zero, by one matrix product; the cloud is centered, so none cancels badly.
        squared = sum((points[:, None, i] - cloud[None, :, i]) ** 2 for i in range(3))
        products = (cloud[:, :, None] * cloud[:, None, :]).reshape(-1, 9)
        columns = jnp.concatenate([jnp.ones_like(cloud[:, :1]), cloud, products], axis=1)
        sums = jnp.matmul(
            jnp.exp(-0.5 * squared / width**2), jnp.where(mask[:, None], columns, 0.0), precision="highest"
        )
        sums = sums / jnp.maximum(sums[:, :1], 1e-30)
        mean, second = sums[:, 1:4], sums[:, 4:].reshape(-1, 3, 3)
        return least_axis(second - mean[:, :, None] * mean[:, None, :])

    return normals


# Batched LAPACK calls that run at the same time can wait for one another for ever on the few threads of a small CPU
# (jaxlib 0.10.2: each splits its batch over the pool it runs on). The two small ones here are plain arithmetic.


def least_axis(matrix: Float[Array, "*b 3 3"]) -> Float[Array, "*b 3"]:
    """Unit eigenvector of the smallest eigenvalue of symmetric matrices, in closed form; one where it is repeated."""
    size = jnp.maximum(jnp.trace(matrix, axis1=-2, axis2=-1), 1e-20)[..., None, None]
    a = matrix / size
    eye = jnp.eye(3, dtype=a.dtype)
    third = jnp.trace(a, axis1=-2, axis2=-1) / 3
    b = a - third[..., None, None] * eye
    p = jnp.sqrt(jnp.sum(b * b, axis=(-2, -1)) / 6 + 1e-20)
    det = jnp.sum(b[..., 0, :] * jnp.cross(b[..., 1, :], b[..., 2, :]), axis=-1)
    angle = jnp.arccos(jnp.clip(det / (2 * p**3), -1.0, 1.0)) / 3
    least = third + 2 * p * jnp.cos(angle + 2 * jnp.pi / 3)
    m = a - least[..., None, None] * eye  # its rows span the plane across the axis
    crossed = jnp.stack([jnp.cross(m[..., i, :], m[..., (i + 1) % 3, :]) for i in range(3)], axis=-2)
    squared = jnp.sum(crossed**2, axis=-1)
    longest = jnp.argmax(squared, axis=-1)[..., None]
    axis = jnp.take_along_axis(crossed, longest[..., None], axis=-2)[..., 0, :]
    length = jnp.sqrt(jnp.take_along_axis(squared, longest, axis=-1))
    return jnp.where(length > ONE_AXIS, axis / jnp.maximum(length, ONE_AXIS), across(m))


def across(rows: Float[Array, "*b 3 3"]) -> Float[Array, "*b 3"]:
    """A unit vector at right angles to rows that are all along one line; any if they are zero."""
    longest = jnp.argmax(jnp.sum(rows**2, axis=-1), axis=-1)[..., None, None]
    line = jnp.take_along_axis(rows, longest, axis=-2)[..., 0, :]
    least = jnp.argmin(jnp.abs(line), axis=-1)
    crossed = jnp.cross(line, jnp.eye(3, dtype=rows.dtype)[least])
    length = jnp.sqrt(jnp.sum(crossed**2, axis=-1, keepdims=True) + 1e-20)
    return jnp.where(length > ONE_AXIS, crossed / length, jnp.array([0.0, 0.0, 1.0]))


def solve_spd(matrix: Float[Array, "n n"], right: Float[Array, "n m"]) -> Float[Array, "n m"]:
    """`matrix⁻¹ right` of a positive definite matrix, by elimination without pivots."""
    rows = jnp.concatenate([matrix, right], axis=1)
    count = len(matrix)

    def eliminate(k: int | Array, rows: Array) -> Array:
        row = rows[k] / rows[k, k]
        return (rows - rows[:, k, None] * row).at[k].set(row)

    if count > WRITTEN_OUT:
        return jax.lax.fori_loop(0, count, eliminate, rows)[:, count:]
    for k in range(count):
        rows = eliminate(k, rows)
    return rows[:, count:]


def spacing(points: Float[Array, "n 3"], mask: Bool[Array, " n"]) -> Float[Array, ""]:
    """Median distance of a cloud's points to their nearest neighbors; 1e-6 where all are one point."""
    some = points[::8]
    squared = sum((some[:, None, i] - points[None, :, i]) ** 2 for i in range(3))
    other = mask & (jnp.arange(len(points)) != 8 * jnp.arange(len(some))[:, None]) & (squared > 0)
    closest = jnp.where(other, squared, FAR).min(axis=1)
    median = jnp.nanmedian(jnp.where(mask[::8] & (closest < FAR), closest, jnp.nan))
    return jnp.sqrt(jnp.where(jnp.isfinite(median), median, 1e-12) + 1e-12)


@pytree
class Correspondences:
    """Moved source points and target points that belong together, both ways; target's frame, one component a row."""

    source: Float[Array, "3 n"]
    target: Float[Array, "3 n"]
    source_normal: Float[Array, "3 n"]
    target_normal: Float[Array, "3 n"]
    squared: Float[Array, " n"]  # `FAR` where there is none
    opposed: Bool[Array, " n"] | None = None  # a front on a back; None where no sides are known


def correspondences(T: jaxlie.SE3, source: Surface, target: Surface) -> Correspondences:
    """Every sample's nearest point on the other cloud, whichever side it shows.

    Rows are long, of one component of all points: on CPUs that takes three fifths of the time of rows of three.
    """
    R, shift = T.rotation().as_matrix(), T.translation()[:, None]
    s, t = source.sampled, target.sampled
    points = product(R, s.points.T) + shift
    there = closest(target, points.T)
    back = closest(source, product(R.T, t.points.T - shift).T)
    a = jnp.concatenate([points, product(R, s.dense.T[:, back]) + shift], axis=1)
    b = jnp.concatenate([t.dense.T[:, there], t.points.T], axis=1)
    real = jnp.concatenate([s.mask & t.dense_mask[there], t.mask & s.dense_mask[back]])
    own = product(R, jnp.concatenate([source.normals.T, source.dense_normals.T[:, back]], axis=1))
    other = jnp.concatenate([target.dense_normals.T[:, there], target.normals.T], axis=1)
    return Correspondences(
        source=a,
        target=b,
        source_normal=own,
        target_normal=other,
        squared=jnp.where(real, jnp.sum((a - b) ** 2, axis=0), FAR),
        opposed=opposed(source, target, there, back, jnp.sum(own * other, axis=0)),
    )


def product(a: Float[Array, "k m"], b: Float[Array, "m n"]) -> Float[Array, "k n"]:
    """The product of two matrices, in full precision on every device."""
    return jnp.matmul(a, b, precision="highest")


def opposed(
    source: Surface,
    target: Surface,
    there: Int[Array, " s"],
    back: Int[Array, " t"],
    cosine: Float[Array, " n"],
) -> Bool[Array, " n"] | None:
    """Which correspondences hold a front against a back; None where a cloud has no known sides.

    `there`, `back`: rows of the other cloud in full; `cosine`: of the angle between both normals.
    """
    if source.sided is None or source.dense_sided is None:
        return None
    if target.sided is None or target.dense_sided is None:
        return None
    known = source.sided & target.dense_sided[there], target.sided & source.dense_sided[back]
    return jnp.concatenate(known) & (cosine < -OPPOSED_COSINE)


def closest(s: Surface, points: Float[Array, "n 3"]) -> Int[Array, " n"]:
    """Row of the cloud in full that is nearest to every point, by the table where there is one."""
    points = jax.lax.stop_gradient(points)
    if s.grid is not None:
        return look_up(s.grid, points)
    return nearest_index(points, jax.lax.stop_gradient(s.sampled.dense), s.sampled.dense_mask)


@pytree
class NormalEquations:
    """Of one step: `matrix @ (shift, turn) = vector`, the weights summing to 1."""

    matrix: Float[Array, "6 6"]
    vector: Float[Array, "6"]
    variance: Float[Array, ""]  # weighted mean square of what is left along the normals
    count: Float[Array, ""]  # correspondences, each by its weight


def normal_equations(
    T: jaxlie.SE3, source: Surface, target: Surface, reach: Float[Array, ""]
) -> NormalEquations:
    """Linearized at `T`; a correspondence as far apart as `reach` counts a quarter.

    One of crossed surfaces does not count, nor one of a front and a back where the scans say which they are.
    """
    c = correspondences(T, source, target)
    points, gap = c.source, c.target - c.source
    own, other = c.source_normal, c.target_normal
    agree = jnp.sum(own * other, axis=0)
    normal = other + jnp.where(agree < 0, -1.0, 1.0) * own
    normal = normal / jnp.sqrt(jnp.maximum(jnp.sum(normal**2, axis=0), 1e-12))
    counts = c.squared < FAR if c.opposed is None else (c.squared < FAR) & ~c.opposed
    weight = jnp.where(counts, (reach**2 / (reach**2 + c.squared)) ** 2 * agree**2, 0.0)
    total = weight.sum()
    weight = weight / jnp.maximum(total, 1e-12)
    off = jnp.sum(normal * gap, axis=0)
    leaving = moments(jnp.concatenate([normal, jnp.cross(points, normal, axis=0), off[None]]), weight)
    matrix, vector = sliding(moments(jnp.concatenate([points, gap, jnp.ones_like(off)[None]]), weight))
    return NormalEquations(
        matrix=(1 - ALONG) * leaving[:6, :6] + ALONG * matrix,
        vector=(1 - ALONG) * leaving[:6, 6] + ALONG * vector,
        variance=leaving[6, 6],
        count=total,
    )


def moments(rows: Float[Array, "k n"], weight: Float[Array, " n"]) -> Float[Array, "k k"]:
    """Weighted sums of the products of any two rows."""
    return product(rows * weight, rows.T)


def sliding(m: Float[Array, "7 7"]) -> tuple[Float[Array, "6 6"], Float[Array, "6"]]:
    """Point-to-point normal equations from the `moments` of points p, gaps and 1: `Σ w Jᵀ J` and `Σ w Jᵀ gap`.

    J = d(p + v + ω × p) / d(v, ω) = (I, −p×)."""
    products, mean = m[:3, :3], cross_matrix(m[:3, 6])
    eye = jnp.eye(3, dtype=m.dtype)
    matrix = jnp.block([[m[6, 6] * eye, -mean], [mean, jnp.trace(products) * eye - products]])
    with_gap = m[:3, 3:6]
    turn = jnp.stack([with_gap[i, j] - with_gap[j, i] for i, j in ((1, 2), (2, 0), (0, 1))])
    return matrix, jnp.concatenate([m[3:6, 6], turn])


def cross_matrix(v: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """`cross_matrix(v) @ p` is v × p."""
    zero = jnp.zeros_like(v[0])
    return jnp.stack([zero, -v[2], v[1], v[2], zero, -v[0], -v[1], v[0], zero]).reshape(3, 3)


def free_directions(motion: MotionModel) -> Float[Array, "6"]:
    """Of (shift, turn), 1 where a pose may change."""
    return jnp.array(NO_TILT if motion == "upright" else (1.0,) * 6)


def solvable(H: Float[Array, "6 6"], motion: MotionModel) -> Float[Array, "6 6"]:
    """The matrix a little damped; `upright`: without tilt."""
    H = H + (DAMPING * jnp.trace(H) / 6 + 1e-9) * jnp.eye(6)
    free = free_directions(motion)
    return H * free * free[:, None] + jnp.diag(1 - free)


@full_precision
def align_step(
    T: jaxlie.SE3, source: Surface, target: Surface, reach: Float[Array, ""], motion: MotionModel
) -> jaxlie.SE3:
    """One Gauss-Newton step; `upright`: shifts, and turns about the vertical only."""
    equations = normal_equations(T, source, target, reach)
    free = free_directions(motion)
    step = solve_spd(solvable(equations.matrix, motion), (equations.vector * free)[:, None])[:, 0]
    return jaxlie.SE3.exp(step) @ T


def pose_covariance(
    T: jaxlie.SE3, source: Surface, target: Surface, reach: float, motion: MotionModel
) -> Float[Array, "6 6"]:
    """Covariance of (shift, turn) at `T` from how well surfaces pin it down; tilt has none when `upright`.

    Correspondences are taken as independent: a lower bound, blind to a wrong basin (see `competing`).
    """
    equations = normal_equations(T, source, target, jnp.asarray(reach))
    free = free_directions(motion)
    inverse = solve_spd(solvable(equations.matrix, motion), jnp.eye(6)) * free * free[:, None]
    return inverse * equations.variance / jnp.maximum(equations.count, 1.0)


def align(
    T: jaxlie.SE3,
    source: Surface,
    target: Surface,
    reach: tuple[float, float],
    steps: int,
    motion: MotionModel,
) -> jaxlie.SE3:
    """`steps` of `align_step`, the reach falling geometrically from the first to the second value."""
    return align_by(T, source, target, jnp.geomspace(reach[0], reach[1], steps), motion)


def align_by(
    T: jaxlie.SE3, source: Surface, target: Surface, reaches: Float[Array, " steps"], motion: MotionModel
) -> jaxlie.SE3:
    """A step of `align_step` with every reach in turn."""

    def body(T: jaxlie.SE3, reach: Array) -> tuple[jaxlie.SE3, None]:
        return align_step(T, source, target, reach, motion), None

    return jax.lax.scan(body, T, reaches)[0]
