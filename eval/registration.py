"""Where matched objects went: rotation errors, recalls and distances over true pairs (paper §3.3 and §4).

`python -m eval.registration --data data/flying_sparse --out runs/registration --scenes 10`

Of upright things scans are leveled by their floors first, for all methods; masks stay as they are.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro

from eval.data.masks import LOST
from eval.data.tilted import leveled_scans
from eval.data.truth import KnownObject, KnownScene
from eval.harness.batched import PairToRegister, embed_all, register_all
from eval.harness.closed_pairs import closed_poses
from eval.harness.options import Descending, OptionsBeside, benchmark, is_upright, undescended
from eval.harness.plots import draw_ecdf
from eval.harness.program import Program, Summary, carry_out, run_program
from eval.harness.runs import Run, Work, open_run
from eval.peers.learned.methods import learned_registrars
from eval.peers.learned.registry import stated
from eval.peers.registration import Registrar, registrars
from eval.performance.stopwatch import Clock, clock, told
from eval.scores.figures import Figure, Record, in_columns
from eval.scores.pose_scores import Pose, pose_scores
from more2_jax.config import (
    DescentRegistration,
    MotionModel,
    RegistrationMethod,
    SceneConfig,
    SurfaceRegistration,
    preset,
)
from more2_jax.geometry.free_space import sight_of
from more2_jax.network.prior import Prior
from more2_jax.types import Embedding, Instance, ObservedObject, Scan, Sight

CLOSED = "laid onto one another"
KABSCH = "Kabsch on F_eqv alone"  # a learned peer, as FreeReg: one look at the codes


@dataclass(frozen=True, kw_only=True)
class Settings(OptionsBeside):
    """Which data, which settings, and where results go."""

    pairs: Literal["first", "all", "rigid"] = "all"
    """Every later scan onto the first, or only the second (as the published evaluation of FlyingShape has it), or only
    objects of which 3RScan lists a rigid motion there (as that of 3RScan has it)."""
    learned: tuple[str, ...] = ()
    """Learned peers measured too: names of shipped weights, or files of `eval.peers.learned.train`."""


@dataclass(frozen=True, kw_only=True)
class TruePair:
    """A true match: the object as scan `scan` saw it, onto how the first scan saw it."""

    scene: KnownScene
    object: KnownObject
    scan: int

    @property
    def instances(self) -> tuple[Instance, Instance]:
        """Source and target."""
        own = self.object.instance
        return self.scene.instance(self.scan, own[self.scan]), self.scene.instance(0, own[0])

    @property
    def clouds(self) -> tuple[np.ndarray, np.ndarray]:
        """Their points, each in its scan's frame."""
        source, target = self.instances
        return source.points, target.points

    def sights(self) -> tuple[Sight | None, Sight | None]:
        """What the sensors of both scans saw around the object, where the data say how they stood."""
        source, target = self.clouds
        return sight_in(self.scene.scans[self.scan], source), sight_in(self.scene.scans[0], target)


def sight_in(scan: Scan, cloud: np.ndarray) -> Sight | None:
    """What a scan's sensors saw around one of its clouds."""
    return sight_of(
        cloud, np.concatenate([*(i.points for i in scan.instances), scan.background]), scan.sensors
    )


def figures(right_deg: float) -> list[Figure]:
    """The figures of paper §4; a success is a rotation error below `right_deg`."""
    share = Figure(
        name=f"RR, RE < {right_deg:g}°", key="re_deg", statistic="share", limit=right_deg, unit="%"
    )
    share = dataclasses.replace(share, scale=100)
    median = Figure(name="MedRE", key="re_deg", statistic="median", unit="°", better="lower")
    rmse = dataclasses.replace(median, name="median RMSE", key="rmse_m", unit="cm", scale=100)
    # The published medians are over successes only.
    of_successes = [
        dataclasses.replace(f, successes=("re_deg.published", right_deg)) if f.column == "published" else f
        for f in (*in_columns(median), *in_columns(rmse))
    ]
    strict = dataclasses.replace(share, column="strict")
    distance = dataclasses.replace(median, name="MedCD", unit="m²")
    time = Figure(name="time a pair", key="seconds", statistic="median", unit="s", better="lower")
    return [
        *in_columns(share),
        dataclasses.replace(strict, name="RE < 10°", key="re_deg.strict", limit=10),
        dataclasses.replace(strict, name="within 5 cm", key="te_m.strict", limit=0.05),
        *of_successes,
        dataclasses.replace(distance, key="cd_m2.paper", column="paper"),
        dataclasses.replace(distance, key="cd_m2.published", column="published"),
        dataclasses.replace(distance, key="cd_m.strict", column="strict", unit="cm", scale=100),
        time,
        dataclasses.replace(time, name="processor time a pair", key="cpu_seconds"),
    ]


def main(options: Annotated[Settings, tyro.conf.arg(name="")]) -> None:
    """Registration of true pairs by the method, without its optimization, and by what one would use instead."""
    carry_out(PROGRAM, options)


def prepare(options: Settings) -> tuple[Run, Work]:
    """The run, and what is done with its scenes."""
    upright = is_upright(options, benchmark(options))
    ours = by_preset(options.presets, upright)
    peers = (registrars() if options.peers else {}) | learned_registrars(options.learned)
    methods = [*(m for settings in ours.values() for m in settings), *peers]
    facts = {"methods": methods, "pairs": options.pairs, "leveled": upright, **stated(options.learned)}
    current = open_run("registration", options, facts)

    def work(scenes: Sequence[KnownScene]) -> list[list[Record]]:
        level = [leveled_scans(s) for s in scenes] if upright else scenes
        pairs = [p for s in level for p in true_pairs(s, options.pairs)]
        records: list[tuple[str, Record]] = []
        for name, settings in ours.items():
            scene = preset(name, upright=upright)
            records += own_records(pairs, current.prior, settings, upright, options.batch, scene)
        records += peer_records(pairs, peers, upright)
        return [[r for s, r in records if s == scene.name] for scene in scenes]

    return current, work


def summary(options: Settings, right_deg: float) -> Summary:
    """Figures, also by category, and distributions of errors."""
    return Summary(
        figures=figures(right_deg),
        groups=("category",),
        plots=lambda out, records, rows: plot(out, records, 3 * right_deg),
    )


def by_preset(names: Sequence[str], upright: bool) -> dict[str, dict[str, RegistrationMethod]]:
    """The `own_settings` of every preset; what several have is measured once."""
    found: dict[str, dict[str, RegistrationMethod]] = {}
    for name in names:
        measured = {method for settings in found.values() for method in settings}
        found[name] = {m: s for m, s in own_settings(name, upright).items() if m not in measured}
    return found


def own_settings(name: str, upright: bool) -> dict[str, RegistrationMethod]:
    """The preset's registration; without knowing the sensors; and without what follows the coarse search of starts."""
    method = preset(name, upright=upright).registration
    codes_alone = dataclasses.replace(DescentRegistration(), steps=0, icp_steps=0)
    if isinstance(method, Descending):
        starts = undescended(method)
        return {f"ours, {name}": method, f"ours, {name}, without optimization": starts, KABSCH: codes_alone}
    blind = dataclasses.replace(method, search=dataclasses.replace(method.search, free_weight=0.0))
    told = upright and method.search.free_weight > 0
    return {
        f"ours, {name}": method,
        **({f"ours, {name}, sensors unknown": blind} if told else {}),
        f"ours, {name}, without optimization": dataclasses.replace(blind, steps=0, polish_steps=0),
        KABSCH: codes_alone,
    }


def true_pairs(scene: KnownScene, which: str = "all") -> list[TruePair]:
    """Objects that the first scan and a later one have, and masks show."""
    last = 2 if which == "first" else len(scene.scans)
    return [
        TruePair(scene=scene, object=o, scan=k)
        for k in range(1, last)
        for o in scene.objects
        if o.instance.get(0, LOST) != LOST and o.instance.get(k, LOST) != LOST
        if o.same_shape(0, k) and (which != "rigid" or o.rigid is None or k in o.rigid)
    ]


def own_records(
    pairs: Sequence[TruePair],
    prior: Prior,
    settings: Mapping[str, RegistrationMethod],
    upright: bool,
    batch: int,
    closed_by: SceneConfig | None = None,
) -> list[tuple[str, Record]]:
    """The method on all pairs of some scenes; time is that of the batch, shared out.

    The first of the `settings` once more as a scene has it before its meshes are made, if `closed_by` closes poses.
    """
    if not pairs:
        return []
    ready, encoding_s, looking_s = ready_pairs(pairs, prior, batch)
    found: list[tuple[str, Record]] = []
    motion: MotionModel = "upright" if upright else "free"
    for name, method in settings.items():
        began = clock()
        poses = register_all(prior, ready, method, motion, batch)
        seconds = encoding_s + (clock() - began) / len(pairs)
        looks = isinstance(method, SurfaceRegistration) and upright and method.search.free_weight > 0
        seconds = seconds + looking_s if looks else seconds
        found += [scored(p, T, name, seconds) for p, T in zip(pairs, poses, strict=True)]
        if closed_by and closed_by.pose_graph.steps and name == next(iter(settings)):
            found += closed_records(
                prior,
                pairs,
                [p.target.embedding for p in ready],
                poses,
                closed_by,
                f"{name}, {CLOSED}",
                seconds,
            )
    return found


def ready_pairs(
    pairs: Sequence[TruePair], prior: Prior, batch: int
) -> tuple[list[PairToRegister], Clock, Clock]:
    """The pairs with their codes and sights, and the seconds that each of the two took a pair."""
    clouds = [c for p in pairs for c in p.clouds]
    normals = [i.normals for p in pairs for i in p.instances]
    began = clock()
    codes = embed_all(prior, clouds, batch, normals)
    encoding_s = (clock() - began) / len(pairs)
    began = clock()
    sights = [p.sights() for p in pairs]
    looking_s = (clock() - began) / len(pairs)
    ready = [
        PairToRegister(
            source=ObservedObject(
                points=s.points, embedding=codes[2 * k], sight=sights[k][0], normals=s.normals
            ),
            target=ObservedObject(
                points=t.points, embedding=codes[2 * k + 1], sight=sights[k][1], normals=t.normals
            ),
        )
        for k, (s, t) in enumerate(p.instances for p in pairs)
    ]
    return ready, encoding_s, looking_s


def closed_records(
    prior: Prior,
    pairs: Sequence[TruePair],
    codes: Sequence[Embedding],
    poses: Sequence[Pose],
    scene: SceneConfig,
    method: str,
    seconds: Clock,
) -> list[tuple[str, Record]]:
    """Pairs registered in so many `seconds` each, as a scene has them in the end. `codes` are of the targets."""
    began = clock()
    scans = [(p.scene.scans[p.scan], p.scene.scans[0]) for p in pairs]
    closed = closed_poses(prior, [p.clouds for p in pairs], scans, codes, poses, scene)
    seconds = seconds + (clock() - began) / len(pairs)
    return [scored(p, T, method, seconds) for p, T in zip(pairs, closed, strict=True)]


def peer_records(
    pairs: Sequence[TruePair], peers: Mapping[str, Registrar], upright: bool
) -> list[tuple[str, Record]]:
    """What one would use instead, on the same clouds."""
    found: list[tuple[str, Record]] = []
    for name, register in peers.items():
        for p in pairs:
            began = clock()
            T = register(*p.clouds, upright)
            found.append(scored(p, T, name, clock() - began))
    return found


def scored(p: TruePair, T: Pose | None, method: str, seconds: Clock) -> tuple[str, Record]:
    """The record of one pair, with its scene's name."""
    scores = pose_scores(T, p.object, p.object, p.scan, 0, *p.clouds)
    return p.scene.name, {
        "method": method,
        "object": p.object.name,
        "category": p.object.category,
        "to_scan": p.scan,
        **told(seconds),
        "pose": None if T is None else T.tolist(),
        **scores,
    }


def plot(out: Path, records: Mapping[str, Sequence[Record]], limit_deg: float) -> None:
    """ECDF of rotation errors and RMSE: by method, and of the method by category."""
    flat = [r for rows in records.values() for r in rows]
    if not flat:
        return
    ours = [r for r in flat if r["method"] == flat[0]["method"]]
    label = "rotation error, strict [°]"
    draw_ecdf(out / "ecdf_rotation", flat, "re_deg.strict", label, limit_deg)
    draw_ecdf(out / "ecdf_rmse", flat, "rmse_m.strict", "RMSE, strict [m]", 0.5)
    draw_ecdf(out / "ecdf_rotation_by_category", ours, "re_deg.strict", label, limit_deg, by="category")
    draw_ecdf(out / "ecdf_rmse_by_category", ours, "rmse_m.strict", "RMSE, strict [m]", 0.5, by="category")


PROGRAM = Program(settings=Settings, prepare=prepare, summary=summary)

if __name__ == "__main__":
    run_program(main)
