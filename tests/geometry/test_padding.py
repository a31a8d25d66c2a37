"""Padding: what is real survives bit for bit, what is not is masked, and buckets are few."""

import numpy as np
import pytest

from more2_jax.geometry.padding import MAX_POINTS, MIN_POINTS, bucket, pad_batch, pad_clouds, take

RNG = np.random.default_rng(0)


def cloud(count, center=(0.0, 0.0, 0.0)):
    return RNG.normal(size=(count, 3)) + center


def unpadded(batch, row):
    """A cloud as it went in, sorted."""
    local = np.asarray(batch.points[row], np.float64)[np.asarray(batch.mask[row])]
    return np.sort(local + batch.origin[row], axis=0)


@pytest.mark.parametrize("count", [0, 1, 2, 3, 7, 8, 9, 1000, 1024, 1025])
def test_bucket_is_the_least_power_of_two_that_holds(count):
    size = bucket(count)
    assert size >= count
    assert size & (size - 1) == 0
    assert size == 1 or size // 2 < count


def test_bucket_has_a_floor():
    assert bucket(3, 256) == 256
    assert bucket(257, 256) == 512


def test_points_come_back_unharmed():
    clouds = [cloud(n) for n in (1, 2, 100, MIN_POINTS, MIN_POINTS + 1)]
    batch = pad_clouds(clouds)
    assert batch.points.shape == (5, 2 * MIN_POINTS, 3)
    assert np.asarray(batch.mask.sum(axis=1)).tolist() == [len(c) for c in clouds]
    for row, points in enumerate(clouds):
        np.testing.assert_allclose(unpadded(batch, row), np.sort(points, axis=0), atol=1e-6)


def test_a_kilometer_away_nothing_is_lost():
    near, far = cloud(500) * 0.1, np.array([1000.0, -2000.0, 5.0])
    batch = pad_clouds([near, near + far])
    assert batch.origin.dtype == np.float64
    assert np.abs(np.asarray(batch.points[0]) - np.asarray(batch.points[1])).max() < 1e-6
    np.testing.assert_allclose(batch.origin[1] - batch.origin[0], far, atol=1e-9)


def test_the_farthest_point_is_first_whatever_the_order():
    points = cloud(300)
    first = points[np.argmax(np.linalg.norm(points - points.mean(axis=0), axis=1))]
    for order in (np.arange(300), RNG.permutation(300)):
        batch = pad_clouds([points[order]])
        np.testing.assert_allclose(np.asarray(batch.points[0, 0]) + batch.origin[0], first, atol=1e-6)


def test_padding_is_masked_and_inside_the_cloud():
    batch = pad_clouds([cloud(10)])
    points, mask = np.asarray(batch.points[0]), np.asarray(batch.mask[0])
    assert not mask[10:].any()
    assert (points[10:] == points[0]).all()


def test_large_clouds_are_thinned_evenly():
    points = cloud(5 * MAX_POINTS)
    batch = pad_clouds([points])
    assert batch.points.shape == (1, MAX_POINTS, 3)
    assert bool(batch.mask.all())
    kept = np.asarray(batch.points[0], np.float64) + batch.origin[0]
    index = np.sort(np.linalg.norm(kept[:, None] - points[None], axis=-1).argmin(axis=1))
    assert (index[0], index[-1]) == (0, len(points) - 1)
    assert set(np.diff(index)) <= {4, 5, 6}


def test_a_size_may_be_asked_for():
    assert pad_clouds([cloud(10)], size=512).points.shape == (1, 512, 3)
    with pytest.raises(ValueError, match="600 points; needed at most the bucket's 512"):
        pad_clouds([cloud(600)], size=512)


@pytest.mark.parametrize(
    ("clouds", "complaint"),
    [
        ([], "no clouds; needed at least one"),
        ([np.zeros((3, 3)), np.zeros((0, 3))], r"cloud 1 has shape \(0, 3\)"),
        ([np.full((4, 3), np.inf)], "cloud 0 has 4 points that are not finite"),
        ([np.array([[0, 0, 0], [0, np.nan, 0.0]])], "cloud 0 has 1 points that are not finite"),
    ],
)
def test_bad_clouds_are_refused(clouds, complaint):
    with pytest.raises(ValueError, match=complaint):
        pad_clouds(clouds)


def test_one_point_and_equal_points():
    batch = pad_clouds([np.ones((1, 3)), np.ones((20, 3))])
    assert np.asarray(batch.mask.sum(axis=1)).tolist() == [1, 20]
    assert (np.asarray(batch.points) == 0).all()
    np.testing.assert_array_equal(batch.origin, 1)


def test_fillers_repeat_the_first_and_take_undoes_them():
    clouds = [cloud(10), cloud(20, (5, 0, 0)), cloud(30)]
    batch = pad_clouds(clouds)
    filled = pad_batch(batch, 8)
    assert filled.points.shape[0] == filled.mask.shape[0] == filled.origin.shape[0] == 8
    assert (np.asarray(filled.points[3:]) == np.asarray(batch.points[0])).all()
    again = take(filled, [2, 1])
    np.testing.assert_array_equal(again.points, batch.points[np.array([2, 1])])
    np.testing.assert_array_equal(again.origin, batch.origin[[2, 1]])


# --- normals ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [1, 40, 3 * MAX_POINTS])
def test_normals_stay_with_their_points(count):
    """Of points on a sphere the normal is the direction, whatever order and thinning did."""
    points = RNG.normal(size=(count, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    batch = pad_clouds([points + 7.0], normals=[3.0 * points])  # any length, unit in the end
    kept = np.asarray(batch.points[0], np.float64) + batch.origin[0] - 7.0
    np.testing.assert_allclose(batch.normals[0], kept, atol=1e-5)


def test_normals_that_are_not_known_are_zeros():
    normals = np.ones((10, 3))
    normals[4], normals[5] = np.nan, 0.0
    batch = pad_clouds([np.arange(30.0).reshape(10, 3), cloud(20)], normals=[normals, None])
    known = np.linalg.norm(batch.normals, axis=-1)
    assert np.isclose(known[0, :10], 1).sum() == 8 and (known[0] == 0).sum() == 2
    assert not known[1].any()
    assert pad_clouds([cloud(10)]).normals is None


def test_fillers_and_choices_carry_normals():
    clouds = [cloud(10), cloud(20)]
    batch = pad_clouds(clouds, normals=clouds)
    np.testing.assert_array_equal(pad_batch(batch, 4).normals[3], batch.normals[0])
    np.testing.assert_array_equal(take(batch, [1]).normals[0], batch.normals[1])


def test_normals_of_another_number_are_refused():
    with pytest.raises(ValueError, match=r"cloud 1 has normals of shape \(9, 3\); needed \(10, 3\)"):
        pad_clouds([cloud(10)] * 2, normals=[None, cloud(9)])
