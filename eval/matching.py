"""Who is who between scans: instance and scene recall (paper §3.2 and §4).

`python -m eval.matching --data data/flying_sparse --out runs/matching --scenes 10`

Pairs of the first scan with every later one, as the paper has them. Of upright things scans are leveled by their floors
first, for all methods; masks stay as they are.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from eval.data.tilted import leveled_scans
from eval.data.truth import KnownScene
from eval.harness.batched import embed_all
from eval.harness.options import OptionsBeside, benchmark, is_upright
from eval.harness.program import Program, Summary, carry_out, run_program
from eval.harness.runs import Run, Work, open_run
from eval.peers import classifier
from eval.peers.learned.methods import learned_matchers
from eval.peers.learned.registry import stated
from eval.peers.matching import Matcher, matchers
from eval.scores.figures import COLUMNS, Figure, Record, in_columns
from eval.scores.match_scores import match_scores, partners
from more2_jax.config import CodeMatcher, EvidenceMatcher, SceneConfig, preset
from more2_jax.matching.color import color_of
from more2_jax.network.prior import Prior
from more2_jax.tracking.identify import identify
from more2_jax.types import Embedding, Instance, ObservedObject

SHARES = (25, 50, 75, 100)  # %: of a scan pair's objects, for scene recall

PERCENT = Figure(name="", key="", statistic="ratio", unit="%", scale=100)
RECALL = replace(PERCENT, name="instance recall", key="right", over="pairs")
FIGURES = [
    *in_columns(RECALL),
    *(
        f
        for share in SHARES
        for f in in_columns(
            replace(
                PERCENT,
                name=f"scene recall ≥ {share} %",
                key="recall",
                statistic="at_least",
                limit=share / 100 - 1e-9,
            )
        )
    ),
    replace(PERCENT, name="F1 of matches", key="f1.strict", statistic="mean", column="strict"),
    replace(RECALL, name="instance recall, unmoved", key="static.right", over="static.pairs", column="paper"),
    replace(RECALL, name="instance recall, moved", key="dynamic.right", over="dynamic.pairs", column="paper"),
    Figure(name="time a scan pair", key="seconds", statistic="median", unit="s", better="lower"),
]


@dataclass(frozen=True, kw_only=True)
class Settings(OptionsBeside):
    """Which data, which settings, and where results go."""

    classifier: Path | None = None
    """Weights of `eval.peers.classifier`, to be matched with too."""
    learned: tuple[str, ...] = ()
    """Learned peers measured too: names of shipped weights, or files of `eval.peers.learned.train`."""


def main(options: Annotated[Settings, tyro.conf.arg(name="")]) -> None:
    """Instance and scene recall of the method, of its parts, and of what one would use instead."""
    carry_out(PROGRAM, options)


def prepare(options: Settings) -> tuple[Run, Work]:
    """The run, and what is done with its scenes."""
    methods = own_settings(*options.presets)
    upright = is_upright(options, benchmark(options))
    peers = matchers(upright) if options.peers else {}
    if options.classifier is not None:
        peers |= {classifier.NAME: classifier.classifier(options.classifier, options.batch)}
    peers |= learned_matchers(options.learned)
    current = open_run(
        "matching", options, {"methods": [*methods, *peers], "leveled": upright, **stated(options.learned)}
    )
    settings = {n: replace(preset(options.preset, upright=upright), matching=m) for n, m in methods.items()}

    def leveled_work(scenes: Sequence[KnownScene]) -> list[list[Record]]:
        scenes = [leveled_scans(s) for s in scenes] if upright else scenes
        return work(scenes, current.prior, settings, peers, options.batch)

    return current, leveled_work


def own_settings(*names: str) -> dict[str, CodeMatcher | EvidenceMatcher]:
    """Each preset's own matching, and the embeddings alone: Λ, 1/E, Λ ⊘ E, and Λ as the published code assigns."""
    plain = CodeMatcher()
    return {
        **{f"ours, {name}": preset(name).matching for name in names},
        "Λ ⊘ E": plain,
        "Λ": replace(plain, score="inv"),
        "1 / E": replace(plain, score="eqv"),
        "Λ, greedy": replace(plain, score="inv", assignment="greedy"),
    }


def work(
    scenes: Sequence[KnownScene],
    prior: Prior,
    settings: Mapping[str, SceneConfig],
    peers: Mapping[str, Matcher],
    batch: int,
) -> list[list[Record]]:
    """Records of some scenes, encoded together: one a scan pair and method."""
    every = [i for s in scenes for scan in s.scans for i in scan.instances]
    began = time.perf_counter()
    codes = embed_all(prior, [i.points for i in every], batch, [i.normals for i in every])
    encoding_s = (time.perf_counter() - began) / max(1, len(every))
    found, used = [], 0
    for scene in scenes:
        counts = [len(scan.instances) for scan in scene.scans]
        parts = np.split(np.arange(used, used + sum(counts)), np.cumsum(counts)[:-1])
        used += sum(counts)
        found.append(
            _scene_records(scene, [[codes[k] for k in p] for p in parts], encoding_s, prior, settings, peers)
        )
    return found


def _scene_records(
    scene: KnownScene,
    codes: Sequence[Sequence[Embedding]],
    encoding_s: float,
    prior: Prior,
    settings: Mapping[str, SceneConfig],
    peers: Mapping[str, Matcher],
) -> list[Record]:
    records: list[Record] = []
    for b in range(1, len(scene.scans)):
        one, other = scene.scans[0].instances, scene.scans[b].instances
        if not partners(scene, 0, b):
            continue
        for name, config in settings.items():
            began = time.perf_counter()
            matched = match_own(prior, one, codes[0], other, codes[b], config)
            seconds = time.perf_counter() - began + encoding_s * (len(one) + len(other))
            records.append(record(scene, b, name, matched, seconds))
        for name, matcher in peers.items():
            began = time.perf_counter()
            matched = matcher(one, other)
            records.append(record(scene, b, name, matched, time.perf_counter() - began))
    return records


def match_own(
    prior: Prior,
    one: Sequence[Instance],
    one_codes: Sequence[Embedding],
    other: Sequence[Instance],
    other_codes: Sequence[Embedding],
    config: SceneConfig,
) -> dict[int, int]:
    """The package's own matching of two scans: instance → instance."""
    if not one or not other:
        return {}
    old, new = (
        [
            ObservedObject(points=i.points, embedding=e, color=color_of(i.colors), normals=i.normals)
            for i, e in zip(*side, strict=True)
        ]
        for side in ((one, one_codes), (other, other_codes))
    )
    found = identify(prior, old, new, config).found
    return {one[f.object].id: other[f.instance].id for f in found}


def record(scene: KnownScene, b: int, method: str, matched: dict[int, int], seconds: float) -> Record:
    """One scan pair: counts, recalls of the pair, and the parts that moved and did not."""
    scores = match_scores(scene, 0, b, matched)
    recalls = {f"recall.{c}": scores[f"right.{c}"] / scores["pairs"] for c in COLUMNS}
    counts: dict[str, int] = {}
    for kind, moved in (("static", False), ("dynamic", True)):
        own = [o for o in partners(scene, 0, b) if o.moved.get(b) is moved]
        if own:
            right = [matched.get(o.instance[0]) == o.instance[b] for o in own]
            counts |= {f"{kind}.pairs": len(own), f"{kind}.right": sum(right)}
    return {"method": method, "to_scan": b, "seconds": seconds, **scores, **recalls, **counts}


PROGRAM = Program(
    settings=Settings,
    prepare=prepare,
    summary=lambda o, right_deg: Summary(figures=FIGURES, groups=("to_scan",)),
)

if __name__ == "__main__":
    run_program(main)
