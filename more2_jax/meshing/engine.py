"""Where meshes are made: one at a time on the host, or many at once on the device; the same meshes, nearly."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator

import jax
import numpy as np

from more2_jax.config import MeshingConfig, SceneConfig
from more2_jax.geometry.observations import seen_from
from more2_jax.meshing.device.batch import PaddedObject, overflows, padded_object, placed_mesh, surfaces
from more2_jax.meshing.extract import check_resolutions
from more2_jax.meshing.object_mesh import (
    box_half_width,
    in_several_scans,
    object_floor,
    object_mesh,
    object_meshes,
    unseen_rise,
)
from more2_jax.meshing.observed_surface import uniform_subsample
from more2_jax.network.prior import Prior
from more2_jax.types import AccumulatedObject, Mesh

# Of a compiled call, by `config.memory_mb`: what XLA sets aside for an object of 16,384 points on a grid of 128 cells.
OBJECTS_A_CALL, OBJECT_MB = 8, 320


def meshes_of_objects(
    prior: Prior, objects: Iterable[AccumulatedObject], config: SceneConfig
) -> Iterator[Mesh | None]:
    """The objects' meshes in their order; None where a field has no surface.

    Of `objects` no more are drawn than are worked on.
    """
    make = device_meshes if on_device(config.meshing) else object_meshes
    return make(prior, objects, config)


def on_device(config: MeshingConfig) -> bool:
    """Whether meshes are made on the device: on accelerators, unless the settings decide it."""
    return config.engine == "device" or (config.engine == "auto" and jax.default_backend() != "cpu")


def device_meshes(
    prior: Prior, objects: Iterable[AccumulatedObject], config: SceneConfig
) -> Iterator[Mesh | None]:
    """Meshes in compiled calls of a fixed number of objects: what `config.memory_mb` holds, `OBJECTS_A_CALL` at most.

    On a CPU one. A surface that the call has no room for is made on the host.
    """
    check_resolutions(config.meshing)
    at_once = int(np.clip(config.memory_mb // OBJECT_MB, 1, OBJECTS_A_CALL))
    at_once = 1 if jax.default_backend() == "cpu" else at_once
    waiting = iter(objects)
    while some := list(itertools.islice(waiting, at_once * len(jax.local_devices()))):
        rows = [as_row(o, config) for o in some]
        found = surfaces(prior, rows, config.meshing, at_once)
        for n, (o, row) in enumerate(zip(some, rows, strict=True)):
            surface = jax.tree.map(lambda x, n=n: np.asarray(x[n]), found)
            if overflows(surface):
                yield object_mesh(prior, o, config)
            else:
                yield placed_mesh(surface, o.embedding, float(row.half_width), config.meshing)


def as_row(o: AccumulatedObject, config: SceneConfig) -> PaddedObject:
    """An object as the device takes it: at most as many points as on the host, the same ones."""
    sensors = seen_from(o) if config.meshing.mls_bandwidth else None
    normals = o.normals if config.meshing.mls_bandwidth else None
    return padded_object(
        o.embedding,
        uniform_subsample(o.points),
        box_half_width(o),
        object_floor(o, config),
        in_several_scans(o),
        unseen_rise(o, config),
        None if sensors is None else uniform_subsample(sensors),
        None if normals is None else uniform_subsample(normals),
    )
