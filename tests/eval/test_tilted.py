"""Rooms tilted against gravity: by exactly that much, and everything in them alike."""

import dataclasses

import numpy as np
import pytest
from known_scenes import known_scene, pose

from eval.data.tilted import tilted
from eval.scores.tracks import Track, score_tracks

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
