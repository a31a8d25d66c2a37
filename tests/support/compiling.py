"""How tests compile: with little optimization, unless they are marked `optimized`."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version

import jax

LITTLE, PRECISION = "jax_disable_most_optimizations", "jax_default_matmul_precision"  # options of JAX
# XLA ends the process at flags that it does not know. The commands set this one, too: what they compile is found again
# by the tests that are marked, and the other way round.
FLAGS = "--xla_cpu_use_fusion_emitters=false" if version("jaxlib").startswith(("0.9.", "0.10.")) else ""


def compile_quickly() -> None:
    """Has this process compile with little optimization; before JAX compiles anything.

    Such programs compile several times faster, run slower, and compute the same up to rounding. Processes that tests
    start compile as they do for users.
    """
    if FLAGS:
        os.environ["XLA_FLAGS"] = FLAGS
    jax.config.update(LITTLE, True)
    jax.config.update(PRECISION, "highest")


@contextmanager
def optimized(much: bool = True) -> Iterator[None]:
    """Programs compile as the commands compile them meanwhile, or not.

    JAX keeps a program in memory whatever was asked of the compiler, so one made with little optimization would be
    taken again, and its last bits differ. It does tell programs apart by the precision asked for, which has two names.
    """
    before = {name: jax.config.values[name] for name in (LITTLE, PRECISION)}
    jax.config.update(LITTLE, not much)
    jax.config.update(PRECISION, "float32" if much else "highest")
    try:
        yield
    finally:
        for name, value in before.items():
            jax.config.update(name, value)
