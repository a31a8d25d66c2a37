"""What a scene costs an accelerator, by counting: `python -m eval.operations --data data/flying_paper --prior base`.

One room, its first two scans and all meshes, is worked on here, twice; every compiled program that it calls the second
time is counted: operations, bytes, and kernels that wait for one another. `estimate_s` says how long a machine of given
rates takes for them; what NumPy and SciPy do beside them is timed, since an accelerator does not speed it up.
"""

from __future__ import annotations

import dataclasses
import json
import math
import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import jax
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn

from eval.end_to_end import living_scene
from eval.flyingshape import flyingshape
from more2_jax import closing, encoding, evidence, fitting, meshing, planes, registration, verification
from more2_jax import scene as scene_module
from more2_jax.config import preset
from more2_jax.prior import load_prior
from train.program import run

# Where the stages call their programs.
PROGRAMS = {
    "encode": ((encoding, "encode"), (fitting, "encode")),
    "match": ((verification, "pair_evidence"),),
    "register": ((registration, "_register_many"),),
    "close": ((closing, "close_poses"),),
    "mesh": ((meshing, "_values"), (meshing, "_slopes"), (planes, "planes")),
}
# What is done for every object by itself, side by side where there are cores.
OBJECTS = {"close": (closing, "sides_seen"), "mesh": (scene_module, "mesh_of")}
# Published rates of one NVIDIA H100 SXM: float32 without tensor cores, and memory.
FLOPS, BYTES = 67e12, 3.35e12
BYTES_A_NUMBER = 4
LAUNCH_S = 5e-6  # assumed: until a kernel that waits for another has begun
MOVES = ("reshape", "squeeze", "expand_dims", "broadcast_in_dim", "convert_element_type", "iota", "copy")
# What ends a fused loop; all else joins the kernel of its neighbours.
KERNELS = (
    "dot_general",
    "sort",
    "top_k",
    "gather",
    "scatter",
    "reduce_",
    "arg",
    "cum",
    "conv",
)


@dataclass(frozen=True)
class Count:
    """Of a program: floating-point operations, bytes read and written if nothing is fused, kernels in sequence."""

    flops: float = 0.0
    bytes: float = 0.0
    kernels: float = 0.0

    def __add__(self, other: Count) -> Count:
        return Count(self.flops + other.flops, self.bytes + other.bytes, self.kernels + other.kernels)

    def times(self, factor: float) -> Count:
        """So many in sequence."""
        return Count(self.flops * factor, self.bytes * factor, self.kernels * factor)


def main(data: Path, prior: str = "base", room: int = 0, out: Path | None = None) -> None:
    """Prints a table.

    Args:
        data: rooms of `train.synthesise`.
        prior: its name or file.
        room: which of them.
        out: a JSON file for the rows.
    """
    rooms = flyingshape(data)
    scene = rooms.read(rooms.names[room]).first_scans(2)
    weights, config = load_prior(prior), preset("robust", upright=rooms.upright)
    with counted() as (stages, spent), timed_objects(spent) as objects:
        living_scene(scene, weights, config)  # compiles
        stages.update(dict.fromkeys(PROGRAMS, Count()))
        spent["cpu"] = 0.0
        for seconds in objects.values():
            seconds.clear()
        began = time.process_time(), time.perf_counter()
        living_scene(scene, weights, config)
        cpu, wall = time.process_time() - began[0], time.perf_counter() - began[1]
    rows = {k: dataclasses.asdict(v) | {"estimate_s": estimate_s(v)} for k, v in stages.items()}
    for name, row in rows.items():
        print(
            f"{name:9s} {row['flops'] / 1e9:9.1f} GFLOP {row['bytes'] / 1e9:8.1f} GB "
            f"{row['kernels']:7.0f} kernels {1e3 * row['estimate_s']:7.1f} ms"
        )
    host = host_times(cpu - spent["cpu"], objects, sum(row["estimate_s"] for row in rows.values()))
    print(", ".join(f"{k} {v:.2f}" for k, v in host.items()) + f"; {wall:.1f} s in all here")
    if out is not None:
        out.write_text(
            json.dumps({"prior": prior, "stages": rows, "host": host | {"wall_s": wall}}, indent=1) + "\n"
        )


def host_times(cpu_s: float, objects: Mapping[str, list[float]], programs_s: float) -> dict[str, float]:
    """Seconds beside the programs: all on one core, the share of that in objects that may go side by side, and of a
    scene with a core for every object, the programs at the machine's rates."""
    shared = sum(map(sum, objects.values()))
    longest = sum(max(seconds, default=0.0) for seconds in objects.values())
    alone = cpu_s - shared
    return {
        "cpu_s": cpu_s,
        "objects_s": shared,
        "longest_s": longest,
        "scene_s": programs_s + alone + longest,
    }


@contextmanager
def timed_objects(spent: Mapping[str, float]) -> Iterator[dict[str, list[float]]]:
    """Meanwhile, by stage, the processor time of every object's own work, less what programs `spent`."""
    times: dict[str, list[float]] = {stage: [] for stage in OBJECTS}

    def timing(stage: str, work: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **kwargs: Any) -> Any:
            began = time.process_time() - spent["cpu"]
            result = work(*args, **kwargs)
            result = list(result) if isinstance(result, Iterator) else result
            times[stage].append(time.process_time() - spent["cpu"] - began)
            return result

        return call

    with ExitStack() as stack:
        for stage, (module, name) in OBJECTS.items():
            stack.enter_context(patch.object(module, name, timing(stage, getattr(module, name))))
        yield times


def estimate_s(count: Count) -> float:
    """Seconds on the machine of the rates above: arithmetic or memory, whichever is longer, and the launches.

    Hopeful where a kernel is too small to keep the machine busy, pessimistic where operations are fused.
    """
    return max(count.flops / FLOPS, count.bytes / BYTES) + LAUNCH_S * count.kernels


@contextmanager
def counted() -> Iterator[tuple[dict[str, Count], dict[str, float]]]:
    """The counts of all programs called meanwhile, by stage, and the processor time they took here."""
    counts, spent = dict.fromkeys(PROGRAMS, Count()), {"cpu": 0.0}
    known: dict[Any, Count] = {}

    def counting(stage: str, program: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **kwargs: Any) -> Any:
            leaves, tree = jax.tree.flatten((args, kwargs))
            key = (stage, program, tree, tuple(getattr(x, "shape", ()) for x in leaves))
            if key not in known:
                known[key] = count_of(program, *args, **kwargs)
            counts[stage] += known[key]
            began = time.process_time()
            result = jax.block_until_ready(program(*args, **kwargs))
            spent["cpu"] += time.process_time() - began
            return result

        return call

    with ExitStack() as stack:
        # As many at once as accelerators take; objects one by one, so that processor time has one owner.
        stack.enter_context(patch.object(os, "cpu_count", lambda: 1))
        stack.enter_context(patch.object(meshing, "CHUNK", {}))
        stack.enter_context(patch.object(evidence, "AT_ONCE", {}))
        for stage, places in PROGRAMS.items():
            for module, name in places:
                stack.enter_context(patch.object(module, name, counting(stage, getattr(module, name))))
        yield counts, spent


def count_of(program: Callable[..., Any], *args: Any, **kwargs: Any) -> Count:
    """Of one call."""
    if hasattr(program, "trace"):
        return count_jaxpr(program.trace(*args, **kwargs).jaxpr.jaxpr)
    return count_jaxpr(jax.make_jaxpr(partial(program, **kwargs))(*args).jaxpr)


def count_jaxpr(jaxpr: Jaxpr) -> Count:
    """All equations in sequence; loops as often as they turn, of branches the dearest."""
    total = Count()
    for eqn in jaxpr.eqns:
        total += count_equation(eqn)
    return total


def count_equation(eqn: JaxprEqn) -> Count:
    """One equation, with what it calls."""
    name, inner = eqn.primitive.name, list(_inner(eqn.params))
    if name == "while":
        raise ValueError(f"a loop of unknown length: {eqn.source_info}")
    if inner:
        parts = [count_jaxpr(j) for j in inner]
        if name == "cond":
            return max(parts, key=lambda c: c.flops)
        return sum(parts, Count()).times(eqn.params["length"] if name == "scan" else 1)
    if name in MOVES:
        return Count()
    moved = sum(math.prod(_shape(v)) * BYTES_A_NUMBER for v in (*eqn.invars, *eqn.outvars))
    return Count(_flops(eqn), float(moved), float(name.startswith(KERNELS)))


def _flops(eqn: JaxprEqn) -> float:
    """Two a product and sum; sorting n numbers n log₂ n; all else one a number made or taken in."""
    name = eqn.primitive.name
    made = _shape(eqn.outvars[0])
    taken = _shape(eqn.invars[0]) if eqn.invars else made
    if name == "dot_general":
        (contracted, _), _ = eqn.params["dimension_numbers"]
        return 2.0 * math.prod(made) * math.prod(taken[k] for k in contracted)
    if name in ("sort", "top_k"):
        return math.prod(taken) * math.log2(max(taken[-1], 2))
    return float(max(math.prod(taken), math.prod(made)))


def _shape(value: Any) -> tuple[int, ...]:
    return getattr(value.aval, "shape", ())


def _inner(params: Mapping[str, Any]) -> Iterator[Jaxpr]:
    """The jaxprs that an equation calls."""
    for value in params.values():
        for x in value if isinstance(value, list | tuple) else (value,):
            if isinstance(x, ClosedJaxpr):
                yield x.jaxpr
            elif isinstance(x, Jaxpr):
                yield x


if __name__ == "__main__":
    run(main)
