"""Replica and S3DIS read back a known room: points of faces, files of instances, and the oddities of both."""

import json

import numpy as np
import pytest
from dataset_writers.ply_file import vertex_columns, write_ply
from dataset_writers.replica import write_replica
from dataset_writers.s3dis import s3dis_lines, write_s3dis

from more2_jax.scans.files.ply_face_mesh import read_ply_mesh
from more2_jax.scans.read_scan import read_scan

RNG = np.random.default_rng(5)


def grid(side=21):
    """A square sheet of quads: vertices (side², 3), faces ((side - 1)², 4)."""
    x, y = np.meshgrid(np.arange(side) / 10, np.arange(side) / 10, indexing="ij")
    points = np.stack([x.ravel(), y.ravel(), np.sin(3 * x.ravel())], axis=-1).astype("f4").astype(np.float64)
    start = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).ravel()
    return points, np.stack([start, start + side, start + side + 1, start + 1], axis=-1)


POINTS, QUADS = grid()
OBJECT = np.repeat([3, 8, 5, 0], 100)  # a strip of 5 × 20 quads each; 0 is in no list
CLASSES = {3: "chair", 8: "wall", 5: "sofa", 12: "lamp"}  # 12 has no faces
TRIANGLES = np.concatenate([QUADS[:, [0, 1, 2]], QUADS[:, [0, 2, 3]]])
SHAPES = {
    "quads": (QUADS.tolist(), OBJECT),
    "triangles": (TRIANGLES.tolist(), np.tile(OBJECT, 2)),
    "mixed": (QUADS[:200].tolist() + TRIANGLES[200:400].tolist() + TRIANGLES[600:].tolist(), None),
}
SHAPES["mixed"] = (SHAPES["mixed"][0], np.concatenate([OBJECT[:200], OBJECT[200:], OBJECT[200:]]))


def vertices_of(faces, objects, wanted):
    return sorted({v for corners, o in zip(faces, objects, strict=True) if o == wanted for v in corners})


@pytest.mark.parametrize("shape", SHAPES)
def test_replica_points_are_the_vertices_of_an_objects_faces(tmp_path, shape):
    faces, objects = SHAPES[shape]
    scene = write_replica(tmp_path / "office_0", POINTS, faces, objects, CLASSES)
    for path in (scene, scene / "habitat", scene / "habitat" / "mesh_semantic.ply"):
        scan = read_scan(path)
        assert {i.id: i.label for i in scan.instances} == {3: "chair", 5: "sofa"}
        for instance in scan.instances:
            mine = vertices_of(faces, objects, instance.id)
            np.testing.assert_array_equal(instance.points, POINTS[mine])
            np.testing.assert_array_equal(instance.colors[:, 0], np.array(mine) % 256)
        assert {s.what for s in scan.skipped} == {"instance 8 (wall)", "instance 12 (lamp)"}


def test_replica_object_zero_is_no_background_where_it_is_an_object(tmp_path):
    scan = read_scan(write_replica(tmp_path / "room_0", POINTS, QUADS, OBJECT, {0: "bed", 3: "chair"}))
    assert {i.id: i.label for i in scan.instances} == {1: "bed", 4: "chair"}
    np.testing.assert_array_equal(scan.instances[0].points, POINTS[vertices_of(QUADS, OBJECT, 0)])
    assert "from 0" in scan.warnings[0]


def test_replica_without_what_it_needs_is_one_line(tmp_path):
    scene = write_replica(tmp_path / "room_0", POINTS, QUADS, OBJECT, CLASSES)
    mesh, classes = scene / "habitat" / "mesh_semantic.ply", scene / "habitat" / "info_semantic.json"
    content = json.loads(classes.read_text())
    classes.write_text(json.dumps({"objects": [{"id": "x", "class_name": "a"}]}))
    with pytest.raises(ValueError, match=r"objects\[0\]\.id: got 'x'"):
        read_scan(scene)
    classes.write_text(json.dumps({"objects": [{"id": 1}]}))
    with pytest.raises(ValueError, match="no class_name"):
        read_scan(scene)
    classes.unlink()
    with pytest.raises(ValueError, match=r"info_semantic\.json: no such file"):
        read_scan(scene)
    classes.write_text(json.dumps(content))
    mesh.write_bytes(mesh.read_bytes()[:-7])
    with pytest.raises(ValueError, match="truncated or damaged PLY"):
        read_scan(scene)
    write_ply(mesh, vertex_columns(POINTS), QUADS)
    with pytest.raises(ValueError, match="faces have no whole number object_id"):
        read_scan(scene)
    write_ply(mesh, vertex_columns(POINTS))
    with pytest.raises(ValueError, match="no 'face' element"):
        read_scan(scene)


@pytest.mark.parametrize("corner", [-1, len(POINTS)])
def test_a_corner_that_is_no_vertex_is_refused(tmp_path, corner):
    write_ply(tmp_path / "a.ply", vertex_columns(POINTS), [[0, 1, corner]])
    with pytest.raises(ValueError, match="corner outside the 441 vertices"):
        read_ply_mesh(tmp_path / "a.ply")


def test_faces_of_no_corners_read(tmp_path):
    mesh = read_ply_mesh(write_ply(tmp_path / "a.ply", vertex_columns(POINTS), [[], [0, 1, 2], []]))
    np.testing.assert_array_equal(mesh.corners, [0, 1, 2])
    np.testing.assert_array_equal(mesh.face, [1, 1, 1])


def test_what_was_read_does_not_change_with_the_file(tmp_path):
    objects = OBJECT.astype("u2")
    file = write_ply(tmp_path / "a.ply", vertex_columns(POINTS), QUADS, face_columns={"object_id": objects})
    mesh = read_ply_mesh(file)
    size = file.stat().st_size
    with file.open("r+b") as stream:
        stream.seek(size // 4)
        stream.write(b"\xff" * (size - size // 4))
    np.testing.assert_array_equal(mesh.cloud.points, POINTS)
    np.testing.assert_array_equal(mesh.corners, QUADS.ravel())
    np.testing.assert_array_equal(mesh.face_properties["object_id"], OBJECT)


# --- S3DIS ---------------------------------------------------------------------------------------------------


def cloud(count):
    return RNG.uniform(-1, 1, (count, 3)).round(3), RNG.integers(0, 256, (count, 3))


ROOM = {name: cloud(n) for name, n in [("chair_10", 90), ("chair_2", 80), ("wall_1", 70), ("table_1", 100)]}


def test_s3dis_numbers_the_movable_files_by_class_and_number(tmp_path):
    room = write_s3dis(tmp_path / "Area_1" / "office_3", ROOM)
    (room / "Annotations" / "notes.txt").write_text("by hand")
    for path in (room, room / "Annotations"):
        scan = read_scan(path)
        assert [(i.id, i.label) for i in scan.instances] == [(1, "chair"), (2, "chair"), (3, "table")]
        for instance, name in zip(scan.instances, ("chair_2", "chair_10", "table_1"), strict=True):
            np.testing.assert_array_equal(instance.points, ROOM[name][0])
            np.testing.assert_array_equal(instance.colors, ROOM[name][1])
        np.testing.assert_array_equal(scan.background, ROOM["wall_1"][0])
        assert {s.what for s in scan.skipped} == {"wall_1.txt", "notes.txt"}
        assert scan.warnings == ()


def damage_line(room, number, text):
    file = room / "Annotations" / "chair_2.txt"
    lines = file.read_text().splitlines()
    lines[number - 1] = text
    file.write_bytes("\n".join(lines).encode("latin-1"))


@pytest.mark.parametrize(
    "text", ["1.0 2.0 3.0 185\x10187 4 5", "1 2 3 4 5", "1 2 3 4 5 6 7", "\xff", "chair"]
)
def test_a_damaged_line_is_left_out_and_named(tmp_path, text):
    room = write_s3dis(tmp_path / "hallway_6", ROOM)
    damage_line(room, 33, text)
    scan = read_scan(room)
    np.testing.assert_array_equal(scan.instances[0].points, np.delete(ROOM["chair_2"][0], 32, axis=0))
    assert scan.warnings == ("chair_2.txt: 1 damaged lines left out, the first is line 33",)


def test_many_damaged_lines_are_an_error(tmp_path):
    room = write_s3dis(tmp_path / "hallway_6", ROOM)
    for number in range(20, 31):
        damage_line(room, number, "?")
    with pytest.raises(ValueError, match=r"chair_2\.txt: line 20 and 10 more are not x y z r g b"):
        read_scan(room)


def test_an_empty_object_is_reported(tmp_path):
    room = write_s3dis(tmp_path / "hallway_6", ROOM)
    (room / "Annotations" / "sofa_1.txt").write_text("\n")
    (room / "Annotations" / "board_1.txt").write_text("no numbers")
    with pytest.raises(ValueError, match=r"board_1\.txt: line 1 is not x y z r g b"):
        read_scan(room)
    (room / "Annotations" / "board_1.txt").write_text(s3dis_lines(*cloud(64)))
    scan = read_scan(room)
    assert [i.label for i in scan.instances] == ["board", "chair", "chair", "table"]
    assert "sofa_1.txt" in {s.what for s in scan.skipped}
