"""Padded clouds to poses and values in one program: its slopes are what central differences say, in float64."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from traced_scene import DESCENT, SURFACE, poses_and_values

import more2_jax as m2

OBJECTS, ROWS, STEP = 2, 256, 1e-8  # no neighbor changes within the step of a difference
MASK = np.arange(ROWS) < np.array([[200], [230]])
SCANS = 2
TURN, MOVED_M = np.array([[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, 1]]), [0.4, -0.2, 0.1]
METHODS = {"descent": DESCENT, "surface": SURFACE}


def scans() -> np.ndarray:
    """Two noisy ellipsoids, then again, turned and moved; what stands in the padding is not a number."""
    rng = np.random.default_rng(0)
    unit = rng.normal(size=(OBJECTS, ROWS, 3))
    unit /= np.linalg.norm(unit, axis=-1, keepdims=True)
    clouds = unit * [[[0.5, 0.3, 0.2]], [[0.3, 0.4, 0.25]]]
    seen = clouds + 0.02 * rng.normal(size=(SCANS, *clouds.shape))
    seen[1] = seen[1] @ TURN.T + MOVED_M
    return np.where(MASK[..., None], seen, np.nan)


@pytest.fixture(scope="module")
def prior64(tiny_prior):
    with jax.enable_x64(True):
        yield jax.tree.map(lambda x: x.astype(jnp.float64), tiny_prior)


def sensitive(x):
    """One number that depends on every entry."""
    return jnp.sum(x * jnp.cos(jnp.arange(x.size)).reshape(x.shape))


def test_it_traces_in_reverse_from_clouds_to_every_result(tiny_prior):
    def total(clouds):
        return sum(map(sensitive, poses_and_values(tiny_prior, clouds, MASK, DESCENT).values()))

    at = jax.ShapeDtypeStruct((SCANS, OBJECTS, ROWS, 3), jnp.float32)
    assert jax.eval_shape(jax.jit(jax.grad(total)), at).shape == at.shape


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_slopes_by_both_clouds_are_those_of_central_differences(prior64, method):
    @jax.jit
    def numbers(clouds, prior):
        found = poses_and_values(prior, clouds, MASK, METHODS[method])
        return {name: sensitive(x) for name, x in found.items()}

    @jax.jit
    def slopes(clouds, prior, chosen):  # one program in reverse, whatever is asked about
        found = jax.grad(lambda x: sum(chosen[k] * v for k, v in numbers(x, prior).items()))
        return found(clouds)

    at, rng = jnp.asarray(scans()), np.random.default_rng(2)
    for name in ("pose", "sdf", "surface"):
        along = np.where(MASK[..., None], rng.normal(size=at.shape), 0.0)
        chosen = {k: float(k == name) for k in ("pose", "sdf", "surface")}
        gradient = np.asarray(slopes(at, prior64, chosen))
        assert not gradient[:, ~MASK].any()
        moved = [numbers(at + side * STEP * along, prior64)[name] for side in (1, -1)]
        difference = float(moved[0] - moved[1]) / (2 * STEP)
        assert abs(difference) > 1e-3, "hardly depends on the clouds: the comparison could not fail"
        assert np.vdot(gradient, along) == pytest.approx(difference, rel=1e-5)
        # Poses depend on both scans' clouds, fields on their own scan's.
        assert [bool(np.abs(x).max() > 0) for x in gradient] == [name == "pose", True]


@pytest.mark.slow
def test_one_program_gives_what_its_parts_give_one_by_one(prior64):
    at = jnp.asarray(np.nan_to_num(scans()))
    found = jax.jit(lambda x, prior: poses_and_values(prior, x, MASK, DESCENT))(at, prior64)
    first, second = (m2.PointCloud(points=x, mask=MASK) for x in at)
    sides = [m2.batch_of(cloud, m2.encode(prior64, cloud)) for cloud in (second, first)]
    pose = m2.register(prior64, m2.pair_up(*sides), DESCENT).T_target_source
    np.testing.assert_allclose(found["pose"], pose.wxyz_xyz, atol=1e-6)
