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


# Compiled: one by one, their operations would take longer.
loss_of, drift_of = jax.jit(surface_loss), jax.jit(code_drift)
slope_of_drift = jax.jit(jax.grad(lambda inv, code: code_drift(dataclasses.replace(code, inv=inv), code)))
placed, scaled = jax.jit(transform), jax.jit(rescale)
pose_of = jax.jit(jaxlie.SE3.from_matrix)
thinned, radius_of = jax.jit(joint.subsample, static_argnums=1), jax.jit(joint.cloud_radius)
all_after = jax.jit(lambda G, poses: jax.vmap(jax.vmap(lambda T: G @ T))(poses))
all_placed = jax.jit(jax.vmap(transform, in_axes=(0, None)))


def pose_group(T):
    return pose_of(np.asarray(T, np.float32))


def rows(tree, *index):
    """Those of every array of a record."""
    return jax.tree.map(lambda x: jnp.asarray(np.asarray(x)[index]), tree)


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
    real = jnp.asarray(np.arange(SEEN)[None].repeat(OBJECTS, axis=0) < SEEN - 1)

    def split(x):
        return jnp.asarray(np.asarray(x).reshape(OBJECTS, SEEN, *x.shape[1:]))

    codes = jax.tree.map(split, codes)
    return Observations(
        points=split(batch.points),
        mask=split(batch.mask),
        real=real,
        codes=codes,
        T_ref_obs=jaxlie.SE3(split(np.stack(poses))),
        accumulated=rows(codes, slice(None), 0),
    )


@pytest.fixture(scope="module")
def fit(tiny_prior, seen):
    return fit_jointly(tiny_prior, seen, CONFIG)


@pytest.fixture(scope="module")
def unmoved(tiny_prior, seen):
    return fit_jointly(tiny_prior, seen, FROZEN)


def test_the_loss_never_ends_above_its_start(fit, unmoved):
    assert (np.asarray(fit.loss) < np.asarray(unmoved.loss)).all()


@pytest.mark.parametrize("start", ["best", "accumulated"])
def test_no_step_is_the_loss_of_the_start_by_definition(tiny_prior, seen, start):
    config = dataclasses.replace(CONFIG, steps=0, start=start)
    fit = fit_jointly(tiny_prior, seen, config)
    for n in range(OBJECTS):
        one = thinned(rows(seen, n), POINTS)
        radius = radius_of(*rows((one.points, one.mask), 0))
        one = scaled(one, jnp.float32(1 / np.asarray(radius)))
        starts = [one.accumulated]
        if start == "best":
            starts = [placed(*rows((one.codes, one.T_ref_obs), j)) for j in range(SEEN - 1)]
        losses = [float(loss_of(tiny_prior, code, one.T_ref_obs, one)) for code in starts]
        assert min(abs(float(np.asarray(fit.loss)[n]) - loss) for loss in losses) < 1e-4 * max(losses)


def test_the_reference_stays_where_it_is(fit):
    still = np.tile([1.0, 0, 0, 0, 0, 0, 0], (OBJECTS, 1))
    np.testing.assert_allclose(np.asarray(fit.T_ref_obs.wxyz_xyz)[:, 0], still, atol=1e-6)


def test_the_reference_stays_where_it_is_given(tiny_prior, seen, unmoved):
    """Of a scan that was leveled its pose is a tilt about a point; the loss is that of the level scan."""
    G = np.eye(4)
    G[:3, :3], G[:3, 3] = Rotation.from_euler("x", 0.09).as_matrix(), [0.1, -0.3, 0.2]
    G = pose_group(G)
    tilted = dataclasses.replace(
        seen,
        T_ref_obs=all_after(G, seen.T_ref_obs),
        accumulated=all_placed(seen.accumulated, G),
    )
    given = np.broadcast_to(G.wxyz_xyz, (OBJECTS, 7))
    for config in (CONFIG, FROZEN):
        moved = fit_jointly(tiny_prior, tilted, config)
        np.testing.assert_allclose(np.asarray(moved.T_ref_obs.wxyz_xyz)[:, 0], given, atol=1e-6)
    np.testing.assert_allclose(moved.loss, unmoved.loss, rtol=1e-4)
    np.testing.assert_allclose(moved.T_ref_obs.wxyz_xyz, tilted.T_ref_obs.wxyz_xyz, atol=1e-5)


def test_without_a_step_size_nothing_moves(seen, unmoved):
    np.testing.assert_allclose(unmoved.T_ref_obs.wxyz_xyz, seen.T_ref_obs.wxyz_xyz, atol=1e-5)
    codes = jax.device_get(unmoved.embedding)
    for n in range(OBJECTS):  # X*: the code of one of the observations, in the reference's frame
        moved = [placed(*rows((seen.codes, seen.T_ref_obs), n, j)) for j in range(SEEN - 1)]
        gaps = [
            max(
                float(np.abs(getattr(codes, k)[n] - np.asarray(getattr(m, k))).max())
                for k in ("inv", "eqv", "center")
            )
            for m in moved
        ]
        assert min(gaps) < 1e-4


def test_code_and_poses_move_with_a_step_size(seen, fit, unmoved):
    for name in ("inv", "eqv", "center"):
        assert (
            np.abs(np.subtract(getattr(fit.embedding, name), getattr(unmoved.embedding, name))).max() > 1e-5
        )
    assert np.abs(np.subtract(fit.T_ref_obs.wxyz_xyz, seen.T_ref_obs.wxyz_xyz))[:, 1:-1].max() > 1e-4


def test_what_stands_in_padding_changes_nothing(tiny_prior, seen, fit):
    def dirty(x, junk=37.0):
        x = np.array(x)
        x[:, -1] = junk
        return jnp.asarray(x)

    other = dataclasses.replace(
        seen,
        points=dirty(np.where(np.asarray(seen.mask)[..., None], seen.points, np.float32(1e6))),
        codes=jax.tree.map(dirty, seen.codes),
        T_ref_obs=jaxlie.SE3(dirty(seen.T_ref_obs.wxyz_xyz, [0, 1, 0, 0, 5, 5, 5])),
    )
    again = fit_jointly(tiny_prior, other, CONFIG)
    np.testing.assert_allclose(again.loss, fit.loss, rtol=1e-4)
    poses, expected = (np.asarray(x.T_ref_obs.wxyz_xyz)[:, :-1] for x in (again, fit))
    np.testing.assert_allclose(poses, expected, atol=1e-4)
    np.testing.assert_allclose(again.embedding.eqv, fit.embedding.eqv, atol=1e-4)


def test_an_object_alone_is_fitted_as_among_others(tiny_prior, seen, fit):
    order = np.array([2, 0, 1])
    mixed = fit_jointly(tiny_prior, rows(seen, order), CONFIG)
    np.testing.assert_allclose(mixed.loss, np.asarray(fit.loss)[order], rtol=1e-4)


def test_an_object_without_reference_is_refused(tiny_prior, seen):
    with pytest.raises(ValueError, match="without observation 0; needed the reference"):
        fit_jointly(tiny_prior, dataclasses.replace(seen, real=seen.real.at[1, 0].set(False)), CONFIG)


def test_no_code_drift_costs_nothing_and_has_a_finite_gradient(seen):
    code = rows(seen.accumulated, 0)
    assert float(drift_of(code, code)) < 1e-6
    assert np.isfinite(slope_of_drift(code.inv, code)).all()
    further = dataclasses.replace(
        code, inv=jnp.asarray(np.asarray(code.inv) + np.float32(3 / np.sqrt(len(code.inv))))
    )
    assert float(drift_of(further, code)) == pytest.approx(3.0, rel=1e-4)


@pytest.mark.parametrize("factor", [0.01, 1.0, 100.0])
def test_moving_the_code_is_encoding_what_was_moved(tiny_prior, factor):
    cloud = pieces.surface(pieces.without_symmetry()[2], POINTS)
    rotation, shift = Rotation.random(random_state=3), np.array([0.4, -0.2, 0.3])
    T = pieces.pose(rotation, factor * shift)
    moved = pieces.apply(T, factor * cloud)
    batch = pad_clouds([cloud, moved], 256)
    both = encode(tiny_prior, batch)
    before, after = (jax.tree.map(lambda x, k=k: np.asarray(x)[k], both) for k in (0, 1))
    plain = dataclasses.replace(before, center=before.center + before.origin.astype(np.float32), origin=None)
    expected = placed(scaled(plain, jnp.float32(factor)), pose_group(T))
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
