"""Small rooms of regime `real`, scanned quickly."""

import dataclasses

import numpy as np
import trimesh

from train.furniture.collections import SourceMesh
from train.rooms import mask_flaws
from train.rooms.depth_sensor import DepthSensor
from train.rooms.fused_scan import ScanSettings
from train.rooms.hand_held import Walk
from train.rooms.real_visits import RealConfig, RealScene, real_scene

QUICK = ScanSettings(
    sensor=DepthSensor(width=80, height=60),
    walk=Walk(views_of_an_object=2, views_of_walls=5, frames_a_view=3),
    voxel_m=(0.04, 0.04),
    kept_faces=(0.8, 0.8),
)


def chair(name: str, width: float, deep: float, high: float) -> SourceMesh:
    """A block with a back: no symmetry."""
    seat = trimesh.creation.box((width, deep, high / 2))
    back = trimesh.creation.box((width, 0.1, high / 2 + 0.01))
    back.apply_translation((0, deep / 2 - 0.05, high / 2))
    both = trimesh.boolean.union([seat, back], engine="manifold")
    return SourceMesh(
        name=name, category="chair", vertices=both.vertices, faces=both.faces, source="boxes", license="CC0"
    )


MODELS = [chair(f"chair_{k}", 0.4 + 0.06 * k, 0.5, 0.7 + 0.1 * k) for k in range(5)]


def made(masks: mask_flaws.Masks = "perfect", seed: int = 1, **more) -> RealScene:
    config = RealConfig(**{"scans": 2, "scanned": dataclasses.replace(QUICK, masks=masks)} | more)
    return real_scene(MODELS, config, np.random.default_rng(seed), "scene_0000")
