"""Instance matching (paper §3.2): scores between the objects of two scans, and one assignment over them."""

from __future__ import annotations

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array
from jaxtyping import Bool, Float

from more2_jax.config import CodeMatcher
from more2_jax.geometry.full_precision import full_precision
from more2_jax.geometry.points import kabsch_rotation
from more2_jax.types import Embedding, Matches

SMALLEST_ERROR = 1e-3  # E of identical codes would be 0: H stays finite


def cosine(a: Float[Array, " c"], b: Float[Array, " c"]) -> Float[Array, ""]:
    """Λ: cosine of the angle between two invariant codes; 0 if one of them is zero."""
    return a @ b / jnp.sqrt(jnp.maximum((a @ a) * (b @ b), 1e-30))


def turning_error(a: Float[Array, "3 c"], b: Float[Array, "3 c"]) -> Float[Array, ""]:
    """E: what is left of ‖R F_eqv − F_eqv'‖ after the best rotation (Kabsch about the origin)."""
    turned = kabsch_rotation(a.T, b.T).as_matrix() @ a
    return jnp.sqrt(jnp.maximum(jnp.sum((turned - b) ** 2), 1e-30))


@full_precision
def pair_score(source: Embedding, target: Embedding, config: CodeMatcher) -> Float[Array, ""]:
    """H = Λ ⊘ E, or one of its factors; differentiable."""
    score = jnp.ones(())
    if config.score in ("inv", "both"):
        score = score * cosine(source.inv, target.inv)
    if config.score in ("eqv", "both"):
        score = score / jnp.maximum(turning_error(source.eqv, target.eqv), SMALLEST_ERROR)
    return score


def score_matrix(source: Embedding, target: Embedding, config: CodeMatcher) -> Float[Array, "n m"]:
    """`pair_score` of every source with every target."""
    row = jax.vmap(lambda s, t: pair_score(s, t, config), in_axes=(None, 0))
    return jax.vmap(row, in_axes=(0, None))(source, target)


def hungarian(score: Float[Array, "n m"], allowed: Bool[Array, "n m"]) -> tuple[Array, Float[Array, " n"]]:
    """The assignment with the largest total score among allowed pairs: target of every source, or −1."""
    # A pair that is not allowed costs a little more than the worst that is: dearer, yet no loss of precision.
    low = jnp.min(jnp.where(allowed, score, jnp.inf), initial=jnp.inf)
    high = jnp.max(jnp.where(allowed, score, -jnp.inf), initial=-jnp.inf)
    spread = jnp.where(jnp.isfinite(high - low), high - low, 0.0)
    dearer = spread * min(score.shape) + 1.0
    cost = jnp.where(allowed, high - score, dearer)
    rows, columns = optax.assignment.hungarian_algorithm(cost)
    target = jnp.full(score.shape[0], -1).at[rows].set(columns)
    return _only_allowed(target, score, allowed)


def greedy(score: Float[Array, "n m"], allowed: Bool[Array, "n m"]) -> tuple[Array, Float[Array, " n"]]:
    """Best pair first, as the published evaluation does: target of every source, or −1."""

    def body(carry: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], None]:
        left, target = carry
        flat = jnp.argmax(left)
        row, column = flat // score.shape[1], flat % score.shape[1]
        possible = left[row, column] > -jnp.inf
        target = target.at[row].set(jnp.where(possible, column, target[row]))
        left = jnp.where(possible, left.at[row].set(-jnp.inf).at[:, column].set(-jnp.inf), left)
        return (left, target), None

    start = (jnp.where(allowed, score, -jnp.inf), jnp.full(score.shape[0], -1))
    (_, target), _ = jax.lax.scan(body, start, length=min(score.shape))
    return _only_allowed(target, score, allowed)


def _only_allowed(
    target: Array, score: Float[Array, "n m"], allowed: Bool[Array, "n m"]
) -> tuple[Array, Float[Array, " n"]]:
    column = jnp.maximum(target, 0)[:, None]
    ok = (target >= 0) & jnp.take_along_axis(allowed, column, axis=1)[:, 0]
    chosen = jnp.take_along_axis(score, column, axis=1)[:, 0]
    return jnp.where(ok, target, -1), jnp.where(ok, chosen, 0.0)


def match_instances(
    source: Embedding,
    target: Embedding,
    config: CodeMatcher,
    source_real: Bool[Array | np.ndarray, " n"] | None = None,
    target_real: Bool[Array | np.ndarray, " m"] | None = None,
    bonus: Float[Array | np.ndarray, "n m"] | None = None,
) -> Matches:
    """Assigns the objects of one scan to those of another (paper §3.2); either may be empty.

    `source_real` and `target_real` mark which rows of a padded batch are objects. `bonus` is added to the score
    (evidence from outside the embedding, such as the distance moved). Unmatched: −1.
    """
    n, m = source.scale.shape[0], target.scale.shape[0]
    if n == 0 or m == 0:
        return Matches(target_index=jnp.full(n, -1), score=jnp.zeros(n))
    real = np.ones(n, bool) if source_real is None else source_real
    other = np.ones(m, bool) if target_real is None else target_real
    extra = np.zeros((n, m), np.float32) if bonus is None else bonus
    if extra.shape != (n, m):
        raise ValueError(f"match_instances got a bonus of shape {extra.shape}; needed {(n, m)}")
    codes = [dataclasses.replace(e, origin=None) for e in (source, target)]
    return _match(*codes, config, real, other, extra)


@partial(jax.jit, static_argnames="config")
def _match(
    source: Embedding,
    target: Embedding,
    config: CodeMatcher,
    source_real: Bool[Array, " n"],
    target_real: Bool[Array, " m"],
    bonus: Float[Array, "n m"],
) -> Matches:
    score = score_matrix(source, target, config) + bonus
    allowed = source_real[:, None] & target_real & jnp.isfinite(score)
    assign = hungarian if config.assignment == "hungarian" else greedy
    index, chosen = assign(score, allowed)
    return Matches(target_index=index, score=chosen)
