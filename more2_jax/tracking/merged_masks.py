"""Masks that hold two objects: divided where each half is an object that the other scan shows alone.

Beyond the paper, which takes masks as true. A graph cut, or what is left of a cloud beside the object it was found to
be, proposes how a mask may fall in two; surfaces decide, as they decide who is who (`EvidenceMatcher`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import overload

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from more2_jax.geometry.normalized_cut import Cut, Rows, thinnest_cuts
from more2_jax.geometry.poses import Points, Pose, apply_pose
from more2_jax.geometry.transform import transform
from more2_jax.matching.color import color_of
from more2_jax.network.embedding_batch import PADDED_TOGETHER, embed
from more2_jax.tracking.comparison import Comparison
from more2_jax.tracking.divisions import LEAST_GAIN, Division, Part, Wholes, chosen
from more2_jax.tracking.objects import place_of
from more2_jax.tracking.regrouped import Regrouped
from more2_jax.tracking.room_points import some_points
from more2_jax.tracking.split_masks import reach_m
from more2_jax.types import Embedding, Instance, ObservedObject, Repair, SceneObject

Normals = Float[np.ndarray, "n 3"]

# Chosen on rooms of regime `real`, docs/developing/notebook/mask_repair.md.
LEAST_PART = 0.1  # share of a mask's points that either half must have
CUTS = 2  # of a graph, that are tried
LEAST_COMMON = 0.5  # share of a thing's points that lie on a mask which may hold it
NEIGHBORS = 7  # of a point, itself among them, that say whether it lies beside a thing


@dataclass(frozen=True, kw_only=True)
class Standing:
    """Clouds of one scan where they stand in the other's frame, as if none had moved."""

    clouds: dict[int, Points]  # by their rows
    low: Float[np.ndarray, "n 3"]  # of their boxes
    high: Float[np.ndarray, "n 3"]

    @classmethod
    def of(cls, rows: Iterable[int], objects: Sequence[ObservedObject], T: Pose) -> Standing:
        """The objects of these rows, placed by `T`."""
        clouds = {k: apply_pose(T, objects[k].points) for k in rows}
        low, high = (np.array([f(c) for c in clouds.values()]).reshape(-1, 3) for f in (lowest, highest))
        return cls(clouds=clouds, low=low, high=high)

    def within(self, points: Points, but: int | None = None) -> list[Points]:
        """Those of which half the points or more lie on a cloud; not the one of row `but`."""
        apart = np.any((self.low > highest(points)) | (self.high < lowest(points)), axis=1)
        rows = np.array(list(self.clouds), int)[~apart]
        near = [self.clouds[k] for k in rows.tolist() if k != but]
        tree = KDTree(points) if near else None
        return [c for c in near if tree is not None and share_near(tree, c) >= LEAST_COMMON]


class Halves(Sequence[ObservedObject]):
    """Parts of clouds as they are compared, made when they are asked for: few are worth aligning."""

    def __init__(self, made: Callable[[Part], ObservedObject], parts: Sequence[Part]) -> None:
        self._made, self._parts = made, parts

    def __len__(self) -> int:
        return len(self._parts)

    @overload
    def __getitem__(self, row: int) -> ObservedObject: ...

    @overload
    def __getitem__(self, row: slice) -> Halves: ...

    def __getitem__(self, row: int | slice) -> ObservedObject | Halves:
        if isinstance(row, slice):
            return Halves(self._made, self._parts[row])
        return self._made(self._parts[row])


def lowest(points: Points) -> Float[np.ndarray, "3"]:
    return points.min(axis=0)


def highest(points: Points) -> Float[np.ndarray, "3"]:
    return points.max(axis=0)


def share_near(tree: KDTree, points: Points) -> float:
    """Share of the points that lie on a cloud."""
    distance, _ = tree.query(points, distance_upper_bound=reach_m(points))
    return float(np.isfinite(distance).mean())


def divide_merged(whole: Regrouped, compared: Comparison, first_number: int) -> Regrouped | None:
    """Divides instances that hold two objects known apart, and objects, seen once, that two instances show apart.

    None if there is nothing to divide. Once more after a division, in any orientation, both halves must be known.
    """
    both_known = whole.divided and compared.config.motion == "free"
    of_instances = divisions_of_instances(compared, whole.instances, both_known)
    of_objects = divisions_of_objects(compared, whole.objects, both_known)
    if not of_instances and not of_objects:
        return None
    return with_instances_divided(with_objects_divided(whole, of_objects, first_number), of_instances)


def with_objects_divided(whole: Regrouped, divisions: Sequence[Division], first_number: int) -> Regrouped:
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


def with_instances_divided(whole: Regrouped, divisions: Sequence[Division]) -> Regrouped:
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


def divisions_of_instances(
    compared: Comparison, instances: Sequence[Instance], both_known: bool = False
) -> list[Division]:
    """Which instances hold two objects that are known apart."""
    partner = {f.instance: f.object for f in compared.identified.found}
    wholes = wholes_of(compared, partner, compared.old, 1, both_known)
    T_scan_scene = np.linalg.inv(compared.identified.frame.T_scene_scan)
    standing = Standing.of(wholes.may_be_taken, compared.old, T_scan_scene)
    cuts = {
        i: cuts_of(
            compared,
            o.points,
            compared.object_there(partner[i], i) if i in partner else None,
            standing.within(o.points, partner.get(i)),
        )
        for i, o in enumerate(compared.new)
        if wholes.in_doubt(i)
    }

    def half(p: Part) -> ObservedObject:
        i = part_of_instance(instances[p.whole], p)
        return ObservedObject(
            points=i.points,
            embedding=p.embedding,
            color=color_of(i.colors),
            sight=compared.new[p.whole].sight,
            normals=i.normals,
        )

    return chosen(
        halves_of(compared, cuts, [(i.points, i.normals) for i in instances]),
        wholes,
        lambda parts, others, among: compared.odds_of_others(
            [compared.old[k] for k in others], Halves(half, parts), among, halves=True
        ),
    )


def divisions_of_objects(
    compared: Comparison, objects: Sequence[SceneObject], both_known: bool = False
) -> list[Division]:
    """Which objects, seen once, are two that the new scan shows apart."""
    partner = {f.object: f.instance for f in compared.identified.found}
    wholes = wholes_of(compared, partner, compared.new, 0, both_known)
    seen_once = [k for k, o in enumerate(objects) if len(o.observations) == 1]
    standing = Standing.of(wholes.may_be_taken, compared.new, compared.identified.frame.T_scene_scan)
    cuts = {
        k: cuts_of(
            compared,
            compared.old[k].points,
            compared.instance_there(k, partner[k]) if k in partner else None,
            standing.within(compared.old[k].points, partner.get(k)),
        )
        for k in seen_once
        if wholes.in_doubt(k)
    }

    def half(p: Part) -> ObservedObject:
        o = objects[p.whole]
        normals = None if o.normals is None else o.normals[p.rows]
        part = ObservedObject(points=o.points[p.rows], embedding=p.embedding, normals=normals)
        placed = transform(part, place_of(o.observations[-1]))
        return dataclasses.replace(placed, sight=compared.old[p.whole].sight)

    return chosen(
        halves_of(compared, cuts, [(o.points, o.normals) for o in objects]),
        wholes,
        lambda parts, others, among: {
            (i, part): z
            for (part, i), z in compared.odds_of_others(
                Halves(half, parts),
                [compared.new[i] for i in others],
                {(p, i) for i, p in among},
                halves=True,
            ).items()
        },
    )


def cuts_of(
    compared: Comparison, points: Points, partner: Points | None, others: Sequence[Points]
) -> list[Cut]:
    """How a cloud may fall in two: beside what it was found to be, at its thinnest, beside what stands in it."""
    first: list[Cut] = []
    if partner is not None:
        rest = beside_of(partner, points)
        if rest.mean() < LEAST_PART:
            return []
        first = [(rest, False)]
    thin = thinnest_cuts(points, CUTS, LEAST_PART)
    first = first or thin[:1]
    cuts = [*first, *(c for c in thin if c[1] and c is not first[0])]
    cuts += [(beside_of(o, points), False) for o in others]
    fewest = max(compared.config.min_points, LEAST_PART * len(points))
    return [c for c in cuts if min(c[0].sum(), (~c[0]).sum()) >= fewest]


def halves_of(
    compared: Comparison, cuts: dict[int, list[Cut]], clouds: Sequence[tuple[Points, Normals | None]]
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
    codes = list[Embedding]()
    for start in range(0, len(every), PADDED_TOGETHER):
        some = [(*clouds[w], rows) for w, rows, _ in every[start : start + PADDED_TOGETHER]]
        normals = [None if n is None else n[rows] for _, n, rows in some]
        codes += embed(compared.prior, [points[rows] for points, _, rows in some], normals)
    parts = [Part(whole=w, rows=r, embedding=e, narrow=n) for (w, r, n), e in zip(every, codes, strict=True)]
    return list(zip(parts[::2], parts[1::2], strict=True))


def wholes_of(
    compared: Comparison,
    partner: Mapping[int, int],
    others: Sequence[ObservedObject],
    side: int,
    both_known: bool,
) -> Wholes:
    """How the clouds of one scan, objects (side 0) or instances (1), stand to `others`, those of the other."""
    odds = compared.odds_of_found(side)
    return Wholes(
        partner=partner,
        left=sorted(set(range(len(others))) - set(partner.values())),
        scale=[float(o.embedding.scale) for o in others],
        odds=odds,
        doubtful={k: odds[w] for w, k in partner.items() if odds[w] < compared.even_odds},
        least=LEAST_GAIN[compared.config.motion],
        both_known=both_known,
    )


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
    return some_points(instance, part.rows)


def part_of_object(o: SceneObject, part: Part) -> SceneObject:
    """One half of an object that was seen once, with its id."""
    return dataclasses.replace(
        o,
        points=o.points[part.rows],
        point_scan=o.point_scan[part.rows],
        normals=None if o.normals is None else o.normals[part.rows],
        embedding=part.embedding,
        mesh=None,
    )
