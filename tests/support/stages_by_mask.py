"""The three stages of a living scene without a network: masks of one number are one object, which stays.

For tests of what is written to disk: a scene takes milliseconds, and its bytes depend on the scans alone.
"""

import dataclasses
from unittest.mock import patch

import numpy as np
from factories import cube, embedding

from more2_jax import scene as stages
from more2_jax.types import Changes, LivingScene, Observation, ScanRecord, SceneObject


def start_scene(prior, scan, config, *, progress=None):
    """A living scene of one scan."""
    empty = LivingScene(
        preset=config.preset,
        prior=prior.name,
        upright=bool(config.upright),
        scans=(),
        objects=(),
        changes=(),
        timing_s={"encode": 0.25},
    )
    return add_scan(prior, empty, scan, config)


def add_scan(prior, scene, scan, config, *, progress=None):
    """The scene with one more scan; objects that are seen again lose their meshes."""
    index = len(scene.scans)
    known = {o.observations[0].instance: o for o in scene.objects}
    seen = {i.id: with_view(known.get(i.id), i, index) for i in scan.instances}
    objects = (known | seen).values()
    record = ScanRecord(index=index, name=scan.name, source=scan.source, instances=tuple(seen))
    change = Changes(
        from_scan=index - 1,
        to_scan=index,
        static=tuple(seen[k].id for k in seen.keys() & known.keys()),
        added=tuple(seen[k].id for k in seen.keys() - known.keys()),
    )
    return dataclasses.replace(
        scene,
        scans=(*scene.scans, record),
        objects=tuple(objects),
        changes=(*scene.changes, *([change] if index else [])),
    )


def with_view(known, instance, index):
    """The object, new or known, as the scan of that index shows it too."""
    view = Observation(
        scan=index, instance=instance.id, T_ref_scan=np.eye(4), score=1.0, rms_m=0.0, converged=True
    )
    owner = np.full(len(instance.points), index)
    if known is None:
        return SceneObject(
            id=f"object_{instance.id:03d}",
            label=instance.label,
            reference_scan=index,
            observations=(view,),
            points=instance.points,
            point_scan=owner,
            embedding=embedding(np.random.default_rng(instance.id), instance.points.mean(axis=0)),
        )
    return dataclasses.replace(
        known,
        observations=(*known.observations, view),
        points=np.concatenate([known.points, instance.points]),
        point_scan=np.concatenate([known.point_scan, owner]),
        mesh=None,
    )


def reconstruct(prior, scene, config, *, progress=None, keep=None):
    """The scene with a cube in place of every object."""
    objects = (dataclasses.replace(o, mesh=cube(o.points.mean(axis=0))) for o in scene.objects)
    return dataclasses.replace(scene, objects=tuple(objects))


def stages_by_mask():
    """A context in which `more2` builds scenes so."""
    return patch.multiple(stages, start_scene=start_scene, add_scan=add_scan, reconstruct=reconstruct)
