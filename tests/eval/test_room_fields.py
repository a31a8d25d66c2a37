"""Masks come into the canonical frame of their object, and scores are those of an exact field."""

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from eval import room_fields
from eval.data.truth import KnownObject
from eval.room_fields import KnownMask, in_canonical_frame, scored, table
from more2_jax.geometry.poses import apply_pose
from more2_jax.network.prior import load_prior
from more2_jax.types import Instance, Mesh
from train.furniture.symmetry import measure

RADIUS = 0.45  # of a ball in canonical units


def directions(count: int) -> np.ndarray:
    found = np.random.default_rng(0).normal(size=(count, 3))
    return found / np.linalg.norm(found, axis=1, keepdims=True)


def ball_mask() -> KnownMask:
    """Half a ball that was seen, and queries of the whole."""
    seen = directions(600)
    seen = seen[seen[:, 2] > 0.2]
    rng = np.random.default_rng(1)
    near = directions(2000) * (RADIUS + 0.03 * rng.normal(size=(2000, 1)))
    uniform = rng.uniform(-0.5, 0.5, (4000, 3))
    known = [np.column_stack([q, np.linalg.norm(q, axis=1) - RADIUS]) for q in (near, uniform)]
    return KnownMask(RADIUS * seen, seen, *known)


def answers(monkeypatch, shift: float) -> room_fields.FieldScores:
    """Scores of a field that is off by `shift` everywhere."""
    m = ball_mask()

    def distances(_, points, mask, normals, queries):
        origin = np.asarray(m.points.mean(0))
        return jnp.linalg.norm(queries + origin, axis=-1) - RADIUS + shift

    monkeypatch.setattr(room_fields, "_distances", distances)
    return scored(load_prior("small"), m)


def test_an_exact_field_has_every_sign_and_no_error(monkeypatch):
    scores = answers(monkeypatch, 0.0)
    assert scores.sign == scores.sign_seen == scores.sign_unseen == scores.iou == scores.volume == 1.0
    assert scores.error < 1e-5


def test_a_field_that_swells_fills_too_much(monkeypatch):
    scores = answers(monkeypatch, -0.05)
    assert scores.error == pytest.approx(0.05, abs=1e-4)
    assert scores.error_seen == pytest.approx(scores.error_unseen, abs=1e-4)
    assert scores.sign < 0.7
    # Of the cube of uniform queries, the ball and the swollen one, which it cuts.
    uniform = np.linalg.norm(ball_mask().uniform[:, :3], axis=1)
    share = (uniform < 0.5).sum() / (uniform < RADIUS).sum()
    assert scores.volume == pytest.approx(share, abs=0.01)
    assert scores.iou == pytest.approx(1 / share, abs=0.01)
    assert table({"a": [scores, scores]}).row_count == 8


def test_a_mask_lies_where_its_object_lies():
    box = trimesh.creation.box([2.0, 1.0, 0.5])
    box.apply_translation([0.3, 0.0, 0.25])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec([0.2, 0.1, 1.0]).as_matrix(), [4.0, -2.0, 0.5]
    points, face = trimesh.sample.sample_surface(box, 300, seed=0)
    mesh = Mesh(vertices=np.asarray(box.vertices), faces=np.asarray(box.faces))
    truth = KnownObject(
        name="box",
        category="box",
        copies="box",
        instance={0: 1},
        T_scan_model={0: T},
        symmetry=measure(mesh.vertices, mesh.faces),
        mesh=mesh,
    )
    mask = Instance(
        id=1, points=apply_pose(T, np.asarray(points)), normals=box.face_normals[face] @ T[:3, :3].T
    )
    found, normals = in_canonical_frame(truth, 0, mask)
    half = 0.45 * np.array([2.0, 1.0, 0.5]) / 2
    np.testing.assert_allclose(np.abs(np.abs(found) - half).min(axis=1), 0.0, atol=1e-9)
    axis = np.abs(normals).argmax(axis=1)
    outward = np.take_along_axis(found * np.sign(normals), axis[:, None], 1)[:, 0]
    np.testing.assert_allclose(outward, half[axis], atol=1e-9)
