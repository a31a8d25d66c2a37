"""Planes of neighboring points: as NumPy's eigenvectors have them, whatever the frame and the order."""

import numpy as np
import pytest
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from more2_jax.meshing.planes import FACE_NEIGHBORS, LEAST_ASPECT, face_normals, fit_planes, least_axes


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
    center, normal, spread = by_eigenvectors(points, near[:, :FACE_NEIGHBORS])
    otherwise, found = by_eigenvectors(points, near)[1], []
    for k, row in enumerate(near):
        wide = [j for j in row if spread[j, 1] > LEAST_ASPECT * spread[j, 2]]
        off = [spread[j, 0] + ((points[k] - center[j]) @ normal[j]) ** 2 for j in wide]
        found.append(normal[wide[int(np.argmin(off))]] if wide else otherwise[k])
    return np.array(found)


def cosine(a, b):
    return np.abs(np.einsum("ni,ni->n", a, b))


def faces(points, near):
    return face_normals(points, near, fit_planes(points, near).normal)


@pytest.mark.parametrize("noise", [0.002, 0.02])
def test_planes_are_those_of_the_eigenvectors(noise):
    points, _ = edge(noise=noise)
    near = neighbors(points)
    found, (center, normal, spread) = fit_planes(points, near), by_eigenvectors(points, near)
    np.testing.assert_allclose(found.center, center, atol=1e-12)
    np.testing.assert_allclose(found.residual_variance, spread[:, 0], rtol=1e-6, atol=1e-15)
    np.testing.assert_allclose(found.total_variance, spread.sum(axis=1), rtol=1e-9)
    told = spread[:, 1] > 1.01 * spread[:, 0]  # of a ball any axis is least
    assert told.mean() > 0.95 and cosine(found.normal, normal)[told].min() > 1 - 1e-9
    assert (cosine(faces(points, near), faces_one_by_one(points, near)) > 1 - 1e-9).mean() > 0.995  # ties


@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e6])
def test_least_axes_of_any_size_with_repeated_eigenvalues_too(scale):
    values = np.array([[0, 1, 2], [0, 0, 1], [0, 1, 1], [1, 1, 1], [0, 0, 0], [1, 1 + 1e-7, 2], [1, 1, 2.0]])
    axes = Rotation.random(len(values), random_state=0).as_matrix()
    matrix = scale * np.einsum("nij,nj,nkj->nik", axes, values, axes)
    found = least_axes(matrix)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0, atol=1e-12)
    # Each is an eigenvector of the least eigenvalue, whichever of its space.
    np.testing.assert_allclose(
        np.einsum("nij,nj->ni", matrix, found), scale * values[:, :1] * found, atol=1e-6 * scale
    )


def test_beside_an_edge_a_face_is_one_of_the_two():
    points, across = edge()
    near = neighbors(points)
    true = np.eye(3)[across]
    of_face, of_all = (
        (cosine(n, true) > 0.9999).mean() for n in (faces(points, near), fit_planes(points, near).normal)
    )
    assert of_face > 0.97 > 0.95 > of_all


def test_points_of_a_line_lie_in_no_plane():
    """Two scan lines, eight times as far apart as their points: six neighbors are of one line, twelve are not."""
    along = np.arange(0, 0.4, 0.01)
    points = np.concatenate([np.column_stack([along, np.full(40, y), 0 * along]) for y in (0.0, 0.03)])
    found = faces(points, neighbors(points))
    np.testing.assert_allclose(cosine(found, np.tile([0.0, 0, 1], (80, 1)))[5:35], 1.0, atol=1e-9)


def test_frame_and_order_change_nothing():
    points, _ = edge(count=300, noise=0.003)
    near, here = neighbors(points), fit_planes(points, neighbors(points))
    R, order = Rotation.random(random_state=0).as_matrix(), np.random.default_rng(1).permutation(len(points))
    turned, mixed = fit_planes(points @ R.T, near), fit_planes(points[order], neighbors(points[order]))
    np.testing.assert_allclose(turned.center, here.center @ R.T, atol=1e-12)
    np.testing.assert_allclose(turned.total_variance, here.total_variance, rtol=1e-9)
    np.testing.assert_allclose(mixed.residual_variance, here.residual_variance[order], rtol=1e-6, atol=1e-15)
    assert cosine(turned.normal, here.normal @ R.T).min() > 1 - 1e-9
    same = cosine(faces(points[order], neighbors(points[order])), faces(points, near)[order])
    assert np.median(1 - same) < 1e-9


@pytest.mark.parametrize(
    "points",
    [np.zeros((40, 3)), np.repeat(np.eye(3), 20, axis=0), np.outer(np.linspace(0, 1, 50), [1.0, 2.0, 3.0])],
    ids=["one place", "three places", "a line"],
)
def test_points_without_a_plane_have_unit_normals_all_the_same(points):
    near = neighbors(points)
    found = fit_planes(points, near)
    for normal in (found.normal, faces(points, near)):
        np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0, atol=1e-9)
    assert np.isfinite(found.center).all() and (found.residual_variance < 1e-12).all()
