"""glTF binary: one named node an object, and an animation that goes through the scans, a second each."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float
from trimesh.exchange.gltf import export_glb
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from more2_jax.export.placing import PALE, State, Track, placed, quaternions, track
from more2_jax.report import rgb
from more2_jax.tracking.objects import number_of
from more2_jax.types import LivingScene, SceneObject

ROOT = "living_scene"  # the node that holds all objects and turns z up into glTF's y up
SECONDS_PER_SCAN = 1.0
T_YUP_ZUP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
FLOAT = 5126  # glTF's componentType of float32

Channels = dict[str, tuple[Float[np.ndarray, "scans _"], str]]  # path → values, interpolation


def write_glb(scene: LivingScene, path: Path, scan: int) -> None:
    """Objects as nodes under `ROOT`; at rest as in `scan`, in the animation `scans` as in scan t at t seconds.

    An object that is not seen or absent has scale 0, in steps: glTF has no other visibility that every viewer knows.
    Where a scan did not look, a node of its own, `<id>_not_seen`, shows the object pale at its last place.
    Positions are in the scene's frame, relative to the scene's middle, which `ROOT` holds in double precision.
    """
    T_scene_scan = scene.scans[scan].frame.T_scene_scan
    shown = [T @ [*o.points.mean(axis=0), 1.0] for _, o, T in placed(scene, scan)]
    middle = T_scene_scan @ np.mean(shown, axis=0)
    T_middle_scan = trimesh.transformations.translation_matrix(-middle[:3])
    graph = trimesh.Scene()
    graph.graph.update(
        frame_from=graph.graph.base_frame, frame_to=ROOT, matrix=T_YUP_ZUP @ np.linalg.inv(T_middle_scan)
    )
    channels: dict[str, Channels] = {}
    extras: dict[str, dict[str, Any]] = {}
    for o in scene.objects:
        node = track(o, scene.scans)
        for state, name, opacity in (("seen", o.id, 1.0), ("not_seen", f"{o.id}_not_seen", PALE)):
            if state in node.states:
                shape = _shape(o, node, opacity)
                graph.add_geometry(shape, node_name=name, geom_name=name, parent_node_name=ROOT)
                channels[name] = _channels(node, T_middle_scan, state)
                extras[name] = {"id": o.id, "label": o.label, "states": list(node.states)}
    path.write_bytes(export_glb(graph, buffer_postprocessor=_animator(channels, extras, scan)))


def _shape(o: SceneObject, node: Track, opacity: float) -> trimesh.PointCloud | trimesh.Trimesh:
    paint = [*rgb(number_of(o)), round(255 * opacity)]
    if o.mesh is None:
        return trimesh.PointCloud(node.vertices, colors=np.tile(paint, (len(node.vertices), 1)))
    shape = trimesh.Trimesh(node.vertices, o.mesh.faces, process=False)
    shape.visual = TextureVisuals(
        material=PBRMaterial(
            name=o.id,
            baseColorFactor=paint,
            metallicFactor=0.0,
            roughnessFactor=0.8,
            doubleSided=True,
            alphaMode=None if opacity == 1 else "BLEND",
        )
    )
    return shape


def _channels(node: Track, T_middle_scan: Float[np.ndarray, "4 4"], state: State) -> Channels:
    """What the node that shows an object in one state does at every scan."""
    poses = T_middle_scan @ node.poses(state)
    return {
        "translation": (poses[:, :3, 3], "LINEAR"),
        "rotation": (quaternions(poses), "LINEAR"),
        "scale": (np.repeat(node.shown(state)[:, None].astype(float), 3, axis=1), "STEP"),
    }


def _animator(
    channels: dict[str, Channels], extras: dict[str, dict[str, Any]], scan: int
) -> Callable[[dict[str, bytes], dict[str, Any]], None]:
    """What trimesh calls with its buffers and glTF tree before it packs them: adds poses and the animation."""

    def add(buffers: dict[Any, Any], tree: dict[str, Any]) -> None:
        scans = len(next(iter(channels.values()))["scale"][0])
        times = _accessor(buffers, tree, "times", SECONDS_PER_SCAN * np.arange(scans))
        animation: dict[str, Any] = {"name": "scans", "samplers": [], "channels": []}
        for index, node in enumerate(tree["nodes"]):
            if (name := node.get("name")) not in channels:
                continue
            node.pop("matrix", None)  # an animated node has translation, rotation, scale instead
            node["extras"] = extras[name]
            for path, (values, interpolation) in channels[name].items():
                node[path] = values[scan].tolist()
                output = _accessor(buffers, tree, f"{name} {path}", values)
                target = {"sampler": len(animation["samplers"]), "target": {"node": index, "path": path}}
                animation["channels"].append(target)
                sampler = {"input": times, "output": output, "interpolation": interpolation}
                animation["samplers"].append(sampler)
        tree["animations"] = [animation]

    return add


def _accessor(buffers: dict[Any, Any], tree: dict[str, Any], key: str, values: np.ndarray) -> int:
    """Appends float32 values to the file's buffer; returns the number of their accessor."""
    values = values.astype("<f4")
    buffers[key] = values.tobytes()
    tree["accessors"][key] = {
        "bufferView": len(buffers) - 1,
        "componentType": FLOAT,
        "count": len(values),
        "type": {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[1 if values.ndim == 1 else values.shape[1]],
        "min": values.min(axis=0, keepdims=values.ndim == 1).tolist(),
        "max": values.max(axis=0, keepdims=values.ndim == 1).tolist(),
    }
    return len(tree["accessors"]) - 1
