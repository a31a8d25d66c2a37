"""Compiling for tests that look at what a program computes and run it a few times only."""

from collections.abc import Callable
from typing import Any

import jax

# Less optimized programs compile several times faster, run slower, and compute the same up to rounding. Where rounding
# decides, as in laws in float32, tests use what users run: `jax.jit` as it is.
QUICKLY = {"xla_backend_optimization_level": 0, "xla_cpu_use_fusion_emitters": False}


def quick_jit(function: Callable[..., Any], **options: Any) -> Any:
    """`jax.jit`, for a program that compiles for longer than it runs."""
    return jax.jit(function, compiler_options=QUICKLY, **options)
