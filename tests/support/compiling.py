"""Compiling for tests that look at what a program computes and run it a few times only."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from unittest.mock import patch

import jax
from jax._src import compiler  # which options programs compile with has no public door

# Less optimized programs compile several times faster, run slower, and compute the same up to rounding. Where rounding
# decides, as in laws in float32, tests use what users run: `jax.jit` as it is.
QUICKLY = {"xla_backend_optimization_level": 0, "xla_cpu_use_fusion_emitters": False}


def quick_jit(function: Callable[..., Any], **options: Any) -> Any:
    """`jax.jit`, for a program that compiles for longer than it runs."""
    return jax.jit(function, compiler_options=QUICKLY, **options)


@contextmanager
def quickly() -> Iterator[None]:
    """Programs of the library, too, compile as by `quick_jit` meanwhile; those compiled before stay as they are."""
    real = compiler.get_compile_options

    def options(*args: Any, env_options_overrides: dict[str, Any] | None = None, **rest: Any) -> Any:
        return real(*args, env_options_overrides=QUICKLY | (env_options_overrides or {}), **rest)

    with patch.object(compiler, "get_compile_options", options):
        yield
