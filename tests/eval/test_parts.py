"""Parts of the programs: what ablations free, which cause a failure is counted under, scenes cut short, the page."""

import dataclasses

import numpy as np
import pytest
from known_scenes import known_scene, pose

from eval.ablations import FREED, RATES, only
from eval.failures import CAUSES, cause_of, overlap, table
from eval.harness.paper_numbers import quoted
from eval.registration import true_pairs
from eval.report import beaten
from eval.scores.figures import Row
from more2_jax.config import JointConfig


@pytest.mark.parametrize("freed", FREED.values(), ids=list(FREED))
def test_what_is_not_freed_has_a_step_size_of_zero(freed):
    config = only(JointConfig(), freed)
    for name, rate in RATES.items():
        assert getattr(config, rate) == (getattr(JointConfig(), rate) if name in freed else 0)


def test_the_printed_settings_and_all_variables_are_named():
    """Four; the first of the printed five frees nothing, and is measured without a step."""
    assert len(FREED) == 4
    assert {v for freed in FREED.values() for v in freed} == set(RATES)


@pytest.mark.parametrize(
    ("error", "shown", "cause"),
    [
        (None, 1.0, "none"),
        (6.0, 0.1, "slipped"),
        (14.9, 0.9, "slipped"),
        (88.0, 0.9, "turned"),
        (179.0, 0.1, "turned"),
        (40.0, 0.2, "little"),
        (40.0, 0.8, "lost"),
        (120.0, 0.8, "lost"),
    ],
)
def test_causes(error, shown, cause):
    record = {"re_deg.strict": error, "pose": np.eye(4).tolist()}
    assert cause_of(record, shown, upright=True) == cause


def test_an_upright_object_that_lies_on_its_side_has_tipped_over():
    record = {"re_deg.strict": 179.0, "pose": pose(170, [0, 0, 0], "x").tolist()}
    assert (cause_of(record, 0.9, upright=True), cause_of(record, 0.9, upright=False)) == ("tipped", "turned")


def test_table_of_causes_counts_every_failure():
    found = {c: [] for c in CAUSES} | {
        "lost": [{"overlap": 0.5}, {"overlap": 0.9}],
        "none": [{"overlap": 0.1}],
    }
    lines = table(found, 10, "m").splitlines()
    assert lines[0] == "| cause of a failed registration (m) | of 10 pairs | median overlap |"
    assert [line.split("|")[2].strip() for line in lines[2:]] == ["2", "1"]


def test_overlap_of_the_same_cloud_is_all_of_it_and_of_halves_none():
    scene = known_scene()
    o = scene.objects[0]
    assert overlap(scene, o, 1) == 1
    cloud = scene.instance(1, o.instance[1])
    apart = dataclasses.replace(cloud, points=cloud.points + [50.0, 0, 0])
    scans = list(scene.scans)
    scans[1] = dataclasses.replace(scans[1], instances=(apart, *scans[1].instances[1:]))
    assert overlap(dataclasses.replace(scene, scans=tuple(scans)), o, 1) == 0


def test_a_scene_cut_short_is_the_scene_of_its_first_scans():
    scene = known_scene(scans=4)
    late = dataclasses.replace(scene.objects[0], name="late", instance={3: 99}, T_scan_model={3: np.eye(4)})
    scene = dataclasses.replace(scene, objects=(*scene.objects, late))
    short = scene.first_scans(2)
    assert short.scans == scene.scans[:2] and [o.name for o in short.objects] == [
        f"object_{n}" for n in range(4)
    ]
    assert all(set(o.instance) == set(o.T_scan_model) == {0, 1} for o in short.objects)
    assert scene.first_scans(0) is scene and scene.first_scans(4) is scene


def test_true_pairs_are_of_the_first_scan_with_each_later_one():
    scene = known_scene(scans=3)
    assert [(p.object.name, p.scan) for p in true_pairs(scene, "first")] == [
        (f"object_{n}", 1) for n in range(4)
    ]
    assert len(true_pairs(scene)) == 8
    pair = true_pairs(scene)[5]
    T = pair.object.true_pose(pair.object, pair.scan, 0)
    source, target = pair.clouds
    np.testing.assert_allclose(source @ T[:3, :3].T + T[:3, 3], target, atol=1e-9)
    assert np.abs(T - pose(0, [0, 0, 0])).max() > 0.1


def row(method, value, better="higher"):
    return Row(
        name="MR",
        value=value,
        unit="%",
        better=better,
        count=1,
        failures=0,
        ci95=None,
        method=method,
        column="",
        group="all",
        scenes=1,
    )


def test_the_page_says_where_another_method_is_ahead():
    assert beaten([row("ours, robust", 1.0), row("GICP", 2.0)]) == ["MR [%] (GICP)"]
    assert beaten([row("ours, robust", 2.0), row("GICP", 2.0)]) == []
    assert beaten([row("ours, robust", 1.0, "lower"), row("GICP", 2.0, "lower")]) == []


def test_what_the_paper_prints_is_quoted_for_the_data_it_resembles():
    assert "74.39" in quoted("end_to_end", "open FlyingShape") and "49.07" in quoted("end_to_end", "3RScan")
    assert "not comparable" in quoted("matching", "open FlyingShape")
    assert quoted("accumulation", "3RScan") == ""
