"""Regime `real`: the truth is true through frames, damage and absence; a seed decides alone; files are a user's."""

import dataclasses
import itertools
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import point_cloud_utils as pcu
import pytest
import trimesh
from hand_held_rooms import MODELS, made
from places import ROOT
from plyfile import PlyData

from more2_jax.geometry.poses import apply_pose
from more2_jax.scans.read_scan import read_scan
from train import synthesize
from train.furniture.collections import write_packed
from train.rooms import real_visits
from train.rooms.furnishing import MOVED_M, furnish, overlap
from train.rooms.mask_flaws import FOREIGN, LOST, MISSED, MIX, SMALLER, draw_flaws, predicted_masks
from train.rooms.mask_truth import LOST as NO_MASK
from train.rooms.mask_truth import Shown, shown_by
from train.rooms.real_files import write_real_scene
from train.rooms.real_visits import RealScene
from train.rooms.scene_files import read_scene
from train.rooms.visits import FlyingScene


@pytest.fixture(scope="module")
def scene() -> RealScene:
    return made()


@pytest.fixture(scope="module")
def folder(scene: RealScene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("real") / "scene_0000"
    write_real_scene(path, scene, {"seed": 1})
    return path


@pytest.fixture(scope="module")
def read(folder: Path) -> FlyingScene:
    return read_scene(folder)


def off_surface(o, T_scan_model: np.ndarray, points: np.ndarray) -> np.ndarray:
    vertices = apply_pose(T_scan_model, o.vertices)
    return pcu.closest_points_on_mesh(np.ascontiguousarray(points), vertices, o.faces.astype(np.int64))[0]


def test_true_poses_lay_models_onto_the_scan(read, scene):
    checked = 0
    for o in read.objects:
        for k, i in o.instance.items():
            (points,) = [s.points for s in read.scans[k].instances if s.id == i]
            assert np.median(off_surface(o, o.T_scan_model[k], points)) < 0.03
            checked += 1
    assert checked >= 6
    for k, T in enumerate(read.T_scan_room):
        np.testing.assert_allclose(T, scene.scans[k].T_scan_room)
        assert read.T_scan_camera[k].shape == (len(scene.T_room_camera[k]), 4, 4)
        for o in (o for o in read.objects if k in o.T_scan_model):
            upright = np.linalg.inv(T) @ o.T_scan_model[k]
            np.testing.assert_allclose(upright[:3, 2], [0, 0, 1], atol=1e-8)


def test_away_from_borders_masks_agree_with_the_nearest_surface(scene):
    for k, scan in enumerate(scene.scans):
        there = [o.name for o in scene.objects if k in o.T_scan_model]
        owner_of = np.full(scan.instance.max() + 1, -1)
        for name, shown in scene.shown[k].items():
            owner_of[shown.instance] = there.index(name)
        at_border = np.zeros(len(scan.owner), bool)
        at_border[scan.mesh.faces[np.ptp(scan.owner[scan.mesh.faces], axis=1) > 0]] = True
        right = owner_of[scan.instance] == scan.owner
        assert right[~at_border].mean() > 0.95
        assert right[~at_border & (scan.owner >= 0)].mean() > 0.85
        assert not right[at_border].all()  # pieces end where they end


def test_files_are_what_a_user_has(folder, scene):
    truth = json.loads((folder / "scene.json").read_text())
    for k, scan in enumerate(scene.scans):
        found = read_scan(folder / f"scan_{k}.ply")  # as `more2 run` reads it
        assert {i.id for i in found.instances} == set(np.unique(scan.instance[scan.instance > 0]).tolist())
        assert all(i.colors is not None for i in found.instances)
        elements = PlyData.read(str(folder / f"scan_{k}.ply"))
        names = elements["vertex"].data.dtype.names
        assert names == ("x", "y", "z", "nx", "ny", "nz", "red", "green", "blue", "instance")
        assert len(elements["face"].data) == len(scan.mesh.faces) > 1000
        normals = np.stack([elements["vertex"].data[n] for n in ("nx", "ny", "nz")], axis=-1)
        assert np.median(np.linalg.norm(normals, axis=1)) == pytest.approx(1, abs=1e-3)
        with np.load(folder / f"scan_{k}.truth.npz") as arrays:
            assert len(arrays["owner"]) == len(scan.owner)
        assert set(truth["scans"][k]["looked_at"]) >= {o.name for o in scene.objects if k in o.T_scan_model}
    assert truth["frames"] in ("own", "aligned")
    assert all({"instances", "visible"} <= set(r) for o in truth["objects"] for r in o["observations"])


def test_a_seed_decides_alone(scene, folder, tmp_path):
    digest = json.loads((folder / "scene.json").read_text())["digest"]
    assert write_real_scene(tmp_path / "again", made(), {"seed": 1}) == digest
    assert write_real_scene(tmp_path / "again", made(scans=1), {"seed": 1}) != digest


def test_what_is_gone_was_looked_at_and_what_is_skipped_was_not(monkeypatch):
    monkeypatch.setattr(real_visits, "SKIPPING", 1.0)
    skipped = [made(seed=s, scans=1) for s in (3, 4)]
    missed = [(room, o) for room in skipped for o in room.objects if 0 not in o.instance]
    assert missed
    assert all(room.looked_at[0][o.name] < 0.5 for room, o in missed)
    monkeypatch.setattr(real_visits, "SKIPPING", 0.0)
    monkeypatch.setattr(
        real_visits, "_roles", lambda *_: real_visits.FlyingConfig(scans=2, removed=3, static=2)
    )
    room = made(seed=5)
    gone = [o for o in room.objects if set(o.T_scan_model) == {0}]
    assert len(gone) == 3
    assert np.mean([room.looked_at[1][o.name] for o in gone]) > 0.5


def test_where_something_came_the_scan_before_had_looked_unless_it_skipped_that_part(monkeypatch):
    monkeypatch.setattr(
        real_visits, "_roles", lambda *_: real_visits.FlyingConfig(scans=2, added=3, static=2)
    )
    shares = {}
    for skipping in (0.0, 1.0):
        monkeypatch.setattr(real_visits, "SKIPPING", skipping)
        rooms = [made(seed=s) for s in (5, 6)]
        for room in rooms:
            came = {o.name for o in room.objects if set(o.T_scan_model) == {1}}
            assert len(came) == 3
            assert set(room.looked_at_next[0]) == came and room.looked_at_next[1] == {}
        shares[skipping] = [share for room in rooms for share in room.looked_at_next[0].values()]
    assert np.mean(shares[0.0]) > 0.5 > np.min(shares[1.0])


def test_furniture_stands_apart_and_what_moves_moves():
    vertices = {m.name: m.vertices - [0, 0, m.vertices[:, 2].min()] for m in MODELS}
    rng = np.random.default_rng(0)
    first = furnish(vertices, {}, [], (3.5, 3.2), rng)
    second = furnish(vertices, first, ["chair_0", "chair_1"], (3.5, 3.2), rng)
    for poses in (first, second):
        boxes = []
        for m in MODELS:
            placed = apply_pose(poses[m.name], vertices[m.name])
            assert (np.abs(placed[:, :2]) < np.array([3.5, 3.2]) / 2).all()
            boxes.append(trimesh.Trimesh(placed, m.faces))
        for a, b in itertools.combinations(boxes, 2):
            assert not a.contains(np.asarray(b.sample(200, seed=0))).any()
    moved = {n: np.linalg.norm((first[n] - second[n])[:2, 3]) for n in vertices}
    assert all((d == 0) if n in ("chair_0", "chair_1") else d >= MOVED_M for n, d in moved.items())
    with pytest.raises(ValueError, match=r"no place for 5 objects in 1\.0 × 1\.0 m; needed more room"):
        furnish(vertices, {}, [], (1.0, 1.0), rng)
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
    turned = np.array([[1.6, -0.1], [2.3, 0.6], [1.6, 1.3], [0.9, 0.6]])
    assert overlap(square, turned)
    assert not overlap(square, turned + [0.2, 0])
    assert overlap(square, turned + [0.2, 0], apart_m=0.2)


def test_free_objects_lie_any_way_on_the_floor():
    room = made(scans=1, free=True)
    upright = []
    for o in room.objects:
        T = np.linalg.inv(room.scans[0].T_scan_room) @ o.T_scan_model[0]
        assert apply_pose(T, o.vertices)[:, 2].min() == pytest.approx(0, abs=1e-6)
        upright.append(T[2, 2] > 0.99)
    assert not all(upright)


# --- masks -------------------------------------------------------------------------------------------------


def row_of_boxes(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Points on three boxes in a row, 30 cm apart, over a floor; and whose each is."""
    rng = np.random.default_rng(seed)
    boxes = [rng.uniform(0, 1, (1500, 3)) * [0.6, 0.4, 0.8] + [0.9 * k, 0, 0.02] for k in range(3)]
    floor = rng.uniform(0, 1, (6000, 3)) * [4, 2, 0] - [0.7, 0.8, 0]
    return np.concatenate([*boxes, floor]), np.repeat([0, 1, 2, -1], [1500, 1500, 1500, 6000])


def shares(mask: np.ndarray, label: np.ndarray) -> dict[int, tuple[float, float]]:
    """By instance: share of the object's points that it has, and of its points that are not the object's."""
    result = {}
    for i in np.unique(mask[mask > 0]).tolist():
        owner = np.bincount(label[mask == i] + 1, minlength=4)[1:].argmax()
        own = (label[mask == i] == owner).sum()
        result[i] = own / (label == owner).sum(), 1 - own / (mask == i).sum()
    return result


@pytest.mark.parametrize("seed", range(4))
def test_flaws_do_what_they_say(seed):
    points, label = row_of_boxes(seed)
    rng = np.random.default_rng(seed)

    def masked(flaw):
        mask = predicted_masks(points, label, {0: "perfect", 1: flaw, 2: "perfect"}, rng)
        shown = shown_by(mask, label, 3, 64)
        return mask, shown, shares(mask, label)

    _, shown, share = masked("perfect")
    assert all(s == (1, 0) for s in share.values()) and len(share) == 3
    _, shown, share = masked("cut")
    assert LOST[0] - 0.01 <= 1 - share[shown[1].instance][0] <= LOST[1] + 0.01
    assert share[shown[0].instance] == (1, 0)
    _, shown, share = masked("dirty")
    assert FOREIGN[0] - 0.01 <= share[shown[1].instance][1] <= FOREIGN[1] + 0.01
    assert share[shown[1].instance][0] == 1
    _, shown, share = masked("split")
    assert len(shown[1].instances) == 2
    large, small = (share[i][0] for i in shown[1].instances)
    assert large + small == pytest.approx(1)
    assert SMALLER[0] - 0.01 <= small <= SMALLER[1] + 0.01
    _, shown, share = masked("merged")
    assert len(share) == 2
    (both,) = {s.instance for s in shown.values() if s.merged}
    assert [s.merged for s in shown.values()].count(True) == 1
    assert sum(s.instance == both for s in shown.values()) == 2
    mask, shown, share = masked("missed")
    assert shown[1].instance == NO_MASK and not mask[label == 1].any()
    assert sorted(share) == sorted(shown[k].instance for k in (0, 2)) and set(share.values()) == {(1, 0)}


def test_ids_tell_nothing_and_crumbs_are_no_instances():
    points, label = row_of_boxes()
    label = np.where(np.cumsum(label == 2) > 40, -1, label)
    ids = [predicted_masks(points, label, {}, np.random.default_rng(s)) for s in range(6)]
    assert {tuple(np.unique(i)) for i in ids} == {(0, 1, 2)}
    assert len({int(i[0]) for i in ids}) == 2
    assert not predicted_masks(points, np.full(len(points), -1), {}, np.random.default_rng(0)).any()


def test_the_mix_is_as_told_and_merges_once():
    rng = np.random.default_rng(0)
    drawn = [draw_flaws(7, "mix", rng) for _ in range(1500)]
    assert max(d.count("merged") for d in drawn) == 1
    for flaw in ("cut", "dirty", "split"):
        assert np.mean([d.count(flaw) / 7 for d in drawn]) == pytest.approx(MIX[flaw], abs=0.02)
    assert draw_flaws(3, "cut", rng) == ["cut"] * 3
    missed = [f for _ in range(500) for f in draw_flaws(7, "missed", rng)]
    assert set(missed) == {"perfect", "missed"}
    assert missed.count("missed") / len(missed) == pytest.approx(MISSED, abs=0.02)
    assert sorted(draw_flaws(3, "merged", rng)) == ["merged", "perfect", "perfect"]


def test_who_is_shown_by_what():
    """Objects: 0 split into 1 and 2; 1 whole within 3, which is mostly 2's; 3 in no mask; 4 hardly there."""
    owner = np.repeat([0, 1, 2, 3, 4, -1], [100, 60, 90, 70, 5, 50])
    mask = np.repeat([2, 1, 3, 3, 0, 0, 3, 0], [70, 30, 60, 90, 70, 5, 20, 30])
    assert shown_by(mask, owner, 5, fewest=64 - 10) == {
        0: Shown(instance=2, instances=(2, 1)),
        1: Shown(instance=3, instances=(3,), merged=True),
        2: Shown(instance=3, instances=(3,)),
        3: Shown(instance=-1, instances=()),
    }


# --- the program -------------------------------------------------------------------------------------------


def test_masks_are_of_regime_real_alone(tmp_path):
    def refusal(**settings) -> str:
        given = {"source": tmp_path / "none.npz", "regime": "real", "out": tmp_path / "x"} | settings
        with pytest.raises(ValueError) as raised:
            synthesize.main(synthesize.Settings(**given))
        assert "\n" not in str(raised.value)
        return str(raised.value)

    assert "masks 'mix' in regime paper" in refusal(regime="paper", masks="mix")
    assert "needed one of perfect, cut, dirty" in refusal(masks="holes")
    assert refusal(scans=0) == "0 scans for regime real; needed 1"
    assert "none.npz" in refusal(masks="cut")


@pytest.mark.slow
def test_any_number_of_workers_gives_the_same(tmp_path):
    more = [dataclasses.replace(m, name=f"{m.name}b", vertices=m.vertices * 0.9) for m in MODELS]
    write_packed(tmp_path / "chairs.npz", [*MODELS, *more])
    for out, workers in (("one", "1"), ("two", "2")):
        line = f"-m train.synthesize --source {tmp_path}/chairs.npz --regime real --masks mix --scenes 2 --scans 2"
        more_words = ["--out", str(tmp_path / out), "--cache", str(tmp_path / "models"), "--workers", workers]
        done = subprocess.run(
            [sys.executable, *line.split(), *more_words],
            cwd=ROOT,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
    one, two = (json.loads((tmp_path / out / "index.json").read_text()) for out in ("one", "two"))
    assert one == two
    room = read_scene(tmp_path / "one" / "scene_0001")
    assert (room.regime, len(room.scans)) == ("real", 2)
    assert 5 <= len(room.objects) <= 8
