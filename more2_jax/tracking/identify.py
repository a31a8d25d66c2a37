"""Who is who in a new scan: its instances against the objects known so far (paper §3.2)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from more2_jax.config import CodeMatcher, EvidenceMatcher, SceneConfig
from more2_jax.matching.assignment import Chosen, LogOdds, assign, interchangeable, unmatched
from more2_jax.matching.calibration import alone_probability, even_odds, probability, told_probability
from more2_jax.matching.candidates import AlignedPairs, odds_of
from more2_jax.matching.code_assignment import match_instances
from more2_jax.matching.places import IN_PLACE, distances_m, in_place, motion_odds
from more2_jax.network.embedding_batch import stack
from more2_jax.network.prior import Prior
from more2_jax.tracking.objects import SCENE_FRAME
from more2_jax.tracking.rooms import Rooms
from more2_jax.tracking.scan_frame import among_noise, common_frame
from more2_jax.tracking.scan_noise import with_noise
from more2_jax.tracking.still_standing import lost_by_standing
from more2_jax.types import Frame, ObservedObject, SceneObject

Lost = Mapping[tuple[int, int], float]  # of log odds, by pairs (object, instance)

NO_ROOMS, NOTHING_LOST = Rooms(), dict[tuple[int, int], float]()
# Of log odds, in any orientation, for pairs of what is left over: objects stay more often than the weights were fitted
# for, docs/developing/notebook/matching_any_orientation.md.
LEFT_OVER = 1.0


@dataclass(frozen=True, kw_only=True)
class Found:
    """An instance of a scan that is an object known before."""

    object: int
    instance: int
    score: float  # `CodeMatcher`: H; `EvidenceMatcher`: probability of being one object
    interchangeable: bool = False  # another assignment explains the scans as well: identical copies


@dataclass(frozen=True, kw_only=True)
class Identified:
    """Who is who in a scan. What is left over has a probability only where surfaces were compared."""

    found: tuple[Found, ...] = ()
    gone: dict[int, float] = field(default_factory=dict)  # object → probability that it is not in the scan
    new: dict[int, float] = field(default_factory=dict)  # instance → probability that it is no known object
    frame: Frame = SCENE_FRAME  # of the scan
    # The pairs that surfaces were compared of, for registration to go on with,
    aligned: AlignedPairs | None = None
    # and what they lost of log odds where places say that they did not move (`still_standing`).
    lost: Lost = field(default_factory=dict)

    def without_seen(self) -> Identified:
        """What registration needs to know: no longer what scans show to be empty."""
        return self if self.aligned is None else replace(self, aligned=replace(self.aligned, seen=None))

    def without_pairs(self) -> Identified:
        """What is left to know once all are registered; the pairs are much of what a scene takes of memory."""
        return replace(self, aligned=None)


def identify(
    prior: Prior,
    old: Sequence[ObservedObject],
    new: Sequence[ObservedObject],
    config: SceneConfig,
    rooms: Rooms = NO_ROOMS,
) -> Identified:
    """One assignment of all objects (`old`, scene's frame) to the instances of a scan (`new`, its own frame)."""
    if isinstance(config.matching, CodeMatcher):
        return by_codes(old, new, config.matching)
    return by_evidence(prior, old, new, config.matching, config, rooms)


def by_codes(
    old: Sequence[ObservedObject], new: Sequence[ObservedObject], matcher: CodeMatcher
) -> Identified:
    """The assignment with the largest total score of the embeddings."""
    (a, real_a), (b, real_b) = (stack([o.embedding for o in side]) for side in (old, new))
    matches = match_instances(a, b, matcher, real_a, real_b)
    index, score = np.asarray(matches.target_index), np.asarray(matches.score)
    pairs = [(k, int(index[k])) for k in range(len(old)) if index[k] >= 0]
    return Identified(found=tuple(Found(object=k, instance=i, score=float(score[k])) for k, i in pairs))


def by_evidence(
    prior: Prior,
    old: Sequence[ObservedObject],
    new: Sequence[ObservedObject],
    matcher: EvidenceMatcher,
    config: SceneConfig,
    rooms: Rooms,
) -> Identified:
    """The assignment that surfaces find likeliest, with probabilities, and the frame of the scan."""
    frame, weighed = common_frame(prior, old, new, matcher, config.motion, rooms)
    frame = with_noise(frame, rooms.scene_surfaces, rooms.scan)
    weighed = among_noise(weighed, frame.noise_m, matcher, config.motion)
    aligned = weighed.aligned
    motion = motion_odds(aligned, frame.T_scene_scan, matcher, config.motion)
    pairs, lost = without_standing(
        lambda lost: assign(weighed.odds.less(lost), motion),
        lambda moved: lost_by_standing(aligned, moved, frame, rooms),
    )
    return as_told(
        weighed.odds.less(lost), pairs, Identified(frame=frame, aligned=aligned, lost=lost), config
    )


def without_standing(
    chosen: Callable[[Lost], Chosen],
    standing: Callable[[Chosen], Float[np.ndarray, " q"]],
    lost: Lost = NOTHING_LOST,
) -> tuple[Chosen, Lost]:
    """The likeliest assignment once its pairs have lost what their places say against them, and what they lost.

    `chosen`: the assignment when some pairs have lost log odds. `standing`: what given pairs lose. Only pairs that an
    assignment holds are asked, each once. `lost`: what is known of that.
    """
    asked, found = dict(lost), chosen(lost)
    while new := [pair for pair in map(tuple, found.tolist()) if pair not in asked]:
        asked |= dict(zip(new, standing(np.array(new)).tolist(), strict=True))
        found = chosen(asked)
    return found, {pair: less for pair, less in asked.items() if less}


def with_left_over(identified: Identified, config: SceneConfig, rooms: Rooms = NO_ROOMS) -> Identified:
    """The same with pairs of what was left over that lie in one place.

    In any orientation also those that are nearly as likely one object as not. To be asked when masks are mended: until
    then, what is left over shows which masks to mend.
    """
    aligned, frame = identified.aligned, identified.frame
    if aligned is None or not isinstance(config.matching, EvidenceMatcher):
        return identified
    search, upright = config.matching.search, config.motion == "upright"
    height_m = float(frame.T_scene_scan[2, 3]) if upright else 0.0
    odds = odds_of(aligned, search, config.motion, height_m)
    k, i = odds.pairs.T
    rows = np.isin(k, list(identified.gone)) & np.isin(i, list(identified.new))
    here = in_place(aligned, rows & (not frame.unknown), frame.T_scene_scan)
    sure = np.maximum(odds.value, even_odds(search, config.motion) + IN_PLACE)
    odds = replace(odds, value=np.where(here, sure, odds.value))
    rows = here if upright else rows
    motion = motion_odds(aligned, frame.T_scene_scan, config.matching, config.motion)[rows]

    def left(lost: Lost) -> Chosen:
        value = odds.less(lost).value[rows] + LEFT_OVER
        return assign(LogOdds(pairs=odds.pairs[rows], value=value, shape=odds.shape), motion)

    more, lost = without_standing(
        left, lambda moved: lost_by_standing(aligned, moved, frame, rooms), identified.lost
    )
    if not len(more):
        return identified
    found = np.array([(f.object, f.instance) for f in identified.found], int).reshape(-1, 2)
    pairs = np.concatenate([found, more])
    return as_told(odds.less(lost), pairs[np.lexsort(pairs.T[::-1])], replace(identified, lost=lost), config)


def as_told(odds: LogOdds, pairs: Chosen, known: Identified, config: SceneConfig) -> Identified:
    """An assignment with its probabilities, of what is `known` of the scan."""
    assert isinstance(config.matching, EvidenceMatcher)
    copies = interchangeable(odds, pairs)
    how = config.matching.search, config.motion
    gone, fresh = unmatched(odds, probability(odds.value, *how), pairs)
    assert known.aligned is not None
    moved_m = distances_m(known.aligned, known.frame.T_scene_scan, pairs)
    told = told_probability(odds.value[odds.rows_of(pairs)], moved_m, *how)
    found = tuple(
        Found(object=int(k), instance=int(i), score=float(p), interchangeable=c)
        for (k, i), p, c in zip(pairs, told, copies, strict=True)
    )
    return replace(known, found=found, gone=gone, new=fresh)


def chances(
    identified: Identified,
    objects: Sequence[SceneObject],
    fresh: Mapping[int, SceneObject],
    counted: tuple[int, int],
    config: SceneConfig,
) -> dict[str, float]:
    """Returns by object id the probability that it is really gone, back or new.

    `fresh`: new objects by the rows of their instances. `counted`: as `alone_probability` takes them.
    """
    alone = alone_probability(*counted)
    gone = {objects[k].id: alone * p for k, p in identified.gone.items()}
    known = isinstance(config.matching, EvidenceMatcher)
    back = {objects[f.object].id: f.score for f in identified.found if known}
    return gone | back | {fresh[i].id: alone * p for i, p in identified.new.items() if i in fresh}
