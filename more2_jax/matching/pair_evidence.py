"""Who is who by geometry: every candidate pair of objects aligned from many starts, and how well it then fits.

Beyond the paper (preset `robust`): the embedding proposes, surfaces decide. A pair costs some milliseconds, since
clouds are prepared once and compared by tables of nearest points. In any orientation more poses fit by chance, and no
heights tell pairs apart: there the prior is asked too, whether each cloud lies on what it completes the other to.
"""

from __future__ import annotations

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import jaxlie
from jax import Array
from jaxtyping import Float, Int

from more2_jax.config import RegistrationConfig
from more2_jax.geometry.point_to_plane import Surface, scale_surface, whole_surface
from more2_jax.geometry.points import cloud_radius
from more2_jax.geometry.transform import scale_embedding
from more2_jax.network.prior import Prior
from more2_jax.registration.starting_poses import Pair, candidate_poses
from more2_jax.registration.surface import (
    coarse_of,
    doubts,
    misfits_both_ways,
    off_field,
    off_fields,
    search,
)
from more2_jax.types import Embedding, PointCloud, pytree

HYPOTHESES = 4  # poses of a pair that are remembered: the best, and others turned otherwise
# Pairs aligned side by side: a small CPU has use for few, an accelerator for all of a scene.
AT_ONCE = {"cpu": 8}
AT_ONCE_OF_OTHERS = 64


@pytree
class Evidence:
    """How a pair of objects fits at the best pose found."""

    of_source: Float[
        Array, "*pairs"
    ]  # mean truncated distance of the source's points, in shares of the truncation
    of_target: Float[Array, "*pairs"]  # and of the target's
    lift: Float[Array, "*pairs"]  # change of height, meters
    radius: Float[Array, "*pairs"]  # of the target, meters
    # How far, 0 to 1, the source's points lie off the target's completed surface, the target's off the source's, and
    # either off its own at most: what the prior does not even know. All 0 where that is not asked.
    off_source: Float[Array, "*pairs"]
    off_target: Float[Array, "*pairs"]
    off_own: Float[Array, "*pairs"]
    poses: jaxlie.SE3  # (*pairs, `HYPOTHESES`): source's local frame to target's, best first, meters


@partial(jax.jit, static_argnames=("config", "upright"))
def pair_evidence(
    prior: Prior,
    source: PointCloud,
    target: PointCloud,
    source_code: Embedding,
    target_code: Embedding,
    offset: Float[Array, "n m 3"],
    pairs: Int[Array, "p 2"],
    config: RegistrationConfig,
    upright: bool,
) -> Evidence:
    """Fits `pairs` (row of `source`, row of `target`) of two batches of clouds.

    `offset`: where the source's local zero lies as the target sees it, when the scans share a frame, meters.
    """

    def prepared(cloud: PointCloud) -> Surface:
        def one(row: tuple[Array, Array]) -> Surface:
            points, mask = row
            return coarse_of(whole_surface(points, mask), config)

        return jax.lax.map(one, (cloud.points, cloud.mask))

    sources, targets = prepared(source), prepared(target)
    own = [jnp.zeros(len(c.points)) for c in (source, target)]
    if asks_prior(config, upright):
        own = [off_own(prior, s, c) for s, c in ((sources, source_code), (targets, target_code))]
    radius = jax.vmap(cloud_radius)(target.points, target.mask)

    def one(index: Int[Array, "2"]) -> Evidence:
        s, s_code = jax.tree.map(lambda x: x[index[0]], (sources, source_code))
        t, t_code, r = jax.tree.map(lambda x: x[index[1]], (targets, target_code, radius))
        found = fit(prior, s, t, s_code, t_code, offset[index[0], index[1]], r, config, upright)
        return dataclasses.replace(found, off_own=jnp.maximum(own[0][index[0]], own[1][index[1]]))

    at_once = AT_ONCE.get(jax.default_backend(), AT_ONCE_OF_OTHERS)
    return jax.lax.map(one, pairs, batch_size=at_once)


def off_own(prior: Prior, surfaces: Surface, codes: Embedding) -> Float[Array, " n"]:
    """How far the samples of clouds lie off the surfaces that the prior completes them to: 0 to 1."""

    def one(row: tuple[Surface, Embedding]) -> Float[Array, ""]:
        surface, code = row
        return off_field(prior, jaxlie.SE3.identity(), surface.sampled, code)

    return jax.lax.map(one, (surfaces, codes))


def fit(
    prior: Prior,
    source: Surface,
    target: Surface,
    source_code: Embedding,
    target_code: Embedding,
    offset: Float[Array, "3"],
    radius: Float[Array, ""],
    config: RegistrationConfig,
    upright: bool,
) -> Evidence:
    """One pair."""
    s, t = (scale_surface(x, 1 / radius) for x in (source, target))
    codes = (scale_embedding(c, 1 / radius) for c in (source_code, target_code))
    a, b = codes
    pair = Pair(source=s.sampled, target=t.sampled, source_code=a, target_code=b, offset=offset / radius)
    starts = candidate_poses(pair, config, upright)
    config = dataclasses.replace(config, keep_starts=HYPOTHESES)
    poses, costs = search(starts, s, t, pair, config, upright)
    off = jnp.zeros((HYPOTHESES, 2))
    if asks_prior(config, upright):
        off = off_fields(prior, poses, pair, (s, t))
        order = jnp.argsort(costs + doubts(costs, off.mean(axis=1), config.field_weight))
        poses, off = jax.tree.map(lambda x: x[order], (poses, off))
    T = jax.tree.map(lambda x: x[0], poses)
    there, back = misfits_both_ways(T, s, t, (config.truncation,))
    return Evidence(
        of_source=there,
        of_target=back,
        lift=jnp.abs(T.translation()[2] - pair.offset[2]) * radius,
        radius=radius,
        off_source=off[0, 0],
        off_target=off[0, 1],
        off_own=jnp.zeros(()),
        poses=jaxlie.SE3.from_rotation_and_translation(poses.rotation(), poses.translation() * radius),
    )


def asks_prior(config: RegistrationConfig, upright: bool) -> bool:
    """Whether completed surfaces are evidence of who is who."""
    return not upright and config.field_weight > 0
