"""The whole task by peers, one a stage: registration of all pairs to match, many starts of GICP, ball pivoting."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from eval.peers.matching import Matcher, by_registration
from eval.peers.reconstruction import Surfacer, ball_pivoting
from eval.peers.registration import TRUNCATED, best_fit, starts
from eval.scores.tracks import Track
from more2_jax.geometry.poses import Points, Pose, apply_pose
from more2_jax.matching.calibration import alone_probability
from more2_jax.types import Instance, Scan

NAME = "all-pairs GICP + multi-start GICP + ball pivoting"
REJECT = 0.05  # of the diagonal: clouds that stay this far apart show two objects
FEWEST = 64  # points of an instance that is used at all


@dataclass(frozen=True, kw_only=True)
class Stages:
    """Who matches, registers (source, target: the pose, and how far apart it leaves them) and makes meshes."""

    match: Matcher
    register: Callable[[Points, Points], tuple[Pose, float] | None]
    surface: Surfacer
    reject: float = np.inf  # of the diagonal: pairs that registration leaves farther apart show two objects


def without_learning(upright: bool) -> Stages:
    """The best of each stage that learns nothing."""
    return Stages(
        match=by_registration(upright, REJECT),
        register=lambda source, target: best_fit(source, target, starts(upright)),
        surface=ball_pivoting,
    )


def combined(scans: Sequence[Scan], stages: Stages) -> list[Track]:
    """Every scan in turn is matched to all objects known so far, each with all that was seen of it.

    A pair that fits badly is not one object: matching tells, or registration where `stages.reject` asks for it.
    """
    tracks: list[Track] = []
    for k, scan in enumerate(scans):
        before = [k - 1 in t.instance for t in tracks]
        new = [i for i in scan.instances if len(i.points) >= FEWEST]
        old = [Instance(id=n, points=t.points) for n, t in enumerate(tracks)]
        matched = stages.match(old, new) if old and new else {}
        by_id = {i.id: i for i in new}
        for n, id_ in matched.items():
            found = stages.register(by_id[id_].points, old[n].points)
            if found is not None and found[1] <= stages.reject:
                tracks[n] = extended(tracks[n], k, by_id.pop(id_), *found)
        tracks += [begun(k, i) for i in by_id.values()]
        tracks = less_sure(tracks, [*before, *[False] * len(by_id)], k) if k else tracks
    return [Track(**{**vars(t), "mesh": stages.surface(t.points)}) for t in tracks]


def less_sure(tracks: Sequence[Track], before: Sequence[bool], k: int) -> list[Track]:
    """The tracks, those that scan `k` or the one before alone has no surer than ours are (`alone_probability`)."""
    now = [k in t.instance for t in tracks]
    alone = [
        (a and not b) or (b and len(t.instance) == 1) for t, a, b in zip(tracks, before, now, strict=True)
    ]
    there = sum(a or b for a, b in zip(before, now, strict=True))
    chance = alone_probability(sum(alone), there)
    return [replace(t, score=min(t.score, chance)) if a else t for t, a in zip(tracks, alone, strict=True)]


def begun(scan: int, i: Instance) -> Track:
    """An object seen for the first time."""
    return Track(instance={scan: i.id}, T_track_scan={scan: np.eye(4)}, points=i.points)


def extended(t: Track, scan: int, i: Instance, T: np.ndarray, apart: float) -> Track:
    """The object with one more observation, as sure as the clouds lie on one another: `apart` of the diagonal."""
    return Track(
        instance={**t.instance, scan: i.id},
        T_track_scan={**t.T_track_scan, scan: T},
        points=np.concatenate([t.points, apply_pose(T, i.points)]),
        score=min(t.score, 1 - apart / TRUNCATED),
    )
