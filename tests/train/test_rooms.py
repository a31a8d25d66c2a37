"""Rooms visited several times: what the truth says is where the points lie; roles, occlusion, determinism."""

import dataclasses
from itertools import combinations

import numpy as np
import point_cloud_utils as pcu
import pytest
import trimesh
from places import DATA

from train.furniture.collections import read_meshes
from train.furniture.symmetry import yaw_symmetry
from train.rooms.ray_scanner import (
    PlacedMesh,
    SensorConfig,
    camera_poses,
    footprint_radius,
    free_spot,
    scan_room,
)
from train.rooms.visits import FlyingConfig, FlyingScene, TrueObject, arrange, flying_scene

UNSEEN = DATA / "unseen_furniture.npz"
NAMES = ("chair_079", "chair_079", "table_134", "couch_112", "shelves_039", "stool_168")
SENSOR = SensorConfig(width=120, height=90)
SPARSE = FlyingConfig(static=1, removed=1, added=1, sensor=SENSOR, fewest_points=100)


def room(config: FlyingConfig = SPARSE, seed: int = 0) -> FlyingScene:
    meshes = {m.name: m for m in read_meshes(UNSEEN)}
    return flying_scene([meshes[n] for n in NAMES], config, np.random.default_rng(seed))


@pytest.fixture(scope="module")
def sparse() -> FlyingScene:
    return room()


def observed(scene: FlyingScene, o: TrueObject, scan: int) -> np.ndarray:
    (points,) = [i.points for i in scene.scans[scan].instances if i.id == o.instance[scan]]
    return points


def off_surface(o: TrueObject, T_scan_model: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Distance of the points from the model's mesh at that pose."""
    vertices = o.vertices @ T_scan_model[:3, :3].T + T_scan_model[:3, 3]
    return pcu.closest_points_on_mesh(np.ascontiguousarray(points), vertices, o.faces.astype(np.int64))[0]


def test_true_poses_put_models_on_the_points(sparse: FlyingScene):
    for o in sparse.objects:
        for scan, T in o.T_scan_model.items():
            distance = off_surface(o, T, observed(sparse, o, scan))
            assert np.quantile(distance, 0.5) < 0.03  # noise at 5 m has a standard deviation of 4 cm
            assert np.quantile(distance, 0.99) < 0.15
            R = T[:3, :3]
            np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)
            np.testing.assert_allclose(R[2], [0, 0, 1], atol=1e-9)
            assert T[2, 3] == 0


def test_objects_do_not_overlap(sparse: FlyingScene):
    for scan in range(3):
        present = [o for o in sparse.objects if scan in o.instance]
        for a, b in combinations(present, 2):
            apart = np.linalg.norm((a.T_scan_model[scan] - b.T_scan_model[scan])[:2, 3])
            assert apart > footprint_radius(a.vertices) + footprint_radius(b.vertices)
        for o in present:
            reach = np.abs(o.T_scan_model[scan][:2, 3]) + footprint_radius(o.vertices)
            assert (reach <= np.array(SPARSE.room_m) / 2 + 1e-9).all()


def test_roles_are_kept(sparse: FlyingScene):
    everywhere = [o for o in sparse.objects if set(o.instance) == {0, 1, 2}]
    removed = [o for o in sparse.objects if 0 in o.instance and 2 not in o.instance]
    added = [o for o in sparse.objects if 0 not in o.instance and 2 in o.instance]
    assert (len(everywhere), len(removed), len(added)) == (4, 1, 1)
    shifts = [
        [np.linalg.norm((o.T_scan_model[k] - o.T_scan_model[k + 1])[:2, 3]) for k in (0, 1)]
        for o in everywhere
    ]
    still = [max(s) == 0 for s in shifts]
    assert sum(still) == 1
    assert all(min(s) > 0.3 for s, stays in zip(shifts, still, strict=True) if not stays)
    assert [o.model for o in sparse.objects].count("chair_079") == 2


def test_instance_ids_tell_nothing_from_scan_to_scan(sparse: FlyingScene):
    for scan in sparse.scans:
        ids = [i.id for i in scan.instances]
        assert ids == list(range(1, len(ids) + 1))
    constant = [len(set(o.instance.values())) == 1 for o in sparse.objects]
    assert not all(constant)
    labels = {(s, i.id): i.label for s, scan in enumerate(sparse.scans) for i in scan.instances}
    assert all(labels[s, i] == o.category for o in sparse.objects for s, i in o.instance.items())


def test_a_seed_decides_alone(sparse: FlyingScene):
    again, other = room(), room(seed=1)
    for one, same in zip(sparse.scans, again.scans, strict=True):
        np.testing.assert_array_equal(one.background, same.background)
        for a, b in zip(one.instances, same.instances, strict=True):
            np.testing.assert_array_equal(a.points, b.points)
    assert len(other.scans[0].background) != len(sparse.scans[0].background)


def test_paper_regime_is_clean_and_sees_from_above():
    scene = room(FlyingConfig(regime="paper", scans=2))
    for o in scene.objects:
        points = observed(scene, o, 1)
        assert off_surface(o, o.T_scan_model[1], points).max() < 1e-4
        assert points[:, 2].max() > 0.99 * o.vertices[:, 2].max()
    assert all(len(scan.background) == 0 for scan in scene.scans)


def test_free_orientations_touch_the_floor_and_tilt():
    scene = room(FlyingConfig(regime="paper", scans=1, free=True, room_m=(14, 14), fewest_points=100))
    for o in scene.objects:
        T = o.T_scan_model[0]
        assert (o.vertices @ T[2, :3] + T[2, 3]).min() == pytest.approx(0, abs=1e-9)
        assert np.linalg.det(T[:3, :3]) == pytest.approx(1)
    assert min(o.T_scan_model[0][2, 2] for o in scene.objects) < 0.9


def test_refusals():
    meshes = list(read_meshes(UNSEEN))[:2]
    rng = np.random.default_rng(0)
    with pytest.raises(ValueError, match="2 models for 3 static"):
        flying_scene(meshes, SPARSE, rng)
    with pytest.raises(ValueError, match="0 models"):
        flying_scene([], FlyingConfig(), rng)
    with pytest.raises(ValueError, match="needed more room"):
        flying_scene(meshes, FlyingConfig(room_m=(0.5, 0.5)), rng)
    with pytest.raises(ValueError, match="fewer than 1000000 points"):
        flying_scene(meshes, FlyingConfig(scans=1, fewest_points=1_000_000, sensor=SENSOR), rng)
    with pytest.raises(ValueError, match=r"no free spot of radius 1\.00"):
        free_spot(rng, 1.0, [(0.0, 0.0, 3.0)], (4.0, 4.0))


def test_arranging_keeps_static_objects_and_bounds_how_far_others_go():
    boxes = {n: np.asarray(trimesh.creation.box((0.4, 0.4, 0.4)).vertices) for n in "abc"}
    rng = np.random.default_rng(0)
    before = arrange(boxes, {}, {"a"}, (5, 5), rng)
    after = arrange(boxes, before, {"a"}, (5, 5), rng, moved_m=(1.0, 1.5))
    np.testing.assert_array_equal(after["a"], before["a"])
    for n in "bc":
        assert 1.0 < np.linalg.norm((after[n] - before[n])[:2, 3]) < 1.5
    assert arrange({}, before, {"a"}, (5, 5), rng) == {}


# --- the sensor ---------------------------------------------------------------------------------------------


def placed(extents: tuple[float, float, float], x: float, y: float) -> PlacedMesh:
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]]
    pose[:2, 3] = x, y
    box = trimesh.creation.box(extents)
    vertices = np.asarray(box.vertices) + np.array([0, 0, extents[2] / 2])
    return PlacedMesh(model="box", vertices=vertices, faces=np.asarray(box.faces), T_room_model=pose)


def test_an_enclosed_object_is_never_seen():
    hidden, cover = placed((0.5, 0.5, 0.5), 0, 0), placed((1, 1, 1), 0, 0)
    _, alone = scan_room([hidden], (5, 5), SENSOR, np.random.default_rng(0))
    _, both = scan_room([hidden, cover], (5, 5), SENSOR, np.random.default_rng(0))
    assert (alone == 0).sum() > 100
    assert (both == 0).sum() == 0
    assert (both == 1).sum() > 100


def test_noise_dropout_and_grazing_rays():
    thing = [placed((1, 1, 0.5), 0, 0)]
    clean = dataclasses.replace(SENSOR, noise_m=0.0, noise_per_m2=0.0, dropout=0.0)

    def scan(config: SensorConfig) -> tuple[np.ndarray, np.ndarray]:
        return scan_room(thing, (5, 5), config, np.random.default_rng(0))

    points, owner = scan(clean)
    np.testing.assert_allclose(points[owner < 0][:, 2], 0, atol=1e-5)
    fewer, _ = scan(dataclasses.replace(clean, dropout=0.25))
    assert len(fewer) / len(points) == pytest.approx(0.75, abs=0.02)
    noisy, owner = scan(dataclasses.replace(clean, noise_m=0.01))
    assert 0.003 < noisy[owner < 0][:, 2].std() < 0.01  # along the ray, which meets the floor at a slant
    steep, _ = scan(dataclasses.replace(clean, grazing_deg=40.0))
    assert len(steep) < 0.8 * len(points)


def test_cameras_stand_around_the_furniture_at_head_height_and_look_across_it():
    poses = camera_poses((5, 4), SENSOR, np.random.default_rng(0))
    for eye, forward in poses:
        assert eye[2] == SENSOR.height_m
        assert np.linalg.norm(forward) == pytest.approx(1)
        middle = eye + forward * (SENSOR.height_m - 0.45) / -forward[2]  # where it looks, at seat height
        assert (np.abs(middle[:2]) <= [0.75 + 1e-9, 0.6 + 1e-9]).all()
    angles = np.sort([np.arctan2(eye[1] / 4, eye[0] / 5) for eye, _ in poses])
    assert np.diff(angles).max() < 2 * 2 * np.pi / SENSOR.cameras


# --- symmetry -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("shape", "order"),
    [
        (trimesh.creation.cylinder(radius=0.3, height=1, sections=64), 0),
        (trimesh.creation.box((1, 1, 0.5)), 4),
        (trimesh.creation.box((1, 0.5, 0.5)), 2),
    ],
)
def test_symmetry_of_solids(shape: trimesh.Trimesh, order: int):
    assert yaw_symmetry(np.asarray(shape.vertices), np.asarray(shape.faces)) == order


def test_symmetry_of_furniture():
    order = {m.name: yaw_symmetry(m.vertices, m.faces) for m in read_meshes(UNSEEN)}
    expected = {"chair_079": 1, "couch_112": 1, "table_134": 2, "stool_168": 4, "dustbin_115": 0}
    assert {name: order[name] for name in expected} == expected


def test_one_model_stands_alone():
    (mesh,) = [m for m in read_meshes(UNSEEN) if m.name == "desk_075"]
    scene = flying_scene([mesh], FlyingConfig(scans=1, sensor=SENSOR), np.random.default_rng(0))
    assert [len(s.instances) for s in scene.scans] == [1]
