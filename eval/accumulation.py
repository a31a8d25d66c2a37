"""What every further scan adds: coverage, rotation error and Chamfer distance after 1, 2, … scans (paper §4).

`python -m eval.accumulation --data data/flying_sparse --out runs/accumulation --scenes 10`

The objects are those of the first scan. After k scans: how much of the true surface the accumulated points cover,
the rotation error of scan k's observation, and the distance of the mesh made then.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import trimesh
import tyro
from jaxtyping import Float
from scipy.spatial import KDTree

from eval.data.masks import LOST
from eval.data.truth import KnownObject, KnownScene
from eval.end_to_end import living_scenes, on_all_devices
from eval.harness.options import OptionsBeside, benchmark, told_upright
from eval.harness.plots import draw_over_scans
from eval.harness.program import Program, Summary, carry_out, run_program
from eval.harness.runs import Run, Work, open_run
from eval.scores.figures import Figure, Record, Row
from eval.scores.mesh_scores import mesh_scores, surface_points
from eval.scores.tracks import Track, pair_record, track_with, tracks_of
from more2_jax.config import SceneConfig
from more2_jax.geometry.poses import apply_pose
from more2_jax.network.prior import Prior
from more2_jax.scene import reconstruct

COVERED_M = 0.03  # a true point is covered by an accumulated one within it
COVERAGE_SAMPLES = 4_000

FIGURES = [
    Figure(name="coverage", key="coverage", statistic="mean", unit="%", scale=100),
    Figure(name="coverage, true poses", key="possible", statistic="mean", unit="%", scale=100),
    Figure(name="MedRE, strict", key="re_deg.strict", statistic="median", unit="°", better="lower"),
    Figure(name="RE < 5°, strict", key="re_deg.strict", statistic="share", limit=5, unit="%", scale=100),
    Figure(name="Chamfer-L1", key="chamfer_m.strict", statistic="mean", unit="cm", scale=100, better="lower"),
    Figure(name="IoU", key="iou.paper", statistic="mean", unit="%", scale=100),
]
PLOTTED = {
    "coverage": "coverage [%]",
    "MedRE, strict": "median rotation error [°]",
    "Chamfer-L1": "Chamfer-L1 [cm]",
}


@dataclass(frozen=True, kw_only=True)
class Settings(OptionsBeside):
    """Which data, which settings, and where results go."""

    samples: int = 20_000
    """Points on each surface."""


def main(options: Annotated[Settings, tyro.conf.arg(name="")]) -> None:
    """Coverage, rotation error and Chamfer distance over the number of scans."""
    carry_out(PROGRAM, options)


def prepare(options: Settings) -> tuple[Run, Work]:
    """The run, and what is done with its scenes."""
    ours = options.methods(told_upright(options, benchmark(options)))
    current = open_run("accumulation", options, {"samples": options.samples, "methods": list(ours)})

    def one(scene: KnownScene) -> list[Record]:
        right_deg = current.data.right_deg
        return [
            {"method": name, **r}
            for name, config in ours.items()
            for r in scene_records(scene, current.prior, config, right_deg, options.samples)
        ]

    return current, lambda scenes: on_all_devices(one, scenes, options.at_once)


def summary(options: Settings, right_deg: float) -> Summary:
    """Figures over the number of scans, and their plots."""

    def plots(out: Path, records: object, rows: Sequence[Row]) -> None:
        draw_over_scans(out / "accumulation", rows, PLOTTED)

    return Summary(figures=FIGURES, groups=("scans",), plots=plots)


def scene_records(
    scene: KnownScene, prior: Prior, config: SceneConfig, right_deg: float, samples: int
) -> list[Record]:
    """One record for every object of the first scan and every number of scans."""
    records: list[Record] = []
    for k, (tracks, reason) in enumerate(tracks_after_every_scan(scene, prior, config)):
        for o in scene.objects:
            if o.instance.get(0, LOST) != LOST and o.mesh is not None:
                track = track_with(tracks, 0, o.instance[0])
                found = object_record(scene, o, track, k, right_deg, samples)
                records.append({"scans": k + 1, "reason": reason, **found})
    return records


def tracks_after_every_scan(
    scene: KnownScene, prior: Prior, config: SceneConfig
) -> Iterator[tuple[list[Track], str]]:
    """What the method holds after each scan, and in words why it holds nothing.

    That is so from a scan on that it cannot use, as one without any mask: the method has failed on the rest.
    """
    scenes, reason = living_scenes(scene, prior, config), ""
    for _ in scene.scans:
        try:
            living = None if reason else next(scenes)
        except ValueError as error:
            living, reason = None, str(error)
        yield [] if living is None else tracks_of(reconstruct(prior, living, config)), reason


def object_record(
    scene: KnownScene, o: KnownObject, track: Track | None, k: int, right_deg: float, samples: int
) -> Record:
    """One object after scan k; its rotation error only if scan k has it."""
    record: Record = {"object": o.name, "category": o.category}
    if k > 0 and k in o.instance:
        lost = o.instance[k] == LOST
        record |= pair_record(scene, o, k, track, right_deg, None, lost=lost)
    surface = true_surface(o)
    record["possible"] = coverage(true_cloud(scene, o, k), surface)
    if track is None:
        return {**record, "coverage": 0.0, **mesh_scores(None, o, np.eye(4))}
    T_track_model = track.T_track_scan[0] @ o.T_scan_model[0]
    cloud = apply_pose(np.linalg.inv(T_track_model), track.points)
    return {
        **record,
        "coverage": coverage(cloud, surface),
        **mesh_scores(track.mesh, o, T_track_model, samples),
    }


def true_surface(o: KnownObject) -> Float[np.ndarray, "n 3"]:
    """Points on the true mesh, model frame. Raises ValueError if there is none."""
    if o.mesh is None:
        raise ValueError(f"{o.name}: no true mesh; needed one")
    mesh = trimesh.Trimesh(o.mesh.vertices, o.mesh.faces, process=False)
    return surface_points(mesh, COVERAGE_SAMPLES)


def true_cloud(scene: KnownScene, o: KnownObject, last: int) -> Float[np.ndarray, "n 3"]:
    """What was seen of an object in its first shape up to scan `last`, model frame, under the true poses."""
    seen = [(k, i) for k, i in o.instance.items() if k <= last and i != LOST and o.same_shape(0, k)]
    clouds = [apply_pose(np.linalg.inv(o.T_scan_model[k]), scene.instance(k, i).points) for k, i in seen]
    return np.concatenate(clouds)


def coverage(points: Float[np.ndarray, "n 3"], surface: Float[np.ndarray, "m 3"]) -> float:
    """Share of the surface within `COVERED_M` of a point."""
    return float((KDTree(points).query(surface)[0] < COVERED_M).mean())


PROGRAM = Program(settings=Settings, prepare=prepare, summary=summary)

if __name__ == "__main__":
    run_program(main)
