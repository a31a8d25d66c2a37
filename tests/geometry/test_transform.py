"""Records moved and rescaled: every field says how, motions compose, and moved codes are those of moved clouds."""

import dataclasses
import importlib
import pkgutil
import typing

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pieces
import pytest
from factories import embedding
from scipy.spatial.transform import Rotation

import more2_jax
from more2_jax.geometry.nearest_grid import NearestGrid
from more2_jax.geometry.padding import pad_clouds
from more2_jax.geometry.point_to_plane import Surface
from more2_jax.geometry.transform import rescale, transform
from more2_jax.network.prior import encode
from more2_jax.types import (
    Anchors,
    Embedding,
    LocalBatch,
    ObservedObject,
    PointCloud,
    Quantity,
    Registration,
    Sampled,
    Sight,
    pytree,
    quantity,
)

# Pytrees that nobody moves: weights, indices, and what lives within one step of a computation.
NEVER_MOVED = {
    "Prior",
    "ObjectField",
    "LocalField",
    "SurfaceField",
    "Matches",
    "Correspondences",
    "NormalEquations",
    "Planes",
    "Sides",
}


def record_classes():
    """All dataclasses of the package that JAX maps over or that have quantities."""
    found = {}
    for module in pkgutil.walk_packages(more2_jax.__path__, "more2_jax."):
        if module.name.endswith("__main__"):
            continue
        for value in vars(importlib.import_module(module.name)).values():
            own = isinstance(value, type) and value.__module__.startswith("more2_jax")
            if own and dataclasses.is_dataclass(value):
                kinds = ["quantity" in f.metadata for f in dataclasses.fields(value)]
                if hasattr(value, "_flax_dataclass") or any(kinds):
                    found[value.__name__] = value
    return found


def test_every_record_says_of_every_field_how_it_moves():
    known, classes = set(typing.get_args(Quantity)), record_classes()
    for name, cls in classes.items():
        kinds = {f.name: f.metadata.get("quantity") for f in dataclasses.fields(cls)}
        if not any(kinds.values()):
            assert name in NEVER_MOVED, f"{name} does not say how it moves"
            continue
        assert set(kinds.values()) <= known, f"{name}: {kinds}"
    moving = {"PointCloud", "Embedding", "LocalBatch", "PairBatch", "AlignableObject", "Observations"}
    assert set(classes) >= moving | {"ObservedObject"}


# --- laws -------------------------------------------------------------------------------------------------------


def numbers(rng, *shape):
    return rng.normal(size=shape)


def records():
    """One of each kind that has a place, float64 on the host; with and without an origin of its own."""
    rng = np.random.default_rng(0)
    cloud = PointCloud(points=numbers(rng, 5, 3), mask=np.ones(5, bool))
    anchors = Anchors(
        offset=numbers(rng, 4, 3),
        features=numbers(rng, 4, 3, 2),
        mask=np.ones(4, bool),
        normal=Rotation.random(4, random_state=3).as_matrix()[:, 0],
    )
    code = Embedding(
        inv=numbers(rng, 6),
        eqv=numbers(rng, 3, 6),
        scale=np.asarray(1.3),
        center=numbers(rng, 3),
        anchors=(anchors, anchors),
    )
    turns = Rotation.random(2, random_state=0).as_matrix()
    sight = Sight(
        eye=numbers(rng, 2, 3),
        turn=turns,
        half=np.ones(2),
        side=np.full(2, 16.0),
        clear=numbers(rng, 2, 4, 4),
    )
    every = np.ones(5, bool)
    sampled = Sampled(points=numbers(rng, 5, 3), mask=every, dense=numbers(rng, 5, 3), dense_mask=every)
    surface = Surface(sampled=sampled, normals=numbers(rng, 5, 3), dense_normals=numbers(rng, 5, 3))
    far = np.array([1000.0, -2000.0, 5.0])
    bound = [dataclasses.replace(x, origin=far) for x in (cloud, code)]
    local = LocalBatch(cloud=cloud, code=code, sight=sight)
    seen = ObservedObject(
        points=numbers(rng, 5, 3), embedding=bound[1], sight=sight, normals=numbers(rng, 5, 3)
    )
    free = {
        "cloud": cloud,
        "anchors": anchors,
        "code": code,
        "sight": sight,
        "surface": surface,
        "batch": local,
    }
    about_origin = {
        "cloud about an origin": bound[0],
        "code about an origin": bound[1],
        "batch about an origin": dataclasses.replace(local, origin=far),
        "object": seen,
    }
    return free, about_origin


FREE, ABOUT_ORIGIN = records()
ALL = FREE | ABOUT_ORIGIN
A, B = (pieces.pose(Rotation.random(random_state=k), np.random.default_rng(k).normal(size=3)) for k in (1, 2))


def leaves(record):
    """All arrays of a record, by name, host or device."""
    found = {}
    for f in dataclasses.fields(record):
        value = getattr(record, f.name)
        parts = value if isinstance(value, tuple) else (value,)
        for k, part in enumerate(parts):
            if dataclasses.is_dataclass(part):
                found |= {f"{f.name}.{k}.{name}": x for name, x in leaves(part).items()}
            elif part is not None:
                found[f"{f.name}.{k}"] = np.asarray(part)
    return found


def assert_same(a, b, atol=1e-9):
    left, right = leaves(a), leaves(b)
    assert left.keys() == right.keys()
    for name, x in left.items():
        np.testing.assert_allclose(x, right[name], atol=atol, err_msg=name)


def differs(a, b):
    right = leaves(b)
    return any(np.abs(x - right[name]).max() > 0.1 for name, x in leaves(a).items() if x.dtype != bool)


@pytest.mark.parametrize("name", ALL)
def test_there_and_back_is_nowhere_and_two_motions_are_their_product(name):
    record = ALL[name]
    there = transform(record, A)
    assert differs(record, there)
    assert_same(transform(there, np.linalg.inv(A)), record)
    assert_same(transform(record, B @ A), transform(there, B))


@pytest.mark.parametrize("name", ALL)
def test_a_device_pose_moves_as_a_host_pose(name):
    record = ALL[name]
    T = jaxlie.SE3.from_matrix(jnp.asarray(A, jnp.float32))
    assert_same(transform(record, T), transform(record, A), atol=2e-3 if name in ABOUT_ORIGIN else 1e-5)


@pytest.mark.parametrize("name", FREE)
def test_units_there_and_back_are_the_same_and_scaling_goes_through_motion(name):
    record, factor = FREE[name], 2.5
    larger = rescale(record, factor)
    assert differs(record, larger)
    assert_same(rescale(larger, 1 / factor), record)
    turn, scaled = np.eye(4), A.copy()
    turn[:3, :3] = A[:3, :3]
    scaled[:3, 3] *= factor
    assert_same(rescale(transform(record, turn), factor), transform(larger, turn))
    assert_same(rescale(transform(record, A), factor), transform(larger, scaled))


def test_a_registration_in_another_unit_is_that_of_clouds_in_another_unit():
    T = jaxlie.SE3.from_matrix(jnp.asarray(A, jnp.float32))
    rng = np.random.default_rng(3)
    half = numbers(rng, 6, 6)
    result = Registration(
        T_target_source=T,
        loss=jnp.array(0.3),
        rms_m=jnp.array(0.01),
        converged=jnp.array(True),
        covariance=jnp.asarray(half @ half.T, jnp.float32),
    )
    points = numbers(rng, 7, 3).astype(np.float32)
    larger = rescale(result, 4.0)
    np.testing.assert_allclose(larger.T_target_source @ (4 * points), 4 * (T @ points), atol=1e-5)
    assert (float(larger.loss), float(larger.rms_m)) == pytest.approx((0.3, 0.04))
    unit = np.diag([4.0, 4, 4, 1, 1, 1])
    np.testing.assert_allclose(larger.covariance, unit @ half @ half.T @ unit, rtol=1e-5)


# --- what cannot be done is said --------------------------------------------------------------------------------


def test_what_cannot_be_moved_or_rescaled_is_named():
    T = jaxlie.SE3.identity()
    result = Registration(
        T_target_source=T, loss=jnp.zeros(()), rms_m=jnp.zeros(()), converged=jnp.array(True)
    )
    with pytest.raises(TypeError, match=r"Registration\.T_target_source \(pose\) cannot be moved"):
        transform(result, A)
    table = NearestGrid(index=jnp.zeros((2, 2, 2), int), low=jnp.zeros(3), cell=jnp.ones(3))
    with pytest.raises(TypeError, match=r"NearestGrid\.low \(axis-aligned\) cannot be moved"):
        transform(table, A)
    with pytest.raises(TypeError, match="origin: a record about an origin is rescaled in its local frame"):
        rescale(ABOUT_ORIGIN["cloud about an origin"], 2.0)


def test_a_field_that_does_not_say_how_it_moves_is_named():
    @pytree
    class Half:
        place: typing.Any = quantity("position")
        other: typing.Any = None

    half = Half(place=np.zeros((1, 3)))
    for change in (lambda: transform(half, A), lambda: rescale(half, 2.0)):
        with pytest.raises(TypeError, match=r"Half\.other does not say how it moves"):
            change()


# --- the encoder ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("about_origin", [True, False])
@pytest.mark.parametrize("factor", [0.01, 1.0, 100.0])
def test_encoding_what_was_moved_is_moving_the_code(tiny_prior, about_origin, factor):
    """With an origin the record moves as it is; without, the points themselves lie elsewhere."""
    cloud = factor * pieces.surface(pieces.without_symmetry()[2], 128)
    cloud -= cloud.mean(axis=0)
    T = pieces.pose(Rotation.random(random_state=3), factor * np.array([0.4, -0.2, 0.3]))
    padded = jax.tree.map(lambda x: x[0], pad_clouds([cloud], 256))
    record = padded if about_origin else dataclasses.replace(padded, origin=None)

    def code_of(cloud):
        return jax.tree.map(lambda x: x[0], encode(tiny_prior, jax.tree.map(lambda x: x[None], cloud)))

    after, expected = code_of(transform(record, T)), transform(code_of(record), T)
    np.testing.assert_allclose(after.inv, expected.inv, atol=1e-4)
    np.testing.assert_allclose(after.eqv, expected.eqv, atol=1e-4)
    assert float(after.scale) == pytest.approx(float(expected.scale), rel=1e-4)
    # Random weights put the center far off; "relative" means to its length.
    length = float(np.linalg.norm(expected.center))
    np.testing.assert_allclose(after.center, expected.center, atol=1e-4 * length)
    if about_origin:
        np.testing.assert_allclose(after.origin, expected.origin, atol=1e-9 * factor)


def test_encoding_in_another_unit_is_rescaling_the_code(tiny_prior):
    cloud = pieces.surface(pieces.without_symmetry()[2], 128)
    batch = dataclasses.replace(pad_clouds([cloud - cloud.mean(axis=0)], 256), origin=None)
    after, expected = encode(tiny_prior, rescale(batch, 4.0)), rescale(encode(tiny_prior, batch), 4.0)
    for name in ("inv", "eqv"):
        np.testing.assert_allclose(getattr(after, name), getattr(expected, name), atol=1e-4)
    np.testing.assert_allclose(after.scale, expected.scale, rtol=1e-4)
    length = float(np.linalg.norm(expected.center))
    np.testing.assert_allclose(after.center, expected.center, atol=1e-4 * length)


def test_a_code_far_from_zero_keeps_its_micrometers_when_moved():
    far = embedding(np.random.default_rng(0), np.array([1e3, -2e3, 5.0]))
    there = transform(far, A)
    assert there.origin.dtype == np.float64 and there.center.dtype == np.float32
    back = transform(there, np.linalg.inv(A))
    np.testing.assert_allclose(back.scan_center(), far.scan_center(), atol=1e-6)
