"""Training samples: points of the chosen views, flaws within their bounds, each a function of its key."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linprog

from train.run.settings import TrainingConfig
from train.shards.augmentation import (
    EDGE_CELLS,
    EDGE_JUMP,
    MOST_JUNK,
    add_junk,
    ball,
    behind_an_edge,
    depth_noise,
    flawed_normals,
    half_space,
    local_piece,
    merge_views,
    plane_patch,
    start_far_out,
)
from train.shards.sampling import partial_cloud, sample_batch
from train.shards.shards import Shapes
from train.shards.view_directions import DISTANCE, HALF_FIELD, view_directions

KEYS = jax.random.split(jax.random.key(0), 200)
CLOUD = jax.random.uniform(jax.random.key(1), (500, 3), minval=-0.45, maxval=0.45)
CONFIG = TrainingConfig(queries=64, raw_points=200, max_views=4)
CLEAN = dataclasses.replace(CONFIG, noise=0.0, augment_probability=0.0)
FLAWS = ("one_view", "crop", "ball", "junk", "depth_noise")
UNFLAWED = dataclasses.replace(
    CLEAN, augment_probability=1.0, **{f"{flaw}_probability": 0.0 for flaw in FLAWS}
)


def each(function, keys=KEYS):
    return jax.jit(jax.vmap(function))(keys)


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
    outward = jnp.asarray(np.rint(127 * direction), jnp.int8)
    given = {"views": jnp.asarray(views, jnp.float16), "normals": outward, "scanned": jnp.zeros(count, bool)}
    return Shapes(**given, sdf_uniform=uniform, sdf_near=near)


def test_clean_samples_are_points_of_the_chosen_shape():
    index = jnp.array([2, 0, 1, 3])
    sample = draw(jax.random.key(0), shapes(), index, CLEAN, 64)
    assert sample.points.shape == (4, 2, 64, 3)
    assert sample.queries.shape == (4, 2, 64, 3)
    for row, radius in zip(range(4), (0.3, 0.1, 0.2, 0.4), strict=True):
        for cloud in range(2):
            points = sample.points[row, cloud][sample.mask[row, cloud]]
            assert len(points) == 64
            np.testing.assert_allclose(np.linalg.norm(points, axis=1), radius, atol=2e-3)
        expected = np.linalg.norm(sample.queries[row], axis=-1) - radius
        np.testing.assert_allclose(sample.sdf[row], expected, atol=2e-3)
    assert not np.array_equal(sample.points[0, 0], sample.points[0, 1])


def test_a_sample_depends_on_its_key_and_place_alone():
    data, key = shapes(), jax.random.key(5)
    pair = draw(key, data, jnp.array([1, 3, 0, 0]), CLEAN, 64)
    again = draw(key, data, jnp.array([1, 0, 2, 0]), CLEAN, 64)
    np.testing.assert_array_equal(pair.points[0], again.points[0])
    other = draw(jax.random.key(6), data, jnp.array([1, 3, 0, 0]), CLEAN, 64)
    assert not np.array_equal(pair.points[0], other.points[0])


def test_merged_views_are_at_most_so_many():
    views = jnp.broadcast_to(jnp.arange(24.0)[:, None, None], (24, 384, 3))  # view v lies at (v, v, v)
    merged = np.asarray(each(lambda k: merge_views(k, views, 3, 256)[0]))
    seen = [len(np.unique(cloud)) for cloud in merged]
    assert max(seen) == 3
    assert min(seen) == 1
    merged = np.asarray(each(lambda k: merge_views(k, views, 8, 256, min_views=5)[0]))
    # Views are drawn with replacement: seldom fewer than so many, never one alone.
    seen = [len(np.unique(cloud)) for cloud in merged]
    assert max(seen) > 5 and min(seen) > 1 and np.mean(np.array(seen) >= 4) > 0.9


def test_a_half_space_cuts_a_share_on_one_side_of_a_plane():
    gone = np.asarray(each(lambda k: half_space(k, CLOUD, 1.0)))
    share = gone.mean(axis=1)
    assert 0.04 < share.min() < 0.08
    assert 0.35 < share.max() < 0.41
    assert not np.asarray(each(lambda k: half_space(k, CLOUD, 0.0))).any()
    some = np.asarray(each(lambda k: half_space(k, CLOUD, 0.4))).any(axis=1).mean()
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


def test_a_ball_is_empty_and_nothing_else_is_gone():
    points = np.asarray(CLOUD)
    gone = np.asarray(each(lambda k: ball(k, CLOUD, 1.0)))
    assert gone.any(axis=1).all()
    distance = np.linalg.norm(points[:, None] - points[None], axis=-1)
    for row in gone:
        farthest_gone = distance[row].max(axis=0)  # from every point as the center
        nearest_kept = np.where(row[:, None], np.inf, distance).min(axis=0)
        assert ((farthest_gone < nearest_kept) & (farthest_gone <= 0.2) & (nearest_kept > 0.05)).any()
    assert not np.asarray(each(lambda k: ball(k, CLOUD, 0.0))).any()


def test_junk_replaces_at_most_15_percent_and_counts_as_kept():
    nothing = jnp.zeros(len(CLOUD), bool)
    other = jax.random.normal(jax.random.key(2), (24, 384, 3))
    strange = other.reshape(-1, 3), jnp.broadcast_to(jnp.array([0.0, 0.6, 0.8]), (24 * 384, 3))
    up = jnp.broadcast_to(jnp.array([0.0, 0.0, 2.0]), CLOUD.shape)  # told by its length from what junk has
    mixed, normals, kept = jax.device_get(each(lambda k: add_junk(k, CLOUD, up, nothing, strange, 1.0)))
    changed = (mixed != np.asarray(CLOUD)).any(axis=-1)
    np.testing.assert_array_equal(changed, kept)
    np.testing.assert_array_equal(changed, np.linalg.norm(normals, axis=-1) < 1.5)
    assert 0.13 < changed.mean(axis=1).max() <= MOST_JUNK + 1 / len(CLOUD)
    flat = [
        np.linalg.matrix_rank(m[c] - m[c].mean(axis=0), tol=1e-4) < 3
        for m, c in zip(mixed, changed, strict=True)
    ]
    assert 0.38 < np.mean(flat) < 0.65  # patches of planes; the others are fragments
    of_fragment = [np.allclose(n[c], [0.0, 0.6, 0.8]) for n, c in zip(normals, changed, strict=True)]
    enough = changed.sum(axis=1) > 3  # three points always lie in a plane
    np.testing.assert_array_equal(np.asarray(of_fragment)[enough], ~np.asarray(flat)[enough])
    clean, normals, kept = each(lambda k: add_junk(k, CLOUD, up, nothing, strange, 0.0), KEYS[:5])
    assert not kept.any()
    assert (np.asarray(normals) == np.asarray(up)).all()
    assert (np.asarray(clean) == np.asarray(CLOUD)).all()


def test_a_fragment_is_the_points_nearest_to_one_of_them():
    other = np.random.default_rng(0).normal(size=(300, 3)).astype(np.float32)
    for key in KEYS[:10]:
        piece, beside = local_piece(key, CLOUD, jnp.asarray(other), jnp.asarray(2 * other), 20)
        offset = np.asarray(beside - beside[0]) / 2  # rows follow their points
        np.testing.assert_allclose(offset, np.asarray(piece - piece[0]), atol=2e-6)
        piece = np.asarray(piece)
        offset = piece - piece[0]  # nearest first: row 0 is the center
        center = min(range(300), key=lambda c: np.abs(nearest_to(other, c, 20) - offset).max())
        np.testing.assert_allclose(offset, nearest_to(other, center, 20), atol=2e-6)


def nearest_to(points, center, count):
    offset = points - points[center]
    return offset[np.argsort(np.linalg.norm(offset, axis=1), kind="stable")[:count]]


def test_a_fragment_of_a_shape_with_fewer_points_repeats_them():
    piece, _ = local_piece(KEYS[0], CLOUD, jnp.zeros((3, 3)), jnp.zeros((3, 3)), 10)
    assert piece.shape == (10, 3)
    assert (np.asarray(piece) == np.asarray(piece[0])).all()


def test_planes_are_level_or_upright_and_touch_the_cloud_from_outside():
    patches, facing = (np.asarray(x, np.float64) for x in each(lambda k: plane_patch(k, CLOUD, 60)))
    floors = 0
    for patch, normals in zip(patches, facing, strict=True):
        _, spread, axes = np.linalg.svd(patch - patch.mean(axis=0))
        assert spread[2] < 1e-5 < spread[1]
        normal = axes[2]
        assert min(abs(normal[2]), 1 - abs(normal[2])) < 1e-5
        floors += abs(normal[2]) > 0.5
        assert np.ptp(normals, axis=0).max() == 0
        assert abs(normals[0] @ normal) == pytest.approx(1, abs=1e-5)
        assert ((np.asarray(CLOUD) - patch[0]) @ normals[0]).min() > -1e-5  # toward the cloud
        beyond = (np.asarray(CLOUD) - patch[0]) @ normal
        assert min(abs(beyond.max()), abs(beyond.min())) < 1e-5  # all on one side, one of them on it
        if abs(normal[2]) > 0.5:
            np.testing.assert_allclose(patch[:, 2], np.asarray(CLOUD)[:, 2].min(), atol=1e-6)
    assert 0.38 < floors / len(patches) < 0.62


def seen_cloud(count=400):
    """Points of a sphere, each with a view that could have seen it."""
    rng = np.random.default_rng(3)
    unit = rng.normal(size=(count, 3))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    return jnp.asarray(0.4 * unit, jnp.float32), jnp.asarray((unit @ view_directions().T).argmax(axis=1))


def test_depth_noise_lies_along_the_ray_in_steps_that_grow_with_depth_squared():
    points, view = seen_cloud()
    config = dataclasses.replace(CONFIG, depth_noise=0.0, depth_step=0.01)
    noisy, _ = depth_noise(KEYS[0], points, view, config, 1.0)
    toward = view_directions()[np.asarray(view)]
    before, after = (np.asarray(p, np.float64) - DISTANCE * toward for p in (points, noisy))
    np.testing.assert_allclose(np.cross(before, after), 0, atol=1e-6)
    depth = [-(ray * toward).sum(axis=1) for ray in (before, after)]
    np.testing.assert_allclose(depth[1], 1 / (np.round(1 / depth[0] / 0.01) * 0.01), rtol=1e-5)
    assert (np.abs(depth[1] - depth[0]) <= 0.0051 * depth[0] * depth[1]).all()


def test_depth_noise_has_its_standard_deviation_and_happens_with_its_probability():
    points, view = seen_cloud()
    config = dataclasses.replace(CONFIG, depth_noise=0.003, depth_step=1e-4)
    noisy, lost = depth_noise(KEYS[0], points, view, config, 1.0)
    toward = view_directions()[np.asarray(view)]
    inverse = [1 / (DISTANCE - (np.asarray(p) * toward).sum(axis=1)) for p in (points, noisy)]
    assert np.std(inverse[1] - inverse[0]) == pytest.approx(0.003, rel=0.15)
    untouched, lost = depth_noise(KEYS[0], points, view, config, 0.0)
    assert (untouched == points).all()
    assert not lost.any()


def test_points_in_the_shadow_of_a_depth_edge_are_lost():
    rng = np.random.default_rng(0)
    points, view = rng.uniform(-0.45, 0.45, (500, 3)), rng.integers(0, 24, 500)
    expected = np.zeros(500, bool)
    for v in range(24):  # pixel columns and rows of that view, by definition
        toward = view_directions()[v]
        right = np.cross(toward, [0, 0, 1.0] if abs(toward[2]) < 0.95 else [1.0, 0, 0])
        right /= np.linalg.norm(right)
        ray = points - DISTANCE * toward
        depth = -ray @ toward
        cells = [
            np.floor((ray @ a / depth / HALF_FIELD + 1) / 2 * EDGE_CELLS)
            for a in (right, np.cross(right, toward))
        ]
        for i in np.flatnonzero(view == v):
            same = (view == v) & (cells[0] == cells[0][i]) & (cells[1] == cells[1][i])
            expected[i] = (depth[same] < depth[i] - EDGE_JUMP).any()
    lost = behind_an_edge(jnp.asarray(points, jnp.float32), jnp.asarray(view))
    assert expected.any()
    np.testing.assert_array_equal(lost, expected)


def test_one_view_clouds_are_of_one_view():
    views = jnp.broadcast_to(jnp.arange(24.0)[:, None, None], (24, 384, 3))
    merged, view, _ = each(lambda k: merge_views(k, views, 6, 64, 1.0))
    assert max(len(np.unique(cloud)) for cloud in np.asarray(merged)) == 1
    np.testing.assert_array_equal(merged[..., 0], view)  # each point names its view


def with_normals(views):
    return views, jnp.zeros(views.shape, jnp.int8)


@partial(jax.jit, static_argnames="config")
def clouds(views, other, config):
    seen = with_normals(views), with_normals(other)
    return jax.vmap(lambda key: partial_cloud(key, *seen, config, 16))(KEYS)


@pytest.mark.slow
def test_flaws_happen_in_augmented_clouds_alone():
    certain = {f"{flaw}_probability": 1.0 for flaw in FLAWS}
    open_to_all = dataclasses.replace(CLEAN, augment_probability=0.6, **certain)
    views = shapes().views[jnp.array([1, 3])]
    clean, flawed = (clouds(*views, config)[0] for config in (UNFLAWED, open_to_all))
    changed = np.asarray((clean != flawed).any(axis=(1, 2))).mean()
    assert changed == pytest.approx(0.6, abs=0.11)
    np.testing.assert_array_equal(clean, clouds(*views, dataclasses.replace(CLEAN, **certain))[0])


def test_sampling_starts_at_the_kept_point_farthest_out():
    points = jnp.array([[0.0, 0, 0], [9, 0, 0], [0, 2, 0], [0.1, 0, 0]])
    first, beside, kept = start_far_out(points, 10 * points, jnp.array([True, False, True, True]))
    np.testing.assert_array_equal(first[0], [0, 2, 0])
    np.testing.assert_array_equal(beside, 10 * first)
    np.testing.assert_array_equal(kept, [True, False, True, True])


def test_flawed_samples_are_finite_and_keep_enough():
    sample = draw(jax.random.key(0), shapes(), jnp.arange(4), CONFIG, 64)
    assert np.isfinite(sample.points).all()
    assert sample.mask.sum(axis=-1).min() > 32


def test_a_cloud_that_cuts_would_leave_nothing_of_stays_whole():
    config = dataclasses.replace(UNFLAWED, ball_probability=1.0)

    def kept(key, views):
        return partial_cloud(key, with_normals(views), with_normals(views), config, 200)[2]

    cut = jax.jit(jax.vmap(kept, (0, None)))
    views = shapes().views[3, :4]
    small = cut(KEYS[:20], 0.05 * views).sum(
        axis=1
    )  # of radius 0.02: any ball about a point of it holds it all
    assert small.min() > 100  # points drawn twice count once
    assert (cut(KEYS[:20], views).sum(axis=1) < small).all()


def test_samples_follow_the_shapes_when_these_are_permuted():
    data, key, order = shapes(), jax.random.key(2), np.array([2, 0, 3, 1])
    permuted = jax.tree.map(lambda a: a[order], data)
    first = draw(key, data, jnp.asarray(order), CONFIG, 64)
    second = draw(key, permuted, jnp.arange(4), CONFIG, 64)
    jax.tree.map(np.testing.assert_array_equal, first, second)


def test_a_shape_that_is_one_point_gives_one_kept_point():
    one = Shapes(
        views=jnp.zeros((1, 24, 8, 3), jnp.float16),
        normals=jnp.zeros((1, 24, 8, 3), jnp.int8),
        sdf_uniform=jnp.ones((1, 9, 4), jnp.float16),
        sdf_near=jnp.ones((1, 9, 4), jnp.float16),
        scanned=jnp.zeros(1, bool),
    )
    sample = draw(jax.random.key(0), one, jnp.array([0]), CLEAN, 32)
    np.testing.assert_array_equal(sample.mask.sum(axis=-1), 1)
    assert (sample.points == 0).all()


# --- normals ------------------------------------------------------------------------------------------------

UP = jnp.broadcast_to(jnp.array([0.0, 0.0, 1.0]), CLOUD.shape)
TRUE_NORMALS = dataclasses.replace(
    CONFIG,
    normal_noise_deg=0.0,
    normals_unknown_probability=0.0,
    normals_lost_probability=0.0,
    flip_probability=0.0,
    flipped=0.0,
)


def flawed(**settings):
    config = dataclasses.replace(TRUE_NORMALS, **settings)
    return np.asarray(each(lambda k: flawed_normals(k, UP, CLOUD, config, 1.0)), np.float64)


def test_normals_of_samples_are_those_of_their_points():
    """On spheres about the origin a point's normal is its direction, also of fragments that keep their own."""
    config = dataclasses.replace(TRUE_NORMALS, noise=0.0, augment_probability=0.0)
    sample = draw(jax.random.key(0), shapes(), jnp.arange(4), config, 64)
    unit = sample.points / jnp.linalg.norm(sample.points, axis=-1, keepdims=True)
    np.testing.assert_allclose(sample.normals, unit, atol=0.01)


def test_points_of_samples_do_not_depend_on_what_befalls_normals():
    drawn = [draw(jax.random.key(0), shapes(), jnp.arange(4), c, 64) for c in (CONFIG, UNFLAWED_NORMALS)]
    np.testing.assert_array_equal(drawn[0].points, drawn[1].points)
    assert not np.array_equal(drawn[0].normals, drawn[1].normals)


UNFLAWED_NORMALS = dataclasses.replace(CONFIG, normal_noise_deg=0.0, normals_unknown_probability=0.0)


def test_flawed_normals_have_unit_length_or_none():
    found = np.asarray(each(lambda k: flawed_normals(k, UP, CLOUD, CONFIG, 1.0)))
    length = np.linalg.norm(found, axis=-1)
    assert (np.isclose(length, 1, atol=1e-5) | (length == 0)).all()
    nowhere = (length == 0).all(axis=1).mean()
    assert nowhere == pytest.approx(CONFIG.normals_unknown_probability, abs=0.11)
    np.testing.assert_array_equal(flawed(), np.broadcast_to(UP, found.shape))


def test_normals_tilt_by_their_noise():
    tilt = np.rad2deg(np.arccos(np.clip(flawed(normal_noise_deg=5.0)[..., 2], -1, 1)))
    rms = np.sqrt((tilt**2).mean(axis=1) / 2)  # of each of two ways
    assert rms.min() > 0.9 * 0.3 * 5
    assert rms.max() < 1.1 * 1.7 * 5
    assert np.mean(rms) == pytest.approx(5.0, rel=0.1)


def test_inward_normals_fill_a_ball_or_are_strewn():
    inward = flawed(flip_probability=1.0)[..., 2] < 0
    points = np.asarray(CLOUD)
    for row in inward:
        assert row.any() and np.linalg.norm(points[row] - points[row].mean(axis=0), axis=1).max() < 0.4
    assert (flawed(flipped=0.1)[..., 2] < 0).mean() == pytest.approx(0.1, abs=0.01)


def test_lost_normals_are_up_to_half_and_unknown_ones_stay_so():
    lost = (flawed(normals_lost_probability=1.0) == 0).all(axis=-1).mean(axis=1)
    assert lost.mean() == pytest.approx(0.25, abs=0.04)
    assert lost.max() < 0.6
    zeros = each(lambda k: flawed_normals(k, 0 * UP, CLOUD, CONFIG, 1.0))
    assert not np.asarray(zeros).any()
