"""Joint optimization: never worse than its start, in the reference's frame, blind to padding."""

import dataclasses

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pieces
import pytest
from scipy.spatial.transform import Rotation

from more2_jax.config import JointConfig
from more2_jax.geometry.padding import pad_clouds
from more2_jax.geometry.transform import rescale, transform
from more2_jax.network.prior import encode
from more2_jax.refinement import joint
from more2_jax.refinement.joint import Observations, code_drift, fit_jointly, surface_loss

POINTS, OBJECTS, SEEN = 128, 3, 4  # every object seen three times, and one row of padding
CONFIG = JointConfig(
    points=POINTS,
    steps=15,
    inv_learning_rate=1e-3,
    eqv_learning_rate=1e-3,
    center_learning_rate=1e-3,
    pose_learning_rate=1e-3,
)
FROZEN = dataclasses.replace(
    CONFIG, inv_learning_rate=0.0, eqv_learning_rate=0.0, center_learning_rate=0.0, pose_learning_rate=0.0
)


def pose_group(T):
    return jaxlie.SE3.from_matrix(jnp.asarray(T, jnp.float32))


@pytest.fixture(scope="module")
def seen(tiny_prior):
    """Three pieces, each in three poses; poses given a little wrong; the last observation is padding."""
    rng = np.random.default_rng(0)
    clouds, poses = [], []
    for mesh in pieces.without_symmetry()[:OBJECTS]:
        cloud = pieces.surface(mesh, POINTS)
        cloud -= cloud.mean(axis=0)
        for j in range(SEEN):
            T = np.eye(4) if j == 0 else pieces.random_pose(rng, upright=True, reach=0.0)
            clouds.append(pieces.apply(np.linalg.inv(T), cloud))
            T = T.copy()
            T[:3, 3] += 0.02 * rng.normal(size=3) * (j > 0)
            poses.append(np.asarray(pose_group(T).wxyz_xyz))
    batch = pad_clouds(clouds, 256)
    codes = dataclasses.replace(encode(tiny_prior, batch), origin=None)
    real = jnp.arange(SEEN)[None].repeat(OBJECTS, axis=0) < SEEN - 1

    def split(x):
        return jnp.asarray(x).reshape(OBJECTS, SEEN, *x.shape[1:])

    codes = jax.tree.map(split, codes)
    return Observations(
        points=split(batch.points),
        mask=split(batch.mask),
        real=real,
        codes=codes,
        T_ref_obs=jaxlie.SE3(split(np.stack(poses))),
        accumulated=jax.tree.map(lambda x: x[:, 0], codes),
    )


@pytest.fixture(scope="module")
def fit(tiny_prior, seen):
    return fit_jointly(tiny_prior, seen, CONFIG)


@pytest.fixture(scope="module")
def unmoved(tiny_prior, seen):
    return fit_jointly(tiny_prior, seen, FROZEN)


def test_the_loss_never_ends_above_its_start(fit, unmoved):
    assert bool((fit.loss < unmoved.loss).all())


@pytest.mark.parametrize("start", ["best", "accumulated"])
def test_no_step_is_the_loss_of_the_start_by_definition(tiny_prior, seen, start):
    config = dataclasses.replace(CONFIG, steps=0, start=start)
    fit, loss_of = fit_jointly(tiny_prior, seen, config), jax.jit(surface_loss)
    for n in range(OBJECTS):
        one = joint.subsample(jax.tree.map(lambda x, n=n: x[n], seen), POINTS)
        radius = joint.cloud_radius(one.points[0], one.mask[0])
        one = rescale(one, 1 / radius)
        starts = [one.accumulated]
        if start == "best":
            own = [jax.tree.map(lambda x, j=j: x[j], (one.codes, one.T_ref_obs)) for j in range(SEEN - 1)]
            starts = [transform(code, T) for code, T in own]
        losses = [float(loss_of(tiny_prior, code, one.T_ref_obs, one)) for code in starts]
        assert min(abs(float(fit.loss[n]) - loss) for loss in losses) < 1e-4 * max(losses)


def test_the_reference_stays_where_it_is(fit):
    still = np.tile([1.0, 0, 0, 0, 0, 0, 0], (OBJECTS, 1))
    np.testing.assert_allclose(fit.T_ref_obs.wxyz_xyz[:, 0], still, atol=1e-6)


def test_the_reference_stays_where_it_is_given(tiny_prior, seen, unmoved):
    """Of a scan that was leveled its pose is a tilt about a point; the loss is that of the level scan."""
    G = jaxlie.SE3.from_rotation_and_translation(
        jaxlie.SO3.from_x_radians(jnp.float32(0.09)), jnp.array([0.1, -0.3, 0.2], jnp.float32)
    )
    tilted = dataclasses.replace(
        seen,
        T_ref_obs=jax.vmap(jax.vmap(lambda T: G @ T))(seen.T_ref_obs),
        accumulated=jax.vmap(lambda code: transform(code, G))(seen.accumulated),
    )
    given = np.broadcast_to(G.wxyz_xyz, (OBJECTS, 7))
    for config in (CONFIG, FROZEN):
        moved = fit_jointly(tiny_prior, tilted, config)
        np.testing.assert_allclose(moved.T_ref_obs.wxyz_xyz[:, 0], given, atol=1e-6)
    np.testing.assert_allclose(moved.loss, unmoved.loss, rtol=1e-4)
    np.testing.assert_allclose(moved.T_ref_obs.wxyz_xyz, tilted.T_ref_obs.wxyz_xyz, atol=1e-5)


def test_without_a_step_size_nothing_moves(seen, unmoved):
    np.testing.assert_allclose(unmoved.T_ref_obs.wxyz_xyz, seen.T_ref_obs.wxyz_xyz, atol=1e-5)
    codes = unmoved.embedding
    for n in range(OBJECTS):  # X*: the code of one of the observations, in the reference's frame
        moved = [
            transform(*jax.tree.map(lambda x, n=n, j=j: x[n, j], (seen.codes, seen.T_ref_obs)))
            for j in range(SEEN - 1)
        ]
        gaps = [
            max(float(jnp.abs(getattr(codes, k)[n] - getattr(m, k)).max()) for k in ("inv", "eqv", "center"))
            for m in moved
        ]
        assert min(gaps) < 1e-4


def test_code_and_poses_move_with_a_step_size(seen, fit, unmoved):
    for name in ("inv", "eqv", "center"):
        assert float(jnp.abs(getattr(fit.embedding, name) - getattr(unmoved.embedding, name)).max()) > 1e-5
    assert float(jnp.abs(fit.T_ref_obs.wxyz_xyz - seen.T_ref_obs.wxyz_xyz)[:, 1:-1].max()) > 1e-4


def test_what_stands_in_padding_changes_nothing(tiny_prior, seen, fit):
    def dirty(x):
        return x.at[:, -1].set(37.0)

    other = dataclasses.replace(
        seen,
        points=dirty(jnp.where(seen.mask[..., None], seen.points, 1e6)),
        codes=jax.tree.map(dirty, seen.codes),
        T_ref_obs=jaxlie.SE3(seen.T_ref_obs.wxyz_xyz.at[:, -1].set(jnp.array([0, 1.0, 0, 0, 5, 5, 5]))),
    )
    again = fit_jointly(tiny_prior, other, CONFIG)
    np.testing.assert_allclose(again.loss, fit.loss, rtol=1e-4)
    np.testing.assert_allclose(again.T_ref_obs.wxyz_xyz[:, :-1], fit.T_ref_obs.wxyz_xyz[:, :-1], atol=1e-4)
    np.testing.assert_allclose(again.embedding.eqv, fit.embedding.eqv, atol=1e-4)


def test_an_object_alone_is_fitted_as_among_others(tiny_prior, seen, fit):
    order = jnp.array([2, 0, 1])
    mixed = fit_jointly(tiny_prior, jax.tree.map(lambda x: x[order], seen), CONFIG)
    np.testing.assert_allclose(mixed.loss, fit.loss[order], rtol=1e-4)


def test_an_object_without_reference_is_refused(tiny_prior, seen):
    with pytest.raises(ValueError, match="without observation 0; needed the reference"):
        fit_jointly(tiny_prior, dataclasses.replace(seen, real=seen.real.at[1, 0].set(False)), CONFIG)


def test_no_code_drift_costs_nothing_and_has_a_finite_gradient(seen):
    code = jax.tree.map(lambda x: x[0], seen.accumulated)
    assert float(code_drift(code, code)) < 1e-6
    gradient = jax.grad(lambda x: code_drift(dataclasses.replace(code, inv=x), code))(code.inv)
    assert bool(jnp.isfinite(gradient).all())
    further = dataclasses.replace(code, inv=code.inv + 3.0 / np.sqrt(len(code.inv)))
    assert float(code_drift(further, code)) == pytest.approx(3.0, rel=1e-4)


@pytest.mark.parametrize("factor", [0.01, 1.0, 100.0])
def test_moving_the_code_is_encoding_what_was_moved(tiny_prior, factor):
    cloud = pieces.surface(pieces.without_symmetry()[2], POINTS)
    rotation, shift = Rotation.random(random_state=3), np.array([0.4, -0.2, 0.3])
    T = pieces.pose(rotation, factor * shift)
    moved = pieces.apply(T, factor * cloud)
    batch = pad_clouds([cloud, moved], 256)
    before, after = (jax.tree.map(lambda x, k=k: x[k], encode(tiny_prior, batch)) for k in (0, 1))
    plain = dataclasses.replace(before, center=before.center + before.origin.astype(np.float32), origin=None)
    expected = transform(rescale(plain, jnp.float32(factor)), pose_group(T))
    np.testing.assert_allclose(after.inv, expected.inv, atol=1e-4)
    np.testing.assert_allclose(after.eqv, expected.eqv, atol=1e-4)
    assert float(after.scale) == pytest.approx(float(expected.scale), rel=1e-4)
    # Random weights put the center far off; "relative" means to its length.
    length = float(np.linalg.norm(expected.center))
    np.testing.assert_allclose(after.center + after.origin, expected.center, atol=1e-4 * length)


def exact(tree):
    """In double precision, if JAX has it."""
    floats = lambda x: jnp.issubdtype(x.dtype, jnp.floating)  # noqa: E731
    return jax.tree.map(lambda x: jnp.asarray(np.asarray(x), float if floats(x) else x.dtype), tree)


@pytest.fixture
def in_float64(tiny_prior, seen):
    """Prior and an object seen three times in double precision; what is real and masked stays on the host, in NumPy."""
    with jax.enable_x64(True):
        prior, few = exact(
            (tiny_prior, jax.tree.map(lambda x: x[:1, :3], dataclasses.replace(seen, accumulated=seen.codes)))
        )
        # Views of a piece differ: were they one cloud, each of their codes would be the best as well as the others.
        noise = 0.01 * np.random.default_rng(0).normal(size=few.points[:, :, :32].shape)
        few = dataclasses.replace(
            few,
            points=few.points[:, :, :32] + noise,
            mask=np.asarray(few.mask[:, :, :32]),
            real=np.asarray(few.real),
        )
        yield prior, few


def outcome(prior, observations, config, points, pose, code):
    """A number that all results go into, of what is added to points, poses (tangent) and codes."""
    codes = observations.codes
    codes = dataclasses.replace(codes, inv=codes.inv + code, eqv=codes.eqv + code[..., None, :])
    given = dataclasses.replace(
        observations,
        points=observations.points + points,
        T_ref_obs=jaxlie.manifold.rplus(observations.T_ref_obs, pose),
        codes=codes,
        accumulated=jax.tree.map(lambda x: x[:, 0], codes),
    )
    fit = fit_jointly(prior, given, config)
    weights = np.random.default_rng(0).normal(size=fit.T_ref_obs.wxyz_xyz.shape)
    code = fit.embedding
    return (
        fit.loss.sum() + (weights * fit.T_ref_obs.wxyz_xyz).sum() + code.inv.sum() + 2 * code.eqv[:, 0].sum()
    )


@pytest.mark.slow
def test_derivatives_in_both_modes_are_those_of_central_differences(in_float64):
    prior, observations = in_float64
    config = dataclasses.replace(CONFIG, steps=3, points=24)
    rng = np.random.default_rng(1)
    points, pose, code = (
        rng.normal(size=shape)
        for shape in (observations.points.shape, (*observations.real.shape, 6), observations.codes.inv.shape)
    )

    def along(t):
        """`outcome` as far as t along three random directions."""
        return outcome(prior, observations, config, t[0] * points, t[1] * pose, t[2] * code)

    value, zero, step = jax.jit(along), jnp.zeros(3), 1e-6
    differences = [(value(step * e) - value(-step * e)) / (2 * step) for e in np.eye(3)]
    assert np.abs(differences).min() > 1e-3
    np.testing.assert_allclose(jax.jit(jax.grad(along))(zero), differences, rtol=1e-5)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(along))(zero), differences, rtol=1e-5)
    one = jax.jit(lambda e: jax.jvp(along, (zero,), (e,))[1])(np.ones(3))
    np.testing.assert_allclose(one, np.sum(differences), rtol=1e-5)


def test_under_jit_masks_may_be_closed_over_and_what_is_concrete_is_checked(tiny_prior, seen):
    """Losses in float64: what a program knows beforehand it rounds otherwise in float32."""
    config = dataclasses.replace(CONFIG, steps=0)

    def with_real(given, prior, real):
        known = dataclasses.replace(given, mask=np.asarray(given.mask), real=real)
        return jax.jit(lambda p: fit_jointly(prior, dataclasses.replace(known, points=p), config).loss)

    with jax.enable_x64(True):
        prior, given = exact((tiny_prior, seen))
        loss = fit_jointly(prior, given, config).loss
        traced = jax.jit(lambda observations: fit_jointly(prior, observations, config).loss)
        np.testing.assert_allclose(traced(given), loss, rtol=1e-10)  # nothing to check
        for real in (given.real, np.asarray(given.real)):
            np.testing.assert_allclose(with_real(given, prior, real)(given.points), loss, rtol=1e-10)
    missing = np.array(seen.real)
    missing[1, 0] = False
    with pytest.raises(ValueError, match="without observation 0"):
        with_real(seen, tiny_prior, missing)(seen.points)
