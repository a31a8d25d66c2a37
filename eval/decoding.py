"""How a query should meet the code: the paper's decoding study, on shapes that no training saw.

`python -m eval.decoding --shards data/real data/procedural --out runs/decoding`

Every decoder is trained for the same steps on the same batches, on the frozen codes of one encoder, and then asked
for shapes of another split: share of right signs near the surface, intersection over union, error of the distance.
"""

from __future__ import annotations

import dataclasses
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float
from rich.console import Console
from rich.progress import track

from eval.harness.results import circumstances_now
from eval.harness.run_folder import write_json
from eval.harness.runs import weights_digest
from eval.harness.tables import latex, markdown, on_screen
from eval.peers.learned_decoders import VARIANTS, decoder_of, decoder_step, drawn, optimizer, start
from eval.prior_scores import BATCH, SEEN, see_twice
from eval.scores.figures import Figure, Record, rows_of
from more2_jax.config import load_config
from more2_jax.geometry.points import farthest_points
from more2_jax.network.prior import (
    Prior,
    encode_ordered,
    field_sdf,
    load_prior,
    object_field,
    points_read,
)
from train.run.program import run
from train.run.settings import TrainingConfig, TrainingRun
from train.run.shape_mix import load_mix
from train.shards.shards import open_shards

OWN = "as shipped: inner, DeepSDF, look-up, trained longer"
SIGN = Figure(name="sign near the surface", key="sign", statistic="mean", unit="%", scale=100)
FIGURES = [
    dataclasses.replace(SIGN, name="IoU", key="iou"),
    SIGN,
    dataclasses.replace(
        SIGN,
        name="error of the distance near the surface",
        key="error",
        unit="10⁻³",
        scale=1000,
        better="lower",
    ),
]


def main(
    shards: tuple[Path, ...],
    out: Path,
    prior: str = "small",
    config: Path = Path("configs/small.yaml"),
    steps: int = 600,
    learning_rate: float = 1e-3,
    views: tuple[int, ...] = (3, 1),
    split: str = "test",
    points: int = 20_000,
    noise: float = 0.005,
    most: int | None = None,
    seed: int = 0,
) -> None:
    """Trains the decoders of the study and scores them.

    Args:
        shards: folders that `python -m train.prepare` wrote; one that is named twice is drawn from twice as often.
        out: a folder for the results of every number of views.
        prior: whose encoder is used: name of shipped weights, or a file.
        config: YAML whose `training` says how shapes are sampled.
        steps: of Adam, for every decoder.
        learning_rate: at the first step; falls as a cosine.
        views: numbers of depth images that a cloud is merged from.
        split: `test` for the final figure; `val` while choosing.
        points: uniform in the unit cube, for the intersection over union.
        noise: standard deviation of every coordinate, canonical units.
        most: score no more shapes than this.
        seed: of the decoders' weights and of the clouds scored.
    """
    own, training = load_prior(prior), load_config(config, TrainingRun).training
    weights = trained(own, shards, training, steps, learning_rate, seed)
    stated = {"program": "decoding", "prior": prior, "weights": weights_digest(own)}
    stated |= {"preset": "paper", "masks": "true"}
    for number in views:
        records = scored(own, weights, shards, split, number, points, noise, most, seed)
        facts = {"dataset": f"shapes of split {split}", "regime": f"{number} views", "digest": "–"}
        write(out / f"{number}_views", stated | {"data": facts, "steps": steps, "views": number}, records)


def trained(
    prior: Prior, shards: tuple[Path, ...], training: TrainingConfig, steps: int, rate: float, seed: int
) -> dict[str, Any]:
    """Weights of every variant after `steps`."""
    shapes, rows = load_mix(shards, "train")
    codes = encode_ordered(
        prior, jnp.zeros((points_read(prior.config), 3)), jnp.ones(points_read(prior.config), bool)
    )
    weights = start(prior, codes, seed)
    states: dict[str, Any] = {name: optimizer(steps, rate).init(w) for name, w in weights.items()}
    here, size = jnp.asarray(rows), points_read(prior.config)
    for number in track(range(steps), description="training"):
        sample, _ = drawn(shapes, here, jnp.asarray(number), config=training, points=size)
        weights, states, losses = decoder_step(
            weights, states, prior, sample, config=training, steps=steps, learning_rate=rate
        )
        if number % 100 == 99:
            Console().print(number + 1, {k: round(float(v), 4) for k, v in losses.items()}, highlight=False)
    return weights


def scored(
    prior: Prior,
    weights: dict[str, Any],
    shards: tuple[Path, ...],
    split: str,
    views: int,
    points: int,
    noise: float,
    most: int | None,
    seed: int,
) -> dict[str, list[Record]]:
    """A record a shape and decoder."""
    shapes, found = open_shards(tuple(dict.fromkeys(shards)), split), {}
    count = min(len(shapes), most or len(shapes))
    for begin in track(range(0, count, BATCH), description=f"{views} views"):
        index = [min(k, count - 1) for k in range(begin, begin + BATCH)]  # fillers repeat the last
        seen = [
            see_twice(shapes[k], views, points, noise, np.random.default_rng((seed, views, k))) for k in index
        ]
        batch = (np.stack([s[name] for s in seen]) for name in SEEN)
        scores = jax.device_get(score_batch(prior, weights, *batch))
        for k, n in enumerate(index[: count - begin]):
            meta = shapes.meta[n]
            found[meta["name"]] = [
                {"method": m, "category": meta["category"]} | {key: float(v[k]) for key, v in s.items()}
                for m, s in scores.items()
            ]
    return found


@jax.jit
def score_batch(
    prior: Prior,
    weights: dict[str, Any],
    clouds: Float[Array, "b 2 n 3"],
    near: Float[Array, "b q 4"],
    uniform: Float[Array, "b u 4"],
) -> dict[str, dict[str, Array]]:
    """The scores of every decoder for the first cloud of each shape."""

    def one(cloud: Array, near: Array, uniform: Array) -> dict[str, dict[str, Array]]:
        real = jnp.ones(len(cloud), bool)
        code = encode_ordered(prior, *farthest_points(cloud, real, points_read(prior.config)))
        fields = {
            name: partial(decoder_of(prior, v).apply, weights[name], code) for name, v in VARIANTS.items()
        } | {OWN: partial(field_sdf, prior, object_field(prior, code))}
        return {name: scores_of(field, near, uniform, name) for name, field in fields.items()}

    # One after the other: twenty thousand queries of one shape fill the processor.
    return jax.lax.map(lambda x: one(*x), (clouds[:, 0], near, uniform))


def scores_of(
    field: Any, near: Float[Array, "q 4"], uniform: Float[Array, "u 4"], name: str
) -> dict[str, Array]:
    """Share of right signs, intersection over union and, of a distance, its mean error."""
    value, inside, truth = field(near[:, :3]), field(uniform[:, :3]) < 0, uniform[:, 3] < 0
    scores = {
        "sign": ((value < 0) == (near[:, 3] < 0)).mean(),
        "iou": (inside & truth).sum() / jnp.maximum((inside | truth).sum(), 1),
    }
    if name == OWN or VARIANTS[name].learns == "distance":
        scores["error"] = jnp.abs(value - near[:, 3]).mean()
    return scores


def write(out: Path, settings: dict[str, Any], records: dict[str, list[Record]]) -> None:
    """results.json and tables, as the other programs leave them; prints the main one."""
    out.mkdir(parents=True, exist_ok=True)
    rows = rows_of(FIGURES, records, ("category",))
    content = circumstances_now() | {"scenes_asked": len(records), "settings": settings}
    write_json(out / "results.json", content | {"rows": [dataclasses.asdict(r) for r in rows]})
    title = f"decoding, {settings['data']['regime']}"
    (out / "tables.md").write_text(markdown(rows, title), encoding="utf-8")
    (out / "tables.tex").write_text(latex(rows, title), encoding="utf-8")
    Console().print(on_screen([r for r in rows if r.group == "all"], title))


if __name__ == "__main__":
    run(main)
