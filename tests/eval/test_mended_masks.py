"""Masks that a method adds are scored as whose they are."""

import dataclasses

import numpy as np
from known_scenes import known_scene

from eval.data.masks import LOST
from eval.scores.mended_masks import with_added_masks
from eval.scores.tracks import Track, false_changes, score_tracks
from more2_jax.geometry.poses import apply_pose
from more2_jax.types import Mesh


def overlooked(scan: int):
    """Two objects in two scans; one has no mask in one of them, in which it left its points."""
    scene = known_scene(copies=("a", "b"), scans=2)
    o = scene.objects[0]
    lost = scene.instance(scan, o.instance[scan])
    scans = list(scene.scans)
    others = tuple(i for i in scans[scan].instances if i is not lost)
    scans[scan] = dataclasses.replace(scans[scan], instances=others)
    gone = dataclasses.replace(o, instance=o.instance | {scan: LOST})
    objects = [dataclasses.replace(known, mesh=mesh_of(scene, known)) for known in (gone, *scene.objects[1:])]
    return dataclasses.replace(scene, scans=tuple(scans), objects=tuple(objects)), lost


def mesh_of(scene, o):
    """A mesh whose vertices are what the first scan shows of an object."""
    points = apply_pose(np.linalg.inv(o.T_scan_model[0]), scene.instance(0, o.instance[0]).points)
    return Mesh(vertices=points, faces=np.array([[0, 1, 2]]))


def track(scene, o, found: int, points):
    """The object as a method follows it that found it as instance `found`."""
    seen = {0: scene.instance(0, o.instance[0]).points, 1: points}
    poses = {k: scene.objects[0].true_pose(o, k, 0) for k in (0, 1)}
    return Track(instance={0: o.instance[0], 1: found}, T_track_scan=poses, points=seen[0], seen=seen)


def test_an_object_without_a_mask_gains_the_one_that_lies_on_it():
    scene, lost = overlooked(1)
    right = track(scene, scene.objects[0], 77, lost.points)
    assert false_changes(scene, [right]) == [0.0]
    mended, (told,) = with_added_masks(scene, [right])
    assert mended.objects[0].instance[1] == told.instance[1] != LOST
    assert np.array_equal(mended.instance(1, told.instance[1]).points, lost.points)
    unmeshed = [dataclasses.replace(o, mesh=None) for o in mended.objects]
    found = score_tracks(dataclasses.replace(mended, objects=tuple(unmeshed)), [told], 10.0, 0)
    assert [r["m.strict"] for r in found if r["object"] == scene.objects[0].name] == [1.0]


def test_a_mask_on_another_object_is_nobodys():
    scene, _ = overlooked(1)
    other = scene.objects[1]
    wrong = track(scene, scene.objects[0], 77, scene.instance(1, other.instance[1]).points)
    mended, (told,) = with_added_masks(scene, [wrong])
    assert [o.instance[1] for o in mended.objects] == [LOST, other.instance[1]]
    assert mended.owner(1, told.instance[1]) is None


def test_masks_of_the_scan_stay_as_they_are():
    scene = known_scene(copies=("a", "b"), scans=2)
    o = scene.objects[1]
    known = track(scene, o, o.instance[1], scene.instance(1, o.instance[1]).points)
    mended, (told,) = with_added_masks(scene, [known])
    assert mended is scene and told is known
