"""Meshes of apps and modelers: points on the faces, an object a named mesh, glTF turned up; damage is one line."""

from pathlib import Path

import numpy as np
import pytest
from dataset_writers.meshes import write_glb, write_obj

from more2_jax.scans.formats import mesh_scene
from more2_jax.scans.labeled_cloud import ReadOptions
from more2_jax.scans.large_instances import MOST_POINTS
from more2_jax.scans.read_scan import read_scan

# Of glTF y is up: the table's top is 0.7 m above the floor.
TABLE = ((1.0, 0.35, 2.0), (1.2, 0.7, 0.6))
SHELF = ((-2.0, 1.0, 0.5), (0.8, 2.0, 0.3))
FLOOR = ((0.0, -0.05, 0.0), (6.0, 0.1, 5.0))
BOXES = {"table": TABLE, "floor": FLOOR, "book shelf": SHELF}
WRITERS = {"glb": write_glb, "obj": write_obj}
TO_Z = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # (x, y, z) → (x, −z, y)


def scan_of(tmp_path: Path, suffix: str, boxes=BOXES, **options):
    return read_scan(WRITERS[suffix](tmp_path / f"room.{suffix}", boxes), **options)


def off_box(points: np.ndarray, middle, edges) -> np.ndarray:
    """Distances of points to the surface of a box whose edges are along the axes."""
    q = np.abs(points - middle) - 0.5 * np.array(edges)
    return np.abs(np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(axis=1), 0))


@pytest.mark.parametrize("suffix", WRITERS)
def test_named_meshes_are_objects_where_they_stand(tmp_path, suffix):
    scan = scan_of(tmp_path, suffix, up="z" if suffix == "glb" else "y")
    assert [(i.id, i.label) for i in scan.instances] == [(1, "book shelf"), (3, "table")]
    for i, (middle, edges) in zip(scan.instances, (SHELF, TABLE), strict=True):
        own = i.points @ TO_Z  # back to y up
        assert off_box(own, middle, edges).max() < 1e-6
        np.testing.assert_allclose(np.ptp(own, axis=0), edges, atol=0.02)  # all of it
        assert 1_000 < len(i.points) <= MOST_POINTS
    assert [s.what for s in scan.skipped] == ["instance 2 (floor)"]
    assert len(scan.background) > 1_000
    assert scan.warnings == (mesh_scene.AS_OBJECTS,)


def test_normals_point_out_of_the_boxes(tmp_path):
    boxes = {"table": TABLE, "shelf": SHELF}
    for i in scan_of(tmp_path, "glb", boxes).instances:
        assert i.normals is not None
        np.testing.assert_allclose(np.linalg.norm(i.normals, axis=1), 1, atol=1e-6)
        middle = 0.5 * (i.points.min(axis=0) + i.points.max(axis=0))
        assert (np.einsum("ni,ni->n", i.normals, i.points - middle) > 0).all()


@pytest.mark.parametrize("suffix", WRITERS)
def test_the_same_points_every_time_whatever_the_order_in_the_file(tmp_path, suffix):
    first, again = (scan_of(tmp_path, suffix) for _ in range(2))
    other = scan_of(tmp_path, suffix, dict(reversed(BOXES.items())))
    for a, b, c in zip(first.instances, again.instances, other.instances, strict=True):
        np.testing.assert_array_equal(a.points, b.points)
        np.testing.assert_array_equal(a.points, c.points)


@pytest.mark.parametrize("suffix", WRITERS)
def test_one_mesh_has_no_masks_and_may_be_cut(tmp_path, suffix):
    with pytest.raises(ValueError, match="no instance masks"):
        scan_of(tmp_path, suffix, {"room": TABLE})
    path = WRITERS[suffix](tmp_path / f"room.{suffix}", BOXES)
    cloud = mesh_scene.read(path, ReadOptions(masks_needed=False))  # as with --segment
    assert cloud.instance is None
    assert cloud.warnings == ()
    assert len(cloud.points) > 3_000


def test_up_is_y_of_gltf_whether_it_is_said_or_not(tmp_path):
    silent, said = (scan_of(tmp_path, "glb", up=up) for up in ("z", "y"))
    for a, b in zip(silent.instances, said.instances, strict=True):
        np.testing.assert_allclose(a.points, b.points, atol=1e-12)


@pytest.mark.parametrize("suffix", WRITERS)
def test_masks_of_vertices_are_not_laid_on_points_drawn_anew(tmp_path, suffix):
    np.savez(tmp_path / "masks.npz", objectId=np.ones(24, int))
    with pytest.raises(ValueError, match="masks speak of a file's points"):
        scan_of(tmp_path, suffix, masks=tmp_path / "masks.npz")


def test_points_lie_evenly_over_faces_of_any_size(tmp_path):
    cloud = mesh_scene.read(write_glb(tmp_path / "a.glb", {"a": TABLE}), ReadOptions())
    on_top = np.isclose(cloud.points[:, 2], 0.7)
    area = 2 * (1.2 * 0.7 + 1.2 * 0.6 + 0.7 * 0.6)
    assert abs(on_top.mean() - 1.2 * 0.6 / area) < 0.01


def test_a_mesh_has_as_many_points_as_vertices_at_least(tmp_path):
    side = np.arange(300)
    vertices = [f"v {x} {y} 0" for x in side for y in side]
    corner = [x * 300 + y + 1 for x in side[:-1] for y in side[:-1]]
    faces = [f"f {c} {c + 300} {c + 301} {c + 1}" for c in corner]
    (tmp_path / "floor.obj").write_text("\n".join(["o floor", *vertices, *faces]))
    assert len(mesh_scene.read(tmp_path / "floor.obj", ReadOptions(masks_needed=False)).points) == 90_000


@pytest.mark.parametrize("suffix", WRITERS)
def test_damage_is_one_line(tmp_path, suffix):
    path = WRITERS[suffix](tmp_path / f"room.{suffix}", BOXES)
    whole = path.read_bytes()
    for content in (b"", whole[:40], b"\xff" * 200):
        path.write_bytes(content)
        with pytest.raises(ValueError, match="room") as refused:
            read_scan(path)
        assert "\n" not in str(refused.value)


def test_points_without_faces_are_no_mesh(tmp_path):
    (tmp_path / "room.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\n")
    with pytest.raises(
        ValueError, match=r"room.obj: (no faces with an area; needed a mesh|not a readable mesh)"
    ):
        read_scan(tmp_path / "room.obj")


def test_numbered_names_are_told_by_their_words(tmp_path):
    boxes = {"Wall_1": FLOOR, "Wall.002": FLOOR, "Floor0": FLOOR, "chair-12": SHELF, "7": TABLE}
    scan = scan_of(tmp_path, "glb", boxes)
    assert sorted(i.label for i in scan.instances) == ["7", "chair"]
    assert sorted(s.what for s in scan.skipped) == [
        "instance 2 (Floor)",
        "instance 3 (Wall)",
        "instance 4 (Wall)",
    ]
