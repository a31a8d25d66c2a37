"""Encoder and decoder under JAX's transformations: the doors take traced values, both modes agree with differences.

In float64, where no neighbor changes within the step of a difference. Clouds are padded with nonsense, and the mask
that says so is a NumPy array which the differentiated function closes over, as a user would write it.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from more2_jax.network.prior import encode, sdf
from more2_jax.types import Embedding, PointCloud

REAL = 90, 110  # points of the two clouds; the rest of the rows is padding
ROWS, QUERIES, STEP = 128, 20, 1e-8
MASK = np.arange(ROWS) < np.array(REAL)[:, None]
OUTPUTS = ("inv", "eqv", "scale", "center", "sdf")


@pytest.fixture
def prior64(tiny_prior):
    with jax.enable_x64(True):
        yield jax.tree.map(lambda x: x.astype(jnp.float64), tiny_prior)


def clouds() -> np.ndarray:
    """Two noisy ellipsoids; what stands in the padding is far away."""
    rng = np.random.default_rng(0)
    unit = rng.normal(size=(2, ROWS, 3))
    unit /= np.linalg.norm(unit, axis=-1, keepdims=True)
    cloud = unit * [[[0.5, 0.3, 0.2]], [[0.3, 0.4, 0.25]]] + 0.01 * rng.normal(size=unit.shape)
    return np.where(MASK[..., None], cloud, 1e3 * rng.normal(size=unit.shape))


def as_cloud(points: jax.Array) -> PointCloud:
    return PointCloud(points=points, mask=MASK, origin=np.zeros((2, 3)))


def queries() -> np.ndarray:
    return np.random.default_rng(1).uniform(-0.4, 0.4, (2, QUERIES, 3))


def outputs(points: jax.Array, prior) -> dict[str, jax.Array]:
    """One number an output, which is sensitive to all of its entries."""
    e = encode(prior, as_cloud(points))
    arrays = {
        "inv": e.inv,
        "eqv": e.eqv,
        "scale": e.scale,
        "center": e.center,
        "sdf": sdf(prior, e, queries()),
    }
    return {k: jnp.sum(x * jnp.cos(jnp.arange(x.size)).reshape(x.shape)) for k, x in arrays.items()}


def moved(shift: jax.Array) -> jax.Array:
    """The clouds, every point moved by a random combination of the three numbers of `shift`."""
    directions = np.random.default_rng(2).normal(size=(3, 2, ROWS, 3))
    return clouds() + jnp.einsum("s,sbnc->bnc", shift, directions)


def of_shift(shift: jax.Array, prior) -> dict[str, jax.Array]:
    return outputs(moved(shift), prior)


value_of_shift, slope_of_shift = jax.jit(of_shift), jax.jit(jax.jacrev(of_shift))


def differences(function, at: np.ndarray) -> dict[str, np.ndarray]:
    """Central differences of every entry of a dictionary of arrays, by the entries of `at`."""
    columns = []
    for e in STEP * np.eye(len(at)):
        above, below = function(at + e), function(at - e)
        columns.append({k: np.asarray(above[k] - below[k]) / (2 * STEP) for k in above})
    return {k: np.stack([c[k] for c in columns], axis=-1) for k in columns[0]}


def assert_close(ours: dict, numeric: dict, tolerance: float) -> None:
    for name in OUTPUTS:
        size = np.abs(numeric[name]).max()
        assert size > 1e-4, f"{name} hardly depends on its input: the comparison could not fail"
        np.testing.assert_allclose(ours[name], numeric[name], rtol=0, atol=tolerance * size, err_msg=name)


# --- derivatives by the points ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "slope",
    [
        pytest.param(jax.jit(jax.jacfwd(of_shift)), id="jacfwd", marks=pytest.mark.slow),
        pytest.param(slope_of_shift, id="jacrev"),
    ],
)
def test_both_modes_agree_with_central_differences(prior64, slope):
    at = np.zeros(3)
    assert_close(slope(at, prior64), differences(lambda x: value_of_shift(x, prior64), at), 1e-6)


@pytest.mark.slow
def test_forward_over_reverse_agrees_with_differences_of_gradients(prior64):
    at = np.zeros(3)
    found = jax.jit(jax.hessian(of_shift))(at, prior64)
    assert_close(found, differences(lambda x: slope_of_shift(x, prior64), at), 1e-6)
    for name in OUTPUTS:
        np.testing.assert_allclose(found[name], found[name].T, rtol=0, atol=1e-9 * np.abs(found[name]).max())


def test_padding_has_no_gradient_and_real_points_have(prior64):
    """`jax.grad` as it is called at a prompt: not jitted, the mask closed over."""
    gradient = jax.grad(lambda points: encode(prior64, as_cloud(points)).scale.sum())(jnp.asarray(clouds()))
    assert (np.asarray(gradient)[~MASK] == 0).all()
    assert (np.abs(np.asarray(gradient)[MASK]).max(axis=-1) > 0).mean() > 0.3  # all that sampling keeps


# --- derivatives by the weights ---------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_change_of_all_weights_agrees_with_central_differences(prior64):
    points, leaves = jnp.asarray(clouds()), jax.tree.leaves(prior64)
    rng = np.random.default_rng(3)
    along = jax.tree.unflatten(
        jax.tree.structure(prior64), [x.std() * rng.normal(size=x.shape) for x in leaves]
    )

    def on_the_way(share: jax.Array) -> dict[str, jax.Array]:
        return outputs(points, jax.tree.map(lambda w, d: w + share[0] * d, prior64, along))

    at = np.zeros(1)
    numeric = differences(jax.jit(on_the_way), at)
    for mode in (jax.jacfwd, jax.jacrev):
        assert_close(jax.jit(mode(on_the_way))(at), numeric, 1e-6)


# --- doors ------------------------------------------------------------------------------------------------------


def host(e: Embedding) -> dict[str, np.ndarray]:
    return {k: np.asarray(getattr(e, k)) for k in ("inv", "eqv", "scale", "center")}


def test_jitted_doors_say_what_the_doors_say(prior64):
    cloud = as_cloud(jnp.asarray(clouds()))
    plain, jitted = encode(prior64, cloud), jax.jit(encode)(prior64, cloud)
    for name, wanted in host(plain).items():
        np.testing.assert_allclose(host(jitted)[name], wanted, rtol=1e-9, atol=1e-12)
    distance = sdf(prior64, plain, queries())
    assert distance.dtype == jnp.float64  # the embedding's
    np.testing.assert_allclose(jax.jit(sdf)(prior64, plain, queries()), distance, rtol=1e-9, atol=1e-12)


def test_mapped_doors_say_what_the_doors_say(prior64):
    """A batch of batches: three copies of the clouds, each turned otherwise."""
    turned = jnp.asarray(clouds())[None] * np.array([[1, 1, 1], [-1, 1, -1], [1, -1, -1.0]])[:, None, None]
    inside = queries()
    codes = jax.vmap(lambda points: encode(prior64, as_cloud(points)), out_axes=0)(turned)
    distances = jax.vmap(lambda points: sdf(prior64, encode(prior64, as_cloud(points)), inside))(turned)
    for k in range(3):
        alone = encode(prior64, as_cloud(turned[k]))
        for name, wanted in host(alone).items():
            np.testing.assert_allclose(host(codes)[name][k], wanted, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(distances[k], sdf(prior64, alone, inside), rtol=1e-9, atol=1e-12)


def test_doors_refuse_what_is_known_and_take_what_is_traced(tiny_prior):
    points, empty = jnp.asarray(clouds(), jnp.float32), MASK & np.array([[True], [False]])
    origin = np.zeros((2, 3))

    def scale(points: jax.Array, mask: jax.Array) -> jax.Array:
        return encode(tiny_prior, PointCloud(points=points, mask=mask, origin=origin)).scale

    for mask in (empty, jnp.asarray(empty)):  # known while the points are traced
        with pytest.raises(ValueError, match=r"clouds \[1\] have no points"):
            jax.eval_shape(lambda p, mask=mask: scale(p, mask), points)
    assert jax.eval_shape(scale, points, empty).shape == (2,)  # traced: taken as it is
    with pytest.raises(ValueError, match=r"mask of shape \(128,\); needed \(2, 128\)"):
        jax.eval_shape(scale, points, MASK[0])
    with pytest.raises(ValueError, match=r"points of shape \(2, 128, 2\)"):
        jax.eval_shape(scale, points[..., :2], MASK)
