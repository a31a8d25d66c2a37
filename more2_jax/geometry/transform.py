"""Records of an object in another frame or unit: every field moves as its kind does, nothing is encoded again."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jax import Array
from jaxtyping import Float

from more2_jax.geometry.poses import Pose, apply_pose
from more2_jax.types import Embedding, ObservedObject, Sight


def moved_embedding(e: Embedding, T_b_a: Pose) -> Embedding:
    """The embedding in another frame: turned about its origin, which moves along in float64."""
    turn = jaxlie.SE3.from_rotation(jaxlie.SO3.from_matrix(jnp.asarray(T_b_a[:3, :3], jnp.float32)))
    origin = apply_pose(T_b_a, np.asarray(e.origin, np.float64)[None])[0]
    return jax.tree.map(np.asarray, dataclasses.replace(move_embedding(e, turn), origin=origin))


def moved(known: ObservedObject, T_b_a: Pose) -> ObservedObject:
    """What is known of an object, in another frame."""
    if np.array_equal(T_b_a, np.eye(4)):
        return known
    embedding = moved_embedding(known.embedding, T_b_a)
    sight = None if known.sight is None else moved_sight(known.sight, T_b_a)
    return dataclasses.replace(
        known, points=apply_pose(T_b_a, known.points), embedding=embedding, sight=sight
    )


def lift(height_m: float) -> Pose:
    """A shift along z."""
    T = np.eye(4)
    T[2, 3] = height_m
    return T


def scale_embedding(e: Embedding, factor: Float[Array, ""]) -> Embedding:
    """The embedding of the same object in other units of length. One object."""
    anchors = tuple(dataclasses.replace(a, offset=a.offset * factor) for a in e.anchors)
    return dataclasses.replace(e, scale=e.scale * factor, center=e.center * factor, anchors=anchors)


def move_embedding(e: Embedding, T_b_a: jaxlie.SE3) -> Embedding:
    """The embedding of a moved object: Φ is equivariant, so nothing is encoded again. One object; local frames."""
    R = T_b_a.rotation().as_matrix()
    anchors = tuple(dataclasses.replace(a, offset=a.offset @ R.T, features=R @ a.features) for a in e.anchors)
    return dataclasses.replace(e, eqv=R @ e.eqv, center=T_b_a @ e.center, anchors=anchors)


def moved_sight(s: Sight, T_b_a: Float[np.ndarray, "4 4"]) -> Sight:
    """The sight in another frame: one view, or several."""
    R, shift = T_b_a[:3, :3], T_b_a[:3, 3]
    return dataclasses.replace(s, eye=np.asarray(s.eye) @ R.T + shift, turn=np.asarray(s.turn) @ R.T)


def scale_sight(s: Sight, factor: Float[Array, ""]) -> Sight:
    """The sight in other units of length."""
    return dataclasses.replace(s, eye=s.eye * factor, clear=s.clear * factor)
