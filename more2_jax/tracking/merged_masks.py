"""Masks that hold two objects: divided where each half is an object that the other scan shows alone.

Beyond the paper, which takes masks as true. A graph cut, or what is left of a cloud beside the object it was found to
be, proposes how a mask may fall in two; surfaces decide, as they decide who is who (`EvidenceMatcher`).
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from more2_jax.config import EvidenceMatcher, SceneConfig
from more2_jax.geometry.normalized_cut import Cut, Rows, thinnest_cuts
from more2_jax.geometry.poses import Points, Pose, apply_pose
from more2_jax.geometry.transform import transform
from more2_jax.matching.candidates import align_candidates, evidence_at, odds_of
from more2_jax.matching.color import color_of
from more2_jax.network.embedding_batch import embed
from more2_jax.network.prior import Prior
from more2_jax.tracking.identify import Found, Identified
from more2_jax.tracking.objects import place_of
from more2_jax.tracking.split_masks import reach_m
from more2_jax.types import Embedding, Instance, ObservedObject, Repair, SceneObject

Normals = Float[np.ndarray, "n 3"]
Weigh = Callable[[Sequence["Part"], Sequence[int]], Float[np.ndarray, "k p"]]

# Chosen on rooms of regime `real`, docs/relocalization.md.
LEAST_PART = 0.1  # share of a mask's points that either half must have
CUTS = 2  # of a graph, that are tried
NEIGHBORS = 7  # of a point, itself among them, that say whether it lies beside a thing
SAME_SIZE = 0.8  # |log| of the ratio of the F_s: a half that differs more from every object is not compared
CANDIDATES = 3  # partners of every half that are aligned
# Log odds that the halves must have beyond the whole, for most masks hold one object: where the halves hardly touch,
LEAST_GAIN_NARROW = 2.2
LEAST_GAIN = 4.0  # and elsewhere, where both must be known
SURE = 4.5  # log odds of a whole that is not divided


@dataclass(frozen=True, kw_only=True)
class Part:
    """One half of a cloud, as a mask of its own would show it; in the cloud's frame."""

    whole: int  # row of the cloud
    rows: Rows  # its points
    embedding: Embedding
    narrow: bool  # whether the halves hardly touch


@dataclass(frozen=True, kw_only=True)
class Division:
    """A cloud that is two objects, and which of the other scan's each half is; log odds beyond those of the whole."""

    parts: tuple[Part, Part]  # the larger first
    others: tuple[int | None, int | None]  # None: none of those that are left
    gain: float


@dataclass(frozen=True, kw_only=True)
class Divided:
    """Objects and instances; of those divided the larger half in the place of the whole, the smaller at the end."""

    objects: list[SceneObject]
    instances: list[Instance]
    embeddings: list[Embedding]  # of the instances
    halves: tuple[tuple[int, int], ...] = ()  # rows of instances that are one mask
    repairs: tuple[Repair, ...] = ()  # of objects

    def masks(self, found: Sequence[Found], fresh: Mapping[int, SceneObject]) -> tuple[Repair, ...]:
        """The masks of this scan that were divided. `fresh`: new objects by the rows of their instances."""
        names = {f.instance: self.objects[f.object].id for f in found} | {i: o.id for i, o in fresh.items()}
        return tuple(
            Repair(object=names[i], instances=(self.instances[i].id,), divided=names[j])
            for i, j in self.halves
            if i in names and j in names
        )


def divide_merged(
    prior: Prior,
    whole: Divided,
    old: Sequence[ObservedObject],
    new: Sequence[ObservedObject],
    identified: Identified,
    config: SceneConfig,
    first_number: int,
) -> Divided | None:
    """Divides instances that hold two objects known apart, and objects, seen once, that two instances show apart.

    `old` and `new`: objects and instances as they were compared. None if there is nothing to divide, or nothing
    is known of surfaces (`CodeMatcher`).
    """
    if not isinstance(config.matching, EvidenceMatcher) or identified.aligned is None:
        return None
    compare = Compare(prior=prior, old=old, new=new, identified=identified, config=config)
    of_instances = compare.divisions_of_instances(whole.instances)
    of_objects = compare.divisions_of_objects(whole.objects)
    if not of_instances and not of_objects:
        return None
    return with_instances_divided(with_objects_divided(whole, of_objects, first_number), of_instances)


def with_objects_divided(whole: Divided, divisions: Sequence[Division], first_number: int) -> Divided:
    """The smaller halves get the ids from `first_number` on."""
    objects, repairs = list(whole.objects), list(whole.repairs)
    for n, d in enumerate(divisions):
        k = d.parts[0].whole
        first, second = (part_of_object(objects[k], part) for part in d.parts)
        second = dataclasses.replace(second, id=f"object_{first_number + n:03d}")
        objects[k] = first
        objects.append(second)
        repairs.append(Repair(object=first.id, divided=second.id))
    return dataclasses.replace(whole, objects=objects, repairs=tuple(repairs))


def with_instances_divided(whole: Divided, divisions: Sequence[Division]) -> Divided:
    """Both halves keep the id that the scan's mask has."""
    instances, embeddings, halves = list(whole.instances), list(whole.embeddings), list(whole.halves)
    for d in divisions:
        i = d.parts[0].whole
        first, second = (part_of_instance(instances[i], part) for part in d.parts)
        instances[i], embeddings[i] = first, d.parts[0].embedding
        halves.append((i, len(instances)))
        instances.append(second)
        embeddings.append(d.parts[1].embedding)
    return dataclasses.replace(whole, instances=instances, embeddings=embeddings, halves=tuple(halves))


@dataclass(frozen=True, kw_only=True)
class Compare:
    """Two scans as they were compared: what a half of one may be in the other."""

    prior: Prior
    old: Sequence[ObservedObject]
    new: Sequence[ObservedObject]
    identified: Identified
    config: SceneConfig

    def divisions_of_instances(self, instances: Sequence[Instance]) -> list[Division]:
        """Which instances hold two objects that are known apart."""
        partner = {f.instance: f.object for f in self.identified.found}
        missing = sorted(set(range(len(self.old))) - set(partner.values()))
        now = self.odds_now().T
        cuts = {
            i: self.cuts(
                instances[i].points, partner.get(i), lambda k, i=i: self.placed(k, i, object_moves=True)
            )
            for i in range(len(instances))
            if missing and (now[i, partner[i]] < SURE if i in partner else len(missing) > 1)
        }

        def weigh(parts: Sequence[Part], others: Sequence[int]) -> Float[np.ndarray, "k p"]:
            halves = [
                ObservedObject(
                    points=half.points,
                    embedding=p.embedding,
                    color=color_of(half.colors),
                    sight=self.new[p.whole].sight,
                )
                for p in parts
                for half in (part_of_instance(instances[p.whole], p),)
            ]
            return self.odds([self.old[k] for k in others], halves)

        parts = self.halves(cuts, [(i.points, i.normals) for i in instances])
        scale = [float(o.embedding.scale) for o in self.old]
        return chosen(parts, partner, missing, scale, now, weigh)

    def divisions_of_objects(self, objects: Sequence[SceneObject]) -> list[Division]:
        """Which objects, seen once, are two that the new scan shows apart."""
        partner = {f.object: f.instance for f in self.identified.found}
        left = sorted(set(range(len(self.new))) - set(partner.values()))
        now = self.odds_now()
        once = [k for k, o in enumerate(objects) if len(o.observations) == 1]
        cuts = {
            k: self.cuts(
                self.old[k].points, partner.get(k), lambda i, k=k: self.placed(k, i, object_moves=False)
            )
            for k in once
            if left and (now[k, partner[k]] < SURE if k in partner else len(left) > 1)
        }

        def weigh(parts: Sequence[Part], others: Sequence[int]) -> Float[np.ndarray, "k p"]:
            halves = [
                transform(
                    ObservedObject(points=o.points[p.rows], embedding=p.embedding, color=None),
                    place_of(o.observations[-1]),
                )
                for p in parts
                for o in (objects[p.whole],)
            ]
            halves = [
                dataclasses.replace(h, sight=self.old[p.whole].sight)
                for h, p in zip(halves, parts, strict=True)
            ]
            return self.odds(halves, [self.new[i] for i in others]).T

        parts = self.halves(cuts, [(o.points, None) for o in objects])
        scale = [float(o.embedding.scale) for o in self.new]
        return chosen(parts, partner, left, scale, now, weigh)

    def cuts(self, points: Points, partner: int | None, placed: Callable[[int], Points]) -> list[Cut]:
        """How a cloud may fall in two: beside what it was found to be, and where it is thinnest."""
        first: list[Cut] = []
        if partner is not None:
            rest = beside_of(placed(partner), points)
            if rest.mean() < LEAST_PART:
                return []
            first = [(rest, False)]
        thin = thinnest_cuts(points, CUTS, LEAST_PART)
        first = first or thin[:1]
        cuts = [*first, *(c for c in thin if c[1] and c is not first[0])]
        fewest = max(self.config.min_points, LEAST_PART * len(points))
        return [c for c in cuts if min(c[0].sum(), (~c[0]).sum()) >= fewest]

    def placed(self, k: int, i: int, *, object_moves: bool) -> Points:
        """Object `k` in the new scan's frame, or instance `i` in the scene's, by the best pose found of the pair."""
        T = self.best_pose(k, i)
        if object_moves:
            return apply_pose(np.linalg.inv(T), self.old[k].points)
        return apply_pose(T, self.new[i].points)

    def best_pose(self, k: int, i: int) -> Pose:
        """The pose of a pair that fits best: T_scene_scan as if the object had not moved."""
        aligned, config = self.identified.aligned, self.config
        assert aligned is not None and isinstance(config.matching, EvidenceMatcher)
        row = aligned.row_of(k, i)
        best = evidence_at(aligned, config.matching.search, config.motion, self.height_m()).pose
        return aligned.T_old_new[row, best[row]]

    def height_m(self) -> float:
        """The common height, upright."""
        return float(self.identified.frame.T_scene_scan[2, 3]) if self.config.motion == "upright" else 0.0

    def odds_now(self) -> Float[np.ndarray, "n m"]:
        """Of the wholes."""
        aligned, config = self.identified.aligned, self.config
        assert aligned is not None and isinstance(config.matching, EvidenceMatcher)
        return odds_of(aligned, config.matching.search, config.motion, self.height_m())

    def odds(self, old: Sequence[ObservedObject], new: Sequence[ObservedObject]) -> Float[np.ndarray, "n m"]:
        """Of halves with what they may be."""
        config, T = self.config, self.identified.frame.T_scene_scan
        assert isinstance(config.matching, EvidenceMatcher)
        matcher = dataclasses.replace(config.matching, candidates=CANDIDATES)
        aligned = align_candidates(self.prior, old, new, matcher, config.motion, T)
        return odds_of(aligned, matcher.search, config.motion, self.height_m())

    def halves(
        self, cuts: dict[int, list[Cut]], clouds: Sequence[tuple[Points, Normals | None]]
    ) -> list[tuple[Part, Part]]:
        """Both sides of every cut with their codes, the larger first."""
        every = [
            (w, side, narrow)
            for w, of_whole in cuts.items()
            for rows, narrow in of_whole
            for side in larger_first(rows)
        ]
        if not every:
            return []
        normals = [None if n is None else n[rows] for w, rows, _ in every for n in (clouds[w][1],)]
        codes = embed(self.prior, [clouds[w][0][rows] for w, rows, _ in every], normals)
        parts = [
            Part(whole=w, rows=r, embedding=e, narrow=n) for (w, r, n), e in zip(every, codes, strict=True)
        ]
        return list(zip(parts[::2], parts[1::2], strict=True))


def chosen(
    halves: Sequence[tuple[Part, Part]],
    partner: dict[int, int],
    left: Sequence[int],
    scale: Sequence[float],
    odds_now: Float[np.ndarray, "w k"],
    weigh: Weigh,
) -> list[Division]:
    """The divisions that surfaces find likelier than the wholes; each cloud once, each of the other scan's once.

    `partner`: what a whole was found to be; `left`: rows of the other scan's clouds that nothing was found to be;
    `scale`: F_s of the other scan's clouds.
    """

    def may_be(part: Part) -> list[int]:
        rows = [*left, *([partner[part.whole]] if part.whole in partner else [])]
        ratio = np.log(float(part.embedding.scale) / np.array([scale[k] for k in rows]))
        return [k for k, r in zip(rows, ratio, strict=True) if abs(r) < SAME_SIZE]

    halves = [pair for pair in halves if any(may_be(p) for p in pair)]
    if not halves:
        return []
    others = sorted({k for pair in halves for p in pair for k in may_be(p)})
    odds = weigh([p for pair in halves for p in pair], others)
    at = {k: n for n, k in enumerate(others)}
    proposals = []
    for n, pair in enumerate(halves):
        whole = pair[0].whole
        now = max(odds_now[whole, partner[whole]], 0.0) if whole in partner else 0.0
        fits = [
            {None: 0.0} | {k: odds[at[k], 2 * n + side] for k in may_be(p) if odds[at[k], 2 * n + side] > 0}
            for side, p in enumerate(pair)
        ]
        for k, q in itertools.product(*fits):
            gain = float(fits[0][k] + fits[1][q] - now)
            both = k is not None and q is not None
            enough = gain > LEAST_GAIN_NARROW if pair[0].narrow else both and gain > LEAST_GAIN
            if enough and k != q:
                proposals.append(Division(parts=pair, others=(k, q), gain=gain))
    return compatible(proposals)


def compatible(proposals: Sequence[Division]) -> list[Division]:
    """The best proposals that share no cloud."""
    kept: list[Division] = []
    for d in sorted(proposals, key=lambda d: -d.gain):
        clash = any(
            d.parts[0].whole == e.parts[0].whole or (set(d.others) & set(e.others)) - {None} for e in kept
        )
        if not clash:
            kept.append(d)
    return kept


def beside_of(whole: Points, points: Points) -> Rows:
    """Which points do not lie on a cloud; single ones follow their neighbors."""
    distance, _ = KDTree(whole).query(points, distance_upper_bound=reach_m(whole))
    off = ~np.isfinite(distance)
    _, near = KDTree(points).query(points, k=min(NEIGHBORS, len(points)))
    return off[near].reshape(len(points), -1).mean(axis=1) > 0.5


def larger_first(side: Rows) -> tuple[Rows, Rows]:
    """Both sides of a cut."""
    return (side, ~side) if side.sum() >= (~side).sum() else (~side, side)


def part_of_instance(instance: Instance, part: Part) -> Instance:
    """One half of an instance, with its id."""
    per_point = {name: getattr(instance, name) for name in ("points", "colors", "normals")}
    return dataclasses.replace(
        instance, **{name: None if x is None else x[part.rows] for name, x in per_point.items()}
    )


def part_of_object(o: SceneObject, part: Part) -> SceneObject:
    """One half of an object that was seen once, with its id."""
    return dataclasses.replace(
        o,
        points=o.points[part.rows],
        point_scan=o.point_scan[part.rows],
        embedding=part.embedding,
        mesh=None,
    )
