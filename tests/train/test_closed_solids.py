"""Solids from soups: closed, wound outward, where the soup is; what has no inside is refused with a reason."""

import numpy as np
import point_cloud_utils as pcu
import pytest
import trimesh

from train.furniture.closed_solids import SHELL, closed_parts, solidify, watertight


def soup(*parts: trimesh.Trimesh) -> tuple[np.ndarray, np.ndarray]:
    mesh = trimesh.util.concatenate(list(parts))
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def moved(mesh: trimesh.Trimesh, by: tuple[float, float, float]) -> trimesh.Trimesh:
    mesh.apply_translation(by)
    return mesh


def open_box(extents: tuple[float, float, float]) -> trimesh.Trimesh:
    """A box without its top: a soup with no inside of its own."""
    box = trimesh.creation.box(extents)
    box.update_faces(box.face_normals[:, 2] < 0.5)
    return box


def closed(vertices: np.ndarray, faces: np.ndarray) -> trimesh.Trimesh:
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume > 0
    return mesh


def test_overlapping_closed_parts_are_united_exactly():
    vertices, faces = soup(
        trimesh.creation.box((1, 1, 1)), moved(trimesh.creation.box((1, 1, 1)), (0.5, 0.3, 0.2))
    )
    solid = solidify(vertices, faces)
    assert solid.method == "united"
    assert closed(solid.vertices, solid.faces).volume == pytest.approx(2 - 0.5 * 0.7 * 0.8, abs=1e-4)


def test_parts_wound_inside_out_are_turned():
    a, b = trimesh.creation.box((1, 1, 1)), moved(trimesh.creation.box((1, 1, 1)), (3, 0, 0))
    b.invert()
    solid = solidify(*soup(a, b))
    assert closed(solid.vertices, solid.faces).volume == pytest.approx(2, abs=1e-4)
    whole = closed(*watertight(np.asarray(b.vertices), np.asarray(b.faces)))
    assert whole.volume == pytest.approx(1, abs=1e-4)


def test_frame_and_unit_are_the_callers():
    box = moved(trimesh.creation.box((100, 50, 20)), (1000, 0, 7))
    vertices, _ = watertight(np.asarray(box.vertices), np.asarray(box.faces))
    np.testing.assert_allclose([vertices.min(0), vertices.max(0)], box.bounds, atol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_an_open_soup_is_wrapped_just_outside_itself(seed: int):
    rng = np.random.default_rng(seed)
    vertices, faces = soup(open_box((0.9, 0.6, 0.5)), moved(open_box((0.2, 0.2, 0.3)), (0.1, 0, 0.1)))
    faces = rng.permuted(faces, axis=0)  # any order
    faces[::2] = faces[::2, ::-1]  # any winding
    solid = solidify(vertices, faces)
    assert solid.method == "wrapped"
    mesh = closed(solid.vertices, solid.faces)
    distance, _, _ = pcu.closest_points_on_mesh(
        np.ascontiguousarray(mesh.vertices), vertices, faces.astype(np.int32)
    )
    assert distance.max() < 2.5 * SHELL
    # A sheet keeps an inside, and the box stays open: its middle is outside.
    inside = pcu.triangle_soup_fast_winding_number(
        solid.vertices, solid.faces.astype(np.int32), np.array([[-0.3, 0.0, 0.0], [0.0, 0.0, -0.2499]])
    )
    np.testing.assert_allclose(inside, [0, 1], atol=0.1)


def test_triangles_without_area_and_duplicates_do_no_harm():
    vertices, faces = soup(open_box((0.9, 0.6, 0.5)))
    faces = np.concatenate([faces, faces, faces[:, [0, 0, 1]]])
    mesh = closed(*watertight(vertices, faces))
    assert np.isfinite(mesh.vertices).all()


@pytest.mark.parametrize(
    ("vertices", "faces", "reason"),
    [
        (np.zeros((0, 3)), np.zeros((0, 3), int), "no vertices"),
        (np.eye(3), np.zeros((0, 3), int), "0 faces"),
        (np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]]), "flat"),
        (np.ones((3, 3)), np.array([[0, 1, 2]]), "extent"),
        (np.eye(3), np.array([[0, 0, 1], [1, 1, 2]]), "no face with an area"),
    ],
)
def test_what_has_no_inside_is_refused(vertices: np.ndarray, faces: np.ndarray, reason: str):
    with pytest.raises(ValueError, match=reason):
        solidify(vertices, faces)


def test_closed_parts_are_none_for_an_open_soup():
    assert closed_parts(*soup(trimesh.creation.box((1, 1, 1)), moved(open_box((1, 1, 1)), (3, 0, 0)))) is None
    parts = closed_parts(*soup(trimesh.creation.box((1, 1, 1)), trimesh.creation.icosphere(2)))
    assert parts is not None
    assert len(parts) == 2
