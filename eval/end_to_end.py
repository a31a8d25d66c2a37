"""The whole task: matched, registered and reconstructed objects over all scans (MR and MRR, paper §4).

`python -m eval.end_to_end --data data/flying_sparse --out runs/end_to_end --scenes 10`

Scenes are spread over the devices of a host, `--at-once` on each.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Any

import jax
import tyro

from eval.data.truth import KnownScene
from eval.harness.options import OURS, OptionsBeside, benchmark, is_upright, told_upright
from eval.harness.program import Program, Summary, carry_out, run_program
from eval.harness.runs import Run, Work, open_run
from eval.peers.end_to_end import NAME, combined, without_learning
from eval.peers.learned.methods import learned_stages
from eval.peers.learned.registry import stated
from eval.performance.stopwatch import clock, told
from eval.scores.figures import Figure, Record, in_columns
from eval.scores.mended_masks import with_added_masks, with_divided_masks
from eval.scores.temporal_ap import temporal_records
from eval.scores.told_chances import FIGURES as CHANCES
from eval.scores.told_chances import told_chances
from eval.scores.tracks import Track, changes_f1, false_changes, score_tracks, tracks_of, without_loose
from more2_jax.config import EvidenceMatcher, SceneConfig
from more2_jax.network.on_devices import at_hand
from more2_jax.network.prior import Prior
from more2_jax.network.shared_calls import side_by_side
from more2_jax.scene import add_scan, reconstruct, start_scene
from more2_jax.types import LivingScene

TEMPORAL = {"t-mAP": "t_map", "t-AP50": "t_ap50", "AP50, scans pooled": "ap50"}  # docs/concepts/measures.md


@dataclass(frozen=True, kw_only=True)
class Settings(OptionsBeside):
    """Which data, which settings, and where results go."""

    samples: int = 20_000
    """Points on each surface."""
    batch_scenes: int = 1
    """Scenes held side by side, whose compiled calls take rows of several; `--at-once` of them work between calls.
    Times of a scene then include waiting for the others."""
    learned: tuple[str, ...] = ()
    """Learned peers combined to one more method, one for matching, one for registration, one for reconstruction: names
    of shipped weights, or files of `eval.peers.learned.train`."""


def figures() -> list[Figure]:
    """MR, MRR and their parts."""
    share = Figure(name="instance recall", key="m", statistic="at_least", limit=1, unit="%", scale=100)
    error = Figure(name="MedRE of true pairs", key="re_deg.strict", statistic="median", unit="°")
    time = Figure(name="time a scene", key="seconds", statistic="median", unit="s", better="lower")
    return [
        *in_columns(share),
        *in_columns(replace(share, name="MR", key="mr")),
        *in_columns(replace(share, name="MRR", key="mrr")),
        replace(error, column="strict", better="lower"),
        replace(share, name="told whether it moved", key="told.strict", column="strict"),
        replace(share, name="added and removed, F1", key="changes_f1", statistic="mean"),
        replace(share, name="told as changed without a mask", key="false_change", better="lower"),
        *CHANCES,
        *(replace(share, name=n, key=k, statistic="average_precision") for n, k in TEMPORAL.items()),
        time,
        replace(time, name="processor time a scene", key="cpu_seconds"),
    ]


def main(options: Annotated[Settings, tyro.conf.arg(name="")]) -> None:
    """MR and MRR of the method, and of the best of each other stage combined."""
    if options.batch_scenes < 1:
        raise ValueError(f"batch scenes {options.batch_scenes}; needed 1 or more")
    carry_out(PROGRAM, replace(options, chunk=max(options.chunk, options.batch_scenes)))


def prepare(options: Settings) -> tuple[Run, Work]:
    """The run, and what is done with its scenes."""
    data = benchmark(options)
    upright = is_upright(options, data)
    peers = {NAME: without_learning(upright)} if options.peers else {}
    peers |= learned_stages(options.learned, upright)
    ours = options.methods(told_upright(options, data))
    facts = {"methods": [*ours, *peers], "samples": options.samples}
    current = open_run("end_to_end", options, {**facts, **stated(options.learned)})
    methods: dict[str, Callable[[KnownScene], list[Track]]] = {}
    for name, config in ours.items():
        methods[name] = partial(found_tracks, prior=current.prior, config=config)
    for name, stages in peers.items():
        methods[name] = lambda s, p=stages: combined(s.scans, p)

    def one(scene: KnownScene) -> list[Record]:
        return [
            r
            for n, m in methods.items()
            for r in records_of(scene, n, m, current.data.right_deg, options.samples)
        ]

    def work(scenes: Sequence[KnownScene]) -> list[list[Record]]:
        if options.batch_scenes > 1:
            return side_by_side(one, scenes, options.at_once, options.batch_scenes)
        return on_all_devices(one, scenes, options.at_once)

    return current, work


def found_tracks(scene: KnownScene, prior: Prior, config: SceneConfig) -> list[Track]:
    """What the method says of a scene."""
    found = living_scene(scene, at_hand(prior), config)
    return tracks_of(found, probable=isinstance(config.matching, EvidenceMatcher))


def on_all_devices(
    one: Callable[[KnownScene], list[Record]], scenes: Sequence[KnownScene], at_once: int = 1
) -> list[list[Record]]:
    """`at_once` threads for each local device; each scene's programs run on the device of its thread."""
    devices = jax.local_devices()
    if len(devices) * at_once == 1:
        return [one(s) for s in scenes]

    def placed(scene: KnownScene, device: Any) -> list[Record]:
        with jax.default_device(device):
            return one(scene)

    with ThreadPoolExecutor(len(devices) * at_once) as pool:
        return list(pool.map(placed, scenes, itertools.cycle(devices)))


def living_scene(scene: KnownScene, prior: Prior, config: SceneConfig) -> LivingScene:
    """The method on all scans in turn, then meshes."""
    *_, last = living_scenes(scene, prior, config)
    return reconstruct(prior, last, config)


def living_scenes(scene: KnownScene, prior: Prior, config: SceneConfig) -> Iterator[LivingScene]:
    """The living scene after every scan, without meshes."""
    found = start_scene(prior, scene.scans[0], config)
    yield found
    for scan in scene.scans[1:]:
        found = add_scan(prior, found, scan, config)
        yield found


def records_of(
    scene: KnownScene, name: str, method: Callable[[KnownScene], list[Track]], right_deg: float, samples: int
) -> list[Record]:
    """One record a true pair, and one of the scene. A method that cannot use a scan has failed on the scene."""
    began = clock()
    try:
        tracks = method(scene)
    except ValueError as error:  # a scan without a usable instance
        tracks, reason = [], str(error)
    else:
        reason = ""
    taken, tracks = told(clock() - began), without_loose(scene, tracks)
    followed = temporal_records(scene, tracks)
    scene, tracks = with_divided_masks(scene, tracks)
    false: list[Record] = [{"false_change": x} for x in false_changes(scene, tracks)]
    scene, tracks = with_added_masks(scene, tracks)
    chances = told_chances(scene, tracks)
    pairs = score_tracks(scene, tracks, right_deg, samples, says_motion=name.startswith(OURS))
    whole: Record = {**taken, "changes_f1": changes_f1(scene, tracks), "reason": reason}
    whole |= followed
    return [{"method": name, **r} for r in [*pairs, *false, *chances, whole]]


PROGRAM = Program(
    settings=Settings,
    prepare=prepare,
    summary=lambda o, right_deg: Summary(figures=figures(), groups=("to_scan", "category", "collection")),
)

if __name__ == "__main__":
    run_program(main)
