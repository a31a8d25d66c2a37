"""Objects and instances after masks were joined and divided, and what that is said of."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from more2_jax.config import EvidenceMatcher, SceneConfig
from more2_jax.matching.calibration import mended_probability
from more2_jax.tracking.identify import Found, Identified
from more2_jax.types import Embedding, Instance, Repair, SceneObject


@dataclass(frozen=True, kw_only=True)
class JoinedMask:
    """Masks of one scan that are one instance now."""

    instances: tuple[int, ...]  # ids; the first is that of the whole
    share: float  # of the part's points that lie on the object
    smooth: float = 0.0  # share of the border between parts, where no other scan shows the whole


@dataclass(frozen=True, kw_only=True)
class Regrouped:
    """Objects and instances; of those divided the larger half in the place of the whole, the smaller at the end."""

    objects: list[SceneObject]
    instances: list[Instance]
    embeddings: list[Embedding]  # of the instances
    halves: tuple[tuple[int, int], ...] = ()  # rows of instances that are one mask
    joined: tuple[JoinedMask, ...] = ()
    repairs: tuple[Repair, ...] = ()  # of objects
    unmasked: tuple[int, int] = (0, 0)  # how many of the last objects and instances no mask shows

    @property
    def divided(self) -> bool:
        """Whether a mask of either scan was. Its halves may show that one of the other scan holds two, as well."""
        return bool(self.halves) or any(r.divided for r in self.repairs)

    def masks(self, found: Sequence[Found], fresh: Mapping[int, SceneObject]) -> tuple[Repair, ...]:
        """The masks of this scan that were joined or divided. `fresh`: new objects by the rows of their instances."""
        names = {f.instance: self.objects[f.object].id for f in found} | {i: o.id for i, o in fresh.items()}
        by_id = {self.instances[i].id: name for i, name in reversed(names.items())}
        return (
            *(
                Repair(object=by_id[j.instances[0]], instances=j.instances, share=j.share, smooth=j.smooth)
                for j in self.joined
                if j.instances[0] in by_id
            ),
            *(
                Repair(object=names[i], instances=(self.instances[i].id,), divided=names[j])
                for i, j in self.halves
                if i in names and j in names
            ),
            *(
                Repair(object=names[i], instances=(x.id,), unmasked=len(x.points))
                for i, x in enumerate(self.instances)
                if i in names and self.is_unmasked(1, i)
            ),
            *(Repair(object=o.id, unmasked=len(o.points)) for o in self.unmasked_objects()),
        )

    def all_repairs(self, found: Sequence[Found], fresh: Mapping[int, SceneObject]) -> tuple[Repair, ...]:
        """Those of objects and of masks, each as sure as the least sure match that rests on it."""
        chance = {self.objects[f.object].id: f.score for f in found}
        return tuple(as_sure(r, chance) for r in (*self.repairs, *self.masks(found, fresh)))

    def masked(self, found: Sequence[Found]) -> list[Found]:
        """Those found of which a mask shows both the object and the instance."""
        return [f for f in found if not (self.is_unmasked(0, f.object) or self.is_unmasked(1, f.instance))]

    def rests_on_mended(self, f: Found) -> bool:
        """Whether a mask of the object or of the instance was divided, or is missing."""
        divided = {id_ for r in self.repairs if r.divided for id_ in (r.object, r.divided)}
        return (
            self.is_unmasked(0, f.object)
            or self.is_unmasked(1, f.instance)
            or self.objects[f.object].id in divided
            or any(f.instance in half for half in self.halves)
        )

    def is_unmasked(self, side: int, row: int) -> bool:
        """Whether no mask shows an object (side 0) or instance (1)."""
        return row >= len((self.objects, self.instances)[side]) - self.unmasked[side]

    def unmasked_objects(self) -> list[SceneObject]:
        """The objects that no mask of the scan before shows."""
        return self.objects[len(self.objects) - self.unmasked[0] :]


def as_sure_as_masks(identified: Identified, masks: Regrouped, config: SceneConfig) -> Identified:
    """What was found of masks that were divided or are missing is less sure; where surfaces were compared."""
    if not isinstance(config.matching, EvidenceMatcher):
        return identified
    found = (
        replace(f, score=mended_probability(f.score, config.motion)) if masks.rests_on_mended(f) else f
        for f in identified.found
    )
    return replace(identified, found=tuple(found))


def as_sure(repair: Repair, chance: Mapping[str, float]) -> Repair:
    """A mask that was divided or missing, with the least probability of a match of its objects. Others as they are.

    `chance`: of the matches of the scan, by object id.
    """
    if repair.divided is None and not repair.unmasked:
        return repair
    resting = [p for id_, p in chance.items() if id_ in (repair.object, repair.divided)]
    return replace(repair, share=min(resting, default=repair.share))
