"""The table of nearest points against the exact nearest."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import KDTree

from more2_jax.geometry import nearest_grid as table
from more2_jax.geometry.transform import rescale

nearest_grid, look_up = jax.jit(table.nearest_grid, static_argnums=2), jax.jit(table.look_up)


@pytest.fixture(scope="module")
def cloud():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(300, 3)) * [1.0, 0.4, 0.1]
    return points.astype(np.float32), np.arange(300) < 250


def test_what_the_table_names_is_nearest_to_within_a_cell(cloud):
    points, mask = cloud
    grid = nearest_grid(jnp.asarray(points), jnp.asarray(mask), 24)
    asked = np.random.default_rng(1).uniform(points[:250].min(0), points[:250].max(0), (500, 3))
    named = np.asarray(look_up(grid, jnp.asarray(asked, jnp.float32)))
    assert named.max() < 250
    exact = KDTree(points[:250]).query(asked)[0]
    found = np.linalg.norm(points[named] - asked, axis=1)
    # Cell's middle m: |p − q| ≤ |p − m| + |m − q| ≤ |p − m| + |m − q*| ≤ 2 |p − m| + |p − q*|.
    assert (found <= exact + np.linalg.norm(np.asarray(grid.cell)) + 1e-5).all()
    assert (found == pytest.approx(exact, abs=1e-5)) is False  # it is a table, after all
    assert np.mean(found < exact + 1e-5) > 0.5


def test_outside_the_box_the_nearest_cell_answers(cloud):
    points, mask = cloud
    grid = nearest_grid(jnp.asarray(points), jnp.asarray(mask), 24)
    far = jnp.asarray([[100.0, 0, 0], [-100, 0, 0], [np.nan, 0, 0]])
    right, left, lost = np.asarray(look_up(grid, far))
    assert points[right, 0] > 0 > points[left, 0]
    assert 0 <= lost < 300


def test_in_another_unit_it_says_the_same(cloud):
    points, mask = cloud
    grid = nearest_grid(jnp.asarray(points), jnp.asarray(mask), 16)
    asked = jnp.asarray(np.random.default_rng(2).normal(size=(50, 3)), jnp.float32)
    np.testing.assert_array_equal(look_up(grid, asked), look_up(rescale(grid, jnp.asarray(8.0)), 8.0 * asked))


def test_one_point_is_nearest_everywhere():
    grid = nearest_grid(jnp.ones((4, 3)), jnp.asarray([True, False, False, False]), 8)
    assert np.asarray(look_up(grid, jnp.asarray([[0.0, 0, 0], [9, 9, 9]]))).tolist() == [0, 0]
