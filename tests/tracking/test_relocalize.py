"""Nothing is searched twice: matching aligns every candidate pair once, registration refines what was found."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from small_scenes import CONFIG, scan

from more2_jax.config import preset
from more2_jax.matching import candidates
from more2_jax.network.embedding_batch import embed
from more2_jax.registration import search, surface
from more2_jax.scene import add_scan, compared_objects, start_scene
from more2_jax.tracking import relocalize
from more2_jax.tracking.identify import identify
from more2_jax.types import Embedding, Frame, ObservedObject

pytestmark = [pytest.mark.optimized, pytest.mark.no_cover]

FIRST = {0: (0.0, 0.0), 1: (0.3, 3.0), 2: (0.0, 6.0)}
THEN = {0: (0.0, 0.0), 1: (1.2, 4.0), 2: (0.0, 6.0)}
ONE_PARTNER = dataclasses.replace(CONFIG, matching=dataclasses.replace(CONFIG.matching, candidates=1))


@pytest.fixture
def searched(monkeypatch):
    """The pairs of every search: where source and target lie, and what asked for them."""
    asked = []

    def watch(module, name):
        original = module.search_poses

        def search_poses(source, target, stayed, *settings):
            asked.append((name, len(stayed.wxyz_xyz)))
            return original(source, target, stayed, *settings)

        monkeypatch.setattr(module, "search_poses", search_poses)

    watch(candidates, "matching")
    watch(surface, "registration")
    return asked


@pytest.fixture
def refined(monkeypatch):
    """How many pairs each call of registration refined."""
    counts = []
    original = surface.refine_poses

    def refine_poses(prior, objects, poses, *rest):
        counts.append(poses.wxyz_xyz.shape[:2])
        return original(prior, objects, poses, *rest)

    monkeypatch.setattr(surface, "refine_poses", refine_poses)
    return counts


@pytest.fixture(scope="module")
def first(tiny_prior):
    return start_scene(tiny_prior, scan("a", FIRST), CONFIG)


@pytest.mark.parametrize("config", [CONFIG, ONE_PARTNER], ids=["all pairs", "one partner each"])
def test_every_candidate_pair_is_searched_once_and_registration_searches_nothing(
    tiny_prior, first, searched, refined, config
):
    second = scan("b", THEN)
    codes = embed(tiny_prior, [i.points for i in second.instances])
    old, new = compared_objects(first, second.instances, codes, second, config)
    known = [o for o, _ in old]
    worth = candidates.proposed(known, new, config.matching, motion=config.motion)
    made = add_scan(tiny_prior, first, second, config)
    assert searched == [("matching", len(worth.pairs))]
    found = sum(len(o.observations) == 2 for o in made.objects)
    assert found > 0 and refined == [(found, config.matching.search.keep)]


def test_a_scan_whose_frame_settles_elsewhere_is_refined_again_but_not_searched(
    tiny_prior, first, searched, refined, monkeypatch
):
    T = np.eye(4)
    T[:3, 3] = [0.0, 0.0, 0.01]
    monkeypatch.setattr(relocalize, "settled_frame", lambda *_: Frame(T_scene_scan=T))
    monkeypatch.setattr(relocalize, "standing", lambda known, new, pairs, *_: np.arange(len(pairs)) < 1)
    made = add_scan(tiny_prior, first, scan("b", THEN), CONFIG)
    np.testing.assert_array_equal(made.scans[1].frame.T_scene_scan, T)
    assert [name for name, _ in searched] == ["matching"]
    # All in either frame; and one again, which stands where it stood, though it lies a centimeter off.
    assert refined == [(pairs, CONFIG.matching.search.keep) for pairs in (3, 3, 1)]
    held = [np.allclose(o.observations[-1].T_ref_scan, T, atol=1e-4) for o in made.objects]
    assert sum(held) == 1


def test_a_frame_is_settled_by_aligned_poses_not_by_those_taken_to_have_stayed(
    tiny_prior, first, monkeypatch
):
    original, settled, aligned_m = relocalize.register, [], 0.5

    def register(*args):
        result = original(*args)
        lifted = result.aligned.wxyz_xyz + aligned_m * np.eye(7)[6]
        return dataclasses.replace(result, aligned=type(result.aligned)(lifted))

    def settled_frame(frame, places, *_):
        settled.append(places)
        return frame

    monkeypatch.setattr(relocalize, "settled_frame", settled_frame)
    heights = []
    for how in (original, register):
        monkeypatch.setattr(relocalize, "register", how)
        made = add_scan(tiny_prior, first, scan("b", THEN), CONFIG)
        heights.append([o.observations[-1].T_ref_scan[2, 3] for o in made.objects])
    np.testing.assert_array_equal(*heights)
    plain, lifted = (np.stack(places)[:, 2, 3] for places in settled)
    np.testing.assert_allclose(lifted - plain, aligned_m, atol=1e-5)


def test_pairs_registered_one_by_one_have_the_poses_they_have_together(tiny_prior, first, refined):
    second = scan("b", THEN)
    whole = add_scan(tiny_prior, first, second, CONFIG)
    assert refined == [(3, CONFIG.matching.search.keep)]
    refined.clear()
    few = dataclasses.replace(CONFIG, memory_mb=relocalize.PAIR_MB)
    apart = add_scan(tiny_prior, first, second, few)
    assert refined == [(1, CONFIG.matching.search.keep)] * 3
    for o, p in zip(whole.objects, apart.objects, strict=True):
        np.testing.assert_array_equal(o.observations[-1].T_ref_scan, p.observations[-1].T_ref_scan)
        assert o.observations[-1].sigma_m == p.observations[-1].sigma_m


def test_another_frame_changes_what_staying_means_and_nothing_else(tiny_prior, first):
    second = scan("b", THEN)
    codes = embed(tiny_prior, [i.points for i in second.instances])
    old, new = compared_objects(first, second.instances, codes, second, CONFIG)
    known = [o for o, _ in old]
    identified = identify(tiny_prior, known, new, CONFIG)
    pairs = relocalize.pairs_found(identified, known, new)
    T = np.eye(4)
    T[:3, 3] = [0.1, -0.2, 0.3]
    moved = relocalize.with_frame(pairs, T)
    np.testing.assert_allclose(moved.to_world(moved.stayed), np.tile(T, (len(pairs), 1, 1)), atol=1e-6)
    np.testing.assert_array_equal(moved.candidates.wxyz_xyz, pairs.candidates.wxyz_xyz)


def test_where_matching_found_no_poses_registration_searches_once(tiny_prior, first, searched, refined):
    config = dataclasses.replace(CONFIG, matching=preset("paper").matching)
    add_scan(tiny_prior, first, scan("b", THEN), config)
    assert searched == [("registration", 4)]  # three pairs, and one that fills up
    assert len(refined) == 1


def test_a_cloud_is_prepared_once_whatever_number_of_pairs_it_is_part_of(tiny_prior, first, monkeypatch):
    prepared = []
    original = search._alignable

    def watched(batch, **settings):
        prepared.extend(np.asarray(points).tobytes() for points in batch.cloud.points)
        return original(batch, **settings)

    monkeypatch.setattr(search, "_alignable", watched)
    add_scan(tiny_prior, first, scan("b", THEN), CONFIG)
    most = len(first.objects) + len(THEN)  # clouds of both scans that are alike to the bit are one
    assert len(prepared) == len(set(prepared)) and max(len(first.objects), len(THEN)) <= len(prepared) <= most


def test_pairs_that_may_stand_are_asked_about_some_at_a_time(monkeypatch):
    asked = []

    def standing(known, new, pairs, T, *_):
        asked.append(len(pairs))
        np.testing.assert_array_equal(T[:, 0, 3], [0.01 * (k + 1) for k, _ in pairs])
        return np.array([k != 1 for k, _ in pairs])

    monkeypatch.setattr(relocalize, "standing", standing)
    monkeypatch.setattr(relocalize, "PAIRS_AT_ONCE", 2)
    found = [relocalize.Found(object=k, instance=k, score=1.0) for k in range(4)]
    T = np.array([np.eye(4)] * 4)
    T[:, 0, 3] = [0.01, 0.02, 0.03, 0.0]  # the last is where nothing moved
    code = object.__new__(Embedding)
    corners = np.array([[-0.1] * 3, [0.1] * 3])
    near = [ObservedObject(points=corners + k, embedding=code) for k in range(4)]
    rows = relocalize.standing_in_place(near, near, found, T, Frame(), relocalize.NO_ROOMS, CONFIG)
    assert rows.tolist() == [0, 2] and asked == [2, 1]
    still = relocalize.standing_in_place(near, near, found, T[[3] * 4], Frame(), relocalize.NO_ROOMS, CONFIG)
    assert still.tolist() == []
