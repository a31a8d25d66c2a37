"""What does not fit is kept and flagged, yet has no part in an object's shape."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np
import pytest
from factories import embedding, living_scene, turn_z
from scipy.spatial.transform import Rotation
from small_scenes import CONFIG, MARK, piece
from small_scenes import scan as pieces

from more2_jax.geometry.observations import own_normals, own_points, with_poses
from more2_jax.geometry.poses import apply_pose
from more2_jax.network.embedding_batch import embed
from more2_jax.refinement.joint_of_objects import fit_objects
from more2_jax.scene import add_scan, reconstruct, start_scene
from more2_jax.storage.scene_folder import load_scene, save_scene
from more2_jax.tracking.accumulated import accumulated_object, readable, with_refined
from more2_jax.tracking.objects import (
    accumulated,
    accumulated_points,
    new_object,
    points_of,
    seen_again,
)
from more2_jax.tracking.relocalize import known_object, shows_again
from more2_jax.types import Instance, Observation, ObservedObject, Scan, ScanRecord, SceneObject

TURNED = turn_z(np.pi, np.zeros(3), np.array([2.0, 0.0, 0.0]))  # back to front, elsewhere


def seen_twice_and_once_wrongly(prior) -> SceneObject:
    """A piece seen thrice, of which the second time in a wrong pose that is doubted."""
    clouds = [piece(0), piece(0) + [1.0, 0, 0], piece(0) + [0, 1.0, 0]]
    o = new_object(0, 0, Instance(id=1, points=clouds[0]), embed(prior, clouds[:1])[0])
    right = turn_z(0.0, np.zeros(3), np.array([0, -1.0, 0]))
    for scan, (T, sure) in enumerate(((TURNED, False), (right, True)), start=1):
        seen = Observation(
            scan=scan, instance=1, T_ref_scan=T, score=0.9, rms_m=0.01, converged=True, accumulated=sure
        )
        o = seen_again(o, Instance(id=1, points=clouds[scan]), seen)
    return o


def test_doubted_points_are_kept_but_no_part_of_the_shape(tiny_prior):
    o = seen_twice_and_once_wrongly(tiny_prior)
    assert [s.scan for s in accumulated(o)] == [0, 2]
    np.testing.assert_allclose(points_of(o, o.observations[1]), piece(0) + [1.0, 0, 0], atol=1e-9)
    np.testing.assert_allclose(accumulated_points(o), np.tile(piece(0), (2, 1)), atol=1e-9)
    known, _ = known_object(o, None, CONFIG)
    np.testing.assert_allclose(known.points, np.tile(piece(0), (2, 1)) + [0, 1.0, 0], atol=1e-9)


def shown(s: Scan, id_: int, keep) -> Scan:
    """The scan with some points of one instance."""
    less = (
        dataclasses.replace(i, points=i.points[keep(i.points)]) if i.id == id_ else i for i in s.instances
    )
    return dataclasses.replace(s, instances=tuple(less))


@pytest.mark.optimized
@pytest.mark.parametrize("first_is_sliver", [True, False])
def test_a_scan_that_shows_all_that_is_known_again_adds_to_the_shape(tiny_prior, first_is_sliver):
    places = {0: (0.3, 3.0), 1: (0.0, 0.0), 2: (0.0, 6.0)}
    scans = [shown(pieces("a", places), 11, lambda p: p[:, 0] < -0.75), pieces("b", places)]
    first, then = scans if first_is_sliver else scans[::-1]
    # Without noise a sliver and the whole reach a misfit of 0.43.
    strict = dataclasses.replace(CONFIG, accumulate_misfit=0.3)
    o = add_scan(tiny_prior, start_scene(tiny_prior, first, strict), then, strict).objects[1]
    assert len(o.observations) == 2 and o.observations[1].misfit > strict.accumulate_misfit
    assert o.observations[1].accumulated is first_is_sliver
    assert len(accumulated_points(o)) == (len(o.points) if first_is_sliver else len(piece(1)))


def test_shown_again_is_what_lies_on_the_new_points_in_their_place():
    whole, sliver = piece(0), piece(0)[:100]
    known, new = (new_object_seen(p) for p in (sliver, whole))
    apart = turn_z(0.0, np.zeros(3), np.array([0.2, 0.0, 0.0]))
    assert shows_again(known, new, np.eye(4)) and not shows_again(new, known, np.eye(4))
    assert not shows_again(known, new, apart)
    assert shows_again(known, new_object_seen(apply_pose(np.linalg.inv(apart), whole)), apart)


def new_object_seen(points: np.ndarray) -> ObservedObject:
    """A cloud as stages take it."""
    return ObservedObject(points=points, embedding=embedding(np.random.default_rng(0), points.mean(axis=0)))


def test_a_doubted_observation_leaves_the_mesh_as_it_is(tiny_prior):
    o = dataclasses.replace(seen_twice_and_once_wrongly(tiny_prior), mesh=MARK)
    again = dataclasses.replace(o.observations[1], scan=3)
    instance = Instance(id=1, points=piece(0))
    assert seen_again(o, instance, again).mesh is MARK
    assert seen_again(o, instance, dataclasses.replace(again, accumulated=True)).mesh is None


def test_the_joint_fit_is_that_without_the_doubted_observation(tiny_prior):
    o = seen_twice_and_once_wrongly(tiny_prior)
    kept = o.point_scan != 1
    without = dataclasses.replace(
        o,
        observations=(o.observations[0], o.observations[2]),
        points=o.points[kept],
        point_scan=o.point_scan[kept],
    )
    records = [ScanRecord(index=k, name="", source="", instances=(1,)) for k in range(3)]
    both = [accumulated_object(x, records) for x in (o, without)]
    mine, its = with_refined([o, without], [0, 1], fit_objects(tiny_prior, both, CONFIG))
    np.testing.assert_allclose(mine.embedding.inv, its.embedding.inv, atol=1e-5)
    np.testing.assert_array_equal(mine.observations[1].T_ref_scan, TURNED)
    np.testing.assert_allclose(mine.observations[2].T_ref_scan, its.observations[1].T_ref_scan, atol=1e-5)
    np.testing.assert_allclose(accumulated_points(mine), its.points, atol=1e-5)


def test_an_accumulated_object_is_what_was_not_doubted_and_goes_back_without_a_change(tiny_prior):
    rng = np.random.default_rng(0)
    o = seen_twice_and_once_wrongly(tiny_prior)
    shuffled = rng.permutation(len(o.points))
    o = dataclasses.replace(o, points=o.points[shuffled], point_scan=o.point_scan[shuffled])
    places = [rng.normal(size=(k, 3)) for k in (0, 3, 2)]
    records = [
        ScanRecord(index=k, name="", source="", instances=(1,), sensors=s, background=s)
        for k, s in enumerate(places)
    ]
    found = accumulated_object(dataclasses.replace(o, reference_scan=2), records)
    np.testing.assert_array_equal(found.points, accumulated_points(o))
    np.testing.assert_array_equal(found.poses, [s.T_ref_scan for s in accumulated(o)])
    for row, seen in enumerate(accumulated(o)):
        np.testing.assert_array_equal(own_points(found, row), points_of(o, seen))
        assert found.sensors[row] is places[seen.scan]
    np.testing.assert_allclose(found.background, apply_pose(o.observations[2].T_ref_scan, places[2]))
    (same,), (other,) = with_refined([o], [0], [found]), with_refined([o], [], [])
    assert other is o
    np.testing.assert_array_equal(same.points, o.points)
    for a, b in zip(same.observations, o.observations, strict=True):
        np.testing.assert_array_equal(a.T_ref_scan, b.T_ref_scan)


def test_normals_turn_with_their_points_and_are_zero_where_a_scan_has_none():
    rng = np.random.default_rng(0)
    unit = rng.normal(size=(30, 3))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec([0.3, -1.0, 2.0]).as_matrix(), [1.0, 2.0, 3.0]
    knows, silent = (Instance(id=1, points=rng.normal(size=(30, 3)), normals=n) for n in (unit, None))
    o = new_object(0, 0, silent, embedding(rng, np.zeros(3)))
    assert o.normals is None
    seen = dataclasses.replace(o.observations[0], scan=1, T_ref_scan=T)
    both = seen_again(o, knows, seen)
    assert both.normals is not None and not both.normals[:30].any()
    np.testing.assert_allclose(both.normals[30:], unit @ T[:3, :3].T, atol=1e-12)
    for whole in (True, False):  # as a new scan is compared with it: all seen so far, or the reference alone
        placed, _ = known_object(both, None, dataclasses.replace(CONFIG, accumulate_target=whole))
        expected = both.normals @ np.linalg.inv(T)[:3, :3].T if whole else np.zeros((30, 3))
        np.testing.assert_allclose(placed.normals, expected, atol=1e-12)
    made = accumulated_object(both, [ScanRecord(index=k, name="", source="", instances=(1,)) for k in (0, 1)])
    np.testing.assert_allclose(own_normals(made, 1), unit, atol=1e-12)
    back = with_refined([both], [0], [with_poses(made, [np.eye(4), np.eye(4)])])[0]
    np.testing.assert_allclose(back.normals, np.concatenate([np.zeros((30, 3)), unit]), atol=1e-12)


def test_what_moves_is_written_back_and_what_is_doubted_stays(tiny_prior):
    o = seen_twice_and_once_wrongly(tiny_prior)
    records = [ScanRecord(index=k, name="", source="", instances=(1,)) for k in range(3)]
    found = accumulated_object(o, records)
    step = turn_z(0.1, np.zeros(3), np.array([0.1, 0, 0]))
    moved = with_poses(found, [found.poses[0], step @ found.poses[1]])
    (new,) = with_refined([o], [0], [moved])
    np.testing.assert_allclose(new.points[o.point_scan == 2], apply_pose(step, o.points[o.point_scan == 2]))
    for row, scan in ((0, 0), (1, 1)):
        np.testing.assert_array_equal(new.observations[row].T_ref_scan, o.observations[row].T_ref_scan)
        np.testing.assert_allclose(
            new.points[o.point_scan == scan], o.points[o.point_scan == scan], atol=1e-12
        )
    np.testing.assert_array_equal(new.observations[2].T_ref_scan, moved.poses[1])
    np.testing.assert_allclose(
        points_of(new, new.observations[2]), points_of(o, o.observations[2]), atol=1e-9
    )


@pytest.mark.parametrize(("limit", "sure"), [(0.0, False), (1.0, True)])
def test_what_fits_worse_than_the_limit_is_left_out(tiny_prior, limit, sure):
    config = dataclasses.replace(CONFIG, accumulate_misfit=limit)
    rng = np.random.default_rng(0)
    part = piece(0)[::2][piece(0)[::2, 2] > -0.2]  # all of it would be shown again
    noisy = apply_pose(TURNED, part + rng.normal(0, 0.005, part.shape))
    scans = [
        Scan(name=n, source=n, instances=(Instance(id=1, points=p),))
        for n, p in (("a", piece(0)), ("b", noisy))
    ]
    made = add_scan(tiny_prior, start_scene(tiny_prior, scans[0], config), scans[1], config)
    (o,) = made.objects
    seen = o.observations[1]
    assert 0 < seen.misfit < 0.5
    assert seen.accumulated is sure
    assert len(accumulated_points(o)) == len(piece(0)) + (len(part) if sure else 0)
    (whole,) = reconstruct(tiny_prior, made, config).objects
    assert len(whole.observations) == 2
    assert made.changes[0].moved == (o.id,)


def test_the_flag_comes_back_from_the_folder(tmp_path):
    scene = living_scene()
    o = next(o for o in scene.objects if len(o.observations) > 1)
    doubted = dataclasses.replace(o.observations[1], accumulated=False, misfit=0.7)
    changed = dataclasses.replace(o, observations=(o.observations[0], doubted, *o.observations[2:]))
    objects = tuple(changed if x is o else x for x in scene.objects)
    save_scene(dataclasses.replace(scene, objects=objects), tmp_path / "scene", CONFIG)
    again, _ = load_scene(tmp_path / "scene")
    found = next(x for x in again.objects if x.id == o.id)
    assert (found.observations[1].accumulated, found.observations[1].misfit) == (False, 0.7)
    np.testing.assert_array_equal(found.points, o.points)


def test_objects_that_older_weights_encoded_are_encoded_anew(tiny_prior):
    """Scenes stored with another look-up: their embeddings have other anchors, which the decoder cannot read."""
    fits = seen_twice_and_once_wrongly(tiny_prior)
    older = dataclasses.replace(
        fits, embedding=dataclasses.replace(fits.embedding, anchors=(*fits.embedding.anchors, MARK))
    )
    assert len(older.embedding.anchors) != len(fits.embedding.anchors)
    scene = dataclasses.replace(living_scene(), objects=(fits, older))
    kept, anew = readable(tiny_prior, scene).objects
    assert kept is fits
    expected = embed(tiny_prior, [accumulated_points(fits)])[0]
    jax.tree.map(np.testing.assert_array_equal, anew.embedding, expected)
