"""Flaws of fused scans: views move as wholes, waves bend normals as they bend surfaces, noise has its bounds."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from train.run.settings import TrainingConfig
from train.shards.fusion_flaws import (
    SWELL,
    SWELL_SPREAD,
    VARIES,
    clustered,
    drifted,
    fused,
    point_noise,
    waved,
)
from train.shards.sampling import partial_cloud
from train.shards.view_directions import VIEWS

KEYS = jax.random.split(jax.random.key(3), 100)
CONFIG = TrainingConfig(queries=64, raw_points=256)
POINTS = jax.random.uniform(jax.random.key(1), (600, 3), minval=-0.45, maxval=0.45)
NORMALS = POINTS / jnp.linalg.norm(POINTS, axis=-1, keepdims=True)
VIEW = jnp.arange(600) % VIEWS


def test_each_view_moves_as_a_whole_and_its_normals_turn_with_it():
    config = dataclasses.replace(CONFIG, drift=0.02, drift_deg=0.5)
    moved, turned = drifted(KEYS[0], POINTS, NORMALS, VIEW, config, 1.0)
    motions = []
    for view in range(VIEWS):
        rows = np.asarray(VIEW) == view
        before, after = np.asarray(POINTS)[rows], np.asarray(moved)[rows]
        lengths = [np.linalg.norm(a[:, None] - a[None], axis=-1) for a in (before, after)]
        np.testing.assert_allclose(*lengths, atol=1e-3)
        offsets = before - before.mean(0)
        covariance = (after - after.mean(0)).T @ offsets
        left, _, right = np.linalg.svd(covariance)
        R = left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
        np.testing.assert_allclose(np.asarray(turned)[rows], np.asarray(NORMALS)[rows] @ R.T, atol=2e-3)
        motions.append(after.mean(0) - before.mean(0))
    assert np.ptp(motions, axis=0).min() > 0.005


def test_drift_has_its_size():
    config = dataclasses.replace(CONFIG, drift=0.02, drift_deg=0.0)
    moved = jax.vmap(lambda k: drifted(k, POINTS, NORMALS, VIEW, config, 1.0)[0])(KEYS)
    shift = np.asarray(moved - POINTS)[:, :VIEWS]
    size = 0.02 * np.sqrt(np.mean(np.linspace(*VARIES, 1001) ** 2))
    assert shift.std() == pytest.approx(size, rel=0.1)


@pytest.mark.parametrize("flaw", [drifted, fused])
def test_a_flaw_that_does_not_happen_changes_nothing(flaw):
    view = (VIEW,) if flaw is drifted else ()
    points, normals = flaw(KEYS[0], POINTS, NORMALS, *view, CONFIG, 0.0)
    np.testing.assert_array_equal(points, POINTS)
    np.testing.assert_allclose(normals, NORMALS, atol=1e-7)


def test_waves_bend_normals_as_they_bend_the_surface():
    """A plane after its wave is a height field, whose normal central differences tell."""
    step = 1e-3
    place = jax.random.uniform(jax.random.key(5), (50, 2), minval=-0.4, maxval=0.4)
    offsets = step * jnp.array([[0.0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
    flat = jnp.concatenate([(place[:, None] + offsets).reshape(-1, 2), jnp.zeros((250, 1))], axis=1)
    up = jnp.broadcast_to(jnp.array([0.0, 0, 1]), flat.shape)
    points, normals = waved(KEYS[1], flat, up, 0.01)
    np.testing.assert_array_equal(points[:, :2], flat[:, :2])
    height = np.asarray(points[:, 2]).reshape(50, 5)
    slope = np.stack([height[:, 1] - height[:, 2], height[:, 3] - height[:, 4]], axis=1) / (2 * step)
    expected = np.concatenate([-slope, np.ones((50, 1))], axis=1)
    assert np.abs(slope).max() > 0.02
    np.testing.assert_allclose(np.asarray(normals).reshape(50, 5, 3)[:, 0], expected, atol=1e-3)


def test_waves_have_their_size_and_leave_points_without_normals():
    known = NORMALS.at[::2].set(0.0)
    points, normals = jax.vmap(lambda k: waved(k, POINTS, known, 0.01))(KEYS)
    np.testing.assert_array_equal(points[:, ::2], np.broadcast_to(POINTS[::2], (100, 300, 3)))
    np.testing.assert_array_equal(normals[:, ::2], 0.0)
    wave = np.sum(np.asarray(points - POINTS) * np.asarray(NORMALS), axis=-1)[:, 1::2]
    assert wave.mean() == pytest.approx(0.01 * SWELL, rel=0.25)
    assert wave.std() == pytest.approx(0.01 * np.sqrt(1 + SWELL_SPREAD**2), rel=0.15)


def test_points_of_a_cell_become_their_mean():
    """Against a dictionary of cells."""
    cell, offset = 0.11, np.array([0.02, 0.05, 0.1])
    points, normals = clustered(POINTS, NORMALS, cell, jnp.asarray(offset))
    cells: dict[tuple, list[int]] = {}
    for row, place in enumerate(np.floor((np.asarray(POINTS) + offset) / cell).astype(int)):
        cells.setdefault(tuple(place), []).append(row)
    assert 100 < len(cells) < 500
    for rows in cells.values():
        for new, old in ((points, POINTS), (normals, NORMALS)):
            np.testing.assert_allclose(
                new[np.array(rows)], np.broadcast_to(old[np.array(rows)].mean(0), (len(rows), 3)), atol=1e-5
            )


def test_two_sides_of_a_sheet_thinner_than_a_voxel_join():
    flat = POINTS.at[:, 2].set(jnp.where(jnp.arange(600) % 2 == 0, 0.002, -0.002))
    up = jnp.zeros_like(flat).at[:, 2].set(jnp.sign(flat[:, 2]))
    points, normals = clustered(flat, up, 0.2, jnp.full(3, 0.1))
    assert np.abs(points[:, 2]).max() < 0.002
    assert np.linalg.norm(normals, axis=-1).max() < 0.9


def test_noise_is_drawn_between_its_bounds_where_flaws_are_allowed():
    config = dataclasses.replace(CONFIG, noise=0.002, most_noise=0.02)
    size = np.array([point_noise(k, POINTS, config, True).std() for k in KEYS])
    assert 0.0018 < size.min() < 0.0026
    assert 0.016 < size.max() < 0.0215
    assert np.median(size) == pytest.approx(np.sqrt(0.002 * 0.02), rel=0.3)
    plain = point_noise(KEYS[0], POINTS, config, False)
    np.testing.assert_allclose(plain, 0.002 * jax.random.normal(KEYS[0], POINTS.shape), rtol=1e-6)


def views() -> tuple[jax.Array, jax.Array]:
    """Of a ball of radius 0.4, as shards hold them."""
    rng = np.random.default_rng(0)
    outward = rng.normal(size=(VIEWS, 64, 3))
    outward /= np.linalg.norm(outward, axis=-1, keepdims=True)
    return jnp.asarray(0.4 * outward, jnp.float16), jnp.asarray(np.rint(127 * outward), jnp.int8)


@pytest.mark.slow
def test_points_of_a_scan_get_no_further_flaws():
    every = dict.fromkeys((f"{flaw}_probability" for flaw in ("augment", "junk", "drift", "fused")), 1.0)
    config = dataclasses.replace(CONFIG, noise=0.1, **every)
    for scanned, least, most in ((True, 0.0, 2e-3), (False, 0.05, 9.0)):
        points, _, mask = partial_cloud(KEYS[3], views(), views(), config, 64, scanned)
        off = np.abs(np.linalg.norm(points, axis=-1) - 0.4)[mask].max()
        assert least <= off < most


@pytest.mark.slow
def test_clouds_without_these_flaws_are_as_they_were_and_with_them_are_not():
    """Keys of their own: what else is drawn of a cloud stays."""
    seen = views()
    small = dataclasses.replace(
        CONFIG,
        drift_probability=1.0,
        drift=1e-7,
        drift_deg=0.0,
        fused_probability=1.0,
        fused=1e-7,
        voxel=1e-5,
    )
    large = dataclasses.replace(small, drift=0.02)
    plain, close, far = (partial_cloud(KEYS[7], seen, seen, c, 64)[0] for c in (CONFIG, small, large))
    np.testing.assert_allclose(close, plain, atol=2e-6)
    assert np.abs(far - plain).max() > 0.005
