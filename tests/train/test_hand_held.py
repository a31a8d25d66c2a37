"""How a person scans: what the sensor measures, where the device believes to be, what fusion makes of both."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from more2_jax.geometry.poses import rotation_error_deg
from train.rooms.coloring import Light, face_colors, model_colors, palette
from train.rooms.depth_sensor import DepthSensor, FrameCaster, at_edges, measure, noise_std
from train.rooms.frames import NEAR_DEG, NEAR_M, TILT_DEG, scan_frames
from train.rooms.fused_scan import ScanSettings, fused_scan, take_frames
from train.rooms.fusion import ColoredMesh, Volume, decimated, without_crumbs
from train.rooms.hand_held import Walk, blind_part, drifted, turned_away, walk
from train.rooms.over_segmentation import majority, over_segmentation
from train.rooms.surroundings import box, loose_clutter, shell
from train.rooms.whole_room import WholeRoom, in_sight, whole_room

SENSOR = DepthSensor(width=80, height=60)
ROOM_M = (3.6, 3.2)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.mark.parametrize("depth_m", [0.8, 2.0, 4.0])
def test_noise_grows_with_depth_squared_and_disparity_is_quantized(depth_m, rng):
    sensor = DepthSensor(width=200, height=200)
    measured = measure(np.full(40_000, depth_m), sensor, rng)
    measured = measured[measured > 0]
    step = depth_m**2 * sensor.disparity_step
    expected = np.hypot(noise_std(np.array([depth_m]), sensor)[0], step / np.sqrt(12))
    assert measured.std() == pytest.approx(expected, rel=0.08)
    assert (noise_std(np.array([depth_m]), sensor) - sensor.noise_m) / (depth_m - 0.4) ** 2 == pytest.approx(
        sensor.noise_per_m2
    )
    values = np.unique(np.round(1 / measured / sensor.disparity_step, 6))
    np.testing.assert_allclose(values, np.round(values), atol=1e-5)


def test_range_and_edges_lose_pixels(rng):
    sensor = DepthSensor(width=100, height=100, dropout=0.0)
    image = np.full((100, 100), 1.0)
    image[:, 50:] = 2.0
    chance = at_edges(image.ravel(), sensor).reshape(100, 100)
    assert np.flatnonzero(chance.any(axis=0)).tolist() == [49, 50]
    assert chance[0, 49], chance[0, 50] == sensor.edge_loss
    lost = (measure(image.ravel(), sensor, rng) == 0).reshape(100, 100)
    assert not lost[:, :49].any()
    assert lost[:, 50].mean() == pytest.approx(sensor.edge_loss[1], abs=0.12)
    for far in (np.inf, 6.0, 0.2):
        assert not measure(np.full(10_000, far), sensor, rng).any()


def test_a_frame_shows_true_depths(rng):
    mesh = trimesh.creation.box((2, 2, 2))
    T = np.eye(4)
    T[:3, 3] = [0.1, -0.2, -4.0]  # looks along +z at the face z = −1
    frame = FrameCaster(mesh, SENSOR).frame(T, rng)
    assert frame.depth[frame.face >= 0] == pytest.approx(3.0)
    at = SENSOR.rays * np.where(np.isfinite(frame.depth), frame.depth, 0)[:, None] + T[:3, 3]
    assert (np.abs(at[frame.face >= 0, :2]) <= 1 + 1e-9).all()
    pixel, inside = SENSOR.pixel(SENSOR.rays * 2.0)
    assert inside.all()
    np.testing.assert_array_equal(pixel, np.arange(80 * 60))


def test_a_walk_is_at_a_persons_height_within_the_room_and_looks_at_its_targets(rng):
    targets = [np.array([1.0, 0.5, 0.4]), np.array([-1.2, -0.8, 0.3])]
    taken = [(0.0, 0.0, 0.5)]
    path = walk(targets, taken, ROOM_M, Walk(), None, rng)
    assert 60 <= len(path) <= 300
    assert (np.abs(path[:, :2, 3]) <= np.array(ROOM_M) / 2).all()
    assert (path[:, 2, 3] > 1.0).all() and (path[:, 2, 3] < 1.8).all()
    assert (np.hypot(*path[:, :2, 3].T) > 0.49).all()
    np.testing.assert_allclose(
        path[:, :3, :3] @ path[:, :3, :3].transpose(0, 2, 1), np.eye(3) + 0 * path[:, :3, :3], atol=1e-7
    )
    for t in targets:
        pixels = [SENSOR.pixel((t - T[:3, 3])[None] @ T[:3, :3])[1][0] for T in path]
        assert sum(pixels) > 5
    steps = np.linalg.norm(np.diff(path[:, :3, 3], axis=0), axis=1)
    assert np.median(steps) < 0.4
    with pytest.raises(ValueError, match="nowhere to stand"):
        walk(targets, [(0.0, 0.0, 9.0)], ROOM_M, Walk(), None, rng)


def test_what_is_skipped_is_in_no_frame(rng):
    targets = [np.array([x, y, 0.4]) for x in (-1.2, 0, 1.2) for y in (-1, 1)]
    blind = blind_part(targets, ROOM_M, rng)
    hidden = blind.hides(np.stack(targets)[:, :2])
    assert 1 <= hidden.sum() < len(targets)
    path = turned_away(walk(targets, [], ROOM_M, Walk(), blind, rng), blind, SENSOR)
    for T in path:
        local = (blind.places - T[:3, 3]) @ T[:3, :3]
        assert not (SENSOR.pixel(local)[1] & (local[:, 2] < SENSOR.farthest_m)).any()


def test_drift_walks_and_is_pulled_back(rng):
    still = np.tile(np.eye(4), (4000, 1, 1))
    config = Walk()
    drift = drifted(still, config, rng)
    np.testing.assert_array_equal(drift[0], np.eye(4))
    step = np.diff(drift[:, :3, 3], axis=0)
    assert step.std() == pytest.approx(config.step_m, rel=0.1)
    spread = config.step_m / np.sqrt(1 - (1 - config.pull) ** 2)  # of a random walk that is pulled back
    assert drift[:, :3, 3].std() == pytest.approx(spread, rel=0.25)
    turns = np.rad2deg(Rotation.from_matrix(drift[:, :3, :3]).magnitude())
    assert 0.1 < np.median(turns) < 1.0


def bare_room() -> WholeRoom:
    x, y = ROOM_M[0] / 2, ROOM_M[1] / 2
    walls = [((-x, -y, -0.1), (x, y, 0)), ((x, -y, 0), (x + 0.1, y, 2.5)), ((-x - 0.1, -y, 0), (-x, y, 2.5))]
    walls += [((-x, y, 0), (x, y + 0.1, 2.5)), ((-x, -y - 0.1, 0), (x, -y, 2.5))]
    return whole_room([], [], [box(low, high, (0.5, 0.6, 0.7)) for low, high in walls])


def wall_thickness(settings: ScanSettings, rng: np.random.Generator) -> float:
    """Of walls of a bare room as it is scanned, 5th to 95th percentile; meters."""
    path = walk([np.array([0.0, 0, 0.1])], [], ROOM_M, settings.walk, None, rng)
    room = bare_room()
    frames = take_frames(room, path, settings.sensor, rng)
    scan = fused_scan(room, frames, 0, np.eye(4), settings, rng)
    vertices, normals = scan.mesh.vertices, scan.mesh.normals
    middle = (vertices[:, 2] > 0.3) & (vertices[:, 2] < 1.6)
    thick = []
    for axis, sign in ((0, 1), (0, -1), (1, 1), (1, -1)):
        beyond = sign * vertices[:, axis] - ROOM_M[axis] / 2
        wall = middle & (np.abs(beyond) < 0.2) & (np.abs(vertices[:, 1 - axis]) < ROOM_M[1 - axis] / 2 - 0.3)
        if wall.sum() < 100:
            continue
        thick.append(np.ptp(np.quantile(beyond[wall], [0.05, 0.95])))
        assert (sign * normals[wall, axis] < 0).mean() > 0.98  # toward the room, none at the back
    assert len(thick) >= 3
    assert not scan.instance.any()
    return float(np.mean(thick))


WALLS = ScanSettings(sensor=SENSOR, walk=Walk(views_of_walls=24), voxel_m=(0.04, 0.04))


def test_drift_makes_walls_one_to_three_centimeters_thick_and_fusion_leaves_no_second_layer(rng):
    assert 0.01 < wall_thickness(WALLS, rng) < 0.03


def test_of_so_many_times_the_noise_and_drift(rng):
    twice = WALLS.with_noise(2.0)
    depth = np.array([0.4, 1.0, 3.0])
    np.testing.assert_allclose(noise_std(depth, twice.sensor), 2 * noise_std(depth, WALLS.sensor))
    assert (twice.walk.step_m, twice.walk.step_deg) == (2 * WALLS.walk.step_m, 2 * WALLS.walk.step_deg)
    assert WALLS.with_noise(1.0) == WALLS
    none, usual = (wall_thickness(WALLS.with_noise(f), np.random.default_rng(0)) for f in (0.0, 1.0))
    assert none < 0.6 * usual


def test_fusion_gives_the_surface_its_color_and_its_side(rng):
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=0.4)
    caster, volume = FrameCaster(mesh, SENSOR), Volume(np.full(3, -0.5), np.full(3, 0.5), 0.02)
    perfect = DepthSensor(80, 60, noise_m=0, noise_per_m2=0, disparity_step=1e-7, dropout=0, edge_loss=(0, 0))
    for turn in Rotation.random(12, rng=rng).as_matrix():
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = turn, -1.2 * turn[:, 2]
        depth = measure(caster.frame(T, rng).depth, perfect, rng)
        for _ in range(2):
            volume.add(depth, np.tile([0.2, 0.4, 0.6], (len(depth), 1)), T, perfect)
    fused = without_crumbs(volume.mesh())
    radius = np.linalg.norm(fused.vertices, axis=1)
    assert np.quantile(np.abs(radius - 0.4), 0.95) < 0.01
    assert ((fused.normals * fused.vertices).sum(axis=1) > 0).mean() > 0.99
    np.testing.assert_allclose(fused.colors, np.tile([0.2, 0.4, 0.6], (len(fused.colors), 1)), atol=1e-5)
    fewer = decimated(fused, 0.5)
    assert len(fewer.faces) == pytest.approx(len(fused.faces) / 2, rel=0.02)
    assert np.quantile(np.abs(np.linalg.norm(fewer.vertices, axis=1) - 0.4), 0.9) < 0.01


def test_an_edge_parts_two_pieces_and_the_majority_names_them():
    a, b = (trimesh.creation.box((1, 1, h)).subdivide().subdivide().subdivide() for h in (0.1, 0.1))
    b.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [0, 1, 0]))
    b.apply_translation([0.0, 0, 0.6])
    both = trimesh.util.concatenate([a, b])
    piece = over_segmentation(
        np.asarray(both.vertices), np.asarray(both.vertex_normals), np.asarray(both.faces)
    )
    assert not set(piece[: len(a.vertices)]) & set(piece[len(a.vertices) :])
    label = np.where(np.arange(len(piece)) < len(a.vertices), -1, 3)
    wrong = label.copy()
    wrong[::5] = 1
    np.testing.assert_array_equal(majority(piece, wrong), label)


def test_frames_are_tilted_or_nearly_the_same(rng):
    for _ in range(30):
        own = scan_frames("own", 3, rng)
        tilt = np.rad2deg(np.arccos(np.clip(own[:, 2, 2], -1, 1)))
        assert (tilt <= TILT_DEG + 1e-6).all()
        near = scan_frames("aligned", 3, rng)
        for T in near[1:]:
            between = np.linalg.inv(near[0]) @ T
            assert np.linalg.norm(between[:3, 3]) <= NEAR_M + 1e-6
            assert rotation_error_deg(between[:3, :3], np.eye(3)) <= NEAR_DEG + 1e-3
        for T in (*own, *near):
            np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-9)
    yaws = [np.arctan2(*scan_frames("own", 1, rng)[0, [1, 0], 0]) for _ in range(40)]
    assert np.ptp(yaws) > 4


def test_what_lies_behind_a_wall_is_not_in_sight(rng):
    room = bare_room()
    path = walk([np.array([1.0, 0, 0.5])], [], ROOM_M, Walk(views_of_walls=30, frames_a_view=2), None, rng)
    frames = take_frames(room, path, SENSOR, rng)
    inside, outside = rng.uniform(-1, 1, (200, 3)) * [1.2, 1.1, 0], rng.uniform(-1, 1, (200, 3))
    inside[:, 2] = rng.uniform(0.1, 0.8, 200)
    outside[:, 0] += 4.0
    assert in_sight(inside, frames, SENSOR).mean() > 0.7
    assert not in_sight(outside, frames, SENSOR).any()


def test_surroundings_keep_to_their_room(rng):
    for _ in range(10):
        for shape in shell(ROOM_M, rng):
            assert (np.abs(shape.vertices[:, :2]) <= np.array(ROOM_M) / 2 + 0.11).all()
        taken = [(0.5, 0.5, 0.6), (-1.0, -0.8, 0.5)]
        for thing in loose_clutter(ROOM_M, taken, rng):
            assert thing.vertices[:, 2].min() == pytest.approx(0, abs=1e-9)
            for x, y, r in taken:
                middle = thing.vertices[:, :2].mean(axis=0)
                assert np.hypot(*(middle - [x, y])) > r


def test_colors_belong_to_models_and_light_to_scans(rng):
    colors = model_colors(["chair", "desk", "chair"], palette(rng), rng)
    assert list(colors) == ["chair", "desk"]
    cube = trimesh.creation.box((1, 1, 1))
    cube.apply_translation([0, 0, 0.5])
    two = np.array([[1, 0, 0], [0, 1, 0], [0.4, 0, 0]])
    painted = face_colors(np.asarray(cube.vertices), np.asarray(cube.faces), two)
    low = np.asarray(cube.triangles_center)[:, 2] < 0.4
    assert (painted[low] == two[1]).all() and (painted[~low] == two[0]).all()
    gray, up = np.full((500, 3), 0.5), np.tile([0.0, 0, 1], (500, 1))
    one, other = (Light.drawn(rng).developed(gray, up, rng) for _ in range(2))
    assert min(one.min(), other.min()) >= 0 and max(one.max(), other.max()) <= 1
    assert np.abs(one.mean(axis=0) - other.mean(axis=0)).max() > 0.01


def test_crumbs_and_bow_ties_are_dropped():
    plate = trimesh.creation.box((1, 1, 1)).subdivide().subdivide().subdivide()
    crumb = trimesh.creation.box(
        (0.1, 0.1, 0.1), transform=trimesh.transformations.translation_matrix([3, 0, 0])
    )
    both = trimesh.util.concatenate([plate, crumb])
    mesh = ColoredMesh(
        vertices=np.asarray(both.vertices),
        faces=np.asarray(both.faces),
        colors=np.zeros((len(both.vertices), 3)),
    )
    kept = without_crumbs(mesh)
    assert kept.vertices[:, 0].max() < 1
    assert len(kept.faces) == len(plate.faces)
    holed = mesh.faces[: len(plate.faces)]
    at = holed[0, 0]
    fan = np.flatnonzero((holed == at).any(axis=1))
    far = next(f for f in fan if len(set(holed[f]) & set(holed[fan[0]])) == 1)
    tied = np.delete(holed, [fan[0], far], axis=0)  # two holes that meet in one vertex
    cleaned = without_crumbs(ColoredMesh(vertices=mesh.vertices, faces=tied, colors=mesh.colors))
    assert len(cleaned.faces) < len(tied)
    assert len(decimated(cleaned, 0.5).faces) < 0.6 * len(tied)
