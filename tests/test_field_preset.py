"""Preset `field` through a scene, shipped weights: who is who by the codes, where it went by the completed shapes."""

import dataclasses

import numpy as np
import pieces
import pytest
from scipy.spatial.transform import Rotation

from more2_jax.config import FieldRegistration, preset
from more2_jax.network.prior import load_prior
from more2_jax.scene import add_scan, start_scene
from more2_jax.types import Instance, Scan

FIELD = FieldRegistration(turns=8, search_points=32, search_steps=4, keep=2, points=128, steps=8)
CONFIG = dataclasses.replace(preset("field", upright=True), registration=FIELD)
MOVED = {0: (0.0, [0.0, 0, 0]), 1: (75.0, [0.4, 1.5, 0]), 2: (-160.0, [1.0, -0.5, 0])}


@pytest.mark.slow
def test_objects_are_found_where_they_went():
    prior = load_prior("small")
    poses = {
        k: pieces.pose(Rotation.from_euler("z", turn, degrees=True), np.array(shift))
        for k, (turn, shift) in MOVED.items()
    }
    models = pieces.without_symmetry()[: len(poses)]
    first = {k: pieces.surface(m, 600) + [3.0 * k, 0, 0] for k, m in enumerate(models)}
    other = {k: pieces.surface(m, 600, seed=1) + [3.0 * k, 0, 0] for k, m in enumerate(models)}
    now = {k: pieces.apply(poses[k], x) for k, x in other.items()}
    scans = [
        Scan(name=n, source=n, instances=tuple(Instance(id=k + 1, points=x) for k, x in seen.items()))
        for n, seen in (("a", first), ("b", now))
    ]
    made = add_scan(prior, start_scene(prior, scans[0], CONFIG), scans[1], CONFIG)
    assert len(made.objects) == len(poses) and made.preset == "field"
    for o in made.objects:
        before, after = o.observations
        assert before.instance == after.instance
        k = before.instance - 1
        degrees, meters = pieces.pose_error(after.T_ref_scan, np.linalg.inv(poses[k]), now[k])
        assert degrees < 3 and meters < 0.03 * pieces.size(now[k])
    (changes,) = made.changes
    assert len(changes.moved) >= 2 and not changes.added and not changes.removed
