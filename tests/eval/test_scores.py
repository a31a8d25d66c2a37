"""Scores of poses and matches in their three columns, against slow computations and by hand."""

import dataclasses
import itertools
import math

import numpy as np
import pytest
import trimesh
from known_scenes import known_scene, pose
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from eval.data.masks import DAMAGES, LOST, associated, with_masks
from eval.scores.match_scores import instance_recall, match_scores
from eval.scores.pose_distances import as_published_chamfer
from eval.scores.pose_scores import KEYS, failed_pose, forgiven, pose_scores
from train.furniture.symmetry import SymmetryGroup, candidates, equivalent_poses, measure

RNG = np.random.default_rng(0)


# --- symmetry ---------------------------------------------------------------------------------------------------


def group_of(mesh):
    return measure(np.asarray(mesh.vertices), np.asarray(mesh.faces))


@pytest.mark.parametrize(
    ("mesh", "order", "revolution"),
    [
        (trimesh.creation.box((1, 0.6, 0.4)), 4, False),  # half turns about three axes
        (trimesh.creation.box((1, 1, 0.4)), 8, False),  # and quarter turns about one
        (trimesh.creation.box((1, 1, 1)), 24, False),
        (trimesh.creation.cylinder(0.5, 0.4), None, True),
    ],
)
def test_measured_groups(mesh, order, revolution):
    found = group_of(mesh.apply_translation([3, 2, 1]))
    assert found.revolution is revolution
    np.testing.assert_allclose(found.center, [3, 2, 1], atol=0.02)
    if order is not None:
        assert len(found.rotations) == order


def test_an_odd_shape_has_no_symmetry_and_a_three_legged_stool_three():
    legs = [
        trimesh.creation.cylinder(0.04, 0.5, transform=pose(0, [0.4 * np.cos(a), 0.4 * np.sin(a), 0.25]))
        for a in 2 * np.pi * np.arange(3) / 3
    ]
    stool = trimesh.util.concatenate(
        [*legs, trimesh.creation.cylinder(0.5, 0.04, transform=pose(0, [0, 0, 0.5]))]
    )
    assert len(group_of(stool).rotations) == 3
    arm = trimesh.creation.box((0.1, 0.7, 0.9), transform=pose(0, [0.5, 0.3, 0.4]))
    odd = trimesh.util.concatenate([trimesh.creation.box((1, 0.5, 0.3)), arm])
    found = group_of(odd)
    assert len(found.rotations) == 1 and not found.revolution
    np.testing.assert_array_equal(found.rotations[0], np.eye(3))


def test_candidates_are_distinct_rotations_from_the_identity_on():
    rotations = candidates()
    np.testing.assert_array_equal(rotations[0], np.eye(3))
    np.testing.assert_allclose(np.linalg.det(rotations), 1, atol=1e-12)
    assert all(np.abs(a - b).max() > 1e-6 for a, b in itertools.combinations(rotations, 2))


def test_turns_refuse_less_than_one():
    with pytest.raises(ValueError, match="symmetry of 0 turns"):
        SymmetryGroup.turns(0, np.zeros(3))


@pytest.mark.parametrize("order", [1, 2, 4])
def test_an_equivalent_pose_puts_a_symmetric_cloud_on_itself(order):
    group = SymmetryGroup.turns(order, np.array([0.3, -0.2, 0.0]))
    corner = RNG.normal(size=(20, 3))
    cloud = np.concatenate([(corner - group.center) @ R.T + group.center for R in group.rotations])
    T_ref_model, T_scan_model = pose(20, [1, 2, 3]), pose(-75, [0, 1, 0], "x")
    target = cloud @ T_ref_model[:3, :3].T + T_ref_model[:3, 3]
    source = cloud @ T_scan_model[:3, :3].T + T_scan_model[:3, 3]
    poses = equivalent_poses(np.eye(4), T_ref_model, T_scan_model, group)
    assert len(poses) == order
    for T in poses:
        assert cdist(source @ T[:3, :3].T + T[:3, 3], target).min(axis=1).max() < 1e-9


def test_of_a_revolution_the_nearest_turn_is_taken():
    group = SymmetryGroup(rotations=np.eye(3)[None], center=np.zeros(3), revolution=True)
    for T in (pose(33, [0, 0, 0]), pose(200, [0, 0, 0])):
        (found,) = equivalent_poses(T, np.eye(4), np.eye(4), group)
        np.testing.assert_allclose(found, T, atol=1e-12)
    tipped = pose(40, [0, 0, 0], "x") @ pose(70, [0, 0, 0])
    (found,) = equivalent_poses(tipped, np.eye(4), np.eye(4), group)
    by_search = min(
        Rotation.from_matrix(tipped[:3, :3].T @ pose(a, [0, 0, 0])[:3, :3]).magnitude()
        for a in np.linspace(0, 360, 3601)
    )
    assert Rotation.from_matrix(tipped[:3, :3].T @ found[:3, :3]).magnitude() == pytest.approx(
        by_search, abs=1e-5
    )


# --- poses ------------------------------------------------------------------------------------------------------

SCENE = known_scene()


def scores(T, n=0, other=None, symmetry=None):
    o = SCENE.objects[n]
    o = o if symmetry is None else dataclasses.replace(o, symmetry=symmetry)
    other = SCENE.objects[n if other is None else other]
    clouds = SCENE.instance(1, other.instance[1]).points, SCENE.instance(0, o.instance[0]).points
    return pose_scores(T, o, other, 1, 0, *clouds)


def test_the_true_pose_has_no_error_in_any_column():
    o = SCENE.objects[0]
    found = scores(o.true_pose(o, 1, 0))
    assert set(found) == set(KEYS)
    assert found == pytest.approx(dict.fromkeys(KEYS, 0.0), abs=1e-6)


def test_the_true_pose_of_a_copy_is_right_too():
    one, other = SCENE.objects[1:3]
    assert scores(one.true_pose(other, 1, 0), 1, 2)["re_deg.paper"] == pytest.approx(0, abs=1e-6)
    assert scores(one.true_pose(one, 1, 0), 1, 2)["rmse_m.strict"] > 1


def test_a_failure_has_no_score():
    assert scores(None) == failed_pose() == dict.fromkeys(KEYS)
    assert scores(np.full((4, 4), np.nan)) == failed_pose()


def test_half_a_turn_is_wrong_but_forgiven_as_published_and_right_for_what_is_symmetric():
    o = SCENE.objects[0]
    half = o.T_scan_model[0] @ pose(180, [0, 0, 0]) @ np.linalg.inv(o.T_scan_model[1])
    plain = scores(half)
    assert plain["re_deg.paper"] == pytest.approx(180) and plain["re_deg.strict"] == pytest.approx(180)
    assert plain["re_deg.published"] == pytest.approx(0, abs=1e-6)
    symmetric = scores(half, symmetry=SymmetryGroup.turns(2, np.zeros(3)))
    assert symmetric["re_deg.strict"] == pytest.approx(0, abs=1e-5)
    assert symmetric["rmse_m.strict"] == pytest.approx(0, abs=1e-9) and plain["rmse_m.strict"] > 0.1


def test_scores_against_slow_computations():
    o = SCENE.objects[0]
    T_true = o.true_pose(o, 1, 0)
    T = T_true @ pose(12, [0.1, -0.2, 0.05], "y")
    source, target = SCENE.instance(1, o.instance[1]).points, SCENE.instance(0, o.instance[0]).points
    move = lambda P, x: np.array([(P @ [*p, 1.0])[:3] for p in x])  # noqa: E731
    there = cdist(move(T, source), target, "sqeuclidean").min(axis=1).mean()
    back = cdist(target, move(T @ np.linalg.inv(T_true), target), "sqeuclidean").min(axis=1).mean()
    assert as_published_chamfer(T, T_true, source, target) == pytest.approx(there + back)
    found = scores(T)
    assert found["cd_m2.published"] == pytest.approx(there + back)
    assert found["re_deg.strict"] == pytest.approx(12)
    assert found["te_m.paper"] == pytest.approx(np.linalg.norm(T[:3, 3] - T_true[:3, 3]))
    middle = source.mean(axis=0)
    assert found["te_m.strict"] == pytest.approx(np.linalg.norm((T - T_true) @ [*middle, 1.0]))
    whole = [
        np.concatenate(x)
        for x in ((target, move(T_true, source)), (source, move(np.linalg.inv(T_true), target)))
    ]
    by_hand = cdist(move(T, source), whole[0]).min(axis=1).mean()
    by_hand += cdist(move(np.linalg.inv(T), target), whole[1]).min(axis=1).mean()
    assert found["cd_m.strict"] == pytest.approx(by_hand / 2)


@pytest.mark.parametrize(("angles", "expected"), [((), 93), ((180,), 87), ((90, 180), 3)])
def test_forgiven_angles(angles, expected):
    assert forgiven(93.0, angles) == expected


# --- matches ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("matched", "paper", "published", "strict"),
    [
        ({0: 10, 1: 11, 2: 12, 3: 13}, 4, 4, 4),
        ({0: 10, 1: 12, 2: 11, 3: 13}, 2, 4, 4),  # the copies changed about
        ({0: 10, 1: 11, 2: 11, 3: 13}, 3, 4, 3),  # both copies claim one
        ({0: 13, 3: 10}, 0, 0, 0),
        ({}, 0, 0, 0),
    ],
)
def test_match_scores(matched, paper, published, strict):
    found = match_scores(known_scene(), 0, 1, matched)
    assert (found["pairs"], found["right.paper"], found["right.published"]) == (4, paper, published)
    assert found["right.strict"] == strict
    assert found["f1.strict"] == pytest.approx(2 * strict / (4 + len(matched)))


@pytest.mark.parametrize(
    ("predicted", "expected"),
    [
        ([0, 1, 2, -1], 1),
        ([0, 2, 1, -1], 1),  # targets 1 and 2 are copies: changed about, they are as good
        ([1, 0, -1, 3], 0),
        ([0, -1, 3, -1], 1 / 3),
        ([0, 1, 2, 3], 1),  # a partner for an object that has none is not this metric's business
    ],
)
def test_instance_recall(predicted, expected):
    truth, same = np.array([0, 1, 2, -1]), np.array([0, 1, 1, 2])
    assert instance_recall(np.array(predicted), truth, same) == pytest.approx(expected)


def test_a_copy_counts_for_one_object_only():
    # Both sources claim target 1; its copy, target 2, goes unclaimed. At most one of the two can be right.
    truth, same = np.array([1, 2]), np.array([0, 1, 1])
    assert instance_recall(np.array([1, 1]), truth, same) == 0.5


def test_instance_recall_of_no_true_match():
    same = np.array([0])
    assert math.isnan(instance_recall(np.array([0, -1]), np.array([-1, -1]), same))


def test_what_has_no_partner_is_no_pair_but_costs_precision():
    scene = known_scene(copies=("a", "b"))
    gone = dataclasses.replace(scene.objects[1], instance={0: 1})
    scene = dataclasses.replace(scene, objects=(scene.objects[0], gone))
    found = match_scores(scene, 0, 1, {0: 10, 1: 11})
    assert (found["pairs"], found["right.strict"]) == (1, 1)
    assert found["f1.strict"] == pytest.approx(2 / 3)


# --- masks ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", DAMAGES)
def test_damaged_masks_are_of_the_same_points_and_the_same_every_time(kind):
    scene = known_scene(copies=tuple("abcdefgh"))
    first, again = with_masks(scene, DAMAGES[kind]), with_masks(scene, DAMAGES[kind])
    for old, new, other in zip(scene.scans, first.scans, again.scans, strict=True):
        known = {bytes(p) for i in old.instances for p in i.points}
        assert {bytes(p) for i in new.instances for p in i.points} <= known
        assert all(
            np.array_equal(a.points, b.points) for a, b in zip(new.instances, other.instances, strict=True)
        )
        assert len({i.id for i in new.instances}) == len(new.instances)


def test_what_each_damage_does():
    scene = known_scene(copies=tuple("abcdefgh"))
    by_kind = {k: with_masks(scene, d) for k, d in DAMAGES.items()}
    counts = {k: [len(s.instances) for s in v.scans] for k, v in by_kind.items()}
    assert counts == {"merged": [6] * 3, "split": [10] * 3, "eroded": [8] * 3, "wrong": [8] * 3}
    lost = [o for o in by_kind["merged"].objects if LOST in o.instance.values()]
    assert len(lost) >= 2  # two objects of one mask: it shows one of them
    assert not any(LOST in o.instance.values() for k in ("eroded", "wrong") for o in by_kind[k].objects)
    for kind in ("eroded", "wrong"):  # a mask loses points, the scan none
        for whole, scan in zip(scene.scans, by_kind[kind].scans, strict=True):
            has, had = (
                {bytes(p) for c in (s.background, *(i.points for i in s.instances)) for p in c}
                for s in (scan, whole)
            )
            assert has == had
    inner = by_kind["eroded"].scans[0].instances[0].points
    assert len(inner) == 150
    old, new = ({bytes(p) for p in s.scans[0].instances[0].points} for s in (scene, by_kind["wrong"]))
    assert len(old & new) == 160 and len(new) == 200


def test_association_is_one_to_one_and_needs_overlap():
    scene = known_scene(copies=("a", "b"))
    thin = [
        dataclasses.replace(
            s,
            instances=(
                dataclasses.replace(s.instances[0], id=77, points=s.instances[0].points[:30]),
                s.instances[1],
            ),
        )
        for s in scene.scans
    ]
    found = associated(scene, thin)
    assert found.objects[0].instance == dict.fromkeys(range(3), LOST)  # 15 % of it
    assert found.objects[1].instance == scene.objects[1].instance
    empty = associated(scene, [dataclasses.replace(s, instances=()) for s in scene.scans])
    assert {i for o in empty.objects for i in o.instance.values()} == {LOST}
