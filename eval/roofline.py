"""Where the time goes: `python -m eval.roofline --out roofline.json`.

Every block of encoder and decoder, forward and with its gradient: operations and bytes by the compiler's count,
the median time, and the share of what this machine's measured peaks would allow: operations at the rate of a large
matrix product, bytes at the rate of a large copy, whichever takes longer. All rates are of processor time, summed over
threads: what else a shared machine does changes them little. On one core (`taskset -c 0`) they are the clock's.
"""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from eval.stopwatch import interleaved, median, timed
from more2_jax.config import EncoderConfig, PriorConfig, TrainingRun, load_config
from more2_jax.data.sampling import sample_batch
from more2_jax.data.shards import Shapes
from more2_jax.decoder import Decoder
from more2_jax.encoder import AttentionBlock, FirstBlock, LinearBlock
from more2_jax.geometry import farthest_points
from more2_jax.prior import encode_ordered, init_prior
from more2_jax.types import Embedding
from more2_jax.vn import nearest_features
from train.program import run

SIDE = 2048  # of the square matrices whose product sets the peak
COPIED = 64 * 2**20  # floats: far larger than any cache

# A function and its arguments; the first is differentiated.
Piece = tuple[Callable[..., Any], tuple[Any, ...]]


def main(
    config: Path = Path("configs/base.yaml"),
    out: Path | None = None,
    clouds: int = 8,
    queries: int = 1024,
    repeats: int = 5,
) -> None:
    """Prints a table.

    Args:
        config: YAML with `model` and `training`.
        out: a JSON file for the rows.
        clouds: a batch.
        queries: a cloud.
        repeats: rounds; medians are taken.
    """
    run_ = load_config(config, TrainingRun)
    peaks = measured_peaks(repeats)
    print(f"matrix product {peaks['flops'] / 1e9:.0f} GFLOP/s, copy {peaks['bytes'] / 1e9:.1f} GB/s")
    rows = []
    for name, (function, arguments) in pieces(run_, clouds, queries).items():
        ways: dict[str, Callable[..., Any]] = {"forward": function}
        if name not in WITHOUT_GRADIENT:
            ways["gradient"] = jax.grad(lambda *a, f=function: _total(f(*a)))
        for way, work in ways.items():
            rows.append({"block": name, "way": way, **measured(work, arguments, peaks, repeats)})
            print_row(rows[-1])
    if out is not None:
        said = {"config": config.name, "clouds": clouds, "queries": queries, "peaks": peaks, "rows": rows}
        out.write_text(json.dumps(said | {"cores": len(os.sched_getaffinity(0))}, indent=1) + "\n")


WITHOUT_GRADIENT = ("sampling", "farthest points", "neighbours")


def _total(tree: Any) -> Array:
    return sum((jnp.sum(x**2) for x in jax.tree.leaves(tree)), jnp.zeros(()))


def measured_peaks(repeats: int) -> dict[str, float]:
    """Operations and bytes a second: of a large product in float32, and of a large copy (read and written)."""
    a, long = jnp.ones((SIDE, SIDE)), jnp.ones(COPIED)
    product, copy = jax.jit(lambda x: x @ x), jax.jit(lambda x: x + 1)
    found = interleaved({"p": timed(lambda: product(a)), "c": timed(lambda: copy(long))}, repeats)
    return {"flops": 2 * SIDE**3 / found["p"].cpu, "bytes": 2 * long.nbytes / found["c"].cpu}


def measured(
    work: Callable[..., Any], arguments: tuple[Any, ...], peaks: dict[str, float], repeats: int
) -> dict[str, float]:
    """Counts, medians, and the share of the limit: limit over processor time."""
    compiled = jax.jit(work).lower(*arguments).compile()
    counted = compiled.cost_analysis() or {}
    job = timed(lambda: compiled(*arguments))
    taken = median([job() for _ in range(repeats + 1)][1:])
    flops, moved = (float(counted.get(k, np.nan)) for k in ("flops", "bytes accessed"))
    limit = max(flops / peaks["flops"], moved / peaks["bytes"])
    return {
        "flops": flops,
        "bytes": moved,
        "wall_s": taken.wall,
        "cpu_s": taken.cpu,
        "limit_s": limit,
        "share": limit / taken.cpu,
    }


def print_row(row: dict[str, Any]) -> None:
    """One line of the table."""
    counts = f"{row['flops'] / 1e9:8.2f} GFLOP {row['bytes'] / 1e9:7.2f} GB"
    times = f"{row['wall_s'] * 1e3:8.1f} ms wall {row['cpu_s'] * 1e3:8.1f} ms threads"
    print(f"{row['block']:22s} {row['way']:8s} {counts} {times} {100 * row['share']:5.0f} %", flush=True)


def pieces(run_: TrainingRun, clouds: int, queries: int) -> dict[str, Piece]:
    """Every block on random features of the sizes that it meets, the steps before them, and the decoder."""
    model, key = run_.model, jax.random.key(0)
    points = jax.random.normal(key, (clouds, model.encoder.points, 3))
    mask = jnp.ones(points.shape[:2], bool)
    features = jax.random.normal(key, (clouds, model.encoder.points, 3, model.encoder.widths[0]))
    shapes = Shapes(
        views=0.3 * jax.random.normal(key, (clouds, 12, 512, 3), jnp.float16),
        sdf_uniform=jnp.zeros((clouds, 4096, 4), jnp.float16),
        sdf_near=jnp.zeros((clouds, 4096, 4), jnp.float16),
    )

    def drawn(shapes: Shapes) -> Any:
        index = jnp.arange(max(clouds // 2, 1))  # two clouds a shape
        return sample_batch(key, shapes, index, run_.training, model.encoder.points)

    found: dict[str, Piece] = {
        "sampling": (drawn, (shapes,)),
        "farthest points": (jax.vmap(lambda p, m: farthest_points(p, m, len(p))), (points, mask)),
        "neighbours": (
            jax.vmap(lambda f, m: nearest_features(f, f, m, model.encoder.neighbours)),
            (features, mask),
        ),
    }
    return found | blocks(model.encoder, clouds) | whole(model, points, mask, queries)


def blocks(c: EncoderConfig, clouds: int) -> dict[str, Piece]:
    """The encoder's blocks; what is differentiated are weights and features."""
    found: dict[str, Piece] = {}
    thinning, n = dict(zip(c.downsample_blocks, c.downsample_factors, strict=True)), c.points
    for i, width in enumerate(c.widths):
        key, keep = jax.random.key(i), n // thinning.get(i, 1)
        mask = jnp.ones(n, bool)
        if i == 0:
            block, inputs = FirstBlock(c), (jax.random.normal(key, (clouds, n, 3)),)
            call = lambda b, w, x, m=mask: b.apply(w, x, m)  # noqa: E731
        else:
            x = jax.random.normal(key, (clouds, n, 3, c.widths[i - 1]))
            inputs = (x,)
            block = LinearBlock(c, width) if i < c.linear_blocks else AttentionBlock(c, width)
            more = () if i < c.linear_blocks else (mask[:keep],)
            call = lambda b, w, x, m=mask, k=keep, more=more: b.apply(w, x, m, x[:k], *more)  # noqa: E731
        first = jax.tree.map(lambda x: x[0], inputs)
        arguments = (first[0], mask) if i == 0 else (first[0], mask, first[0][:keep], *more)
        weights = jax.jit(block.init)(key, *arguments)

        def work(both: Any, block: Any = block, call: Any = call) -> Any:
            weights, x = both
            return jax.vmap(lambda one: call(block, weights, one))(x)

        found[f"block {i} ({n} → {keep})"] = (work, ((weights, inputs[0]),))
        n = keep
    return found


def whole(model: PriorConfig, points: Array, mask: Array, queries: int) -> dict[str, Piece]:
    """Encoder and decoder entire."""
    prior = init_prior(model, jax.random.key(0))
    codes = jax.jit(jax.vmap(lambda p, m: encode_ordered(prior, p, m)))(points, mask)
    asked = jax.random.normal(jax.random.key(1), (len(points), queries, 3))

    def encoder(params: Any, points: Array, mask: Array) -> Any:
        ours = dataclasses.replace(prior, params=params)
        e = jax.vmap(lambda p, m: encode_ordered(ours, p, m))(points, mask)
        return e.inv, e.eqv, e.scale, e.center

    def decoder(weights: Any, codes: Embedding, asked: Array) -> Any:
        return jax.vmap(lambda e, q: Decoder(model).apply({"params": weights}, e, q))(codes, asked)

    return {
        "encoder": (encoder, (prior.params, points, mask)),
        "decoder": (decoder, (prior.params["decoder"], codes, asked)),
    }


if __name__ == "__main__":
    run(main)
