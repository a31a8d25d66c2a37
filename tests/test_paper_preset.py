"""Preset `paper` from scans to shapes: embeddings match, the descent registers, what was seen is encoded together.

Random weights do: codes turn with what they are of whatever the weights.
"""

import dataclasses

import jax
import numpy as np
import pytest
from factories import turn_z
from pieces import pose_error
from small_scenes import piece, scan

from more2_jax.cli.main import main
from more2_jax.config import preset, to_yaml
from more2_jax.geometry.poses import apply_pose
from more2_jax.network.embedding_batch import embed
from more2_jax.network.prior import init_prior, save_prior
from more2_jax.refinement.joint import with_anchors
from more2_jax.scene import add_scan, reconstruct, start_scene
from more2_jax.storage.ply_files import write_points
from more2_jax.storage.scene_folder import load_scene
from more2_jax.tracking.objects import new_object, seen_again
from more2_jax.types import Instance, Observation, Scan

PAPER = preset("paper")
SHORT = dataclasses.replace(
    PAPER,
    registration=dataclasses.replace(PAPER.registration, points=128, sdf_points=64, steps=5, icp_steps=5),
    joint=dataclasses.replace(PAPER.joint, points=64, steps=3),
    meshing=dataclasses.replace(PAPER.meshing, coarse_resolution=8, resolution=16),
)
WITHOUT_JOINT = dataclasses.replace(SHORT, joint=dataclasses.replace(SHORT.joint, steps=0))
# Angle about the vertical and place of every kind of piece; the second kind stays.
BEFORE = {0: (0.0, 0.0), 1: (0.3, 3.0), 2: (0.0, 6.0)}
AFTER = {2: (2.5, 1.0), 1: (0.3, 3.0), 0: (-1.2, 5.0)}


def true_motion(kind: int) -> np.ndarray:
    """T_ref_scan of a piece between the two visits."""
    before, after = (
        turn_z(angle, np.zeros(3), np.array([x, 0, 0])) for angle, x in (BEFORE[kind], AFTER[kind])
    )
    return before @ np.linalg.inv(after)


@pytest.fixture(scope="module")
def visited(tiny_prior):
    """Both visits added, nothing reconstructed yet."""
    made = start_scene(tiny_prior, scan("a", BEFORE), SHORT)
    return add_scan(tiny_prior, made, scan("b", AFTER), SHORT)


def kind_of(o) -> int:
    return o.observations[0].instance - 10


def test_every_object_is_found_again_where_it_is(visited):
    assert len(visited.objects) == 3
    for o in visited.objects:
        first, second = o.observations
        assert first.instance == second.instance
        degrees, meters = pose_error(
            second.T_ref_scan, true_motion(kind_of(o)), apply_pose(second.T_ref_scan, piece(kind_of(o)))
        )
        assert degrees < 0.5 and meters < 0.01
    (changes,) = visited.changes
    assert {len(changes.moved), len(changes.static)} == {2, 1}
    assert not changes.added and not changes.removed


def test_shapes_are_encoded_from_all_observations_together(tiny_prior):
    """The second visit sees what the first does not: the piece's other half."""
    whole, half = piece(0), piece(0)[:, 1] < 0
    seen = [Instance(id=1, points=whole[rows]) for rows in (half, ~half)]
    o = new_object(0, 0, seen[0], embed(tiny_prior, [seen[0].points])[0])
    there = Observation(scan=1, instance=1, T_ref_scan=np.eye(4), score=1.0, rms_m=0.0, converged=True)
    made = start_scene(tiny_prior, Scan(name="a", source="a", instances=(seen[0],)), SHORT)
    both = dataclasses.replace(made, objects=(seen_again(o, seen[1], there),), scans=(made.scans[0],) * 2)
    (shape,) = reconstruct(tiny_prior, both, WITHOUT_JOINT).objects
    (expected,) = embed(tiny_prior, [np.concatenate([x.points for x in seen])])
    np.testing.assert_allclose(shape.embedding.inv, expected.inv, atol=1e-6)
    np.testing.assert_allclose(shape.embedding.scan_center(), expected.scan_center(), atol=1e-5)
    assert np.abs(shape.embedding.inv - o.embedding.inv).max() > 1e-3


def test_code_and_poses_are_optimized_together(tiny_prior, visited):
    plain, made = (reconstruct(tiny_prior, visited, c) for c in (WITHOUT_JOINT, SHORT))
    for before, after in zip(plain.objects, made.objects, strict=True):
        assert np.isfinite(after.embedding.inv).all()
        np.testing.assert_array_equal(after.observations[0].T_ref_scan, np.eye(4))
        gap = after.observations[1].T_ref_scan - before.observations[1].T_ref_scan
        assert 0 < np.abs(gap).max() < 0.05


def test_what_is_looked_up_beside_the_best_code_is_of_all_observations(tiny_prior):
    decoder = dataclasses.replace(tiny_prior.config.decoder, local_blocks=(1,), local_channels=4)
    prior = init_prior(dataclasses.replace(tiny_prior.config, decoder=decoder), jax.random.key(0))
    one, together = embed(prior, [piece(0)[piece(0)[:, 1] < 0], piece(0)])
    local = [
        dataclasses.replace(e, center=e.scan_center().astype(np.float32), origin=None)
        for e in (one, together)
    ]
    mixed = with_anchors(*local)
    np.testing.assert_array_equal(mixed.inv, one.inv)
    np.testing.assert_array_equal(mixed.center, local[0].center)
    (found,), (expected,) = mixed.anchors, local[1].anchors
    np.testing.assert_array_equal(found.features, expected.features)
    np.testing.assert_allclose(found.offset + mixed.center, expected.offset + local[1].center, atol=1e-6)


def test_the_command_runs_it(tmp_path, tiny_prior):
    """`more2 run --preset paper`, with settings that take a moment; then one more scan."""
    save_prior(tiny_prior, tmp_path / "tiny.npz", half=False)
    (tmp_path / "short.yaml").write_text(to_yaml(SHORT))
    files = []
    for name, poses in (("a", BEFORE), ("b", AFTER), ("c", BEFORE)):
        instances = scan(name, poses).instances
        ids = np.repeat([i.id for i in instances], [len(i.points) for i in instances])
        files.append(tmp_path / f"{name}.ply")
        write_points(files[-1], np.concatenate([i.points for i in instances]), ids, "instance")
    options = ["--prior", tmp_path / "tiny.npz", "--unit", "m"]
    out = ["--out", tmp_path / "room", "--preset", "paper", "--config", tmp_path / "short.yaml"]
    assert main([str(a) for a in ("run", *files[:2], *out, *options)]) == 0
    assert main([str(a) for a in ("add", tmp_path / "room", files[2], "--prior", tmp_path / "tiny.npz")]) == 0
    made, config = load_scene(tmp_path / "room")
    assert (made.preset, config) == ("paper", SHORT)
    assert [[seen.instance for seen in o.observations] for o in made.objects] == [
        [10 + k] * 3 for k in range(3)
    ]
    for o in made.objects:  # the third visit is as the first was
        degrees, meters = pose_error(o.observations[2].T_ref_scan, np.eye(4), piece(kind_of(o)))
        assert degrees < 0.5 and meters < 0.01
