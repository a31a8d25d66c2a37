"""Whether the probabilities that a living scene tells hold: of its matches, and of what came, went, moved or stayed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from eval.data.truth import KnownScene
from eval.scores.figures import Figure, Record
from eval.scores.tracks import Track, said_changes, sides

KINDS = ("matches", "changes", "motions")
MATCHES, CHANGES, MOTIONS = (
    Figure(
        name=f"calibration error of {kind}",
        key=f"said.{kind}",
        over=f"so.{kind}",
        statistic="calibration",
        unit="%",
        scale=100,
        better="lower",
    )
    for kind in KINDS
)
SHARE = Figure(name="", key="", statistic="mean", unit="%", scale=100)
# Of each kind: what is told and what is so, in the mean, and how far apart they are by what is told.
FIGURES = [
    figure
    for error in (MATCHES, CHANGES, MOTIONS)
    for figure in (
        replace(SHARE, name=error.name.replace("calibration error", "told probability"), key=error.key),
        replace(SHARE, name=error.name.replace("calibration error", "true share"), key=error.over),
        error,
        replace(error, name=f"{error.name}, by chance", statistic="chance"),
    )
]


def told_chances(scene: KnownScene, tracks: Sequence[Track]) -> list[Record]:
    """Of every match, change and motion that is told with a probability: that, and whether it is so (1 or 0)."""
    return [*matches_told(scene, tracks), *changes_told(scene, tracks), *motions_told(scene, tracks)]


def matches_told(scene: KnownScene, tracks: Sequence[Track]) -> list[Record]:
    """Right is what shows the object of the first scan, or a copy. Of two masks of no object nothing is known."""
    found = list[Record]()
    for t in tracks:
        first = min(t.instance)
        before = scene.owner(first, t.instance[first])
        for k, said in t.matched.items():
            after = scene.owner(k, t.instance[k])
            if before is None and after is None:
                continue
            so = before is not None and after is not None and before.copies == after.copies
            found.append({MATCHES.key: said, MATCHES.over: float(so)})
    return found


def changes_told(scene: KnownScene, tracks: Sequence[Track]) -> list[Record]:
    """Right is what the other scan's room really lacks, known or not. Masks of no object are left out."""
    found = list[Record]()
    for (name, k, instance), t in said_changes(scene, tracks).items():
        here, other = next(scans for kind, *scans in sides(k) if kind == name)
        shown = next((o for o in scene.objects if instance in o.masks(here)), None)
        if shown is not None and k in t.alone:
            found.append({CHANGES.key: t.alone[k], CHANGES.over: float(other not in shown.T_scan_model)})
    return found


def motions_told(scene: KnownScene, tracks: Sequence[Track]) -> list[Record]:
    """Of right matches of the first scan and the next, where it is known whether the object moved."""
    found = list[Record]()
    for t in tracks:
        first = min(t.instance)
        k, before = first + 1, scene.owner(first, t.instance[first])
        after = scene.owner(k, t.instance[k]) if k in t.instance else None
        if k not in t.motion or before is None or after is None or before.copies != after.copies:
            continue
        if before.first == first and (moved := before.moved.get(k)) is not None:
            found.append({MOTIONS.key: t.motion[k], MOTIONS.over: float(t.moved[k] == moved)})
    return found
