"""Gradients run from the pose a registration ends with back to the points it was given.

You learn: the stages for one pair (`encode_one`, `register_one`) are plain functions that `jax.grad` differentiates,
through the encoder, the start by Kabsch, descent on SE(3) and ICP. A central difference confirms the number.
"""

import jax
import jax.numpy as jnp

import more2_jax as m2
from more2_jax.config import RegistrationConfig
from more2_jax.geometry.points import sample
from more2_jax.network.prior import encode_one
from more2_jax.registration.register import register_one
from more2_jax.registration.starting_poses import Pair

jax.config.update("jax_enable_x64", True)  # finite differences need the digits; gradients alone do not

prior = jax.tree.map(lambda x: x.astype(jnp.float64), m2.load_prior("small"))
config = RegistrationConfig(points=64, sdf_points=64, steps=5, icp_steps=2)


def loss(source, target):
    """What registration minimizes, at the pose it ends with."""
    mask = jnp.ones(len(source), bool)
    pair = Pair(
        source=sample(source, mask, config.points, dense=False),
        target=sample(target, mask, config.points, dense=False),
        source_code=encode_one(prior, source, mask),
        target_code=encode_one(prior, target, mask),
        offset=jnp.zeros(3),
    )
    return register_one(prior, pair, config, upright=False).loss


keys = jax.random.split(jax.random.key(0), 3)
cloud = jax.random.normal(keys[0], (256, 3), jnp.float64) * jnp.array([0.5, 0.3, 0.2])
other = cloud + 0.02 * jax.random.normal(keys[1], cloud.shape)
value, gradient = jax.jit(jax.value_and_grad(loss))(cloud, other)

direction = jax.random.normal(keys[2], cloud.shape)
direction /= jnp.linalg.norm(direction)
step, only_loss = 1e-6, jax.jit(loss)
difference = (only_loss(cloud + step * direction, other) - only_loss(cloud - step * direction, other)) / (
    2 * step
)
along = jnp.vdot(gradient, direction)
print(f"loss at the final pose: {value:.5f}")
print(f"gradient with respect to {gradient.shape[0]} points: norm {jnp.linalg.norm(gradient):.5f}")
print(f"slope in a random direction: {along:.6f} by gradient, {difference:.6f} by finite difference")
print(f"relative difference: {abs(along - difference) / abs(difference):.1e}")
