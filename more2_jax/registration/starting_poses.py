"""Where registration starts from: poses worth trying for one pair (paper §3.3, and beyond it)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy.spatial.transform import Rotation

from more2_jax.config import MotionModel
from more2_jax.geometry.points import kabsch, kabsch_rotation
from more2_jax.types import Embedding


def embedding_pose(source: Embedding, target: Embedding) -> jaxlie.SE3:
    """The paper's start: Kabsch on `F_se3 = F_eqv + F_c` as corresponding points, one a channel (§3.3)."""
    a, b = source.eqv.T + source.center, target.eqv.T + target.center
    return kabsch(a, b, jnp.ones(len(a), a.dtype))


def candidate_poses(
    codes: tuple[Embedding, Embedding],
    means: tuple[Float[Array, "3"], Float[Array, "3"]],
    stayed: jaxlie.SE3,
    turns: int,
    motion: MotionModel,
) -> jaxlie.SE3:
    """All starts of a pair (source, target), batched: every rotation about the codes' centers and the clouds' means.

    Upright, those about the means keep their height: what stands on the floor stays there. `turns`: as
    `candidate_rotations`.
    """
    rotations = candidate_rotations(*codes, turns, motion)
    from_codes = place(rotations, codes[0].center, codes[1].center)
    from_means = place(rotations, *means)
    if motion == "upright":
        level = from_means.translation().at[:, 2].set(stayed.translation()[2])
        from_means = jaxlie.SE3.from_rotation_and_translation(rotations, level)
    return jax.tree.map(lambda *x: jnp.concatenate(x), from_codes, from_means)


def candidate_rotations(source: Embedding, target: Embedding, turns: int, motion: MotionModel) -> jaxlie.SO3:
    """The embeddings' rotation, and `turns` about the vertical (upright) or the 60 rotations of an icosahedron.

    Upright, of the embeddings' rotation the nearest turn about the vertical.
    """
    by_code = kabsch_rotation(source.eqv.T, target.eqv.T).as_matrix()
    others = turns_about_vertical(turns) if motion == "upright" else icosahedral_rotations()
    matrices = jnp.concatenate([by_code[None], jnp.asarray(others, by_code.dtype)])
    if motion == "upright":
        return jax.vmap(jaxlie.SO3.from_z_radians)(yaw_of(matrices))
    return jax.vmap(jaxlie.SO3.from_matrix)(matrices)


def turned_rotations(source: Embedding, target: Embedding, turns: int, motion: MotionModel) -> jaxlie.SO3:
    """The embeddings' rotation, and that rotation turned on: `turns` in all about the vertical (upright), or by the
    60 rotations of an icosahedron; the first is the embeddings' own, upright the nearest turn about the vertical."""
    by_code = kabsch_rotation(source.eqv.T, target.eqv.T)
    if motion == "upright":
        others, by_code = turns_about_vertical(turns), jaxlie.SO3.from_z_radians(yaw_of(by_code.as_matrix()))
    else:
        others = icosahedral_rotations()
    return jax.vmap(lambda R: jaxlie.SO3.from_matrix(R) @ by_code)(jnp.asarray(others, source.eqv.dtype))


def yaw_of(matrix: Float[Array, "*b 3 3"]) -> Float[Array, "*b"]:
    """The turn about the vertical nearest to each rotation, radians; 0 where all are as near."""
    return jnp.arctan2(matrix[..., 1, 0] - matrix[..., 0, 1], matrix[..., 0, 0] + matrix[..., 1, 1])


def place(
    rotations: jaxlie.SO3, source_center: Float[Array, "3"], target_center: Float[Array, "3"]
) -> jaxlie.SE3:
    """Poses with the given rotations that bring one center onto the other."""

    def one(rotation: jaxlie.SO3) -> jaxlie.SE3:
        return jaxlie.SE3.from_rotation_and_translation(rotation, target_center - rotation @ source_center)

    return jax.vmap(one)(rotations)


def masked_mean(points: Float[Array, "n 3"], mask: Bool[Array, " n"]) -> Float[Array, "3"]:
    """The mean of the real points."""
    return (mask / jnp.maximum(mask.sum(), 1)) @ points


def turns_about_vertical(count: int) -> Float[np.ndarray, "count 3 3"]:
    """`count` turns about z, evenly spaced, the first none at all."""
    angle = 2 * np.pi * np.arange(count) / count
    zero, one = np.zeros(count), np.ones(count)
    rows = [[np.cos(angle), -np.sin(angle), zero], [np.sin(angle), np.cos(angle), zero], [zero, zero, one]]
    return np.moveaxis(np.array(rows), -1, 0).astype(np.float32)


def icosahedral_rotations() -> Float[np.ndarray, "60 3 3"]:
    """The rotations that map an icosahedron onto itself: no rotation is farther than 45° from one of them."""
    return Rotation.create_group("I").as_matrix().astype(np.float32)
