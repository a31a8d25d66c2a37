"""Masks that show one object in parts: joined before objects are compared, where that explains the other scan better.

Beyond the paper, which takes masks as true. A part of an object looks like another object's part as well, so parts are
joined first; `split_masks` joins what is left over after registration. Two masks of a scan are one object where they
touch, where both lie on one object of the other scan in one pose, and where surfaces find both together to be that
object as surely as one alone.
"""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from more2_jax.geometry.poses import Points
from more2_jax.geometry.touching_surfaces import touch
from more2_jax.geometry.transform import transform
from more2_jax.matching.color import color_of
from more2_jax.network.embedding_batch import embed
from more2_jax.network.prior import Prior
from more2_jax.tracking.accumulated import embed_accumulated
from more2_jax.tracking.comparison import Comparison
from more2_jax.tracking.objects import place_of
from more2_jax.tracking.regrouped import JoinedMask, Regrouped
from more2_jax.tracking.split_masks import Balls, absorbed, joined, share_on
from more2_jax.types import Instance, ObservedObject, Repair, SceneObject

# Chosen on rooms of regimes `paper`, `sparse` and `real`, docs/developing/notebook/mask_parts.md.
LEAST_ON = 0.3  # share of a part that must lie on the other scan's object, which may be a part itself
LIKELY = 1.0  # log odds beyond an even chance: what is so likely an object of its own
LEAST_GAIN = 1.0  # is joined where both together are so much likelier than the likelier of them
MOST_LOSS = 0.5  # log odds that a whole may lose by its part: it is compared in more places


@dataclass(frozen=True, kw_only=True)
class Join:
    """Two clouds of one scan that are one object, by rows."""

    matched: int  # the one whose partner both are
    part: int
    share: float  # of the part, on that partner
    odds: float  # of both together with it
    smooth: float = 0.0  # share of their border, where no partner shows the whole


@dataclass(frozen=True, kw_only=True)
class Parts(ABC):
    """The clouds of one scan, some of which may be parts of what others were found to be."""

    compared: Comparison
    partner: Mapping[int, int]  # row → row in the other scan
    odds: Mapping[int, float]  # of the pairs found, by rows
    clouds: Sequence[Points]  # in the frame of their scan

    @abstractmethod
    def whole(self, row: int) -> Points:
        """What a cloud was found to be, laid onto it by the pose that fits best."""

    @abstractmethod
    def odds_together(self, row: int, part: int) -> float:
        """Log odds of two clouds together with what the first was found to be."""

    def may_be_one(self, row: int, part: int) -> bool:
        """Whether two clouds can be one mask's."""
        return row != part

    def joins(self) -> list[Join]:
        """What is to be joined, the likeliest first; every cloud once."""
        balls, found = Balls.around(self.clouds), list[Join]()
        for row in self.partner:
            whole = self.whole(row)
            for part in balls.reach(whole):
                if not self.may_be_one(row, part) or not touch(self.clouds[row], self.clouds[part]):
                    continue
                share = share_on(whole, self.clouds[part])
                if share >= LEAST_ON and (odds := self.odds_together(row, part)) >= self.needed(row, part):
                    found.append(Join(matched=row, part=part, share=share, odds=odds))
        return each_once(sorted(found, key=lambda j: -j.odds))

    def needed(self, row: int, part: int) -> float:
        """Log odds that both together must have."""
        even = self.compared.even_odds
        own = self.odds.get(part, -np.inf)
        if own < even + LIKELY:
            return max(self.odds[row] - MOST_LOSS, even)
        return max(self.odds[row], own) + LEAST_GAIN


@dataclass(frozen=True, kw_only=True)
class InstanceParts(Parts):
    """The instances of a scan."""

    instances: Sequence[Instance]

    def whole(self, row: int) -> Points:
        """The object that an instance was found to be, in the scan's frame."""
        return self.compared.object_there(self.partner[row], row)

    def odds_together(self, row: int, part: int) -> float:
        """Log odds of two instances together with the object that the first was found to be."""
        new = instances_together(self.compared, self.instances, row, part)
        return self.compared.odds_of_pair(self.compared.old[self.partner[row]], new)


@dataclass(frozen=True, kw_only=True)
class ObjectParts(Parts):
    """The objects known so far."""

    objects: Sequence[SceneObject]

    def whole(self, row: int) -> Points:
        """The instance that an object was found to be, in the scene's frame."""
        return self.compared.instance_there(row, self.partner[row])

    def may_be_one(self, row: int, part: int) -> bool:
        """Whether the second was seen once, by the scan that saw the first last: two parts of one mask."""
        return row != part and seen_with(self.objects[row], self.objects[part])

    def odds_together(self, row: int, part: int) -> float:
        """Log odds of two objects together with the instance that the first was found to be."""
        old = objects_together(self.compared, self.objects, row, part)
        return self.compared.odds_of_pair(old, self.compared.new[self.partner[row]])


def seen_with(o: SceneObject, part: SceneObject) -> bool:
    """Whether an object was seen once, by the scan that saw the other last: both may be parts of one mask."""
    return [s.scan for s in part.observations] == [o.observations[-1].scan]


def instances_together(
    compared: Comparison, instances: Sequence[Instance], row: int, part: int
) -> ObservedObject:
    """Two instances of a scan as one, as it would be compared."""
    both = joined(instances[row], [instances[part]])
    (code,) = embed(compared.prior, [both.points], [both.normals])
    return dataclasses.replace(
        compared.new[row],
        points=both.points,
        normals=both.normals,
        color=color_of(both.colors),
        embedding=code,
    )


def objects_together(
    compared: Comparison, objects: Sequence[SceneObject], row: int, part: int
) -> ObservedObject:
    """An object and its part (`seen_with`) as one, as it would be compared."""
    both = absorbed(objects[row], objects[part])
    (code,) = embed(compared.prior, [both.points], [both.normals])
    cloud = ObservedObject(points=both.points, normals=both.normals, color=both.color, embedding=code)
    return dataclasses.replace(
        transform(cloud, place_of(both.observations[-1])),
        sight=compared.old[row].sight,
        around=compared.old[row].around,
    )


def join_parts(whole: Regrouped, compared: Comparison) -> Regrouped | None:
    """Joins instances that are one object known before, and objects that are one instance; None if there are none."""
    prior, pairs = compared.prior, [(f.object, f.instance) for f in compared.identified.found]
    of_instances = InstanceParts(
        compared=compared,
        partner={i: k for k, i in pairs},
        odds=compared.odds_of_found(1),
        clouds=[o.points for o in compared.new],
        instances=whole.instances,
    ).joins()
    of_objects = ObjectParts(
        compared=compared,
        partner=dict(pairs),
        odds=compared.odds_of_found(0),
        clouds=[o.points for o in compared.old],
        objects=whole.objects,
    ).joins()
    if not of_instances and not of_objects:
        return None
    return with_instances_joined(with_objects_joined(whole, of_objects, prior), of_instances, prior)


def each_once(found: Sequence[Join]) -> list[Join]:
    """Those that share no cloud with one before."""
    kept, taken = list[Join](), set[int]()
    for j in found:
        if taken.isdisjoint({j.matched, j.part}):
            kept.append(j)
            taken |= {j.matched, j.part}
    return kept


def with_objects_joined(whole: Regrouped, joins: Sequence[Join], prior: Prior) -> Regrouped:
    """The larger of two objects keeps its id, unless it was seen once and the smaller more often."""
    objects, repairs, parts, wholes = list(whole.objects), list(whole.repairs), set[int](), list[int]()
    for j in joins:
        first, second = j.matched, j.part
        if len(objects[first].observations) == 1 and len(objects[second].points) > len(objects[first].points):
            first, second = second, first
        objects[first] = absorbed(objects[first], objects[second])
        repairs.append(
            Repair(object=objects[first].id, absorbed=(objects[second].id,), share=j.share, smooth=j.smooth)
        )
        parts.add(second)
        wholes.append(first)
    objects = embed_accumulated(prior, objects, wholes)
    return dataclasses.replace(
        whole, objects=[o for k, o in enumerate(objects) if k not in parts], repairs=tuple(repairs)
    )


def with_instances_joined(whole: Regrouped, joins: Sequence[Join], prior: Prior) -> Regrouped:
    """The larger of two instances keeps its id."""
    instances, embeddings, whole_of = list(whole.instances), list(whole.embeddings), dict[int, int]()
    masks = list(whole.joined)
    for j in joins:
        first, second = sorted((j.matched, j.part), key=lambda i: -len(instances[i].points))
        ids = instances[first].id, instances[second].id
        masks.append(JoinedMask(instances=ids, share=j.share, smooth=j.smooth))
        instances[first] = joined(instances[first], [instances[second]])
        (embeddings[first],) = embed(prior, [instances[first].points], [instances[first].normals])
        whole_of[second] = first
    kept = [i for i in range(len(instances)) if i not in whole_of]
    row = {i: n for n, i in enumerate(kept)}
    halves = [tuple(row[whole_of.get(i, i)] for i in pair) for pair in whole.halves]
    return dataclasses.replace(
        whole,
        instances=[instances[i] for i in kept],
        embeddings=[embeddings[i] for i in kept],
        halves=tuple((a, b) for a, b in halves if a != b),
        joined=tuple(masks),
    )
