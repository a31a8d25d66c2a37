"""Scores of one assignment between two scans (paper §4), in three columns.

`paper`: a match is right if it names the very object. `published`: a copy is as good, however often it is named.
`strict`: a copy is as good, but only once; matches of objects that have no partner count against F1.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Int

from eval.data.masks import LOST
from eval.data.truth import KnownObject, KnownScene

Matched = Mapping[int, int]  # instance of the earlier scan → instance of the later


def partners(scene: KnownScene, a: int, b: int) -> list[KnownObject]:
    """The objects that both scans have: the denominator of instance recall."""
    return [o for o in scene.objects if a in o.instance and b in o.instance]


def match_scores(scene: KnownScene, a: int, b: int, matched: Matched) -> dict[str, int | float]:
    """Counts of right matches in each column, their denominator, and F1 of the strict column."""
    true = partners(scene, a, b)
    right = {column: count_right(scene, a, b, matched, true, column) for column in ("paper", "published")}
    strict = strict_count(scene, a, b, matched, true)
    return {
        "pairs": len(true),
        "right.paper": right["paper"],
        "right.published": right["published"],
        "right.strict": strict,
        "f1.strict": 2 * strict / (len(true) + len(matched)) if true or matched else 1.0,
    }


def count_right(
    scene: KnownScene, a: int, b: int, matched: Matched, true: Sequence[KnownObject], column: str
) -> int:
    """How many objects were matched to themselves (`paper`), or to any of their copies (`published`)."""
    count = 0
    for o in true:
        other = scene.owner(b, matched[o.instance[a]]) if o.instance[a] in matched else None
        same = other is not None and (other is o if column == "paper" else other.copies == o.copies)
        count += bool(same)
    return count


def strict_count(scene: KnownScene, a: int, b: int, matched: Matched, true: Sequence[KnownObject]) -> int:
    """Copies may stand in for one another, each once (`instance_recall`)."""
    true = [o for o in true if LOST not in (o.instance[a], o.instance[b])]  # no match of those is right
    if not true:
        return 0
    ids = [i.id for i in scene.scans[b].instances]
    owners = [scene.owner(b, i) for i in ids]
    groups = {c: n for n, c in enumerate(dict.fromkeys(o.copies for o in owners if o))}
    same = np.array([-2 - k if o is None else groups[o.copies] for k, o in enumerate(owners)])
    predicted = np.array(
        [ids.index(matched[o.instance[a]]) if o.instance[a] in matched else -1 for o in true]
    )
    truth = np.array([ids.index(o.instance[b]) for o in true])
    return round(instance_recall(predicted, truth, same) * len(true))


def instance_recall(
    predicted: Int[np.ndarray, " n"], truth: Int[np.ndarray, " n"], same: Int[np.ndarray, " m"]
) -> float:
    """Correct matches over true matches; −1 means no partner. NaN when nothing has a partner.

    `same[j]` is equal for targets that are identical copies: each may stand in for the other, but only
    once: a target that several sources claim is right for one of them.
    """
    has = truth >= 0
    right = has & (predicted >= 0) & (same[np.maximum(predicted, 0)] == same[np.maximum(truth, 0)])
    return float(len(np.unique(predicted[right])) / has.sum()) if has.any() else float("nan")
