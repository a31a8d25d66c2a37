"""Free space in front of what known sensors saw: definition, laws, what it decides, where the places come from."""

import dataclasses

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pieces
import pytest
from scipy.spatial.transform import Rotation

from eval.data.truth import KnownScene
from eval.harness.options import without_sensors
from eval.registration import own_settings, sight_in
from more2_jax.config import preset
from more2_jax.geometry.free_space import (
    PIXELS,
    VIEWS,
    clearance,
    looked_through,
    margin,
    padded_sights,
    sight_of,
    spread,
)
from more2_jax.geometry.observations import seen_from
from more2_jax.geometry.point_to_plane import whole_surface
from more2_jax.geometry.transform import rescale, transform
from more2_jax.registration.pose_costs import CLEARLY, free_space_cost
from more2_jax.scans.read_scan import read_scan
from more2_jax.scene import add_scan, start_scene
from more2_jax.storage.scene_folder import load_scene, save_scene
from more2_jax.tracking import relocalize
from more2_jax.tracking.accumulated import accumulated_object
from more2_jax.tracking.object_views import Views
from more2_jax.tracking.objects import seen_again
from more2_jax.types import Instance, Scan

EYE = np.array([0.0, -3.0, 0.5])
ROBUST = preset("robust", upright=True)
# Compiled: one by one, their operations would take longer.
clear_at, costs_of, surface_of = (
    jax.jit(clearance),
    jax.jit(free_space_cost, static_argnums=(3, 4)),
    jax.jit(whole_surface),
)


def grid(x, y, z):
    """Points of a box-shaped lattice."""
    return np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1).reshape(-1, 3)


# The face of a cube of 1 m at y = −0.5, a wall 1.5 m behind it; only the face is the object.
LINE = np.linspace(-0.5, 0.5, 81)
FACE = grid(LINE, [-0.5], LINE + 0.5)
WALL = grid(np.linspace(-2, 2, 161), [1.0], np.linspace(-1, 2, 121))
ROOM = np.concatenate([FACE, WALL])


@pytest.fixture(scope="module")
def sight():
    found = sight_of(FACE, ROOM, EYE[None])
    assert found is not None
    return found


def free_at(sight, points):
    device = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), sight)
    return np.asarray(clear_at(device, jnp.asarray(points, jnp.float32)))


def test_in_front_of_what_was_seen_space_is_free_by_the_way_that_is_left(sight):
    point = np.array([[0.1, -1.2, 0.6]])
    way = (point[0] - EYE) / np.linalg.norm(point[0] - EYE)
    depth = (-0.5 - EYE[1]) / way[1]  # where that ray meets the face
    left = depth - np.linalg.norm(point[0] - EYE)
    np.testing.assert_allclose(free_at(sight, point), left - margin(np.array(depth)), atol=0.03)


def test_at_and_behind_what_was_seen_nothing_is_known(sight):
    at, behind, far = FACE[::7], FACE[::7] + [0, 0.4, 0], FACE[::7] + [0, 3.0, 0]
    assert not free_at(sight, np.concatenate([at, behind, far])).any()


def test_beside_the_object_what_stands_behind_it_says_how_far_space_is_free(sight):
    beside = np.array([[0.57, -0.45, 0.5]])  # as far away as the face; its ray meets the wall alone
    assert free_at(sight, beside) > 1.0


def test_out_of_view_and_where_no_ray_met_anything_nothing_is_known(sight):
    assert not free_at(sight, np.array([[0.0, -4.0, 0.5], [30.0, -1.0, 0.5], [0.0, 0.0, 40.0]])).any()
    alone = sight_of(FACE, FACE, EYE[None])
    assert not free_at(alone, np.array([[0.57, -0.45, 0.5]])).any()


def test_the_margin_grows_with_the_square_of_the_distance():
    near, far = margin(np.array([1.0, 4.0]))
    assert far - near == pytest.approx(15 * (margin(np.array(1.0)) - margin(np.array(0.0))))


@pytest.mark.parametrize("seed", range(3))
def test_it_moves_with_its_frame(sight, seed):
    rng = np.random.default_rng(seed)
    T = pieces.pose(Rotation.random(random_state=seed), rng.normal(size=3))
    points = rng.uniform(-1.5, 1.5, (400, 3))
    here, there = free_at(sight, points), free_at(transform(sight, T), pieces.apply(T, points))
    same = np.abs(there - here) < 1e-3
    assert (here > 0).any() and same.mean() > 0.98  # but for points that lie on a pixel's edge
    near = rng.uniform([-0.4, -2.0, 0.1], [0.4, 0.9, 0.9], (400, 3))  # within the view, however it is turned
    anew = sight_of(*(pieces.apply(T, p) for p in (FACE, ROOM, EYE[None])))
    again, before = free_at(anew, pieces.apply(T, near)), free_at(sight, near)
    clearly = before > 0.1
    assert 100 < clearly.sum() < 300 and (again[clearly] > 0).all() and not again[near[:, 1] > -0.4].any()


def test_scaling_and_views_that_fill_up_change_nothing(sight):
    points = np.random.default_rng(0).uniform(-1.5, 1.5, (400, 3))
    origin = np.array([0.3, -0.2, 0.1])
    batch = padded_sights([None, sight], np.stack([np.zeros(3), origin]))
    blank, padded = (jax.tree.map(lambda x, k=k: x[k], batch) for k in range(2))
    assert padded.clear.shape == (VIEWS, PIXELS, PIXELS)
    np.testing.assert_allclose(free_at(padded, points - origin), free_at(sight, points), atol=1e-3)
    assert not free_at(blank, points).any()
    doubled = free_at(rescale(padded, jnp.float32(2.0)), 2 * (points - origin))
    np.testing.assert_allclose(doubled, 2 * free_at(padded, points - origin), atol=1e-3)
    assert padded_sights([None, None], np.zeros((2, 3))) is None


def test_of_many_sensors_those_all_around_are_asked():
    ring = [np.array([np.cos(a), np.sin(a), 1.0]) for a in np.deg2rad([*range(10), 90, 180, 270])]
    kept = spread(ring, np.zeros(3))
    assert len(kept) == len(set(kept)) == VIEWS and {10, 11, 12} <= set(kept)
    assert spread(ring[:3], np.zeros(3)) == [0, 1, 2]


@pytest.mark.parametrize(
    "cloud", [FACE[:1], np.repeat(FACE[:1], 50, axis=0), FACE[:2], FACE[FACE[:, 0] == 0.0]]
)
def test_few_doubled_and_flat_points_have_a_view(cloud):
    found = sight_of(cloud, np.concatenate([cloud, WALL]), EYE[None])
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(found))
    assert not free_at(found, cloud).any()


def test_a_sensor_inside_what_it_saw_has_no_view():
    ball = Rotation.random(200, random_state=0).apply([1.0, 0, 0])
    assert sight_of(ball, ball, np.zeros((1, 3))) is None
    assert sight_of(ball, ball, np.zeros((0, 3))) is None


def test_what_is_looked_through_is_a_share_of_real_points(sight):
    device = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), sight)
    points = jnp.array([[0.0, -2.0, 0.5], [0.0, 0.0, 0.5], [0.0, -2.0, 0.5]], jnp.float32)
    asked = jax.jit(looked_through, static_argnums=3)
    share = asked(device, points, jnp.array([True, True, False]), CLEARLY)
    assert float(share) == pytest.approx(0.5)
    assert float(asked(device, points, jnp.zeros(3, bool), CLEARLY)) == 0


# --- registration -------------------------------------------------------------------------------------------


def surfaces_of(points):
    cloud = jnp.asarray(points, jnp.float32)
    return surface_of(cloud, jnp.ones(len(cloud), bool))


def on_the_device(sight):
    """As one row of a batch has it."""
    batch = padded_sights([sight], np.zeros((1, 3)))
    return jax.tree.map(lambda x: jnp.asarray(x[0]), batch)


def test_a_pose_in_front_of_what_was_seen_costs_and_the_right_one_does_not(sight):
    still = jaxlie.SE3.identity()
    nearer = jaxlie.SE3.from_translation(jnp.array([0.0, -0.3, 0.0]))
    poses = jax.tree.map(lambda *x: jnp.stack(x), still, nearer)
    face, search, seen = surfaces_of(FACE[::20]), ROBUST.registration.search, on_the_device(sight)
    right, wrong = costs_of(poses, (face, face), (None, seen), search, "upright")
    assert right < 0.05 * search.free_weight and wrong > 0.45 * search.free_weight
    _, back = costs_of(
        jax.jit(jax.vmap(jaxlie.SE3.inverse))(poses), (face, face), (seen, None), search, "upright"
    )
    assert float(back) == pytest.approx(float(wrong), abs=1e-5)
    silent = dataclasses.replace(search, free_weight=0.0)
    for sights, settings, motion in (
        ((None, None), search, "upright"),
        ((None, seen), silent, "upright"),
        ((None, seen), search, "free"),
    ):
        assert not costs_of(poses, (face, face), sights, settings, motion).any()


def test_robust_asks_for_it():
    assert ROBUST.registration.search.free_weight > 0


# --- scenes -------------------------------------------------------------------------------------------------


def scan_of(name, shift, sensors):
    cube = pieces.surface(pieces.without_symmetry()[0], 400) + [0, 0, 1.0]
    other = pieces.surface(pieces.without_symmetry()[1], 400) + [3.0, 0, 1.0]
    instances = tuple(Instance(id=k, points=p) for k, p in ((1, cube + shift), (2, other)))
    return Scan(name=name, source=name, instances=instances, background=WALL + [0, 2.0, 0], sensors=sensors)


class Asked(Exception):
    """Stops a scene where registration would begin."""


@pytest.fixture
def sights_asked(monkeypatch):
    """What registration is given, instead of registering."""
    given = []

    def register(prior, pairs, *_):
        given.append((pairs.source.sight, pairs.target.sight))
        raise Asked

    monkeypatch.setattr(relocalize, "register", register)
    return given


def test_registration_is_told_by_a_scene_in_memory_and_by_a_saved_one(tiny_prior, tmp_path, sights_asked):
    config = dataclasses.replace(ROBUST, matching=preset("paper").matching)
    sensors = np.array([[0.0, -4.0, 1.5], [1.0, -4.0, 1.5]])
    first = start_scene(tiny_prior, scan_of("a", np.zeros(3), sensors), config)
    save_scene(first, tmp_path / "scene", config)
    again, _ = load_scene(tmp_path / "scene")
    np.testing.assert_array_equal(again.scans[0].sensors, sensors)
    second = scan_of("b", np.array([0.2, 0.1, 0.0]), sensors)
    for scene in (first, again):
        with pytest.raises(Asked):
            add_scan(tiny_prior, scene, second, config)
    (here, there), saved = sights_asked
    assert (here.clear > 0).any() and (there.clear > 0).any()
    for one, other in zip(jax.tree.leaves((here, there)), jax.tree.leaves(saved), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-5)


def test_without_sensors_registration_is_told_nothing(tiny_prior, sights_asked):
    config = dataclasses.replace(ROBUST, matching=preset("paper").matching)
    nowhere = np.zeros((0, 3))
    scene = start_scene(tiny_prior, scan_of("a", np.zeros(3), nowhere), config)
    with pytest.raises(Asked):
        add_scan(tiny_prior, scene, scan_of("b", np.zeros(3), nowhere), config)
    assert sights_asked == [(None, None)]


def test_an_objects_views_are_of_all_that_make_up_its_shape(tiny_prior):
    sensors = np.array([[0.0, -4.0, 1.5]])
    scans = [scan_of("a", np.zeros(3), sensors), scan_of("b", np.array([0.5, 0.0, 0.0]), sensors)]
    scene = start_scene(tiny_prior, scans[0], ROBUST)
    T = pieces.pose(Rotation.identity(), np.array([-0.5, 0.0, 0.0]))
    seen = dataclasses.replace(scene.objects[0].observations[0], scan=1, T_ref_scan=T)
    twice = seen_again(scene.objects[0], scans[1].instances[0], seen)
    records = (*scene.scans, dataclasses.replace(scene.scans[0], index=1))
    (both,) = Views([twice], records).of_objects()
    np.testing.assert_allclose(both.eye, [[0.0, -4.0, 1.5], [-0.5, -4.0, 1.5]])
    doubted = seen_again(
        scene.objects[0], scans[1].instances[0], dataclasses.replace(seen, accumulated=False)
    )
    (one,) = Views([doubted], records).of_objects()
    np.testing.assert_allclose(one.eye, sensors)
    count = len(doubted.points) // 2
    np.testing.assert_allclose(
        seen_from(accumulated_object(doubted, records)), np.tile(sensors, (count, 1, 1))
    )
    places = seen_from(accumulated_object(twice, records))
    np.testing.assert_allclose(places[[0, count - 1], 0], [[0.0, -4.0, 1.5]] * 2)
    np.testing.assert_allclose(places[[count, -1], 0], [[-0.5, -4.0, 1.5]] * 2)


def test_a_scan_without_sensors_leaves_its_points_without_places(tiny_prior):
    three = np.array([[0.0, -4.0, 1.5], [1.0, -4.0, 1.5], [2.0, -4.0, 1.5]])
    scene = start_scene(tiny_prior, scan_of("a", np.zeros(3), three), ROBUST)
    o, records = scene.objects[0], scene.scans
    unknown = dataclasses.replace(records[0], index=1, sensors=np.zeros((0, 3)))
    again = dataclasses.replace(o.observations[0], scan=1)
    both = seen_again(o, Instance(id=1, points=o.points), again)
    places = seen_from(accumulated_object(both, (*records, unknown)))
    assert places.shape == (len(both.points), 3, 3)
    assert np.isfinite(places[both.point_scan == 0]).all() and np.isnan(places[both.point_scan == 1]).all()
    assert seen_from(accumulated_object(o, (unknown,))) is None


# --- where the places come from -----------------------------------------------------------------------------


def save_npz(path, **more):
    points = np.random.default_rng(0).uniform(0, 1, (200, 3))
    np.savez(path, points=points, instance=np.ones(200, int), **more)
    return path


def test_npz_says_where_sensors_stood_in_its_unit(tmp_path):
    places = np.array([[1.0, 2, 3], [4, 5, 6]])
    cameras = np.tile(np.eye(4), (2, 1, 1))
    cameras[:, :3, 3] = places
    for more in ({"sensors": places}, {"T_scan_camera": cameras}):
        scan = read_scan(save_npz(tmp_path / "a.npz", **more), unit="cm")
        np.testing.assert_allclose(scan.sensors, places / 100)
    assert read_scan(save_npz(tmp_path / "a.npz")).sensors.shape == (0, 3)


def test_a_file_beside_the_scan_says_it_too_and_first(tmp_path):
    path = save_npz(tmp_path / "room.npz", sensors=np.zeros((1, 3)))
    (tmp_path / "room.sensors.txt").write_text("1 2 3\n\n4 5 6\n")
    np.testing.assert_allclose(read_scan(path).sensors, [[1, 2, 3], [4, 5, 6]])


@pytest.mark.parametrize("text", ["1 2\n3 4\n", "1 2 x\n", "1 2 3\n4 5\n", "nan 0 0\n", "", "\0\n"])
def test_a_file_that_names_no_places_is_refused_in_one_line(tmp_path, text):
    path = save_npz(tmp_path / "room.npz")
    (tmp_path / "room.sensors.txt").write_text(text)
    with pytest.raises(ValueError, match=r"room\.sensors\.txt: .*needed") as refused:
        read_scan(path)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("places", [np.zeros((2, 2)), np.zeros(3), np.full((1, 3), np.inf), np.array(["a"])])
def test_an_npz_with_other_places_is_refused_in_one_line(tmp_path, places):
    with pytest.raises(ValueError, match="needed"):
        read_scan(save_npz(tmp_path / "a.npz", sensors=places))


def test_a_benchmark_can_keep_the_places_from_the_method():
    scan = scan_of("a", np.zeros(3), EYE[None])
    known = KnownScene(name="a", scans=(scan,), objects=())
    (told,), (blind,) = known.scans, without_sensors(known).scans
    assert len(told.sensors) == 1 and len(blind.sensors) == 0 and blind.instances == told.instances
    assert sight_in(told, scan.instances[0].points) is not None
    assert sight_in(blind, scan.instances[0].points) is None


def test_registration_is_measured_with_and_without_them():
    names = own_settings("robust", upright=True)
    assert names["ours, robust"].search.free_weight > 0
    assert names["ours, robust, sensors unknown"].search.free_weight == 0
    assert not any("unknown" in name for name in own_settings("robust", upright=False))
