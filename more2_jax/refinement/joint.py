"""Joint optimization of one object's shape code and poses over all its observations (paper §3.5)."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import optax
from jax import Array
from jax.core import Tracer
from jaxtyping import Bool, Float

from more2_jax.config import JointConfig
from more2_jax.geometry.full_precision import full_precision
from more2_jax.geometry.points import cloud_radius, farthest_points, transformed
from more2_jax.geometry.se3_descent import adam, descend
from more2_jax.geometry.transform import rescale, transform
from more2_jax.network.prior import Prior, field_sdf, object_field
from more2_jax.types import AnyArray, Embedding, JointFit, pytree, quantity

jax.tree_util.register_static(JointConfig)  # part of a program: `jax.jit(fit_jointly)` takes it as it is


@pytree
class Observations:
    """One object, seen up to k times; every cloud in its own local frame. Row 0 is the reference."""

    points: Float[AnyArray, "*b k n 3"] = quantity("position")
    mask: Bool[AnyArray, "*b k n"] = quantity("invariant")
    real: Bool[AnyArray, "*b k"] = quantity("invariant")  # False: padding
    codes: Embedding = quantity("record")  # (*b, k, …): of every observation alone
    T_ref_obs: jaxlie.SE3 = quantity("pose")  # (*b, k): observation's local frame to the reference's
    accumulated: Embedding = quantity(
        "record"
    )  # (*b, …): of all observations together, in the reference's local frame


def fit_jointly(prior: Prior, observations: Observations, config: JointConfig) -> JointFit:
    """Optimizes code and poses of a batch of objects in one call (paper §3.5); frame: the reference's local one.

    Differentiable in both modes, with respect to points, poses, codes and weights. Raises ValueError when an object
    has no reference observation, unless which observations are real is traced.
    """
    # By NumPy: under `jax.jit` even an operation on a concrete array is traced, and has no truth value.
    if not isinstance(observations.real, Tracer) and not np.asarray(observations.real)[:, 0].all():
        raise ValueError(
            "fit_jointly got an object without observation 0; needed the reference observation there"
        )
    return _fit_many(prior, observations, config)


@partial(jax.jit, static_argnames="config")
@full_precision
def _fit_many(prior: Prior, observations: Observations, config: JointConfig) -> JointFit:
    return jax.vmap(lambda one: fit_one(prior, one, config))(observations)


def fit_one(prior: Prior, seen: Observations, config: JointConfig) -> JointFit:
    """`fit_jointly` for one object, in units of the reference cloud's radius."""
    seen = subsample(seen, config.points)
    radius = cloud_radius(seen.points[0], seen.mask[0])
    seen = rescale(seen, 1 / radius)
    start = seen.accumulated if config.start == "accumulated" else best_code(prior, seen)
    free = {"inv": start.inv, "eqv": start.eqv, "center": start.center, "pose": seen.T_ref_obs}

    def loss(free: dict[str, Any]) -> Float[Array, ""]:
        code = dataclasses.replace(start, inv=free["inv"], eqv=free["eqv"], center=free["center"])
        return surface_loss(prior, code, free["pose"], seen) + code_drift(code, start)

    best, lowest = descend(loss, free, optimizer(config), config.steps)
    # The reference observation defines the frame: all is moved back by what it drifted.
    given, found = (jax.tree.map(lambda x: x[0], poses) for poses in (seen.T_ref_obs, best["pose"]))
    drift = given @ found.inverse()
    code = dataclasses.replace(start, inv=best["inv"], eqv=best["eqv"], center=best["center"])
    poses = jax.vmap(lambda T: drift @ T)(best["pose"])
    fit = JointFit(
        embedding=transform(code, drift),
        T_ref_obs=poses,
        loss=lowest,
    )
    return rescale(fit, radius)


def optimizer(config: JointConfig) -> optax.GradientTransformation:
    """Adam with the paper's own step size for every variable."""
    rates = {
        "inv": config.inv_learning_rate,
        "eqv": config.eqv_learning_rate,
        "center": config.center_learning_rate,
        "pose": config.pose_learning_rate,
    }
    return optax.multi_transform({k: adam(rate) for k, rate in rates.items()}, {k: k for k in rates})


def surface_loss(
    prior: Prior, code: Embedding, T_ref_obs: jaxlie.SE3, seen: Observations
) -> Float[Array, ""]:
    """Σ over observations of the mean |Ψ| at their points; canonical units."""
    field = object_field(prior, code)

    def one(T: jaxlie.SE3, points: Any, mask: Any, real: Any) -> Array:
        distance = jnp.where(mask, jnp.abs(field_sdf(prior, field, transformed(T, points))), 0.0)
        return real * distance.sum() / jnp.maximum(mask.sum(), 1)

    return jax.vmap(one)(T_ref_obs, seen.points, seen.mask, seen.real).sum()


def code_drift(code: Embedding, start: Embedding) -> Float[Array, ""]:
    """‖F' − F_0‖₂ (paper §3.5): keeps the code from a field that is zero everywhere."""
    squared = [jnp.sum((getattr(code, k) - getattr(start, k)) ** 2) for k in ("inv", "eqv", "center")]
    return jnp.sqrt(sum(squared, jnp.zeros(())) + 1e-16)


def best_code(prior: Prior, seen: Observations) -> Embedding:
    """X*: the code of the observation it explains best, moved into the reference's frame.

    What the decoder looks up beside the code is of all observations together.
    """

    def own_loss(code: Embedding, points: Any, mask: Any) -> Array:
        distance = jnp.abs(field_sdf(prior, object_field(prior, code), points))
        return jnp.where(mask, distance, 0.0).sum() / jnp.maximum(mask.sum(), 1)

    losses = jax.vmap(own_loss)(seen.codes, seen.points, seen.mask)
    best = jnp.argmin(jnp.where(seen.real & jnp.isfinite(losses), losses, jnp.inf))
    code, T = jax.tree.map(lambda x: x[best], (seen.codes, seen.T_ref_obs))
    return with_anchors(transform(code, T), seen.accumulated)


def with_anchors(code: Embedding, other: Embedding) -> Embedding:
    """The code with the anchors of another one of the same frame, where those lie."""
    shift = other.center - code.center
    anchors = tuple(dataclasses.replace(a, offset=a.offset + shift) for a in other.anchors)
    return dataclasses.replace(code, anchors=anchors)


def subsample(seen: Observations, points: int) -> Observations:
    """At most `points` farthest points of every cloud."""
    clouds, mask = jax.vmap(lambda p, m: farthest_points(p, m, points))(seen.points, seen.mask)
    return dataclasses.replace(seen, points=clouds, mask=mask)
