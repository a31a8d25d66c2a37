"""The whole method on one page (paper Alg. 1): start a living scene, add scans, reconstruct its objects."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from functools import partial
from typing import Any

import numpy as np

from more2_jax.config import EvidenceMatcher, SceneConfig
from more2_jax.freed_memory import give_back
from more2_jax.geometry.poses import Points, Pose
from more2_jax.matching.color import color_of
from more2_jax.meshing.engine import meshes_of_objects
from more2_jax.network.embedding_batch import embed
from more2_jax.network.prior import Prior
from more2_jax.network.remembered_rows import rows_remembered
from more2_jax.network.shared_calls import side_by_side
from more2_jax.progress import Watcher, staged
from more2_jax.refinement.joint_of_objects import fit_objects
from more2_jax.refinement.pose_graph_of_objects import refine_object_poses
from more2_jax.registration.pose_costs import asks_sensors
from more2_jax.tracking.accumulated import accumulated_objects, embed_accumulated, readable, with_refined
from more2_jax.tracking.changes import (
    changes_between,
    counted_alone,
    forgotten,
    not_seen_in,
    set_in_motion,
)
from more2_jax.tracking.comparison import Comparison
from more2_jax.tracking.identify import Found, Identified, chances, identify, with_left_over
from more2_jax.tracking.leveling import as_given, level_by_objects, level_of, leveled, shows_floor, tells_up
from more2_jax.tracking.looked_at import not_looked_at, not_looked_at_before, with_not_seen
from more2_jax.tracking.mask_borders import mend_borders
from more2_jax.tracking.mask_mends import Mend, mends_of_masks
from more2_jax.tracking.object_views import Views
from more2_jax.tracking.objects import SCENE_FRAME, accumulated, new_objects, next_number
from more2_jax.tracking.regrouped import Regrouped, as_sure_as_masks
from more2_jax.tracking.relocalize import accumulated_rows, known_object, relocalize, with_observations
from more2_jax.tracking.room_points import Cleared, remembered, without_room
from more2_jax.tracking.rooms import Rooms, rooms_of
from more2_jax.tracking.scan_record import record
from more2_jax.tracking.split_masks import Mended, mend_splits
from more2_jax.tracking.surroundings import surroundings, surroundings_of_objects
from more2_jax.tracking.unmasked import not_sought, without_unfound
from more2_jax.types import (
    Embedding,
    Instance,
    LivingScene,
    Mesh,
    Observation,
    ObservedObject,
    Repair,
    Scan,
    ScanRecord,
    SceneObject,
    Skipped,
)

# Regrouped masks, objects and instances as matching compared them, and the matches.
Compared = tuple[Regrouped, list[tuple[ObservedObject, Pose]], list[ObservedObject], Identified]

CLOSED_AT_ONCE = 64  # objects whose poses are refined in one call; each takes a MB


def start_scene(
    prior: Prior, scan: Scan, config: SceneConfig, *, progress: Watcher | None = None
) -> LivingScene:
    """Returns the living scene of one scan: every instance becomes an object. Raises ValueError if there is none.

    `progress` is called with an event of every stage, here and in the functions below.
    """
    config = settled(config, shows_floor(scan) if config.upright is None else config.upright)
    level, T_level_scan = leveled_scan(scan, config)
    masks, skipped = usable(level, config)
    cleared = without_floor_and_walls(masks, level, config)
    instances, timing = cleared.instances, dict[str, float]()
    with staged(timing, progress, "encode", len(instances), scan=scan.name):
        embeddings = embed(prior, [i.points for i in instances], [i.normals for i in instances])
    objects = new_objects(0, 0, range(len(instances)), instances, embeddings)
    objects, frame = as_given(list(objects.values()), 0, SCENE_FRAME, T_level_scan)
    return LivingScene(
        preset=config.preset,
        prior=prior.name,
        upright=bool(config.upright),
        scans=(record(0, scan, instances, skipped, frame, repairs=cleared.repairs(0, objects)),),
        objects=tuple(objects),
        changes=(),
        timing_s=timing,
    )


def who_is_who(
    prior: Prior,
    scene: LivingScene,
    instances: Sequence[Instance],
    scan: Scan,
    config: SceneConfig,
    stage: Callable[[str, int], AbstractContextManager[Any]],
) -> Compared:
    """Matches instances to objects. Masks in parts are joined first, and masks over two objects divided.

    Returns the regrouped masks, objects and instances as matching compared them, and the matches.
    """
    with stage("encode", len(instances)):
        embeddings = embed(prior, [i.points for i in instances], [i.normals for i in instances])
    masks = Regrouped(objects=list(scene.objects), instances=list(instances), embeddings=embeddings)
    rooms = rooms_of(scene, scan)

    def compare(masks: Regrouped) -> Compared:
        give_back(len(instances))
        known = dataclasses.replace(scene, objects=tuple(masks.objects))
        old, new = compared_objects(known, masks.instances, masks.embeddings, scan, config)
        return masks, old, new, identify(prior, [o for o, _ in old], new, config, rooms)

    def mended_by(mend: Mend, known: Compared) -> Regrouped | None:
        masks, old, new, identified = known
        give_back(len(new))
        compared = Comparison.of(prior, [o for o, _ in old], new, identified, config)
        return compared and mend(masks, compared)

    with stage("match", len(instances)), rows_remembered():
        known = compare(masks)
        for mend in mends_of_masks(scene, scan) if config.repair_masks else ():
            if mended := mended_by(mend, known):
                del known  # one comparison at a time is in memory
                known = compare(mended)
            elif mend is without_unfound:
                break
        masks, old, new, found = known
        found = as_sure_as_masks(with_left_over(found, config, rooms), masks, config)
        return masks, old, new, found.without_seen()


def add_scan(
    prior: Prior, scene: LivingScene, scan: Scan, config: SceneConfig, *, progress: Watcher | None = None
) -> LivingScene:
    """Adds a scan: matches its instances to the scene's objects, registers the pairs, and notes what changed.

    An object that was absent from earlier scans can come back. Meshes of objects that were seen again are dropped,
    and `reconstruct` makes new ones. Where objects are upright because the first scan has a floor, and this one has
    none, they are found in any orientation first, which tells where up is in this scan; then anew, upright. Raises
    ValueError if the scan has no usable instance.
    """
    scene, T_level_scan = readable(prior, scene), None
    if config.upright is None and scene.upright and not tells_up(remembered(scan.background)):
        found = added(prior, scene, scan, settled(config, False), progress)
        T_level_scan = level_by_objects(found, scan)
        if T_level_scan is None:
            return found
        scene = dataclasses.replace(scene, timing_s=found.timing_s)  # both took their time
    return added(prior, scene, scan, settled(config, scene.upright), progress, T_level_scan)


def added(
    prior: Prior,
    scene: LivingScene,
    scan: Scan,
    config: SceneConfig,
    progress: Watcher | None,
    T_level_scan: Pose | None = None,
) -> LivingScene:
    """`add_scan` with `upright` settled. `T_level_scan` levels the scan, where it is known."""
    level, T_level_scan = leveled_scan(scan, config, scene.scans[0], T_level_scan)
    masks, skipped = usable(level, config)
    cleared = without_floor_and_walls(masks, level, config)
    index, timing = len(scene.scans), dict(scene.timing_s)
    stage = partial(staged, timing, progress, scan=scan.name)
    whole, old, new, identified = who_is_who(prior, scene, cleared.instances, level, config, stage)
    with stage("register", len(found := identified.found)):
        give_back(len(found))  # what matching took
        views = Views(whole.objects, scene.scans, whole.instances, level, remembered(level.background))
        rooms = rooms_of(scene, level)
        seen, frame = relocalize(prior, views, old, new, identified, index, config, rooms)
    codes, identified, views, old, new = [o.embedding for o in new], identified.without_pairs(), None, (), ()
    mended = with_splits_mended(whole, found, seen, rooms, config)
    objects = with_observations(mended.objects, mended.instances, found, seen)
    objects, borders = with_borders_mended(objects, whole.masked(found), scene, level, config)
    if config.accumulate_target:
        with stage("encode", len(found)):
            objects = embed_accumulated(prior, objects, accumulated_rows(found, seen))
    missing, left = mended.left_over([(f.object, f.instance) for f in found])
    unseen = not_looked_at(objects, missing, level, frame, scene.upright)
    fresh = new_objects(next_number(objects, scene.scans), index, left, whole.instances, codes, frame)
    chance = chances(identified, objects, fresh, counted_alone(objects, missing, fresh, scene.scans), config)
    objects, frame = as_given([*mended.whole(objects), *fresh.values()], index, frame, T_level_scan)
    before = not_looked_at_before(objects, list(fresh.values()), scene.scans, scene.upright)
    repairs = (*whole.all_repairs(found, fresh), *mended.repairs)
    scene = forgotten(scene, {id_ for r in repairs for id_ in r.absorbed})
    repairs = (*repairs, *cleared.repairs(index, objects, repairs), *borders)
    earlier = with_not_seen(scene.scans, before, not_sought(whole, scene.scans))
    scans = (*earlier, record(index, scan, masks, skipped, frame, unseen, repairs))
    changes = (*scene.changes, changes_between(objects, index - 1, index, config, chance, not_seen_in(scans)))
    return dataclasses.replace(scene, scans=scans, objects=tuple(objects), changes=changes, timing_s=timing)


def with_poses_refined(
    prior: Prior,
    objects: list[SceneObject],
    chosen: Sequence[int],
    scans: Sequence[ScanRecord],
    config: SceneConfig,
) -> list[SceneObject]:
    """Returns the objects, the poses of the `chosen` refined by how their observations fit one another.

    What would then have moved between two scans, though it had not before, stays as it is.
    """
    for start in range(0, len(chosen), CLOSED_AT_ONCE):
        some = chosen[start : start + CLOSED_AT_ONCE]
        several = list(accumulated_objects(objects, some, scans))
        refined = refine_object_poses(prior, several, config)
        refined = with_refined(objects, some, refined)
        objects = [o if set_in_motion(o, r, config) else r for o, r in zip(objects, refined, strict=True)]
        give_back(len(objects))
    return objects


def reconstruct(
    prior: Prior,
    scene: LivingScene,
    config: SceneConfig,
    *,
    progress: Watcher | None = None,
    keep: Callable[[Mesh], Mesh] | None = None,
) -> LivingScene:
    """Refines the poses of objects that were seen more than once, then extracts the mesh of every object.

    `pose_graph.steps` (preset `robust`) aligns all observations of an object with one another. `joint.steps` (preset
    `paper`) optimizes code and poses together (paper §3.5). An object without a code of all its observations is
    encoded anew (§3.4). Doubtful observations (`Observation.accumulated` False) are left out. Objects that have a
    mesh are not touched: they have not changed since it was made. Every new mesh is passed through `keep`, such as
    `storage.waiting_meshes.WaitingMeshes`: those of a building need not all be in memory.
    """
    config, scene = settled(config, scene.upright), readable(prior, scene)
    timing, objects = dict(scene.timing_s), list(scene.objects)
    todo = [k for k, o in enumerate(objects) if o.mesh is None]
    again = [k for k in todo if len(accumulated(objects[k])) > 1]
    align, fit = again if config.pose_graph.steps else [], again if config.joint.steps else []
    with staged(timing, progress, "close", len(align)):
        objects = with_poses_refined(prior, objects, align, scene.scans, config)
    anew = [] if config.accumulate_target else again
    with staged(timing, progress, "encode", len(anew)):
        objects = embed_accumulated(prior, objects, anew)
    with staged(timing, progress, "joint", len(fit)):
        fitted = fit_objects(prior, list(accumulated_objects(objects, fit, scene.scans)), config)
        objects = with_refined(objects, fit, fitted)
    with staged(timing, progress, "mesh", len(todo)) as advance:
        meshes = meshes_of_objects(prior, accumulated_objects(objects, todo, scene.scans), config)
        for done, (k, mesh) in enumerate(zip(todo, meshes, strict=True), start=1):
            objects[k] = dataclasses.replace(objects[k], mesh=keep(mesh) if keep and mesh else mesh)
            advance(done)
    changes = tuple(
        changes_between(objects, c.from_scan, c.to_scan, config, c.probability, not_seen_in(scene.scans))
        for c in scene.changes
    )
    return dataclasses.replace(scene, objects=tuple(objects), changes=changes, timing_s=timing)


def run_scenes(
    prior: Prior,
    scenes: Sequence[Sequence[Scan]],
    config: SceneConfig,
    *,
    meshes: bool = True,
    at_once: int | None = None,
) -> list[LivingScene]:
    """Builds many living scenes side by side, each from a list of scans in time order.

    Results equal those of one scene at a time, to rounding. Compiled calls are filled with rows of several scenes
    (`network.shared_calls`). `at_once` scenes run between these calls, by default one a core. `meshes` False leaves
    `reconstruct` out. A scene that fails raises its ValueError after all others are done.
    """

    def one(scans: Sequence[Scan]) -> LivingScene:
        scene = start_scene(prior, scans[0], config)
        for scan in scans[1:]:
            scene = add_scan(prior, scene, scan, config)
        return reconstruct(prior, scene, config) if meshes else scene

    if empty := [n for n, scans in enumerate(scenes) if not len(scans)]:
        raise ValueError(f"scenes {empty} have no scans; needed one at least")
    return side_by_side(one, scenes, at_once)


def compared_objects(
    scene: LivingScene,
    instances: Sequence[Instance],
    embeddings: Sequence[Embedding],
    scan: Scan,
    config: SceneConfig,
) -> tuple[list[tuple[ObservedObject, Pose]], list[ObservedObject]]:
    """Returns objects (in the scene's frame, with the pose to their own) and instances as the stages take them."""
    of_objects, of_instances = [None] * len(scene.objects), [None] * len(instances)
    if isinstance(config.matching, EvidenceMatcher) and asks_sensors(config.matching.search, config.motion):
        views = Views(scene.objects, scene.scans, instances, scan, remembered(scan.background))
        of_objects, of_instances = views.of_objects(), views.of_instances()
    near, beside = surroundings_where_masks_may_be_wrong(scene, instances, scan, config)
    old = [
        known_object(o, view, config, around)
        for o, view, around in zip(scene.objects, of_objects, near, strict=True)
    ]
    new = [
        ObservedObject(
            points=i.points,
            embedding=e,
            color=color_of(i.colors),
            sight=view,
            normals=i.normals,
            around=around,
        )
        for i, e, view, around in zip(instances, embeddings, of_instances, beside, strict=True)
    ]
    return old, new


def usable(scan: Scan, config: SceneConfig) -> tuple[list[Instance], tuple[Skipped, ...]]:
    """Returns the instances with enough points, and what is left out. Raises ValueError if nothing remains."""
    need = config.min_points
    small = [i for i in scan.instances if len(i.points) < need]
    skipped = tuple(
        Skipped(what=f"instance {i.id}", reason=f"{len(i.points)} points; needed {need}") for i in small
    )
    if len(small) == len(scan.instances):
        raise ValueError(f"{scan.name}: {len(small)} instances, none with {need} points or more; needed one")
    return [i for i in scan.instances if len(i.points) >= need], (*scan.skipped, *skipped)


def surroundings_where_masks_may_be_wrong(
    scene: LivingScene, instances: Sequence[Instance], scan: Scan, config: SceneConfig
) -> tuple[Sequence[Points | None], Sequence[Points | None]]:
    """Returns the points around each object (in its own frame) and around each instance; None if masks are kept."""
    if not config.repair_masks:
        return [None] * len(scene.objects), [None] * len(instances)
    background = remembered(scan.background)
    return (
        surroundings_of_objects(scene.objects, scene.scans),
        surroundings([i.points for i in instances], background),
    )


def without_floor_and_walls(instances: list[Instance], scan: Scan, config: SceneConfig) -> Cleared:
    """Returns the instances without their points of floor or wall, if masks are repaired."""
    if not config.repair_masks:
        return Cleared(instances=instances)
    return without_room(instances, remembered(scan.background), config.min_points)


def with_splits_mended(
    whole: Regrouped, found: Sequence[Found], seen: Sequence[Observation], rooms: Rooms, config: SceneConfig
) -> Mended:
    """Returns objects and instances, leftovers joined to what they are parts of, if masks are repaired."""
    pairs = [(f.object, f.instance) for f in found if config.repair_masks]
    shown = rooms.surfaces if pairs and config.upright else None
    return mend_splits(whole.objects, whole.instances, pairs, seen[: len(pairs)], shown)


def with_borders_mended(
    objects: list[SceneObject], found: Sequence[Found], scene: LivingScene, scan: Scan, config: SceneConfig
) -> tuple[list[SceneObject], tuple[Repair, ...]]:
    """Returns the objects with the borders of their masks repaired. `scan`: the new one, leveled."""
    give_back(len(objects))  # what registration took
    if not config.repair_masks:
        return objects, ()
    index = len(scene.scans)
    backgrounds = {s.index: s.background for s in scene.scans} | {index: scan.background}
    return mend_borders(objects, [f.object for f in found], index, backgrounds)


def settled(config: SceneConfig, upright: bool) -> SceneConfig:
    """Returns the settings with `upright` filled in, if they leave it to the first scan."""
    return dataclasses.replace(config, upright=upright) if config.upright is None else config


def leveled_scan(
    scan: Scan, config: SceneConfig, first: ScanRecord | None = None, T_level_scan: Pose | None = None
) -> tuple[Scan, Pose]:
    """Returns the scan, leveled if the scene is upright, and T_level_scan, by its floor if it is not known.

    `first`: the scene's first scan.
    """
    if not config.upright:
        return scan, np.eye(4)
    if T_level_scan is None:
        T_level_first = None if first is None else first.frame.T_scene_scan
        T_level_scan = level_of(remembered(scan.background), T_level_first)
    return leveled(scan, T_level_scan), T_level_scan
