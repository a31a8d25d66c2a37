"""How tests compile: with little optimization, unless they are marked `optimized`."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version

import jax

LITTLE = "jax_disable_most_optimizations"  # an option of JAX


def compile_quickly() -> None:
    """Has this process compile with little optimization; before JAX compiles anything.

    Such programs compile several times faster, run slower, and compute the same up to rounding. Processes that tests
    start compile as they do for users.
    """
    # XLA ends the process at flags that it does not know. The commands set this one, too: what they compile is found
    # again by the tests that are marked, and the other way round.
    if version("jaxlib").startswith(("0.9.", "0.10.")):
        os.environ["XLA_FLAGS"] = "--xla_cpu_use_fusion_emitters=false"
    jax.config.update(LITTLE, True)


@contextmanager
def optimized(much: bool = True) -> Iterator[None]:
    """Programs compile as the commands compile them meanwhile, or not; those compiled before stay as they are."""
    before = jax.config.values[LITTLE]
    jax.config.update(LITTLE, not much)
    try:
        yield
    finally:
        jax.config.update(LITTLE, before)
