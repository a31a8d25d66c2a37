"""How sure it is that two clouds show one object: the weights of `more2_jax.matching.calibration`, fitted on rooms.

`python -m eval.calibration --data rooms/paper_free rooms/sparse_free --masks true eroded wrong`

For other weights of the prior, or other kinds of rooms. Never on rooms that results are reported on.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int
from rich.console import Console
from rich.progress import track
from rich.table import Table
from scipy.optimize import minimize
from scipy.special import expit

from eval.data.flyingshape import flyingshape
from eval.data.truth import Benchmark, KnownScene
from eval.harness.options import Masks
from eval.harness.plots import draw_reliability
from eval.harness.runs import masked
from eval.scores.reliability import Bin, calibration_error, reliability
from more2_jax.config import EvidenceMatcher, SceneConfig, preset
from more2_jax.matching.assignment import NEVER, LogOdds, assign
from more2_jax.matching.calibration import FREE, UNASKED, UNKNOWN, UPRIGHT, Calibration, features, weighed
from more2_jax.matching.candidates import compared_at, evidence_at
from more2_jax.matching.pair_evidence import asks_prior
from more2_jax.network.embedding_batch import embed
from more2_jax.network.prior import Prior, load_prior
from more2_jax.scene import (
    compared_objects,
    leveled_scan,
    start_scene,
    usable,
    without_floor_and_walls,
)
from more2_jax.tracking.rooms import Rooms, rooms_of
from more2_jax.tracking.scan_frame import common_frame
from more2_jax.types import ObservedObject
from train.run.program import run

RIDGE = 1e-6  # keeps weights finite where the rooms are told apart without a mistake
SIGN = {"likeness": 1.0}  # the only evidence that speaks for a pair; all other speaks against it
TIMES = 8  # that they are taken away anew


@dataclass(frozen=True, kw_only=True)
class ScanPair:
    """The candidate pairs of two scans: what is known of each, and the truth."""

    room: str
    among: Bool[np.ndarray, "n m"]
    known: dict[str, Float[np.ndarray, " p"]]
    color: Float[np.ndarray, " p"]  # log likelihood ratios, which have weights of their own
    sure: Bool[np.ndarray, " p"]  # the prior knows something of both clouds
    one: Bool[np.ndarray, "n m"]  # one object, or copies of one

    def odds(self, c: Calibration) -> Float[np.ndarray, "n m"]:
        """Log odds of all pairs, as the package weighs them."""
        found = np.full(self.among.shape, NEVER)
        by_weights = np.where(self.sure, weighed(self.known, c), weighed(self.known, UNASKED))
        found[self.among] = by_weights + self.color
        return found


def main(
    data: tuple[Path, ...],
    prior: str = "small",
    visits: int = 2,
    scenes: int = 0,
    masks: tuple[Masks, ...] = ("true",),
    taken_away: float = 0.25,
    out: Path | None = None,
) -> None:
    """Fits the log odds of pairs of scans (first and every later one) and says how well they hold.

    Args:
        data: folders of train.synthesize, all upright or none.
        prior: name of shipped weights, or a file.
        visits: scans of a room that take part, from the first; 0 for all.
        scenes: rooms of a folder, from the first; 0 for all.
        masks: true, or damaged on purpose; every room is seen through each of them.
        taken_away: share of the objects and of the instances that go at random, to see what rejection costs.
        out: folder of the reliability curves, reliability.png and .svg; needs matplotlib.
    """
    if not 0 <= taken_away < 1:
        raise ValueError(f"taken away {taken_away:g}; needed a share, 0 or more and less than 1")
    rooms = [flyingshape(folder) for folder in data]
    if len({r.upright for r in rooms}) != 1:
        raise ValueError(
            "folders of upright rooms and of others; needed one kind, as each has its own weights"
        )
    config, weights = preset("robust", upright=rooms[0].upright), load_prior(prior)
    seen = scenes_of(list(zip(data, rooms, strict=True)), visits, scenes, masks)
    pairs = [p for room, scene in seen for p in scan_pairs(room, scene, weights, config)]
    if not pairs:
        raise ValueError(f"{', '.join(map(str, data))}: no room with two scans; needed one")
    report(pairs, asked(config), taken_away)
    curves = reliability_curves(pairs, asked(config))
    Console(width=120).print(*(reliability_table(name, curve) for name, curve in curves.items()))
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        draw_reliability(out / "reliability", curves)


def scenes_of(
    rooms: Sequence[tuple[Path, Benchmark]], visits: int, scenes: int, masks: Sequence[Masks]
) -> Iterator[tuple[str, KnownScene]]:
    """Every room through each of the masks, with its name."""
    for folder, benchmark in rooms:
        for name in track(benchmark.names[: scenes or None], description=folder.name):
            scene = benchmark.read(name).first_scans(visits)
            for m in masks:
                yield f"{folder}/{name}", masked(scene, m)


def asked(config: SceneConfig) -> dict[str, Calibration]:
    """The calibrations that these settings use, by name."""
    if config.upright:
        return {"UPRIGHT": UPRIGHT}
    return (
        {"FREE": FREE, "UNASKED": UNASKED}
        if asks_prior(evidence_matcher(config).search, "free")
        else {"UNASKED": UNASKED}
    )


def scan_pairs(room: str, scene: KnownScene, prior: Prior, config: SceneConfig) -> list[ScanPair]:
    """The first scan's objects with those of every later one, leveled and at the height that matching finds."""
    first = start_scene(prior, scene.scans[0], config)
    of_first = [o.observations[0].instance for o in first.objects]
    found = []
    for b, scan in enumerate(scene.scans[1:], start=1):
        later, _ = leveled_scan(scan, config, first.scans[0])
        masks, _ = usable(later, config)
        instances = without_floor_and_walls(masks, later, config).instances
        codes = embed(prior, [i.points for i in instances], [i.normals for i in instances])
        old, new = compared_objects(first, instances, codes, later, config)
        sides = [o for o, _ in old], new
        one = labels(scene, b, of_first, [i.id for i in instances])
        found.append(scan_pair(room, prior, config, sides, rooms_of(first, later), one))
    return found


def scan_pair(
    room: str,
    prior: Prior,
    config: SceneConfig,
    sides: tuple[Sequence[ObservedObject], Sequence[ObservedObject]],
    rooms: Rooms,
    one: Bool[np.ndarray, "n m"],
) -> ScanPair:
    """Aligns the candidates of two scans."""
    matcher = evidence_matcher(config)
    _, weighed_pairs = common_frame(prior, *sides, matcher, config.motion, rooms)
    aligned, height_m = weighed_pairs.aligned, weighed_pairs.height_m
    compared = compared_at(aligned, height_m)
    known = features(evidence_at(aligned, matcher.search, config.motion, height_m), compared)
    sure = aligned.off_own <= UNKNOWN
    among = np.zeros(aligned.shape, bool)
    among[tuple(aligned.rows.T)] = True
    return ScanPair(room=room, among=among, known=known, color=compared.color, sure=sure, one=one)


def evidence_matcher(config: SceneConfig) -> EvidenceMatcher:
    """The settings of matching. Raises ValueError where surfaces are not compared."""
    if not isinstance(config.matching, EvidenceMatcher):
        raise ValueError(f"preset {config.preset!r} matches by codes; needed one that compares surfaces")
    return config.matching


def labels(scene: KnownScene, b: int, first: Sequence[int], later: Sequence[int]) -> Bool[np.ndarray, "n m"]:
    """Which instances of the first scan and of scan `b`, by their ids, show one object, or copies of one."""
    a = [scene.owner(0, i) for i in first]
    c = [scene.owner(b, i) for i in later]
    return np.array([[x is not None and y is not None and x.copies == y.copies for y in c] for x in a])


def fitted(pairs: Sequence[ScanPair], like: Calibration) -> Calibration:
    """Logistic regression on the evidence that `like` asks, each weight with the sign it must have."""
    names = [k for k, v in asdict(like).items() if k not in ("intercept", "raised") and v != 0]
    known = np.concatenate([np.stack([p.known[k] for k in names], axis=1)[p.sure] for p in pairs])
    one, color = (
        np.concatenate([x[p.sure] for x, p in zip(part, pairs, strict=True)])
        for part in ([p.one[p.among] for p in pairs], [p.color for p in pairs])
    )
    x = np.concatenate([np.ones((len(known), 1)), known], axis=1)

    def loss(w: np.ndarray) -> tuple[float, np.ndarray]:
        told = x @ w + color
        slope = x.T @ (expit(told) - one) / len(x) + 2 * RIDGE * w
        return float(log_loss(told, one) + RIDGE * w @ w), slope

    signs = [SIGN.get(k, -1.0) for k in names]
    bounds = [(None, None), *((0.0, None) if s > 0 else (None, 0.0) for s in signs)]
    w = minimize(loss, np.zeros(x.shape[1]), jac=True, bounds=bounds, method="L-BFGS-B").x
    return replace(like, raised=0.0, **dict(zip(["intercept", *names], w.tolist(), strict=True)))


def left_out(pairs: Sequence[ScanPair], like: Calibration) -> dict[str, Calibration]:
    """Of every room, the weights that the other rooms give."""
    rooms = dict.fromkeys(p.room for p in pairs)
    return {room: fitted([p for p in pairs if p.room != room], like) for room in rooms}


def log_loss(odds: Float[np.ndarray, " p"], one: Bool[np.ndarray, " p"]) -> float:
    """Mean, in nats."""
    return float(np.logaddexp(0.0, np.where(one, -odds, odds)).mean())


def report(pairs: Sequence[ScanPair], named: dict[str, Calibration], taken_away: float) -> None:
    """Prints the fitted weights and how well the shipped and the fitted ones tell who is who."""
    console = Console(width=120)
    gone = (f"{taken_away:.0%} gone: recall", "precision", "F1", "changes' F1")
    table = Table("weights", "added", "log loss", "off by", "recall", "precision", "changes' F1", *gone)
    several = len({p.room for p in pairs}) > 1
    for name, shipped in named.items():
        add_row(table, f"{name}, shipped", pairs, {p.room: shipped for p in pairs}, taken_away)
        by_room = left_out(pairs, shipped) if several else {}
        for added in (0.0, 1.0, 2.0, 3.0) if several else ():
            raised = {k: replace(c, intercept=c.intercept + added, raised=added) for k, c in by_room.items()}
            add_row(table, f"{name}, fitted, rooms left out in turn", pairs, raised, taken_away)
        weights = {k: round(v, 2) for k, v in asdict(fitted(pairs, shipped)).items() if v}
        console.print(f"{name}, fitted on all: {weights}")
    count, one = sum(p.among.sum() for p in pairs), sum(p.one[p.among].sum() for p in pairs)
    console.print(f"{len(pairs)} pairs of scans, {count} pairs of objects, {one} of them one object")
    console.print(table)


def add_row(
    table: Table,
    name: str,
    pairs: Sequence[ScanPair],
    by_room: dict[str, Calibration],
    taken_away: float,
) -> None:
    """One way to weigh."""
    added = next(iter(by_room.values())).raised
    odds = [p.odds(by_room[p.room]) for p in pairs]
    told = np.concatenate([o[p.among] - by_room[p.room].raised for o, p in zip(odds, pairs, strict=True)])
    one = np.concatenate([p.one[p.among] for p in pairs])
    whole = [(o, p.one) for o, p in zip(odds, pairs, strict=True)]
    fewer = thinned(odds, pairs, taken_away)
    told_apart = (*counts(whole)[:2], changes_f1(whole), *counts(fewer), changes_f1(fewer))
    shares = [f"{100 * x:.1f} %" for x in told_apart]
    table.add_row(
        name, f"{added:g}", f"{log_loss(told, one):.3f}", f"{calibration_error(told, one):.3f}", *shares
    )


def reliability_curves(pairs: Sequence[ScanPair], named: dict[str, Calibration]) -> dict[str, list[Bin]]:
    """What the shipped and the fitted weights say of candidate pairs, and what is true, by bins of what is said."""
    one = np.concatenate([p.one[p.among] for p in pairs])
    curves = {}
    for name, shipped in named.items():
        weights = {f"{name}, shipped": {p.room: shipped for p in pairs}}
        if len({p.room for p in pairs}) > 1:
            weights[f"{name}, fitted, rooms left out in turn"] = left_out(pairs, shipped)
        for label, by_room in weights.items():
            told = [p.odds(by_room[p.room])[p.among] - by_room[p.room].raised for p in pairs]
            curves[label] = reliability(np.concatenate(told), one)
    return curves


def reliability_table(name: str, curve: Sequence[Bin]) -> Table:
    """A line a bin."""
    table = Table("probability", "said", "true", "pairs", title=name)
    for b in curve:
        table.add_row(f"{b.low:.1f} to {b.high:.1f}", f"{b.said:.3f}", f"{b.true:.3f}", str(b.count))
    return table


def thinned(
    odds: Sequence[Float[np.ndarray, "n m"]], pairs: Sequence[ScanPair], taken_away: float
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Log odds and truth with a share of the objects and of the instances taken away at random."""
    rng = np.random.default_rng(0)
    found = []
    for o, p in zip(odds, pairs, strict=True):
        for _ in range(TIMES):
            kept = np.ix_(*(rng.random(n) >= taken_away for n in o.shape))
            found.append((o[kept], p.one[kept]))
    return found


def counts(rooms: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[float, float, float]:
    """Recall, precision and F1 of the assignments; a copy stands in for another, each once."""
    right = said = true = 0
    for odds, one in rooms:
        pairs = assigned(odds)
        right, said, true = right + one[tuple(pairs.T)].sum(), said + len(pairs), true + most(one)
    return right / max(true, 1), right / max(said, 1), 2 * right / max(said + true, 1)


def changes_f1(rooms: Sequence[tuple[np.ndarray, np.ndarray]]) -> float:
    """Mean over rooms of the F1 of what came or went; 1 where nothing did and nothing is said to have."""
    found = []
    for odds, one in rooms:
        pairs = assigned(odds)
        said = np.concatenate([~np.isin(np.arange(n), pairs[:, side]) for side, n in enumerate(one.shape)])
        true = np.concatenate([~one.any(axis=1), ~one.any(axis=0)])
        either = said.sum() + true.sum()
        found.append(2 * (said & true).sum() / either if either else 1.0)
    return float(np.mean(found))


def most(one: Bool[np.ndarray, "n m"]) -> int:
    """As many pairs as can be right at the same time."""
    return len(assigned(np.where(one, 1.0, NEVER)))


def assigned(odds: Float[np.ndarray, "n m"]) -> Int[np.ndarray, "q 2"]:
    """The likeliest assignment, wherever things moved."""
    listed = LogOdds.of(odds)
    return assign(listed)


if __name__ == "__main__":
    run(main)
