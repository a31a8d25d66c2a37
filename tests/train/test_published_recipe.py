"""`configs/paper.yaml` is the published recipe but for what its page lists, with a reason for every value."""

import dataclasses
import re

import numpy as np
import pytest
import yaml
from places import DATA, ROOT

from more2_jax.config import load_config
from train.run.schedule import learning_rate
from train.run.settings import TrainingRun

CONFIGS = ("paper", "paper_small")
# What has no part in what is learned,
OF_THE_RUN = {"training.seed", "training.validate_every", "training.picture_every"}
# and what has none because another setting switches it off.
SWITCH = {
    "model.decoder.local_channels": "model.decoder.local_blocks",
    "model.decoder.bandwidths": "model.decoder.local_blocks",
    "model.decoder.surface_bandwidths": "model.decoder.surface_points",
    "training.depth_noise": "training.depth_noise_probability",
    "training.depth_step": "training.depth_noise_probability",
    "training.drift": "training.drift_probability",
    "training.drift_deg": "training.drift_probability",
    "training.fused": "training.fused_probability",
    "training.voxel": "training.fused_probability",
    "training.normal_noise_deg": "model.decoder.normals",
    "training.normals_unknown_probability": "model.decoder.normals",
    "training.normals_lost_probability": "model.decoder.normals",
    "training.flip_probability": "model.decoder.normals",
    "training.flipped": "model.decoder.normals",
    "training.contrast_temperature": "training.contrast_weight",
    "training.sign_width": "training.sign_weight",
}


def flat(tree: dict, where: str = "") -> dict[str, object]:
    """Settings by their dotted names; lists for tuples."""
    found = {}
    for key, value in tree.items():
        name = f"{where}.{key}" if where else key
        found |= flat(value, name) if isinstance(value, dict) else {name: plain(value)}
    return found


def plain(value: object) -> object:
    return list(value) if isinstance(value, tuple) else value


def settings(name: str) -> dict[str, object]:
    return flat(dataclasses.asdict(load_config(ROOT / "configs" / f"{name}.yaml", TrainingRun)))


PUBLISHED = flat(yaml.safe_load((DATA / "published_recipe.yaml").read_text()))


def listed() -> dict[str, tuple[list[object], str]]:
    """The rows of the table in the page: by setting, the published value and those of `CONFIGS`, and why."""
    page = (ROOT / "docs" / "developing" / "paper_recipe.md").read_text(encoding="utf-8")
    section = page.split("## The paper's recipe", 1)[1].split("\n## ", 1)[0]
    rows = [
        re.split(r"\s*\|\s*", line.strip("| ")) for line in section.splitlines() if line.startswith("| `")
    ]
    return {name.strip("`"): ([yaml.safe_load(v) for v in values], why) for name, *values, why in rows}


@pytest.mark.parametrize("name", CONFIGS)
def test_every_setting_is_the_published_one_or_has_no_part_or_is_listed(name):
    ours = settings(name)
    assert set(ours) == set(PUBLISHED) | OF_THE_RUN | set(SWITCH)
    for setting, switch in SWITCH.items():
        assert not ours[switch], f"{setting} has a part: {switch} is on"
    column = 1 + CONFIGS.index(name)
    differing = {k: ours[k] for k in PUBLISHED if ours[k] != PUBLISHED[k]}
    told = {k: values[column] for k, (values, _) in listed().items() if values[column] != values[0]}
    assert told == differing


def test_the_page_lists_what_differs_somewhere_with_the_published_value_and_a_reason():
    found = listed()
    assert len(found) > 3
    for setting, (values, why) in found.items():
        assert values[0] == PUBLISHED[setting], setting
        assert any(v != values[0] for v in values[1:]), f"{setting} differs nowhere"
        assert len(why) > 20, f"{setting} has no reason"


def test_the_rate_falls_where_the_published_one_does():
    rate = learning_rate(load_config(ROOT / "configs" / "paper.yaml", TrainingRun).training)
    at = [0, 119_999, 120_001, 149_999, 150_001, 179_999, 180_001, 199_999]
    expected = 1e-4 * 0.3 ** np.repeat(range(4), 2)
    np.testing.assert_allclose([float(rate(k)) for k in at], expected, rtol=1e-5)
