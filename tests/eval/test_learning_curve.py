"""Learning curves: a known line gives its slope and its crossing; what does not rise never arrives."""

import json

import numpy as np
import pytest

from eval.learning_curve import TARGETS, draw, main, read_curves, table

CLOUDS = (1000, 2000, 8000)


def results(rise: float, start: float = 0.1) -> list[dict]:
    """Scores on a line over log2, of clouds of three views."""
    return [
        {"3 views": {name: {"value": start + rise * np.log2(n / 1000)} for name in TARGETS}} for n in CLOUDS
    ]


def test_a_line_gives_its_slope_and_where_it_meets_the_target():
    curves = read_curves(CLOUDS, results(0.05))
    assert [c.name for c in curves] == list(TARGETS) and {c.views for c in curves} == {"3 views"}
    for curve in curves:
        np.testing.assert_allclose(curve.gain, 0.05, rtol=1e-9)
        np.testing.assert_allclose(curve.needed, 1000 * 2 ** ((curve.target - 0.1) / 0.05), rtol=1e-6)


@pytest.mark.parametrize("rise", [0.0, -0.02])
def test_what_does_not_rise_never_arrives(rise):
    curves = read_curves(CLOUDS, results(rise))
    assert all(c.needed is None for c in curves)


def test_a_score_above_its_target_is_said_to_have_reached_it():
    shown = table(read_curves(CLOUDS, results(0.01, start=0.9)))
    assert "reached" in list(shown.columns[-1].cells)


@pytest.mark.parametrize(
    ("clouds", "count"), [((1000,), 1), ((1000, 2000), 3), ((5, 5, 5), 3), ((0, 1, 2), 3)]
)
def test_unequal_or_single_scores_are_refused(clouds, count):
    with pytest.raises(ValueError, match="needed as many"):
        read_curves(clouds, results(0.1)[:count])


def test_files_are_written_and_a_missing_one_is_named(tmp_path):
    pytest.importorskip("matplotlib")
    for n, result in zip(CLOUDS, results(0.05), strict=True):
        (tmp_path / str(n)).mkdir()
        (tmp_path / str(n) / "results.json").write_text(json.dumps(result))
    main(CLOUDS, tuple(tmp_path / str(n) for n in CLOUDS), tmp_path / "out")
    assert {p.name for p in (tmp_path / "out").iterdir()} == {"curve.json", "curve.png", "curve.svg"}
    assert len(draw(tmp_path / "again", read_curves(CLOUDS, results(0.05)))) == 2
    with pytest.raises(ValueError, match=r"nowhere: no results\.json"):
        main(CLOUDS, (tmp_path / "nowhere",), tmp_path / "out")
