"""Who is who by geometry: every candidate pair of objects aligned from many starts, and how well it then fits.

Beyond the paper (preset `robust`): the embedding proposes, surfaces decide. A pair costs some milliseconds, since
clouds are prepared once and compared by tables of nearest points. In any orientation more poses fit by chance, and no
heights tell pairs apart: there the prior is asked too, whether each cloud lies on what it completes the other to.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jax import Array
from jaxtyping import Float, Int

from more2_jax.alignment import Surface, scale_surface, whole_surface
from more2_jax.config import RegistrationConfig
from more2_jax.geometry import cloud_radius
from more2_jax.prior import Prior
from more2_jax.starts import Pair, candidate_poses
from more2_jax.surface_registration import (
    LIFTED,
    coarse_of,
    doubts,
    misfits_both_ways,
    off_field,
    off_fields,
    search,
)
from more2_jax.types import Embedding, PointCloud, pytree, scale_embedding

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
    lift: Float[Array, "*pairs"]  # change of height, metres
    radius: Float[Array, "*pairs"]  # of the target, metres
    # How far, 0 to 1, the source's points lie off the target's completed surface, the target's off the source's, and
    # either off its own at most: what the prior does not even know. All 0 where that is not asked.
    off_source: Float[Array, "*pairs"]
    off_target: Float[Array, "*pairs"]
    off_own: Float[Array, "*pairs"]
    poses: jaxlie.SE3  # (*pairs, `HYPOTHESES`): source's local frame to target's, best first, metres


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

    `offset`: where the source's local zero lies as the target sees it, when the scans share a frame, metres.
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


@dataclass(frozen=True, kw_only=True)
class Compared:
    """What is known of pairs without aligning them."""

    size: Float[np.ndarray, "*pairs"]  # |log| of the ratio of the F_s
    likeness: Float[np.ndarray, "*pairs"]  # cosine of the F_inv
    top_m: Float[np.ndarray, "*pairs"]  # difference of the heights of their highest points
    color: Float[np.ndarray, "*pairs"]  # log likelihood ratio of their colours (`color.color_evidence`)


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """Log odds that two clouds show one object, linear in what is known of the pair (docs/relocalisation.md)."""

    intercept: float
    nearer: float  # of the smaller mean truncated distance of the two ways,
    farther: float  # and of the larger
    size: float
    likeness: float
    lift: float = 0.0  # of a change of height, in shares of `LIFTED` of the radius, at most 1
    top: float = 0.0  # of `top_m`, in shares of the radius, at most `HIGHEST`
    off_less: float = 0.0  # of the smaller distance off the other's completed surface,
    off_more: float = 0.0  # and of the larger


HIGHEST = 0.2
UNKNOWN = 0.5  # of `off_own`: a prior that lays a cloud so far off its own surface has no say
# Logistic regression on pairs of validation rooms; how, and how well it holds, is in docs/relocalisation.md.
UPRIGHT = Calibration(intercept=3.7, nearer=-6.9, farther=-1.0, size=-2.7, likeness=2.6, lift=-2.5, top=-21.0)
FREE = Calibration(
    intercept=2.6, nearer=-6.9, farther=0.0, size=-4.0, likeness=7.25, off_less=-11.1, off_more=-6.5
)
# Without the prior's say.
UNASKED = Calibration(intercept=1.2, nearer=-9.9, farther=-3.3, size=-4.2, likeness=5.7)


def calibrated(
    evidence: Evidence, compared: Compared, config: RegistrationConfig, upright: bool
) -> Float[np.ndarray, "*pairs"]:
    """`log_odds` as these settings were calibrated; `upright`: things stand on the floor of one frame.

    Weights that know nothing of a pair's clouds have no say in it."""
    if upright:
        return log_odds(evidence, compared, UPRIGHT)
    unasked = log_odds(evidence, compared, UNASKED)
    if not asks_prior(config, upright):
        return unasked
    return np.where(np.asarray(evidence.off_own) <= UNKNOWN, log_odds(evidence, compared, FREE), unasked)


def log_odds(evidence: Evidence, compared: Compared, c: Calibration) -> Float[np.ndarray, "*pairs"]:
    """Of every pair to be one object."""
    return weighed(features(evidence, compared), c) + compared.color


def weighed(known: dict[str, Float[np.ndarray, "*pairs"]], c: Calibration) -> Float[np.ndarray, "*pairs"]:
    """Log odds of what is known (`features`) by a calibration; without colours."""
    parts = [getattr(c, name) * value for name, value in known.items()]
    return c.intercept + np.sum(parts, axis=0)


def features(evidence: Evidence, compared: Compared) -> dict[str, Float[np.ndarray, "*pairs"]]:
    """What each weight of a `Calibration` is multiplied with, by its name."""
    radius = np.asarray(evidence.radius)
    ways = np.stack([evidence.of_source, evidence.of_target])
    off = np.stack([evidence.off_source, evidence.off_target])
    return {
        "nearer": ways.min(axis=0),
        "farther": ways.max(axis=0),
        "size": compared.size,
        "likeness": compared.likeness,
        "lift": np.minimum(np.asarray(evidence.lift) / (LIFTED * radius), 1.0),
        "top": np.minimum(compared.top_m / radius, HIGHEST),
        "off_less": off.min(axis=0),
        "off_more": off.max(axis=0),
    }
