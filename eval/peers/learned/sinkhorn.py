"""Differentiable assignment with outliers: Sinkhorn's algorithm with a slack row and column (RPM-Net, §4.2)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array
from jax.scipy.special import logsumexp
from jaxtyping import Bool, Float

NONE = -1e9  # logarithm of what is no partner at all


def sinkhorn(
    scores: Float[Array, "n m"], row_mask: Bool[Array, " n"], column_mask: Bool[Array, " m"], steps: int
) -> Float[Array, "n+1 m+1"]:
    """Logarithms of how much each row belongs to each column; the last of both are for what has no partner.

    Real columns, slack row included, sum to 1 after every step, real rows at convergence; the two slacks never do.
    """
    real_rows, real_columns = (jnp.concatenate([m, jnp.ones(1, bool)]) for m in (row_mask, column_mask))
    allowed = real_rows[:, None] & real_columns
    allowed = allowed.at[-1, -1].set(False)
    start = jnp.where(allowed, jnp.pad(scores, ((0, 1), (0, 1))), NONE)

    def step(x: Array, _: None) -> tuple[Array, None]:
        rows = x.at[:-1].add(-logsumexp(x[:-1], axis=1, keepdims=True))
        x = jnp.where(allowed, rows, NONE)
        columns = x.at[:, :-1].add(-logsumexp(x[:, :-1], axis=0, keepdims=True))
        return jnp.where(allowed, columns, NONE), None

    return jax.lax.scan(step, start, length=steps)[0]
