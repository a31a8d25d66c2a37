"""What became of every object between two scans: it moved, stayed, came, went, or was not looked for."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping, Sequence, Sized
from itertools import pairwise

import numpy as np
from scipy.special import ndtr

from more2_jax.config import SceneConfig
from more2_jax.tracking.objects import motion_between, observation_in
from more2_jax.types import Changes, LivingScene, Observation, ScanRecord, SceneObject

# Registration takes correspondences as independent: true errors are larger than it says, by about this much.
OPTIMISM = 3.0
SURE = 2.0  # standard errors that a motion must exceed
IN_DOUBT = 0.55  # that something moved between scans of which nobody knows how they lie: 11 of 17 things had

KINDS = ("moved", "static", "added", "removed", "not_seen", "discovered")
# Of a scan, the ids of objects that it cannot tell it lacks.
NotSeen = Mapping[int, Collection[str]]


def changes_between(
    objects: Sequence[SceneObject],
    a: int,
    b: int,
    config: SceneConfig,
    chance: Mapping[str, float] | None = None,
    not_seen: NotSeen | None = None,
) -> Changes:
    """What moved, stayed, came (also: came back), went, and was not seen between two scans.

    `chance`: probabilities, by object, that one scan alone has it. Those of motion are worked out here. An object that
    scan `a` did not look for is compared with the scan that did.
    """
    found: dict[str, list[str]] = {kind: [] for kind in KINDS}
    probability: dict[str, float] = {}
    not_seen = not_seen or {}
    for o in objects:
        before, after = last_known(o, a, not_seen), observation_in(o, b)
        if before and after:
            moved = moved_probability(o, before, after, config)
            found["moved" if moved > 0.5 else "static"].append(o.id)
            probability[o.id] = max(moved, 1 - moved)
        elif before:
            found["not_seen" if o.id in not_seen.get(b, ()) else "removed"].append(o.id)
        elif after:
            found["added" if looked_for(o, a, not_seen) else "discovered"].append(o.id)
        if bool(before) != bool(after) and chance and o.id in chance:
            probability[o.id] = chance[o.id]
    lists = {k: tuple(v) for k, v in found.items()}
    return Changes(from_scan=a, to_scan=b, **lists, probability=probability)


def not_seen_in(scans: Sequence[ScanRecord]) -> NotSeen:
    """Of every scan, the objects that it did not look for."""
    return {s.index: frozenset(s.not_seen) for s in scans}


def forgotten(scene: LivingScene, ids: Collection[str]) -> LivingScene:
    """The scene's history without some objects, which turned out to be parts of others."""
    if not ids:
        return scene

    def less(names: tuple[str, ...]) -> tuple[str, ...]:
        return tuple(n for n in names if n not in ids)

    changes = tuple(
        dataclasses.replace(
            c,
            **{k: less(getattr(c, k)) for k in KINDS},
            probability={k: p for k, p in c.probability.items() if k not in ids},
        )
        for c in scene.changes
    )
    scans = tuple(dataclasses.replace(s, not_seen=less(s.not_seen)) for s in scene.scans)
    return dataclasses.replace(scene, changes=changes, scans=scans)


def last_known(o: SceneObject, scan: int, not_seen: NotSeen) -> Observation | None:
    """The observation that says where an object is at a scan: its own, or one before if none has looked since.

    None where the object was not there, or not known yet.
    """
    while scan > 0 and observation_in(o, scan) is None and o.id in not_seen.get(scan, ()):
        scan -= 1
    return observation_in(o, scan)


def looked_for(o: SceneObject, scan: int, not_seen: NotSeen) -> bool:
    """Whether this scan or one before it looked where an object stands that was found later."""
    return any(o.id not in not_seen.get(k, ()) for k in range(scan + 1))


def counted_alone(
    objects: Sequence[SceneObject], missing: Sequence[int], fresh: Sized, scans: Sequence[ScanRecord]
) -> tuple[int, int]:
    """How many things the last of the `scans` or a new one alone shows, and how many either does.

    `missing`: rows of the objects that were not found in the new one; `fresh`: what is new in it.
    """
    last, not_seen = scans[-1].index, not_seen_in(scans)
    there = [o.observations[-1].scan > last or last_known(o, last, not_seen) is not None for o in objects]
    return sum(there[k] for k in missing) + len(fresh), sum(there) + len(fresh)


def set_in_motion(before: SceneObject, after: SceneObject, config: SceneConfig) -> bool:
    """Whether an object whose poses were refined seems to have moved between two observations, but did not before."""
    if after is before:
        return False
    pairs = zip(pairwise(before.observations), pairwise(after.observations), strict=True)
    return any(
        moved_probability(before, *old, config) <= 0.5 < moved_probability(after, *new, config)
        for old, new in pairs
    )


def moved_probability(o: SceneObject, before: Observation, after: Observation, config: SceneConfig) -> float:
    """That an object moved: by more than `static_m` or `static_deg`, and than registration's own error explains.

    Measured motions are taken as normal about the true ones. Without an error (`paper`), 0 or 1. In a scan of unknown
    frame, no more than likely.
    """
    distance, angle_deg = motion_between(o, before, after)
    found = []
    for motion, limit, own in (
        (distance, config.static_m, "sigma_m"),
        (angle_deg, config.static_deg, "sigma_deg"),
    ):
        frames = [getattr(seen.frame, own) for seen in (before, after)]
        error = float(
            np.hypot(OPTIMISM * np.hypot(getattr(before, own), getattr(after, own)), np.hypot(*frames))
        )
        limit = max(limit, SURE * error)
        found.append(float(ndtr((motion - limit) / error)) if error > 0 else float(motion > limit))
    known = not (before.frame.unknown or after.frame.unknown)
    return max(found) if known else min(max(found), IN_DOUBT)
