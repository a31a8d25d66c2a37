"""Products of matrices in float32, whatever JAX's default is on the device at hand."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import jax

P = ParamSpec("P")
R = TypeVar("R")


def full_precision(function: Callable[P, R]) -> Callable[P, R]:
    """`function` with every product of matrices inside it in full precision, and so the derivatives of these.

    By default GPUs round the factors of a float32 product to 11 significant bits and TPUs to 8. A product of two
    quaternions is such a product in jaxlie, and so is a turned point: a pose would be off by tenths of a degree, a
    neighbor in feature space another one, and a field's slope coarse. CPUs compute in float32 in any case.
    """

    @functools.wraps(function)
    def exact(*args: P.args, **named: P.kwargs) -> R:
        with jax.default_matmul_precision("highest"):
            return function(*args, **named)

    return exact
