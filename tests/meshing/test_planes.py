"""Planes of neighboring points: as NumPy's eigenvectors have them, whatever the frame, the order and the padding."""

import numpy as np
import pytest
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from more2_jax.geometry.padding import MIN_POINTS
from more2_jax.meshing.planes import OF_FACE, WIDE, planes, planes_of


def neighbors(points, count=12):
    return np.asarray(KDTree(points).query(points, k=count)[1])


def edge(count=1500, noise=0.0, seed=0):
    """Two faces that meet at a right angle, and which axis each point's face is across."""
    rng = np.random.default_rng(seed)
    points, across = rng.uniform(-0.4, 0.4, (count, 3)), rng.integers(0, 2, count)
    points[np.arange(count), across] = 0.4
    return points + noise * rng.normal(size=points.shape), across


def by_eigenvectors(points, near):
    """Mean, least axis, variances: float64, one point after the other."""
    center, normal, spread = [], [], []
    for row in near:
        values, axes = np.linalg.eigh(np.cov(points[row].T, bias=True))
        center.append(points[row].mean(axis=0)), normal.append(axes[:, 0]), spread.append(values)
    return np.array(center), np.array(normal), np.array(spread)


def faces_one_by_one(points, near):
    """The definition: of the planes of the six nearest of each neighbor, the one that all of these fit best."""
    center, normal, spread = by_eigenvectors(points, near[:, :OF_FACE])
    otherwise, found = by_eigenvectors(points, near)[1], []
    for k, row in enumerate(near):
        wide = [j for j in row if spread[j, 1] > WIDE * spread[j, 2]]
        off = [spread[j, 0] + ((points[k] - center[j]) @ normal[j]) ** 2 for j in wide]
        found.append(normal[wide[int(np.argmin(off))]] if wide else otherwise[k])
    return np.array(found)


def cosine(a, b):
    return np.abs(np.einsum("ni,ni->n", a, b))


@pytest.mark.parametrize("noise", [0.002, 0.02])
def test_planes_are_those_of_the_eigenvectors(noise):
    points, _ = edge(noise=noise)
    near = neighbors(points)
    found, (center, normal, spread) = planes_of(points, near), by_eigenvectors(points, near)
    np.testing.assert_allclose(found.center, center, atol=1e-6)
    np.testing.assert_allclose(found.off, spread[:, 0], rtol=1e-3, atol=1e-9)
    np.testing.assert_allclose(found.spread, spread.sum(axis=1), rtol=1e-4)
    told = spread[:, 1] > 1.1 * spread[:, 0]  # of a ball any axis is least
    assert told.mean() > 0.9 and cosine(found.normal, normal)[told].min() > 0.9999
    assert (cosine(found.face, faces_one_by_one(points, near)) > 0.9999).mean() > 0.995  # ties


def test_beside_an_edge_a_face_is_one_of_the_two():
    points, across = edge()
    found = planes_of(points, neighbors(points))
    true = np.eye(3)[across]
    assert (
        (cosine(found.face, true) > 0.9999).mean()
        > 0.97
        > 0.95
        > (cosine(found.normal, true) > 0.9999).mean()
    )


def test_points_of_a_line_lie_in_no_plane():
    """Two scan lines, eight times as far apart as their points: six neighbors are of one line, twelve are not."""
    along = np.arange(0, 0.4, 0.01)
    points = np.concatenate([np.column_stack([along, np.full(40, y), 0 * along]) for y in (0.0, 0.03)])
    found = planes_of(points, neighbors(points))
    np.testing.assert_allclose(cosine(found.face, np.tile([0.0, 0, 1], (80, 1)))[5:35], 1.0, atol=1e-5)


def test_frame_order_and_padding_change_nothing():
    points, _ = edge(count=MIN_POINTS + 44, noise=0.003)
    near, here = neighbors(points), planes_of(points, neighbors(points))
    R, order = Rotation.random(random_state=0).as_matrix(), np.random.default_rng(1).permutation(len(points))
    turned, mixed = planes_of(points @ R.T, near), planes_of(points[order], neighbors(points[order]))
    np.testing.assert_allclose(turned.center, here.center @ R.T, atol=1e-6)
    np.testing.assert_allclose(turned.spread, here.spread, rtol=1e-4)
    np.testing.assert_allclose(mixed.off, here.off[order], rtol=1e-3, atol=1e-9)
    assert cosine(turned.normal, here.normal @ R.T).min() > 0.9999
    assert np.median(1 - cosine(mixed.face, here.face[order])) < 1e-6
    bare = planes(points.astype(np.float32), near.astype(np.int32))
    np.testing.assert_allclose(here.normal, bare.normal, atol=1e-5)
    np.testing.assert_allclose(here.face, bare.face, atol=1e-5)


@pytest.mark.parametrize(
    "points",
    [np.zeros((40, 3)), np.repeat(np.eye(3), 20, axis=0), np.outer(np.linspace(0, 1, 50), [1.0, 2.0, 3.0])],
    ids=["one place", "three places", "a line"],
)
def test_points_without_a_plane_have_unit_normals_all_the_same(points):
    found = planes_of(points, neighbors(points))
    for normal in (found.normal, found.face):
        np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0, atol=1e-5)
    assert np.isfinite(found.center).all() and (found.off < 1e-6).all()


def test_clouds_of_many_sizes_share_a_program():
    before = planes._cache_size()
    for count in (600, 700, 1000):
        points, _ = edge(count=count)
        planes_of(points, neighbors(points, 13))
    assert planes._cache_size() == before + 1
