"""Scores where masks are predicted: parts are the object, what is merged is lost, what is not seen has not gone."""

import dataclasses

import numpy as np
import pytest
import trimesh
from known_scenes import known_scene, pose

from eval.data.flyingshape import known
from eval.data.masks import LOST
from eval.data.truth import KnownScene
from eval.scores.match_scores import match_scores
from eval.scores.tracks import Track, changes_f1, false_changes, score_tracks
from train.rooms.visits import TrueObject

TURN = {0: pose(10, [0, 0, 0]), 1: pose(90, [2, 0, 0], "x")}  # T_scan_room of two scans


def true_object(**more) -> TrueObject:
    box = trimesh.creation.box((0.8, 0.5, 0.3))
    stands = pose(30, [1.0, 2.0, 0.15])
    return TrueObject(
        name="object_0",
        model="box",
        category="box",
        vertices=np.asarray(box.vertices),
        faces=np.asarray(box.faces),
        T_scan_model={k: T @ stands for k, T in TURN.items()},
        **{"instance": {0: 3, 1: 5}} | more,
    )


def test_moved_is_told_in_the_room_whatever_the_scans_frames():
    there = true_object()
    assert known(there, list(TURN.values())).moved == {0: False, 1: False}
    moved = {**there.T_scan_model, 1: TURN[1] @ pose(30, [1.0, 2.4, 0.15])}
    assert known(dataclasses.replace(there, T_scan_model=moved), list(TURN.values())).moved[1]


def test_parts_are_the_object_and_merged_ones_are_lost():
    split = known(true_object(parts={0: (3, 4), 1: (5,)}))
    assert split.masks(0) == (3, 4)
    assert split.masks(2) == ()
    merged = known(true_object(merged=frozenset({1}), parts={0: (3,), 1: (5,)}))
    assert merged.instance == {0: 3, 1: LOST}
    scene = KnownScene(name="one", scans=(), objects=(split,))
    assert [scene.owner(0, i) for i in (3, 4, 5)] == [split, split, None]


def with_object(scene: KnownScene, n: int, **changed) -> KnownScene:
    objects = [dataclasses.replace(o, **changed) if k == n else o for k, o in enumerate(scene.objects)]
    return dataclasses.replace(scene, objects=tuple(objects))


def true_tracks(scene: KnownScene) -> list[Track]:
    return [
        Track(
            instance={k: i for k, i in o.instance.items() if i != LOST},
            T_track_scan={k: np.linalg.inv(T) for k, T in o.T_scan_model.items()},
            points=np.zeros((1, 3)),
        )
        for o in scene.objects
    ]


SCENE = known_scene(scans=2)


def test_a_match_to_a_smaller_part_is_right():
    parts = {0: (0,), 1: (10, 99)}
    extra = dataclasses.replace(SCENE.scans[1].instances[0], id=99)
    scans = (
        SCENE.scans[0],
        dataclasses.replace(SCENE.scans[1], instances=(*SCENE.scans[1].instances, extra)),
    )
    scene = dataclasses.replace(with_object(SCENE, 0, parts=parts), scans=scans)
    matched = {k: 10 + k for k in range(4)}
    assert match_scores(scene, 0, 1, matched)["right.paper"] == 4
    assert match_scores(scene, 0, 1, {**matched, 0: 99})["right.paper"] == 4
    assert match_scores(scene, 0, 1, {**matched, 0: 99})["right.strict"] == 4
    unknown = dataclasses.replace(SCENE, scans=scans)
    assert match_scores(unknown, 0, 1, {**matched, 0: 99})["right.paper"] == 3


def test_a_merged_object_has_failed_for_whoever_keeps_the_mask_whole():
    scene = with_object(SCENE, 3, instance={0: 3, 1: LOST})
    records = {r["object"]: r for r in score_tracks(scene, true_tracks(scene), 5.0, 10)}
    assert [records[f"object_{k}"]["m.strict"] for k in range(4)] == [1, 1, 1, 0]
    assert "m.published" not in records["object_3"]


@pytest.mark.parametrize("absent", [0, 1])
def test_what_is_not_seen_has_neither_come_nor_gone(absent):
    seen = {k: i for k, i in SCENE.objects[0].instance.items() if k != absent}
    unseen = with_object(SCENE, 0, instance=seen)
    assert changes_f1(unseen, true_tracks(unseen)) == 1  # says that it came, or went; nobody can know
    poses = {k: T for k, T in SCENE.objects[0].T_scan_model.items() if k != absent}
    gone = with_object(SCENE, 0, instance=seen, T_scan_model=poses)
    assert changes_f1(gone, true_tracks(gone)) == 1
    assert changes_f1(gone, true_tracks(gone)[1:]) == 0
    assert changes_f1(unseen, true_tracks(unseen)[1:]) == 1


@pytest.mark.parametrize("absent", [0, 1])
@pytest.mark.parametrize(("share", "known"), [(0.0, False), (0.09, False), (0.11, True), (1.0, True)])
def test_what_changed_where_the_other_scan_did_not_look_counts_neither_way(absent, share, known):
    seen = {k: i for k, i in SCENE.objects[0].instance.items() if k != absent}
    poses = {k: T for k, T in SCENE.objects[0].T_scan_model.items() if k != absent}
    gone = with_object(SCENE, 0, instance=seen, T_scan_model=poses)
    looked = {absent: {SCENE.objects[0].name: share}}
    by_scan = tuple(looked.get(k, {}) for k in range(2))
    which = "looked_at" if absent else "looked_at_next"  # what went, and what came
    told = dataclasses.replace(gone, **{which: by_scan})
    said, *others = true_tracks(told)
    assert changes_f1(told, [said, *others]) == 1
    assert changes_f1(told, others) == (0 if known else 1)
    silent = dataclasses.replace(said, not_seen=frozenset({absent}))
    assert changes_f1(told, [silent, *others]) == (0 if known else 1)
    other = "looked_at_next" if absent else "looked_at"  # tells of another place
    assert changes_f1(dataclasses.replace(gone, **{other: by_scan}), others) == 0


@pytest.mark.parametrize("absent", [0, 1])
@pytest.mark.parametrize("visible", [True, False])
def test_what_is_told_of_a_thing_without_a_mask(absent, visible):
    first, *others = true_tracks(SCENE)
    kept = {k: i for k, i in SCENE.objects[0].instance.items() if k != absent}
    scene = with_object(SCENE, 0, instance=kept | ({absent: LOST} if visible else {}))
    gone = dataclasses.replace(first, instance=kept)
    assert false_changes(scene, [gone, *others]) == [1.0]
    assert false_changes(scene, [dataclasses.replace(gone, not_seen=frozenset({absent})), *others]) == [0.0]
    assert false_changes(scene, [first, *others]) == [0.0]  # held to be another mask
    assert false_changes(scene, others) == [0.0]
    assert false_changes(SCENE, [gone, *others]) == []  # it has a mask in both
    poses = {k: T for k, T in SCENE.objects[0].T_scan_model.items() if k != absent}
    assert false_changes(with_object(SCENE, 0, instance=kept, T_scan_model=poses), [gone, *others]) == []


@pytest.mark.parametrize("absent", [0, 1])
def test_who_says_that_a_scan_did_not_look_says_no_change(absent):
    seen = {k: i for k, i in SCENE.objects[0].instance.items() if k != absent}
    poses = {k: T for k, T in SCENE.objects[0].T_scan_model.items() if k != absent}
    gone = with_object(SCENE, 0, instance=seen, T_scan_model=poses)
    first, *others = true_tracks(gone)
    silent = dataclasses.replace(first, not_seen=frozenset({absent}))
    assert changes_f1(gone, [silent, *others]) == 0  # it had changed
    first, *others = true_tracks(SCENE)
    (kept,) = set(first.instance) - {absent}
    part = dataclasses.replace(first, instance={kept: first.instance[kept]})
    assert changes_f1(SCENE, [part, *others]) == 0  # it had not
    assert changes_f1(SCENE, [dataclasses.replace(part, not_seen=frozenset({absent})), *others]) == 1
