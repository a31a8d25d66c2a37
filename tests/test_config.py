"""Settings: strict YAML, presets, round trips."""

import dataclasses
from dataclasses import replace
from typing import get_args

import pytest
from places import ROOT

from more2_jax.cli.settings import scene_config
from more2_jax.config import (
    CodeMatcher,
    DescentRegistration,
    EvidenceMatcher,
    FieldRegistration,
    PresetName,
    PriorConfig,
    SceneConfig,
    SurfaceRegistration,
    SurfaceSearch,
    from_dict,
    load_config,
    preset,
    to_yaml,
)
from train.run.settings import TrainingRun


@pytest.mark.parametrize("path", sorted((ROOT / "configs").rglob("*.yaml")), ids=lambda p: p.stem)
def test_shipped_configurations_load_and_round_trip(path, tmp_path):
    run = load_config(path, TrainingRun)
    copy = tmp_path / "copy.yaml"
    copy.write_text(to_yaml(run))
    assert load_config(copy, TrainingRun) == run


@pytest.mark.parametrize("upright", [False, True])
@pytest.mark.parametrize("name", get_args(PresetName))
def test_presets_round_trip(name, upright, tmp_path):
    config = preset(name, upright=upright)
    assert (config.preset, config.upright) == (name, upright)
    path = tmp_path / "scene.yaml"
    path.write_text(to_yaml(config))
    assert load_config(path, SceneConfig) == config


def test_paper_is_the_paper():
    paper = preset("paper")
    assert paper.matching == CodeMatcher(score="both", assignment="hungarian")
    assert paper.registration == DescentRegistration(steps=200, trim=1.0)
    assert (paper.joint.start, paper.joint.steps) == ("best", 200)
    assert not paper.accumulate_target


def test_field_is_the_paper_but_for_its_poses():
    field, paper = preset("field"), preset("paper")
    assert isinstance(field.registration, FieldRegistration)
    assert replace(field, preset="paper", registration=paper.registration) == paper


def test_robust_searches_alike_in_matching_and_registration():
    robust = preset("robust")
    assert isinstance(robust.matching, EvidenceMatcher) and isinstance(
        robust.registration, SurfaceRegistration
    )
    # But for free space, which has no say in the evidence of who is who.
    assert replace(robust.matching.search, free_weight=1.0) == robust.registration.search


def test_base_has_the_published_widths():
    model, published = load_config(ROOT / "configs" / "base.yaml", TrainingRun).model, PriorConfig()
    for part, names in {
        "encoder": ("widths", "code", "neighbors", "linear_blocks", "head_channels", "downsample_blocks"),
        "decoder": ("hidden", "layers", "skip_layer"),
    }.items():
        for name in names:
            assert getattr(getattr(model, part), name) == getattr(getattr(published, part), name), name


@pytest.mark.parametrize("name", get_args(PresetName))
def test_motion_says_how_objects_may_move(name):
    assert preset(name).motion == "free"
    assert preset(name, upright=True).motion == "upright"


def test_unknown_preset_names_the_known():
    with pytest.raises(ValueError, match="'fast'; needed 'paper', 'field' or 'robust'"):
        preset("fast")


@pytest.mark.parametrize(
    ("values", "complaint"),
    [
        ({"encoder": {"width": 3}}, r"encoder: unknown width; known are .*widths"),
        ({"encoder": {"neighbors": "many"}}, "encoder.neighbors: got 'many', needed int"),
        ({"encoder": {"neighbors": 1.5}}, "encoder.neighbors: got 1.5, needed int"),
        ({"encoder": {"neighbors": True}}, "encoder.neighbors: got True, needed int"),
        ({"encoder": {"widths": 16}}, "encoder.widths: got 16, needed a list"),
        ({"encoder": {"widths": [16, "x"]}}, r"encoder.widths\[1\]: got 'x', needed int"),
        ({"encoder": [1]}, r"encoder: got \[1\], needed a mapping"),
        ({"eqv_gain": None}, "eqv_gain: got None, needed float"),
        ({"eqv_gain": True}, "eqv_gain: got True, needed float"),
    ],
)
def test_wrong_values_are_named(values, complaint):
    with pytest.raises(ValueError, match=complaint):
        from_dict(PriorConfig, values)


def test_choices_are_listed():
    with pytest.raises(ValueError, match="score: got 'all', needed one of 'inv', 'eqv', 'both'"):
        from_dict(CodeMatcher, {"score": "all"})


def test_each_algorithm_has_settings_of_its_own_chosen_by_its_name():
    values = {
        "matching": {"method": "evidence", "search": {"keep": 3}},
        "registration": {"method": "descent", "steps": 7},
    }
    config = from_dict(SceneConfig, values)
    assert config.matching == EvidenceMatcher(search=SurfaceSearch(keep=3))
    assert config.registration == DescentRegistration(steps=7)


@pytest.mark.parametrize(
    ("values", "complaint"),
    [
        ({"matching": {"method": "codes", "search": {}}}, "matching: unknown search; known are"),
        ({"matching": {"score": "inv"}}, "matching.method: got None, needed one of 'codes', 'evidence'"),
        (
            {"registration": {"method": "icp"}},
            "registration.method: got 'icp', needed one of 'descent', 'surface'",
        ),
        ({"registration": 3}, "registration.method: got 3, needed one of"),
        (
            {"registration": {"method": "surface", "search": {"turn": 3}}},
            "registration.search: unknown turn; known are",
        ),
    ],
)
def test_settings_of_another_algorithm_or_of_none_are_named(values, complaint):
    with pytest.raises(ValueError, match=complaint):
        from_dict(SceneConfig, values)


def test_a_file_may_put_another_algorithm_in_place_of_the_presets(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("matching: {method: codes}\nregistration: {method: surface, steps: 3}\n")
    config, robust = scene_config("robust", True, path), preset("robust", upright=True)
    assert config.matching == CodeMatcher()
    assert config.registration == dataclasses.replace(robust.registration, steps=3)


def test_whole_numbers_are_floats_and_missing_keys_keep_their_defaults():
    config = from_dict(PriorConfig, {"eqv_gain": 3})
    assert isinstance(config.eqv_gain, float)
    assert config == dataclasses.replace(PriorConfig(), eqv_gain=3.0)


@pytest.mark.parametrize("text", ["", "# nothing but a remark\n"])
def test_an_empty_file_is_all_defaults(text, tmp_path):
    path = tmp_path / "empty.yaml"
    path.write_text(text)
    assert load_config(path, TrainingRun) == TrainingRun()


def test_a_complaint_names_the_file(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("modle: {}")
    with pytest.raises(ValueError, match=r"mine\.yaml: unknown modle; known are model, training"):
        load_config(path, TrainingRun)


def test_settings_cannot_be_changed():
    with pytest.raises(dataclasses.FrozenInstanceError):
        preset("robust").min_points = 3


# The settings of meshes and pose graphs as `robust` wrote them before they were renamed.
OLD_ROBUST = """
closing: {steps: 16, points: 1024, first_reach: 0.05, last_reach: 0.001, most_turn_deg: 3.0}
meshing: {coarse: 16, resolution: 128, field_resolution: 32, level: observed, seen_reach: 0.02, screening: 0.12,
  screening_of_many: 0.3, outlier_factor: 1.5, outlier_factor_of_many: 1.25, floor: true, half_width: 0.65}
"""


def test_settings_written_before_they_were_renamed_still_read(tmp_path):
    path = tmp_path / "config.yaml"
    path.write_text(OLD_ROBUST)
    found, robust = load_config(path, SceneConfig), preset("robust")
    then = dataclasses.replace(
        robust.meshing, screening_length=0.12, screening_length_multi_scan=0.3, unseen_rise=0.0
    )
    assert found.meshing == then and found.pose_graph == robust.pose_graph


@pytest.mark.parametrize("values", [{"closing": {"most_turn_deg": 5.0}}, {"meshing": {"half_width": 0.7}}])
def test_another_value_of_what_is_a_constant_now_is_refused(values):
    with pytest.raises(ValueError, match=r"(most_turn_deg|half_width) is no setting any more; needed"):
        from_dict(SceneConfig, values)
