"""Peers on what they must manage: whole clouds of an odd shape; and their failures are values."""

import numpy as np
import pytest
import trimesh
from known_scenes import pose

from eval.harness.extra import has, library
from eval.peers import matching, registration
from more2_jax.geometry.poses import apply_pose, rotation_error_deg
from more2_jax.types import Instance

need = pytest.mark.skipif(not (has("open3d") and has("small_gicp")), reason="extra peers is not installed")


def odd_shape(count, seed, size=(1.0, 0.5, 0.3)):
    arm = trimesh.creation.box((0.1, 0.7, 0.9), transform=pose(0, [0.5, 0.3, 0.4]))
    mesh = trimesh.util.concatenate([trimesh.creation.box(size), arm])
    return np.asarray(trimesh.sample.sample_surface(mesh, count, seed=seed)[0])


def bench_points():
    """Of a seat, a back and two legs; its own mirror image in x = 0 alone."""
    boxes = [(1, 0.6, 0.1), (1, 0.05, 0.8), (0.1, 0.1, 0.6), (0.1, 0.1, 0.6)]
    at = [(0, 0, 0), (0, 0.3, 0.4), (0.4, -0.2, -0.35), (-0.4, -0.2, -0.35)]
    mesh = trimesh.util.concatenate(
        [trimesh.creation.box(b, transform=pose(0, t)) for b, t in zip(boxes, at, strict=True)]
    )
    return np.asarray(trimesh.sample.sample_surface(mesh, 6000, seed=0)[0])


SOURCE, TARGET = odd_shape(3000, 0), odd_shape(3000, 1)
T_TRUE = pose(70, [3, -2, 0.1])
MOVED = TARGET @ T_TRUE[:3, :3].T + T_TRUE[:3, 3]


@need
@pytest.mark.parametrize("name", ["FPFH + RANSAC + GICP", "multi-start GICP"])
@pytest.mark.parametrize("upright", [True, False])
def test_registrars_find_the_pose_of_a_whole_cloud(name, upright):
    T = registration.registrars()[name](SOURCE, MOVED, upright)
    assert T is not None
    assert rotation_error_deg(T[:3, :3], T_TRUE[:3, :3]) < 2
    np.testing.assert_allclose(SOURCE.mean(axis=0) @ T[:3, :3].T + T[:3, 3], MOVED.mean(axis=0), atol=0.03)


@need
@pytest.mark.parametrize("name", list(registration.registrars()) if has("open3d") else [])
def test_registrars_fail_on_next_to_nothing_without_raising(name):
    few = np.random.default_rng(0).normal(size=(3, 3))
    assert registration.registrars()[name](few, few + 1, False) is None


def test_starts_are_distinct_rotations():
    assert [len(registration.starts(u, f)) for u, f in ((True, 60), (False, 60), (False, 24))] == [24, 60, 24]
    for upright in (True, False):
        rotations = np.stack(registration.starts(upright))[:, :3, :3]
        apart = [rotation_error_deg(a, b) for i, a in enumerate(rotations[:8]) for b in rotations[i + 1 :]]
        assert min(apart) > 14


def test_apart_is_the_truncated_mean_of_both_ways():
    rng = np.random.default_rng(0)
    a, b = rng.uniform(0, 0.3, (40, 3)), rng.uniform(0, 0.3, (30, 3))
    distance = np.linalg.norm(a[:, None] - b[None], axis=-1)
    expected = [np.minimum(distance.min(axis=k), registration.TRUNCATED).mean() for k in (0, 1)]
    assert registration.apart(np.eye(4), a, b) == pytest.approx(np.mean(expected))
    assert registration.apart(np.eye(4), a, a) == 0
    assert registration.apart(np.eye(4), a, a + 9) == pytest.approx(registration.TRUNCATED)
    assert registration.apart(np.full((4, 4), np.nan), a, b) == np.inf


def instances(seed, sizes):
    rng = np.random.default_rng(seed)
    found = []
    for k, size in enumerate(sizes):
        T = pose(rng.uniform(-180, 180), rng.uniform(-5, 5, 3))
        found.append(
            Instance(id=10 * seed + k, points=odd_shape(1500, seed * 7 + k, size) @ T[:3, :3].T + T[:3, 3])
        )
    return found


@need
@pytest.mark.parametrize("name", list(matching.matchers(True)))
def test_matchers_tell_different_shapes_apart(name):
    sizes = [(1.0, 0.5, 0.3), (2.0, 1.0, 0.1), (0.4, 0.4, 1.8)]
    one, other = instances(1, sizes), instances(2, sizes[::-1])
    assert matching.matchers(True)[name](one, other) == {10: 22, 11: 21, 12: 20}


def test_d2_is_a_distribution_of_distances():
    line = np.array([[0.0, 0, 0], [1.0, 0, 0]])
    found = matching.d2(np.repeat(line, 50, axis=0))
    assert found.sum() == pytest.approx(1)
    assert np.flatnonzero(found).tolist() == [0, 16] and found[0] == pytest.approx(0.5, abs=0.02)


def test_extents_do_not_depend_on_the_pose():
    turned = SOURCE @ pose(33, [0, 0, 0], "x")[:3, :3].T + 5
    np.testing.assert_allclose(matching.sorted_extents(turned), matching.sorted_extents(SOURCE), atol=1e-9)


def test_rejected_pairs_are_none():
    one, other = instances(1, [(1, 1, 1)] * 2), instances(2, [(1, 1, 1)] * 2)
    cost = np.array([[0.1, 0.2], [0.3, 0.9]])
    assert matching.assigned(one, other, cost) == {10: 21, 11: 20}
    assert matching.assigned(one, other, cost, reject=0.25) == {10: 21}


@need
@pytest.mark.parametrize(
    "name", ["screened Poisson, cropped", "ball pivoting", "alpha shape", "mirror image + ball pivoting"]
)
def test_surfaces_of_a_whole_cloud_lie_on_it(name):
    from eval.peers.reconstruction import SURFACERS

    mesh = SURFACERS[name](SOURCE + 4)
    assert mesh is not None and len(mesh.faces) > 500
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    found = np.asarray(trimesh.sample.sample_surface(solid, 2000, seed=0)[0])
    distance = np.linalg.norm(found[:, None] - (SOURCE + 4)[None], axis=-1).min(axis=1)
    assert np.median(distance) < 0.03


@need
def test_the_mirror_image_completes_a_bench_of_which_one_end_was_not_seen():
    from scipy.spatial import KDTree

    from eval.peers.mirror_image import with_mirror_image

    whole = bench_points()
    T = pose(40, [3, 1, 2], "x")
    unseen = whole[:, 0] >= 0.3
    seen, missing = (apply_pose(T, x) for x in (whole[~unseen], whole[unseen]))
    completed = with_mirror_image(seen)
    np.testing.assert_array_equal(completed[: len(seen)], seen)
    before, after = (KDTree(x).query(missing)[0].mean() for x in (seen, completed))
    assert after < 0.7 * before
    assert KDTree(apply_pose(T, whole)).query(completed[len(seen) :])[0].mean() < 0.04


@need
def test_a_cloud_that_is_no_mirror_image_of_itself_stays_as_it_is():
    from eval.peers.mirror_image import with_mirror_image

    scattered = np.random.default_rng(0).normal(size=(400, 3)) * [3.0, 2.0, 1.0]
    np.testing.assert_array_equal(with_mirror_image(scattered), scattered)


@need
def test_the_peers_together_follow_a_scene():
    from eval.peers.end_to_end import combined, without_learning
    from more2_jax.types import Scan

    sizes = [(1.0, 0.5, 0.3), (2.0, 1.0, 0.1)]
    scans = [Scan(name=str(s), source="", instances=tuple(instances(s, sizes))) for s in (1, 2)]
    tracks = combined(scans, without_learning(upright=True))
    assert [t.instance for t in tracks] == [{0: 10, 1: 20}, {0: 11, 1: 21}]
    assert all(t.mesh is not None and len(t.points) == 3000 for t in tracks)


def test_what_one_scan_alone_has_is_as_sure_with_peers_as_with_ours():
    from eval.peers.end_to_end import less_sure
    from eval.scores.tracks import Track
    from more2_jax.matching.calibration import alone_probability

    scans = [(0, 1), (0,), (1, 2), (0, 2), (2,)]  # that have each; the second was gone in 1 already
    tracks = [Track(instance=dict.fromkeys(s, 1), T_track_scan={}, points=np.zeros((1, 3))) for s in scans]
    found = less_sure(tracks, [1 in s for s in scans], 2)
    # The first went and the last came: one besides each, of four things that either scan has.
    least = alone_probability(2, 4)
    assert [t.score for t in found] == [least, 1.0, 1.0, 1.0, least]


@pytest.mark.parametrize(("apart", "reject"), [(0.01, 0.05), (0.08, 0.05), (0.08, np.inf)])
def test_stages_are_asked_in_turn_and_a_pair_that_fits_badly_is_none_where_asked(apart, reject):
    from eval.peers.end_to_end import Stages, combined
    from more2_jax.types import Mesh, Scan

    T = pose(90, [1.0, 0, 0])
    mesh = Mesh(vertices=np.eye(3), faces=np.array([[0, 1, 2]]))
    stages = Stages(
        match=lambda old, new: {old[0].id: new[1].id},
        register=lambda source, target: (T, apart),
        surface=lambda points: mesh,
        reject=reject,
    )
    sizes = [(1.0, 0.5, 0.3), (2.0, 1.0, 0.1)]
    scans = [Scan(name=str(s), source="", instances=tuple(instances(s, sizes))) for s in (1, 2)]
    tracks = combined(scans, stages)
    first = {0: 10, 1: 21} if apart < reject else {0: 10}
    assert tracks[0].instance == first and len(tracks) == (3 if apart < reject else 4)
    assert all(t.mesh is mesh for t in tracks)
    if apart < reject:
        np.testing.assert_array_equal(tracks[0].T_track_scan[1], T)
        assert tracks[0].score < 1


def test_a_missing_library_is_named():
    with pytest.raises(ValueError, match=r"no_such_library .*more2-jax\[peers\]"):
        library("no_such_library")
    assert not has("no_such_library")
