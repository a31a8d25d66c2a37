"""Color tells identical copies apart where both scans have it, and changes nothing where one has none."""

from __future__ import annotations

import dataclasses
import json

import jsonschema
import numpy as np
import pytest
from factories import turn_z
from places import ROOT
from small_scenes import CONFIG

from more2_jax.geometry.transform import transform
from more2_jax.matching.color import DIFFERENT, ODD, SAME, color_evidence, color_of, pooled
from more2_jax.network.embedding_batch import embed
from more2_jax.scans.read_scan import read_scan
from more2_jax.scene import add_scan, start_scene
from more2_jax.storage.scene_folder import load_scene, save_scene
from more2_jax.tracking.identify import identify
from more2_jax.tracking.objects import new_object, seen_again
from more2_jax.tracking.relocalize import known_object
from more2_jax.types import Color, Instance, ObservedObject, Scan

pytestmark = pytest.mark.optimized  # scenes run for longer than their programs compile

RED, BLUE, GRAY = (190, 60, 50), (60, 80, 170), (128, 128, 128)
HERE, THERE = 0.0, 3.0


def shape() -> np.ndarray:
    """A box with a fin on it; meters."""
    rng = np.random.default_rng(0)
    box = rng.uniform(-0.5, 0.5, (500, 3))
    box[np.arange(500), rng.integers(0, 3, 500)] = rng.choice([-0.5, 0.5], 500)
    fin = rng.uniform(0, 1, (140, 3)) * [0.1, 0.5, 0.9] + [0.35, 0, 0.5]
    return np.concatenate([box, fin]) * [0.8, 0.4, 0.5]


def painted(rgb: tuple[int, int, int] | None, seed: int = 0, count: int = 640) -> np.ndarray | None:
    """Colors about one, as a camera sees them."""
    noise = np.random.default_rng(seed).normal(0, 8, (count, 3))
    return None if rgb is None else np.clip(rgb + noise, 0, 255).astype(np.uint8)


def twins(paints, at=(HERE, THERE), brightness: float = 1.0) -> Scan:
    """Copies of one shape, a color and a place along x each; ids are 1, 2, ..."""
    instances = []
    for k, (paint, x) in enumerate(zip(paints, at, strict=True)):
        rgb = painted(paint, k)
        rgb = None if rgb is None else (rgb * brightness).astype(np.uint8)
        instances.append(Instance(id=k + 1, points=shape() + [x, 0, 0], colors=rgb))
    return Scan(name="made", source="made", instances=tuple(instances))


def identified(prior, first: Scan, second: Scan):
    """Who is who in the second scan."""
    codes = [embed(prior, [i.points for i in s.instances]) for s in (first, second)]
    objects = [new_object(k, 0, i, e) for k, (i, e) in enumerate(zip(first.instances, codes[0], strict=True))]
    new = [
        ObservedObject(points=i.points, embedding=e, color=color_of(i.colors))
        for i, e in zip(second.instances, codes[1], strict=True)
    ]
    return identify(prior, [known_object(o, None, CONFIG)[0] for o in objects], new, CONFIG)


def partners(result) -> list[tuple[int, int, bool]]:
    return [(f.object, f.instance, f.interchangeable) for f in result.found]


@pytest.mark.parametrize("brightness", [pytest.param(1.0, marks=pytest.mark.slow), 0.8])
def test_copies_that_swap_places_are_told_by_their_color(tiny_prior, brightness):
    swapped = twins((BLUE, RED), brightness=brightness)
    assert partners(identified(tiny_prior, twins((RED, BLUE)), swapped)) == [(0, 1, False), (1, 0, False)]
    without = identified(tiny_prior, twins((None, None)), swapped)
    assert partners(without) == [(0, 0, True), (1, 1, True)]  # as if they had stayed


def test_a_swap_is_told_as_two_motions_also_to_a_scene_that_was_saved(tiny_prior, tmp_path):
    first, swapped = twins((RED, BLUE)), twins((BLUE, RED))
    save_scene(start_scene(tiny_prior, first, CONFIG), tmp_path / "scene", CONFIG)
    content = json.loads((tmp_path / "scene/scene.json").read_text())
    schema = json.loads((ROOT / "more2_jax/assets/scene.schema.json").read_text())
    jsonschema.validate(content, schema)
    scene, config = load_scene(tmp_path / "scene")
    assert scene.objects[0].color.points == content["objects"][0]["color"]["points"] == 640
    np.testing.assert_array_equal(scene.objects[0].color.lab, color_of(first.instances[0].colors).lab)
    added = add_scan(tiny_prior, scene, swapped, config)
    assert added.changes[0].moved == ("object_000", "object_001") and not added.changes[0].static
    assert not any(o.observations[1].interchangeable for o in added.objects)
    for o in content["objects"]:
        del o["color"]  # as written before colors were
    (tmp_path / "scene/scene.json").write_text(json.dumps(content))
    old, _ = load_scene(tmp_path / "scene")
    assert [o.color for o in old.objects] == [None, None]
    added = add_scan(tiny_prior, old, swapped, config)
    assert added.changes[0].static == ("object_000", "object_001")
    assert all(o.color is not None for o in added.objects)  # of the new scan alone


@pytest.mark.parametrize("paint", [RED, GRAY])
def test_copies_of_one_color_stay_as_interchangeable_as_without(tiny_prior, paint):
    found = identified(tiny_prior, twins((paint, paint)), twins((paint, paint)))
    assert partners(found) == [(0, 0, True), (1, 1, True)]


def test_color_in_one_scan_alone_changes_no_bit(tiny_prior):
    plain, colored = twins((None, None)), twins((RED, BLUE))
    results = [identified(tiny_prior, *s) for s in ((plain, plain), (plain, colored), (colored, plain))]
    assert results[0].found == results[1].found == results[2].found
    assert results[0].gone == results[1].gone and results[0].new == results[2].new


def test_an_object_gains_the_colors_of_accumulated_observations(tiny_prior):
    first, second = twins((RED, RED)).instances
    o = new_object(0, 0, first, embed(tiny_prior, [first.points])[0])
    again = dataclasses.replace(o.observations[0], scan=1)
    both = seen_again(o, second, again)
    assert both.color.points == 1280
    np.testing.assert_allclose(
        both.color.lab, color_of(np.concatenate([first.colors, second.colors])).lab, rtol=1e-12
    )
    known, _ = known_object(both, None, CONFIG)
    assert known.color is both.color
    assert transform(known, turn_z(1.0, np.zeros(3), np.ones(3))).color is both.color
    assert seen_again(o, second, dataclasses.replace(again, accumulated=False)).color is o.color
    assert seen_again(o, dataclasses.replace(second, colors=None), again).color.points == 640


def test_both_names_of_an_npzs_colors_and_those_of_a_ply_reach_the_instance(tmp_path):
    arrays = {"points": shape(), "instance": np.ones(640, np.int32)}
    for name in ("color", "colors"):
        np.savez(tmp_path / f"{name}.npz", **arrays, **{name: painted(RED)})
        np.testing.assert_array_equal(read_scan(tmp_path / f"{name}.npz").instances[0].colors, painted(RED))


# --- the record and its likelihood --------------------------------------------------------------------------


def test_the_color_of_a_union_is_the_pooled_colors():
    clouds = [painted(p, k, n) for k, (p, n) in enumerate([(RED, 1), (BLUE, 300), (GRAY, 77)])]
    whole = color_of(np.concatenate(clouds))
    parts = [color_of(c) for c in clouds]
    for order in (parts, parts[::-1], [pooled(*parts[:2]), None, parts[2]]):
        both = pooled(*order)
        assert both.points == whole.points == 378
        np.testing.assert_allclose(both.lab, whole.lab, rtol=1e-12)
    assert pooled() is pooled(None, None) is color_of(None) is color_of(np.zeros((0, 3), np.uint8)) is None


def test_points_in_another_order_are_of_the_same_color():
    rgb = painted(RED)
    shuffled = np.random.default_rng(1).permutation(rgb)
    np.testing.assert_allclose(color_of(rgb).lab, color_of(shuffled).lab, rtol=1e-12)


@pytest.mark.parametrize(
    ("rgb", "lab"),  # CIE L*a*b* of sRGB's primaries, D65
    [((255, 255, 255), (100, 0, 0)), ((0, 0, 0), (0, 0, 0)), ((255, 0, 0), (53.24, 80.09, 67.2))],
)
@pytest.mark.parametrize("dtype", [np.uint8, np.int64])
def test_one_point_has_its_own_color(rgb, lab, dtype):
    color = color_of(np.array([rgb], dtype))
    assert color.points == 1
    np.testing.assert_allclose(color.lab, lab, atol=0.02)


def evidence(old, new):
    """Of all pairs, (n, m)."""
    pairs = np.array(list(np.ndindex(len(old), len(new))))
    return color_evidence(old, new, pairs).reshape(len(old), len(new))


def lab(*rows) -> list[Color | None]:
    return [None if row is None else Color(points=1, lab=np.array(row, float)) for row in rows]


def test_evidence_is_bounded_symmetric_and_falls_with_the_difference():
    rng = np.random.default_rng(0)
    old, new = (lab(*rng.uniform([0, -100, -100], 100, (n, 3))) for n in (30, 20))
    ratio = evidence(old, new)
    most = np.log((1 - ODD) * np.prod(DIFFERENT / SAME) + ODD)
    assert ratio.shape == (30, 20) and (ratio >= np.log(ODD)).all() and (ratio <= most).all()
    np.testing.assert_array_equal(evidence(new, old), ratio.T)
    falling = [evidence(lab((50, 0, 0)), lab((50, x, 0)))[0, 0] for x in range(0, 200, 5)]
    assert falling[0] == pytest.approx(most) and falling[-1] == pytest.approx(np.log(ODD))
    assert (np.diff(falling) <= 0).all()


def test_evidence_is_the_ratio_of_the_densities_it_names():
    from scipy.stats import norm

    old, new = lab((20, 40, 10), (80, -60, -50)), lab((30, 35, 20), (90, -10, 60))
    for n, m in np.ndindex(2, 2):  # rooms of many colors: the spread is `DIFFERENT`
        d = old[n].lab - new[m].lab
        same, different = norm.pdf(d, scale=SAME).prod(), norm.pdf(d, scale=DIFFERENT).prod()
        expected = np.log(((1 - ODD) * same + ODD * different) / different)
        assert evidence(old, new)[n, m] == pytest.approx(expected)


def test_a_room_or_a_file_of_one_color_says_nothing():
    many, one = lab((20, 40, 10), (80, -60, -50), (50, 0, 0)), lab(*[(100, 0, 0)] * 4)
    for old, new in ((one, one), (many, one), (one, many)):
        np.testing.assert_allclose(evidence(old, new), 0.0, atol=1e-12)


def test_objects_without_color_neither_have_evidence_nor_take_it_from_others():
    old, new = lab((20, 40, 10), None, (80, -60, -50)), lab(None, (30, 35, 20), (90, -10, 60))
    ratio = evidence(old, new)
    assert not ratio[1].any() and not ratio[:, 0].any()
    np.testing.assert_array_equal(ratio[::2, 1:], evidence(old[::2], new[1:]))
    assert not evidence(lab(None, None), new).any()
