"""What a prior knows of shapes from sources that no training used: sign, overlap, orientation, identity.

`python -m eval.prior_scores --prior small --shards data/shards --out runs/prior_scores`

Every shape is seen twice, each time from other viewpoints, with noise and in a random orientation. Nothing but the
codes decides: no other starts, no geometry, no size.

`--debiased` gives nothing of the true center and size away (as SIMECO, NeurIPS 2025, asks of completion): every cloud
lies elsewhere and has another unit, distances count in the size that the codes say, and what is filled outside the
box about the true shape counts as wrong.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float
from rich.console import Console
from rich.progress import track
from rich.table import Table
from scipy.spatial.transform import Rotation

from eval.scores.figures import mean_ci95
from more2_jax.config import CodeMatcher
from more2_jax.geometry.points import kabsch_rotation
from more2_jax.matching.code_assignment import hungarian, score_matrix
from more2_jax.metrics import symmetry_aware_rotation_error_deg
from more2_jax.network.prior import Prior, encode_one, field_sdf, load_prior, object_field
from more2_jax.types import Embedding
from train.furniture.symmetry import yaw_symmetry
from train.run.program import run
from train.shards.shards import ShardView, open_shards, read_solids, shard_folders
from train.shards.signed_distance import BOX

BATCH = 8
RIGHT_DEG = 10.0
NEAR = 4096  # queries near the surface, for the sign
TILT_DEG, INWARD = 10.0, 0.05  # of normals: as training has them
VERTICAL = np.array([0.0, 0.0, 1.0])
UNITS, SHIFT = (
    (0.1, 10.0),
    2.0,
)  # of debiased clouds: canonical units in theirs, and how far off, canonical units
WIDER = 2.0  # edge of the box in which debiased overlap counts, in edges of the box of the queries


@dataclass(frozen=True)
class Row:
    """Scores of one shape, seen twice."""

    category: str
    near_sign: float
    iou: float
    rotation_deg: float
    near_error: float  # mean error of the distance near the surface, in units of F_s
    true_error: float  # the same in true canonical units, so that an error of F_s counts, too
    wide_iou: float  # overlap in the wide box; NaN where it is not asked for


def main(
    shards: tuple[Path, ...],
    out: Path,
    prior: str = "small",
    split: str = "test",
    views: tuple[int, ...] = (3, 2, 1),
    points: int = 50_000,
    noise: float = 0.005,
    normals: bool = True,
    debiased: bool = False,
    scenes: int = 400,
    most: int | None = None,
    seed: int = 0,
) -> None:
    """Scores a prior on every shape of a split.

    Args:
        shards: folders that `python -m train.prepare` wrote.
        out: folder for results.json.
        prior: name of shipped weights, or a file.
        split: `test` for the final figure; `val` while choosing.
        views: numbers of depth images that a cloud is merged from.
        points: uniform in the unit cube, for the intersection over union.
        noise: standard deviation of every coordinate, canonical units.
        normals: given where the prior looks them up, tilted and some of them inward; otherwise none are known.
        debiased: also score without anything of the true center and size.
        scenes: of 4 to 8 shapes, for matching.
        most: score no more shapes than this.
        seed: of viewpoints, noise, orientations and scenes.
    """
    weights, shapes = load_prior(prior), open_shards(shards, split)
    orders = symmetries(shards, [m["name"] for m in shapes.meta[:most]])
    results: dict[str, Any] = {"prior": weights.name, "split": split, "shapes": len(orders)}
    for number in views:
        seeing = partial(see_twice, views=number, points=points, noise=noise)
        rows, codes = score_shapes(weights, shapes, orders, seeing, normals, debiased, (seed, number))
        results[f"{number} views"] = summary(rows, debiased) | matching(codes, scenes, seed)
    out.mkdir(parents=True, exist_ok=True)
    (out / "results.json").write_text(json.dumps(results, indent=1))
    Console().print(table(results))


def symmetries(folders: Sequence[Path], names: Sequence[str]) -> list[int]:
    """Order of the symmetry about the vertical of the shapes called `names` (see `yaw_symmetry`)."""
    wanted = frozenset(names)
    every = (s for folder in folders for shard in shard_folders(folder) for s in read_solids(shard))
    solids = {s.name: s for s in every if s.name in wanted}
    chosen = (solids[name] for name in track(names, description="symmetries"))
    return [yaw_symmetry(s.vertices, s.faces) for s in chosen]


Seeing = Callable[..., dict[str, np.ndarray]]  # of a shape and a generator, as `see_twice`


def score_shapes(
    prior: Prior,
    shapes: ShardView,
    orders: Sequence[int],
    see: Seeing,
    normals: bool,
    debiased: bool,
    seed: tuple[int, ...],
) -> tuple[list[Row], Embedding]:
    """A row for each of the first shapes, as many as `orders`, and the codes of both clouds (shapes, 2, …)."""
    rows, codes, count = [], [], len(orders)
    for start in track(range(0, count, BATCH), description="shapes"):
        index = [min(k, count - 1) for k in range(start, start + BATCH)]  # fillers repeat the last
        seen = []
        for k in index:
            rng = np.random.default_rng((*seed, k))
            seen.append(elsewhere(see(shapes[k], rng=rng), rng, debiased))
        batch = {name: np.stack([s[name] for s in seen]) for name in (*SEEN, "normals", "beyond", "unit")}
        batch["normals"] = normals * batch["normals"]
        embedding, scores, turn = jax.device_get(score_batch(prior, batch))
        codes.append(embedding)
        for k, n in enumerate(index[: count - start]):
            turned = rotation_error(turn[k], seen[k]["rotation"], orders[n])
            found = {name: float(value[k]) for name, value in scores.items()}
            rows.append(Row(category=shapes.meta[n]["category"], rotation_deg=turned, **found))
    return rows, jax.tree.map(lambda *x: np.concatenate(x)[:count], *codes)


SEEN = ("clouds", "near", "uniform")


def see_twice(
    shape: Mapping[str, np.ndarray], views: int, points: int, noise: float, rng: np.random.Generator
) -> dict[str, np.ndarray]:
    """Two clouds in random orientations; queries and true distances in the first one's frame."""
    (of_normals,) = rng.spawn(1)  # clouds are the same with normals and without
    rotation = Rotation.from_quat(rng.normal(size=(2, 4))).as_matrix()
    clouds, normals = [], []
    for R in rotation:
        chosen = rng.choice(len(shape["views"]), views, replace=False)
        merged = np.asarray(shape["views"][chosen], np.float64).reshape(-1, 3)
        order = rng.permutation(len(merged))
        clouds.append((merged[order] + noise * rng.normal(size=merged.shape)) @ R.T)
        outward = np.asarray(shape["normals"][chosen], np.float64).reshape(-1, 3)[order]
        normals.append(flawed(outward, of_normals) @ R.T)
    known = {"near": shape["sdf_near"][:NEAR], "uniform": shape["sdf_uniform"][:points]}
    turned = {
        k: np.concatenate([v[:, :3].astype(np.float64) @ rotation[0].T, v[:, 3:]], axis=1)
        for k, v in known.items()
    }
    return {"clouds": np.stack(clouds), "normals": np.stack(normals), "rotation": rotation} | turned


def flawed(normals: Float[np.ndarray, "n 3"], rng: np.random.Generator) -> Float[np.ndarray, "n 3"]:
    """Unit normals, tilted by `TILT_DEG` each of two ways, `INWARD` of them pointing inward; zeros stay."""
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    tilted = normals / np.maximum(length, 1e-9) + np.deg2rad(TILT_DEG) * rng.normal(size=normals.shape)
    sign = np.where(rng.random((len(normals), 1)) < INWARD, -1.0, 1.0)
    return np.where(length > 0, sign * tilted / np.linalg.norm(tilted, axis=1, keepdims=True), 0.0)


def elsewhere(
    seen: Mapping[str, np.ndarray], rng: np.random.Generator, debiased: bool
) -> dict[str, np.ndarray]:
    """The same views in a unit and a place of their own, with queries of the wide box outside the usual one.

    Not debiased: as they are, and without such queries.
    """
    if not debiased:
        return dict(seen) | {"unit": np.float64(1.0), "beyond": np.zeros((0, 3))}
    unit, shift = np.exp(rng.uniform(*np.log(UNITS))), rng.uniform(-SHIFT, SHIFT, 3)
    wide = WIDER * rng.uniform(-BOX, BOX, (2 * len(seen["uniform"]), 3))  # an eighth lies in the usual box
    wide = wide[np.abs(wide).max(axis=1) > BOX][: len(seen["uniform"])]
    moved = {k: np.concatenate([unit * (seen[k][:, :3] + shift), seen[k][:, 3:]], axis=1) for k in SEEN[1:]}
    beyond = unit * (wide @ seen["rotation"][0].T + shift)
    return dict(seen) | moved | {"clouds": unit * (seen["clouds"] + shift), "beyond": beyond, "unit": unit}


@jax.jit
def score_batch(
    prior: Prior, batch: Mapping[str, Float[Array, "b ..."]]
) -> tuple[Embedding, dict[str, Float[Array, " b"]], Float[Array, "b 3 3"]]:
    """Codes, what a `Row` says of the field, and the rotation between the clouds (Kabsch)."""

    def encode(points: Float[Array, "n 3"], normals: Float[Array, "n 3"]) -> Embedding:
        return encode_one(prior, points, jnp.ones(len(points), bool), normals)

    def one(x: Mapping[str, Array]) -> tuple[Embedding, dict[str, Array], Array]:
        codes = jax.vmap(encode)(x["clouds"], x["normals"])
        field = object_field(prior, jax.tree.map(lambda c: c[0], codes))
        scores = field_scores(partial(field_sdf, prior, field), field.scale, x)
        return codes, scores, kabsch_rotation(codes.eqv[0].T, codes.eqv[1].T).as_matrix()

    # One after the other: fifty thousand queries of one shape fill the processor.
    return jax.lax.map(one, dict(batch))


def field_scores(
    field: Callable[[Float[Array, "n 3"]], Float[Array, " n"]],
    scale: Float[Array, ""],
    asked: Mapping[str, Array],
) -> dict[str, Float[Array, ""]]:
    """What a `Row` says of a field, of which `scale` is F_s: see `elsewhere` for the queries."""
    distance, truth = field(asked["near"][:, :3]), asked["near"][:, 3]
    inside, solid = field(asked["uniform"][:, :3]) < 0, asked["uniform"][:, 3] < 0
    common, union = (inside & solid).sum(), jnp.maximum((inside | solid).sum(), 1)
    spilled = jnp.full((), jnp.nan)  # queries of the usual box that would fill the volume filled outside it
    if len(asked["beyond"]):
        spilled = (field(asked["beyond"]) < 0).mean() * len(inside) * (WIDER**3 - 1)
    return {
        "near_sign": ((distance < 0) == (truth < 0)).mean(),
        "iou": common / union,
        "near_error": jnp.abs(distance - truth).mean(),
        "true_error": jnp.abs(distance * scale / asked["unit"] - truth).mean(),
        "wide_iou": common / (union + spilled),
    }


def rotation_error(R: np.ndarray, true: Float[np.ndarray, "2 3 3"], order: int) -> float:
    """Degrees between the rotation found and the true one, up to the shape's symmetry about its vertical."""
    return symmetry_aware_rotation_error_deg(R, true[1] @ true[0].T, true[0] @ VERTICAL, order)


@partial(jax.jit, static_argnames="config")
def matched(codes: Embedding, real: Bool[Array, " n"], config: CodeMatcher) -> Bool[Array, " n"]:
    """Which of a scene's objects the assignment on H = Λ ⊘ E takes to themselves."""
    source, target = (jax.tree.map(lambda x, i=i: x[:, i], codes) for i in (0, 1))
    partner, _ = hungarian(score_matrix(source, target, config), real[:, None] & real[None])
    return (partner == jnp.arange(len(real))) & real


def matching(codes: Embedding, scenes: int, seed: int) -> dict[str, Any]:
    """Instance recall over scenes of 4 to 8 shapes; every object has its partner."""
    rng, right, of = np.random.default_rng(seed), [], []
    for _ in range(scenes):
        chosen = rng.choice(len(codes.scale), 8, replace=False)
        real = np.arange(8) < rng.integers(4, 9)
        scene = jax.tree.map(lambda x, c=chosen: x[c], codes)
        right.append(int(np.sum(matched(scene, real, CodeMatcher()))))
        of.append(int(real.sum()))
    share = np.array(right) / np.array(of)
    return {"instance recall": figure(share, np.sum(right) / np.sum(of))}


def summary(rows: Sequence[Row], debiased: bool = False) -> dict[str, Any]:
    """Means with their intervals, and the same by category."""
    values = {
        "near-surface sign": np.array([r.near_sign for r in rows]),
        "near-surface error": np.array([r.near_error for r in rows]),
        "near-surface error, true units": np.array([r.true_error for r in rows]),
        "IoU": np.array([r.iou for r in rows]),
        "IoU, wide box": np.array([r.wide_iou for r in rows]),
        "Kabsch, RE < 10°": np.array([r.rotation_deg < RIGHT_DEG for r in rows], float),
    }
    if not debiased:
        del values["near-surface error, true units"], values["IoU, wide box"]
    kinds = np.array([r.category for r in rows])
    by_kind = {
        kind: {name: round(float(v[kinds == kind].mean()), 4) for name, v in values.items()}
        | {"count": int((kinds == kind).sum())}
        for kind in sorted(set(kinds))
    }
    middle = float(np.median([r.rotation_deg for r in rows]))
    return {k: figure(v, float(v.mean())) for k, v in values.items()} | {
        "Kabsch, median RE (deg)": {"value": middle, "count": len(rows)},
        "by category": by_kind,
    }


def figure(values: Float[np.ndarray, " n"], value: float) -> dict[str, Any]:
    """One figure with its 95 % interval."""
    return {"value": float(value), "ci95": list(mean_ci95(values)), "count": len(values)}


def table(results: dict[str, Any]) -> Table:
    """A row a figure, a column a number of views."""
    columns = [k for k in results if k.endswith(" views")]
    shown = Table("figure", *columns)
    for name in results[columns[0]]:
        if name != "by category":
            shown.add_row(name, *(f"{results[c][name]['value']:.3f}" for c in columns))
    return shown


if __name__ == "__main__":
    run(main)
