"""The surface of a field of occupancy: a coarse grid around the cloud, then a finer one around what is inside."""

from __future__ import annotations

from functools import partial
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float
from skimage.measure import marching_cubes

from eval.peers.learned.clouds import thinned
from eval.peers.learned.registry import Params, Trained
from more2_jax.geometry.poses import Points
from more2_jax.meshing.grid import Lattice, cube
from more2_jax.types import Mesh

COARSE, FINE = 32, 64  # cells a side, as published at the finest: 128
# Of the cloud's longest edge, from the middle of its box: one view shows no back. Queries of training reach 0.61 around
# a whole cloud, the planes of ConvONet 0.7 around any; farther out no network has learned that there is nothing.
REACH = 0.7
RING = 1  # coarse cells around what is inside
CHUNK = 8192  # queries a call
LEVEL = float(np.log(0.2 / 0.8))  # logit of the published threshold: inside from a probability of 0.2


@partial(jax.jit, static_argnames="network")
def _code(network: nn.Module, params: Params, points: Float[Array, "n 3"], mask: Bool[Array, " n"]) -> Any:
    return network.apply(params, points, mask, method="code")


@partial(jax.jit, static_argnames="network")
def _field(network: nn.Module, params: Params, code: Any, queries: Float[Array, "q 3"]) -> Float[Array, " q"]:
    return network.apply(params, code, queries, method="field")  # type: ignore[return-value]


def surface(trained: Trained, cloud: Points) -> Mesh | None:
    """The closed surface where being inside has the published probability, meters; None where nothing is inside."""
    points, mask, origin = thinned([cloud], trained.peer.points)
    network = trained.peer.network
    code = _code(network, trained.params, points[0], mask[0])
    seen = cloud - origin[0]
    low, high = seen.min(axis=0), seen.max(axis=0)
    middle, edge = (low + high) / 2, max(float((high - low).max()), 1e-6)

    def values(lattice: Lattice) -> Float[np.ndarray, "i j k"]:
        at = (lattice.corners() + middle).astype(np.float32)
        padded = np.pad(at, ((0, -len(at) % CHUNK), (0, 0)))
        parts = [_field(network, trained.params, code, jnp.asarray(p)) for p in padded.reshape(-1, CHUNK, 3)]
        return np.concatenate([np.asarray(p) for p in parts])[: len(at)].reshape(lattice.shape)

    coarse = cube(COARSE, REACH * edge)
    held = np.argwhere(values(coarse) > LEVEL)
    if not len(held):
        return None
    fine = around(coarse, held)
    return closed_surface(values(fine), fine, middle + origin[0])


def around(coarse: Lattice, held: np.ndarray) -> Lattice:
    """A cube of `FINE` cells a side around corners of a coarse lattice, with a ring of its cells."""
    low, high = coarse.at(held.min(axis=0) - RING), coarse.at(held.max(axis=0) + RING)
    half = float((high - low).max()) / 2
    return Lattice((low + high) / 2 - half, 2 * half / FINE, (FINE + 1,) * 3)


def closed_surface(
    values: Float[np.ndarray, "i j k"], lattice: Lattice, shift: Float[np.ndarray, "3"]
) -> Mesh | None:
    """Marching cubes of logits, higher inside, with a ring of outside around them."""
    if not (values > LEVEL).any():
        return None
    below = LEVEL - values
    outside = np.pad(below, 1, constant_values=max(float(below.max()), 1e-3))
    vertices, faces, _, _ = marching_cubes(outside, 0.0, gradient_direction="descent")
    return Mesh(vertices=lattice.at(vertices - 1) + shift, faces=faces.astype(np.int64))
