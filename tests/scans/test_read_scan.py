"""Scans read back what was written, in meters; anything wrong with a file is one clear line."""

from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from more2_jax.geometry.up_axis import R_UP
from more2_jax.scans.read_scan import read_scan

RNG = np.random.default_rng(0)
POINTS = RNG.normal(size=(500, 3))
IDS = np.repeat([0, 3, 7, -1], [100, 200, 150, 50])


def write_ply(
    path: Path, points=POINTS, *, text=False, order="<", kind="f8", comments=(), **properties: np.ndarray
) -> Path:
    columns = {axis: points[:, i].astype(kind) for i, axis in enumerate("xyz")} | properties
    table = np.empty(len(points), [(name, column.dtype) for name, column in columns.items()])
    for name, column in columns.items():
        table[name] = column
    PlyData([PlyElement.describe(table, "vertex")], text=text, byte_order="=" if text else order).write(
        str(path)
    )
    return path


def two_instances(path: Path, **changes) -> Path:
    return write_ply(path, **({"instance": IDS.astype(np.int32)} | changes))


@pytest.mark.parametrize("kind", ["f4", "f8"])
@pytest.mark.parametrize(("text", "order"), [(True, "<"), (False, "<"), (False, ">")])
def test_every_ply_encoding_reads_back(tmp_path, kind, text, order):
    scan = read_scan(two_instances(tmp_path / "room.ply", text=text, order=order, kind=kind))
    assert scan.name == "room"
    assert [i.id for i in scan.instances] == [3, 7]
    for instance in scan.instances:
        expected = POINTS[instance.id == IDS]
        assert instance.points.dtype == np.float64
        np.testing.assert_allclose(instance.points, expected, rtol=1e-6 if kind == "f4" else 1e-12)
    np.testing.assert_allclose(scan.background, POINTS[IDS <= 0], rtol=1e-6)
    assert scan.warnings == () and scan.skipped == ()


def test_binary_double_keeps_a_far_frame_to_the_bit(tmp_path):
    far = POINTS + [4e5, 5e6, 100.0]
    scan = read_scan(two_instances(tmp_path / "far.ply", points=far))
    np.testing.assert_array_equal(scan.instances[0].points, far[IDS == 3])


@pytest.mark.parametrize("name", ["instance", "instance_id", "objectId", "object_id", "label"])
def test_instance_property_is_found_by_name(tmp_path, name):
    scan = read_scan(write_ply(tmp_path / "a.ply", **{name: IDS.astype(np.int32)}))
    assert [i.id for i in scan.instances] == [3, 7]
    assert [i.label for i in scan.instances] == [None, None]


def test_instance_properties_are_tried_in_order_and_overridden(tmp_path):
    other = np.where(IDS > 0, 9, 0).astype(np.uint16)
    path = write_ply(tmp_path / "a.ply", label=other, object_id=IDS.astype(np.int32), segment=other)
    assert [i.id for i in read_scan(path).instances] == [3, 7]
    assert [i.id for i in read_scan(path, instance_property="segment").instances] == [9]


def test_label_beside_the_instance_is_the_label(tmp_path):
    classes = np.where(IDS == 3, 41, 5).astype(np.int32)
    classes[100:120] = 5  # a minority of instance 3 says otherwise
    scan = read_scan(two_instances(tmp_path / "a.ply", label=classes))
    assert [i.label for i in scan.instances] == ["41", "5"]


def test_ply_colors(tmp_path):
    rgb = RNG.integers(0, 256, (500, 3)).astype(np.uint8)
    colors = {c: rgb[:, i] for i, c in enumerate(("red", "green", "blue"))}
    scan = read_scan(two_instances(tmp_path / "a.ply", **colors))
    np.testing.assert_array_equal(scan.instances[1].colors, rgb[IDS == 7])


def test_other_elements_and_list_properties_are_passed_over(tmp_path):
    rows = "\n".join(f"{x} {y} {z} 2 3 0 1 2" for x, y, z in POINTS[:80])
    (tmp_path / "mesh.ply").write_text(
        "ply\nformat ascii 1.0\ncomment a mesh\nelement vertex 80\nproperty float x\nproperty float y\n"
        "property float z\nproperty int instance\nproperty list uchar int rings\n"
        f"element face 1\nproperty list uchar int vertex_indices\nend_header\n{rows}\n3 0 1 2\n"
    )
    scan = read_scan(tmp_path / "mesh.ply")
    np.testing.assert_allclose(scan.instances[0].points, POINTS[:80], rtol=1e-6)


def test_npz_reads_back(tmp_path):
    rgb = RNG.random((500, 3))
    names = np.where(IDS == 3, "chair", "table")
    names[100:130] = "floor"
    np.savez(tmp_path / "s.npz", points=POINTS.astype(np.float32), instance=IDS, label=names, color=rgb)
    scan = read_scan(tmp_path / "s.npz")
    assert [(i.id, i.label) for i in scan.instances] == [(3, "chair"), (7, "table")]
    np.testing.assert_allclose(scan.instances[1].points, POINTS[IDS == 7], rtol=1e-6)
    np.testing.assert_allclose(scan.instances[1].colors / 255.0, rgb[IDS == 7], atol=1 / 255)


@pytest.mark.parametrize("code", [0x110000, 0xFFFFFFFF, 0xD800, 0xDFFF])
@pytest.mark.parametrize("order", "<>")
def test_npz_labels_that_are_no_text_are_refused(tmp_path, code, order):
    codes = np.full(len(POINTS), ord("a"), f"{order}u4")
    np.savez(tmp_path / "s.npz", points=POINTS, instance=IDS, label=codes.view(f"{order}U1"))
    assert {i.label for i in read_scan(tmp_path / "s.npz").instances} == {"a"}
    codes[5] = code
    np.savez(tmp_path / "s.npz", points=POINTS, instance=IDS, label=codes.view(f"{order}U1"))
    assert "label holds what is no text" in fails(tmp_path / "s.npz")


def test_npz_instance_property_names_another_array(tmp_path):
    np.savez(tmp_path / "s.npz", points=POINTS, segments=IDS)
    assert [i.id for i in read_scan(tmp_path / "s.npz", instance_property="segments").instances] == [3, 7]


@pytest.mark.parametrize(
    ("names", "ids"),
    [
        (["chair_4", "table_9"], [4, 9]),
        (["chair", "table"], [1, 2]),
        (["chair_1", "table_1"], [1, 2]),
        (["a0", "b1"], [1, 2]),
    ],
)
def test_folder_of_plys(tmp_path, names, ids):
    for i, name in enumerate(names):
        write_ply(tmp_path / f"{name}.ply", POINTS[100 * i : 100 * i + 100])
    scan = read_scan(tmp_path)
    assert [(i.id, i.label) for i in scan.instances] == list(zip(ids, names, strict=True))
    np.testing.assert_array_equal(scan.instances[1].points, POINTS[100:200])
    assert scan.name == tmp_path.name


def test_small_instances_are_skipped_and_said(tmp_path):
    ids = np.r_[np.full(430, 1), np.full(63, 2), np.full(7, 5)]
    scan = read_scan(two_instances(tmp_path / "a.ply", instance=ids.astype(np.int32)))
    assert [i.id for i in scan.instances] == [1]
    assert [(s.what, s.reason) for s in scan.skipped] == [
        ("instance 2", "63 points; needed 64"),
        ("instance 5", "7 points; needed 64"),
    ]
    assert len(read_scan(tmp_path / "a.ply", min_points=7).instances) == 3


@pytest.mark.parametrize(("unit", "scale"), [("m", 1.0), ("cm", 100.0), ("mm", 1000.0)])
def test_units_scale_to_meters(tmp_path, unit, scale):
    path = two_instances(tmp_path / "a.ply", points=scale * POINTS / 4)
    scan = read_scan(path, unit=unit)
    np.testing.assert_allclose(scan.instances[0].points, POINTS[IDS == 3] / 4, rtol=1e-12)
    assert scan.warnings == ()
    if unit != "m":
        (warning,) = read_scan(path).warnings
        assert f"--unit {unit}" in warning


def test_meters_read_as_millimeters_warn(tmp_path):
    (warning,) = read_scan(two_instances(tmp_path / "a.ply"), unit="mm").warnings
    assert "--unit m" in warning and "--unit mm" not in warning


# --- bad input: one line each, saying what, got, needed -----------------------------------------------------


@pytest.mark.parametrize("up", ["x", "y", "z", "-x", "-y", "-z"])
def test_the_axis_that_is_up_in_the_file_is_z_in_the_scan(tmp_path, up):
    R = R_UP[up]
    axis = np.eye(3)["xyz".index(up[-1])] * (-1 if up[0] == "-" else 1)
    np.testing.assert_array_equal(R @ axis, [0, 0, 1])
    np.testing.assert_array_equal(R @ R.T, np.eye(3))
    assert np.linalg.det(R) == pytest.approx(1.0)
    normals, sensors = np.tile([0.0, 0.6, 0.8], (len(POINTS), 1)), [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]
    standing = {"points": POINTS, "normals": normals, "sensors": sensors}
    for name, turned in (("standing", np.eye(3)), ("lying", R.T)):
        rows = {k: np.asarray(v) @ turned.T for k, v in standing.items()}
        np.savetxt(tmp_path / f"{name}.sensors.txt", rows.pop("sensors"))
        np.savez(tmp_path / f"{name}.npz", instance=IDS, **rows)
    told = read_scan(tmp_path / "standing.npz", unit="cm")
    found = read_scan(tmp_path / "lying.npz", unit="cm", up=up)
    np.testing.assert_allclose(found.background, told.background, atol=1e-12)
    np.testing.assert_allclose(found.sensors, told.sensors, atol=1e-12)
    for a, b in zip(found.instances, told.instances, strict=True):
        np.testing.assert_allclose(a.points, b.points, atol=1e-12)
        np.testing.assert_allclose(a.normals, b.normals, atol=1e-12)
    assert "up 'w'; needed x, y, z, -x, -y, -z" in fails(tmp_path / "lying.npz", up="w")


def fails(path: Path, **kwargs) -> str:
    with pytest.raises(ValueError) as error:
        read_scan(path, **kwargs)
    message = str(error.value)
    assert "\n" not in message and message
    return message


def test_missing_file(tmp_path):
    assert "no such file" in fails(tmp_path / "nothing.ply")


def test_unknown_suffix_and_empty_folder(tmp_path):
    (tmp_path / "a.xyz").write_text("1 2 3")
    assert ".xyz" in fails(tmp_path / "a.xyz")
    (tmp_path / "empty").mkdir()
    assert "without .ply" in fails(tmp_path / "empty")


def test_unknown_unit(tmp_path):
    assert "'inch'" in fails(two_instances(tmp_path / "a.ply"), unit="inch")


@pytest.mark.parametrize("content", [b"", b"solid cube", b"\x89PNG\r\n", b"plywood\n"])
def test_not_a_ply(tmp_path, content):
    (tmp_path / "a.ply").write_bytes(content)
    assert "not a PLY" in fails(tmp_path / "a.ply")


@pytest.mark.parametrize("text", [True, False])
@pytest.mark.parametrize("share", [0.02, 0.3, 0.5, 0.99])
def test_truncated_ply(tmp_path, text, share):
    path = two_instances(tmp_path / "a.ply", text=text)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    assert "truncated" in fails(path)


def test_ply_without_vertices(tmp_path):
    header = "ply\nformat ascii 1.0\nelement face 0\nproperty int a\nend_header\n"
    (tmp_path / "a.ply").write_text(header)
    assert "vertex" in fails(tmp_path / "a.ply")


def test_ply_without_z(tmp_path):
    (tmp_path / "a.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nend_header\n1 2\n"
    )
    assert "needed z" in fails(tmp_path / "a.ply")


def test_no_instance_property_names_the_integers_there_are(tmp_path):
    path = write_ply(
        tmp_path / "a.ply",
        segment=IDS.astype(np.int32),
        category=IDS.astype(np.int16),
        quality=np.full(500, 0.5),
        red=np.zeros(500, np.uint8),
    )
    message = fails(path)
    assert "segment, category" in message and "red" not in message and "quality" not in message
    assert "no integer property" in fails(write_ply(tmp_path / "b.ply"))
    assert "quality" in fails(path, instance_property="quality")


def test_no_instances_left(tmp_path):
    path = two_instances(tmp_path / "a.ply", instance=np.minimum(IDS, 0).astype(np.int32))
    assert "background" in fails(path)
    assert "fewer than 1000 points" in fails(two_instances(tmp_path / "b.ply"), min_points=1000)
    empty = write_ply(tmp_path / "c.ply", POINTS[:0], instance=np.zeros(0, np.int32))
    assert "no points" in fails(empty)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_coordinates_must_be_finite(tmp_path, value):
    points = POINTS.copy()
    points[[3, 250, 251], [0, 1, 2]] = value
    assert "3 of 500" in fails(two_instances(tmp_path / "a.ply", points=points))


def test_npz_that_are_wrong(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, xyz=POINTS, instance=IDS)
    assert "xyz" in fails(path) and "needed points" in fails(path)
    np.savez(path, points=POINTS)
    assert "needed instance" in fails(path)
    for arrays in (
        {"points": POINTS[:, :2], "instance": IDS},
        {"points": POINTS.ravel(), "instance": IDS},
        {"points": np.float64(1), "instance": IDS},
        {"points": POINTS, "instance": IDS[:-1]},
        {"points": POINTS, "instance": IDS, "color": np.zeros((500, 4))},
        {"points": POINTS, "instance": IDS, "label": np.zeros(3, int)},
    ):
        np.savez(path, **arrays)
        assert "shape" in fails(path)
    for arrays in (
        {"points": POINTS.astype(str), "instance": IDS},
        {"points": POINTS, "instance": IDS.astype(float)},
        {"points": POINTS, "instance": IDS, "label": POINTS[:, 0]},
    ):
        np.savez(path, **arrays)
        assert "holds" in fails(path)


def test_npz_that_are_damaged(tmp_path):
    path = tmp_path / "a.npz"
    np.savez_compressed(path, points=POINTS, instance=IDS)
    whole = path.read_bytes()
    middle = len(whole) // 2
    for content in (b"", b"hello", whole[:middle], whole[: middle - 9] + b"\0" * 9 + whole[middle:]):
        path.write_bytes(content)
        assert "not a readable NPZ" in fails(path)
    with path.open("wb") as file:
        np.save(file, POINTS)
    assert "not a readable NPZ" in fails(path)
    np.savez(path, points=np.array([{}], object), instance=IDS)
    assert "not a readable NPZ" in fails(path)


@pytest.mark.parametrize(("far_m", "count"), [(0.0, 0), (1e4, 0), (1e5, 1)])
def test_32_bit_coordinates_far_from_the_origin_are_said(tmp_path, far_m, count):
    scan = read_scan(two_instances(tmp_path / "room.ply", points=POINTS + far_m, kind="f4"))
    said = [w for w in scan.warnings if "stored in 32 bits" in w]
    assert len(said) == count
    assert all("in steps of 0.0078 m" in w for w in said)


def test_32_bit_coordinates_that_spoil_shapes_are_refused(tmp_path):
    path = two_instances(tmp_path / "room.ply", points=POINTS + 5e5, kind="f4")
    assert "stored in 32 bits, in steps of 0.031 m; needed 64 bits" in fails(path)


def test_64_bit_coordinates_may_lie_anywhere_and_one_stray_point_is_not_where_the_scan_is(tmp_path):
    assert read_scan(two_instances(tmp_path / "a.ply", points=POINTS + 5e6)).warnings == ()
    stray = np.where(np.arange(len(POINTS))[:, None] == 0, 1e9, POINTS)  # of the background
    assert not any(
        "32 bits" in w for w in read_scan(two_instances(tmp_path / "b.ply", points=stray, kind="f4")).warnings
    )


def test_instances_that_cloudcompare_stored_are_read(tmp_path):
    ids = np.where(IDS > 0, IDS, np.nan).astype(np.float32)
    scan = read_scan(write_ply(tmp_path / "room.ply", scalar_instance=ids))
    assert [i.id for i in scan.instances] == [3, 7]
    assert len(scan.background) == 150
