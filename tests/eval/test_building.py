"""A building is its rooms side by side: counts, places, ids, copies; and what is told of its memory."""

import numpy as np
import pytest

from eval.building import PITCH_M, Watch, building, filled, rows_of, spiral
from more2_jax.progress import Progress
from more2_jax.types import Instance, Scan
from train.rooms.visits import FlyingScene, TrueObject


def room(name, count):
    """Some objects at known places; the second scan shows the last one under another id, and one more."""
    rng = np.random.default_rng(len(name))
    clouds = [rng.uniform(-0.5, 0.5, (70, 3)) + [k, 0, 0] for k in range(count + 1)]

    def scan(ids):
        instances = tuple(Instance(id=i, points=clouds[k]) for k, i in enumerate(ids))
        return Scan(name=name, source=name, instances=instances, background=np.zeros((5, 3)))

    first, second = range(1, count + 1), [*range(1, count), 40, 41]
    objects = tuple(
        TrueObject(
            name=f"object_{k}",
            model="box",
            category="box",
            vertices=np.zeros((3, 3)),
            faces=np.zeros((1, 3), int),
            instance={0: first[k], 1: second[k]},
            T_scan_model={0: np.eye(4), 1: np.eye(4)},
        )
        for k in range(count)
    )
    return FlyingScene(scans=(scan(first), scan(second)), objects=objects, name=name)


def test_rooms_lie_side_by_side_and_repeat_until_there_are_enough_objects():
    (first, second), truth = building([room("a", 3), room("bb", 2)], 7)
    assert [i.id for i in first.instances] == list(range(1, 8))
    assert [i.id for i in second.instances] == list(range(1, 12))  # one more in each of three rooms
    assert len(first.background) == len(second.background) == 3 * 5
    shown = [{i.id: i.points for i in scan.instances} for scan in (first, second)]
    for (a, b), _ in truth:
        np.testing.assert_array_equal(shown[0][a], shown[1][b])
    assert len(truth) == 7 and len({a for (a, _), _ in truth}) == 7
    things = [thing for _, thing in truth]
    assert things == ["a/object_0", "a/object_1", "a/object_2", "bb/object_0", "bb/object_1", *things[:2]]
    again = shown[0][truth[5][0][0]] - shown[0][truth[0][0][0]]
    np.testing.assert_allclose(again, np.broadcast_to(spiral(2) * PITCH_M, again.shape), atol=1e-12)


def test_places_of_rooms_fill_a_square():
    places = np.array([spiral(n) for n in range(25)])
    assert sorted(map(tuple, places.astype(int))) == [(x, y, 0) for x in range(-2, 3) for y in range(-2, 3)]
    assert np.abs(places[:9]).max() == 1


def test_an_object_is_filled_up_near_its_own_points():
    own = Instance(id=3, points=np.random.default_rng(0).uniform(size=(50, 3)), normals=np.eye(3)[[2] * 50])
    more = filled(own, 400, np.random.default_rng(1))
    assert more.points.shape == more.normals.shape == (400, 3)
    np.testing.assert_array_equal(more.points[:50], own.points)
    gap = np.linalg.norm(more.points[50:, None] - own.points, axis=-1).min(axis=1)
    assert 0 < gap.max() < 0.02
    assert filled(own, 20, np.random.default_rng(1)).points.shape == (50, 3)


def test_no_rooms_are_refused():
    with pytest.raises(ValueError, match="0 rooms without objects"):
        building([], 3)


def test_a_size_is_told_by_its_sums_its_peak_and_its_share_of_right_pairs():
    size = {
        "objects": 8,
        "points": 900,
        "cpu_seconds": {"match": 2.0, "rest": 0.5},
        "peak_mb": {"match": 700.0, "rest": 650.0},
        "right": 6,
        "true": 8,
    }
    found = {r.name: (r.method, r.value, r.better) for r in rows_of(size)}
    assert found == {
        "points": ("8 objects", 900, "lower"),
        "processor time": ("8 objects", 2.5, "lower"),
        "peak memory": ("8 objects", 700.0, "lower"),
        "right pairs": ("8 objects", 75.0, "higher"),
    }


def test_a_peak_is_that_of_its_own_stage():
    watch = Watch()

    def tell(event, stage):
        watch(Progress(event=event, stage=stage, scan=None, done=0, total=1, unit="objects", seconds=0.0))

    tell("started", "match")
    held = np.ones(40_000_000)  # 320 MB
    del held
    tell("finished", "match")
    tell("started", "mesh")
    tell("finished", "mesh")
    assert watch.peak_mb["match"] > watch.peak_mb["mesh"] + 250
    assert set(watch.seconds) == {"rest", "match", "mesh"}
