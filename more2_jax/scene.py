"""The whole method on one page (paper Alg. 1): start a living scene, add scans, reconstruct its objects."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
from jaxtyping import Float

from more2_jax.closing import close_objects
from more2_jax.config import SceneConfig
from more2_jax.encoding import embed
from more2_jax.fitting import embed_accumulated, fit_objects
from more2_jax.frames import Rooms, floor_height
from more2_jax.meshing import extract_mesh, observed_level
from more2_jax.metrics import apply_pose
from more2_jax.objects import (
    SCENE_FRAME,
    accumulated,
    accumulated_points,
    changes_between,
    new_object,
    seen_again,
)
from more2_jax.outliers import inliers
from more2_jax.prior import Prior
from more2_jax.progress import Watcher, staged
from more2_jax.seen_surface import some_of
from more2_jax.sights import few_sensors, instances_with_sight, objects_with_sight, seen_from
from more2_jax.tracking import match_scan, register_in_frame
from more2_jax.types import Frame, Instance, LivingScene, Mesh, Scan, ScanRecord, SceneObject, Skipped

BACKGROUND_POINTS = 20_000  # of a scan, remembered for the page and for what its sensors looked through
STRAYS = 0.02  # share of an object's points that may lie below the floor,
BELOW_M = 0.05  # by more than this
# About 70 MB each: a scene of eight objects took 662 MB one at a time, 1,131 MB all at once.
MESHES_AT_ONCE = 8


def start_scene(
    prior: Prior, scan: Scan, config: SceneConfig, *, progress: Watcher | None = None
) -> LivingScene:
    """The living scene of one scan: every instance is an object, seen once. Raises ValueError if there is none.

    `progress` is told of every stage, here and below.
    """
    instances, skipped = usable(scan, config)
    timing: dict[str, float] = {}
    with staged(timing, progress, "encode", len(instances), scan=scan.name):
        embeddings = embed(prior, [i.points for i in instances])
    objects = [new_object(k, 0, i, e) for k, (i, e) in enumerate(zip(instances, embeddings, strict=True))]
    return LivingScene(
        preset=config.preset,
        prior=prior.name,
        upright=config.upright,
        scans=(record(0, scan, instances, skipped),),
        objects=tuple(objects),
        changes=(),
        timing_s=timing,
    )


def add_scan(
    prior: Prior, scene: LivingScene, scan: Scan, config: SceneConfig, *, progress: Watcher | None = None
) -> LivingScene:
    """Matches a new scan's instances to the scene's objects, registers every pair in one call, notes what changed.

    Objects that were absent for a while can come back. Meshes of objects seen again are dropped; `reconstruct`
    makes them anew. Raises ValueError if the scan has no usable instance.
    """
    instances, skipped = usable(scan, config)
    index, timing, objects = len(scene.scans), dict(scene.timing_s), list(scene.objects)
    stage = partial(staged, timing, progress, scan=scan.name)
    with stage("encode", len(instances)):
        embeddings = embed(prior, [i.points for i in instances])
    if config.registration.free_weight:
        instances = instances_with_sight(instances, scan, remembered(scan.background))
        objects = objects_with_sight(objects, scene.scans)
    with stage("match", len(instances)):
        identified = match_scan(prior, objects, instances, embeddings, config, rooms_of(scene, scan))
    found, chance = identified.found, {objects[k].id: p for k, p in identified.gone.items()}
    with stage("register", len(found), unit="pairs"):
        seen, frame = register_in_frame(prior, objects, instances, embeddings, identified, index, config)
    for f, observation in zip(found, seen, strict=True):
        objects[f.object] = seen_again(objects[f.object], instances[f.instance], observation)
        if config.matching.verify:
            chance[objects[f.object].id] = f.score  # that what came back is what it was
    if config.accumulate_target:
        with stage("encode", len(found)):
            changed = [f.object for f, s in zip(found, seen, strict=True) if s.accumulated]
            objects = embed_accumulated(prior, objects, changed)
    known = {f.instance for f in found}
    for i in (i for i in range(len(instances)) if i not in known):
        objects.append(new_object(len(objects), index, instances[i], embeddings[i], frame))
        chance |= {objects[-1].id: identified.new[i]} if i in identified.new else {}
    return dataclasses.replace(
        scene,
        scans=(*scene.scans, record(index, scan, instances, skipped, frame)),
        objects=tuple(dataclasses.replace(o, sight=None) for o in objects),
        changes=(*scene.changes, changes_between(objects, index - 1, index, config, chance)),
        timing_s=timing,
    )


def reconstruct(
    prior: Prior, scene: LivingScene, config: SceneConfig, *, progress: Watcher | None = None
) -> LivingScene:
    """Poses of objects seen more than once are made to agree, or optimised with the code; then meshes are extracted.

    `closing.steps` (`robust`): all observations of an object are laid onto one another at once. `joint.steps`
    (`paper`): code and poses of all objects are optimised in one call. Observations in doubt
    (`Observation.accumulated` False) have no part in it. Objects that have a mesh have not changed since and are left
    alone.
    """
    timing, objects = dict(scene.timing_s), list(scene.objects)
    todo = [k for k, o in enumerate(objects) if o.mesh is None]
    again = [k for k in todo if seen_often(objects[k])]
    close, fit = again if config.closing.steps else [], again if config.joint.steps else []
    with staged(timing, progress, "close", len(close)):
        floors = {k: floor_of(objects[k], scene.scans, config) for k in close}
        objects = close_objects(prior, objects, close, scene.scans, floors, config)
    with staged(timing, progress, "joint", len(fit)):
        objects = fit_objects(prior, objects, fit, config)
    with staged(timing, progress, "mesh", len(todo)) as advance:
        meshes = meshes_of(prior, [objects[k] for k in todo], scene.scans, config)
        for done, (k, mesh) in enumerate(zip(todo, meshes, strict=True), start=1):
            objects[k] = dataclasses.replace(objects[k], mesh=mesh)
            advance(done)
    changes = tuple(
        changes_between(objects, c.from_scan, c.to_scan, config, c.probability) for c in scene.changes
    )
    return dataclasses.replace(scene, objects=tuple(objects), changes=changes, timing_s=timing)


def floor_under(o: SceneObject, background: Float[np.ndarray, "b 3"], config: SceneConfig) -> float | None:
    """Height of the floor in an object's frame, metres; `background` is that of its reference scan.

    None if it is not asked for, there is none to see, or the object was seen clearly below it: then it is another's.
    """
    if not (config.upright and config.meshing.floor):
        return None
    floor = floor_height(background)
    if floor is None or float(np.quantile(accumulated_points(o)[:, 2], STRAYS)) < floor - BELOW_M:
        return None
    return floor


def floor_of(o: SceneObject, scans: Sequence[ScanRecord], config: SceneConfig) -> float | None:
    """`floor_under` an object in its reference scan."""
    return floor_under(o, scans[o.reference_scan].background, config)


def meshes_of(
    prior: Prior, objects: Sequence[SceneObject], scans: Sequence[ScanRecord], config: SceneConfig
) -> Iterator[Mesh | None]:
    """The objects' meshes in their order, `MESHES_AT_ONCE` worked on side by side: most steps keep one core busy."""
    with ThreadPoolExecutor(min(MESHES_AT_ONCE, os.cpu_count() or 1)) as pool:
        yield from pool.map(lambda o: mesh_of(prior, o, scans, config), objects)


def mesh_of(prior: Prior, o: SceneObject, scans: Sequence[ScanRecord], config: SceneConfig) -> Mesh | None:
    """The object's mesh, in a box that holds all that was seen of it, and above the floor of its reference scan.

    `level` "observed": seen points lie on the surface, so the field's median there is its bias, and is taken off.
    """
    points, eyes = trusted(o, scans, config)
    level = observed_level(prior, o.embedding, points) if config.meshing.level == "observed" else 0.0
    floor = floor_of(o, scans, config)
    half, meshing = box_half_width(o, config), config.meshing
    if not seen_often(o):
        meshing = dataclasses.replace(meshing, screening_of_many=0.0)
    return extract_mesh(prior, o.embedding, meshing, half, level, points, floor, eyes)


def seen_often(o: SceneObject) -> bool:
    """Whether several scans make up its shape."""
    return len(accumulated(o)) > 1


def trusted(
    o: SceneObject, scans: Sequence[ScanRecord], config: SceneConfig
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n s 3"] | None]:
    """What was seen of an object without outliers, thinned, in its frame; and from where, if that is known and used."""
    points = some_of(accumulated_points(o))
    eyes = seen_from(o, scans) if config.meshing.seen_reach else None
    most = config.meshing.outlier_factor_of_many if seen_often(o) else config.meshing.outlier_factor
    kept = inliers(points, most)
    return points[kept], None if eyes is None else some_of(eyes)[kept]


def box_half_width(o: SceneObject, config: SceneConfig) -> float:
    """Half the edge of the box to mesh, canonical units: at least the usual, and all of what was seen."""
    center = np.asarray(o.embedding.center, np.float64) + o.embedding.origin
    seen = np.quantile(np.abs(accumulated_points(o) - center).max(axis=1), 0.99) / float(o.embedding.scale)
    return float(np.clip(1.15 * seen, config.meshing.half_width, 3 * config.meshing.half_width))


def usable(scan: Scan, config: SceneConfig) -> tuple[list[Instance], tuple[Skipped, ...]]:
    """The instances with enough points, and what is left out; ValueError if nothing remains."""
    need = config.min_points
    small = [i for i in scan.instances if len(i.points) < need]
    skipped = tuple(
        Skipped(what=f"instance {i.id}", reason=f"{len(i.points)} points; needed {need}") for i in small
    )
    if len(small) == len(scan.instances):
        raise ValueError(f"{scan.name}: {len(small)} instances, none with {need} points or more; needed one")
    return [i for i in scan.instances if len(i.points) >= need], (*scan.skipped, *skipped)


def rooms_of(scene: LivingScene, scan: Scan) -> Rooms:
    """The background of the scan before and of a new one."""
    last = scene.scans[-1]
    return Rooms(scene=apply_pose(last.frame.T_scene_scan, last.background), scan=scan.background)


def record(
    index: int,
    scan: Scan,
    instances: list[Instance],
    skipped: tuple[Skipped, ...],
    frame: Frame = SCENE_FRAME,
) -> ScanRecord:
    """What the scene remembers of a scan."""
    return ScanRecord(
        index=index,
        name=scan.name,
        source=scan.source,
        instances=tuple(i.id for i in instances),
        skipped=skipped,
        frame=frame,
        background=remembered(scan.background),
        sensors=few_sensors(scan),
    )


def remembered(background: Float[np.ndarray, "b 3"]) -> Float[np.ndarray, "k 3"]:
    """Of what is no instance, points at even steps, `BACKGROUND_POINTS` at most."""
    return background[:: max(1, -(-len(background) // BACKGROUND_POINTS))]
