"""Masks of simulated scans as training shapes: in the model's canonical frame, with the model's own distances."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from more2_jax.geometry.poses import apply_pose
from more2_jax.types import Instance, Scan
from train.rooms.visits import FlyingScene, TrueObject
from train.run.shape_mix import open_mix
from train.shards.packed_shapes import HALF, write_shapes
from train.shards.settings import NORMAL_STEPS
from train.tools.scanned import FEWEST_POINTS, Sizes, masks_of, model_queries, stacked

SIZES = Sizes(views=3, points=64, queries=200)
EDGES = np.array([2.0, 1.0, 0.5])  # of a box standing on z = 0, meters: 0.45 canonical units a meter


def pose() -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec([0.1, -0.2, 2.0]).as_matrix(), [5.0, -3.0, 1.0]
    return T


def box() -> tuple[TrueObject, np.ndarray, np.ndarray]:
    """The box in scan 0, its only scan, and points with normals on it, model frame."""
    mesh = trimesh.creation.box(EDGES)
    mesh.apply_translation([0, 0, EDGES[2] / 2])
    points, face = trimesh.sample.sample_surface(mesh, 400, seed=0)
    truth = TrueObject(
        name="object_0",
        model="box",
        category="box",
        vertices=np.asarray(mesh.vertices),
        faces=np.asarray(mesh.faces),
        instance={0: 1},
        T_scan_model={0: pose()},
        parts={0: (1, 2)},
    )
    return truth, np.asarray(points), np.asarray(mesh.face_normals[face])


def scene(truth: TrueObject, *masks: tuple[np.ndarray, np.ndarray]) -> FlyingScene:
    instances = tuple(
        Instance(id=n, points=apply_pose(pose(), p), normals=n_model @ pose()[:3, :3].T)
        for n, (p, n_model) in enumerate(masks, start=1)
    )
    scan = Scan(name="scan_0", instances=instances, background=np.zeros((0, 3)), source="scan_0.ply")
    return FlyingScene(scans=(scan,), objects=(truth,), regime="real")


def test_views_are_points_of_the_mask_in_the_models_canonical_frame():
    truth, points, normals = box()
    (row,) = masks_of(scene(truth, (points, normals)), truth, SIZES)
    assert row["views"].shape == row["normals"].shape == (3, 64, 3)
    half = 0.45 * EDGES / 2
    flat = row["views"].astype(float).reshape(-1, 3)
    off = np.abs(np.abs(flat) - half).min(axis=1)
    np.testing.assert_allclose(off, 0.0, atol=2e-3)
    assert (np.abs(flat) <= half + 2e-3).all()
    outward = row["normals"].astype(float).reshape(-1, 3) / NORMAL_STEPS
    axis = np.abs(outward).argmax(axis=1)
    np.testing.assert_allclose(np.abs(outward).max(axis=1), 1.0, atol=0.01)
    np.testing.assert_allclose(
        np.take_along_axis(flat * np.sign(outward), axis[:, None], 1)[:, 0], half[axis], atol=2e-3
    )


def test_every_part_of_a_split_mask_is_a_shape_and_a_merged_mask_is_none():
    truth, points, normals = box()
    halves = scene(truth, (points[:200], normals[:200]), (points[200:], normals[200:]))
    assert len(list(masks_of(halves, truth, SIZES))) == 2
    merged = TrueObject(**(vars(truth) | {"merged": frozenset({0})}))
    assert not list(masks_of(halves, merged, SIZES))


def test_points_far_off_are_left_out_and_few_points_make_no_shape():
    truth, points, normals = box()
    far = points.copy()
    far[::2] += 3.0
    (row,) = masks_of(scene(truth, (far, normals)), truth, SIZES)
    assert np.abs(row["views"]).max() < HALF
    few = slice(FEWEST_POINTS - 1)
    assert not list(masks_of(scene(truth, (points[few], normals[few])), truth, SIZES))


def test_distances_are_the_models_and_the_file_says_that_it_was_scanned(tmp_path):
    truth, points, normals = box()
    known = model_queries(truth, SIZES.queries)
    half = 0.45 * EDGES / 2
    for name in ("sdf_uniform", "sdf_near"):
        query, sdf = known[name][:, :3].astype(float), known[name][:, 3].astype(float)
        beyond = np.abs(query) - half
        exact = np.linalg.norm(np.maximum(beyond, 0), axis=1) + np.minimum(beyond.max(axis=1), 0)
        np.testing.assert_allclose(sdf, exact, atol=2e-3)
    (row,) = masks_of(scene(truth, (points, normals)), truth, SIZES)
    write_shapes(tmp_path / "scanned.npz", {"train": stacked([known | row] * 2)})
    plain = {name: array for name, array in stacked([known | row]).items() if name != "scanned"}
    write_shapes(tmp_path / "plain.npz", {"train": plain})
    mix = open_mix([tmp_path / "scanned.npz", tmp_path / "plain.npz"], "train")
    read = mix.read(range(3))
    np.testing.assert_array_equal(read.scanned, [True, True, False])
    np.testing.assert_allclose(read.views[0], row["views"], atol=3e-3)


@pytest.mark.parametrize("count", [30, 5000])
def test_a_view_repeats_no_point_of_a_mask_that_has_enough(count):
    truth, *_ = box()
    mesh = trimesh.Trimesh(truth.vertices, truth.faces)
    points, face = trimesh.sample.sample_surface(mesh, max(count, FEWEST_POINTS), seed=1)
    (row,) = masks_of(scene(truth, (np.asarray(points), mesh.face_normals[face])), truth, SIZES)
    for view in row["views"]:
        assert len(np.unique(view, axis=0)) >= 62  # rounding joins a pair at most
