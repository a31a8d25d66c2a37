"""Fitting how sure a pair is one object."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from known_scenes import known_scene
from scipy.special import expit

from eval.calibration import (
    ScanPair,
    changes_f1,
    counts,
    fitted,
    labels,
    left_out,
    log_loss,
    main,
    most,
    reliability_curves,
    reliability_table,
    scan_pairs,
    thinned,
)
from eval.scores.reliability import Bin, reliability
from more2_jax.config import preset
from more2_jax.matching.calibration import FREE, UNASKED, UPRIGHT, Calibration
from more2_jax.matching.candidates import align_candidates, odds_of
from more2_jax.network.embedding_batch import embed
from more2_jax.types import ObservedObject

PLANTED = Calibration(
    intercept=2.0, apart_less=-6.0, apart_more=0.0, contradicted=-3.0, likeness=4.0, off_less=-5.0
)


def drawn(room: str, count: int, seed: int, c: Calibration = PLANTED) -> ScanPair:
    """Pairs whose truth was drawn with the probability that `c` gives them."""
    rng = np.random.default_rng(seed)
    names = [k for k in dataclasses.asdict(c) if k not in ("intercept", "raised")]
    known = {k: rng.uniform(size=count) for k in names}
    told = c.intercept + sum(getattr(c, k) * v for k, v in known.items())
    one = rng.random(count) < expit(told)
    among = np.ones((1, count), bool)
    sure, color = np.ones(count, bool), np.zeros(count)
    return ScanPair(room=room, among=among, known=known, color=color, sure=sure, one=one[None])


def test_weights_that_drew_the_truth_are_found_and_evidence_never_speaks_the_wrong_way():
    found = fitted(
        [drawn("a", 20_000, 0), drawn("b", 20_000, 1)], dataclasses.replace(PLANTED, apart_more=-1.0)
    )
    for name, value in dataclasses.asdict(PLANTED).items():
        assert getattr(found, name) == pytest.approx(value, abs=0.35), name
    wrong = drawn("c", 20_000, 2, dataclasses.replace(PLANTED, apart_less=6.0))
    assert fitted([wrong], PLANTED).apart_less == 0.0


def test_only_evidence_that_the_calibration_asks_is_fitted():
    assert fitted([drawn("a", 500, 0)], UNASKED).off_less == 0.0
    assert fitted([drawn("a", 500, 0)], FREE).contradicted == 0.0


def test_a_pair_the_prior_knows_nothing_of_teaches_nothing_and_is_weighed_without_it():
    pair, other = drawn("a", 2000, 0), drawn("b", 100, 1)
    unsure = dataclasses.replace(other, sure=np.zeros(100, bool))
    assert fitted([pair, unsure], PLANTED) == fitted([pair], PLANTED)
    np.testing.assert_array_equal(unsure.odds(FREE), unsure.odds(UNASKED))
    assert (other.odds(FREE) != other.odds(UNASKED)).all()


def test_a_rooms_weights_are_fitted_without_it():
    pairs = [drawn(room, 2000, k) for k, room in enumerate("aab")]
    by_room = left_out(pairs, PLANTED)
    assert by_room == {"a": fitted(pairs[2:], PLANTED), "b": fitted(pairs[:2], PLANTED)}


def test_colors_are_evidence_with_a_weight_of_their_own():
    """Colors that decided with odds of 3 either way: the other weights are found beside them."""
    rng = np.random.default_rng(0)
    pair = drawn("a", 40_000, 0)
    color = rng.choice([-3.0, 3.0], 40_000)
    one = rng.random(40_000) < expit(pair.odds(PLANTED)[0] + color)
    found = fitted([dataclasses.replace(pair, color=color, one=one[None])], PLANTED)
    assert found.apart_less == pytest.approx(PLANTED.apart_less, abs=0.35)
    assert found.intercept == pytest.approx(PLANTED.intercept, abs=0.35)


def test_log_loss_by_definition_and_where_odds_are_large():
    odds, one = np.array([0.3, -2.0, 800.0]), np.array([True, False, False])
    assert log_loss(odds[:2], one[:2]) == pytest.approx(-np.log(expit(0.3) * (1 - expit(-2.0))) / 2)
    assert log_loss(odds[2:], one[2:]) == 800.0


def test_copies_are_one_object_and_what_a_scan_lacks_is_nothing():
    scene = known_scene(copies=("a", "b", "b"), scans=2)
    first, later = ([i.id for i in s.instances] for s in scene.scans)
    found = labels(scene, 1, first, later)
    assert found.tolist() == [[True, False, False], [False, True, True], [False, True, True]]
    gone = dataclasses.replace(scene, objects=scene.objects[1:])
    assert not labels(gone, 1, first, later)[0].any()


def test_recall_precision_and_f1_of_assignments_by_hand():
    one = np.array([[True, False, False], [False, True, True], [False, True, True], [False, False, False]])
    odds = np.array([[2.0, 1.0, -1.0], [-1, 3, -1], [-1, -1, -1], [-1, -1, 1]])
    assert most(one) == 3
    recall, precision, f1 = counts([(odds, one), (odds, one)])
    assert (recall, precision, f1) == pytest.approx((2 / 3, 2 / 3, 2 / 3))


def test_f1_of_what_came_or_went_by_hand():
    one = np.array([[True, False], [False, False], [False, False]])  # two objects went, one instance came
    odds = np.array([[2.0, -1], [-1, 1], [-1, -1]])  # one is said to have gone
    assert changes_f1([(odds, one)]) == pytest.approx(2 * 1 / (1 + 3))
    nothing = np.eye(2, dtype=bool)
    assert changes_f1([(np.where(nothing, 1.0, -1.0), nothing)]) == 1
    assert changes_f1([(np.full((2, 2), -1.0), nothing)]) == 0
    assert changes_f1([(odds, one), (np.full((2, 2), -1.0), nothing)]) == pytest.approx(0.25)


def test_thinned_rooms_are_parts_of_the_rooms_and_not_all_the_same():
    pair = drawn("a", 30, 0)
    parts = thinned([pair.odds(PLANTED)], [pair], 0.25)
    assert len({o.shape for o, _ in parts}) > 1
    for odds, one in parts:
        assert odds.shape == one.shape
        assert np.isin(odds, pair.odds(PLANTED)).all()


@pytest.mark.slow
def test_pairs_are_weighed_as_the_package_weighs_them(tiny_prior):
    scene = known_scene(copies=("a", "b", "c"), scans=3)
    config = preset("robust", upright=True)
    search = dataclasses.replace(config.matching.search, steps=2, dense=256, cells=8, turns=4)
    matcher = dataclasses.replace(config.matching, search=search)
    config = dataclasses.replace(config, matching=matcher)
    found = scan_pairs("room", scene, tiny_prior, config)
    assert len(found) == 2
    sides = [
        [ObservedObject(points=i.points, embedding=e) for i, e in zip(scan.instances, codes, strict=True)]
        for scan in scene.scans
        for codes in [embed(tiny_prior, [i.points for i in scan.instances])]
    ]
    for b, pair in enumerate(found, 1):
        aligned = align_candidates(tiny_prior, sides[0], sides[b], matcher, "upright")
        odds = odds_of(aligned, search, "upright")
        np.testing.assert_allclose(pair.odds(UPRIGHT), odds.matrix(), rtol=1e-3, atol=1e-3)


def test_curves_are_of_every_candidate_by_weights_that_did_not_see_its_room():
    pairs = [drawn(room, 3000, k) for k, room in enumerate("abc")]
    apart = dataclasses.replace(PLANTED, intercept=PLANTED.intercept + 1.5)
    curves = reliability_curves(pairs, {"P": apart})
    assert list(curves) == ["P, shipped", "P, fitted, rooms left out in turn"]
    shipped, fitted_ = curves.values()
    assert sum(b.count for b in shipped) == sum(b.count for b in fitted_) == 9000
    assert all(b.said > b.true for b in shipped if b.count > 300)  # odds 1.5 too high
    assert all(abs(b.said - b.true) < 0.06 for b in fitted_ if b.count > 300)
    assert list(reliability_curves(pairs[:1], {"P": apart})) == ["P, shipped"]  # one room leaves no other
    raised = dataclasses.replace(apart, intercept=apart.intercept + 2, raised=2.0)  # raised odds say the same
    for one, other in zip(
        reliability_curves(pairs[:1], {"P": raised})["P, shipped"], curves_of(pairs[0], apart), strict=True
    ):
        assert one.count == other.count and one.said == pytest.approx(other.said)


def curves_of(pair: ScanPair, c: Calibration):
    return reliability(pair.odds(c)[0], pair.one[0])


def test_a_line_a_bin():
    bins = [
        Bin(low=0.0, high=0.1, said=0.05, true=0.25, count=8),
        Bin(low=0.9, high=1.0, said=0.95, true=1.0, count=2),
    ]
    table = reliability_table("name", bins)
    assert [list(c.cells) for c in table.columns] == [
        ["0.0 to 0.1", "0.9 to 1.0"],
        ["0.050", "0.950"],
        ["0.250", "1.000"],
        ["8", "2"],
    ]


@pytest.mark.parametrize("share", [-0.1, 1.0])
def test_a_share_that_leaves_nothing_is_refused(tmp_path, share):
    with pytest.raises(ValueError, match="needed a share"):
        main((tmp_path,), taken_away=share)


def test_rooms_of_two_kinds_are_refused(tmp_path, monkeypatch):
    kinds = iter((True, False))
    monkeypatch.setattr("eval.calibration.flyingshape", lambda _: type("Rooms", (), {"upright": next(kinds)}))
    with pytest.raises(ValueError, match="needed one kind"):
        main((tmp_path, tmp_path))
