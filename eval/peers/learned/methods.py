"""Trained peers as the tables of matching, registration, reconstruction and the whole task take them."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float

from eval.peers.end_to_end import REJECT, Stages
from eval.peers.learned.clouds import centered, thinned
from eval.peers.learned.occupancy_mesh import surface
from eval.peers.learned.registry import TASKS, Params, Trained, load, of_task
from eval.peers.matching import Matched, Matcher, assigned
from eval.peers.reconstruction import Surfacer
from eval.peers.registration import FEWEST, Registrar, best_fit, diagonal
from more2_jax.geometry.poses import Points, Pose
from more2_jax.types import Instance


def learned_matchers(given: tuple[str, ...]) -> dict[str, Matcher]:
    """By title: Hungarian on the cosine of codes. ValueError as `of_task`."""
    return {t.peer.title: partial(by_code, t) for t in of_task(given, "matching")}


def learned_surfacers(given: tuple[str, ...]) -> dict[str, Surfacer]:
    """By title: the surface of the occupancy. ValueError as `of_task`."""
    return {t.peer.title: partial(surface, t) for t in of_task(given, "reconstruction")}


def learned_registrars(given: tuple[str, ...]) -> dict[str, Registrar]:
    """By title: the network alone, and with GICP after it. ValueError as `of_task`."""
    found: dict[str, Registrar] = {}
    for t in of_task(given, "registration"):
        found |= {t.peer.title: partial(by_network, t), f"{t.peer.title} + GICP": partial(then_gicp, t)}
    return found


def learned_stages(given: tuple[str, ...], upright: bool) -> dict[str, Stages]:
    """The whole task by one peer a stage, each at what it is trained for; none where none is asked for.

    Raises ValueError as `load`, and unless there is one of each stage.
    """
    found = {t.peer.task: t for t in map(load, given)}
    if not given:
        return {}
    if len(given) != len(TASKS) or set(found) != set(TASKS):
        asked = ", ".join(f"{t.peer.title} ({k})" for k, t in found.items())
        raise ValueError(f"learned peers {asked}; needed one of each of {', '.join(TASKS)}")
    matcher, registrar, surfacer = (found[task] for task in TASKS)
    stages = Stages(
        match=partial(by_code, matcher),
        register=partial(fit_gicp, registrar, upright=upright),
        surface=partial(surface, surfacer),
        reject=REJECT,  # codes tell no distance, so matching rejects nothing
    )
    return {" + ".join((matcher.peer.title, registrar.peer.title, "GICP", surfacer.peer.title)): stages}


@partial(jax.jit, static_argnames="network")
def _codes(
    network: nn.Module, params: Params, points: Float[Array, "1 n 3"], mask: Bool[Array, "1 n"]
) -> Float[Array, "1 code"]:
    of_cloud = partial(network.apply, params, method="unit_code")
    return jax.vmap(of_cloud)(points, mask)  # type: ignore[arg-type]


def codes(trained: Trained, clouds: Sequence[Points]) -> Float[np.ndarray, "b code"]:
    """A unit code a cloud."""
    points, mask, _ = thinned(clouds, trained.peer.points)
    one = partial(_codes, trained.peer.network, trained.params)
    return np.concatenate([np.asarray(one(p[None], m[None])) for p, m in zip(points, mask, strict=True)])


def by_code(trained: Trained, one: Sequence[Instance], other: Sequence[Instance]) -> Matched:
    """Hungarian on the cosine."""
    if not one or not other:
        return {}
    found = codes(trained, [i.points for i in (*one, *other)])
    return assigned(one, other, -found[: len(one)] @ found[len(one) :].T)


@partial(jax.jit, static_argnames=("network", "upright"))
def _pose(
    network: nn.Module, params: Params, points: Float[Array, "2 n 3"], mask: Bool[Array, "2 n"], upright: bool
) -> tuple[Float[Array, "4 4"], Float[Array, "2 3"], Float[Array, ""]]:
    source, target = (centered(points[i], mask[i]) for i in (0, 1))
    unit = target.radius
    clouds = source.points * source.radius / unit, mask[0], target.points, mask[1]
    T: Any = network.apply(params, *clouds, upright, method="pose")
    return T, jnp.stack([source.mean, target.mean]), unit


def by_network(trained: Trained, source: Points, target: Points, upright: bool) -> Pose | None:
    """The network's own pose from no start but the clouds' means, meters; None of next to nothing."""
    if min(len(source), len(target)) < FEWEST:
        return None
    points, mask, origin = thinned([source, target], trained.peer.points)
    T, means, unit = map(np.asarray, _pose(trained.peer.network, trained.params, points, mask, upright))
    if not np.isfinite(T).all():
        return None
    means = means + origin
    pose = np.eye(4)
    pose[:3, :3] = T[:3, :3]
    pose[:3, 3] = T[:3, 3] * float(unit) + means[1] - T[:3, :3] @ means[0]
    return pose


def then_gicp(trained: Trained, source: Points, target: Points, upright: bool) -> Pose | None:
    """The network's pose, refined by GICP as those of the peers that learn nothing."""
    found = fit_gicp(trained, source, target, upright)
    return None if found is None else found[0]


def fit_gicp(trained: Trained, source: Points, target: Points, upright: bool) -> tuple[Pose, float] | None:
    """`then_gicp`, and how far the clouds then lie apart (shares of the diagonal)."""
    found = by_network(trained, source, target, upright)
    if found is None:
        return None
    # As `best_fit` takes it: between clouds about their means, in the target's diagonals.
    start = found.copy()
    R, means = found[:3, :3], (source.mean(axis=0), target.mean(axis=0))
    start[:3, 3] = (found[:3, 3] + R @ means[0] - means[1]) / diagonal(target)
    return best_fit(source, target, [start])
