"""Living scenes (MoRE², CVPR 2024) in JAX: which object is which over repeated scans, where each went, and its mesh.

`start_scene`, `add_scan` and `reconstruct` are the whole method; `read_scan`, `load_prior` and `preset` give them what
they need. The other public names are the stages that these are built of. Lengths are meters; `T_a_b` takes points of
frame b to frame a.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from more2_jax import renamed

__version__ = "0.2.0"

# Public names and where they live. Imported on first use: `more2 --help` need not wait for JAX.
_HOMES = {
    "types": (
        "PointCloud",
        "Embedding",
        "Matches",
        "Registration",
        "Mesh",
        "Instance",
        "Scan",
        "LivingScene",
        "LocalBatch",
        "ObservedObject",
    ),
    "config": ("SceneConfig", "load_config", "preset"),
    "network.prior": ("Prior", "encode", "init_prior", "load_prior", "save_prior", "sdf"),
    "geometry.padding": ("pad_clouds",),
    "geometry.points": ("chamfer_distance", "kabsch"),
    "matching.code_assignment": ("match_instances",),
    "registration.register_pairs": ("register",),
    "registration.older_calls": ("world_pose",),
    "registration.pair_batch": ("PairBatch", "batch_of", "local_batch", "observe", "pair_up"),
    "meshing.extract": ("extract_mesh",),
    "refinement.joint": ("fit_jointly",),
    "scene": ("add_scan", "reconstruct", "run_scenes", "start_scene"),
    "scans.read_changed_scans": ("read_changed_scans",),
    "scans.read_scan": ("read_scan",),
    "storage.scene_folder": ("load_scene", "save_scene"),
}
_HOME_OF = {name: module for module, names in _HOMES.items() for name in names}

if TYPE_CHECKING:
    from more2_jax.config import SceneConfig, load_config, preset
    from more2_jax.geometry.padding import pad_clouds
    from more2_jax.geometry.points import chamfer_distance, kabsch
    from more2_jax.matching.code_assignment import match_instances
    from more2_jax.meshing.extract import extract_mesh
    from more2_jax.network.prior import Prior, encode, init_prior, load_prior, save_prior, sdf
    from more2_jax.refinement.joint import fit_jointly
    from more2_jax.registration.older_calls import world_pose
    from more2_jax.registration.pair_batch import PairBatch, batch_of, local_batch, observe, pair_up
    from more2_jax.registration.register_pairs import register
    from more2_jax.scans.read_changed_scans import read_changed_scans
    from more2_jax.scans.read_scan import read_scan
    from more2_jax.scene import add_scan, reconstruct, run_scenes, start_scene
    from more2_jax.storage.scene_folder import load_scene, save_scene
    from more2_jax.types import (
        Embedding,
        Instance,
        LivingScene,
        LocalBatch,
        Matches,
        Mesh,
        ObservedObject,
        PointCloud,
        Registration,
        Scan,
    )

__all__ = [
    "Embedding",
    "Instance",
    "LivingScene",
    "LocalBatch",
    "Matches",
    "Mesh",
    "ObservedObject",
    "PairBatch",
    "PointCloud",
    "Prior",
    "Registration",
    "Scan",
    "SceneConfig",
    "add_scan",
    "batch_of",
    "chamfer_distance",
    "encode",
    "extract_mesh",
    "fit_jointly",
    "init_prior",
    "kabsch",
    "load_config",
    "load_prior",
    "load_scene",
    "local_batch",
    "match_instances",
    "observe",
    "pad_clouds",
    "pair_up",
    "preset",
    "read_changed_scans",
    "read_scan",
    "reconstruct",
    "register",
    "run_scenes",
    "save_prior",
    "save_scene",
    "sdf",
    "start_scene",
    "world_pose",
]


renamed.install()

if not TYPE_CHECKING:  # a checker reads the imports above

    def __getattr__(name: str) -> Any:
        if name in _HOME_OF:
            return getattr(importlib.import_module(f"more2_jax.{_HOME_OF[name]}"), name)
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
