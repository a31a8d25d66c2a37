"""A room whose page has details: pages are made to hold so little that a few objects are many."""

import dataclasses
from contextlib import contextmanager

import numpy as np
import pytest
import trimesh
from factories import WORLD_M, scene_object

from more2_jax.report import details, payload
from more2_jax.types import Changes, LivingScene, Mesh, ScanRecord

FACES = 1280  # of every surface
POINTS = 900  # of every object, two thirds in the first scan
APART_M = 15.0  # none is near in the view of all


def detailed_room() -> LivingScene:
    """Five balls of half a meter in a row, each in two scans; the last has no surface."""
    return LivingScene(
        preset="robust",
        prior="small",
        upright=True,
        scans=tuple(ScanRecord(index=s, name=f"visit {s}", source="made up", instances=()) for s in (0, 1)),
        objects=tuple(_ball(k) for k in range(5)),
        changes=(Changes(from_scan=0, to_scan=1, static=tuple(f"object_{k:03d}" for k in range(5))),),
    )


def _ball(k: int):
    o = scene_object(k, {0: np.eye(4), 1: np.eye(4)}, mesh=False)
    solid = trimesh.creation.icosphere(subdivisions=3, radius=0.5)
    center = WORLD_M + [APART_M * k, 0.0, 0.0]
    out = np.random.default_rng(k).normal(size=(POINTS, 3))
    mesh = Mesh(vertices=np.array(solid.vertices) + center, faces=np.array(solid.faces, np.int32))
    return dataclasses.replace(
        o,
        points=center + 0.5 * out / np.linalg.norm(out, axis=1, keepdims=True),
        point_scan=np.repeat([0, 1], [2 * POINTS // 3, POINTS // 3]),
        normals=None,
        mesh=mesh if k < 4 else None,
    )


@contextmanager
def small_pages():
    """Within, a page alone holds 3 objects, 500 points or 200 faces; one with details 100 points."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(details, "MOST_IN_ONE_FILE", 3)
        patch.setattr(payload, "MAX_POINTS_WITH_DETAILS", 100)
        for module in (details, payload):
            patch.setattr(module, "MAX_POINTS", 500)
            patch.setattr(module, "MAX_FACES", 200)
        yield
