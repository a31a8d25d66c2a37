"""How fast encoder and training step are beside plain forms of the same layers: `python -m eval.speed`.

Ratios from one run: ours, the plain form in JAX, and the published layers' operations in PyTorch if an interpreter
that has it is named. All get the same sizes, clouds and cores, and clouds in farthest-point order. Whatever has a
gradient, ours does as `train.prior` does: on CPUs every core has its share of the clouds, one after the other, and
gradients are added up. The others get all clouds at once, and their libraries divide every operation over the cores.
"""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array

from eval.performance import plain_layers
from eval.performance.stopwatch import Job, Seconds, interleaved, timed
from more2_jax.config import PriorConfig, load_config
from more2_jax.geometry.points import farthest_points
from more2_jax.network.decoder import Decoder
from more2_jax.network.prior import Prior, encode_ordered, init_prior
from more2_jax.network.row_map import in_blocks, in_turn
from train.run.devices import by_rows, cores, device_a_core, device_mesh, everywhere
from train.run.memory import GLIBC_KEEPS_MEMORY, keep_freed_memory
from train.run.program import run
from train.run.settings import TrainingRun
from train.shards.losses import AT_ONCE

WHAT = {"forward": "encoder forward", "encoder_step": "encoder and its gradient", "step": "training step"}
WANTED = {"forward": 5.0, "step": 5.0}  # times the published layers


def main(
    config: Path = Path("configs/base.yaml"),
    out: Path | None = None,
    torch: str = "",
    clouds: int = 8,
    points: int = 1024,
    queries: int = 1024,
    repeats: int = 5,
) -> None:
    """Prints medians and ratios.

    Args:
        config: YAML with `model`.
        out: a JSON file for the rows.
        torch: a Python interpreter that has PyTorch; without, the plain form stands alone.
        clouds: a batch.
        points: a cloud.
        queries: a cloud, in the training step: encoder, decoder, mean error, gradient, Adam. No dropout.
        repeats: rounds; every competitor once a round.
    """
    keep_freed_memory()  # as training does, and so is
    device_a_core(clouds)
    quiet = published_layers(load_config(config, TrainingRun).model)
    batch = clouds_and_queries(clouds, points, queries)
    jobs = {
        **{("ours", name): job for name, job in jax_jobs(quiet, batch, plain=False).items()},
        **{("plain", name): job for name, job in jax_jobs(quiet, batch, plain=True).items()},
    }
    with torch_jobs(torch, quiet, batch) as (more, version):
        jobs |= {("torch", name): job for name, job in more.items()}
        flat = interleaved({"/".join(key): job for key, job in jobs.items()}, repeats)
    rows = table({tuple(key.split("/")): s for key, s in flat.items()})
    said = {"clouds": clouds, "points": points, "queries": queries, "repeats": repeats}
    said |= {"config": config.name, "cores": cores(), "torch": version, "rows": rows}
    if out is not None:
        out.write_text(json.dumps(said, indent=1) + "\n")


def published_layers(model: PriorConfig) -> PriorConfig:
    """The same widths with nothing that the paper does not have: no look-up of observed points; and no dropout."""
    decoder = dataclasses.replace(model.decoder, dropout=0.0, local_blocks=())
    return dataclasses.replace(model, decoder=decoder)


def clouds_and_queries(clouds: int, points: int, queries: int) -> tuple[Array, Array, Array]:
    """Noisy ellipsoids in farthest-point order, queries around them, their distances (to the unit sphere)."""
    rng = np.random.default_rng(0)
    unit = rng.normal(size=(clouds, points, 3))
    unit /= np.linalg.norm(unit, axis=-1, keepdims=True)
    cloud = unit * rng.uniform(0.2, 0.45, (clouds, 1, 3)) + rng.normal(size=unit.shape) * 0.005
    asked = rng.uniform(-0.5, 0.5, (clouds, queries, 3))
    ordered = jax.vmap(lambda p: farthest_points(p, jnp.ones(points, bool), points)[0])(
        jnp.asarray(cloud, jnp.float32)
    )
    truth = np.linalg.norm(asked, axis=-1) - 0.35
    return ordered, jnp.asarray(asked, jnp.float32), jnp.asarray(truth, jnp.float32)


def outputs(prior: Prior, points: Array, plain: bool) -> plain_layers.Outputs:
    """F_inv, F_eqv, F_s, F_c of one cloud, by our layers or by the plain ones."""
    if plain:
        return plain_layers.encode(prior.params["encoder"], points, prior.config.encoder)
    e = encode_ordered(prior, points, jnp.ones(len(points), bool))
    return e.inv, e.eqv, e.scale, e.center


def distances(prior: Prior, points: Array, queries: Array, plain: bool) -> Array:
    """Ψ at queries of one cloud."""
    if plain:
        code = outputs(prior, points, plain)
        return plain_layers.decode(prior.params["decoder"], code, queries, prior.config)
    e = encode_ordered(prior, points, jnp.ones(len(points), bool))
    decoder = Decoder(prior.config)
    weights = {"params": prior.params["decoder"]}
    return in_blocks(lambda some: decoder.apply(weights, e, some, train=True), queries)  # type: ignore[return-value]


def jax_jobs(model: PriorConfig, batch: tuple[Array, Array, Array], plain: bool) -> dict[str, Job]:
    """The three jobs, compiled."""
    prior, adam = init_prior(model, jax.random.key(0)), optax.adam(1e-4)
    mesh = device_mesh(len(batch[0]))

    # Everything is an argument: of constants the compiler would compute a part in advance.
    def forward(params: Any, points: Array) -> plain_layers.Outputs:
        p = dataclasses.replace(prior, params=params)
        return jax.vmap(lambda x: outputs(p, x, plain))(points)

    def over(one: Any, params: Any, rows: Any) -> Any:  # ours as training does it
        f = lambda params, row: one(dataclasses.replace(prior, params=params), row)  # noqa: E731
        if plain:
            return jax.vmap(f, in_axes=(None, 0))(params, rows)
        return in_turn(f, params, rows, max(1, AT_ONCE // batch[0].shape[1]), mesh)

    def squares(params: Any, points: Array) -> Array:
        found = over(lambda p, x: outputs(p, x, plain), params, points)
        return sum((jnp.sum(x**2) for x in found), jnp.zeros(()))

    def loss(params: Any, points: Array, queries: Array, truth: Array) -> Array:
        found = over(lambda p, row: distances(p, row[0], row[1], plain), params, (points, queries))
        return jnp.abs(found - truth).mean()

    def step(params: Any, state: Any, *batch: Array) -> Any:
        updates, state = adam.update(jax.grad(loss)(params, *batch), state)
        return optax.apply_updates(params, updates), state

    weights = prior.params, adam.init(prior.params)
    if plain:
        params, state, split = *weights, batch
    else:
        (params, state), split = everywhere(mesh, weights), jax.device_put(batch, by_rows(mesh))
    run_forward, run_gradient, run_step = jax.jit(forward), jax.jit(jax.grad(squares)), jax.jit(step)
    return {
        "forward": timed(lambda: run_forward(prior.params, batch[0])),
        "encoder_step": timed(lambda: run_gradient(params, split[0])),
        "step": timed(lambda: run_step(params, state, *split)),
    }


@contextmanager
def torch_jobs(
    interpreter: str, model: PriorConfig, batch: tuple[Array, Array, Array]
) -> Iterator[tuple[dict[str, Job], str]]:
    """The jobs in PyTorch, in a process of its own, and PyTorch's version; none without an interpreter.

    Raises ValueError if the interpreter does not start or has no torch.
    """
    if not interpreter:
        yield {}, ""
        return
    script = str(Path(__file__).parent / "performance" / "torch_layers.py")
    pipe = subprocess.PIPE
    environment = os.environ | GLIBC_KEEPS_MEMORY
    with subprocess.Popen(
        [interpreter, script], stdin=pipe, stdout=pipe, text=True, env=environment
    ) as worker:
        names = ("hidden", "layers", "skip", "narrow")
        d = model.decoder
        settings = {
            "threads": cores(),
            "encoder": dataclasses.asdict(model.encoder),
            "decoder": dict(zip(names, (d.hidden, d.layers, d.skip_layer, d.narrow_skip), strict=True)),
            **{k: np.asarray(x).tolist() for k, x in zip(("points", "queries", "sdf"), batch, strict=True)},
        }
        version = _asked(worker, json.dumps(settings))["version"]
        yield {name: _job(worker, name) for name in WHAT}, version
        assert worker.stdin is not None
        worker.stdin.close()


def _asked(worker: subprocess.Popen[str], line: str) -> Any:
    assert worker.stdin is not None and worker.stdout is not None
    worker.stdin.write(line + "\n")
    worker.stdin.flush()
    if not (answer := worker.stdout.readline()):
        raise ValueError(f"{worker.args[0]} gave no answer; needed an interpreter that has torch")  # type: ignore[index]
    return json.loads(answer)


def _job(worker: subprocess.Popen[str], name: str) -> Job:
    return lambda: Seconds(*_asked(worker, name))


def table(found: dict[tuple[str, ...], Seconds]) -> list[dict[str, Any]]:
    """Prints and returns a row a job: seconds of everyone, and how many times ours they are."""
    rows = []
    for name, what in WHAT.items():
        ours = found["ours", name]
        for who in ("ours", "plain", "torch"):
            if (s := found.get((who, name))) is None:
                continue
            row = {"what": what, "who": who, "wall_s": s.wall, "cpu_s": s.cpu}
            row |= {"wall_ratio": s.wall / ours.wall, "cpu_ratio": s.cpu / ours.cpu}
            wanted = f" (wanted {WANTED[name]:g})" if who == "torch" and name in WANTED else ""
            times = f"{s.wall * 1e3:9.0f} ms wall {s.cpu * 1e3:9.0f} ms of threads"
            ratios = f"{row['wall_ratio']:5.2f} × wall {row['cpu_ratio']:5.2f} × threads"
            print(f"{what:25s} {who:6s} {times}   {ratios}{wanted}")
            rows.append(row)
    sys.stdout.flush()
    return rows


if __name__ == "__main__":
    run(main)
