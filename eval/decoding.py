"""How a query should meet the code: the paper's decoding study, encoder and decoder trained together for each.

`python -m eval.decoding --shards train/shapes/infinigen.npz train/shapes/open.npz --out runs/decoding`

Every decoder starts with an encoder of the same random weights, sees the same batches in the same order for equal
steps, and is then asked for shapes that no training saw: error of distances at uniform queries and near the surface,
right signs, intersection over union, and the Chamfer distance of the mesh. A run that was stopped goes on where it was.

The true surface is the points of all depth views, since packed shapes have no meshes; distances to it cannot be less
than those of one half of the points to the other, which is a row of its own.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from jaxtyping import Array, Float
from rich.console import Console
from rich.progress import track
from scipy.spatial import KDTree
from skimage.measure import marching_cubes

from eval.harness.results import circumstances_now
from eval.harness.run_folder import RunFolder, claim, write_json
from eval.harness.tables import latex, markdown, on_screen
from eval.peers.decoder_training import Study, Weights, distances, trained
from eval.peers.learned_decoders import VARIANTS, Variant
from eval.prior_scores import see_twice
from eval.scores.figures import Figure, Record, rows_of
from eval.scores.mesh_scores import surface_points, volume_iou
from more2_jax.config import PriorConfig, load_config
from more2_jax.geometry.points import farthest_points
from more2_jax.meshing.grid import Grid, Lattice, cube
from more2_jax.network.prior import Prior, encode_ordered
from more2_jax.network.row_map import in_blocks
from train.run.batches import resident
from train.run.devices import device_mesh
from train.run.program import run
from train.run.settings import TrainingRun
from train.run.shape_mix import open_mix
from train.run.start import started_cold
from train.shards.signed_distance import BOX

TRUTH = "the true points, one half against the other"
SAMPLES = 20_000  # on each mesh
NOISE = 0.005  # of every coordinate of the clouds scored, a standard deviation; canonical units
SEED = 0  # of those clouds
ERROR = Figure(
    name="L1 of uniform queries", key="uniform", statistic="mean", unit="10⁻³", scale=1000, better="lower"
)
SIGN = Figure(name="sign", key="sign", statistic="mean", unit="%", scale=100)
FIGURES = [
    ERROR,
    dataclasses.replace(ERROR, name="L1 near the surface", key="near"),
    dataclasses.replace(ERROR, name="Chamfer-L1", key="chamfer"),
    dataclasses.replace(ERROR, name="Chamfer-L1 at the observed level", key="chamfer_observed"),
    dataclasses.replace(SIGN, name="IoU", key="iou"),
    SIGN,
]


def main(
    shards: tuple[Path, ...],
    out: Path,
    val_shards: tuple[Path, ...] = (),
    config: Path = Path("configs/decoding.yaml"),
    steps: int = 0,
    minutes: float = math.inf,
    views: tuple[int, ...] = (3,),
    split: str = "val",
    resolution: int = 32,
    most: int | None = None,
) -> None:
    """Trains an encoder with each decoder of the study and scores them.

    Args:
        shards: folders that `python -m train.prepare` wrote, or files of `train.tools.pack`; one that is named twice is
            drawn from twice as often.
        out: checkpoints, and a folder for the results of every number of views.
        val_shards: of the shapes scored; by default `shards`.
        config: YAML with `model` and `training`, as `train.prior` reads it.
        steps: of Adam, for every decoder; by default the configuration's.
        minutes: of training; a run that needs more goes on when the command is given again.
        views: numbers of depth images that a cloud is merged from.
        split: `test` for the final figure; `val` while choosing.
        resolution: cells of the meshes' grid, a side.
        most: score no more shapes than this.
    """
    study = opened(settings_of(config, steps), shards, out / "training")
    weights, done = trained(study, time.monotonic() + 60 * minutes)
    shapes = [view[k] for view in open_mix(val_shards or shards, split).views for k in range(len(view))]
    for number in views:
        stated = {"prior": config.stem, "steps": done, "views": number, "resolution": resolution}
        stated |= {"data": {"dataset": f"shapes of split {split}", "regime": f"{number} views, {done} steps"}}
        folder = opened_folder(out / f"{number}_views", stated, shapes[:most])
        score(folder, study.start.config, weights, shapes)


def settings_of(config: Path, steps: int) -> TrainingRun:
    """The configuration, with another number of steps if it is not 0."""
    settings = load_config(config, TrainingRun)
    training = dataclasses.replace(settings.training, steps=steps or settings.training.steps)
    return dataclasses.replace(settings, training=training)


def score(
    folder: RunFolder,
    config: PriorConfig,
    weights: Mapping[str, Weights],
    shapes: Sequence[Mapping[str, np.ndarray]],
) -> None:
    """Records of every shape that has none yet, then tables."""
    told = folder.settings
    number = told["views"]
    for name in track(folder.missing(), description=f"{number} views"):
        shape = shapes[int(name)]
        rng = np.random.default_rng((SEED, number, int(name)))
        seen = see_twice(shape, number, len(shape["sdf_uniform"]), NOISE, rng)
        write_json(folder.file(name), shape_records(config, weights, seen, shape, told["resolution"]))
    write(folder)


def opened(settings: TrainingRun, shards: tuple[Path, ...], out: Path) -> Study:
    """Training shapes in memory, and the random weights that every encoder starts with.

    Raises ValueError if `out` is of other shapes or settings; the number of steps may differ.
    """
    training = repr(dataclasses.replace(settings.training, steps=0))
    stated = {"shards": [str(s) for s in shards], "model": repr(settings.model), "training": training}
    claim(out, stated, fresh=False)
    mix, mesh = open_mix(shards, "train"), device_mesh(settings.training.batch)
    return Study(
        training=settings.training,
        start=started_cold(settings, mix, "decoding"),
        batches=resident(mix, settings.training, mesh),
        mesh=mesh,
        out=out,
    )


def opened_folder(out: Path, stated: dict[str, Any], shapes: list[Any]) -> RunFolder:
    """Where the records of every shape lie; those of other settings, as of fewer steps, are forgotten."""
    stated = {"program": "decoding", "masks": "true", "preset": "paper", "weights": "trained here"} | stated
    stated["data"] = {"digest": "–"} | stated.get("data", {})
    claim(out, stated, fresh=True)
    names = tuple(f"{k:04}" for k in range(len(shapes)))
    return RunFolder(out=out, names=names, settings=stated, right_deg=0.0)


def shape_records(
    config: PriorConfig,
    weights: Mapping[str, Weights],
    seen: Mapping[str, np.ndarray],
    shape: Mapping[str, np.ndarray],
    resolution: int,
) -> list[Record]:
    """A record a decoder, and one of the true points against themselves."""
    surface = np.asarray(shape["views"], np.float64).reshape(-1, 3)
    halves = np.array_split(np.random.default_rng(0).permutation(surface), 2)
    lattice = cube(resolution, BOX)
    asked = [seen["near"][:, :3], seen["uniform"][:, :3], seen["clouds"][0]]
    asked.append(lattice.corners() @ seen["rotation"][0].T)
    queries, ends = np.concatenate(asked).astype(np.float32), np.cumsum([len(a) for a in asked])[:-1]
    found: list[Record] = [
        {"method": TRUTH, "chamfer": chamfer(*halves), "chamfer_observed": chamfer(*halves)}
    ]
    for name, variant in VARIANTS.items():
        cloud = seen["clouds"][0].astype(np.float32)
        values = np.asarray(answered(weights[name], cloud, queries, variant=variant, config=config))
        near, uniform, observed, grid = np.split(values, ends)
        grid, level = grid.reshape(lattice.shape), float(np.median(observed))
        scores = field_scores(near, seen["near"][:, 3], uniform, seen["uniform"][:, 3])
        scores["chamfer"] = mesh_chamfer(grid, lattice, surface)
        scores["chamfer_observed"] = mesh_chamfer(grid - level, lattice, surface)
        found.append({"method": name} | scores)
    return found


@partial(jax.jit, static_argnames=("variant", "config"))
def answered(
    weights: Weights,
    cloud: Float[Array, "n 3"],
    queries: Float[Array, "q 3"],
    *,
    variant: Variant,
    config: PriorConfig,
) -> Float[Array, " q"]:
    """The distances at `queries` that the code of a cloud says."""
    real = jnp.ones(len(cloud), bool)
    points, mask = farthest_points(cloud, real, config.encoder.points)
    code = encode_ordered(Prior(params=dict(weights), config=config), points, mask)
    return in_blocks(partial(distances, config, variant, weights, code), queries)


def field_scores(
    near: Float[np.ndarray, " n"],
    near_truth: Float[np.ndarray, " n"],
    uniform: Float[np.ndarray, " u"],
    uniform_truth: Float[np.ndarray, " u"],
) -> dict[str, float | None]:
    """Mean error of distances at both kinds of queries, share of right signs near the surface, and overlap."""
    return {
        "uniform": float(np.abs(uniform - uniform_truth).mean()),
        "near": float(np.abs(near - near_truth).mean()),
        "sign": float(((near < 0) == (near_truth < 0)).mean()),
        "iou": volume_iou(uniform < 0, uniform_truth < 0),
    }


def mesh_chamfer(values: Grid, lattice: Lattice, surface: Float[np.ndarray, "p 3"]) -> float | None:
    """Chamfer-L1 between points of the zero level, closed at the box, and the true ones; None if there is no level."""
    if not (values < 0).any() or not (values > 0).any():
        return None
    padded = np.pad(values, 1, constant_values=max(float(values.max()), lattice.step))
    vertices, faces, _, _ = marching_cubes(padded, 0.0, gradient_direction="descent")
    mesh = trimesh.Trimesh(lattice.at(vertices - 1), faces, process=False)
    return chamfer(surface_points(mesh, SAMPLES), surface)


def chamfer(one: Float[np.ndarray, "n 3"], other: Float[np.ndarray, "m 3"]) -> float:
    """(accuracy + completeness) / 2: mean distances to the nearest point of the other cloud."""
    return float(KDTree(other).query(one)[0].mean() + KDTree(one).query(other)[0].mean()) / 2


def write(folder: RunFolder) -> None:
    """results.json and tables, as the other programs leave them; prints the main one."""
    records, settings = folder.records(), folder.settings
    rows = rows_of(FIGURES, records)
    content = circumstances_now() | {"scenes_asked": len(records), "settings": settings}
    write_json(folder.out / "results.json", content | {"rows": [dataclasses.asdict(r) for r in rows]})
    title = f"decoding, {settings['data']['regime']}"
    (folder.out / "tables.md").write_text(markdown(rows, title), encoding="utf-8")
    (folder.out / "tables.tex").write_text(latex(rows, title), encoding="utf-8")
    Console().print(on_screen(rows, title))


if __name__ == "__main__":
    run(main)
