"""Which pairs are worth aligning: by hand from the whole matrix of scores, in blocks, and by place in a building."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from more2_jax.config import EvidenceMatcher
from more2_jax.matching import proposals
from more2_jax.matching.proposals import (
    NEAR_M,
    ROOM_M,
    Signatures,
    extent_of,
    likeliest,
    proposed,
    signatures,
)
from more2_jax.types import Embedding, ObservedObject

WEIGHT = 0.5


def drawn(count, seed, spread_m=5.0):
    rng = np.random.default_rng(seed)
    inv = rng.normal(size=(count, 16))
    return Signatures(
        inv=inv / np.linalg.norm(inv, axis=1, keepdims=True),
        scale=rng.uniform(0.2, 2.0, count),
        center=rng.uniform(-spread_m, spread_m, (count, 3)),
    )


def observed(s):
    """Objects with these codes and places."""
    return [
        ObservedObject(
            points=center[None],
            embedding=Embedding(inv=inv, eqv=np.zeros((3, 1)), scale=scale, center=np.zeros(3)),
        )
        for inv, scale, center in zip(s.inv, s.scale, s.center, strict=True)
    ]


def scores(a, b):
    return a.inv @ b.inv.T - WEIGHT * np.abs(np.log(a.scale[:, None] / b.scale))


@pytest.mark.parametrize("block", [1, 4, 100])
@pytest.mark.parametrize("count", [0, 2, 50])
def test_every_object_and_instance_has_its_likeliest_partners_whatever_the_block(monkeypatch, block, count):
    monkeypatch.setattr(proposals, "ROWS_AT_ONCE", block)
    a, b = drawn(13, 0), drawn(9, 1)
    found = likeliest(a, b, count, WEIGHT)
    score = scores(a, b)
    ranks = np.stack([np.argsort(np.argsort(-score, axis=axis), axis=axis) for axis in (1, 0)], axis=-1)
    among = (ranks < (count or 50)).any(axis=-1)
    np.testing.assert_array_equal(found.pairs, np.argwhere(among))
    of_pair = ranks[among].astype(float)
    np.testing.assert_array_equal(found.rank, np.where(of_pair < (count or 50), of_pair, np.inf))
    np.testing.assert_allclose(found.likeness, (a.inv @ b.inv.T)[among], rtol=1e-12)


def test_of_equals_the_first_is_taken_in_any_block(monkeypatch):
    monkeypatch.setattr(proposals, "ROWS_AT_ONCE", 2)
    one = Signatures(inv=np.ones((6, 1)), scale=np.ones(6), center=np.zeros((6, 3)))
    found = likeliest(one, one, 1, WEIGHT)
    assert found.pairs.tolist() == [[0, i] for i in range(6)] + [[k, 0] for k in range(1, 6)]


def test_in_a_room_places_say_nothing():
    a, b = drawn(12, 2, ROOM_M / 2), drawn(12, 3, ROOM_M / 2)
    far = np.eye(4)
    far[0, 3] = 100.0
    matcher = EvidenceMatcher(candidates=3, size_weight=WEIGHT)
    here, there = (
        proposed(observed(a), observed(b), matcher, place, motion="upright") for place in (None, far)
    )
    np.testing.assert_array_equal(here.pairs, likeliest(a, b, 3, WEIGHT).pairs)
    np.testing.assert_array_equal(there.pairs, here.pairs)


def copies(rooms, pitch_m, seed):
    """The same five things in every room of a row, with codes that noise tells apart no more."""
    rng = np.random.default_rng(seed)
    things, count = drawn(5, 5, 2.0), 5 * rooms
    inv = np.tile(things.inv, (rooms, 1)) + 0.01 * rng.normal(size=(count, 16))
    center = np.tile(things.center, (rooms, 1))
    center[:, 0] += pitch_m * np.repeat(np.arange(rooms), 5)
    inv /= np.linalg.norm(inv, axis=1, keepdims=True)
    return Signatures(inv=inv, scale=np.tile(things.scale, rooms), center=center)


def test_among_the_copies_of_a_building_what_stands_there_is_proposed():
    """Of 40 copies of a thing codes alone would propose any; its own room's is found where frames are shared."""
    a, b = copies(40, 12.0, 4), copies(40, 12.0, 8)
    same = np.repeat(np.arange(200)[:, None], 2, axis=1)
    matcher = EvidenceMatcher(candidates=4, size_weight=WEIGHT)

    def recall(found):
        return np.isin(same @ [1000, 1], found.pairs @ [1000, 1]).mean()

    assert recall(likeliest(a, b, 4, WEIGHT)) < 0.5
    moved = np.eye(4)
    moved[:3, 3] = [7.0, -300.0, 2.0]
    elsewhere = Signatures(inv=b.inv, scale=b.scale, center=b.center - moved[:3, 3])
    assert recall(proposed(observed(a), observed(b), matcher, motion="upright")) == 1.0
    assert recall(proposed(observed(a), observed(elsewhere), matcher, moved, motion="upright")) == 1.0
    # As given the two frames lie far apart: as many partners are proposed, by codes and sizes.
    lost = proposed(observed(a), observed(elsewhere), matcher, motion="upright")
    assert (np.bincount(lost.pairs[:, 0]) >= 4).all()


def test_what_was_carried_through_a_building_is_proposed():
    a, b = drawn(60, 6, 30.0), drawn(60, 7, 30.0)
    b = Signatures(inv=a.inv[::-1], scale=a.scale[::-1], center=b.center)
    far = np.linalg.norm(a.center - b.center[::-1], axis=1) > NEAR_M
    assert far.sum() > 30
    found = proposed(
        observed(a), observed(b), EvidenceMatcher(candidates=4, size_weight=WEIGHT), motion="upright"
    )
    assert {(k, 59 - k) for k in range(60)} <= {tuple(p) for p in found.pairs.tolist()}


def turned(points, R):
    return points @ R.as_matrix().T + [3.0, -1.0, 0.5]


@pytest.mark.parametrize("size", [[1.2, 0.6, 0.7], [0.3, 0.3, 1.6], [2.0, 0.9, 0.0], [0.0, 0.0, 0.0]])
def test_extents_do_not_change_as_things_may_turn(size):
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (500, 3)) * size
    about_z, any_way = Rotation.from_euler("z", 1.1), Rotation.random(random_state=2)
    for motion, R in (("upright", about_z), ("free", about_z), ("free", any_way)):
        there = extent_of(turned(points, R), motion)
        np.testing.assert_allclose(there, extent_of(points, motion), atol=1e-3)
        assert np.isfinite(there).all()
    lying = extent_of(turned(points, Rotation.from_euler("x", 90, degrees=True)), "upright")
    assert np.allclose(lying, extent_of(points, "upright"), atol=0.05) == (size == [0.0, 0.0, 0.0])


@pytest.mark.parametrize("motion", ["upright", "free"])
def test_what_codes_do_not_tell_extents_do(motion):
    """Among many things of all shapes, every code like every other."""
    rng = np.random.default_rng(3)
    things = [
        ObservedObject(
            points=rng.uniform(-0.5, 0.5, (300, 3)) * rng.uniform(0.1, 2.0, 3),
            embedding=Embedding(
                inv=rng.normal(size=16), eqv=np.zeros((3, 1)), scale=np.ones(()), center=np.zeros(3)
            ),
        )
        for _ in range(40)
    ]
    again = [
        dataclasses.replace(
            o,
            points=turned(o.points, Rotation.from_euler("z", rng.uniform(0, 6))),
            embedding=dataclasses.replace(o.embedding, inv=rng.normal(size=16)),
        )
        for o in things
    ]
    true = {(k, k) for k in range(40)}

    def told(found):
        return len(true & set(map(tuple, found.pairs.tolist())))

    plain = likeliest(signatures(things), signatures(again), 8, WEIGHT)
    by_extent = proposed(things, again, EvidenceMatcher(candidates=8, size_weight=WEIGHT), motion=motion)
    assert told(plain) < 24 and told(by_extent) > 36
