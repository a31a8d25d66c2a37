"""Variants of the settings, and what their figures count."""

import dataclasses

import numpy as np
import pytest

import eval.variants
from eval.variants import changed, row_of
from more2_jax.config import preset

ROBUST = preset("robust", upright=True)


def test_a_variant_differs_in_what_it_names_alone():
    new = changed(ROBUST, "registration.choose_among=5,matching.search.keep=9")
    assert (new.registration.choose_among, new.matching.search.keep) == (5, 9)
    back = changed(
        new, f"registration.choose_among={ROBUST.registration.choose_among},matching.search.keep=6"
    )
    assert back == ROBUST == changed(ROBUST, "")


@pytest.mark.parametrize("wrong", ["registration.chose=5", "nothing.of=1", "registration.choose_among=many"])
def test_what_is_no_setting_is_refused(wrong):
    with pytest.raises(ValueError):
        changed(ROBUST, wrong)


def test_figures_count_pairs_and_a_failure_is_neither_near_nor_right(monkeypatch):
    """Four pairs: right and near, right and turned by 7°, right but 20 cm off, not matched; six links were made."""

    @dataclasses.dataclass
    class FakeTrack:
        instance: dict

    def pair(matched, turn, shift):
        return {"m.strict": matched, "re_deg.strict": turn, "te_m.strict": shift, "told.strict": matched}

    pairs = [pair(1.0, 1.0, 0.01), pair(1.0, 7.0, 0.02), pair(1.0, 1.0, 0.2), pair(0.0, None, None)]
    monkeypatch.setattr(eval.variants, "living_scenes", lambda *_: iter([object()]))
    monkeypatch.setattr(
        eval.variants, "tracks_of", lambda _: [FakeTrack({0: 1, 1: 1})] * 6 + [FakeTrack({1: 9})]
    )
    monkeypatch.setattr(eval.variants, "with_mended_masks", lambda scene, tracks: (scene, tracks))
    monkeypatch.setattr(eval.variants, "score_tracks", lambda *_, **__: pairs)
    monkeypatch.setattr(eval.variants, "changes_f1", lambda *_: 0.5)
    count, right, wrong, below_5, below_15, registered, f1, told, seconds = row_of(
        [object()], None, ROBUST, 5.0
    )
    assert (count, right, wrong, below_5, below_15) == ("4", "3", "3", "2", "3")
    assert (registered, f1, told) == ("50.0 %", "50.0 %", "75.0 %")
    assert np.isfinite(float(seconds))
