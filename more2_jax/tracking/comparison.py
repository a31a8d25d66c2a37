"""Two scans as they were compared: the poses and odds of their pairs, and of other clouds in their places."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Int

from more2_jax.config import EvidenceMatcher, SceneConfig
from more2_jax.geometry.poses import Points, Pose, apply_pose
from more2_jax.matching.assignment import NEVER
from more2_jax.matching.calibration import even_odds
from more2_jax.matching.candidates import AlignedPairs, align_proposed, evidence_at, measured_among, odds_of
from more2_jax.matching.proposals import Proposed, proposed
from more2_jax.network.prior import Prior
from more2_jax.tracking.identify import Identified
from more2_jax.types import ObservedObject

CANDIDATES = 3  # partners of every cloud that are aligned
PAIRS_AT_ONCE = 256  # that are held as they were aligned: of a building there are many


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Objects and instances as they were compared."""

    prior: Prior
    old: Sequence[ObservedObject]
    new: Sequence[ObservedObject]
    identified: Identified
    aligned: AlignedPairs
    matcher: EvidenceMatcher
    config: SceneConfig

    @classmethod
    def of(
        cls,
        prior: Prior,
        old: Sequence[ObservedObject],
        new: Sequence[ObservedObject],
        identified: Identified,
        config: SceneConfig,
    ) -> Comparison | None:
        """The comparison; None where nothing is known of surfaces (`CodeMatcher`)."""
        if not isinstance(config.matching, EvidenceMatcher) or identified.aligned is None:
            return None
        return cls(
            prior=prior,
            old=old,
            new=new,
            identified=identified,
            aligned=identified.aligned,
            matcher=config.matching,
            config=config,
        )

    def best_pose(self, k: int, i: int) -> Pose:
        """The pose of a pair that fits best: T_scene_scan as if the object had not moved."""
        (row,) = self.aligned.rows_of([(k, i)])
        return self.aligned.T_old_new[row, self.best[row]]

    def object_there(self, k: int, i: int) -> Points:
        """An object laid onto an instance by the pose that fits best, in the scan's frame."""
        return apply_pose(np.linalg.inv(self.best_pose(k, i)), self.old[k].points)

    def instance_there(self, k: int, i: int) -> Points:
        """An instance laid onto an object by the pose that fits best, in the scene's frame."""
        return apply_pose(self.best_pose(k, i), self.new[i].points)

    @cached_property
    def best(self) -> Int[np.ndarray, " p"]:
        """Which of the poses of every aligned pair fits best."""
        return evidence_at(self.aligned, self.matcher.search, self.config.motion, self.height_m()).pose

    def height_m(self) -> float:
        """The common height, upright."""
        return float(self.identified.frame.T_scene_scan[2, 3]) if self.config.motion == "upright" else 0.0

    def odds_of_found(self, side: int) -> dict[int, float]:
        """Log odds of the pairs found, by their rows of objects (side 0) or of instances (1)."""
        pairs = [(f.object, f.instance) for f in self.identified.found]
        odds = odds_of(self.aligned, self.matcher.search, self.config.motion, self.height_m())
        value = odds.value[self.aligned.rows_of(pairs)]
        return {pair[side]: float(z) for pair, z in zip(pairs, value, strict=True)}

    @property
    def even_odds(self) -> float:
        """The log odds here of an even chance."""
        return even_odds(self.matcher.search, self.config.motion)

    def odds_of_pair(self, old: ObservedObject, new: ObservedObject) -> float:
        """Log odds of one pair of clouds; `NEVER` where they are not even proposed."""
        return self.odds_of_others([old], [new]).get((0, 0), NEVER)

    def odds_of_others(
        self,
        old: Sequence[ObservedObject],
        new: Sequence[ObservedObject],
        among: Collection[tuple[int, int]] | None = None,
        *,
        halves: bool = False,
    ) -> dict[tuple[int, int], float]:
        """Log odds of clouds of both scans that were not compared, by rows of `old` and `new`.

        `among`: the pairs to ask about, all by default. Halves are small without being what people carry about.
        """
        worth = self.proposed_others(old, new)
        worth = worth if among is None else worth.among(among)
        found = dict[tuple[int, int], float]()
        for start in range(0, len(worth.pairs), PAIRS_AT_ONCE):
            found |= self._odds_of_some(old, new, worth.rows(slice(start, start + PAIRS_AT_ONCE)), halves)
        return found

    def _odds_of_some(
        self, old: Sequence[ObservedObject], new: Sequence[ObservedObject], worth: Proposed, halves: bool
    ) -> dict[tuple[int, int], float]:
        # What is part of no pair is not prepared.
        rows, at = zip(*(np.unique(side, return_inverse=True) for side in worth.pairs.T), strict=True)
        clouds = [old[k] for k in rows[0].tolist()], [new[i] for i in rows[1].tolist()]
        aligned = self.align_others(clouds, dataclasses.replace(worth, pairs=np.stack(at, axis=1)))
        if halves:
            known = dataclasses.replace(aligned.compared, portable=np.zeros(len(aligned.rows)))
            aligned = dataclasses.replace(aligned, compared=known)
        odds = odds_of(aligned, self.matcher.search, self.config.motion, self.height_m())
        return {(k, i): z for (k, i), z in zip(worth.pairs.tolist(), odds.value.tolist(), strict=True)}

    def poses_of_others(
        self, old: Sequence[ObservedObject], new: Sequence[ObservedObject]
    ) -> dict[tuple[int, int], tuple[float, Pose]]:
        """As `odds_of_others`, with the pose that fits best: T_old_new."""
        clouds, search, motion = (old, new), self.matcher.search, self.config.motion
        aligned = self.align_others(clouds, self.proposed_others(*clouds))
        odds = odds_of(aligned, search, motion, self.height_m())
        best = evidence_at(aligned, search, motion, self.height_m()).pose
        T = aligned.T_old_new[np.arange(len(best)), best]
        rows = zip(odds.pairs.tolist(), odds.value.tolist(), T, strict=True)
        return {(k, i): (z, pose) for (k, i), z, pose in rows}

    def proposed_others(self, old: Sequence[ObservedObject], new: Sequence[ObservedObject]) -> Proposed:
        """The likeliest pairs of clouds that were not compared."""
        few = dataclasses.replace(self.matcher, candidates=CANDIDATES)
        place = self.identified.frame.T_scene_scan
        return proposed(old, new, few, place, motion=self.config.motion)

    def align_others(
        self, clouds: tuple[Sequence[ObservedObject], Sequence[ObservedObject]], worth: Proposed
    ) -> AlignedPairs:
        """Pairs of such clouds, aligned; compared as far as noise puts surfaces apart."""
        frame, seen = self.identified.frame, self.aligned.seen
        aligned = align_proposed(
            self.prior, clouds, worth, self.matcher, self.config.motion, frame.T_scene_scan, seen
        )
        return measured_among(aligned, frame.noise_m)
