"""A widened prior is the narrow one until it trains, and everything new in it trains."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax.traverse_util import flatten_dict
from places import ROOT

from more2_jax.config import DecoderConfig, EncoderConfig, PriorConfig, load_config
from more2_jax.geometry.points import farthest_points
from more2_jax.network.prior import Prior, encode_ordered, init_prior, load_prior, sdf_one
from train.run.settings import TrainingRun
from train.tools import widen as program
from train.tools.widen import source_layer, widen

pytestmark = pytest.mark.no_cover

NARROW = PriorConfig(
    encoder=EncoderConfig(
        widths=(8, 8, 16), code=12, neighbors=4, head_channels=8, points=32, output_scale=100.0,
        downsample_blocks=(2,), downsample_factors=(2,),
    ),
    decoder=DecoderConfig(
        hidden=32, layers=4, skip_layer=2, dropout=0.0, narrow_skip=False, local_blocks=(1, 2), local_channels=4,
        bandwidths=(0.2, 0.4),  # thin ones magnify rounding
    ),
    eqv_gain=3.0,
    inv_gain=12.0,
)  # fmt: skip


@functools.cache
def narrow_prior() -> Prior:
    return init_prior(NARROW, jax.random.key(1))


def changed(config: PriorConfig, encoder: dict | None = None, decoder: dict | None = None) -> PriorConfig:
    return dataclasses.replace(
        config,
        encoder=dataclasses.replace(config.encoder, **(encoder or {})),
        decoder=dataclasses.replace(config.decoder, **(decoder or {})),
    )


WIDE = dataclasses.replace(
    changed(
        NARROW,
        {"widths": (8, 24, 32), "code": 21},
        {"hidden": 48, "layers": 7, "skip_layer": 3},
    ),
    eqv_gain=5.0,
    inv_gain=20.0,
)
# Wider and deeper everywhere, in the encoder alone, in the decoder alone.
WIDER = {
    "all": WIDE,
    "encoder": changed(NARROW, {"widths": (16, 16, 48)}),
    "decoder": changed(NARROW, decoder={"hidden": 40, "layers": 6}),
}


def clouds(points: int, count: int = 3) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Noisy ellipsoids off the origin with a few masked rows, in farthest-point order; queries around them."""
    rng = np.random.default_rng(0)
    raw = rng.normal(size=(count, 2 * points, 3))
    raw = raw / np.linalg.norm(raw, axis=-1, keepdims=True) * rng.uniform(0.2, 0.5, (count, 1, 3)) + 0.3
    raw += 0.01 * rng.normal(size=raw.shape)
    real = np.ones((count, 2 * points), bool)
    real[0, points - 5 :] = False
    ordered = jax.vmap(lambda p, m: farthest_points(p, m, points))(jnp.asarray(raw, jnp.float32), real)
    queries = rng.uniform(-0.6, 0.6, (count, 50, 3))
    return *ordered, jnp.asarray(queries, jnp.float32)


@jax.jit
def outputs(prior: Prior, points: jax.Array, mask: jax.Array, queries: jax.Array) -> dict[str, jax.Array]:
    """Codes of clouds, their center, and distances around it, in units of the size of clouds."""
    codes = jax.vmap(functools.partial(encode_ordered, prior))(points, mask)
    # Random weights have any F_s: queries spread accordingly.
    asked = queries * codes.scale[:, None, None] + codes.center[:, None]
    sdf = jax.vmap(functools.partial(sdf_one, prior))(codes, asked)
    return {"inv": codes.inv, "eqv": codes.eqv, "scale": codes.scale, "center": codes.center, "sdf": sdf}


@pytest.mark.slow
@pytest.mark.parametrize("wider", WIDER)
def test_codes_and_distances_stay(wider):
    narrow = narrow_prior()
    wide = widen(narrow, WIDER[wider], jax.random.key(2))
    assert_same(outputs(narrow, *clouds(32)), outputs(wide, *clouds(32)))


@pytest.mark.slow
def test_base_begins_as_the_shipped_small():
    config = load_config(ROOT / "configs" / "base.yaml", TrainingRun).model
    narrow = load_prior("small")
    same = {k: getattr(narrow.config.encoder, k) for k in ("points", "neighbors", "downsample_factors")}
    wide = widen(narrow, changed(config, same), jax.random.key(0))
    assert_same(outputs(narrow, *clouds(256, 2)), outputs(wide, *clouds(256, 2)))


def assert_same(narrow: dict[str, jax.Array], wide: dict[str, jax.Array]) -> None:
    """To 1e-4 of the largest; new channels of the code are zero."""
    for name, before in narrow.items():
        extra = [(0, 0)] * (before.ndim - 1) + [(0, wide[name].shape[-1] - before.shape[-1])]
        padded = np.pad(before, extra) if before.ndim > 1 else before
        assert np.ptp(before) > 0
        np.testing.assert_allclose(wide[name], padded, rtol=0, atol=1e-4 * np.abs(before).max(), err_msg=name)


@pytest.mark.slow
def test_everything_new_is_reached_by_a_gradient():
    """At once, or after the one step that moves what leads from it off zero."""
    before_widening = narrow_prior()
    wide = widen(before_widening, WIDE, jax.random.key(2))
    points, mask, queries = clouds(32)
    rng = np.random.default_rng(1)

    @jax.jit
    @jax.grad
    def gradient(params, *asked):
        found = outputs(dataclasses.replace(wide, params=params), *asked)
        directions = {k: jnp.asarray(rng.normal(size=v.shape)) for k, v in found.items()}
        return sum((jnp.sum(directions[k] * v) for k, v in found.items()), jnp.zeros(()))

    first = gradient(wide.params, points, mask, queries)
    moved = jax.tree.map(lambda p, g: p - 1e-3 * np.sign(g), wide.params, jax.device_get(first))
    reached: dict[str, Any] = dict(flatten_dict(gradient(moved, points, mask, queries), sep="/"))
    narrow: dict[str, Any] = dict(flatten_dict(before_widening.params, sep="/"))
    for name, g in reached.items():
        assert np.isfinite(g).all(), name
        before = narrow[name].shape if name in narrow else (0,) * g.ndim
        for axis in range(g.ndim):
            new = np.moveaxis(np.abs(g), axis, 0)[before[axis] :]
            largest = new.max(axis=tuple(range(1, g.ndim)))
            # A hidden unit may be off, and a direction's gate open, at all that is asked.
            least = 0.5 if "decoder/layer" in name or "direction" in name else 1.0
            assert not len(new) or (largest > 0).mean() >= least, (name, axis)


def test_new_layers_come_last_ahead_of_the_skip_and_last_of_all():
    before, after = DecoderConfig(layers=6, skip_layer=3), DecoderConfig(layers=8, skip_layer=4)
    assert [source_layer(n, before, after) for n in range(8)] == [0, 1, 2, None, 3, 4, 5, None]


@pytest.mark.parametrize(
    ("wanted", "message"),
    [
        (changed(NARROW, {"widths": (8, 8, 8)}), r"widths\[2\] is 8; needed 16 or more"),
        (changed(NARROW, {"widths": (8, 8, 20)}), "has 20; needed multiples of 8"),
        (changed(NARROW, {"widths": (8, 16)}), "encoder.widths has 2; needed 3"),
        (changed(NARROW, {"code": 8}), "code is 8; needed 12 or more"),
        (changed(NARROW, {"downsample_blocks": (1,)}), "downsample_blocks is"),
        (changed(NARROW, decoder={"hidden": 16}), "hidden is 16"),
        (changed(NARROW, decoder={"layers": 4, "skip_layer": 3}), "after the skip is 1; needed 2"),
        (changed(NARROW, decoder={"layers": 4, "skip_layer": 1}), "skip_layer is 1"),
        (changed(NARROW, decoder={"bandwidths": (0.1,)}), r"bandwidths is \(0.1,\); needed"),
        (changed(NARROW, decoder={"local_channels": 8}), "local_channels is 8"),
        (changed(NARROW, decoder={"narrow_skip": True}), "narrow_skip is true"),
    ],
)
def test_what_cannot_be_widened_is_refused_in_one_line(wanted, message):
    with pytest.raises(ValueError, match=message) as refused:
        widen(narrow_prior(), wanted, jax.random.key(0))
    assert "\n" not in str(refused.value)


@pytest.mark.slow
def test_the_program_writes_what_training_starts_from(tmp_path):
    out = tmp_path / "wide.npz"
    program.main("small", ROOT / "configs" / "base.yaml", out)
    wide = load_prior(out)
    config = load_config(ROOT / "configs" / "base.yaml", TrainingRun).model
    assert (wide.name, wide.config.decoder) == ("wide", config.decoder)
    scale = wide.config.encoder.output_scale
    assert wide.config.encoder == dataclasses.replace(config.encoder, output_scale=scale)
