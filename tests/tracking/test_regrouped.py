"""How sure what was mended of masks is said to be."""

import pytest
from factories import living_scene

from more2_jax.config import preset
from more2_jax.tracking.identify import Found, Identified
from more2_jax.tracking.regrouped import Regrouped, as_sure, as_sure_as_masks
from more2_jax.types import Instance, Repair

SCENE = living_scene()
FIRST, SECOND = (o.id for o in SCENE.objects[:2])


def test_what_was_divided_or_missing_is_as_sure_as_its_least_sure_match():
    chance = {FIRST: 0.9, SECOND: 0.6}
    assert as_sure(Repair(object=FIRST, divided=SECOND), chance).share == 0.6
    assert as_sure(Repair(object=FIRST, divided="object_077"), chance).share == 0.9  # the other half is new
    assert as_sure(Repair(object=SECOND, unmasked=70), chance).share == 0.6
    assert as_sure(Repair(object="object_077", divided="object_078"), chance).share == 1.0


def test_what_points_tell_is_not_touched():
    told = Repair(object=FIRST, instances=(1, 2), share=0.92), Repair(object=FIRST, dropped=40, share=0.5)
    assert tuple(as_sure(r, {FIRST: 0.7}) for r in told) == told


def test_repairs_of_objects_and_of_masks_rest_on_the_matches_of_the_scan():
    last = len(SCENE.objects) - 1
    masks = [Instance(id=n, points=SCENE.objects[0].points) for n in (4, 5)]
    whole = Regrouped(
        objects=list(SCENE.objects),
        instances=masks,
        embeddings=[SCENE.objects[0].embedding] * 2,
        repairs=(Repair(object=FIRST, divided=SECOND),),
        unmasked=(1, 0),  # the last object
    )
    found = [Found(object=0, instance=0, score=0.8), Found(object=last, instance=1, score=0.7)]
    divided, missing = whole.all_repairs(found, {})
    assert (divided.divided, divided.share) == (SECOND, 0.8)
    assert (missing.object, missing.share) == (SCENE.objects[last].id, 0.7)


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        ({}, False),
        ({"repairs": (Repair(object=FIRST, divided=SECOND),)}, True),
        ({"repairs": (Repair(object=SECOND, divided=FIRST),)}, True),
        ({"repairs": (Repair(object=FIRST, absorbed=(SECOND,)),)}, False),  # parts that were joined
        ({"halves": ((0, 1),)}, True),
        ({"halves": ((1, 2),)}, False),
        ({"unmasked": (0, 1)}, True),
        ({"unmasked": (len(SCENE.objects), 0)}, True),
    ],
)
def test_what_rests_on_masks_that_were_divided_or_are_missing_is_less_sure(changed, expected):
    whole = Regrouped(
        objects=list(SCENE.objects),
        instances=[Instance(id=4, points=SCENE.objects[0].points)],
        embeddings=[SCENE.objects[0].embedding],
        **changed,
    )
    told = Identified(found=(Found(object=0, instance=0, score=0.9),))
    for upright in (True, False):
        config = preset("robust", upright=upright)
        (found,) = as_sure_as_masks(told, whole, config).found
        assert (found.score < 0.85) is expected
        assert expected or found.score == 0.9
    assert as_sure_as_masks(told, whole, preset("paper")) is told
