"""t-mAP: values by hand, and the laws of its definition (docs/concepts/measures.md)."""

import dataclasses

import numpy as np
import pytest
from factories import living_scene
from known_scenes import known_scene

from eval.data.flyingshape import vertices_of
from eval.data.masks import DAMAGES, with_masks
from eval.end_to_end import figures, records_of
from eval.scores.average_precision import ap_of_rows, ap_rows
from eval.scores.figures import Figure, figure_row, rows_of
from eval.scores.mended_masks import with_mended_masks
from eval.scores.temporal_ap import THRESHOLDS, masks_of, overlaps, temporal_records
from eval.scores.tracks import Track, tracks_of
from more2_jax.storage.ply_files import write_points

KEYS = ("t_map", "t_ap50", "ap50")


def mask(*rows: int, of: int = 10) -> np.ndarray:
    found = np.zeros(of, bool)
    found[list(rows)] = True
    return found


def value(records: list[dict], key: str) -> float:
    """The average precision of some scenes."""
    rows = [np.array(r[key], float) for r in records]
    return ap_of_rows(np.concatenate([r for r in rows if len(r)]))


def followed(scene, rows: dict[int, dict[int, int]], scores=None) -> list[Track]:
    """Tracks: by number, scan → the object whose instance it takes there."""
    return [
        Track(
            instance={k: scene.objects[n].instance[k] for k, n in which.items()},
            T_track_scan={k: np.eye(4) for k in which},
            points=np.zeros((1, 3)),
            score=1.0 if scores is None else scores[t],
        )
        for t, which in rows.items()
    ]


def true_tracks(scene) -> list[Track]:
    return followed(scene, {n: dict.fromkeys(o.instance, n) for n, o in enumerate(scene.objects)})


def without(scene, n: int, *scans: int):
    """The scene as if object `n` were not in some scans, instances and all."""
    gone = scene.objects[n]
    kept = {k: i for k, i in gone.instance.items() if k not in scans}
    poses = {k: T for k, T in gone.T_scan_model.items() if k not in scans}
    objects = tuple(
        dataclasses.replace(o, instance=kept, T_scan_model=poses) if o is gone else o for o in scene.objects
    )
    made = tuple(
        dataclasses.replace(s, instances=tuple(i for i in s.instances if i.id != gone.instance[k]))
        if k in scans
        else s
        for k, s in enumerate(scene.scans)
    )
    return dataclasses.replace(scene, scans=made, objects=objects)


# --- overlaps ---------------------------------------------------------------------------------------------------


def test_overlaps_by_hand():
    """Scan 0: 3 of 4 and 4 points, union 5; scan 1: 1 common, union 2. Together 4 of 7."""
    track = {0: mask(0, 1, 2, 3), 1: mask(5)}
    truth = {0: mask(1, 2, 3, 4), 1: mask(5, 6)}
    least, pooled = overlaps([track], [truth], ["a"])
    assert least.item() == pytest.approx(1 / 2)  # of 3/5 and 1/2
    assert pooled.item() == pytest.approx(4 / 7)


def test_a_scan_that_only_one_of_them_has_makes_the_least_zero_and_counts_in_the_pool():
    both, one = {0: mask(0, 1, 2), 1: mask(0, 1, 2)}, {0: mask(0, 1, 2)}
    for predicted, truth in ((both, one), (one, both)):
        least, pooled = overlaps([predicted], [truth], ["a"])
        assert (least.item(), pooled.item()) == (0, pytest.approx(1 / 2))
    least, pooled = overlaps([one], [one], ["a"])  # scan 1 is there, and neither is in it
    assert (least.item(), pooled.item()) == (1, 1)


def test_copies_are_compared_with_the_one_that_a_track_overlaps_most():
    a, b = {0: mask(0, 1), 1: mask(0, 1)}, {0: mask(5, 6), 1: mask(5, 6)}
    swapped = [{0: a[0], 1: b[1]}, {0: b[0], 1: a[1]}]
    for kinds, least, pooled in ((["x", "x"], 1, 1), (["x", "y"], 0, 1 / 3)):
        found = overlaps(swapped, [a, b], kinds)
        np.testing.assert_allclose(found[0], least)
        np.testing.assert_allclose(found[1], pooled)  # 2 common points of 6


def test_a_copy_that_came_is_no_copy_that_was_there_all_the_time():
    """Whoever has other scans is another object, however alike."""
    stayed, came = {0: mask(0), 1: mask(0)}, {1: mask(5)}
    least, _ = overlaps([{0: mask(0), 1: mask(5)}, {1: mask(0)}], [stayed, came], ["x", "x"])
    np.testing.assert_array_equal(least, np.eye(2))


# --- scenes -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("key", KEYS)
def test_a_perfect_result_is_one_and_none_is_zero(key):
    scene = known_scene()
    assert value([temporal_records(scene, true_tracks(scene))], key) == 1
    assert value([temporal_records(scene, [])], key) == 0


@pytest.mark.parametrize("key", KEYS)
def test_one_scan_is_standard_average_precision(key):
    """The masks of two objects damaged by hand, beside the matrix of overlaps worked out on sets."""
    scene = known_scene(scans=1, points=100)
    tracks = true_tracks(scene)
    clouds = [scene.instance(0, o.instance[0]).points for o in scene.objects]
    seen = [clouds[0][:80], np.concatenate([clouds[1], clouds[2][:60]]), clouds[2][60:], clouds[3]]
    scores = (0.3, 0.9, 0.8, 0.7)
    tracks = [
        dataclasses.replace(t, seen={0: s}, score=c) for t, s, c in zip(tracks, seen, scores, strict=True)
    ]
    sets = [[set(map(tuple, c)) for c in part] for part in (seen, clouds)]
    iou = np.array([[len(a & b) / len(a | b) for b in sets[1]] for a in sets[0]])
    thresholds = THRESHOLDS if key == "t_map" else (0.5,)
    expected = ap_of_rows(np.array(ap_rows(np.array(scores), iou, thresholds), float))
    found = value([temporal_records(distinct(scene), tracks)], key)
    assert found == pytest.approx(expected) and 0.2 < found < 0.9


def distinct(scene):
    """The scene without copies."""
    objects = tuple(dataclasses.replace(o, copies=o.name) for o in scene.objects)
    return dataclasses.replace(scene, objects=objects)


@pytest.mark.parametrize("scans", [2, 5])
def test_objects_that_change_identity_halve_it_and_copies_cost_nothing(scans):
    """Two of four tracks go on as each other in the last scan."""
    scene = known_scene(copies=("a", "b", "b", "c"), scans=scans)
    last = scans - 1
    rows = {n: dict.fromkeys(range(scans), n) for n in range(4)}
    copies = rows | {1: rows[1] | {last: 2}, 2: rows[2] | {last: 1}}
    assert value([temporal_records(scene, followed(scene, copies))], "t_map") == 1
    others = rows | {0: rows[0] | {last: 3}, 3: rows[3] | {last: 0}}
    record = temporal_records(scene, followed(scene, others))
    assert (
        value([record], "t_map") == value([record], "t_ap50") == pytest.approx(1 / 2 * 1 / 2)
    )  # recall · precision
    sure = temporal_records(scene, followed(scene, others, [0.5, 1, 1, 0.5]))
    assert value([sure], "t_map") == pytest.approx(1 / 2)  # the wrong ones come last: recall alone
    assert value([sure], "ap50") == (pytest.approx(1 / 2) if scans == 2 else 1)  # one scan of five is too few


def test_a_copy_is_found_once():
    """Both tracks end in copies of one another; a third one says of an instance of another kind that it is one."""
    scene = known_scene(copies=("a", "a", "b"), scans=2)
    tracks = followed(scene, {0: {0: 0, 1: 1}, 1: {0: 1, 1: 0}, 2: {0: 2}})
    record = temporal_records(scene, tracks)
    assert [row[1] for row in record["t_ap50"]] == [1, 1, 0, 0, 0, 0]
    twice = [*tracks, tracks[0]]  # more tracks than copies
    assert [row[1] for row in temporal_records(scene, twice)["t_ap50"]].count(1) == 2


def test_what_came_or_went_is_right_in_the_scans_that_have_it_alone():
    scene = without(known_scene(scans=2), 3, 1)
    assert value([temporal_records(scene, true_tracks(scene))], "t_map") == 1
    missed = followed(scene, {0: {0: 0, 1: 0}, 1: {0: 1, 1: 1}, 2: {0: 2}, 3: {1: 2}, 4: {0: 3}})
    record = temporal_records(scene, missed)
    assert [row[1] for row in record["t_ap50"]][:5] == [1, 1, 0, 0, 1]


def test_scenes_are_put_together_before_the_curve_is_drawn():
    """A sure error in one scene stands before the unsure success of another; their mean would be 1/2."""
    scene = known_scene(copies=("a",), scans=2)
    right = temporal_records(scene, followed(scene, {0: {0: 0, 1: 0}}, [0.2]))
    wrong = temporal_records(scene, followed(scene, {0: {0: 0}}, [0.9]))
    assert value([right], "t_map") == 1 and value([wrong], "t_map") == 0
    assert value([right, wrong], "t_map") == pytest.approx(1 / 2 * 1 / 2)
    figure = Figure(name="t", key="t_map", statistic="average_precision", scale=100)
    row = figure_row(figure, {"r": [right], "w": [wrong], "none": [{"other": 1}]}, "m", "all")
    assert row is not None and (row.value, row.count, row.failures) == (pytest.approx(25), 2, 0)
    assert row.ci95 == (0, 100)


def test_a_record_that_was_stored_says_the_same():
    """JSON has null for what is no prediction."""
    rows = ap_rows(np.array([0.5]), np.array([[0.7, 0.0]]), THRESHOLDS)
    assert rows[1] == [None, *[0.0] * 10]
    assert ap_of_rows(np.array(rows, float)) == pytest.approx(1 / 2 * 5 / 10)  # 0.5, 0.55 … 0.7: five of ten
    assert np.isnan(ap_of_rows(np.array(rows[:1], float)))


# --- masks ------------------------------------------------------------------------------------------------------


def test_truth_is_of_the_masks_before_they_were_damaged():
    """A track that has the damaged mask is as right as that mask is: 3/4 of each object's points."""
    scene = known_scene(copies=("a", "b"), scans=2)
    eroded = with_masks(scene, DAMAGES["eroded"])
    found = temporal_records(eroded, true_tracks(eroded))
    assert value([found], "t_ap50") == 1
    assert value([found], "t_map") == pytest.approx(6 / 10)  # 0.5 to 0.75
    assert value([temporal_records(eroded.first_scans(1), true_tracks(eroded.first_scans(1)))], "t_ap50") == 1


def test_mended_masks_are_those_of_the_track_up_to_rounding():
    """One mask divided between two tracks, points there and back under a pose; the halves of it are told apart."""
    scene = known_scene(copies=("a", "b"), scans=1)
    merged = with_masks(scene, DAMAGES["merged"])
    assert len(merged.scans[0].instances) == 1
    id_ = merged.scans[0].instances[0].id
    track = Track(instance={0: id_}, T_track_scan={0: np.eye(4)}, points=np.zeros((1, 3)))
    T = np.array([[0, -1.0, 0, 300], [1, 0, 0, 7], [0, 0, 1, 0.1], [0, 0, 0, 1]])
    clouds = [scene.instance(0, o.instance[0]).points for o in scene.objects]
    moved = [(c @ T[:3, :3].T + T[:3, 3] - T[:3, 3]) @ T[:3, :3] for c in clouds]
    halves = [dataclasses.replace(track, seen={0: c}) for c in moved]
    assert value([temporal_records(merged, halves)], "t_map") == 1
    assert value([temporal_records(merged, [track])], "t_ap50") == pytest.approx(
        1 / 2
    )  # half the union: at 0.5
    assert with_mended_masks(merged, [track])[1] == [track]  # a mask of one track is left alone


def test_points_that_are_not_the_scans_are_refused():
    scene = known_scene(scans=1)
    (track, *_) = true_tracks(scene)
    off = dataclasses.replace(track, seen={0: np.full((5, 3), 99.0)})
    with pytest.raises(ValueError, match="5 of a track's 5 points"):
        masks_of(scene, [off], scene.true_masks())


def test_without_true_masks_nothing_is_said():
    scene = known_scene(scans=2)
    unknown = dataclasses.replace(scene, objects=scene.objects[1:])
    assert unknown.true_masks() is None
    assert temporal_records(unknown, true_tracks(unknown)) == {}
    damaged = with_masks(unknown, DAMAGES["merged"])
    assert temporal_records(damaged, []) == {}


def test_in_rooms_as_a_person_scans_them_the_truth_is_of_vertices(tmp_path):
    """Masks that a network drew badly are not the truth; objects that a scan does not show have none in it."""
    scene = known_scene(copies=("a", "b"), scans=1)
    points = np.concatenate([i.points for i in scene.scans[0].instances]).astype(np.float32)
    file = tmp_path / "scan_0.ply"
    write_points(file, points, np.repeat([1, 2], 200), "instance")
    owner = np.where(np.arange(400) < 150, 1, np.where(np.arange(400) < 390, 0, -1)).astype(np.int16)
    np.savez(file.with_suffix(".truth.npz"), owner=owner, object=np.array(["object_1", "object_0"]))
    scan = dataclasses.replace(scene.scans[0], source=str(file))
    found = vertices_of(0, scan, scene.objects)
    np.testing.assert_array_equal(found["object_0"], points[:150].astype(np.float64))
    np.testing.assert_array_equal(found["object_1"], points[150:390].astype(np.float64))
    assert set(vertices_of(1, scan, scene.objects)) == set()
    np.savez(file.with_suffix(".truth.npz"), owner=owner[1:], object=np.array(["object_1"]))
    with pytest.raises(ValueError, match="400 vertices"):
        vertices_of(0, scan, scene.objects)


def test_tracks_of_a_living_scene_have_their_points_as_scanned_and_their_least_sure_score():
    """Matches are worth 0.9 there, and that object 2 went 0.8; of what moved, the probability is another matter."""
    scene = living_scene()
    assert [t.score for t in tracks_of(scene)] == [0.9, 0.9, 0.8, 0.9, 0.9]
    unsure = dataclasses.replace(scene.changes[0], probability={"object_001": 0.5, "object_003": 0.7})
    scene = dataclasses.replace(scene, changes=(unsure, scene.changes[1]))
    assert [t.score for t in tracks_of(scene)] == [0.9, 0.9, 1.0, 0.7, 0.9]
    for o, track in zip(scene.objects, tracks_of(scene), strict=True):
        assert set(track.seen) == set(track.instance) == {s.scan for s in o.observations}
        for s in o.observations:
            back = track.seen[s.scan] @ s.T_ref_scan[:3, :3].T + s.T_ref_scan[:3, 3]
            np.testing.assert_allclose(back, o.points[o.point_scan == s.scan], atol=1e-9)


def test_the_program_reports_all_three_and_a_method_that_failed_has_none_right():
    scene = known_scene(scans=2)

    def fails(_):
        raise ValueError("no usable instance")

    found = {"good": true_tracks, "bad": fails}
    records = [r for n, m in found.items() for r in records_of(scene, n, m, 5.0, 10)]
    rows = {(r.method, r.name): r for r in rows_of(figures(), {scene.name: records})}
    for name in ("t-mAP", "t-AP50", "AP50, scans pooled"):
        assert (rows["good", name].value, rows["bad", name].value) == (100, 0)
        assert rows["good", name].count == rows["bad", name].count == 4
