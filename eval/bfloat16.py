"""What products in bfloat16 change: in a trained prior's codes and fields, and in the gradient that trains one.

`python -m eval.bfloat16 --prior small --shards data/shards --out runs/bfloat16`

Factors are rounded to bfloat16 and their products added in float32, as accelerators multiply where nothing else is
asked of them: in the decoder's hidden layers, in the encoder's linear ones, or in both. Rounding is the same on every
backend, so this runs anywhere. How much faster such products are is not asked here.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from unittest.mock import patch

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float
from rich.console import Console
from rich.progress import track

from eval.harness.results import write_rows
from eval.harness.tables import on_screen
from eval.prior_scores import RIGHT_DEG, field_scores, rotation_error, see_twice, symmetries
from eval.scores.figures import Row, mean_ci95
from more2_jax.geometry.points import kabsch_rotation
from more2_jax.network import decoder, vector_neurons
from more2_jax.network.decoder import bfloat16_product
from more2_jax.network.prior import Prior, encode_one, field_sdf, load_prior, object_field
from more2_jax.types import Embedding
from train.run.program import run
from train.shards.shards import open_shards

BATCH = 8
ROUNDED = {"float32": "", "decoder in bfloat16": "d", "encoder in bfloat16": "e", "both in bfloat16": "de"}
BETTER = {"error of distances": "lower", "change of distances": "lower", "change of slopes": "lower"}
Batch = Mapping[str, Float[np.ndarray, "b ..."]]
Gradient = Float[np.ndarray, " w"]  # of all weights, in one row


@contextmanager
def rounded(parts: str) -> Iterator[None]:
    """Within, what is traced multiplies in bfloat16: in the decoder ("d"), in the encoder ("e"), in both or neither."""
    if not parts:
        yield
        return
    jax.clear_caches()
    try:
        with (
            patch.object(decoder, "product", product if "d" in parts else decoder.product),
            patch.object(vector_neurons, "linear", product if "e" in parts else vector_neurons.linear),
        ):
            yield
    finally:
        jax.clear_caches()


def product(
    x: Float[Array, "*b i"], kernel: Float[Array, "i o"], _train: bool = False
) -> Float[Array, "*b o"]:
    """x @ kernel in bfloat16, added in float32, whether training or not."""
    rows = bfloat16_product(x.reshape(-1, x.shape[-1]), kernel)
    return rows.reshape(*x.shape[:-1], kernel.shape[-1])


def main(
    shards: tuple[Path, ...],
    out: Path,
    prior: str = "small",
    split: str = "test",
    views: int = 2,
    points: int = 20_000,
    noise: float = 0.005,
    most: int = 64,
    seed: int = 0,
) -> None:
    """Scores a prior on shapes of a split with every kind of rounding, and beside float32.

    Args:
        shards: folders that `python -m train.prepare` wrote.
        out: folder for results.json.
        prior: name of shipped weights, or a file.
        split: of the shards.
        views: depth images that a cloud is merged from.
        points: uniform in the unit cube, for the intersection over union.
        noise: standard deviation of every coordinate, canonical units.
        most: score no more shapes than this.
        seed: of viewpoints, noise and orientations.
    """
    weights, shapes = load_prior(prior), open_shards(shards, split)
    count = min(most, len(shapes)) // BATCH * BATCH
    if not count:
        raise ValueError(f"{len(shapes)} shapes in split {split!r}; needed {BATCH} or more")
    orders = symmetries(shards, [m["name"] for m in shapes.meta[:count]])
    generators = [np.random.default_rng((seed, k)) for k in range(count)]
    seen = [see_twice(shapes[k], views, points, noise, rng) for k, rng in enumerate(generators)]
    rows = rows_of_all(weights, seen, orders)
    write_rows(out, rows, program="bfloat16", prior=weights.name, shapes=count, views=views, split=split)
    Console().print(on_screen(rows, f"{weights.name}, {count} shapes, {views} views"))


def rows_of_all(prior: Prior, seen: Sequence[Mapping[str, np.ndarray]], orders: Sequence[int]) -> list[Row]:
    """The figures with every kind of rounding. `seen`: of `see_twice`; `orders`: of the shapes' symmetries."""
    rows, exact = [], None
    for name, parts in ROUNDED.items():
        with rounded(parts):
            batches = track(in_batches(seen), description=name)
            both = [(answered(prior, b), gradient_of(prior, b)) for b in batches]
        answers, gradients = [a for a, _ in both], [g for _, g in both]
        exact = exact or (answers, gradients)
        rows += [
            *field_rows(name, answers, exact[0], seen, orders),
            *gradient_rows(name, gradients, exact[1]),
        ]
    return rows


def in_batches(seen: Sequence[Mapping[str, np.ndarray]]) -> list[Batch]:
    """`BATCH` shapes each, stacked."""
    starts = range(0, len(seen), BATCH)
    return [{k: np.stack([s[k] for s in seen[b : b + BATCH]]) for k in seen[0]} for b in starts]


# --- one batch ---------------------------------------------------------------------------------------------


def answered(prior: Prior, batch: Batch) -> dict[str, np.ndarray]:
    """What the prior says of every shape: distances and slopes near its surface, scores, the clouds' rotation."""
    names = ("clouds", "normals", "near", "uniform")
    return jax.device_get(answers_of(prior, {k: jnp.asarray(batch[k], jnp.float32) for k in names}))


@jax.jit
def answers_of(prior: Prior, batch: Mapping[str, Array]) -> dict[str, Array]:
    """Of every shape, one after the other: the queries of one fill a processor."""

    def one(x: Mapping[str, Array]) -> dict[str, Array]:
        codes = jax.vmap(partial(encoded, prior))(x["clouds"], x["normals"])
        field = object_field(prior, jax.tree.map(lambda c: c[0], codes))
        distance = partial(field_sdf, prior, field)
        asked = {k: x[k] for k in ("near", "uniform")} | {"beyond": jnp.zeros((0, 3)), "unit": jnp.ones(())}
        near = x["near"][:, :3]
        return field_scores(distance, field.scale, asked) | {
            "distance": distance(near),
            "slope": jax.grad(lambda q: distance(q).sum())(near),
            "turn": kabsch_rotation(codes.eqv[0].T, codes.eqv[1].T).as_matrix(),
        }

    return jax.lax.map(one, dict(batch))


def encoded(prior: Prior, points: Float[Array, "n 3"], normals: Float[Array, "n 3"]) -> Embedding:
    """The code of one cloud without padding."""
    return encode_one(prior, points, jnp.ones(len(points), bool), normals)


def gradient_of(prior: Prior, batch: Batch) -> Gradient:
    """How a batch would have the weights change: of the mean error of distances near the surfaces (L1)."""
    few = {"clouds": batch["clouds"][:, 0], "normals": batch["normals"][:, 0], "near": batch["near"][:, ::8]}
    return np.asarray(l1_gradient(prior, jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), few)))


@jax.jit
def l1_gradient(prior: Prior, batch: Mapping[str, Array]) -> Float[Array, " w"]:
    """`batch`: a cloud of every shape, its normals, and queries with their true distances."""

    def loss(params: dict[str, object]) -> Array:
        trained = Prior(params=params, config=prior.config)

        def one(x: Mapping[str, Array]) -> Array:
            field = object_field(trained, encoded(trained, x["clouds"], x["normals"]))
            return jnp.abs(field_sdf(trained, field, x["near"][:, :3]) - x["near"][:, 3]).mean()

        return jax.lax.map(one, dict(batch)).mean()

    return jnp.concatenate([g.ravel() for g in jax.tree.leaves(jax.grad(loss)(prior.params))])


# --- figures -----------------------------------------------------------------------------------------------


def field_rows(
    method: str,
    answers: Sequence[dict[str, np.ndarray]],
    exact: Sequence[dict[str, np.ndarray]],
    seen: Sequence[Mapping[str, np.ndarray]],
    orders: Sequence[int],
) -> list[Row]:
    """Scores of the fields and codes, and how distances and slopes differ from those in float32, shape by shape."""
    every, true = ({k: np.concatenate([a[k] for a in one]) for k in one[0]} for one in (answers, exact))
    turns = [
        rotation_error(*x) for x in zip(every["turn"], [s["rotation"] for s in seen], orders, strict=True)
    ]
    change = np.abs(every["distance"] - true["distance"]).mean(axis=1) / np.abs(true["distance"]).mean(axis=1)
    values = {
        "sign": (100 * every["near_sign"], "%"),
        "error of distances": (1000 * every["near_error"], "10⁻³"),
        "overlap": (100 * every["iou"], "%"),
        "orientation": (100.0 * (np.array(turns) < RIGHT_DEG), "%"),
        "change of distances": (100 * change, "%"),
        "change of slopes": (np.median(angles(every["slope"], true["slope"]), axis=1), "deg"),
    }
    return [figure(name, method, v, unit) for name, (v, unit) in values.items()]


def angles(a: Float[np.ndarray, "*n 3"], b: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n"]:
    """Degrees between vectors."""
    across = np.linalg.norm(np.cross(a, b), axis=-1)
    return np.rad2deg(np.arctan2(across, np.einsum("...i,...i", a, b)))


def gradient_rows(method: str, gradients: Sequence[Gradient], exact: Sequence[Gradient]) -> list[Row]:
    """Cosines of the gradients with those in float32 of the same batch, and of another one."""
    same = [cosine(a, b) for a, b in zip(gradients, exact, strict=True)]
    other = [cosine(a, b) for a, b in zip(gradients, [*exact[1:], exact[0]], strict=True)]
    names = ("cosine of gradients", "cosine with another batch")
    return [figure(name, method, np.array(v), "") for name, v in zip(names, (same, other), strict=True)]


def cosine(a: Gradient, b: Gradient) -> float:
    return float(a @ b / (np.linalg.norm(a) * np.linalg.norm(b)))


def figure(name: str, method: str, values: Float[np.ndarray, " n"], unit: str) -> Row:
    """The mean of values with its 95 % interval."""
    return Row(
        name=name,
        method=method,
        value=float(values.mean()),
        unit=unit,
        column="",
        count=len(values),
        scenes=len(values),
        better=BETTER.get(name, "higher"),
        failures=0,
        ci95=mean_ci95(values),
        group="all",
    )


if __name__ == "__main__":
    run(main)
