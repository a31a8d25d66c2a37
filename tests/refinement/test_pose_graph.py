"""All observations of an object at once: slips are found, what tells nothing stays; padding and order."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from more2_jax.refinement.pose_graph import OrientedObservations, optimize_pose_graphs

STEPS = 16
POINTS = 512
HALF = np.array([0.5, 0.3, 0.2])


def box_view(rng, faces, count=POINTS):
    """Points of some faces of a box, and their outward normals; face 2 a + s is that of axis a, side s."""
    face = rng.choice(faces, count)
    points = rng.uniform(-1, 1, (count, 3))
    normals = np.zeros((count, 3))
    sign = 2 * (face % 2) - 1
    points[np.arange(count), face // 2] = normals[np.arange(count), face // 2] = sign
    return points * HALF, normals


def observed(views, moves=None, size=POINTS, residual=0.0):
    """Views (points and normals) through `moves`, padded, as a batch of one object."""
    points, normals = np.zeros((2, 1, len(views), size, 3), np.float32)
    mask = np.zeros((1, len(views), size), bool)
    for k, (p, n) in enumerate(views):
        R, t = (np.eye(3), np.zeros(3)) if moves is None else (moves[k][:3, :3], moves[k][:3, 3])
        points[0, k, : len(p)], normals[0, k, : len(p)], mask[0, k, : len(p)] = p @ R.T + t, n @ R.T, True
    residual = jnp.array([residual], jnp.float32)
    return OrientedObservations(
        points=jnp.asarray(points), normals=jnp.asarray(normals), mask=jnp.asarray(mask), residual=residual
    )


def slips(rng, count, *, upright, meters=0.02, degrees=2.0):
    """Small motions, the first none."""
    moves = np.tile(np.eye(4), (count, 1, 1))
    for T in moves[1:]:
        axis = np.array([0.0, 0.0, 1.0]) if upright else rng.normal(size=3)
        turn = np.deg2rad(degrees) * axis / np.linalg.norm(axis)
        T[:3, :3], T[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), rng.uniform(-meters, meters, 3)
    return moves


def left(found, moves, views):
    """By how much each view's points stay away from their places, root mean square."""
    rest = np.asarray(found)[0] @ moves
    return [
        np.sqrt(np.mean(np.sum((p @ T[:3, :3].T + T[:3, 3] - p) ** 2, axis=1)))
        for T, (p, _) in zip(rest, views, strict=True)
    ]


# Some two leave a direction open, all together none.
AROUND = ([0, 2, 5], [2, 1, 5], [1, 3, 5], [0, 1, 2, 3, 5])


@pytest.mark.parametrize("upright", [True, False])
@pytest.mark.parametrize("count", [2, 4])
def test_slips_are_found(upright, count):
    rng = np.random.default_rng(count)
    faces = AROUND if count == 4 else ([0, 2, 5], [0, 2, 5])
    views = [box_view(rng, f) for f in faces]
    moves = slips(rng, count, upright=upright)
    found = optimize_pose_graphs(observed(views, moves), STEPS, "upright" if upright else "free")
    before = left(np.tile(np.eye(4), (1, count, 1, 1)), moves, views)
    after = left(found, moves, views)
    assert min(before[1:]) > 0.015
    assert max(after) < 0.001
    np.testing.assert_array_equal(np.asarray(found)[0, 0], np.eye(4))  # the first is held


def test_a_chain_is_aligned_as_no_single_pair_could():
    """The last view shares no face with the first: only the others tell where it belongs."""
    rng = np.random.default_rng(3)
    views = [box_view(rng, f) for f in ([0, 2, 4], [0, 1, 2, 3, 4, 5], [1, 3, 5])]
    moves = slips(rng, 3, upright=False)
    assert max(left(optimize_pose_graphs(observed(views, moves), STEPS, "free"), moves, views)) < 0.001
    lonely = [views[0], views[2]]
    alone = optimize_pose_graphs(observed(lonely, moves[[0, 2]]), STEPS, "free")
    assert left(alone, moves[[0, 2]], lonely)[1] > 0.01


def test_upright_things_do_not_tilt():
    rng = np.random.default_rng(4)
    views, moves = [box_view(rng, f) for f in AROUND], slips(rng, 4, upright=False)
    found = np.asarray(optimize_pose_graphs(observed(views, moves), STEPS, "upright"))[0]
    np.testing.assert_allclose(found[:, 2, :3], np.tile([0.0, 0, 1], (4, 1)), atol=1e-6)
    assert np.abs(found[1:, :2, 3]).max() > 0.002


def test_the_faces_of_a_board_stay_apart():
    """A thin board's front and back, each seen by one scan, overlap nowhere; were they one side, they would meet."""
    rng = np.random.default_rng(5)
    flat = rng.uniform(-0.5, 0.5, (2, POINTS, 3)) * [1.0, 1.0, 0.0]
    up, down = np.tile([0.0, 0, 1], (POINTS, 1)), np.tile([0.0, 0, -1], (POINTS, 1))
    front, back = (flat[0] + [0, 0, 0.01], up), (flat[1] - [0, 0, 0.01], down)
    apart = np.asarray(optimize_pose_graphs(observed([front, back]), STEPS, "upright"))[0, 1]
    np.testing.assert_allclose(apart, np.eye(4), atol=1e-6)
    met = np.asarray(optimize_pose_graphs(observed([front, (back[0], up)]), STEPS, "upright"))[0, 1]
    assert met[2, 3] == pytest.approx(0.02, abs=1e-3)


def test_padding_changes_nothing():
    rng = np.random.default_rng(6)
    views, moves = [box_view(rng, f, count=400) for f in AROUND[:3]], slips(rng, 3, upright=True)
    exact = observed(views, moves, size=400)
    empty = (np.zeros((0, 3)), np.zeros((0, 3)))
    more = observed([*views, empty, empty], np.concatenate([moves, np.tile(np.eye(4), (2, 1, 1))]), size=600)
    dirty = jnp.where(more.mask[..., None], more.points, 7.0)
    more = dataclasses.replace(more, points=dirty)
    mine = np.asarray(optimize_pose_graphs(exact, STEPS, "upright"))[0]
    its = np.asarray(optimize_pose_graphs(more, STEPS, "upright"))[0]
    np.testing.assert_allclose(its[:3], mine, atol=2e-4)
    np.testing.assert_allclose(its[3:], np.tile(np.eye(4), (2, 1, 1)), atol=1e-6)


def test_the_order_of_the_others_changes_nothing():
    rng = np.random.default_rng(7)
    views, moves = [box_view(rng, f) for f in AROUND], slips(rng, 4, upright=True)
    order = [0, 3, 1, 2]
    mine = np.asarray(optimize_pose_graphs(observed(views, moves), STEPS, "upright"))[0]
    its = np.asarray(
        optimize_pose_graphs(observed([views[k] for k in order], moves[order]), STEPS, "upright")
    )[0]
    np.testing.assert_allclose(its, mine[order], atol=2e-4)


def test_objects_of_a_batch_do_not_meet():
    rng = np.random.default_rng(8)
    views, moves = [box_view(rng, f) for f in AROUND], slips(rng, 4, upright=True)
    one, other = observed(views, moves), observed(views[::-1])
    both = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), one, other)
    np.testing.assert_allclose(
        np.asarray(optimize_pose_graphs(both, STEPS, "upright"))[:1],
        optimize_pose_graphs(one, STEPS, "upright"),
        atol=1e-5,
    )


@pytest.mark.parametrize("kind", ["one point", "one place", "a plane", "far apart", "nothing"])
def test_what_tells_little_stays_finite_and_near(kind):
    rng = np.random.default_rng(9)
    up = np.tile([0.0, 0, 1], (POINTS, 1))
    flat = rng.uniform(-0.5, 0.5, (POINTS, 3)) * [1.0, 1.0, 0.0]
    view = {
        "one point": (flat[:1], up[:1]),
        "one place": (np.zeros((POINTS, 3)), up),
        "a plane": (flat, up),
        "far apart": (flat + [0, 0, 2.0], up),
        "nothing": (flat[:0], up[:0]),
    }[kind]
    found = np.asarray(optimize_pose_graphs(observed([(flat, up), view]), STEPS, "free"))[0]
    assert np.isfinite(found).all()
    # Points in one place slide to the nearest one: half the way between neighbors at most.
    np.testing.assert_allclose(found[1], np.eye(4), atol=0.02 if kind == "one place" else 1e-3)


def test_as_many_programs_as_numbers_of_observations():
    rng = np.random.default_rng(10)
    optimize_pose_graphs.clear_cache()
    for seed in range(3):
        for count in (2, 4):
            views = [box_view(rng, f) for f in AROUND[:count]]
            optimize_pose_graphs(
                observed(views, slips(np.random.default_rng(seed), count, upright=True)), STEPS, "upright"
            )
    assert optimize_pose_graphs._cache_size() == 2
