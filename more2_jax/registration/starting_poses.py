"""Where registration starts from: poses worth trying for one pair (METHOD 4, and beyond it in `robust`)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jax import Array
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from more2_jax.config import RegistrationConfig
from more2_jax.geometry.points import Sampled, kabsch, kabsch_rotation
from more2_jax.types import Embedding, Sight, pytree


@pytree
class Pair:
    """A source to be moved onto a target; local frames."""

    source: Sampled
    target: Sampled
    source_code: Embedding
    target_code: Embedding
    offset: Float[Array, "*b 3"]  # source's origin minus target's, meters, in the frame both scans share
    source_sight: Sight | None = None  # what was seen around each, where sensors are known
    target_sight: Sight | None = None


def embedding_pose(source: Embedding, target: Embedding) -> jaxlie.SE3:
    """The paper's start: Kabsch on `F_se3 = F_eqv + F_c` as 256 corresponding points (§3.3)."""
    a, b = source.eqv.T + source.center, target.eqv.T + target.center
    return kabsch(a, b, jnp.ones(len(a), a.dtype))


def candidate_poses(pair: Pair, config: RegistrationConfig, upright: bool) -> jaxlie.SE3:
    """All starts of a pair, batched: every rotation about the codes' centers and about the clouds' means.

    Upright, in scans of one frame, those about the means keep their height: what stands on the floor stays there."""
    if config.starts == "embedding":
        return jax.tree.map(lambda x: x[None], embedding_pose(pair.source_code, pair.target_code))
    rotations = candidate_rotations(pair, config, upright)
    from_codes = place(rotations, pair.source_code.center, pair.target_code.center)
    from_means = place(rotations, _mean(pair.source), _mean(pair.target))
    if upright and config.identity_start:
        level = from_means.translation().at[:, 2].set(pair.offset[2])
        from_means = jaxlie.SE3.from_rotation_and_translation(rotations, level)
    return jax.tree.map(lambda *x: jnp.concatenate(x), from_codes, from_means)


def candidate_rotations(pair: Pair, config: RegistrationConfig, upright: bool) -> jaxlie.SO3:
    """The embedding's rotation, and turns about the vertical (`upright`) or the 60 rotations of an icosahedron.

    `upright`: of the embedding's, the nearest turn about the vertical."""
    by_code = kabsch_rotation(pair.source_code.eqv.T, pair.target_code.eqv.T).as_matrix()
    others = yaw_turns(config.yaw_starts) if upright and config.yaw_starts else icosahedral_rotations()
    matrices = jnp.concatenate([by_code[None], jnp.asarray(others, by_code.dtype)])
    rotations = jax.vmap(jaxlie.SO3.from_matrix)
    return rotations(matrices) if not upright else jax.vmap(jaxlie.SO3.from_z_radians)(yaw_of(matrices))


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


def _mean(cloud: Sampled) -> Float[Array, "3"]:
    return (cloud.mask / jnp.maximum(cloud.mask.sum(), 1)) @ cloud.points


def yaw_turns(count: int) -> Float[np.ndarray, "count 3 3"]:
    """`count` turns about z, evenly spaced, the first none at all."""
    angle = 2 * np.pi * np.arange(count) / count
    zero, one = np.zeros(count), np.ones(count)
    rows = [[np.cos(angle), -np.sin(angle), zero], [np.sin(angle), np.cos(angle), zero], [zero, zero, one]]
    return np.moveaxis(np.array(rows), -1, 0).astype(np.float32)


def icosahedral_rotations() -> Float[np.ndarray, "60 3 3"]:
    """The rotations that map an icosahedron onto itself: no rotation is farther than 45° from one of them."""
    return Rotation.create_group("I").as_matrix().astype(np.float32)
