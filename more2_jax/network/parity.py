"""Proof that a converted checkpoint computes what the published layers do, by a file of their inputs and outputs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from more2_jax.geometry.points import farthest_points
from more2_jax.network.encoder import neighbor_counts
from more2_jax.network.prior import Prior, encode_ordered, sdf_one
from more2_jax.network.published_weights import PREFIX, prior_from_published
from more2_jax.network.torch_checkpoint import DAMAGED
from more2_jax.types import Embedding

WEIGHTS = "w/"  # prefix of weights inside a reference file
OUTPUTS = ("F_inv", "F_eqv", "F_s", "F_c", "sdf")


def read_reference(path: str | Path) -> dict[str, np.ndarray]:
    """Reads a reference: inputs and outputs of the published layers, perhaps with the weights under `w/…`.

    Arrays are points (b, n, 3), queries (b, q, 3), F_inv (b, c), F_eqv (b, c, 3), F_s (b,), F_c (b, 3) and
    sdf (b, q). Raises ValueError for a file that is not of this layout.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    except DAMAGED as error:
        raise ValueError(f"{path}: not a readable NPZ file ({' '.join(str(error).split())})") from error
    _check_reference(arrays, str(path))
    return arrays


def _check_reference(reference: Mapping[str, np.ndarray], where: str) -> None:
    if missing := [name for name in ("points", "queries", *OUTPUTS) if name not in reference]:
        raise ValueError(
            f"{where}: no array {', '.join(missing)}; needed points, queries, {', '.join(OUTPUTS)}"
        )
    shapes = {name: reference[name].shape for name in ("points", "queries", *OUTPUTS)}
    if len(shapes["points"]) != 3 or len(shapes["queries"]) != 3 or len(shapes["F_inv"]) != 2:
        raise ValueError(
            f"{where}: got shapes {shapes}; needed points (b, n, 3), queries (b, q, 3), F_inv (b, c)"
        )
    (b, n, _), q, c = shapes["points"], shapes["queries"][1], shapes["F_inv"][1]
    needed = {
        "points": (b, n, 3),
        "queries": (b, q, 3),
        "F_inv": (b, c),
        "F_eqv": (b, c, 3),
        "F_s": (b,),
        "F_c": (b, 3),
        "sdf": (b, q),
    }
    for name, shape in needed.items():
        if shapes[name] != shape:
            raise ValueError(f"{where}: {name} has shape {shapes[name]}; needed {shape}")


def weights_of_reference(reference: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The weights inside a reference, by their published names. Raises ValueError when it holds none."""
    weights = {k.removeprefix(WEIGHTS): v for k, v in reference.items() if k.startswith(f"{WEIGHTS}{PREFIX}")}
    if not weights:
        raise ValueError(f"the reference holds no weights {WEIGHTS}{PREFIX}…; needed a checkpoint beside it")
    return weights


def check_prior(weights: Mapping[str, np.ndarray], reference: Mapping[str, np.ndarray]) -> dict[str, float]:
    """Runs published weights on a reference's points and queries and compares with its outputs.

    Points enter as they are: no farthest-point sampling to another size. Returns for F_inv, F_eqv, F_s, F_c
    and sdf the largest deviation relative to the array's largest value, computed in float32; 1e-5 or less
    proves a conversion right. F_c is a place, small where clouds are centered: what rounding leaves of it is measured
    by the largest F_s. Raises ValueError on weights or a reference that do not fit.
    """
    _check_reference(reference, "the reference")
    prior = prior_from_published(weights, "checked")
    points = jnp.asarray(reference["points"], jnp.float32)
    encoder = prior.config.encoder
    if (least := min(neighbor_counts(encoder, points.shape[1]))) < encoder.neighbors:
        raise ValueError(
            f"{points.shape[1]} reference points leave a block {least}; needed {encoder.neighbors} or more"
        )
    embedding, distance = _run(prior, points, jnp.asarray(reference["queries"], jnp.float32))
    ours = {
        "F_inv": embedding.inv,
        "F_eqv": embedding.eqv.swapaxes(-1, -2),
        "F_s": embedding.scale,
        "F_c": embedding.center,
        "sdf": distance,
    }
    unit = {name: float(np.abs(reference[name]).max()) for name in OUTPUTS}
    unit["F_c"] = max(unit["F_c"], unit["F_s"])
    return {name: _deviation(name, np.asarray(ours[name]), reference[name], unit[name]) for name in OUTPUTS}


@jax.jit
def _run(
    prior: Prior, points: Float[Array, "b n 3"], queries: Float[Array, "b q 3"]
) -> tuple[Embedding, Float[Array, "b q"]]:
    def one(
        points: Float[Array, "n 3"], queries: Float[Array, "q 3"]
    ) -> tuple[Embedding, Float[Array, " q"]]:
        ordered = farthest_points(points, jnp.ones(len(points), bool), len(points))
        embedding = encode_ordered(prior, *ordered)
        return embedding, sdf_one(prior, embedding, queries)

    return jax.vmap(one)(points, queries)


def _deviation(name: str, ours: np.ndarray, reference: np.ndarray, unit: float) -> float:
    if ours.shape != reference.shape:
        raise ValueError(f"{name} of these weights has shape {ours.shape}; the reference's {reference.shape}")
    return float(np.abs(ours.astype(np.float64) - reference).max() / unit) if unit > 0 else float("inf")
