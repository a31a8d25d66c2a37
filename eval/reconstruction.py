"""How well objects are reconstructed: Chamfer, IoU, SDF recall, and what a user of meshes asks (paper §3.4 to §4).

`python -m eval.reconstruction --data data/flying_sparse --out runs/reconstruction --scenes 10 --scans 1`

With `--scans k` the observations of the first k scans are accumulated under their true poses: poses are another
program's business.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
import tyro
from jaxtyping import Float, Int

from eval.data.masks import LOST
from eval.data.truth import KnownObject, KnownScene
from eval.harness.batched import embed_all
from eval.harness.options import OptionsBeside, benchmark, told_upright
from eval.harness.program import Program, Summary, carry_out, run_program
from eval.harness.runs import Run, Work, open_run
from eval.peers.learned.methods import learned_surfacers
from eval.peers.learned.registry import stated
from eval.peers.reconstruction import SURFACERS, Surfacer
from eval.scores.figures import Column, Figure, Record
from eval.scores.mesh_scores import RECONSTRUCTED, mesh_scores
from more2_jax.config import SceneConfig, preset
from more2_jax.geometry.open_below import most_seen_beneath
from more2_jax.geometry.poses import apply_pose, turned
from more2_jax.meshing.engine import meshes_of_objects
from more2_jax.network.prior import Prior
from more2_jax.refinement.joint_of_objects import fit_objects
from more2_jax.tracking.object_views import few_sensors
from more2_jax.tracking.room_points import remembered
from more2_jax.types import AccumulatedObject, Mesh, Observation


@dataclass(frozen=True, kw_only=True)
class Settings(OptionsBeside):
    """Which data, which settings, and where results go."""

    scans: int = 1
    """How many scans are accumulated, under their true poses."""
    samples: int = 100_000
    """Points on each surface, and in the box of the inside tests."""
    learned: tuple[str, ...] = ()
    """Learned peers measured too: names of shipped weights, or files of `eval.peers.learned.train`."""


def _of(name: str, key: str, column: Column, **more: object) -> Figure:
    return replace(Figure(name=name, key=key, statistic="mean", column=column), **more)  # pyright: ignore[reportArgumentType]


JOINT_STEPS = 40  # where the preset has none

PERCENT = {"unit": "%", "scale": 100.0}
LENGTH = {"unit": "cm", "scale": 100.0, "better": "lower"}
AT_LEAST = {"statistic": "at_least", "limit": RECONSTRUCTED, **PERCENT}

FIGURES = [
    _of("Chamfer-L1", "chamfer.paper", "paper", unit="10⁻³", scale=1000.0, better="lower"),
    _of("Chamfer-L1", "chamfer.published", "published", unit="10⁻³", scale=1000.0, better="lower"),
    _of("Chamfer-L1", "chamfer_m.strict", "strict", **LENGTH),
    _of("Chamfer-L1, median", "chamfer_m.strict", "strict", **{**LENGTH, "statistic": "median"}),
    _of("accuracy", "accuracy_m", "strict", **LENGTH),
    _of("completeness", "completeness_m", "strict", **LENGTH),
    _of("completeness, of the diagonal", "completeness_diagonal", "strict", **{**PERCENT, "better": "lower"}),
    _of("F at 1 % of the diagonal", "f", "strict", **PERCENT),
    _of("IoU", "iou.paper", "paper", **PERCENT),
    _of("IoU", "iou.published", "published", **PERCENT),
    _of("SDF recall, points", "recall.paper", "paper", **PERCENT),
    _of("SDF recall, objects", "recall.published", "published", **AT_LEAST),
    _of("SDF recall, objects", "recall.strict", "strict", **AT_LEAST),
    _of("watertight", "watertight", "strict", **PERCENT),
    _of("time an object", "seconds", "", unit="s", better="lower", statistic="median"),
]
# Of 3RScan, whose true surfaces end where its scans do. In the strict column it is `completeness`.
ONE_WAY = [
    _of("Chamfer-L1, one way", f"one_way.{column}", column, unit="10⁻³", scale=1000.0, better="lower")
    for column in ("paper", "published")
]


def figures_of(dataset: str) -> list[Figure]:
    """What a table of a data set has."""
    return [*ONE_WAY, *FIGURES] if dataset == "3rscan" else FIGURES


def main(options: Annotated[Settings, tyro.conf.arg(name="")]) -> None:
    """Meshes of the method with and without joint optimization, and of what one would use instead."""
    carry_out(PROGRAM, options)


def prepare(options: Settings) -> tuple[Run, Work]:
    """The run, and what is done with its scenes."""
    peers = (SURFACERS if options.peers else {}) | learned_surfacers(options.learned)
    upright = told_upright(options, benchmark(options))
    ours = {name: preset(name, upright=upright) for name in options.presets}
    names = [n for name, config in ours.items() for n in own_names(name, config)]
    facts = {"methods": [*names, *peers], "scans": options.scans}
    facts |= {"samples": options.samples, **stated(options.learned)}
    current = open_run("reconstruction", options, facts)
    return current, lambda scenes: work(scenes, current.prior, ours, peers, options)


def own_names(preset: str, config: SceneConfig) -> tuple[str, str]:
    """The preset's, and the same with or without the joint optimization, whichever the preset is not.

    Of a single observation, the optimization is that of its code.
    """
    without = "without optimization" if config.joint.steps else "with joint optimization"
    return f"ours, {preset}", f"ours, {preset}, {without}"


def with_joint(config: SceneConfig) -> SceneConfig:
    """The settings with joint optimization, where the preset has none."""
    joint = dataclasses.replace(config.joint, steps=config.joint.steps or JOINT_STEPS)
    return dataclasses.replace(config, joint=joint)


@dataclass(frozen=True, kw_only=True)
class Seen:
    """An object with what the first scans saw of it, laid into the first scan's frame under the true poses."""

    scene: KnownScene
    known: KnownObject
    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"] | None  # zeros where not known; None: nowhere
    point_scan: Int[np.ndarray, " n"]
    observations: tuple[Observation, ...]


def seen_objects(scenes: Sequence[KnownScene], scans: int) -> list[Seen]:
    """The objects of the first scan that have a true mesh and that masks show."""
    known = [(s, o) for s in scenes for o in s.objects if o.mesh is not None]
    return [accumulated(s, o, scans) for s, o in known if o.instance.get(0, LOST) != LOST]


def accumulated(scene: KnownScene, o: KnownObject, scans: int) -> Seen:
    """What the first `scans` scans saw of an object."""
    there = [k for k, i in o.instance.items() if k < scans and i != LOST and o.same_shape(0, k)]
    poses = [o.true_pose(o, k, 0) for k in there]
    seen = [scene.instance(k, o.instance[k]) for k in there]
    clouds = [apply_pose(T, i.points) for i, T in zip(seen, poses, strict=True)]
    normals = [turned(T, i.normals) for i, T in zip(seen, poses, strict=True)]
    return Seen(
        scene=scene,
        known=o,
        points=np.concatenate(clouds),
        normals=None
        if all(n is None for n in normals)
        else np.concatenate(
            [np.zeros_like(c) if n is None else n for c, n in zip(clouds, normals, strict=True)]
        ),
        point_scan=np.concatenate([np.full(len(c), k) for k, c in zip(there, clouds, strict=True)]),
        observations=tuple(
            Observation(scan=k, instance=o.instance[k], T_ref_scan=T, score=1.0, rms_m=0.0, converged=True)
            for k, T in zip(there, poses, strict=True)
        ),
    )


def work(
    scenes: Sequence[KnownScene],
    prior: Prior,
    ours: Mapping[str, SceneConfig],
    peers: Mapping[str, Surfacer],
    o: Settings,
) -> list[list[Record]]:
    """All objects of some scenes: encoded, and optimized, together; then one mesh after the other."""
    seen = seen_objects(scenes, o.scans)
    plain, encoding_s = timed(lambda: embedded(prior, seen, o.batch), len(seen))
    records = [
        r
        for name, config in ours.items()
        for r in own_records(prior, seen, plain, encoding_s, name, config, o)
    ]
    for name, surface in peers.items():
        records += [scored(s, name, lambda s=s, f=surface: f(s.points), 0.0, o.samples) for s in seen]
    return [[r for n, r in records if n == scene.name] for scene in scenes]


def own_records(
    prior: Prior,
    seen: Sequence[Seen],
    plain: list[AccumulatedObject],
    encoding_s: float,
    preset: str,
    config: SceneConfig,
    o: Settings,
) -> list[tuple[str, Record]]:
    """Scene and record of every object, by a preset and by the same with or without joint optimization."""
    fitted, fitting_s = timed(lambda: fitted_in_batches(prior, plain, with_joint(config), o.batch), len(seen))
    both = [(fitted, encoding_s + fitting_s), (plain, encoding_s)]
    names = own_names(preset, config)
    return [
        scored(s, name, lambda own=own: next(meshes_of_objects(prior, [own], config)), spent_s, o.samples)
        for name, (objects, spent_s) in zip(names, both if config.joint.steps else both[::-1], strict=True)
        for s, own in zip(seen, objects, strict=True)
    ]


def timed(stage: Callable[[], list[AccumulatedObject]], count: int) -> tuple[list[AccumulatedObject], float]:
    """What a stage returns, and the seconds it took for each of `count`."""
    began = time.perf_counter()
    result = stage()
    return result, (time.perf_counter() - began) / max(1, count)


def embedded(prior: Prior, seen: Sequence[Seen], batch: int) -> list[AccumulatedObject]:
    """The objects in the rooms that their scans show, as refinement and meshing take them."""
    codes = embed_all(prior, [s.points for s in seen], batch, [s.normals for s in seen])
    return [
        AccumulatedObject(
            points=s.points,
            observation=np.searchsorted([seen.scan for seen in s.observations], s.point_scan),
            poses=np.stack([seen.T_ref_scan for seen in s.observations]),
            embedding=code,
            normals=s.normals,
            sensors=tuple(few_sensors(s.scene.scans[seen.scan]) for seen in s.observations),
            background=remembered(s.scene.scans[0].background),
            seen_beneath=seen_beneath(s),
        )
        for s, code in zip(seen, codes, strict=True)
    ]


def seen_beneath(seen: Seen) -> float:
    """The share of an object's footprint beneath which one of its scans shows background."""
    backgrounds = [remembered(seen.scene.scans[o.scan].background) for o in seen.observations]
    return most_seen_beneath(seen.points, [o.T_ref_scan for o in seen.observations], backgrounds)


def fitted_in_batches(
    prior: Prior, objects: Sequence[AccumulatedObject], config: SceneConfig, batch: int
) -> list[AccumulatedObject]:
    """Joint optimization of every object, `batch` a call."""
    found: list[AccumulatedObject] = []
    for start in range(0, len(objects), batch):
        part = objects[start : start + batch]
        found += fit_objects(prior, part, config)
    return found


def scored(
    s: Seen, method: str, make: Callable[[], Mesh | None], spent_s: float, samples: int
) -> tuple[str, Record]:
    """The record of one object, with its scene's name; `spent_s` came before the mesh."""
    began = time.perf_counter()
    mesh = make()
    seconds = spent_s + time.perf_counter() - began
    scores = mesh_scores(mesh, s.known, s.known.T_scan_model[0], samples)
    head = {"method": method, "object": s.known.name, "category": s.known.category, "seconds": seconds}
    return s.scene.name, {**head, **scores}


PROGRAM = Program(
    settings=Settings,
    prepare=prepare,
    summary=lambda o, right_deg: Summary(figures=figures_of(o.dataset), groups=("category",)),
)

if __name__ == "__main__":
    run_program(main)
