"""The regimes of the open FlyingShape benchmark: which models a scene is furnished with, and their roles."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Literal, get_args

import numpy as np

from train.furniture.source_mesh import SourceMesh, standing
from train.rooms.things_on_furniture import is_small
from train.rooms.visits import FlyingConfig

Flying = Literal["paper", "sparse", "identical", "changes"]  # scanned by standing cameras (`visits`)
Regime = Literal[Flying, "real"]  # scanned by hand (`real_visits`)
FLYING: tuple[Flying, ...] = get_args(Flying)
REGIMES: tuple[Regime, ...] = (*FLYING, "real")
OBJECTS = (4, 8)  # in a scene, least and most (paper §4)
REAL_OBJECTS = (5, 8)
LIVED_IN = (14, 24)  # in a room that is lived in
SMALL_SHARE = 0.35  # of these, what may stand on furniture
SETS = ((2, 4), (2, 3))  # copies in each of the sets that are alike: chairs about a table
CHANGES_OBJECTS = (6, 8)  # so that every role is played and two objects move
COPIES = (2, 4)  # of the same model in a scene of `identical`
TWIN_SCALE = (0.04, 0.08)  # by how much a near-twin is larger or smaller along each axis
SIMILAR = 0.15  # models whose extents differ by at most this share of the larger are similar in size


def scene_config(regime: Regime, scans: int, rng: np.random.Generator, *, free: bool) -> FlyingConfig:
    """How a scene of the regime changes and is scanned.

    `changes` has a static, a removed, an added and a returning object, sometimes two static ones; in the
    others every pose changes. Raises ValueError for an unknown regime, or `changes` in less than 3 scans.
    """
    if regime not in FLYING:
        raise ValueError(f"regime {regime!r}; needed one of {', '.join(FLYING)}")
    check_scans(regime, scans)
    scanned = "paper" if regime == "paper" else "sparse"
    if regime != "changes":
        return FlyingConfig(scans=scans, regime=scanned, free=free)
    static = int(rng.integers(1, 3))
    return FlyingConfig(
        scans=scans, regime=scanned, free=free, static=static, removed=1, added=1, returning=1
    )


def check_scans(regime: Regime, scans: int) -> None:
    """Raises ValueError if a scene of the regime needs more scans."""
    if scans < (least := 3 if regime == "changes" else 1):
        raise ValueError(f"{scans} scans for regime {regime}; needed {least}")


def furniture(regime: Regime, models: Sequence[SourceMesh], rng: np.random.Generator) -> list[SourceMesh]:
    """The models of one scene, categories balanced; in `identical`, copies and near-twins of one of them.

    `models` are in a fixed order, their names unique. Raises ValueError if they are fewer than a scene needs.
    """
    least, most = {"changes": CHANGES_OBJECTS, "real": REAL_OBJECTS}.get(regime, OBJECTS)
    if len(models) < most:
        raise ValueError(f"{len(models)} usable models; needed {most}")
    count = int(rng.integers(least, most + 1))
    if regime != "identical":
        return balanced(by_category(models), count, rng)
    group = identical_group(models, count, rng)
    taken = {m.name for m in group}
    others = by_category([m for m in models if m.name not in taken])
    return [*group, *balanced(others, count - len(group), rng)]


def lived_in(models: Sequence[SourceMesh], rng: np.random.Generator) -> list[SourceMesh]:
    """The models of a room that is lived in: many, two sets of which are alike, some small enough for tables.

    Raises ValueError if they are fewer than a room needs.
    """
    count = int(rng.integers(LIVED_IN[0], LIVED_IN[1] + 1))
    small = [m for m in models if is_small(m.vertices)]
    large = [m for m in models if not is_small(m.vertices)]
    things = balanced(by_category(small), min(round(SMALL_SHARE * count), len(small)), rng)
    copies = [int(rng.integers(least, most + 1)) - 1 for least, most in SETS]
    pieces = balanced(by_category(large), count - len(things) - sum(copies), rng)
    narrow = sorted(range(len(pieces)), key=lambda k: float(np.ptp(pieces[k].vertices[:, :2], axis=0).prod()))
    for k, more in zip(narrow, copies, strict=False):
        pieces += [pieces[k]] * more
    return [*pieces, *things]


def by_category(models: Sequence[SourceMesh]) -> dict[str, list[SourceMesh]]:
    """Models of every category, in their order."""
    groups: dict[str, list[SourceMesh]] = {}
    for model in models:
        groups.setdefault(model.category, []).append(model)
    return groups


def balanced(
    groups: Mapping[str, Sequence[SourceMesh]], count: int, rng: np.random.Generator
) -> list[SourceMesh]:
    """So many different models, as equally many of every category as there are."""
    names = sorted(groups)
    piles = {c: [groups[c][k] for k in rng.permutation(len(groups[c]))] for c in names}
    chosen: list[SourceMesh] = []
    while len(chosen) < count:
        left = [c for c in names if piles[c]]
        if not left:
            raise ValueError(f"{len(chosen)} models for a scene; needed {count}")
        chosen += [piles[left[k]].pop() for k in rng.permutation(len(left))]
    return chosen[:count]


def identical_group(models: Sequence[SourceMesh], count: int, rng: np.random.Generator) -> list[SourceMesh]:
    """Two to four copies of one model, and a near-twin where there is room: at most `count` in all.

    The twin is another model of the category and about the size, or the same model slightly rescaled.
    """
    (model,) = balanced(by_category(models), 1, rng)
    copies = min(int(rng.integers(COPIES[0], COPIES[1] + 1)), count - 1)
    return [*[model] * copies, near_twin(model, models, rng)]


def near_twin(model: SourceMesh, models: Sequence[SourceMesh], rng: np.random.Generator) -> SourceMesh:
    """A similar model of the category, or, every other time and where there is none, a rescaled copy."""
    similar = [
        m
        for m in models
        if m.category == model.category and m.name != model.name and size_difference(m, model) <= SIMILAR
    ]
    if similar and rng.random() < 0.5:
        return similar[int(rng.integers(len(similar)))]
    scale = np.round(1 + rng.uniform(*TWIN_SCALE, 3) * rng.choice([-1, 1], 3), 4)
    name = f"{model.name}~{'x'.join(f'{s:.4f}' for s in scale)}"
    return dataclasses.replace(model, name=name, vertices=standing(np.round(model.vertices * scale, 6)))


def size_difference(a: SourceMesh, b: SourceMesh) -> float:
    """Largest difference of the boxes' edges, a share of the larger."""
    one, other = (np.ptp(m.vertices, axis=0) for m in (a, b))
    return float((np.abs(one - other) / np.maximum(one, other)).max())
