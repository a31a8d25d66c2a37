"""Training samples: points of the chosen views, flaws within their bounds, each a function of its key."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linprog

from more2_jax.config import TrainingConfig
from more2_jax.data.sampling import add_junk, ball, half_space, merge_views, sample_batch, start_far_out
from more2_jax.data.shards import Shapes

KEYS = jax.random.split(jax.random.key(0), 200)
CLOUD = jax.random.uniform(jax.random.key(1), (500, 3), minval=-0.45, maxval=0.45)
CONFIG = TrainingConfig(queries=64, raw_points=256, max_views=4)
CLEAN = dataclasses.replace(
    CONFIG, noise=0.0, crop_probability=0.0, ball_probability=0.0, junk_probability=0.0
)
draw = jax.jit(sample_batch, static_argnames=("config", "points"))


def shapes(count: int = 4) -> Shapes:
    """Shape i's views lie on the sphere of radius 0.1 (i + 1), view v at height v; its queries say so too."""
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(count, 24, 384, 3))
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    radius = 0.1 * (1 + np.arange(count))
    query = rng.uniform(-0.55, 0.55, (2, count, 500, 3))
    sdf = np.linalg.norm(query, axis=-1, keepdims=True) - radius[:, None, None]
    uniform, near = (jnp.asarray(a, jnp.float16) for a in np.concatenate([query, sdf], axis=-1))
    views = direction * radius[:, None, None, None]
    return Shapes(views=jnp.asarray(views, jnp.float16), sdf_uniform=uniform, sdf_near=near)


def test_clean_samples_are_points_of_the_chosen_shape():
    index = jnp.array([2, 0])
    sample = draw(jax.random.key(0), shapes(), index, CLEAN, 64)
    assert sample.points.shape == (2, 2, 64, 3)
    assert sample.queries.shape == (2, 2, 64, 3)
    for row, radius in zip(range(2), (0.3, 0.1), strict=True):
        for cloud in range(2):
            points = sample.points[row, cloud][sample.mask[row, cloud]]
            assert len(points) == 64
            np.testing.assert_allclose(np.linalg.norm(points, axis=1), radius, atol=2e-3)
        expected = np.linalg.norm(sample.queries[row], axis=-1) - radius
        np.testing.assert_allclose(sample.sdf[row], expected, atol=2e-3)
    assert not np.array_equal(sample.points[0, 0], sample.points[0, 1])


def test_a_sample_depends_on_its_key_and_place_alone():
    data, key = shapes(), jax.random.key(5)
    pair = draw(key, data, jnp.array([1, 3]), CLEAN, 64)
    again = draw(key, data, jnp.array([1, 0]), CLEAN, 64)
    np.testing.assert_array_equal(pair.points[0], again.points[0])
    other = draw(jax.random.key(6), data, jnp.array([1, 3]), CLEAN, 64)
    assert not np.array_equal(pair.points[0], other.points[0])


def test_merged_views_are_at_most_so_many():
    views = jnp.broadcast_to(jnp.arange(24.0)[:, None, None], (24, 384, 3))  # view v lies at (v, v, v)
    merged = np.asarray(jax.vmap(lambda k: merge_views(k, views, 3, 256))(KEYS))
    seen = [len(np.unique(cloud)) for cloud in merged]
    assert max(seen) == 3
    assert min(seen) == 1


def test_a_half_space_cuts_a_share_on_one_side_of_a_plane():
    gone = np.asarray(jax.vmap(lambda k: half_space(k, CLOUD, 1.0))(KEYS))
    share = gone.mean(axis=1)
    assert 0.04 < share.min() < 0.08
    assert 0.35 < share.max() < 0.41
    assert not np.asarray(jax.vmap(lambda k: half_space(k, CLOUD, 0.0))(KEYS)).any()
    some = np.asarray(jax.vmap(lambda k: half_space(k, CLOUD, 0.4))(KEYS)).any(axis=1).mean()
    assert some == pytest.approx(0.4, abs=0.11)  # three standard errors of 200 draws
    points = np.asarray(CLOUD)
    for row in gone[:20]:  # separable: some plane has one class on each side
        side = np.where(row, 1.0, -1.0)[:, None]
        found = linprog(
            np.zeros(4),
            A_ub=-side * np.c_[points, np.ones(len(points))],
            b_ub=-np.ones(len(points)),
            bounds=(None, None),
        )
        assert found.status == 0


def test_a_ball_removes_points_near_one_of_them():
    points = np.asarray(CLOUD)
    gone = np.asarray(jax.vmap(lambda k: ball(k, CLOUD, 1.0))(KEYS))
    assert gone.any(axis=1).all()
    for row in gone:
        distance = np.linalg.norm(points[row][:, None] - points[row][None], axis=-1)
        assert distance.max(axis=1).min() <= 0.2  # one of them is the centre
    assert not np.asarray(jax.vmap(lambda k: ball(k, CLOUD, 0.0))(KEYS)).any()


def test_junk_replaces_at_most_15_percent_and_counts_as_kept():
    nothing = jnp.zeros(len(CLOUD), bool)
    other = jax.random.normal(jax.random.key(2), (24, 384, 3))
    mixed, kept = jax.vmap(lambda k: add_junk(k, CLOUD, nothing, other, 1.0))(KEYS)
    changed = np.asarray((mixed != CLOUD).any(axis=-1))
    np.testing.assert_array_equal(changed, np.asarray(kept))
    assert 0.10 < changed.mean(axis=1).max() <= 0.152
    on_floor = np.isclose(np.asarray(mixed)[..., 2], np.asarray(CLOUD)[:, 2].min())
    floor_only = [(f[c]).all() for f, c in zip(on_floor, changed, strict=True) if c.any()]
    assert 0.3 < np.mean(floor_only) < 0.7  # the other half are fragments
    clean, kept = jax.vmap(lambda k: add_junk(k, CLOUD, nothing, other, 0.0))(KEYS[:5])
    assert not kept.any()
    assert (np.asarray(clean) == np.asarray(CLOUD)).all()


def test_sampling_starts_at_the_kept_point_farthest_out():
    points = jnp.array([[0.0, 0, 0], [9, 0, 0], [0, 2, 0], [0.1, 0, 0]])
    first, kept = start_far_out(points, jnp.array([True, False, True, True]))
    np.testing.assert_array_equal(first[0], [0, 2, 0])
    np.testing.assert_array_equal(kept, [True, False, True, True])


def test_flawed_samples_are_finite_and_keep_enough():
    sample = draw(jax.random.key(0), shapes(), jnp.arange(2), CONFIG, 64)
    assert np.isfinite(sample.points).all()
    assert sample.mask.sum(axis=-1).min() > 32
