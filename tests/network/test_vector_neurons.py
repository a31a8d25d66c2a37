"""What the layers are made of: nearest neighbors by definition, gradients of products as plain ones."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from more2_jax.network.vector_neurons import linear, nearest_features, nearest_points


def found(x: np.ndarray, mask: np.ndarray, k: int, how: str) -> tuple[np.ndarray, np.ndarray]:
    x = jnp.asarray(x, jnp.float32)
    if how == "points":
        index, real = nearest_points(x, jnp.asarray(mask), k)
    else:
        features = x.reshape(len(x), 3, -1)
        index, real = nearest_features(features, features, jnp.asarray(mask), k)
    return np.asarray(index), np.asarray(real)


def clouds(channels: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    spread = rng.normal(size=(200, 3 * channels))
    return {
        "spread": spread,
        "a line": spread * np.eye(1, 3 * channels)[0],
        "far from zero": 0.02 * spread + 1.0,
        "twice each": np.repeat(spread[:100], 2, axis=0),
        "all the same": np.ones_like(spread),
    }


@pytest.mark.parametrize("cloud", clouds(1))
@pytest.mark.parametrize(("how", "channels"), [("points", 1), ("features", 1), ("features", 5)])
@pytest.mark.parametrize("k", [4, 16])
def test_none_is_nearer_than_those_found(how, channels, cloud, k):
    x = np.asarray(clouds(channels)[cloud], np.float32).astype(float)
    mask = np.ones(len(x), bool)
    mask[[3, 50, 199]] = False
    index, real = found(x, mask, k, how)
    assert real.all() and mask[index].all()
    assert all(len(set(row)) == k for row in index)
    distance = np.linalg.norm(x[:, None] - x[None], axis=-1)
    nearest = np.sort(np.where(mask, distance, np.inf), axis=1)[:, :k]
    got = np.sort(np.take_along_axis(distance, index, axis=1), axis=1)
    # Equal distances may change places; so may those whose difference float32 does not hold.
    np.testing.assert_allclose(got, nearest, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("how", ["points", "features"])
def test_where_too_few_are_real_the_rest_is_marked(how):
    x, mask = clouds(1)["spread"], np.zeros(200, bool)
    mask[[7, 30, 111]] = True
    index, real = found(x, mask, 8, how)
    np.testing.assert_array_equal(real.sum(axis=1), 3)
    assert all(set(i[r]) == {7, 30, 111} for i, r in zip(index, real, strict=True))


@pytest.mark.parametrize("rows", [(40,), (13, 3), (2, 20, 3)], ids=str)
@pytest.mark.parametrize("batch", ["cloud by cloud", "one kernel for all", "a kernel each"])
def test_gradients_of_a_product_are_those_of_matmul(rows, batch):
    """Many rows a kernel, so that CPUs take the form of their own; alone, and mapped as training does."""
    clouds, inputs, outputs = 3, 16, 24
    kx, kw, kg = jax.random.split(jax.random.key(0), 3)
    x = jax.random.normal(kx, (clouds, *rows, inputs))
    kernel = jax.random.normal(kw, (clouds, inputs, outputs))
    direction = jax.random.normal(kg, (clouds, *rows, outputs))
    if batch != "a kernel each":
        kernel = kernel[0]

    def gradients(product):
        if batch == "cloud by cloud":
            mapped = lambda x, w: jnp.stack([product(c, w) for c in x])  # noqa: E731
        else:
            mapped = jax.vmap(product, in_axes=(0, 0 if kernel.ndim == 3 else None))
        return jax.jit(jax.grad(lambda x, w: jnp.sum(direction * mapped(x, w)), argnums=(0, 1)))(x, kernel)

    for ours, plain in zip(gradients(linear), gradients(jnp.matmul), strict=True):
        np.testing.assert_allclose(ours, plain, rtol=1e-5, atol=1e-4)


def test_the_kernels_gradient_is_a_product_a_cloud_on_cpus_where_rows_are_many():
    def products(rows: int) -> str:
        x, kernel = jnp.ones((3, rows, 16)), jnp.ones((16, 24))
        loss = jax.grad(lambda w: jnp.sum(jax.vmap(lambda c: linear(c, w))(x) ** 2))
        return jax.jit(loss).lower(kernel).as_text()

    assert "3x16x24" in products(40) and "3x16x24" not in products(20)
