"""Which parts matter: embeddings of the matching, variables of the joint optimization, the descent of registration.

`python -m eval.ablations --data data/flying_sparse --out runs/ablations --scenes 4`

Joint optimization starts from the method's own poses of every scan onto the first, for true matches.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
import tyro

from eval.data.truth import KnownScene
from eval.harness.batched import PairToRegister, embed_all, register_all
from eval.harness.options import Options
from eval.harness.program import Program, Summary, carry_out, run_program
from eval.harness.runs import Run, Work, open_run
from eval.matching import RECALL, match_own
from eval.matching import record as match_record
from eval.reconstruction import Seen, embedded, fitted_in_batches, seen_objects, with_joint
from eval.registration import own_records, own_settings, true_pairs
from eval.scores.figures import Figure, Record, in_columns
from eval.scores.mesh_scores import RECONSTRUCTED, mesh_scores
from eval.scores.pose_scores import pose_scores
from more2_jax.config import CodeMatcher, JointConfig, SceneConfig
from more2_jax.geometry.observations import with_poses
from more2_jax.meshing.engine import meshes_of_objects
from more2_jax.network.prior import Prior
from more2_jax.types import AccumulatedObject, ObservedObject

RATES = {
    "pose": "pose_learning_rate",
    "inv": "inv_learning_rate",
    "eqv": "eqv_learning_rate",
    "center": "center_learning_rate",
}
# The rows that the paper prints, after the first, which frees nothing.
FREED: dict[str, tuple[str, ...]] = {
    "G": ("pose",),
    "G, F_c": ("pose", "center"),
    "G, F_eqv, F_c": ("pose", "eqv", "center"),
    "G, F_inv, F_eqv, F_c": ("pose", "inv", "eqv", "center"),
}
Study = Literal["matching", "registration", "joint"]
SCORES = {"Λ": "inv", "1 / E": "eqv", "Λ ⊘ E": "both"}

SHARE = Figure(name="", key="", statistic="share", unit="%", scale=100)
ERROR = Figure(
    name="MedRE", key="re_deg.strict", statistic="median", column="strict", unit="°", better="lower"
)
LENGTH = Figure(
    name="Chamfer-L1",
    key="chamfer_m.strict",
    statistic="mean",
    column="strict",
    unit="cm",
    scale=100,
    better="lower",
)
FIGURES = [
    *in_columns(RECALL),
    replace(SHARE, name="RE < 5°", key="re_deg.strict", limit=5, column="strict"),
    ERROR,
    replace(ERROR, name="mean RE", statistic="mean"),
    LENGTH,
    replace(LENGTH, name="median Chamfer-L1", statistic="median"),
    replace(SHARE, name="IoU", key="iou.paper", statistic="mean", column="paper"),
    replace(
        SHARE,
        name="SDF recall, objects",
        key="recall.strict",
        statistic="at_least",
        limit=RECONSTRUCTED,
        column="strict",
    ),
]


@dataclass(frozen=True, kw_only=True)
class Settings(Options):
    """Which data, which settings, and where results go."""

    scans: int = 5
    """Scans that the joint optimization sees."""
    samples: int = 20_000
    """Points on each surface."""
    studies: tuple[Study, ...] = ("matching", "registration", "joint")
    """Which."""
    joint_points: int = 0
    """Of every observation in the joint optimization; 0: as the preset has it."""


def main(options: Annotated[Settings, tyro.conf.arg(name="")]) -> None:
    """One table a study; methods are named after the study and the setting."""
    carry_out(PROGRAM, options)


def prepare(options: Settings) -> tuple[Run, Work]:
    """The run, and what is done with its scenes."""
    stated = {n: getattr(options, n) for n in ("scans", "samples", "studies", "joint_points")}
    current = open_run("ablations", options, stated)
    prior, config = current.prior, current.config
    if options.joint_points:
        config = replace(config, joint=replace(config.joint, points=options.joint_points))
    studies: dict[Study, Callable[[Sequence[KnownScene]], list[tuple[str, Record]]]] = {
        "matching": lambda scenes: matching_study(scenes, prior, options),
        "registration": lambda scenes: registration_study(scenes, prior, config, options),
        "joint": lambda scenes: joint_study(scenes, prior, config, options),
    }

    def work(scenes: Sequence[KnownScene]) -> list[list[Record]]:
        found = [r for study in options.studies for r in studies[study](scenes)]
        return [[r for n, r in found if n == s.name] for s in scenes]

    return current, work


def matching_study(scenes: Sequence[KnownScene], prior: Prior, o: Settings) -> list[tuple[str, Record]]:
    """Λ, 1/E and Λ ⊘ E, assigned alike (paper's preset)."""
    found = []
    for scene in scenes:
        counts = np.cumsum([len(s.instances) for s in scene.scans])
        codes = embed_all(prior, [i.points for s in scene.scans for i in s.instances], o.batch)
        by_scan = [codes[b - len(s.instances) : b] for b, s in zip(counts, scene.scans, strict=True)]
        for name, score in SCORES.items():
            config = SceneConfig(matching=CodeMatcher(score=score))  # pyright: ignore[reportArgumentType]
            for b in range(1, len(scene.scans)):
                one, other = scene.scans[0].instances, scene.scans[b].instances
                matched = match_own(prior, one, by_scan[0], other, by_scan[b], config)
                record = match_record(scene, b, f"matching by {name}", matched, 0.0)
                # The other studies' `recall` is that of surfaces.
                found.append((scene.name, {k: v for k, v in record.items() if not k.startswith("recall.")}))
    return found


def registration_study(
    scenes: Sequence[KnownScene], prior: Prior, config: SceneConfig, o: Settings
) -> list[tuple[str, Record]]:
    """With and without descent on the loss."""
    pairs = [p for s in scenes for p in true_pairs(s)]
    settings = {
        n.replace(f"ours, {o.preset}", "registration"): c
        for n, c in own_settings(o.preset, bool(config.upright)).items()
    }
    return own_records(pairs, prior, settings, bool(config.upright), o.batch)


def joint_study(
    scenes: Sequence[KnownScene], prior: Prior, config: SceneConfig, o: Settings
) -> list[tuple[str, Record]]:
    """Poses as registered, then the joint optimization with each set of variables freed (`FREED`)."""
    seen = seen_objects(scenes, o.scans)
    start = registered(prior, seen, embedded(prior, seen, o.batch), config, o.batch)
    found = joint_records(seen, start, prior, config, "joint: nothing", o.samples)
    for name, freed in FREED.items():
        own = dataclasses.replace(config, joint=only(with_joint(config).joint, freed))
        fitted = fitted_in_batches(prior, start, own, o.batch)
        found += joint_records(seen, fitted, prior, config, f"joint: {name}", o.samples)
    return found


def only(config: JointConfig, freed: Sequence[str]) -> JointConfig:
    """The settings with a step size of zero for what is not freed."""
    return replace(config, **{rate: 0.0 for name, rate in RATES.items() if name not in freed})


def registered(
    prior: Prior, seen: Sequence[Seen], objects: Sequence[AccumulatedObject], config: SceneConfig, batch: int
) -> list[AccumulatedObject]:
    """The objects with the method's own poses in place of the true ones, encoded anew."""
    raw = [[s.scene.instance(o.scan, o.instance).points for o in s.observations] for s in seen]
    codes = embed_all(prior, [c for clouds in raw for c in clouds], batch)
    pairs, used = [], 0
    for clouds in raw:
        own = codes[used : used + len(clouds)]
        pairs += [
            PairToRegister(
                source=ObservedObject(points=c, embedding=e),
                target=ObservedObject(points=clouds[0], embedding=own[0]),
            )
            for c, e in zip(clouds[1:], own[1:], strict=True)
        ]
        used += len(clouds)
    poses = iter(register_all(prior, pairs, config.registration, config.motion, batch))
    posed = [
        with_poses(x, [np.eye(4), *(next(poses) for _ in clouds[1:])])
        for x, clouds in zip(objects, raw, strict=True)
    ]
    again = embed_all(prior, [x.points for x in posed], batch)
    return [dataclasses.replace(x, embedding=e) for x, e in zip(posed, again, strict=True)]


def joint_records(
    seen: Sequence[Seen],
    objects: Sequence[AccumulatedObject],
    prior: Prior,
    config: SceneConfig,
    method: str,
    samples: int,
) -> list[tuple[str, Record]]:
    """One record of each object's mesh, and one of each of its poses."""
    found = []
    for s, own in zip(seen, objects, strict=True):
        scores = mesh_scores(
            next(meshes_of_objects(prior, [own], config)), s.known, s.known.T_scan_model[0], samples
        )
        found.append((s.scene.name, {"method": method, "object": s.known.name, **scores}))
        target = s.scene.instance(0, s.known.instance[0]).points
        for o, T_ref_scan in zip(s.observations[1:], own.poses[1:], strict=True):
            source = s.scene.instance(o.scan, o.instance).points
            pose = pose_scores(T_ref_scan, s.known, s.known, o.scan, 0, source, target)
            found.append((s.scene.name, {"method": method, "to_scan": o.scan, **pose}))
    return found


PROGRAM = Program(settings=Settings, prepare=prepare, summary=lambda o, right_deg: Summary(figures=FIGURES))

if __name__ == "__main__":
    run_program(main)
