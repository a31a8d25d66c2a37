"""A scene over several scans: who is kept, what is skipped, what came and went, where things were put."""

from __future__ import annotations

import dataclasses
import time

import jax
import numpy as np
import pytest
from factories import scene_object, turn_z
from furnished import sheet
from small_scenes import CONFIG, MARK, ROBUST, piece, scan

import more2_jax.scene
from more2_jax.config import JointConfig, MeshingConfig, preset
from more2_jax.meshing import engine, object_mesh
from more2_jax.meshing.object_mesh import object_floor
from more2_jax.registration import search, surface
from more2_jax.scene import add_scan, reconstruct, start_scene
from more2_jax.tracking.accumulated import accumulated_object
from more2_jax.tracking.changes import moved_probability
from more2_jax.tracking.objects import next_number, points_of
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


def mended_and_kept(prior, visits: list[Scan]):
    """The scene of two scans with masks repaired, and with masks as they are."""
    return (
        add_scan(prior, start_scene(prior, visits[0], c), visits[1], c)
        for c in (CONFIG, dataclasses.replace(CONFIG, repair_masks=False))
    )


def in_parts(s: Scan) -> Scan:
    """The scan whose first instance falls into two, of which the smaller has the id 99."""
    first, *others = s.instances
    cut = first.points[:, 0] < np.quantile(first.points[:, 0], 0.7)
    parts = [dataclasses.replace(first, points=first.points[rows]) for rows in (cut, ~cut)]
    return dataclasses.replace(s, instances=(parts[0], *others, dataclasses.replace(parts[1], id=99)))


@pytest.mark.parametrize("split_scan", [0, 1])
def test_a_mask_in_parts_is_one_object_where_another_scan_shows_it_whole(tiny_prior, split_scan):
    visits = [scan(n, {0: (0.0, 0.0), 1: (0.3, 3.0)}) for n in "ab"]
    visits[split_scan] = in_parts(visits[split_scan])
    made, kept = mended_and_kept(tiny_prior, visits)
    assert [sorted(s.scan for s in o.observations) for o in made.objects] == [[0, 1]] * 2
    assert not made.changes[0].added and not made.changes[0].removed
    (repair,) = made.scans[1].repairs
    assert repair.object == "object_000" and repair.share > 0.9
    assert len(made.objects[0].points) == 2 * len(piece(0))
    assert (repair.instances, repair.absorbed) == (((), ("object_002",)), ((10, 99), ()))[split_scan]
    assert len(kept.objects) == 3 and not kept.scans[1].repairs
    assert len(kept.changes[0].added) + len(kept.changes[0].removed) == 1


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
    often = scene.objects[0]
    doubted = tuple(
        dataclasses.replace(s, accumulated=s.scan == often.reference_scan) for s in often.observations
    )
    for o in (often, dataclasses.replace(often, observations=doubted)):
        object_mesh.object_mesh(tiny_prior, accumulated_object(o, scene.scans), ROBUST)
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


def in_one(s: Scan) -> Scan:
    """The scan whose first two instances share one mask."""
    first, second, *others = s.instances
    both = dataclasses.replace(first, points=np.concatenate([first.points, second.points]))
    return dataclasses.replace(s, instances=(both, *others))


@pytest.mark.parametrize("merged_scan", [0, 1])
def test_a_mask_that_holds_two_objects_is_divided_where_another_scan_shows_them_apart(
    tiny_prior, merged_scan
):
    visits = [scan(n, {0: (0.0, 0.0), 1: (0.3, 3.0), 2: (0.1, -3.0)}) for n in "ab"]
    visits[merged_scan] = in_one(visits[merged_scan])
    made, kept = mended_and_kept(tiny_prior, visits)
    assert [sorted(s.scan for s in o.observations) for o in made.objects] == [[0, 1]] * 3
    assert not made.changes[0].added and not made.changes[0].removed
    (repair,) = made.scans[1].repairs
    assert repair.divided is not None and len(repair.instances) == merged_scan
    masks = [o.observations[merged_scan].instance for o in made.objects]
    assert sorted(masks.count(m) for m in set(masks)) == [1, 2]
    assert sum(len(o.points) for o in made.objects) == sum(len(i.points) for v in visits for i in v.instances)
    assert made.scans[merged_scan].instances == tuple(i.id for i in visits[merged_scan].instances)
    assert kept.changes[0].added or kept.changes[0].removed


@pytest.mark.parametrize(("merged", "expected"), [(True, [True, False]), (False, [False])])
def test_masks_are_looked_at_again_where_one_was_divided(tiny_prior, monkeypatch, merged, expected):
    """Its halves may show that a mask of the other scan holds two things as well."""
    found = []

    def noted(masks, compared, first_number, divide=more2_jax.scene.divide_merged):
        divided = divide(masks, compared, first_number)
        found.append(divided is not None)
        assert first_number == next_number(masks.objects, ())
        return divided

    monkeypatch.setattr(more2_jax.scene, "divide_merged", noted)
    visits = [scan(n, {0: (0.0, 0.0), 1: (0.3, 3.0), 2: (0.1, -3.0)}) for n in "ab"]
    first = in_one(visits[0]) if merged else visits[0]
    add_scan(tiny_prior, start_scene(tiny_prior, first, CONFIG), visits[1], CONFIG)
    assert found == expected


def furnished(name: str, seed: int) -> Scan:
    """Two pieces a little over a floor: their undersides are seen, and no part of it."""
    floor = sheet([-1.2, -1.2, -0.31], [5.0, 0, 0], [0, 2.4, 0], np.random.default_rng(seed))
    return dataclasses.replace(scan(name, {0: (0.0, 0.0), 1: (0.3, 3.0)}), background=floor)


def with_mask(s: Scan, points: np.ndarray, background: np.ndarray) -> Scan:
    """The scan with another mask of its first instance."""
    first, *others = s.instances
    instances = (dataclasses.replace(first, points=points), *others)
    return dataclasses.replace(s, instances=instances, background=background)


@pytest.mark.parametrize("dirty_scan", [0, 1])
def test_floor_in_a_mask_is_left_out_and_said_to_be(tiny_prior, dirty_scan):
    visits = [furnished("a", 0), furnished("b", 4)]
    dirty, own = visits[dirty_scan], visits[dirty_scan].instances[0].points
    beside = (np.abs(dirty.background - [0.5, 0.3, -0.31]) < [0.2, 0.2, 0.03]).all(axis=1)
    both = np.concatenate([own, dirty.background[beside]])
    visits[dirty_scan] = with_mask(dirty, both, dirty.background[~beside])
    made, kept = mended_and_kept(tiny_prior, visits)
    left = points_of(made.objects[0], made.objects[0].observations[dirty_scan])
    (repair,) = made.scans[dirty_scan].repairs
    assert (repair.object, repair.instances, repair.points) == ("object_000", (10,), len(both))
    assert repair.dropped == len(both) - len(left) > 0.9 * beside.sum() > 40
    assert set(map(bytes, np.round(own, 6))) <= set(map(bytes, np.round(left, 6)))
    assert not made.scans[1 - dirty_scan].repairs
    assert len(points_of(kept.objects[0], kept.objects[0].observations[dirty_scan])) == len(both)
    assert not any(s.repairs for s in kept.scans)


@pytest.mark.parametrize("cut_scan", [0, 1])
def test_what_was_cut_off_a_mask_comes_back_from_the_background(tiny_prior, cut_scan):
    visits = [furnished("a", 0), furnished("b", 4)]
    whole = visits[cut_scan].instances[0].points
    lost = whole[:, 0] > 0.1
    background = np.concatenate([visits[cut_scan].background, whole[lost]])
    visits[cut_scan] = with_mask(visits[cut_scan], whole[~lost], background)
    made, kept = mended_and_kept(tiny_prior, visits)
    (repair,) = made.scans[1].repairs
    assert repair.object == "object_000" and repair.regained > 0.9 * lost.sum() > 100
    assert repair.instances == ((), (10,))[cut_scan]
    counts = [
        [len(points_of(s.objects[0], seen)) for seen in s.objects[0].observations] for s in (made, kept)
    ]
    assert counts[0][cut_scan] == counts[1][cut_scan] + repair.regained == (~lost).sum() + repair.regained
    assert counts[0][1 - cut_scan] == counts[1][1 - cut_scan] == len(whole)
    assert not any(s.repairs for s in kept.scans)


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
