"""The published layouts as fixtures: FlyingShape's npz files; 3RScan with annotated and predicted masks."""

import dataclasses
import json
import shutil

import numpy as np
import pytest
import trimesh
from dataset_writers.ply_file import vertex_columns, write_ply
from dataset_writers.threerscan import column_major, write_annotated_mesh, write_semseg
from known_scenes import pose
from published_folder import SCENE, write_published

from eval import accumulation
from eval.data.flyingshape import digest, flyingshape
from eval.data.masks import LOST
from eval.data.threerscan import threerscan
from eval.harness.options import Options, benchmark, is_upright
from eval.registration import true_pairs
from eval.scores.match_scores import match_scores
from eval.scores.pose_scores import pose_scores
from more2_jax.geometry.poses import apply_pose
from more2_jax.storage.ply_files import write_mesh
from more2_jax.types import Mesh


@pytest.mark.parametrize("rows", [3, 4])
def test_published_flyingshape(tmp_path, rows):
    write_published(tmp_path / "all_1" / "scene_a", rows=rows)
    write_published(tmp_path / "all_1" / "scene_b", rows=rows)
    data = flyingshape(tmp_path)
    assert data.names == ("all_1-scene_a", "all_1-scene_b") and not data.upright and data.right_deg == 5
    scene = data.read(data.names[0])
    assert [len(s.instances) for s in scene.scans] == [4, 4, 4]
    assert [o.copies for o in scene.objects] == ["a", "b", "b", "c"]
    for o, true in zip(scene.objects, SCENE.objects, strict=True):
        T = o.true_pose(o, 2, 0)
        source, target = scene.instance(2, o.instance[2]).points, scene.instance(0, o.instance[0]).points
        np.testing.assert_allclose(source @ T[:3, :3].T + T[:3, 3], target, atol=1e-5)
        np.testing.assert_allclose(T, true.true_pose(true, 2, 0), atol=1e-12)
    found = match_scores(scene, 0, 1, {1: 1, 2: 2, 3: 3, 4: 4})
    assert found["right.paper"] == found["pairs"] == 4


def test_published_flyingshape_that_is_wrong_is_refused(tmp_path):
    folder = tmp_path / "s"
    write_published(folder)
    with np.load(folder / "00001.npz") as file:
        arrays = dict(file)
    name = flyingshape(tmp_path).names[0]
    for changed, message in (
        ({"transform": arrays["transform"][:2]}, r"transform \(2, 3, 4\)"),
        ({"obj_id": arrays["obj_id"][::-1]}, "obj_id differs"),
        ({"class_id": arrays["class_id"][:1]}, "do not have the 4 rows"),
    ):
        np.savez(folder / "00001.npz", **{**arrays, **changed})
        with pytest.raises(ValueError, match=message):
            flyingshape(tmp_path).read(name)
    np.savez(folder / "00001.npz", pc=arrays["pc"])
    with pytest.raises(ValueError, match="needed transform, class_id, obj_id too"):
        flyingshape(tmp_path).read(name)


def test_a_folder_of_neither_layout_is_refused(tmp_path):
    with pytest.raises(ValueError, match="neither"):
        flyingshape(tmp_path)
    with pytest.raises(ValueError, match="no such folder"):
        benchmark(Options(data=tmp_path / "none", out=tmp_path))
    with pytest.raises(ValueError, match="predicted masks are read for 3rscan only"):
        benchmark(Options(data=tmp_path, out=tmp_path, masks="predicted"))


def test_digest_follows_the_index(tmp_path):
    (tmp_path / "index.json").write_text("{}")
    before = digest(tmp_path)
    (tmp_path / "other").write_text("x")
    assert digest(tmp_path) == before
    (tmp_path / "index.json").write_text('{"seed": 1}')
    assert digest(tmp_path) != before


# --- 3RScan -----------------------------------------------------------------------------------------------------

RNG = np.random.default_rng(0)
SHAPE = {n: RNG.uniform(-0.4, 0.4, (300, 3)) for n in ("chair", "table", "plant")}
# Where every instance stands: chairs 1 and 2 look alike, the table is 3; in the rescan chair 1 has moved.
T_REF = {1: pose(0, [1, 0, 0.5]), 2: pose(90, [3, 1, 0.5]), 3: pose(10, [0, 4, 0.5]), 9: pose(0, [9, 9, 0])}
T_WORLD = pose(35, [0.5, -1, 0.2])  # rescan's frame to the reference's
T_RESCAN = {
    1: pose(-120, [2, 2, 0.5]),
    2: np.linalg.inv(T_WORLD) @ T_REF[2],
    3: np.linalg.inv(T_WORLD) @ T_REF[3],
}
LABEL = {1: "chair", 2: "chair", 3: "table", 9: "plant"}


def write_scan(folder, poses):
    points = np.concatenate([SHAPE[LABEL[i]] @ T[:3, :3].T + T[:3, 3] for i, T in poses.items()])
    ids = np.concatenate([np.full(300, i) for i in poses])
    write_annotated_mesh(folder, points, ids)
    write_semseg(folder, {i: LABEL[i] for i in poses})
    return ids


@pytest.fixture(scope="module")
def places(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data") / "3rscan"
    recon = folder.parent / "val_set_recon" / "ref"
    recon.mkdir(parents=True)
    box = trimesh.creation.box((0.8, 0.8, 0.8), transform=T_REF[2])
    write_mesh(recon / "objectId_2.ply", Mesh(vertices=np.asarray(box.vertices), faces=np.asarray(box.faces)))
    for name, poses in (("ref", T_REF), ("later", T_RESCAN)):
        ids = write_scan(folder / name, poses)
        predicted = np.where(ids == 3, 0, ids)  # the network misses the table
        predicted[: 150 if name == "later" else 0] = 0
        np.savez(folder / name / "mask3d.labels.npz", objectId=predicted)
    moved = {
        "instance_reference": 1,
        "instance_rescan": 1,
        "symmetry": 1,
        "transform": column_major(T_RESCAN[1] @ np.linalg.inv(T_REF[1])),
    }
    alike = {
        "instance_source": 1,
        "instance_target": 2,
        "transform": column_major(T_REF[2] @ np.linalg.inv(T_REF[1])),
    }
    rescan = {
        "reference": "later",
        "transform": column_major(T_WORLD),
        "rigid": [moved],
        "nonrigid": [],
        "removed": [],
    }
    place = {"reference": "ref", "type": "validation", "ambiguity": [[alike]], "scans": [rescan]}
    (folder / "3RScan.json").write_text(json.dumps([place]))
    return folder


def scores(scene, a, b):
    """Of the true pose of what `b` shows in the rescan, onto `a` in the reference; by moving the points."""
    T = a.true_pose(b, 1, 0)
    source, target = scene.instance(1, b.instance[1]).points, scene.instance(0, a.instance[0]).points
    np.testing.assert_allclose(source @ T[:3, :3].T + T[:3, 3], target, atol=1e-5)
    return pose_scores(T, a, b, 1, 0, source, target)


def test_annotated_places(places):
    data = threerscan(places, split="validation", predicted=False)
    assert data.names == ("ref",) and data.right_deg == 10 and data.upright
    scene = data.read("ref")
    assert [o.name for o in scene.objects] == ["instance_1", "instance_2", "instance_3"]  # no plant
    one, two, table = scene.objects
    assert one.copies == two.copies != table.copies
    assert (one.moved[1], two.moved[1], table.moved[1]) == (True, False, False)
    for a, b in ((one, one), (two, two), (table, table), (one, two), (two, one)):
        assert scores(scene, a, b)["re_deg.paper"] == pytest.approx(0, abs=1e-4)
    assert one.forgiven_deg == (180.0,) and len(one.symmetry.rotations) == 2 and table.forgiven_deg == ()
    swapped = match_scores(scene, 0, 1, {1: 2, 2: 1, 3: 3})
    assert (swapped["right.paper"], swapped["right.published"], swapped["right.strict"]) == (1, 3, 3)


def test_annotated_surfaces_stand_where_the_points_are(places):
    one, two, _ = threerscan(places, split="validation", predicted=False).read("ref").objects
    assert one.mesh is None and two.mesh is not None
    in_reference = two.mesh.vertices @ two.T_scan_model[0][:3, :3].T + two.T_scan_model[0][:3, 3]
    np.testing.assert_allclose(in_reference.mean(axis=0), T_REF[2][:3, 3], atol=1e-6)


def test_predicted_masks_show_the_objects_they_overlap_most(places):
    scene = threerscan(places, split="validation", predicted=True).read("ref")
    one, two, table = scene.objects
    assert set(table.instance.values()) == {LOST}
    assert one.instance == {0: 1, 1: 1} and two.instance == {0: 2, 1: 2}
    assert len(scene.instance(1, 1).points) == 150
    assert [len(s.instances) for s in scene.scans] == [3, 2]  # the reference's plant is a distractor


DENSE = {n: np.concatenate([points + d for d in (0.001, 0.002, 0.003, 0.004)]) for n, points in SHAPE.items()}


def write_published_cloud(folder, poses, T_ref_scan, shapes):
    """Points in the reference's frame with their labels; returns the labels."""
    points = np.concatenate([apply_pose(T_ref_scan @ T, shapes[i]) for i, T in poses.items()])
    write_ply(folder / "pointcloud.instances.align.ply", vertex_columns(points))
    ids = np.concatenate([np.full(len(shapes[i]), i) for i in poses])
    np.savez(folder / "pointcloud.labels.npz", objectId=ids)
    return ids


@pytest.fixture
def published(places, tmp_path):
    """The same place with the published evaluation's clouds: other points than the mesh's, in the reference's frame."""
    folder = tmp_path / "3rscan"
    shutil.copytree(places, folder)
    for name, poses, T in (("ref", T_REF, np.eye(4)), ("later", T_RESCAN, T_WORLD)):
        ids = write_published_cloud(folder / name, poses, T, {i: DENSE[LABEL[i]] for i in poses})
        np.savez(folder / name / "mask3d.labels.npz", objectId=np.where(ids == 3, 0, ids))
    return folder


def test_published_clouds_are_read_in_their_scans_own_frames(published):
    scene = threerscan(published, split="validation", predicted=False).read("ref")
    one, two, table = scene.objects
    assert {len(i.points) for s in scene.scans for i in s.instances} == {1200}
    for a, b in ((one, one), (two, two), (table, table), (two, one)):
        assert scores(scene, a, b)["re_deg.paper"] == pytest.approx(0, abs=1e-4)
    expected = apply_pose(T_RESCAN[1], DENSE["chair"])
    np.testing.assert_allclose(scene.instance(1, 1).points, expected, atol=1e-5)


def test_published_predicted_masks_are_of_the_published_cloud(published):
    scene = threerscan(published, split="validation", predicted=True).read("ref")
    one, two, table = scene.objects
    assert set(table.instance.values()) == {LOST}
    assert one.instance == {0: 1, 1: 1} and two.instance == {0: 2, 1: 2}
    assert len(scene.instance(1, 1).points) == 1200
    np.savez(published / "later" / "mask3d.labels.npz", objectId=np.zeros(900, int))
    with pytest.raises(ValueError, match="objectId is for 900 points; the scan has 3600"):
        threerscan(published, split="validation", predicted=True).read("ref")


def test_a_scan_without_any_predicted_mask_is_one(published):
    """Its objects have no mask and stay in all denominators; programs go on."""
    np.savez(published / "later" / "mask3d.labels.npz", objectId=np.zeros(3600, int))
    scene = threerscan(published, split="validation", predicted=True).read("ref")
    assert scene.scans[1].instances == () and len(scene.scans[1].background) == 3600
    assert {o.instance[1] for o in scene.objects} == {LOST}
    assert match_scores(scene, 0, 1, {})["pairs"] == 3


def test_a_scan_that_cannot_be_used_ends_what_accumulates(published, monkeypatch, unchecked):
    def grows(scene, prior, config):
        yield "after one scan"
        raise ValueError("no instances")

    monkeypatch.setattr(accumulation, "living_scenes", grows)
    monkeypatch.setattr(accumulation, "reconstruct", lambda prior, living, config: living)
    monkeypatch.setattr(accumulation, "tracks_of", lambda living: [living])
    scene = threerscan(published, split="validation", predicted=True).read("ref")
    found = list(accumulation.tracks_after_every_scan(scene, None, None))
    assert found == [(["after one scan"], ""), ([], "no instances")]

    def fails(prior, living, config):
        raise ValueError("a mistake of ours")

    monkeypatch.setattr(
        accumulation, "reconstruct", fails
    )  # what is no scan's fault is no failure of the method
    with pytest.raises(ValueError, match="a mistake of ours"):
        list(accumulation.tracks_after_every_scan(scene, None, None))


def test_masks_of_the_vertices_are_compared_on_the_vertices(published):
    """Beside a published cloud without masks of its own: the truth is then that of the vertices, too."""
    for name, rows in (("ref", 1200), ("later", 900)):
        (published / name / "mask3d.labels.npz").unlink()
        np.savez(published / name / f"{name}.npz", objectId=np.repeat(np.arange(rows // 300) + 7, 300))
    scene = threerscan(published, split="validation", predicted=True).read("ref")
    assert [o.instance for o in scene.objects] == [{0: 7, 1: 7}, {0: 8, 1: 8}, {0: 9, 1: 9}]
    assert {len(i.points) for s in scene.scans for i in s.instances} == {300}


def test_instances_below_1024_points_are_no_instances_of_the_published_cloud(published):
    poses, shapes = T_RESCAN, {i: DENSE[LABEL[i]] for i in T_RESCAN}
    for count, seen in ((1024, True), (1023, False)):
        write_published_cloud(published / "later", poses, T_WORLD, shapes | {2: shapes[2][:count]})
        scene = threerscan(published, split="validation", predicted=False).read("ref")
        assert (1 in scene.objects[1].instance) == seen
        assert len(scene.scans[1].instances) == 2 + seen


def test_masks_of_very_many_points_keep_what_they_share(published):
    """A scan thins large instances. Masks of which one holds nine tenths of the other overlap by that much after it."""
    rng = np.random.default_rng(3)
    shapes = {i: rng.uniform(-0.4, 0.4, (12_000, 3)) for i in (1, 2, 3)}
    for name, T in (("ref", np.eye(4)), ("later", T_WORLD)):
        poses = {i: T_RESCAN[i] if name == "later" else T_REF[i] for i in shapes}
        ids = write_published_cloud(published / name, poses, T, shapes)
        ids[::10] = 0
        np.savez(published / name / "mask3d.labels.npz", objectId=ids)
    data = {p: threerscan(published, split="validation", predicted=p).read("ref") for p in (False, True)}
    assert all(o.instance == {0: i, 1: i} for o, i in zip(data[True].objects, (1, 2, 3), strict=True))
    for i in shapes:
        true, masked = (set(map(tuple, data[p].instance(1, i).points.tolist())) for p in (False, True))
        assert 7_000 < len(masked) < len(true) <= 10_000
        assert masked < true and len(masked) == pytest.approx(0.9 * len(true), rel=0.02)


def test_what_changed_its_shape_is_matched_and_not_registered(places, tmp_path):
    """As the published evaluation has it, which knows no nonrigid change when it matches; a listed motion counts."""
    shutil.copytree(places, tmp_path / "3rscan")
    index = json.loads((places / "3RScan.json").read_text())
    index[0]["scans"][0]["nonrigid"] = [1, 3]  # the chair's motion is listed, the table's is not
    (tmp_path / "3rscan" / "3RScan.json").write_text(json.dumps(index))
    scene = threerscan(tmp_path / "3rscan", split="validation", predicted=False).read("ref")
    assert match_scores(scene, 0, 1, {1: 1, 2: 2, 3: 3})["pairs"] == 3
    assert [p.object.name for p in true_pairs(scene, "all")] == ["instance_1", "instance_2"]


def test_rescans_without_movable_furniture_are_left_out(places, tmp_path):
    shutil.copytree(places, tmp_path / "3rscan")
    write_scan(tmp_path / "3rscan" / "bare", {9: T_REF[9]})
    index = json.loads((places / "3RScan.json").read_text())
    bare = {"reference": "bare", "transform": column_major(np.eye(4))}
    index[0]["scans"].insert(0, bare)
    (tmp_path / "3rscan" / "3RScan.json").write_text(json.dumps(index))
    scene = threerscan(tmp_path / "3rscan", split="validation", predicted=False).read("ref")
    assert [s.name for s in scene.scans] == ["ref", "later"]
    np.testing.assert_allclose(
        scene.scans[1].instances[0].points, apply_pose(T_RESCAN[1], SHAPE["chair"]), atol=1e-5
    )


def test_pairs_that_3rscan_lists_as_rigid(places):
    scene = threerscan(places, split="validation", predicted=False).read("ref")
    assert [p.object.name for p in true_pairs(scene, "all")] == ["instance_1", "instance_2", "instance_3"]
    assert [p.object.name for p in true_pairs(scene, "rigid")] == ["instance_1"]
    everywhere = dataclasses.replace(scene.objects[2], rigid=None)  # of data that state every pose
    known = dataclasses.replace(scene, objects=(everywhere,))
    assert [p.object.name for p in true_pairs(known, "rigid")] == ["instance_3"]


def test_what_is_missing_is_named(places, tmp_path):
    with pytest.raises(ValueError, match=r"no 3RScan.json"):
        threerscan(tmp_path, split="validation", predicted=False)
    with pytest.raises(ValueError, match="no place of split test"):
        threerscan(places, split="test", predicted=False)
    masks = places / "later" / "mask3d.labels.npz"
    content = masks.read_bytes()
    masks.unlink()
    with pytest.raises(ValueError, match="no predicted masks"):
        threerscan(places, split="validation", predicted=True).read("ref")
    masks.write_bytes(content)


def test_upright_is_as_the_data_were_made_unless_told(places):
    data = threerscan(places, split="validation", predicted=False)
    said = {u: is_upright(Options(data=places, out=places, upright=u), data) for u in ("auto", "yes", "no")}
    assert said == {"auto": True, "yes": True, "no": False}
