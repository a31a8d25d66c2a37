"""Scores of meshes and of whole scenes, against slow computations; a case of nothing and one of everything right."""

import dataclasses

import numpy as np
import pytest
import trimesh
from known_scenes import known_scene, pose
from scipy.spatial.distance import cdist

from eval.accumulation import coverage
from eval.data.truth import KnownObject
from eval.reconstruction import JOINT_STEPS, own_names, with_joint
from eval.scores.mesh_scores import (
    DISTANCES,
    SHARES,
    all_to_surface,
    enclosed,
    f_score,
    mesh_scores,
    no_mesh,
    sdf_recall,
    surface_points,
    volume_iou,
)
from eval.scores.tracks import Track, changes_f1, f1, score_tracks
from more2_jax.config import preset
from more2_jax.types import Mesh
from train.furniture.symmetry import SymmetryGroup

SAMPLES = 3000


def mesh_of(box: trimesh.Trimesh) -> Mesh:
    return Mesh(vertices=np.asarray(box.vertices, float), faces=np.asarray(box.faces, np.int64))


BOX = trimesh.creation.box((1.0, 0.6, 0.4)).subdivide().subdivide()
TRUTH = KnownObject(
    name="box",
    category="box",
    copies="box",
    instance={0: 1},
    T_scan_model={0: pose(30, [2, 1, 0])},
    symmetry=SymmetryGroup.trivial(),
    mesh=mesh_of(BOX),
    canonical=0.9,
)


def placed(mesh: Mesh, T: np.ndarray) -> Mesh:
    return Mesh(vertices=mesh.vertices @ T[:3, :3].T + T[:3, 3], faces=mesh.faces)


def test_the_true_mesh_is_right_wherever_it_stands():
    T = TRUTH.T_scan_model[0]
    found = mesh_scores(placed(mesh_of(BOX), T), TRUTH, T, SAMPLES)
    assert set(found) == {*DISTANCES, *SHARES}
    one = ("iou.paper", "recall.paper", "recall.published", "recall.strict", "watertight", "f")
    assert {k: found[k] for k in one} == pytest.approx(dict.fromkeys(one, 1.0), abs=0.005)
    assert found["chamfer_m.strict"] < 1e-9
    # Of formulas that compare samples their spacing is left: they are drawn by one rule, but through other vertices.
    assert found["chamfer.paper"] < 0.03 and found["chamfer.published"] < 0.01


@pytest.mark.parametrize("off", [0.001, 0.02])
def test_a_distance_is_to_the_surface_however_few_its_samples_are(off):
    """Samples of 3,000 points lie 0.015 apart: a box that is wider by a millimeter is told from the true one."""
    wider = trimesh.creation.box(np.array([1.0, 0.6, 0.4]) + 2 * off)
    found = mesh_scores(mesh_of(wider), TRUTH, np.eye(4), SAMPLES)
    assert found["completeness_m"] == pytest.approx(off, rel=1e-6)
    assert off <= found["accuracy_m"] < 1.1 * off  # a little more beyond the edges


def test_no_mesh_recalls_nothing_and_has_no_distance():
    found = no_mesh()
    assert mesh_scores(None, TRUTH, np.eye(4)) == found
    assert found["iou.paper"] == found["recall.strict"] == found["f"] == 0
    assert found["chamfer.paper"] is None and set(found) == {*DISTANCES, *SHARES}


def test_truth_without_mesh_is_refused():
    with pytest.raises(ValueError, match="no mesh of it"):
        mesh_scores(None, dataclasses.replace(TRUTH, mesh=None), np.eye(4))


def to_triangles(points, mesh):
    """From every point to every triangle, the least."""
    at, triangles = np.repeat(points, len(mesh.faces), axis=0), np.tile(mesh.triangles, (len(points), 1, 1))
    away = np.linalg.norm(trimesh.triangles.closest_point(triangles, at) - at, axis=1)
    return away.reshape(len(points), -1).min(axis=1)


def test_distances_against_all_pairs():
    other, true = (
        trimesh.creation.icosphere(radius=0.4, subdivisions=2),
        trimesh.Trimesh(**vars(TRUTH.mesh), process=False),
    )
    found = mesh_scores(mesh_of(other), TRUTH, np.eye(4), SAMPLES)
    a, b = surface_points(other, SAMPLES), surface_points(true, SAMPLES)
    there, back = to_triangles(a, true), to_triangles(b, other)
    assert found["accuracy_m"] == pytest.approx(there.mean())
    assert found["completeness_m"] == pytest.approx(back.mean())
    assert found["chamfer_m.strict"] == pytest.approx((there.mean() + back.mean()) / 2)
    between = cdist(a, b)
    assert found["chamfer.paper"] == pytest.approx(
        0.9 * (between.min(axis=1).mean() + between.min(axis=0).mean()) / 2
    )
    diagonal = np.linalg.norm([1.0, 0.6, 0.4])
    assert found["completeness_diagonal"] == pytest.approx(back.mean() / diagonal)
    limit = 0.01 * diagonal
    assert found["f"] == pytest.approx(f_score(float((there < limit).mean()), float((back < limit).mean())))
    squared = cdist(a, BOX.vertices, "sqeuclidean")
    assert found["chamfer.published"] == pytest.approx(
        0.81 * (squared.min(axis=1).mean() + squared.min(axis=0).mean())
    )
    assert found["one_way.paper"] == pytest.approx(0.9 * between.min(axis=0).mean())
    assert found["one_way.published"] == pytest.approx(0.81 * squared.min(axis=0).mean())
    radius = np.linalg.norm(BOX.vertices, axis=1)
    assert found["iou.published"] == pytest.approx(np.mean(radius < 0.4), abs=0.02)
    assert found["recall.published"] == pytest.approx(np.mean(np.abs(radius - 0.4) < 0.05 / 0.9), abs=0.02)


def test_iou_of_half_a_box():
    half = trimesh.creation.box((0.5, 0.6, 0.4), transform=pose(0, [0.25, 0, 0]))
    found = mesh_scores(mesh_of(half), TRUTH, np.eye(4), 20_000)
    assert found["iou.paper"] == pytest.approx(0.5, abs=0.02)
    assert found["watertight"] == 1


def test_one_way_what_lies_beyond_an_incomplete_truth_costs_nothing():
    """A truth that ends where its scan does: half of the box. The whole box covers it; the other half does not."""
    half = trimesh.creation.box((0.5, 0.6, 0.4), transform=pose(0, [0.25, 0, 0])).subdivide().subdivide()
    cut = trimesh.Trimesh(half.vertices, half.faces[half.triangles_center[:, 0] > 1e-6], process=False)
    cut.remove_unreferenced_vertices()
    seen = dataclasses.replace(TRUTH, mesh=mesh_of(cut))
    whole = mesh_scores(mesh_of(BOX), seen, np.eye(4), 20_000)
    assert whole["one_way.published"] < 1e-3 and whole["one_way.paper"] < 0.01 < 0.05 < whole["chamfer.paper"]
    other = trimesh.creation.box((0.5, 0.6, 0.4), transform=pose(0, [-0.25, 0, 0]))
    assert mesh_scores(mesh_of(other), seen, np.eye(4), 20_000)["one_way.paper"] > 0.15


def test_an_open_surface_encloses_by_winding():
    points = np.random.default_rng(0).uniform(-0.6, 0.6, (2000, 3))
    box = trimesh.creation.box((1, 1, 1)).subdivide()
    opened = trimesh.Trimesh(box.vertices, box.faces[1:], process=False)
    assert not opened.is_watertight
    agree = enclosed(opened, points) == (np.abs(points).max(axis=1) < 0.5)
    assert agree.mean() > 0.97
    assert mesh_scores(mesh_of(opened), TRUTH, np.eye(4), 500)["watertight"] == 0


@pytest.mark.parametrize(("p", "r", "f"), [(0, 0, 0), (1, 1, 1), (1, 0, 0), (0.5, 1, 2 / 3)])
def test_f_score(p, r, f):
    assert f_score(p, r) == pytest.approx(f)


def test_volume_iou():
    a, b, none = np.array([1, 1, 1, 0], bool), np.array([0, 1, 1, 1], bool), np.zeros(4, bool)
    assert volume_iou(a, b) == 0.5
    assert volume_iou(a, a) == 1
    assert volume_iou(a, ~a) == 0
    assert volume_iou(none, none) == 0


def test_iou_of_shifted_boxes_by_inside_tests():
    box = trimesh.creation.box((1, 1, 1))
    half = trimesh.creation.box((1, 1, 1), transform=pose(0, [0.5, 0, 0]))
    points = np.random.default_rng(3).uniform([-0.5, -0.5, -0.5], [1, 0.5, 0.5], size=(4000, 3))
    within = enclosed(box, points)
    np.testing.assert_array_equal(within, np.abs(points).max(axis=1) < 0.5)
    assert volume_iou(within, enclosed(half, points)) == pytest.approx(1 / 3, abs=0.03)


def test_sdf_recall_of_a_plane_at_known_heights():
    plane = trimesh.Trimesh([[-9, -9, 0], [9, -9, 0], [9, 9, 0], [-9, 9, 0]], [[0, 1, 2], [0, 2, 3]])
    heights = np.array([[0, 0, 0.0], [1, 1, 0.04], [2, 0, -0.04], [0, 2, 0.06], [1, 0, -0.2]])
    near, far = all_to_surface((heights, heights + [0, 0, 5]), plane)
    np.testing.assert_allclose(near, np.abs(heights[:, 2]), atol=1e-9)
    assert sdf_recall(near, 0.05) == pytest.approx(3 / 5)
    assert sdf_recall(near, threshold=1.0) == 1
    assert sdf_recall(far, 0.05) == 0


def test_f1():
    assert f1({"a", "b"}, {"a", "b"}) == 1
    assert f1({"a"}, {"b"}) == 0
    assert f1(set(), set()) == 1
    assert f1(set(), {"a"}) == 0
    precision, recall = 1 / 3, 1 / 2
    expected = 2 * precision * recall / (precision + recall)
    assert f1({"a", "x", "y"}, {"a", "b"}) == pytest.approx(expected)


def test_coverage_by_hand():
    surface = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]])
    assert coverage(surface + [0, 0.02, 0], surface) == 1
    assert coverage(surface + [0, 0.04, 0], surface) == 0
    assert coverage(surface[:1], surface) == 0.25


# --- whole scenes -----------------------------------------------------------------------------------------------


def with_meshes(scene):
    objects = tuple(dataclasses.replace(o, mesh=mesh_of(BOX), canonical=0.9) for o in scene.objects)
    return dataclasses.replace(scene, objects=objects)


SCENE = with_meshes(known_scene())


def true_track(o, instance=None):
    return Track(
        instance=instance or o.instance,
        T_track_scan={k: o.true_pose(o, k, o.first) for k in o.instance},
        points=SCENE.instance(0, o.instance[0]).points,
        mesh=placed(mesh_of(BOX), o.T_scan_model[o.first]),
    )


def totals(records, key):
    return sum(r[key] for r in records), len(records)


def test_true_tracks_are_all_right_and_none_are_all_wrong():
    good = score_tracks(SCENE, [true_track(o) for o in SCENE.objects], 5.0, 500)
    bad = score_tracks(SCENE, [], 5.0, 500)
    for c in ("paper", "published", "strict"):
        for kind in ("m", "mr", "mrr"):
            assert totals(good, f"{kind}.{c}") == (8, 8)
            assert totals(bad, f"{kind}.{c}") == (0, 8)
    assert changes_f1(SCENE, [true_track(o) for o in SCENE.objects]) == 1
    assert changes_f1(SCENE, [Track(instance={0: 0}, T_track_scan={}, points=np.zeros((1, 3)))]) == 0


def test_each_stage_alone_can_fail():
    tracks = [true_track(o) for o in SCENE.objects]
    turned = dataclasses.replace(
        tracks[0], T_track_scan={k: T @ pose(20 * k, [0, 0, 0]) for k, T in tracks[0].T_track_scan.items()}
    )
    found = score_tracks(SCENE, [turned, *tracks[1:]], 5.0, 500)
    assert (totals(found, "m.strict"), totals(found, "mr.strict")) == ((8, 8), (6, 8))
    without = dataclasses.replace(tracks[3], mesh=None)
    found = score_tracks(SCENE, [*tracks[:3], without], 5.0, 500)
    assert (totals(found, "mr.strict"), totals(found, "mrr.strict")) == ((8, 8), (6, 8))


def test_pairs_know_the_collection_that_their_furniture_is_of():
    named = ("chair/kenney_chairDesk", "small-table/clvrai_table_lack_0825", "Bench_applaro", "box")
    owners = [dataclasses.replace(o, copies=c) for o, c in zip(SCENE.objects, named, strict=True)]
    records = score_tracks(dataclasses.replace(SCENE, objects=tuple(owners)), [], 5.0, 10)
    expected = {o.name: c for o, c in zip(owners, ("kenney", "clvrai", None, None), strict=True)}
    assert {r["object"]: r.get("collection") for r in records} == expected


def test_what_is_said_of_motion_counts_for_scans_that_follow_each_other():
    tracks = [true_track(o) for o in SCENE.objects]
    known = [dict.fromkeys((1, 2), k % 2 == 0) for k in range(len(tracks))]
    scene = dataclasses.replace(
        SCENE,
        objects=tuple(dataclasses.replace(o, moved=m) for o, m in zip(SCENE.objects, known, strict=True)),
    )
    asked = sum(o.first + 1 in o.instance for o in scene.objects)

    def told(said):
        tracked = [dataclasses.replace(t, moved=m) for t, m in zip(tracks, said, strict=True)]
        found = score_tracks(scene, tracked, 5.0, 10, says_motion=True)
        return sum(r.get("told.strict", 0) for r in found), sum("told.strict" in r for r in found)

    assert told(known) == (asked, asked)
    assert told([{k: not m for k, m in moved.items()} for moved in known]) == (0, asked)
    assert told([{}] * len(tracks)) == (0, asked)
    assert told([known[0], *[{}] * (len(tracks) - 1)]) == (1, asked)
    objects = tuple(dataclasses.replace(o, moved={}) for o in SCENE.objects)
    unknown = dataclasses.replace(SCENE, objects=objects)
    for says, asked_of in ((False, scene), (True, unknown)):
        records = score_tracks(asked_of, tracks, 5.0, 10, says_motion=says)
        assert not any("told.strict" in r for r in records)


def test_copies_that_change_places_are_right_but_not_by_name():
    one, other = SCENE.objects[1:3]
    swapped = []
    for a, b in ((one, other), (other, one)):
        track = true_track(a, {0: a.instance[0], 1: b.instance[1], 2: a.instance[2]})
        poses = {**track.T_track_scan, 1: a.true_pose(b, 1, 0)}
        swapped.append(dataclasses.replace(track, T_track_scan=poses))
    tracks = [true_track(SCENE.objects[0]), *swapped, true_track(SCENE.objects[3])]
    found = score_tracks(SCENE, tracks, 5.0, 500)
    assert (totals(found, "mr.paper"), totals(found, "mr.strict")) == ((6, 8), (8, 8))


def test_an_object_without_a_mask_has_failed_but_not_as_published():
    lost = dataclasses.replace(SCENE.objects[0], instance={0: 0, 1: -1, 2: 20})
    scene = dataclasses.replace(SCENE, objects=(lost, *SCENE.objects[1:]))
    found = score_tracks(scene, [true_track(o) for o in SCENE.objects], 5.0, 500)
    assert totals(found, "mr.strict") == (7, 8)
    assert [r["mr.published"] for r in found if "mr.published" in r] == [1.0] * 7


def test_a_preset_is_measured_with_and_without_joint_optimization():
    paper, robust = preset("paper"), preset("robust")
    assert own_names("paper", paper) == ("ours, paper", "ours, paper, without optimization")
    assert own_names("robust", robust) == ("ours, robust", "ours, robust, with joint optimization")
    assert with_joint(paper) == paper
    assert with_joint(robust).joint == dataclasses.replace(robust.joint, steps=JOINT_STEPS)
