"""Adam on pytrees that may hold SE(3) poses: tangent-space steps, the best point kept with its own loss."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import jaxlie
import optax
from jax import Array
from jaxtyping import Float

from more2_jax.geometry.full_precision import full_precision

V = TypeVar("V")

# Inside Adam's square root: without it the gradient *through* the optimizer is NaN wherever a gradient is 0.
EPS_ROOT = 1e-16


def adam(learning_rate: float) -> optax.GradientTransformation:
    """Adam that can itself be differentiated."""
    return optax.adam(learning_rate, eps_root=EPS_ROOT)


@full_precision
def descend(
    loss_fn: Callable[[V], Float[Array, ""]],
    start: V,
    optimizer: optax.GradientTransformation,
    steps: int,
) -> tuple[V, Float[Array, ""]]:
    """Minimizes `loss_fn` from `start`; returns the best value seen and its loss. `steps` = 0 returns `start`.

    `start` is a pytree of arrays and jaxlie groups; groups move along their tangent. A step whose loss is NaN is
    never kept.
    """
    value_and_grad = jaxlie.manifold.value_and_grad(loss_fn)

    def step(carry: tuple[V, Any, V, Array], _: None) -> tuple[tuple[V, Any, V, Array], None]:
        value, state, best, best_loss = carry
        loss, gradient = value_and_grad(value)
        best, best_loss = keep_better(value, loss, best, best_loss)
        updates, state = optimizer.update(gradient, state)
        return (jaxlie.manifold.rplus(value, updates), state, best, best_loss), None

    state = optimizer.init(jaxlie.manifold.zero_tangents(start))
    (value, _, best, best_loss), _ = jax.lax.scan(
        step, (start, state, start, jnp.array(jnp.inf)), length=steps
    )
    return keep_better(value, loss_fn(value), best, best_loss)


def keep_better(
    value: V, loss: Float[Array, ""], best: V, best_loss: Float[Array, ""]
) -> tuple[V, Float[Array, ""]]:
    """Whichever has the lower loss; NaN never wins."""
    better = loss < best_loss
    chosen = jax.tree.map(lambda new, old: jnp.where(better, new, old), value, best)
    return chosen, jnp.where(better, loss, best_loss)
