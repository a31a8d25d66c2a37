"""How tests compile: with little optimization, unless they are marked `optimized`."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from typing import Any
from unittest.mock import patch

from jax._src import compiler  # which options programs compile with has no public door

EMITTERS, LEVEL = "xla_cpu_use_fusion_emitters", "xla_backend_optimization_level"
KNOWS_EMITTERS = version("jaxlib").startswith(
    ("0.9.", "0.10.")
)  # XLA ends the process at a flag it does not know
# As XLA compiles where nobody asks for anything else.
OPTIMIZED = {LEVEL: 3} | ({EMITTERS: True} if KNOWS_EMITTERS else {})


def compile_quickly() -> None:
    """Has this process, and those that it starts, compile with little optimization; before JAX compiles anything.

    Such programs compile several times faster, run slower, and compute the same up to rounding.
    """
    flags = [f"--{LEVEL}=0", *([f"--{EMITTERS}=false"] if KNOWS_EMITTERS else [])]
    os.environ["XLA_FLAGS"] = " ".join(flags)


def as_users_compile() -> dict[str, str]:
    """The environment for a process that compiles as if no test had started it."""
    return {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}


@contextmanager
def optimized() -> Iterator[None]:
    """Programs compile with the optimization of users meanwhile; those compiled before stay as they are."""
    real = compiler.get_compile_options

    def options(*args: Any, env_options_overrides: dict[str, Any] | None = None, **rest: Any) -> Any:
        return real(*args, env_options_overrides=OPTIMIZED | (env_options_overrides or {}), **rest)

    with patch.object(compiler, "get_compile_options", options):
        yield
