"""How well the method does on furniture of a source that no training used.

`python -m eval.unseen --source heldout_ikea.npz --scenes 5 --out runs/unseen`
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Literal

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table
from scipy.optimize import linear_sum_assignment

from eval.scores.figures import mean_ci95
from eval.scores.tracks import f1
from more2_jax.config import SceneConfig, preset
from more2_jax.metrics import symmetry_aware_rotation_error_deg
from more2_jax.network.prior import Prior, load_prior
from more2_jax.scene import add_scan, start_scene
from more2_jax.tracking.objects import reference_pose
from more2_jax.types import LivingScene
from train.furniture.collections import SourceMesh, read_meshes
from train.furniture.heldout import read_ikea
from train.furniture.symmetry import yaw_symmetry
from train.rooms.visits import FlyingConfig, FlyingScene, TrueObject, flying_scene
from train.run.program import run

RIGHT_DEG = 5.0
VERTICAL = np.array([0.0, 0, 1])


def main(
    source: Path,
    out: Path,
    prior: str = "small",
    scenes: int = 5,
    objects: int = 7,
    regime: Literal["paper", "sparse"] = "sparse",
    seed: int = 0,
    upright: bool = True,
) -> None:
    """Builds rooms of unseen furniture, two visits each, and scores matching, registration and changes.

    Args:
        source: packed .npz of meshes; one with `ikea` in its name is read as IKEA-Manuals-at-Work.
        out: folder for results.json.
        prior: name of shipped weights, or a file.
        scenes: rooms.
        objects: in a room; one goes, one comes, one stays.
        regime: `paper` (three clean views) or `sparse` (occlusion and noise).
        seed: of furniture, places and noise.
        upright: objects only turn about the vertical, and the method is told so.
    """
    meshes, weights = list((read_ikea if "ikea" in source.name else read_meshes)(source)), load_prior(prior)
    config = preset("robust", upright=upright)
    rows = [
        one_room(
            meshes,
            weights,
            config,
            FlyingConfig(2, regime, static=1, removed=1, added=1, free=not upright),
            k,
        )
        for k in track([(seed, n, objects) for n in range(scenes)], description="rooms")
    ]
    results = {name: summary([row[name] for row in rows]) for name in rows[0]}
    out.mkdir(parents=True, exist_ok=True)
    report = {"prior": weights.name, "regime": regime, **results}
    (out / "results.json").write_text(json.dumps(report, indent=1))
    Console().print(results_table(results))


def results_table(results: dict[str, dict[str, Any]]) -> Table:
    """Every figure with its interval."""
    table = Table("figure", "mean", "95 % interval", "rooms")
    for name, r in results.items():
        table.add_row(name, f"{r['mean']:.3f}", f"{r['ci95'][0]:.3f} … {r['ci95'][1]:.3f}", str(r["count"]))
    return table


def one_room(
    meshes: list[SourceMesh],
    prior: Prior,
    config: SceneConfig,
    flying: FlyingConfig,
    which: tuple[int, int, int],
) -> dict[str, float | None]:
    """Scores of one room."""
    seed, number, objects = which
    rng = np.random.default_rng((seed, number))
    chosen = [meshes[k] for k in rng.choice(len(meshes), objects, replace=False)]
    room = flying_scene(chosen, flying, rng)
    scene = start_scene(prior, room.scans[0], config)
    for scan in room.scans[1:]:
        scene = add_scan(prior, scene, scan, config)
    return score_room(scene, room)


def score_room(scene: LivingScene, room: FlyingScene) -> dict[str, float | None]:
    """Instance recall, recall of rotations below 5° (of all true pairs), F1 of changes, and what size alone recalls."""
    pairs = [o for o in room.objects if {0, 1} <= set(o.instance)]
    found = {o.observations[0].instance: o for o in scene.objects if o.reference_scan == 0}
    matched, right = [], []
    for true in pairs:
        seen = found[true.instance[0]].observations[1:]
        matched.append(bool(seen) and seen[0].instance == true.instance[1])
        T = np.linalg.inv(reference_pose(found[true.instance[0]]))
        right.append(matched[-1] and rotation_error(true, T @ seen[0].T_ref_scan) < RIGHT_DEG)
    gone = {o.name for o in room.objects if set(o.instance) == {0}}
    came = {o.name for o in room.objects if set(o.instance) == {1}}
    first, second = ({o.instance[s]: o.name for o in room.objects if s in o.instance} for s in (0, 1))
    by_id = {o.id: o for o in scene.objects}
    removed = {first[by_id[i].observations[0].instance] for i in scene.changes[0].removed}
    added = {second[by_id[i].observations[0].instance] for i in scene.changes[0].added}
    return {
        "instance recall": float(np.mean(matched)) if pairs else None,
        "registration recall 5°": float(np.mean(right)) if pairs else None,
        "added and removed, F1": f1(
            {f"-{n}" for n in removed} | {f"+{n}" for n in added},
            {f"-{n}" for n in gone} | {f"+{n}" for n in came},
        ),
        "instance recall, box extents alone": extents_recall(room) if pairs else None,
    }


def rotation_error(true: TrueObject, T_ref_scan: np.ndarray) -> float:
    """Degrees, up to the object's own symmetry about its vertical."""
    T_true = true.T_scan_model[0] @ np.linalg.inv(true.T_scan_model[1])
    axis = true.T_scan_model[1][:3, :3] @ VERTICAL
    order = yaw_symmetry(true.vertices, true.faces)
    return symmetry_aware_rotation_error_deg(T_ref_scan[:3, :3], T_true[:3, :3], axis, order)


def extents_recall(room: FlyingScene) -> float:
    """What a trivial descriptor recalls: sorted extents along the principal axes, Hungarian on their difference."""
    rows = []
    for scan in room.scans[:2]:
        extents = []
        for instance in scan.instances:
            centered = instance.points - instance.points.mean(axis=0)
            extents.append(
                np.sort(np.ptp(centered @ np.linalg.svd(centered, full_matrices=False)[2].T, axis=0))
            )
        rows.append(np.log(np.array(extents)))
    source, target = linear_sum_assignment(np.linalg.norm(rows[0][:, None] - rows[1][None], axis=-1))
    ids = [[i.id for i in scan.instances] for scan in room.scans[:2]]
    pairs = {(ids[0][a], ids[1][b]) for a, b in zip(source, target, strict=True)}
    true = [o.instance for o in room.objects if {0, 1} <= set(o.instance)]
    return float(np.mean([(t[0], t[1]) in pairs for t in true]))


def summary(rows: list[float | None]) -> dict[str, Any]:
    """Mean, interval and count over the rooms in which the figure is defined."""
    values = [value for value in rows if value is not None]
    return {"mean": float(np.mean(values)), "ci95": mean_ci95(values), "count": len(values)}


if __name__ == "__main__":
    run(main)
