"""Rooms tilted against gravity: by exactly that much, and everything in them alike."""

import dataclasses

import numpy as np
import pytest
from known_scenes import known_scene, pose

from eval.data.tilted import leveled_scans, tilted
from eval.scores.tracks import Track, score_tracks
from more2_jax.geometry.poses import apply_pose

SCENE = known_scene(copies=("a", "b", "c"), scans=2)


def up_of(scene, k, n=0):
    return scene.objects[n].T_scan_model[k][:3, 2]


@pytest.mark.parametrize("before", [0.0, 3.0])
@pytest.mark.parametrize("tilt_deg", [0.0, 5.0])
def test_up_is_so_many_degrees_off_z_however_a_scan_lay_before(before, tilt_deg):
    T = pose(before, [1.0, 0.0, 0.0], axis="x")
    turned = dataclasses.replace(
        SCENE,
        objects=tuple(
            dataclasses.replace(o, T_scan_model={k: T @ P for k, P in o.T_scan_model.items()})
            for o in SCENE.objects
        ),
    )
    found = tilted(turned, tilt_deg)
    off = [np.linalg.norm(up_of(found, k, n)[:2]) for k in range(2) for n in range(3)]
    np.testing.assert_allclose(off, np.sin(np.deg2rad(tilt_deg)), atol=1e-9)
    if tilt_deg:
        ways = [up_of(found, k)[:2] / np.linalg.norm(up_of(found, k)[:2]) for k in range(2)]
        assert ways[0] @ ways[1] < 0.999  # each another way


def test_points_and_truth_turn_alike():
    whole = dataclasses.replace(SCENE, true_points=SCENE.true_masks())
    found = tilted(whole, 5.0)
    for o, old in zip(found.objects, whole.objects, strict=True):
        for k in range(2):
            model = [
                s.instance(k, i).points @ np.linalg.inv(T)[:3, :3].T + np.linalg.inv(T)[:3, 3]
                for s, i, T in (
                    (found, o.instance[k], o.T_scan_model[k]),
                    (whole, old.instance[k], old.T_scan_model[k]),
                )
            ]
            np.testing.assert_allclose(*model, atol=1e-9)
            np.testing.assert_allclose(found.true_points[k][o.name], found.instance(k, o.instance[k]).points)
            assert np.abs(found.true_points[k][o.name] - whole.true_points[k][o.name]).max() > 0.01
    poses = [o.T_scan_model for o in found.objects]
    tracks = [
        Track(
            instance=o.instance,
            T_track_scan={k: np.linalg.inv(T) for k, T in P.items()},
            points=np.zeros((1, 3)),
        )
        for o, P in zip(found.objects, poses, strict=True)
    ]
    assert all(r["mr.strict"] == 1 for r in score_tracks(found, tracks, 5.0, 10))


def test_things_in_any_orientation_have_no_tilt():
    fallen = dataclasses.replace(
        SCENE.objects[1], T_scan_model={k: pose(90, [0, 0, 0], axis="x") for k in range(2)}
    )
    scene = dataclasses.replace(SCENE, objects=(SCENE.objects[0], fallen, SCENE.objects[2]))
    with pytest.raises(ValueError, match="no common up of its objects; needed upright rooms"):
        tilted(scene, 5.0)


def on_floor(scene):
    """The scene with a floor below and a wall beside it, as background of every scan."""
    rng = np.random.default_rng(0)
    floor = rng.uniform([-2, -2, -0.75], [10, 6, -0.75], (30_000, 3))
    wall = rng.uniform([-2, 6, -0.75], [10, 6, 1.8], (10_000, 3))
    background = np.concatenate([floor, wall])
    return dataclasses.replace(
        scene, scans=tuple(dataclasses.replace(s, background=background) for s in scene.scans)
    )


def test_scans_are_leveled_by_their_floors_and_the_truth_with_them():
    level = on_floor(SCENE)
    found = leveled_scans(tilted(level, 5.0))
    for k in range(2):
        assert np.linalg.norm(up_of(found, k)[:2]) < np.sin(np.deg2rad(0.5))
        for o, old in zip(found.objects, level.objects, strict=True):
            model = [
                apply_pose(np.linalg.inv(x.T_scan_model[k]), s.instance(k, x.instance[k]).points)
                for s, x in ((found, o), (level, old))
            ]
            np.testing.assert_allclose(*model, atol=1e-9)


def test_what_is_level_or_shows_no_floor_stays_as_it_is():
    assert leveled_scans(on_floor(SCENE)).scans[0].instances == on_floor(SCENE).scans[0].instances
    bare = tilted(SCENE, 5.0)
    assert leveled_scans(bare) is bare
