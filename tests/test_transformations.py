"""Public functions under JAX's transformations, and the precision of every product in what is compiled of them.

Traced, not run: CPUs compute in float32 whatever precision is asked for, so what accelerators are told is read from
the programs.
"""

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from traced_scene import DESCENT, SURFACE, little

import more2_jax as m2
from more2_jax.config import CodeMatcher, FieldRegistration, JointConfig
from more2_jax.geometry.full_precision import full_precision
from more2_jax.meshing.device.values import observed_object, surface_values
from more2_jax.network.prior import encode_ordered
from more2_jax.refinement.joint import Observations
from more2_jax.refinement.pose_graph import OrientedObservations, optimize_pose_graphs

ROWS, REAL, OBJECTS, SEEN = 256, 200, 3, 2
MASK = np.arange(ROWS) < np.full((OBJECTS, 1), REAL)  # closed over
FIELD = FieldRegistration(turns=2, search_points=16, search_steps=1, keep=1, points=32, steps=2)
JOINT = JointConfig(steps=2, points=32)
# Traced as they are and in reverse mode they are for their products' precision, below.
TRANSFORMATIONS = {
    "vmap": lambda f: jax.jit(lambda x: jax.vmap(f)(jnp.stack([x, x]))),
    "jvp": lambda f: jax.jit(lambda x: jax.jvp(f, (x,), (x,))),
}


def points() -> np.ndarray:
    cloud = np.random.default_rng(0).normal(size=(OBJECTS, ROWS, 3)) * [0.5, 0.3, 0.2]
    return cloud.astype(np.float32)


def cloud_of(x):
    return m2.PointCloud(points=x, mask=MASK)


def number(tree) -> jax.Array:
    """The sum of every number that is not an integer."""
    leaves = [x for x in jax.tree.leaves(tree) if jnp.issubdtype(x.dtype, jnp.floating)]
    return sum((x.sum() for x in leaves), jnp.zeros(()))


@pytest.fixture(scope="module")
def code(tiny_prior):
    return jax.jit(m2.encode)(tiny_prior, cloud_of(jnp.asarray(points())))


def pairs_of(x, code):
    """The clouds onto those of `points`."""
    return m2.pair_up(m2.batch_of(cloud_of(x), code), m2.batch_of(cloud_of(jnp.asarray(points())), code))


def observations_of(x, code):
    """Every cloud as seen twice."""
    return Observations(
        points=jnp.stack([x] * SEEN, axis=1),
        mask=np.stack([MASK] * SEEN, axis=1),
        real=np.ones((OBJECTS, SEEN), bool),
        codes=jax.tree.map(lambda a: jnp.stack([a] * SEEN, axis=1), code),
        T_ref_obs=jaxlie.SE3.identity((OBJECTS, SEEN)),
        accumulated=code,
    )


def oriented(x):
    """The same for alignment, their own directions taken for normals."""
    seen = jnp.stack([x] * SEEN, axis=1)
    mask = np.stack([MASK] * SEEN, axis=1)
    return OrientedObservations(points=seen, normals=seen, mask=mask, residual=jnp.ones(OBJECTS))


def surface_of(x, prior, code):
    """Values of the first object's surface."""
    first = jax.tree.map(lambda a: a[0], code)
    return surface_values(prior, observed_object(first, x[0], MASK[0]), little())


# By name, functions of the clouds' points, a prior and their codes; all but the first argument is closed over.
PROGRAMS = {
    "encode": lambda x, prior, code: m2.encode(prior, cloud_of(x)),
    "encode_ordered": lambda x, prior, code: encode_ordered(prior, x[0, :64], jnp.ones(64, bool)),
    "sdf": lambda x, prior, code: m2.sdf(prior, code, x),
    "sdf, own code": lambda x, prior, code: m2.sdf(prior, m2.encode(prior, cloud_of(x)), x),
    "register, descent": lambda x, prior, code: m2.register(prior, pairs_of(x, code), DESCENT),
    "register, field": lambda x, prior, code: m2.register(prior, pairs_of(x, code), FIELD, "upright"),
    "register, surface": lambda x, prior, code: m2.register(prior, pairs_of(x, code), SURFACE),
    "register, upright": lambda x, prior, code: m2.register(prior, pairs_of(x, code), SURFACE, "upright"),
    "surface_values": surface_of,
    "fit_jointly": lambda x, prior, code: m2.fit_jointly(prior, observations_of(x, code), JOINT),
    "optimize_pose_graphs": lambda x, prior, code: optimize_pose_graphs(oriented(x), 2, "free"),
    "kabsch": lambda x, prior, code: m2.kabsch(x[0], x[1] ** 2, jnp.ones(ROWS)),
    "chamfer_distance": lambda x, prior, code: m2.chamfer_distance(
        x[0], jnp.asarray(MASK[0]), x[1], jnp.asarray(MASK[1])
    ),
    "match_instances": lambda x, prior, code: m2.match_instances(
        m2.encode(prior, cloud_of(x)), code, CodeMatcher()
    ),
}


def of_points(name, prior, code):
    """A program as a function of the clouds' points to one number."""
    return lambda x: number(PROGRAMS[name](x, prior, code))


@pytest.mark.parametrize("transformation", TRANSFORMATIONS)
@pytest.mark.parametrize("name", PROGRAMS)
def test_public_functions_trace(tiny_prior, code, name, transformation):
    f = TRANSFORMATIONS[transformation](of_points(name, tiny_prior, code))
    assert jax.tree.leaves(jax.eval_shape(f, jnp.asarray(points())))


def test_jitted_registration_takes_its_settings_as_they_are(tiny_prior, code):
    pairs = pairs_of(jnp.asarray(points()), code)
    plain = m2.register(tiny_prior, pairs, DESCENT)
    for jitted in (
        jax.jit(m2.register)(tiny_prior, pairs, DESCENT),
        jax.jit(m2.register, static_argnames="motion")(tiny_prior, pairs, DESCENT, motion="upright"),
    ):
        np.testing.assert_allclose(jitted.loss, plain.loss, rtol=1e-4)
    observations = observations_of(jnp.asarray(points()), code)
    joint = m2.fit_jointly(tiny_prior, observations, JOINT)
    again = jax.jit(m2.fit_jointly)(tiny_prior, observations, JOINT)
    np.testing.assert_allclose(again.loss, joint.loss, rtol=1e-4)


# --- precision ----------------------------------------------------------------------------------------------------


def products(jaxpr) -> Iterator[tuple]:
    """The precision of every product of matrices in a program and in all that it calls."""
    for equation in jaxpr.eqns:
        if equation.primitive.name == "dot_general":
            yield equation.params["precision"]
        for value in jax.tree.leaves(list(equation.params.values()), is_leaf=is_program):
            if is_program(value):
                yield from products(getattr(value, "jaxpr", value))


def is_program(x) -> bool:
    """Whether a parameter of an equation is itself a program."""
    return hasattr(getattr(x, "jaxpr", x), "eqns")


def coarse(f, *at) -> tuple[int, int]:
    """How many products of a function leave their precision to a default of bfloat16, and how many there are."""
    with jax.default_matmul_precision("bfloat16"):
        found = list(products(jax.make_jaxpr(f)(*at).jaxpr))
    exact = (jax.lax.Precision.HIGHEST, jax.lax.Precision.HIGHEST)
    return sum(p != exact for p in found), len(found)


WITHOUT_PRODUCTS = {"chamfer_distance"}


@pytest.mark.parametrize("name", list(PROGRAMS))
def test_no_product_is_left_to_the_default_precision(tiny_prior, code, name):
    f, x = of_points(name, tiny_prior, code), jnp.asarray(points())
    for g in (jax.jit(f), jax.jit(jax.grad(f))):
        left, count = coarse(g, x)
        assert left == 0
        assert count > 0 or name in WITHOUT_PRODUCTS


def test_no_product_is_left_to_the_default_where_weights_are_differentiated(tiny_prior, code):
    x = jnp.asarray(points())
    for name in ("sdf, own code", "register, descent", "fit_jointly"):
        left, count = coarse(jax.grad(lambda p, name=name: number(PROGRAMS[name](x, p, code))), tiny_prior)
        assert left == 0 and count > 20


def test_training_leaves_products_with_weights_to_the_default(tiny_prior):
    x, mask = jnp.asarray(points()[0, :64]), jnp.ones(64, bool)
    left, count = coarse(lambda x: encode_ordered(tiny_prior, x, mask, train=True), x)
    assert 0 < left < count


def test_full_precision_is_that_of_products_and_their_derivatives():
    def squared(x):
        return (x.T @ x).sum()

    x = jnp.ones((4, 3))
    assert coarse(squared, x) == (1, 1)
    assert coarse(full_precision(squared), x) == (0, 1)
    left, count = coarse(jax.grad(full_precision(squared)), x)
    assert left == 0 and count > 1
