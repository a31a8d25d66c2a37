"""A scene over several scans: who is kept, what is skipped, what came and went, where things were put."""

from __future__ import annotations

import dataclasses
import time

import jax
import numpy as np
import pytest
from factories import scene_object, turn_z
from small_scenes import CONFIG, MARK, ROBUST, piece, scan

from more2_jax.config import JointConfig, MeshingConfig, preset
from more2_jax.geometry.poses import apply_pose
from more2_jax.matching.calibration import alone_probability
from more2_jax.meshing import engine, object_mesh
from more2_jax.meshing.object_mesh import object_floor
from more2_jax.registration import search, surface
from more2_jax.scene import add_scan, reconstruct, start_scene
from more2_jax.tracking.accumulated import accumulated_object
from more2_jax.tracking.changes import counted_alone, moved_probability
from more2_jax.tracking.objects import points_of
from more2_jax.types import Instance, Mesh, Scan

pytestmark = pytest.mark.optimized  # scenes run for longer than their programs compile

VISITS = (
    {0: (0.0, 0.0), 1: (0.3, 3.0)},
    {0: (0.0, 0.0), 2: (0.0, 6.0)},
    {0: (1.0, 1.0), 1: (1.2, 4.0), 2: (0.0, 6.0)},
)


@pytest.fixture(scope="module")
def scene(tiny_prior):
    """Three visits: 0 stays, then moves; 1 goes and comes back; 2 comes and stays."""
    made = start_scene(tiny_prior, scan("a", VISITS[0]), CONFIG)
    for name, poses in zip("bc", VISITS[1:], strict=True):
        made = add_scan(tiny_prior, made, scan(name, poses), CONFIG)
    return made


def test_objects_are_followed_through_absence(scene):
    seen = {o.label: [(s.scan, s.instance) for s in o.observations] for o in scene.objects}
    assert seen == {
        "kind 0": [(0, 10), (1, 10), (2, 10)],
        "kind 1": [(0, 11), (2, 11)],
        "kind 2": [(1, 12), (2, 12)],
    }


def test_changes_name_what_stayed_moved_came_and_went(scene):
    first, second = scene.changes
    ids = {o.label: o.id for o in scene.objects}
    assert (first.static, first.removed, first.added) == (
        (ids["kind 0"],),
        (ids["kind 1"],),
        (ids["kind 2"],),
    )
    assert (second.moved, second.static, second.added) == (
        (ids["kind 0"],),
        (ids["kind 2"],),
        (ids["kind 1"],),
    )


def test_all_that_is_said_of_changes_has_a_probability(scene):
    for c in scene.changes:
        assert set(c.probability) == {*c.static, *c.moved, *c.added, *c.removed}
        assert all(0.5 < p <= 1 for p in c.probability.values())
    assert not any(seen.interchangeable for o in scene.objects for seen in o.observations)
    # One thing went and another came, of three; where one comes back, it is by its match that it is told.
    first, second = scene.changes
    assert [first.probability[i] for i in (*first.added, *first.removed)] == pytest.approx(
        [alone_probability(2, 3)] * 2, abs=0.02
    )
    (back,) = second.added
    (o,) = (o for o in scene.objects if o.id == back)
    assert second.probability[back] == o.observations[-1].score


def test_what_one_scan_alone_has_is_counted_and_the_less_sure_the_more_there_is(scene):
    def counted(missing, new):
        return counted_alone(scene.objects * 4, missing, range(new), scene.scans)

    assert [counted([], 0), counted([0], 0), counted([0, 3], 3)] == [(0, 12), (1, 12), (5, 15)]
    # What was gone before is not missed again.
    went = next(o for o in scene.objects if o.label == "kind 1")
    gone, lost = (dataclasses.replace(went, observations=went.observations[k : k + 1]) for k in (0, 1))
    assert counted_alone([gone] * 9 + [lost], range(10), [went], scene.scans) == (2, 2)
    chances = [alone_probability(alone, 20) for alone in range(1, 11)]
    assert 0.9 > chances[0] > 0.8 and 0.3 > chances[-1] > 0.0 and (np.diff(chances) < 0).all()
    assert alone_probability(1, 1) == alone_probability(1, 20)


@pytest.mark.parametrize(
    ("shift_m", "sigma_m", "low", "high"),
    [
        (0.06, 0.0, 1, 1),  # without an error of its own: what the limits say
        (0.04, 0.0, 0, 0),
        (0.06, 0.001, 0.99, 1),
        (0.06, 0.05, 0, 0.5),  # less than registration's own error explains
        (0.04, 0.05, 0, 0.5),
        (1.0, 0.05, 0.99, 1),
    ],
)
def test_a_motion_within_registrations_own_error_is_none(shift_m, sigma_m, low, high):
    shifted = turn_z(0.0, np.zeros(3), np.array([shift_m, 0, 0]))
    o = scene_object(0, {0: np.eye(4), 1: shifted})
    before, after = (dataclasses.replace(seen, sigma_m=0.0, sigma_deg=0.0) for seen in o.observations)
    moved = moved_probability(o, before, dataclasses.replace(after, sigma_m=sigma_m), CONFIG)
    assert low <= moved <= high


def test_identical_copies_are_matched_one_to_one_and_flagged(tiny_prior):
    def twins(name: str, at: list[float]) -> Scan:
        clouds = [piece(0) + [x, 0, 0] for x in at]
        return Scan(
            name=name,
            source=name,
            instances=tuple(Instance(id=k, points=c) for k, c in enumerate(clouds)),
        )

    made = start_scene(tiny_prior, twins("a", [0.0, 3.0]), CONFIG)
    made = add_scan(tiny_prior, made, twins("b", [3.0, 0.0]), CONFIG)
    seen = [o.observations[1] for o in made.objects]
    assert [s.instance for s in seen] == [1, 0]  # each where it stood
    assert all(s.interchangeable for s in seen)
    assert made.changes[0].static == tuple(o.id for o in made.objects)


def test_every_pose_maps_its_observation_onto_the_reference(scene):
    for o in scene.objects:
        kind = int(o.label[-1])
        reference = dict(enumerate(VISITS))[o.reference_scan][kind]
        for seen in o.observations:
            there = VISITS[seen.scan][kind]
            true = turn_z(reference[0], np.zeros(3), np.array([reference[1], 0, 0])) @ np.linalg.inv(
                turn_z(there[0], np.zeros(3), np.array([there[1], 0, 0]))
            )
            np.testing.assert_allclose(seen.T_ref_scan, true, atol=2e-3)


def test_single_observations_can_be_had_back(scene):
    o = scene.objects[0]
    for seen, poses in zip(o.observations, VISITS, strict=True):
        original = scan("again", poses).instances[0].points
        np.testing.assert_allclose(points_of(o, seen), original, atol=1e-9)


def test_reconstruction_gives_closed_frames_and_leaves_finished_objects_alone(tiny_prior, scene):
    once = reconstruct(tiny_prior, scene, CONFIG)
    for o in once.objects:
        np.testing.assert_allclose(o.observations[0].T_ref_scan, np.eye(4), atol=1e-5)
        assert np.isfinite(o.points).all()
    marked = dataclasses.replace(
        once, objects=tuple(dataclasses.replace(o, mesh=o.mesh or MARK) for o in once.objects)
    )
    again = reconstruct(tiny_prior, marked, CONFIG)
    assert all(a is b for a, b in zip(again.objects, marked.objects, strict=True))


def test_meshes_come_in_order_whichever_is_ready_first_and_errors_come_through(
    monkeypatch, tiny_prior, scene
):
    waits = {id(o.embedding): 0.2 / (k + 1) for k, o in enumerate(scene.objects)}

    def slow(prior, o, config):
        time.sleep(waits[id(o.embedding)])
        return Mesh(vertices=np.full((1, 3), waits[id(o.embedding)]), faces=np.zeros((0, 3), int))

    monkeypatch.setattr(object_mesh, "object_mesh", slow)
    config = dataclasses.replace(CONFIG, joint=JointConfig(steps=0), pose_graph=preset("paper").pose_graph)
    bare = dataclasses.replace(scene, objects=tuple(dataclasses.replace(o, mesh=None) for o in scene.objects))
    done = reconstruct(tiny_prior, bare, config)
    assert [o.mesh.vertices[0, 0] for o in done.objects] == list(waits.values())
    monkeypatch.setattr(object_mesh, "object_mesh", lambda prior, o, config: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        reconstruct(tiny_prior, bare, config)


def test_several_scans_confirm_one_another_one_does_not(monkeypatch, tiny_prior, scene):
    """Of what several scans saw more is an outlier, and exact points' sides reach farther."""
    asked = []
    monkeypatch.setattr(object_mesh, "inliers", lambda p, most: asked.append(most) or np.ones(len(p), bool))
    monkeypatch.setattr(
        object_mesh,
        "extract_mesh",
        lambda prior, code, meshing, *_: asked.append(meshing.screening_length_multi_scan),
    )
    farther = dataclasses.replace(ROBUST.meshing, screening_length_multi_scan=0.3)
    config = dataclasses.replace(ROBUST, meshing=farther)
    often = scene.objects[0]
    doubted = tuple(
        dataclasses.replace(s, accumulated=s.scan == often.reference_scan) for s in often.observations
    )
    for o in (often, dataclasses.replace(often, observations=doubted)):
        object_mesh.object_mesh(tiny_prior, accumulated_object(o, scene.scans), config)
    assert len(often.observations) == 3
    assert asked == [ROBUST.meshing.outlier_factor_multi_scan, 0.3, ROBUST.meshing.outlier_factor, 0.0]


@pytest.mark.parametrize("steps", ["joint", "pose_graph"])
def test_without_steps_codes_and_poses_stay_and_with_them_they_do_not(tiny_prior, scene, steps):
    """The preset `robust` has none of `joint`, `paper` none of `pose_graph`."""
    none = {"joint": ROBUST.joint, "pose_graph": preset("paper").pose_graph}
    without = dataclasses.replace(CONFIG, **none)
    some = dataclasses.replace(without, **{steps: getattr(CONFIG, steps)})
    stayed, moved = (reconstruct(tiny_prior, scene, c) for c in (without, some))
    assert ROBUST.joint.steps == preset("paper").pose_graph.steps == 0
    for before, after, other in zip(scene.objects, stayed.objects, moved.objects, strict=True):
        assert after.embedding is before.embedding and after.observations is before.observations
        assert (other.embedding is not before.embedding) == (len(before.observations) > 1)


def test_another_scene_compiles_nothing_new(tiny_prior, scene):
    programs = (search._alignable, search._search_poses, surface._refine_poses)
    before = [p._cache_size() for p in programs]
    other = start_scene(tiny_prior, scan("d", {0: (2.0, 0.0), 1: (0.0, 3.0), 2: (1.0, 7.0)}), CONFIG)
    add_scan(tiny_prior, other, scan("e", {0: (1.0, 1.0), 2: (0.5, 6.0)}), CONFIG)
    assert min(before) >= 1 and [p._cache_size() for p in programs] == before


def test_scenes_of_other_sizes_compile_not_the_smallest_program(tiny_prior):
    """Programs stay in memory: a process that works on thousands of scenes would meet limits, and compiles are slow."""
    config, compiled = dataclasses.replace(CONFIG, joint=JointConfig(steps=0)), []

    def note(event, duration, **_):
        compiled.append(event.endswith("backend_compile_duration"))

    def build(name, *visits):
        made = start_scene(tiny_prior, scan(f"{name} 0", visits[0]), config)
        for k, visit in enumerate(visits[1:], start=1):
            made = add_scan(tiny_prior, made, scan(f"{name} {k}", visit), config)
        reconstruct(tiny_prior, made, config)

    here, there, far = {0: (0.0, 0.0)}, {1: (1.0, 3.0)}, {2: (0.5, 7.0)}
    jax.monitoring.register_event_duration_secs_listener(note)
    try:
        jax.jit(lambda x: x + 1)(0)
        assert sum(compiled)  # it is noted
        build("warm", here | there, here | there | far)
        compiled.clear()
        for n, visits in enumerate(
            [(here, here), (here | there | far,) * 2, (here, there | here, far | there)]
        ):
            build(str(n), *visits)
        assert not sum(compiled)
    finally:
        jax.monitoring.unregister_event_duration_listener(note)


def test_one_scan_alone_is_a_scene_without_changes(tiny_prior):
    made = start_scene(tiny_prior, scan("only", VISITS[0]), CONFIG)
    assert made.changes == ()
    assert [len(o.observations) for o in made.objects] == [1, 1]


def test_small_instances_are_reported_and_the_rest_goes_on(tiny_prior):
    whole = scan("a", VISITS[0])
    small = Instance(id=99, points=piece(0)[:5])
    made = start_scene(tiny_prior, dataclasses.replace(whole, instances=(*whole.instances, small)), CONFIG)
    assert [s.what for s in made.scans[0].skipped] == ["instance 99"]
    assert "5 points; needed 64" in made.scans[0].skipped[0].reason
    assert len(made.objects) == 2
    with pytest.raises(ValueError, match="none with 64 points"):
        start_scene(tiny_prior, dataclasses.replace(whole, instances=(small,)), CONFIG)


@pytest.mark.parametrize(
    ("lowest", "settings", "floor"),
    [
        (0.0, {}, 0.0),  # it stands on the floor
        (0.7, {}, 0.0),  # on a table, or its foot was hidden
        (-0.03, {}, 0.0),  # noise
        (-0.5, {}, None),  # down a step: this floor is not its own
        (0.0, {"upright": False}, None),
        (0.0, {"meshing": MeshingConfig()}, None),
    ],
)
def test_the_floor_under_an_object_is_that_of_its_room(scene, lowest, settings, floor):
    rng = np.random.default_rng(0)
    room = np.column_stack([rng.uniform(-3, 3, (4000, 2)), 0.002 * rng.normal(size=4000)])
    points = rng.uniform([-0.2, -0.2, lowest], [0.2, 0.2, lowest + 0.5], (500, 3))
    first = scene.objects[0].observations[:1]
    o = dataclasses.replace(
        scene.objects[0], observations=first, points=points, point_scan=np.zeros(500, int)
    )
    config = dataclasses.replace(preset("robust", upright=True), **settings)
    scans = [dataclasses.replace(scene.scans[0], background=b) for b in (room, np.zeros((0, 3)))]
    found = object_floor(accumulated_object(o, scans[:1]), config)
    assert found == (None if floor is None else pytest.approx(floor, abs=2e-3))
    assert object_floor(accumulated_object(o, scans[1:]), config) is None


def test_what_any_scan_shows_beneath_an_object_counts(scene):
    rng = np.random.default_rng(0)
    x, y = np.meshgrid(*[np.arange(-1, 1, 0.04)] * 2)
    room = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    points = rng.uniform([-0.3, -0.3, 0.0], [0.3, 0.3, 0.7], (500, 3))
    first = dataclasses.replace(scene.objects[0].observations[0], accumulated=True)
    moved = dataclasses.replace(first, scan=1, T_ref_scan=turn_z(0.7, np.zeros(3), np.array([2.0, 0.0, 0.0])))
    o = dataclasses.replace(
        scene.objects[0], observations=(first, moved), points=points, point_scan=np.arange(500) % 2
    )
    there = apply_pose(np.linalg.inv(moved.T_ref_scan), room)  # in the second scan's frame
    for backgrounds, share in (((room[:0], there), 1.0), ((room[:0], room), 0.0), ((room, room), 1.0)):
        scans = [dataclasses.replace(s, background=b) for s, b in zip(scene.scans, backgrounds, strict=False)]
        assert accumulated_object(o, scans).seen_beneath == share


def test_every_new_mesh_is_kept_as_it_is_told_and_no_other(monkeypatch, tiny_prior, scene):
    made = [Mesh(vertices=np.full((1, 3), float(k)), faces=np.zeros((0, 3), int)) for k in range(9)]
    monkeypatch.setattr(
        engine,
        "object_meshes",
        lambda prior, objects, config: map(made.__getitem__, range(len(list(objects)))),
    )
    kept = []

    def keep(mesh):
        kept.append(mesh)
        return Mesh(vertices=mesh.vertices + 100, faces=mesh.faces)

    *bare, last = (dataclasses.replace(o, mesh=None) for o in scene.objects)
    old = dataclasses.replace(last, mesh=MARK)
    done = reconstruct(tiny_prior, dataclasses.replace(scene, objects=(*bare, old)), CONFIG, keep=keep)
    assert [id(m) for m in kept] == [id(m) for m in made[: len(bare)]]
    assert [o.mesh.vertices[0, 0] for o in done.objects[:-1]] == [100.0 + k for k in range(len(bare))]
    assert done.objects[-1].mesh is MARK
