"""Changed shapes: the foot stays, a turned top stays rigid, a bend is as large as it says; truth and scores know."""

import numpy as np
import pytest
from hand_held_rooms import MODELS, made

from eval.data.flyingshape import known, read_open
from eval.registration import true_pairs
from eval.scores.tracks import Track, score_tracks
from more2_jax.geometry.poses import apply_pose
from train import synthesize
from train.furniture.collections import standing, write_packed
from train.rooms import real_visits
from train.rooms.changed_shape import BEND_M, HIP, JOINT, TURN_DEG, Bend, Turn, shape_change
from train.rooms.real_files import write_real_scene
from train.rooms.scene_files import read_scene
from train.rooms.visits import surface_samples

VERTICES = standing(MODELS[2].vertices)
POINTS = surface_samples(VERTICES, MODELS[2].faces)
HEIGHT = float(np.ptp(VERTICES[:, 2]))


def changes(kind: type) -> list:
    drawn = [shape_change(VERTICES, np.random.default_rng(seed)) for seed in range(40)]
    found = [c for c in drawn if isinstance(c, kind)]
    assert 10 < len(found) < 30
    return found


def test_a_top_turns_as_one_body_about_the_vertical_and_the_foot_stays():
    for turn in changes(Turn):
        after = turn(POINTS)
        np.testing.assert_allclose(after[:, 2], POINTS[:, 2])
        below = POINTS[:, 2] < HIP[0] * HEIGHT
        np.testing.assert_array_equal(after[below], POINTS[below])
        top = POINTS[:, 2] > (HIP[1] + JOINT) * HEIGHT
        angle = np.angle((after - np.append(turn.center, 0))[top, :2] @ [1, 1j])
        angle -= np.angle((POINTS - np.append(turn.center, 0))[top, :2] @ [1, 1j])
        turned = np.rad2deg(np.abs(np.angle(np.exp(1j * angle))))
        assert np.ptp(turned) < 1e-6
        assert TURN_DEG[0] - 1e-9 <= turned[0] <= TURN_DEG[1] + 1e-9


def test_a_bend_is_some_centimeters_smooth_and_leaves_the_foot():
    sizes = []
    for bend in changes(Bend):
        moved = np.linalg.norm(bend(POINTS) - POINTS, axis=1)
        assert np.abs(bend(POINTS * [1, 1, 0]) - POINTS * [1, 1, 0]).max() == 0
        near = POINTS + [0, 0, 1e-3]
        assert np.linalg.norm(bend(near) - bend(POINTS), axis=1).max() < 3e-3
        sizes.append(np.sqrt((moved[POINTS[:, 2] > 0.3 * HEIGHT] ** 2).mean()))
    assert 0.3 * BEND_M[0] < min(sizes) and max(sizes) < 2 * BEND_M[1]
    assert BEND_M[0] < np.median(sizes) < BEND_M[1]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("reshaped") / "scene_0000"
    write_real_scene(path, made(reshaped=0.4, seed=8), {"seed": 8})
    return path


def test_the_first_scan_shows_the_first_shape_and_files_keep_which_others_do_not(folder):
    scene = read_scene(folder)
    changed = [o for o in scene.objects if o.reshaped]
    assert 0 < len(changed) < len(scene.objects)
    assert all(o.reshaped <= {1} and 1 in o.T_scan_model for o in changed)
    truth = np.load(folder / "scan_1.truth.npz")
    off = {}
    for o in scene.objects:
        if 1 in o.instance:
            (points,) = [s.points for s in scene.scans[1].instances if s.id == o.instance[1]]
            surface = apply_pose(o.T_scan_model[1], surface_samples(o.vertices, o.faces))
            off[o.name] = np.linalg.norm(points[:, None] - surface[None], axis=2).min(axis=1).mean()
    assert set(off) <= set(truth["object"].tolist())
    assert max(off[o.name] for o in scene.objects if o.name in off and not o.reshaped) < 0.04
    assert max(off[o.name] for o in changed if o.name in off) > 0.04


def test_no_pose_is_asked_of_what_changed_its_shape(folder):
    scene = read_open(folder)
    tracks = [
        Track(
            instance=dict(o.instance),
            T_track_scan={k: np.linalg.inv(o.T_scan_model[k]) for k in o.instance},
            points=np.zeros((1, 3)),
            moved=dict(o.moved),
        )
        for o in scene.objects
    ]
    records = {r["object"]: r for r in score_tracks(scene, tracks, 5.0, 100, says_motion=True)}
    changed = {o.name for o in scene.objects if o.reshaped} & set(records)
    assert {p.object.name for p in true_pairs(scene)} == set(records) - changed
    assert changed and set(records) - changed
    for name, record in records.items():
        assert record["m.strict"] == 1
        assert ("mr.strict" in record) == ("told.strict" in record) == (name not in changed)
        assert record.get("mr.strict", 1.0) == 1


@pytest.mark.parametrize(
    ("option", "needed", "values"),
    [
        ("reshaped", "a share from 0 to 1", [("real", 1.5), ("real", -0.1), ("sparse", 0.4)]),
        ("noise", "a factor from 0", [("real", -1.0), ("real", np.inf), ("sparse", 2.0)]),
    ],
)
def test_other_values_and_regimes_are_refused(tmp_path, option, needed, values):
    source = tmp_path / "models.npz"
    write_packed(source, MODELS)
    for regime, value in values:
        settings = synthesize.Settings(source=source, regime=regime, out=tmp_path / "out", **{option: value})
        with pytest.raises(ValueError, match=f"{option} {value}, regime {regime}; needed {needed}"):
            synthesize.main(settings)


def test_without_the_option_nothing_is_drawn(monkeypatch):
    plain = made()
    monkeypatch.setattr(real_visits, "_changes", lambda room, config, rng: ({},) * config.scans)
    same = made()
    for a, b in zip(plain.scans, same.scans, strict=True):
        np.testing.assert_array_equal(a.mesh.vertices, b.mesh.vertices)
    assert all(not known(o).reshaped for o in plain.objects if o.instance)
