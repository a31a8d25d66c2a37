"""Why registration fails: what the errors of one method have in common, with pictures of the worst.

`python -m eval.failures --records runs/registration --data data/flying_sparse --out runs/failures`
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from eval.data.flyingshape import flyingshape
from eval.data.truth import KnownObject, KnownScene
from eval.harness.plots import pyplot, save
from eval.harness.run_folder import write_json
from eval.harness.tables import number
from eval.scores.figures import Record
from eval.scores.pose_scores import evenly
from more2_jax.geometry.poses import Points, apply_pose
from train.run.program import run

NEAR_DEG = 15.0  # of a quarter or half turn; and what is a slip rather than another place
LITTLE_OVERLAP = 0.5  # share of what either cloud shows that both show
WITHIN_M = 0.05  # points of two clouds show the same place
TIPPED_DEG = 45.0  # from the vertical, of an object that only turns about it
CAUSES = {
    "tipped": "tipped over, though objects only turn about the vertical",
    "turned": "turned by nearly a quarter or half: the object looks almost the same",
    "slipped": f"right but for less than {NEAR_DEG:g}°: the fit slides along the surface",
    "little": "elsewhere, and the two scans show different sides",
    "lost": "elsewhere, though the two scans show much the same",
    "none": "no pose",
}


def main(records: Path, data: Path, out: Path, method: str | None = None, examples: int = 1) -> None:
    """Counts the causes of failed registrations, and draws the first examples of each.

    Args:
        records: folder of a run of eval.registration.
        data: its data (open FlyingShape).
        out: folder of causes.json, causes.md and the pictures.
        method: one of the run's; the first otherwise.
        examples: pictures of each cause.
    """
    method = method or str(json.loads((records / "settings.json").read_text())["methods"][0])
    known = flyingshape(data)
    found: dict[str, list[dict[str, Any]]] = {cause: [] for cause in CAUSES}
    total = 0
    for file in sorted((records / "scenes").glob("*.json")):
        own = [r for r in json.loads(file.read_text()) if r["method"] == method]
        scene, total = known.read(file.stem), total + len(own)
        for r in own:
            if r["re_deg.strict"] is None or r["re_deg.strict"] >= known.right_deg:
                shown = overlap(scene, object_of(scene, r), r["to_scan"])
                found[cause_of(r, shown, known.upright)].append({**r, "scene": scene.name, "overlap": shown})
    out.mkdir(parents=True, exist_ok=True)
    write_json(out / "causes.json", {"method": method, "pairs": total, "causes": found})
    (out / "causes.md").write_text(table(found, total, method), encoding="utf-8")
    for cause, rows in found.items():
        for k, r in enumerate(rows[:examples]):
            picture(known.read(r["scene"]), r, out / f"{cause}_{k}", CAUSES[cause])
    print((out / "causes.md").read_text())


def object_of(scene: KnownScene, record: Record) -> KnownObject:
    """The object that a record speaks of."""
    return next(o for o in scene.objects if o.name == record["object"])


def overlap(scene: KnownScene, o: KnownObject, scan: int) -> float:
    """Share of the points of both clouds, under the true pose, that the other cloud shows too."""
    target = evenly(scene.instance(0, o.instance[0]).points)
    source = apply_pose(o.true_pose(o, scan, 0), evenly(scene.instance(scan, o.instance[scan]).points))
    near = [KDTree(b).query(a)[0] < WITHIN_M for a, b in ((source, target), (target, source))]
    return float(np.concatenate(near).mean())


def cause_of(record: Record, shown: float, upright: bool) -> str:
    """Which of `CAUSES` a failure is counted under."""
    error = record["re_deg.strict"]
    if error is None:
        return "none"
    if upright and np.array(record["pose"])[2, 2] < np.cos(np.deg2rad(TIPPED_DEG)):
        return "tipped"
    if error < NEAR_DEG:
        return "slipped"
    if min(abs(error - 90), abs(error - 180)) < NEAR_DEG:
        return "turned"
    return "little" if shown < LITTLE_OVERLAP else "lost"


def table(found: dict[str, list[dict[str, Any]]], total: int, method: str) -> str:
    """Causes by how often they occur."""
    lines = [
        f"| cause of a failed registration ({method}) | of {total} pairs | median overlap |",
        "|---|---|---|",
    ]
    for cause, rows in sorted(found.items(), key=lambda item: -len(item[1])):
        if rows:
            lines.append(
                f"| {CAUSES[cause]} | {len(rows)} | {number(float(np.median([r['overlap'] for r in rows])))} |"
            )
    return "\n".join([*lines, ""])


def picture(scene: KnownScene, r: Record, path: Path, title: str) -> list[Path]:
    """The reference, and the other scan's cloud under the true and the found pose; from the side and from above."""
    o = object_of(scene, r)
    target = evenly(scene.instance(0, o.instance[0]).points)
    source = evenly(scene.instance(r["to_scan"], o.instance[r["to_scan"]]).points)
    poses = {"true": o.true_pose(o, r["to_scan"], 0)}
    if r["pose"] is not None:
        poses["found"] = np.array(r["pose"])
    figure, panels = pyplot().subplots(2, len(poses), figsize=(3.2 * len(poses), 6), squeeze=False)
    for column, (name, T) in enumerate(poses.items()):
        draw(panels[:, column], target, apply_pose(T, source))
        panels[0, column].set_title(name, fontsize=9)
    figure.suptitle(f"{r['category']}, {r['scene']}: {title}", fontsize=8)
    return save(figure, path)


def draw(panels: Sequence[Any], target: Points, source: Points) -> None:
    """Both clouds from the side (x, z) and from above (x, y)."""
    for axes, (a, b) in zip(panels, ((0, 2), (0, 1)), strict=True):
        for points, color in ((target, "tab:gray"), (source, "tab:orange")):
            axes.scatter(points[:, a], points[:, b], s=1, c=color, linewidths=0)
        axes.set_aspect("equal")
        axes.set_xticks([])
        axes.set_yticks([])


if __name__ == "__main__":
    run(main)
