"""Laws of Φ for random weights: it turns, scales and shifts with the object, and sees nothing else."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from places import ROOT
from scipy.spatial.transform import Rotation

from more2_jax.config import EncoderConfig, PriorConfig, load_config
from more2_jax.geometry.padding import pad_clouds
from more2_jax.network.encoder import neighbor_counts, power_of_two
from more2_jax.network.prior import Prior, encode, encode_one, init_prior
from more2_jax.types import Embedding, PointCloud
from train.run.settings import TrainingRun

CONFIGS = ROOT / "configs"
POINTS, BATCH = 512, 8  # what clouds are padded to and how many there are, of choice: compiled once a prior
LEAVES = ("inv", "eqv", "scale", "center")


@pytest.fixture(
    scope="module", params=[("tiny", 1), ("tiny", 3), pytest.param(("small", 1), marks=pytest.mark.slow)]
)
def prior(request):
    name, draws = request.param
    config = load_config(CONFIGS / f"{name}.yaml", TrainingRun).model
    return init_prior(dataclasses.replace(config, draws=draws), jax.random.key(1), name)


def with_draws(prior: Prior, draws: int) -> Prior:
    return dataclasses.replace(prior, config=dataclasses.replace(prior.config, draws=draws))


def furniture(seed: int, count: int = 300) -> np.ndarray:
    """Points on a few boxes, like a piece of furniture with no symmetry; about 1 m."""
    rng = np.random.default_rng(seed)
    boxes = [rng.uniform(-0.5, 0.5, (2, 3)) for _ in range(4)]
    points = np.stack([rng.uniform(*np.sort(boxes[i % 4], axis=0)) for i in range(count)])
    axis = rng.integers(3, size=count)  # pushed to the nearer face along one axis: a surface
    for i, a in enumerate(axis):
        faces = boxes[i % 4][:, a]
        points[i, a] = faces[np.argmin(np.abs(faces - points[i, a]))]
    return points


def world_center(embedding: Embedding) -> np.ndarray:
    """F_c in the scan's frame, float64."""
    return np.asarray(embedding.origin, np.float64) + np.asarray(embedding.center, np.float64)


def assert_same(ours: Embedding, theirs: Embedding, tolerance: float = 1e-5) -> None:
    for leaf in LEAVES:
        a, b = np.asarray(getattr(ours, leaf)), np.asarray(getattr(theirs, leaf))
        np.testing.assert_allclose(a, b, rtol=0, atol=tolerance * np.abs(b).max(), err_msg=leaf)


# --- laws -----------------------------------------------------------------------------------------------------


def test_similarity_equivariance(prior):
    """Φ(sRX + t) = (F_inv, R·F_eqv, s·F_s, sR·F_c + t), s from 1 cm to 100 m, t up to 1 km."""
    rng = np.random.default_rng(0)
    clouds = [furniture(seed) for seed in range(BATCH)]
    scales = np.r_[0.01, 100.0, np.exp(rng.uniform(np.log(0.01), np.log(100), 6))]
    turns = Rotation.random(8, random_state=0).as_matrix()
    shifts = rng.normal(size=(8, 3))
    shifts *= (
        np.r_[1000.0, 1000.0, rng.uniform(0, 1000, 6)][:, None] / np.linalg.norm(shifts, axis=1)[:, None]
    )
    moved = [s * x @ R.T + t for x, s, R, t in zip(clouds, scales, turns, shifts, strict=True)]
    before, after = encode(prior, pad_clouds(clouds)), encode(prior, pad_clouds(moved))
    expected_eqv = turns @ np.asarray(before.eqv)
    expected_center = scales[:, None] * np.einsum("bij,bj->bi", turns, world_center(before)) + shifts
    # Random weights put F_c tens of the object's lengths away from it: float32 holds it to shares of that distance.
    size = np.asarray([np.ptp(x, axis=0).max() for x in clouds])
    held = scales * np.maximum(size, np.linalg.norm(before.center, axis=1))
    largest = np.abs(before.inv).max(axis=1), np.abs(before.eqv).max(axis=(1, 2))
    deviations = {
        "inv": np.abs(after.inv - before.inv).max(axis=1) / largest[0],
        "eqv": np.abs(after.eqv - expected_eqv).max(axis=(1, 2)) / largest[1],
        "scale": np.abs(after.scale / (scales * before.scale) - 1),
        "center": np.abs(world_center(after) - expected_center).max(axis=1) / held,
    }
    assert max(d.max() for d in deviations.values()) <= 1e-4, deviations


@pytest.mark.parametrize("draws", [1, 4])
def test_similarity_equivariance_in_float64(tiny_prior, draws):
    """The law itself, without float32's rounding: all of it to a billionth of the object's size."""
    tiny_prior = with_draws(tiny_prior, draws)
    scale, shift = 100.0, np.array([600.0, -800.0, 3.0])
    turn = Rotation.random(random_state=1).as_matrix()
    cloud = furniture(5, count=128)
    with jax.enable_x64(True):
        prior = jax.tree.map(lambda x: x.astype(jnp.float64), tiny_prior)
        each = jax.jit(jax.vmap(lambda points: encode_one(prior, points, jnp.ones(128, bool))))
        before, after = (
            jax.tree.map(
                lambda x, k=k: np.asarray(x[k]), each(np.stack([cloud, scale * cloud @ turn.T + shift]))
            )
            for k in range(2)
        )
    np.testing.assert_allclose(after.inv, before.inv, rtol=0, atol=1e-9)
    np.testing.assert_allclose(after.eqv, turn @ before.eqv, rtol=0, atol=1e-9)
    np.testing.assert_allclose(after.scale, scale * before.scale, rtol=1e-9)
    np.testing.assert_allclose(after.center, scale * turn @ before.center + shift, rtol=0, atol=1e-9 * scale)


def test_a_reflection_is_not_a_rotation(prior):
    """The first block's cross product tells a left chair from a right one."""
    cloud = furniture(0)
    plain, mirrored = (encode(prior, pad_clouds([x])) for x in (cloud, cloud * [-1, 1, 1]))
    assert np.abs(plain.inv - mirrored.inv).max() > 1e-3 * np.abs(plain.inv).max()


def test_order_of_points_does_not_matter(prior):
    cloud = furniture(1)
    shuffled = np.random.default_rng(0).permutation(cloud)
    assert_same(encode(prior, pad_clouds([shuffled])), encode(prior, pad_clouds([cloud])), 1e-4)


def test_duplicates_do_not_matter_beyond_the_mean(prior):
    """Points given twice weigh twice in the input's mean and nowhere else: doubling all changes nothing."""
    cloud = furniture(2, count=40)
    doubled = np.concatenate([cloud, cloud])
    assert_same(*(encode(prior, pad_clouds([x], POINTS)) for x in (doubled, cloud)), 1e-4)


def test_padding_and_garbage_in_it_do_not_matter(prior):
    cloud = pad_clouds([furniture(3, count=200)], POINTS)
    rng, rows = np.random.default_rng(0), (POINTS - 200, 3)
    for junk in (rng.normal(size=rows), 1e6 * rng.normal(size=rows), np.zeros(rows)):
        dirty = cloud.points.at[:, 200:].set(jnp.asarray(junk, jnp.float32))
        other = PointCloud(points=dirty, mask=cloud.mask, origin=cloud.origin)
        assert_same(encode(prior, other), encode(prior, cloud), 1e-7)
    assert_same(encode(prior, pad_clouds([furniture(3, count=200)], size=1024)), encode(prior, cloud))


@pytest.mark.parametrize("batch", [3, BATCH])
def test_the_rest_of_the_batch_does_not_matter(prior, batch):
    clouds = [furniture(seed) for seed in range(batch)]
    alone = encode(prior, pad_clouds(clouds[:1]))
    together = encode(prior, pad_clouds(clouds))
    assert_same(jax.tree.map(lambda x: x[:1], together), alone)


def test_different_shapes_have_different_codes(prior):
    """Guards the laws above: a constant would obey most of them."""
    embedding = encode(prior, pad_clouds([furniture(seed) for seed in range(4)]))
    inv = np.asarray(embedding.inv) / np.linalg.norm(embedding.inv, axis=1, keepdims=True)
    assert (inv @ inv.T)[np.triu_indices(4, 1)].max() < 0.9999
    np.testing.assert_allclose((np.asarray(embedding.eqv) ** 2).sum(axis=(1, 2)), 1, atol=1e-5)
    assert (np.asarray(embedding.scale) > 0).all()


# --- the hard third ---------------------------------------------------------------------------------------------

LINE = np.linspace(0, 1, 30)
DEGENERATE = {
    "one point": np.array([[1.0, 2.0, 3.0]]),
    "two points": np.array([[0.0, 0, 0], [1, 0, 0]]),
    "five points": np.random.default_rng(0).normal(size=(5, 3)),
    "one point thirty times": np.ones((30, 3)),
    "collinear": np.outer(LINE, [1.0, 2.0, 3.0]),
    "planar": np.random.default_rng(1).uniform(size=(100, 3)) * [1, 1, 0],
    "regular grid": np.stack(np.meshgrid(*[np.arange(5.0)] * 3), axis=-1).reshape(-1, 3),
    "a micrometer": 1e-6 * furniture(0),
}


def test_degenerate_clouds_have_finite_codes_and_gradients(prior):
    cloud = pad_clouds(list(DEGENERATE.values()))

    def total(points: jax.Array, mask: jax.Array, prior: Prior) -> tuple[jax.Array, Embedding]:
        e = encode_one(prior, points, mask)
        return e.inv.sum() + e.eqv.sum() + e.scale + e.center.sum(), e

    each = jax.jit(jax.vmap(jax.grad(total, has_aux=True), in_axes=(0, 0, None)))
    gradients, codes = each(cloud.points, cloud.mask, prior)
    finite = jax.tree.map(lambda x: np.isfinite(x).reshape(len(x), -1).all(axis=1), (gradients, codes))
    for ok in jax.tree.leaves(finite):
        assert ok.all(), [name for name, good in zip(DEGENERATE, ok, strict=True) if not good]
    assert (np.asarray(gradients)[~np.asarray(cloud.mask)] == 0).all()
    assert (np.abs(gradients).max(axis=(1, 2)) > 0)[2]  # five points: not cut off altogether


def test_gradient_agrees_with_finite_differences(tiny_prior):
    """In float64, where no neighbor changes within the step."""
    with jax.enable_x64(True):
        prior = jax.tree.map(lambda x: x.astype(jnp.float64), tiny_prior)
        points, mask = furniture(4, count=100), np.ones(100, bool)
        along, step = np.random.default_rng(0).normal(size=(100, 3)), 1e-7

        @jax.jit
        @jax.value_and_grad
        def total(points: jax.Array, mask: jax.Array, prior: Prior) -> jax.Array:
            e = encode_one(prior, points, mask)
            return (e.inv**2).sum() + e.eqv[0].sum() + e.scale + e.center[0]

        (after, _), (before, _) = (total(points + s * along, mask, prior) for s in (step, -step))
        gradient = total(points, mask, prior)[1]
        assert gradient.dtype == jnp.float64
        np.testing.assert_allclose((gradient * along).sum(), (after - before) / (2 * step), rtol=1e-5)


# --- doors ------------------------------------------------------------------------------------------------------


def test_encode_refuses_clouds_without_points(tiny_prior):
    cloud = pad_clouds([furniture(0)] * 3)
    empty = PointCloud(points=cloud.points, mask=cloud.mask.at[1].set(False), origin=cloud.origin)
    with pytest.raises(ValueError, match=r"clouds \[1\] have no points"):
        encode(tiny_prior, empty)


def test_encode_refuses_normals_of_another_shape(tiny_prior):
    cloud = pad_clouds([furniture(0)] * 2)
    with pytest.raises(ValueError, match=r"normals of shape \(2, 3\)"):
        encode(tiny_prior, dataclasses.replace(cloud, normals=jnp.ones((2, 3))))


def test_init_refuses_an_input_too_small_for_its_neighbors():
    config = PriorConfig(encoder=EncoderConfig(points=256))
    assert neighbor_counts(config.encoder, 512)[-1] == 16
    with pytest.raises(ValueError, match="needed 16 neighbors"):
        init_prior(config, jax.random.key(0))


def test_init_refuses_codes_of_no_draw():
    with pytest.raises(ValueError, match="0 draws of a cloud; needed one or more"):
        init_prior(PriorConfig(draws=0), jax.random.key(0))


@pytest.mark.parametrize("value", [1e-12, 0.3, 1.0, 7e5])
def test_power_of_two_is_next_and_exact(value):
    power = float(power_of_two(jnp.float32(value)))
    assert np.log2(power) == round(np.log2(power))
    assert 0.5 <= value / power <= 1.0
    assert float(jax.grad(power_of_two)(jnp.float32(value))) == 0.0


def test_one_program_serves_batches_of_one_shape(tiny_prior):
    from more2_jax.network.prior import _encode_many

    programs = []
    for seed in range(3):
        encode(tiny_prior, pad_clouds([furniture(seed, count=100 + seed)], POINTS))
        programs.append(_encode_many._cache_size())
    assert programs[0] >= 1 and programs == programs[:1] * 3
