"""Gradients through registration: from the pose that it ends with back to the points that it was given.

You learn: `encode` and `register` can be differentiated as they are, through the encoder, the start by Kabsch, descent
on SE(3) and ICP. A central difference confirms the number.
"""

import jax
import jax.numpy as jnp

import more2_jax as m2
from more2_jax.config import DescentRegistration

jax.config.update("jax_enable_x64", True)  # finite differences need the digits; gradients alone do not

prior = jax.tree.map(lambda x: x.astype(jnp.float64), m2.load_prior("small"))
method = DescentRegistration(points=64, sdf_points=64, steps=5, icp_steps=2)


def loss(source, target):
    """What registration minimizes, at the pose it ends with."""
    clouds = [m2.PointCloud(points=x[None], mask=jnp.ones((1, len(x)), bool)) for x in (source, target)]
    one, other = (m2.batch_of(cloud, m2.encode(prior, cloud)) for cloud in clouds)
    return m2.register(prior, m2.pair_up(one, other), method).loss[0]


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
