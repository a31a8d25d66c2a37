"""What settings do to matches, poses and changes of whole rooms, without meshes: for choosing on validation rooms.

`python -m eval.variants --data rooms/paper rooms/sparse --set registration.choose_among=3 registration.choose_among=6`

Every entry of `--set` is a variant: changes to the preset, joined by commas; the preset as it is comes first.
"""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from rich.console import Console
from rich.table import Table

from eval.data.flyingshape import flyingshape
from eval.data.truth import KnownScene
from eval.end_to_end import living_scenes
from eval.harness.options import Masks
from eval.harness.runs import masked
from eval.scores.figures import Record
from eval.scores.mended_masks import with_mended_masks
from eval.scores.tracks import changes_f1, score_tracks, tracks_of
from more2_jax.config import SceneConfig, from_dict, preset
from more2_jax.network.prior import Prior, load_prior
from train.run.program import run

HEADINGS = (
    "rooms",
    "variant",
    "pairs",
    "right",
    "wrong",
    "RE < 5°",
    "< 15°",
    "MR (10°, 10 cm)",
    "F1",
    "told",
    "s",
)


def main(
    data: tuple[Path, ...],
    set: tuple[str, ...] = (),
    scenes: int = 0,
    visits: int = 2,
    masks: Masks = "true",
    prior: str = "small",
    as_is: bool = True,
) -> None:
    """A line of figures for every folder of rooms and every variant of `robust`.

    Args:
        data: folders of rooms of train.synthesize.
        set: variants: dotted.setting=value, several joined by commas.
        scenes: how many of each, from the first; 0 for all.
        visits: how many scans of each.
        masks: true, or damaged on purpose.
        prior: name of shipped weights, or a file.
        as_is: also measure the preset as it is.
    """
    weights = load_prior(prior)
    result = Table(*HEADINGS)
    for folder in data:
        rooms = flyingshape(folder)
        known = [rooms.read(n).first_scans(visits) for n in rooms.names[: scenes or None]]
        known = [masked(s, masks) for s in known]
        robust = preset("robust", upright=rooms.upright)
        for variant in (*([""] if as_is else []), *set):
            row = row_of(known, weights, changed(robust, variant), rooms.right_deg)
            result.add_row(folder.name, variant or "robust", *row)
            Console().print(folder.name, variant or "robust", *row)
    Console().print(result)


def changed(config: SceneConfig, variant: str) -> SceneConfig:
    """The settings with some replaced. Raises ValueError for what is no setting."""
    values: dict[str, Any] = dataclasses.asdict(config)
    for change in filter(None, variant.split(",")):
        path, _, value = change.partition("=")
        *outer, last = path.split(".")
        inner = values
        for name in outer:
            inner = inner.setdefault(name, {})
        inner[last] = yaml.safe_load(value)
    return from_dict(SceneConfig, values)


def row_of(scenes: list[KnownScene], prior: Prior, config: SceneConfig, right_deg: float) -> list[str]:
    """The figures of one variant: strict, over true pairs; seconds of processor time a room, without the first."""
    pairs: list[Record] = []
    seconds, f1, wrong = [], [], 0
    for scene in scenes:
        began = time.process_time()
        *_, last = living_scenes(scene, prior, config)
        seconds.append(time.process_time() - began)
        scene, tracks = with_mended_masks(scene, tracks_of(last))
        pairs += score_tracks(scene, tracks, right_deg, 0, says_motion=True)
        f1.append(changes_f1(scene, tracks))
        wrong += sum(len(t.instance) - 1 for t in tracks)
    right = sum(r["m.strict"] for r in pairs)
    turn = np.array([180.0 if r["re_deg.strict"] is None else r["re_deg.strict"] for r in pairs])
    shift = np.array([9.0 if r["te_m.strict"] is None else r["te_m.strict"] for r in pairs])
    registered = np.mean((turn < 10) & (shift < 0.1))
    return [
        str(len(pairs)),
        f"{right:.0f}",
        f"{wrong - right:.0f}",
        f"{np.sum(turn < 5)}",
        f"{np.sum(turn < 15)}",
        f"{100 * registered:.1f} %",
        f"{100 * np.mean(f1):.1f} %",
        f"{100 * np.mean([r['told.strict'] for r in pairs if 'told.strict' in r] or [np.nan]):.1f} %",
        f"{np.mean(seconds[1:] or seconds):.2f}",
    ]


if __name__ == "__main__":
    run(main)
