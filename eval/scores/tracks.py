"""What a method says of a whole scene, in one form: which instances are one object, where, and its surface."""

from __future__ import annotations

from collections.abc import Hashable, Sequence, Set
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from eval.data.masks import LOST
from eval.data.truth import KnownObject, KnownScene, Pose
from eval.scores.figures import COLUMNS, Record
from eval.scores.mesh_scores import RECONSTRUCTED, mesh_scores
from eval.scores.pose_scores import Scores, failed_pose, pose_scores
from more2_jax.tracking.objects import accumulated_points, points_of
from more2_jax.types import LivingScene, Mesh

LEAST_IN_SIGHT = 0.1  # share of a place: of less, nobody can know what stands there


@dataclass(frozen=True, kw_only=True)
class Track:
    """One object over all scans: its instance in each, `T_track_scan`, its points and its mesh (frame of the track)."""

    instance: dict[int, int]
    T_track_scan: dict[int, Pose]
    points: Float[np.ndarray, "n 3"]
    mesh: Mesh | None = None
    score: float = 1.0  # of its least sure match, or of its absence from a scan; 0 to 1
    seen: dict[int, Float[np.ndarray, "n 3"]] = field(
        default_factory=dict
    )  # by scan, its own points, where masks were mended; else those of its instance
    moved: dict[int, bool] = field(default_factory=dict)  # by scan, since the one before; where that is said
    not_seen: frozenset[int] = frozenset()  # scans of which it is said that they did not look for it
    # How probable it is said to be, by scan: that it is one object with the first, and
    matched: dict[int, float] = field(default_factory=dict)
    # that of this scan and the one before, one alone has it,
    alone: dict[int, float] = field(default_factory=dict)
    # and that it moved, or stayed, as `moved` has it.
    motion: dict[int, float] = field(default_factory=dict)


def tracks_of(scene: LivingScene, *, probable: bool = False) -> list[Track]:
    """The objects of a living scene. `probable`: scores of matches are probabilities (`EvidenceMatcher`)."""
    return [
        Track(
            instance={seen.scan: seen.instance for seen in o.observations},
            T_track_scan={seen.scan: seen.T_ref_scan for seen in o.observations},
            points=accumulated_points(o),
            mesh=o.mesh,
            score=min(*(seen.score for seen in o.observations), *in_one_scan(scene, o.id).values(), 1.0),
            seen={seen.scan: points_of(o, seen) for seen in o.observations},
            moved={c.to_scan: o.id in c.moved for c in scene.changes if o.id in c.moved + c.static},
            not_seen=frozenset(s.index for s in scene.scans if o.id in s.not_seen),
            matched={seen.scan: seen.score for seen in o.observations[1:] if probable},
            alone=in_one_scan(scene, o.id) if probable else {},
            motion={
                c.to_scan: c.probability[o.id]
                for c in scene.changes
                if probable and o.id in c.moved + c.static and o.id in c.probability
            },
        )
        for o in scene.objects
    ]


def in_one_scan(scene: LivingScene, id_: str) -> dict[int, float]:
    """How probable it is that an object was in one scan alone, by the later scan of every pair where that is said."""
    return {
        c.to_scan: c.probability[id_]
        for c in scene.changes
        if id_ in c.probability and id_ in c.added + c.removed + c.not_seen + c.discovered
    }


def track_with(tracks: Sequence[Track], scan: int, instance: int) -> Track | None:
    """The track that holds an instance."""
    return next((t for t in tracks if t.instance.get(scan) == instance), None)


def score_tracks(
    scene: KnownScene, tracks: Sequence[Track], right_deg: float, samples: int, *, says_motion: bool = False
) -> list[Record]:
    """A record for every true pair (first scan that has an object, each later one): matched, registered, reconstructed.

    As published, objects without a mask do not count at all; in the other columns they have failed. `says_motion`: the
    method says what moved and what stayed.
    """
    records = []
    for o in scene.objects:
        track = track_with(tracks, o.first, o.instance[o.first]) if o.instance[o.first] != LOST else None
        recalled = object_recall(o, track, samples) if o.mesh is not None else None
        for k in sorted(o.instance):
            if k > o.first:
                lost = LOST in (o.instance[o.first], o.instance[k])
                record = pair_record(
                    scene, o, k, track, right_deg, recalled, lost=lost, says_motion=says_motion
                )
                records.append(record)
    return records


def pair_record(
    scene: KnownScene,
    o: KnownObject,
    k: int,
    track: Track | None,
    right_deg: float,
    recalled: dict[str, float] | None,
    *,
    lost: bool,
    says_motion: bool = False,
) -> Record:
    """One true pair. `mr.*` and `mrr.*` are 1 or 0; the latter only where there is a true mesh.

    Of what changed its shape between the two scans there is `m.*` alone: no pose is true of all of it.
    `says_motion`: the method says of what it found whether it moved: `told.strict` is then whether that is right, for
    scans that follow each other.
    """
    found = track.instance.get(k) if track else None
    other = scene.owner(k, found) if found is not None else None
    scores = found_pose(scene, o, other, k, track) if not lost else failed_pose()
    rigid = o.same_shape(o.first, k)
    record: Record = {"object": o.name, "category": o.category, "to_scan": k, **(scores if rigid else {})}
    if o.collection:
        record["collection"] = o.collection
    for c in COLUMNS:
        if c == "published" and lost:
            continue
        same = other is o if c == "paper" else other is not None and other.copies == o.copies
        error = scores[f"re_deg.{c}"]
        record[f"m.{c}"] = float(same)
        if not rigid:
            continue
        if c == "strict" and says_motion and o.moved.get(k) is not None and k == o.first + 1:
            record["told.strict"] = float(same and track is not None and track.moved.get(k) == o.moved[k])
        record[f"mr.{c}"] = float(same and error is not None and error < right_deg)
        if recalled is not None:
            record[f"mrr.{c}"] = record[f"mr.{c}"] * float(recalled[c] > RECONSTRUCTED)
    return record


def found_pose(
    scene: KnownScene, o: KnownObject, other: KnownObject | None, k: int, track: Track | None
) -> Scores:
    """Scores of the pose of `other`, what a track takes for `o` in scan `k`; a failure unless they look alike."""
    if track is None or other is None or other.copies != o.copies:
        return failed_pose()
    T = np.linalg.inv(track.T_track_scan[o.first]) @ track.T_track_scan[k]
    source = scene.instance(k, other.instance[k]).points
    target = scene.instance(o.first, o.instance[o.first]).points
    return pose_scores(T, o, other, k, o.first, source, target)


def object_recall(o: KnownObject, track: Track | None, samples: int) -> dict[str, float]:
    """SDF recall of the object's mesh in each column; 0 without one."""
    if track is None:
        return dict.fromkeys(COLUMNS, 0.0)
    scores = mesh_scores(track.mesh, o, track.T_track_scan[o.first] @ o.T_scan_model[o.first], samples)
    return {str(c): float(scores[f"recall.{c}"] or 0.0) for c in COLUMNS}


def changes_f1(scene: KnownScene, tracks: Sequence[Track]) -> float:
    """F1 of added and removed between scans that follow each other: instances that begin or end a presence.

    An object that is there and not seen has not come or gone, and a method cannot know; nor can it where the other scan
    did not look at the place (less than `LEAST_IN_SIGHT` of it). What is said of either counts neither way. A method
    that says it did not look for something does not say that it came or went.
    """
    true, open_ = true_changes(scene)
    return f1(set(said_changes(scene, tracks)) - open_, true)


Change = tuple[str, int, int]  # added or removed, the later scan, the instance


def said_changes(scene: KnownScene, tracks: Sequence[Track]) -> dict[Change, Track]:
    """What is said to have come or gone between scans that follow each other, and the track that says so."""
    return {
        (name, k, t.instance[here]): t
        for k in range(1, len(scene.scans))
        for name, here, other in sides(k)
        for t in tracks
        if here in t.instance and other not in t.instance and other not in t.not_seen
    }


def true_changes(scene: KnownScene) -> tuple[set[Change], set[Change]]:
    """What really came or went, and what counts neither way."""
    true, open_ = set[Change](), set[Change]()
    for k in range(1, len(scene.scans)):
        for name, here, other in sides(k):
            for o in (o for o in scene.objects if here in o.instance and other not in o.instance):
                if other in o.T_scan_model or scene.in_sight(o, other, here) < LEAST_IN_SIGHT:
                    open_ |= {(name, k, i) for i in o.masks(here)}
                else:
                    true.add((name, k, o.instance[here]))
    return true, open_


def without_loose(scene: KnownScene, tracks: Sequence[Track]) -> list[Track]:
    """The tracks but those that hold nothing else than what is `loose`."""
    if not scene.loose:
        return list(tracks)
    return [t for t in tracks if not all(i in scene.loose[k] for k, i in t.instance.items())]


def sides(k: int) -> tuple[tuple[str, int, int], tuple[str, int, int]]:
    """Of scan `k` and the one before: what a change is called, the scan that has the object, the one that lacks it."""
    return ("added", k, k - 1), ("removed", k - 1, k)


def false_changes(scene: KnownScene, tracks: Sequence[Track]) -> list[float]:
    """Of every object that two scans in a row have, and only one of them a mask of: 1 if told as added or removed.

    What no track holds is not told of: 0.
    """
    found = list[float]()
    for k in range(1, len(scene.scans)):
        for here, other in ((k, k - 1), (k - 1, k)):
            for o in scene.objects:
                masked = [o.instance.get(scan, LOST) != LOST for scan in (here, other)]
                if masked != [True, False] or other not in o.T_scan_model:
                    continue
                t = track_with(tracks, here, o.instance[here])
                found.append(float(t is not None and other not in t.instance and other not in t.not_seen))
    return found


def f1(predicted: Set[Hashable], truth: Set[Hashable]) -> float:
    """Harmonic mean of precision and recall of a set; 1 when both are empty."""
    if not predicted and not truth:
        return 1.0
    return 2 * len(predicted & truth) / (len(predicted) + len(truth))
