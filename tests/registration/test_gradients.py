"""Gradients through registration: finite differences confirm them, and both modes agree; masks may be closed over."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pieces
import pytest

from more2_jax.config import DescentRegistration, FieldRegistration, SurfaceRegistration, SurfaceSearch
from more2_jax.network.prior import encode
from more2_jax.registration.pair_batch import batch_of, pair_up
from more2_jax.registration.register_pairs import register
from more2_jax.types import PointCloud

COUNT = 64
MASK = np.ones((2, COUNT), bool)  # closed over by what is compiled
DESCENT = DescentRegistration(points=32, sdf_points=32, steps=5, icp_steps=2)
FIELD = FieldRegistration(search_points=16, search_steps=2, points=32, steps=3)
SURFACE = SurfaceRegistration(
    search=SurfaceSearch(points=32, dense=64, cells=8, keep=2, steps=4),
    points=32,
    steps=3,
    field_points=32,
    polish_points=32,
    polish_steps=2,
)


def start(degrees):
    """One candidate of one pair."""
    turn = jaxlie.SO3.from_z_radians(jnp.deg2rad(jnp.array(degrees)))
    return jaxlie.SE3(jaxlie.SE3.from_rotation(turn).wxyz_xyz[None, None])


def loss_with(method, candidates=None):
    """What registration ends with, as a function of both clouds (n, 3) and the prior; codes follow or are given."""

    def loss(source, target, prior, codes=None):
        clouds = [PointCloud(points=x[None], mask=MASK[:1]) for x in (source, target)]
        codes = codes or codes_of(prior, source, target)
        pairs = pair_up(*map(batch_of, clouds, codes), candidates=candidates)
        return register(prior, pairs, method).loss[0]

    return loss


def codes_of(prior, *clouds):
    """Of both clouds, encoded together."""
    both = encode(prior, PointCloud(points=jnp.stack([jnp.asarray(x) for x in clouds]), mask=MASK))
    return [jax.tree.map(lambda x, k=k: x[k : k + 1], both) for k in range(2)]


@pytest.fixture(scope="module")
def clouds():
    rng = np.random.default_rng(0)
    cloud = pieces.surface(pieces.without_symmetry()[4], COUNT) - [0, 0, 0.4]
    turned = pieces.apply(pieces.random_pose(rng, upright=False, reach=0.1), cloud)
    return cloud + 0.01 * rng.normal(size=cloud.shape), turned


@pytest.mark.slow
def test_gradient_through_encoder_kabsch_and_refinement_agrees_with_finite_differences(tiny_prior, clouds):
    """In float64; with the codes given also forward, which the encoder is not made for."""
    rng = np.random.default_rng(0)
    with jax.enable_x64(True):
        params = jax.tree.map(lambda x: jnp.asarray(x, jnp.float64), tiny_prior.params)
        prior = dataclasses.replace(tiny_prior, params=params)
        source, target = (jnp.asarray(x) for x in clouds)
        codes, loss = codes_of(prior, source, target), loss_with(DESCENT)

        def slopes(x, way, given):
            """The loss, and its slope by reverse and by forward mode."""
            value, gradient = jax.value_and_grad(lambda x: loss(x, target, prior, given))(x)
            if given is None:
                return value, gradient, jnp.vdot(gradient, way)
            return value, gradient, jax.jvp(lambda x: loss(x, target, prior, given), (x,), (way,))[1]

        for given in (None, codes):
            slopes_of = jax.jit(lambda x, way, given=given: slopes(x, way, given))
            for _ in range(4):
                way, eps = jnp.asarray(rng.normal(size=source.shape)), 1e-6
                after, before = (slopes_of(source + s * way, way)[0] for s in (eps, -eps))
                slope = (after - before) / (2 * eps)
                _, gradient, forward = slopes_of(source, way)
                assert gradient.dtype == jnp.float64 and bool(jnp.isfinite(gradient).all())
                assert float(jnp.abs(gradient).max()) > 1e-4
                along = float(jnp.vdot(gradient, way))
                assert along == pytest.approx(float(slope), rel=1e-3)
                assert float(forward) == pytest.approx(along, rel=1e-6)


@pytest.mark.slow
def test_gradient_through_steps_on_the_fields_agrees_with_finite_differences(tiny_prior, clouds):
    """In float64 and over differences so small that they cross no kink of a ReLU, where a field's slope jumps."""
    rng = np.random.default_rng(0)
    with jax.enable_x64(True):
        params = jax.tree.map(lambda x: jnp.asarray(x, jnp.float64), tiny_prior.params)
        prior = dataclasses.replace(tiny_prior, params=params)
        source, target = (jnp.asarray(x) for x in clouds)
        codes, loss = codes_of(prior, source, target), loss_with(FIELD, start(10.0))

        def of_one(x):
            return loss(x, target, prior, codes)

        @jax.jit
        def slopes(x, way):
            value, gradient = jax.value_and_grad(of_one)(x)
            return value, jnp.vdot(gradient, way), jax.jvp(of_one, (x,), (way,))[1]

        for _ in range(3):
            way, eps = jnp.asarray(rng.normal(size=source.shape)), 1e-10
            after, before = (float(slopes(source + s * way, way)[0]) for s in (eps, -eps))
            _, along, forward = map(float, slopes(source, way))
            assert abs(along) > 1e-4
            assert along == pytest.approx((after - before) / (2 * eps), rel=1e-3)
            assert forward == pytest.approx(along, rel=1e-6)


METHODS = {
    "descent": (DESCENT, start(10.0)),
    "surface": (SURFACE, start(10.0)),
    "surface without candidates": (SURFACE, None),
}
CASES = list(itertools.product(METHODS, ["source", "target"]))


def slopes_of_one(prior, clouds, method, moved):
    """The loss by one cloud, that cloud, and the loss with its slopes in both modes; the rest are constants of it."""
    both = [jnp.asarray(x, jnp.float32) for x in clouds]
    codes, loss = codes_of(prior, *both), loss_with(*METHODS[method])

    def of_one(x):
        given = [x, both[1]] if moved == "source" else [both[0], x]
        return loss(*given, prior, codes)

    def slopes(x, way):
        value, forward = jax.jvp(of_one, (x,), (way,))
        return value, forward, jax.grad(of_one)(x)

    return of_one, both[moved == "target"], slopes


@pytest.mark.slow  # all are traced below, and the longest ways compiled above
@pytest.mark.parametrize(("method", "moved"), CASES)
def test_both_modes_agree_whichever_cloud_is_traced(tiny_prior, clouds, method, moved):
    """The other cloud and both codes are constants of the program."""
    of_one, cloud, slopes = slopes_of_one(tiny_prior, clouds, method, moved)
    way = jnp.asarray(np.random.default_rng(1).normal(size=cloud.shape), jnp.float32)
    value, forward, gradient = jax.jit(slopes)(cloud, way)
    assert bool(jnp.isfinite(gradient).all()) and float(jnp.abs(gradient).max()) > 1e-4
    assert float(forward) == pytest.approx(float(jnp.vdot(gradient, way)), rel=2e-3)
    assert float(value) == pytest.approx(float(of_one(cloud)), rel=1e-3)


@pytest.mark.parametrize(("method", "moved"), CASES)
def test_both_modes_take_either_cloud(tiny_prior, clouds, method, moved):
    """Traced, not compiled: no constant and no rule of differentiation stands in the way."""
    _, cloud, slopes = slopes_of_one(tiny_prior, clouds, method, moved)
    value, forward, gradient = jax.eval_shape(slopes, cloud, cloud)
    assert (value.shape, forward.shape, gradient.shape) == ((), (), cloud.shape)


@pytest.mark.slow
def test_gradients_through_the_encoder_reach_surface_registration(tiny_prior, clouds):
    source, target = (jnp.asarray(x, jnp.float32) for x in clouds)
    gradient = jax.jit(jax.grad(loss_with(SURFACE, start(10.0))))(source, target, tiny_prior)
    assert bool(jnp.isfinite(gradient).all()) and float(jnp.abs(gradient).max()) > 1e-4
