"""3RScan: the annotated mesh reads back, and depth frames land where the rays hit known walls."""

import numpy as np
import pytest
from dataset_writers.threerscan import (
    info_text,
    pgm_bytes,
    sequence_files,
    write_annotated_mesh,
    write_semseg,
    write_sequence,
)
from scipy.spatial.transform import Rotation

from more2_jax.scans.files.rgbd_sequence import Intrinsics, back_project, read_info, read_pgm, read_pose
from more2_jax.scans.formats import threerscan
from more2_jax.scans.read_scan import read_scan

RNG = np.random.default_rng(8)
POINTS = RNG.uniform(-2, 2, (900, 3)).round(4)
IDS = np.repeat([0, 35, 4, 1], [200, 300, 250, 150])
LABELS = {35: "chair", 4: "couch table", 1: "floor", 77: "pillow"}  # 77 has no vertices
CAMERA = {"fx": 90.5, "fy": 88.25, "cx": 31.5, "cy": 23.75}


def write_scan(folder, strings=False):
    write_annotated_mesh(folder, POINTS, IDS, RNG.integers(0, 256, (900, 3)))
    write_semseg(folder, LABELS, strings=strings)
    return folder


@pytest.mark.parametrize("strings", [False, True])
@pytest.mark.parametrize("by", ["folder", "file"])
def test_vertices_keep_their_objects(tmp_path, strings, by):
    folder = write_scan(tmp_path / "531cff08-0021-28f6-8e08-ba2eeb945e09", strings)
    scan = read_scan(folder / "labels.instances.annotated.v2.ply" if by == "file" else folder)
    assert {i.id: i.label for i in scan.instances} == {4: "couch table", 35: "chair"}
    for instance in scan.instances:
        np.testing.assert_allclose(instance.points, POINTS[instance.id == IDS], atol=1e-6)
        assert instance.colors is None  # they paint the instances
    np.testing.assert_allclose(scan.background, POINTS[np.isin(IDS, [0, 1])], atol=1e-6)
    assert {s.what for s in scan.skipped} == {"instance 1 (floor)", "instance 77 (pillow)"}
    assert scan.warnings == ()


def test_without_labels_all_is_kept_and_said(tmp_path):
    write_annotated_mesh(tmp_path, POINTS, IDS)
    scan = read_scan(tmp_path)
    assert [i.id for i in scan.instances] == [1, 4, 35]
    assert any("semseg.v2.json" in warning for warning in scan.warnings)


def test_a_hidden_test_scan_has_points_and_no_masks(tmp_path):
    vertices = "".join(f"v {x} {y} {z}\nvt 0 0\n" for x, y, z in POINTS[:5].tolist())
    (tmp_path / "mesh.refined.v2.obj").write_text(f"mtllib a.mtl\n{vertices}vn 0 0 1\nf 1/1 2/2 3/3\n")
    np.testing.assert_array_equal(threerscan.read_obj_vertices(tmp_path / "mesh.refined.v2.obj"), POINTS[:5])
    with pytest.raises(ValueError, match="no instance masks"):
        read_scan(tmp_path)


# --- depth ---------------------------------------------------------------------------------------------------


def look(eye, target):
    """T_world_camera of a camera at `eye` that sees `target` in its middle: z forward, y down."""
    z = np.subtract(target, eye) / np.linalg.norm(np.subtract(target, eye))
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = np.stack([x, np.cross(z, x), z], axis=-1)
    T[:3, 3] = eye
    return T


def depth_of_plane(T_world_camera, normal, offset, height=48, width=64):
    """Depth in mm of the plane normal · p = offset, pixel by pixel: the ray is cast by hand."""
    depth = np.zeros((height, width), np.int64)
    for row in range(height):
        for column in range(width):
            ray = np.array([(column - CAMERA["cx"]) / CAMERA["fx"], (row - CAMERA["cy"]) / CAMERA["fy"], 1.0])
            along = normal @ (T_world_camera[:3, :3] @ ray)
            z = (offset - normal @ T_world_camera[:3, 3]) / along if along else -1.0
            depth[row, column] = round(z * 1000) if 0 < z < 8 else 0
    return depth


PLANE = (np.array([0.6, 0.0, 0.8]), 1.5)
EYES = ([0.2, 0.1, 0.3], [-0.5, 0.9, -0.2], [0.0, -0.4, 0.1])


def plane_frames():
    poses = [look(eye, PLANE[0] * 1.5) for eye in EYES]
    return [(depth_of_plane(T, *PLANE), T) for T in poses]


@pytest.mark.parametrize("zipped", [True, False])
def test_back_projected_frames_lie_on_the_wall_they_saw(tmp_path, zipped):
    write_sequence(tmp_path, sequence_files(plane_frames(), CAMERA), zipped=zipped)
    points, sensors, skipped = threerscan.depth_points(threerscan.open_sequence(tmp_path))
    assert len(points) == 3 * 48 * 64 and skipped == ()
    np.testing.assert_allclose(sensors, EYES, atol=1e-6)
    # half a millimeter of rounding along rays up to 1.2 times as long as their depth
    assert np.abs(points @ PLANE[0] - PLANE[1]).max() < 1e-3


def test_one_pixel_by_hand():
    depth = np.zeros((3, 4), np.uint16)
    depth[2, 1] = 2500
    camera = Intrinsics(fx=2.0, fy=4.0, cx=0.5, cy=1.0, depth_shift=1000.0)
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    T[:3, 3] = [10.0, 20.0, 30.0]
    # camera: x = (1 - 0.5) / 2 · 2.5 = 0.625, y = (2 - 1) / 4 · 2.5 = 0.625; a quarter turn takes x to y
    np.testing.assert_allclose(back_project(depth, camera, T, 1), [[10 - 0.625, 20 + 0.625, 32.5]])


def test_depth_points_take_the_object_of_the_nearest_vertex(tmp_path):
    frames = plane_frames()
    write_sequence(tmp_path, sequence_files(frames, CAMERA))
    seen, eyes, _ = threerscan.depth_points(threerscan.open_sequence(tmp_path))
    right = seen[seen[:, 1] > 0.2]
    vertices = np.concatenate([right[::3], seen[seen[:, 1] < -0.2][::3]])
    ids = np.repeat([35, 1], [len(right[::3]), len(vertices) - len(right[::3])])
    write_annotated_mesh(tmp_path, vertices, ids)
    write_semseg(tmp_path, LABELS)
    scan = read_scan(tmp_path, depth_frames=True)
    (chair,) = scan.instances
    np.testing.assert_array_equal(scan.sensors, eyes)
    assert chair.id == 35 and chair.label == "chair" and chair.colors is None
    # by hand, in chunks: the nearest vertex of every point
    away = np.concatenate(
        [np.linalg.norm(p[:, None] - vertices[None], axis=-1) for p in np.array_split(seen, 60)]
    )
    nearest = away.argmin(axis=1)
    wanted = (ids[nearest] == 35) & (away.min(axis=1) < threerscan.NEAREST_M)
    assert 0 < wanted.sum() < len(seen)
    np.testing.assert_allclose(chair.points, seen[wanted], atol=1e-6)
    assert len(scan.background) == len(seen) - wanted.sum()


def test_far_from_every_vertex_is_background():
    vertices = np.array([[0.0, 0.0, 0.0]])
    points = np.array([[0.0, 0.0, 0.049], [0.0, 0.0, 0.051]])
    np.testing.assert_array_equal(threerscan.nearest_instance(vertices, np.array([7]), points), [7, 0])
    np.testing.assert_array_equal(threerscan.nearest_instance(vertices[:0], np.zeros(0, int), points), [0, 0])


def test_frames_without_tracking_are_left_out_and_counted(tmp_path):
    depth = np.full((48, 64), 1000)
    lost = "\n".join(["-nan -nan -nan -nan"] * 4)
    scaled = 2 * np.eye(4)
    frames = [(depth, None), (depth, lost), (depth, np.eye(4)), (depth, "1 0 0"), (depth, scaled)]
    write_sequence(tmp_path, sequence_files(frames, CAMERA))
    points, _, (skipped,) = threerscan.depth_points(threerscan.open_sequence(tmp_path))
    assert len(points) == 48 * 64
    assert skipped.what == "4 of 5 depth frames"


def test_many_frames_are_thinned_evenly_and_always_alike(tmp_path, monkeypatch):
    monkeypatch.setattr(threerscan, "MOST_FRAMES", 4)
    monkeypatch.setattr(threerscan, "MOST_POINTS", 4 * 12 * 16)
    depth = np.full((48, 64), 1000)
    poses = [np.eye(4) for _ in range(10)]
    for i, T in enumerate(poses):
        T[2, 3] = i
    write_sequence(tmp_path, sequence_files([(depth, T) for T in poses], CAMERA))
    points, sensors, _ = threerscan.depth_points(threerscan.open_sequence(tmp_path))
    assert len(points) == 4 * 12 * 16
    np.testing.assert_allclose(sensors[:, 2], [0, 3, 6, 9])
    np.testing.assert_allclose(np.unique(points[:, 2]), [1, 4, 7, 10])  # frames 0, 3, 6, 9, a meter ahead
    again, *_ = threerscan.depth_points(threerscan.open_sequence(tmp_path))
    np.testing.assert_array_equal(points, again)


def test_depth_frames_are_for_3rscan_alone(tmp_path):
    (tmp_path / "a.npz").write_bytes(b"")
    with pytest.raises(ValueError, match="depth frames asked for"):
        read_scan(tmp_path / "a.npz", depth_frames=True)


# --- damage --------------------------------------------------------------------------------------------------


def test_pgm_is_big_endian_with_comments():
    image = np.array([[1, 256], [65535, 0], [7, 8]])
    np.testing.assert_array_equal(read_pgm(pgm_bytes(image), ""), image)
    commented = b"P5 # made by hand\n# 9 9\n2 3\n65535\n" + image.astype(">u2").tobytes()
    np.testing.assert_array_equal(read_pgm(commented, ""), image)
    np.testing.assert_array_equal(read_pgm(b"P5\n2 1\n255\n\x03\x04", ""), [[3, 4]])


@pytest.mark.parametrize(
    "content", [b"", b"P6\n1 1\n255\n000", b"P5\n99999 99999\n65535\n00", b"P5\n-1 2\n255\n"]
)
def test_a_damaged_pgm_is_one_line(content):
    with pytest.raises(ValueError, match=r"PGM|complete file") as error:
        read_pgm(content, "a.pgm")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("filler", [b" ", b"\n", b" #\n", b"#", b"1 "])
def test_a_header_without_end_is_no_hang(filler):
    with pytest.raises(ValueError, match="PGM"):
        read_pgm(b"P5" + filler * 2000, "a.pgm")


def test_info_without_the_depth_camera_is_refused():
    text = info_text(64, 48, frames=1, **CAMERA)
    assert read_info(text.encode(), "").cy == CAMERA["cy"]
    for change, message in (
        (("m_depthShift", "m_other"), "no line m_depthShift"),
        (("90.5 0", "0"), "15 numbers"),
        (("90.5", "nan"), "finite"),
        (("90.5", "-90.5"), "needed > 0"),
        (("90.5", "wide"), "not numbers"),
    ):
        with pytest.raises(ValueError, match=message):
            read_info(text.replace(*change).encode(), "_info.txt")


def test_a_pose_that_mirrors_is_no_pose():
    mirror = np.diag([1.0, 1.0, -1.0, 1.0])
    assert read_pose(" ".join(map(str, mirror.ravel())).encode()) is None
    assert read_pose(b"\xff\xfe") is None


@pytest.mark.parametrize("cut", [10, 200, -30])
def test_a_cut_archive_is_one_line(tmp_path, cut):
    write_scan(tmp_path)
    write_sequence(tmp_path, sequence_files(plane_frames()[:1], CAMERA))
    archive = tmp_path / "sequence.zip"
    archive.write_bytes(archive.read_bytes()[:cut])
    with pytest.raises(ValueError, match=r"sequence\.zip") as error:
        read_scan(tmp_path, depth_frames=True)
    assert "\n" not in str(error.value)


def test_what_is_missing_is_named(tmp_path):
    write_scan(tmp_path)
    with pytest.raises(ValueError, match=r"no sequence\.zip"):
        read_scan(tmp_path, depth_frames=True)
    write_sequence(tmp_path, {"_info.txt": info_text(64, 48, frames=0, **CAMERA).encode()}, zipped=False)
    with pytest.raises(ValueError, match="needed depth frames"):
        read_scan(tmp_path, depth_frames=True)


def test_a_bomb_is_not_unpacked(tmp_path):
    files = sequence_files(plane_frames()[:1], CAMERA) | {"frame-000000.depth.pgm": b"\0" * 50_000_000}
    write_sequence(tmp_path, files)
    write_scan(tmp_path)
    with pytest.raises(ValueError, match="more than"):
        read_scan(tmp_path, depth_frames=True)
