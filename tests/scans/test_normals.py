"""Normals of scans: as files state them, by the winding of faces, out of the matter, and moved with the points."""

import numpy as np
import pytest
import trimesh
from plyfile import PlyData, PlyElement
from scipy.spatial.transform import Rotation

from more2_jax.scans.files.ply_faces import unit_or_zero, vertex_normals
from more2_jax.scans.normal_sides import outward
from more2_jax.scans.read_scan import read_scan

RNG = np.random.default_rng(0)
BALL = trimesh.creation.icosphere(subdivisions=3, radius=0.4)
TURNED_WARNING = "normals point into the surfaces"


def write_ply(path, points, faces=None, **properties):
    columns = dict(zip("xyz", np.asarray(points, "f8").T, strict=True)) | properties
    table = np.empty(len(points), [(name, column.dtype) for name, column in columns.items()])
    for name, column in columns.items():
        table[name] = column
    elements = [PlyElement.describe(table, "vertex")]
    if faces is not None:
        rows = np.empty(len(faces), [("vertex_indices", "i4", (faces.shape[1],))])
        rows["vertex_indices"] = faces
        elements.append(PlyElement.describe(rows, "face"))
    PlyData(elements).write(str(path))
    return path


def corners(faces):
    return faces.ravel().astype(np.int64), np.repeat(np.arange(len(faces)), faces.shape[1])


def room():
    """A room of 4 × 3 × 2.5 m seen from inside, and a ball in it: points, outward normals, instances."""
    parts = []
    for axis, side in ((0, 0), (0, 4.0), (1, 0), (1, 3.0), (2, 0)):
        points = RNG.uniform(0, [4.0, 3.0, 2.5], (200, 3))
        points[:, axis] = side
        normal = np.zeros((200, 3))
        normal[:, axis] = 1.0 if side == 0 else -1.0
        parts.append((points, normal, np.zeros(200, int)))
    vertices = np.asarray(BALL.vertices)
    parts.append((vertices + [2.0, 1.0, 0.4], vertices / 0.4, np.full(len(vertices), 3)))
    return (np.concatenate(x) for x in zip(*parts, strict=True))


def test_winding_gives_the_normals_of_a_ball_and_those_of_trimesh():
    normals = vertex_normals(np.asarray(BALL.vertices) + 1e3, *corners(np.asarray(BALL.faces)))
    np.testing.assert_allclose(normals, BALL.vertices / 0.4, atol=0.02)
    assert np.einsum("ni,ni->n", normals, BALL.vertex_normals).min() > 0.999  # weighted by angle there


def test_quads_turn_with_the_mesh_and_lone_vertices_have_none():
    square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [5, 5, 5]])
    quad = np.array([[0, 1, 2, 3]])
    turn = Rotation.random(random_state=0).as_matrix()
    for R in (np.eye(3), turn):
        normals = vertex_normals(square @ R.T, *corners(quad))
        np.testing.assert_allclose(normals[:4], np.tile(R[:, 2], (4, 1)), atol=1e-12)
        assert (normals[4] == 0).all()
    np.testing.assert_allclose(vertex_normals(square, *corners(quad[:, ::-1]))[:4, 2], -1.0)
    assert not vertex_normals(square, np.zeros(0, int), np.zeros(0, int)).any()


def test_what_is_no_direction_is_unknown():
    given = np.array([[0, 0, 3.0], [0, 0, 0], [np.nan, 1, 0], [np.inf, 0, 0], [1e-100, 0, 0]])
    np.testing.assert_allclose(unit_or_zero(given), [[0, 0, 1], [0, 0, 0], [0, 0, 0], [0, 0, 0], [1, 0, 0]])


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("told_by", ["walls", "sensors", "objects"])
def test_normals_point_out_of_the_matter(told_by, sign):
    points, normals, instance = room()
    sensors = np.array([[1.0, 2.0, 1.6], [3.0, 2.0, 1.5]]) if told_by == "sensors" else np.zeros((0, 3))
    rows = instance > 0 if told_by == "objects" else np.ones(len(points), bool)
    found, turned = outward(points[rows], sign * normals[rows], instance[rows], sensors)
    np.testing.assert_array_equal(found, normals[rows])
    assert turned == (sign < 0)


@pytest.mark.parametrize("sign", [1, -1])
def test_a_scan_keeps_what_its_file_states(tmp_path, sign):
    points, normals, instance = room()
    stated = dict(zip(("nx", "ny", "nz"), (sign * normals).T.astype("f4"), strict=True))
    np.savez(tmp_path / "a.npz", points=points, instance=instance, normals=2.0 * sign * normals)
    ply = write_ply(tmp_path / "a.ply", points, instance=instance.astype("i4"), **stated)
    for path in (ply, tmp_path / "a.npz"):
        scan = read_scan(path)
        np.testing.assert_allclose(scan.instances[0].normals, normals[instance == 3], atol=1e-6)
        assert any(TURNED_WARNING in w for w in scan.warnings) == (sign < 0)


def test_a_mesh_of_a_scan_gives_normals_and_a_cloud_none(tmp_path):
    points, faces = np.asarray(BALL.vertices), np.asarray(BALL.faces)
    ids = np.ones(len(points), "i4")
    mesh = read_scan(write_ply(tmp_path / "mesh.ply", points, faces, instance=ids))
    np.testing.assert_allclose(mesh.instances[0].normals, points / 0.4, atol=0.02)
    assert read_scan(write_ply(tmp_path / "cloud.ply", points, instance=ids)).instances[0].normals is None
    damaged = write_ply(tmp_path / "damaged.ply", points, faces + 1, instance=ids)
    assert read_scan(damaged).instances[0].normals is None


def test_normals_wound_at_random_are_not_known():
    points, normals, instance = room()
    signs = RNG.choice([-1, 1], len(points))[:, None]
    for sensors in (np.zeros((0, 3)), np.array([[2.0, 1.5, 1.6]])):
        assert outward(points, signs * normals, instance, sensors) == (None, False)


def test_npz_refuses_normals_of_another_shape(tmp_path):
    points, normals, instance = room()
    np.savez(tmp_path / "a.npz", points=points, instance=instance, normals=normals[:-1])
    with pytest.raises(ValueError, match=r"normals has shape \(1641, 3\); needed \(1642, 3\)"):
        read_scan(tmp_path / "a.npz")
