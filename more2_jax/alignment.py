"""Registration on surfaces: normals of a cloud, and robust point-to-plane alignment both ways; one pair, vmapped.

Generalised ICP (Segal et al., 2009) with both covariances flat: what lies off the common tangent plane counts in
full, what slides along it hardly. A Geman-McClure weight, sharpened step by step, takes the place of a maximal
distance: what one scan did not see pulls ever less.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import jaxlie
from jax import Array
from jaxtyping import Bool, Float

from more2_jax.geometry import FAR, Sampled, nearest
from more2_jax.types import pytree

ALONG = 0.02  # weight of sliding along the surface, against leaving it
DAMPING = 1e-4  # of the normal equations, in shares of their trace: a ball may turn freely
NO_TILT = (1.0, 1.0, 1.0, 0.0, 0.0, 1.0)  # shift, and turn about the vertical
NEIGHBOURHOOD = 2.5  # half width of a normal's neighbourhood, in median distances between neighbours


@pytree
class Surface:
    """A cloud with normals, as a sample to compare and in full to be compared with. Normals have no side."""

    sampled: Sampled
    normals: Float[Array, "*b n 3"]  # of the sample
    dense_normals: Float[Array, "*b m 3"]


def surface(cloud: Sampled) -> Surface:
    """The cloud with normals, each the direction of least spread of its neighbourhood, weighted by a Gaussian."""
    width = NEIGHBOURHOOD * spacing(cloud.dense, cloud.dense_mask)

    def normals(points: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
        # All moments about the cloud's own zero, by one matrix product; the cloud is centred, so none cancels badly.
        squared = sum((points[:, None, i] - cloud.dense[None, :, i]) ** 2 for i in range(3))
        weight = jnp.where(cloud.dense_mask, jnp.exp(-0.5 * squared / width**2), 0.0)
        weight = weight / jnp.maximum(weight.sum(axis=1, keepdims=True), 1e-30)
        mean = jnp.matmul(weight, cloud.dense, precision="highest")
        products = (cloud.dense[:, :, None] * cloud.dense[:, None, :]).reshape(-1, 9)
        second = jnp.matmul(weight, products, precision="highest").reshape(-1, 3, 3)
        spread = second - mean[:, :, None] * mean[:, None, :]
        return least_axis(spread)

    return Surface(sampled=cloud, normals=normals(cloud.points), dense_normals=normals(cloud.dense))


# Batched LAPACK calls that run at the same time can wait for one another for ever on the few threads of a small CPU
# (jaxlib 0.10.2: each splits its batch over the pool it runs on). The two small ones here are plain arithmetic.


def least_axis(matrix: Float[Array, "*b 3 3"]) -> Float[Array, "*b 3"]:
    """Unit eigenvector of the smallest eigenvalue of symmetric matrices, in closed form; any where it is repeated."""
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
    return jnp.where(length > 1e-12, axis / jnp.maximum(length, 1e-12), jnp.array([0.0, 0.0, 1.0]))


def solve_spd(matrix: Float[Array, "n n"], right: Float[Array, "n m"]) -> Float[Array, "n m"]:
    """`matrix⁻¹ right` of a small positive definite matrix, by elimination without pivots."""
    rows = jnp.concatenate([matrix, right], axis=1)
    count = len(matrix)
    for k in range(count):
        row = rows[k] / rows[k, k]
        others = rows - rows[:, k : k + 1] * row
        rows = others.at[k].set(row)
    return rows[:, count:]


def spacing(points: Float[Array, "n 3"], mask: Bool[Array, " n"]) -> Float[Array, ""]:
    """Median distance of a cloud's points to their nearest neighbours; 1e-6 where all are one point."""
    some = points[::8]
    squared = sum((some[:, None, i] - points[None, :, i]) ** 2 for i in range(3))
    other = mask & (jnp.arange(len(points)) != 8 * jnp.arange(len(some))[:, None]) & (squared > 0)
    closest = jnp.where(other, squared, FAR).min(axis=1)
    median = jnp.nanmedian(jnp.where(mask[::8] & (closest < FAR), closest, jnp.nan))
    return jnp.sqrt(jnp.where(jnp.isfinite(median), median, 1e-12) + 1e-12)


@pytree
class Correspondences:
    """Moved source points and target points that belong together, both ways; target's frame."""

    source: Float[Array, "n 3"]
    target: Float[Array, "n 3"]
    source_normal: Float[Array, "n 3"]
    target_normal: Float[Array, "n 3"]
    squared: Float[Array, " n"]  # `FAR` where there is none


def correspondences(T: jaxlie.SE3, source: Surface, target: Surface) -> Correspondences:
    """Every sample's nearest point on the other cloud."""
    R = T.rotation().as_matrix()
    s, t = source.sampled, target.sampled
    points, dense = T @ s.points, T @ s.dense
    there, d_there = nearest(points, s.mask, t.dense, t.dense_mask)
    back, d_back = nearest(t.points, t.mask, dense, s.dense_mask)
    return Correspondences(
        source=jnp.concatenate([points, dense[back]]),
        target=jnp.concatenate([t.dense[there], t.points]),
        source_normal=jnp.concatenate([source.normals, source.dense_normals[back]]) @ R.T,
        target_normal=jnp.concatenate([target.dense_normals[there], target.normals]),
        squared=jnp.concatenate([d_there, d_back]),
    )


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
    """Linearised at `T`; a correspondence as far apart as `reach` counts a quarter, one of crossed surfaces not."""
    c = correspondences(T, source, target)
    agree = jnp.sum(c.source_normal * c.target_normal, axis=-1)
    normal = c.target_normal + jnp.where(agree < 0, -1.0, 1.0)[:, None] * c.source_normal
    normal = normal / jnp.sqrt(jnp.maximum(jnp.sum(normal**2, axis=-1, keepdims=True), 1e-12))
    weight = jnp.where(c.squared < FAR, (reach**2 / (reach**2 + c.squared)) ** 2 * agree**2, 0.0)
    total = weight.sum()
    weight = weight / jnp.maximum(total, 1e-12)
    gap = c.target - c.source
    off = jnp.sum(normal * gap, axis=-1)
    rows = point_jacobian(c.source)
    n, a = jnp.sqrt(1 - ALONG) * normal, jnp.sqrt(ALONG)
    J = jnp.concatenate([jnp.einsum("ni,nij->nj", n, rows)[:, None], a * rows], axis=1).reshape(-1, 6)
    r = jnp.concatenate([jnp.sqrt(1 - ALONG) * off[:, None], a * gap], axis=1).reshape(-1)
    weighted = (jnp.repeat(weight, 4)[:, None] * J).T
    return NormalEquations(
        matrix=jnp.matmul(weighted, J, precision="highest"),
        vector=jnp.matmul(weighted, r, precision="highest"),
        variance=jnp.sum(weight * off**2),
        count=total,
    )


def point_jacobian(points: Float[Array, "n 3"]) -> Float[Array, "n 3 6"]:
    """d(p + v + ω × p) / d(v, ω)."""
    x, y, z = points.T
    zero = jnp.zeros_like(x)
    turn = jnp.stack([zero, z, -y, -z, zero, x, y, -x, zero], axis=-1).reshape(-1, 3, 3)
    return jnp.concatenate([jnp.broadcast_to(jnp.eye(3, dtype=points.dtype), turn.shape), turn], axis=-1)


def free_directions(upright: bool) -> Float[Array, "6"]:
    """1 where a pose may change."""
    return jnp.array(NO_TILT if upright else (1.0,) * 6)


def solvable(H: Float[Array, "6 6"], upright: bool) -> Float[Array, "6 6"]:
    """The matrix a little damped; `upright`: without tilt."""
    H = H + (DAMPING * jnp.trace(H) / 6 + 1e-9) * jnp.eye(6)
    free = free_directions(upright)
    return H * free * free[:, None] + jnp.diag(1 - free)


def align_step(
    T: jaxlie.SE3, source: Surface, target: Surface, reach: Float[Array, ""], upright: bool
) -> jaxlie.SE3:
    """One Gauss-Newton step; `upright`: shifts, and turns about the vertical only."""
    equations = normal_equations(T, source, target, reach)
    free = free_directions(upright)
    step = solve_spd(solvable(equations.matrix, upright), (equations.vector * free)[:, None])[:, 0]
    return jaxlie.SE3.exp(step) @ T


def pose_covariance(
    T: jaxlie.SE3, source: Surface, target: Surface, reach: float, upright: bool
) -> Float[Array, "6 6"]:
    """Covariance of (shift, turn) at `T` from how well surfaces pin it down; tilt has none when `upright`.

    Correspondences are taken as independent: a lower bound, blind to a wrong basin (see `competing`).
    """
    equations = normal_equations(T, source, target, jnp.asarray(reach))
    free = free_directions(upright)
    inverse = solve_spd(solvable(equations.matrix, upright), jnp.eye(6)) * free * free[:, None]
    return inverse * equations.variance / jnp.maximum(equations.count, 1.0)


def align(
    T: jaxlie.SE3,
    source: Surface,
    target: Surface,
    reach: tuple[float, float],
    steps: int,
    upright: bool,
) -> jaxlie.SE3:
    """`steps` of `align_step`, the reach falling geometrically from the first to the second value."""
    widths = jnp.geomspace(reach[0], reach[1], steps)

    def body(T: jaxlie.SE3, width: Array) -> tuple[jaxlie.SE3, None]:
        return align_step(T, source, target, width, upright), None

    return jax.lax.scan(body, T, widths)[0]
