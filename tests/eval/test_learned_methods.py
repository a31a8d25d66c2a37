"""Learned peers as tables take them: weight files and what is refused, surfaces, what shipped weights manage."""

import dataclasses

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from known_scenes import pose
from places import ROOT
from sphere_shards import sphere_shards

from eval.peers.learned import methods, registry, train, validation
from eval.peers.learned.clouds import centered
from eval.peers.learned.occupancy_mesh import LEVEL, surface
from eval.peers.learned.registry import LearnedPeer, Trained, Training, load, save, shipped, start
from eval.peers.learned.vn_dgcnn import VNDGCNN, matching_loss
from more2_jax.config import EncoderConfig
from more2_jax.geometry.poses import rotation_error_deg
from more2_jax.types import Instance
from train.shards.settings import SampleConfig

HOW = Training(steps=3, minutes=0.1, shapes=5, clouds=24, loss=0.5)
SMALL = EncoderConfig(widths=(4, 4, 8), linear_blocks=3, neighbors=4, code=6, points=32)


def tiny(**more):
    given = {"title": "tiny", "task": "matching", "network": VNDGCNN(SMALL), "loss": matching_loss}
    return LearnedPeer(**(given | {"points": 32, "batch": 4} | more))


@pytest.fixture(scope="module")
def random_params():
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(registry.PEERS, "tiny", tiny())
        return start("tiny", 0)


@pytest.fixture
def with_tiny(monkeypatch, random_params):
    monkeypatch.setitem(registry.PEERS, "tiny", tiny())
    return Trained(name="tiny", params=random_params, training=HOW)


def test_weights_come_back_from_their_file(with_tiny, tmp_path):
    save(with_tiny, tmp_path / "a" / "tiny.npz")
    found = load(str(tmp_path / "a" / "tiny.npz"))
    assert found.name == "tiny" and found.training == HOW and found.peer.title == "tiny"
    for a, b in zip(jax.tree.leaves(found.params), jax.tree.leaves(with_tiny.params), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-6)


def test_a_run_states_which_weights_it_asked(with_tiny, tmp_path):
    save(with_tiny, tmp_path / "one.npz")
    more = jax.tree.map(lambda x: x + 1, with_tiny.params)
    save(dataclasses.replace(with_tiny, params=more), tmp_path / "two.npz")
    one, two = (registry.stated((str(tmp_path / f"{name}.npz"),)) for name in ("one", "two"))
    assert one.keys() == two.keys() == {"learned"} and one["learned"]["tiny"] != two["learned"]["tiny"]
    assert registry.stated(()) == {}


def test_training_goes_on_from_weights_and_counts_what_came_before(with_tiny, tmp_path, monkeypatch):
    save(with_tiny, tmp_path / "tiny.npz")
    assert train.begun("tiny", 0, None).training.minutes == 0
    first = train.begun("tiny", 0, tmp_path / "tiny.npz")
    assert first.training == HOW
    now = train.trained(first, first.params, [1.0, 0.5], train.time.process_time() - 60, 5)
    assert (now.training.steps, now.training.clouds) == (5, 24 + 2 * 2 * 4)
    assert now.training.minutes == pytest.approx(1.1, abs=0.05) and now.training.loss == 0.5
    monkeypatch.setitem(registry.PEERS, "other", tiny(title="other"))
    with pytest.raises(ValueError, match="weights of tiny; needed those of other"):
        train.begun("other", 0, tmp_path / "tiny.npz")


def test_the_whole_task_needs_one_peer_of_each_stage(with_tiny, tmp_path, monkeypatch):
    assert methods.learned_stages((), True) == {}
    save(with_tiny, tmp_path / "tiny.npz")
    for given in (("vn_dgcnn", "rpmnet"), ("vn_dgcnn", "rpmnet", "vn_onet", str(tmp_path / "tiny.npz"))):
        with pytest.raises(ValueError, match="needed one of each of matching, registration, reconstruction"):
            methods.learned_stages(given, True)
    ((name, stages),) = methods.learned_stages(("vn_onet", "vn_dgcnn", "rpmnet"), True).items()
    assert name == "VN-DGCNN, small + RPM-Net, small + GICP + VN-ONet, small"
    source = legged(2000, 0)
    found = stages.register(source, legged(2000, 1) + [3.0, -2, 0.1])
    assert found is not None and found[1] < 0.05
    np.testing.assert_allclose(found[0][:3, 3], [3, -2, 0.1], atol=0.1)


def test_what_is_no_learned_peer_is_refused(with_tiny, tmp_path, monkeypatch):
    with pytest.raises(ValueError, match="no learned peer 'nonsense' is shipped; there are vn_"):
        load("nonsense")
    with pytest.raises(ValueError, match="no learned peer 'nonsense'; there are vn_dgcnn"):
        train.main("nonsense", (tmp_path,), tmp_path / "x.npz")
    with pytest.raises(ValueError, match="minutes 0; needed"):
        train.main("tiny", (tmp_path,), tmp_path / "x.npz", minutes=0)
    (tmp_path / "damaged.npz").write_bytes(b"PK not a file")
    for name in ("missing.npz", "damaged.npz"):
        with pytest.raises(ValueError, match=f"{name}: no weights of a learned peer"):
            load(str(tmp_path / name))
    save(with_tiny, tmp_path / "tiny.npz")
    with pytest.raises(ValueError, match="tiny is of matching; needed a peer of registration"):
        methods.learned_registrars((str(tmp_path / "tiny.npz"),))
    wider = dataclasses.replace(SMALL, code=8)
    monkeypatch.setitem(registry.PEERS, "tiny", tiny(network=VNDGCNN(wider)))
    with pytest.raises(ValueError, match=r"tiny\.npz: weights of another form of tiny"):
        load(str(tmp_path / "tiny.npz"))


class Ball(nn.Module):
    """Inside within half a radius of the cloud's mean: a field that is known."""

    def code(self, points, mask):
        return centered(points, mask)

    def field(self, code, queries):
        return LEVEL + 0.5 - jnp.linalg.norm(code.local(queries), axis=-1)

    def __call__(self, points, mask, queries):
        return self.field(self.code(points, mask), queries)


class Nothing(Ball):
    """No place is inside."""

    def field(self, code, queries):
        return LEVEL - jnp.ones(len(queries))


def test_the_surface_of_a_known_field_is_where_it_is(monkeypatch):
    rng = np.random.default_rng(0)
    unit = rng.normal(size=(128, 3))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    cloud = 2 * np.concatenate([unit, -unit]) + [900.0, 4, -2]  # all points are taken: the mean is exact
    for network in (Ball(), Nothing()):
        monkeypatch.setitem(registry.PEERS, "ball", tiny(task="reconstruction", network=network, points=256))
        mesh = surface(Trained(name="ball", params={}, training=HOW), cloud)
        if isinstance(network, Nothing):
            assert mesh is None
            continue
        assert mesh is not None
        solid = trimesh.Trimesh(mesh.vertices, mesh.faces)
        assert solid.is_watertight and solid.volume == pytest.approx(4 / 3 * np.pi, rel=0.1)
        np.testing.assert_allclose(np.linalg.norm(mesh.vertices - [900, 4, -2], axis=1), 1, atol=0.05)


def test_the_rate_rises_and_falls():
    assert train.rate(0) == 0 and train.rate(train.WARMUP) == pytest.approx(1, abs=0.01)
    assert train.rate(1) == pytest.approx(train.LAST) and train.rate(0.5) == pytest.approx(0.505, abs=1e-3)


@pytest.mark.slow
def test_a_peer_learns_and_repeats_exactly(with_tiny, tmp_path, monkeypatch):
    (tmp_path / "shards").mkdir()
    shards = sphere_shards(tmp_path / "shards")
    monkeypatch.setattr(train, "SAMPLES", SampleConfig(queries=16, raw_points=64, max_views=2))
    for name in ("a", "b"):
        train.main("tiny", (shards,), tmp_path / f"{name}.npz", steps=4)
    a, b = (load(str(tmp_path / f"{name}.npz")) for name in ("a", "b"))
    assert a.training.steps == 4 and a.training.clouds == 32 and a.training.shapes == 32
    assert all(np.array_equal(x, y) for x, y in zip(*map(jax.tree.leaves, (a.params, b.params)), strict=True))
    moved = zip(jax.tree.leaves(a.params), jax.tree.leaves(with_tiny.params), strict=True)
    assert any(np.abs(x - y).max() > 1e-3 for x, y in moved)


@pytest.mark.slow
def test_validation_draws_the_same_shapes_for_all_weights(with_tiny, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(train, "SAMPLES", SampleConfig(queries=16, raw_points=64, max_views=2))

    def inside_and_weight(network, params, sample, key):
        return (sample.sdf < 0).mean() + jax.tree.leaves(params)[0].sum()

    monkeypatch.setitem(registry.PEERS, "tiny", tiny(loss=inside_and_weight, points=33))
    open_shapes = ROOT / "train/shapes/open.npz"
    shapes, rows = train.load_mix((open_shapes,), "val")
    zeros = dataclasses.replace(with_tiny, params=jax.tree.map(jnp.zeros_like, with_tiny.params))
    ones = dataclasses.replace(zeros, params={"a": jnp.ones(2)})
    found = [
        validation.losses_of(t, shapes, jnp.asarray(rows), 3, seed) for t, seed in ((zeros, 0), (ones, 0))
    ]
    np.testing.assert_allclose(found[1] - found[0], 2, atol=1e-5)
    assert len(set(found[0].tolist())) > 1 and (found[0] > 0).all() and (found[0] < 0.5).all()
    assert not np.array_equal(validation.losses_of(zeros, shapes, jnp.asarray(rows), 3, 1), found[0])
    monkeypatch.setitem(registry.PEERS, "tiny", tiny(loss=inside_and_weight))
    save(zeros, tmp_path / "tiny.npz")
    validation.main((str(tmp_path / "tiny.npz"),), (open_shapes,), batches=2)
    said = capsys.readouterr().out.splitlines()
    assert [line.split(":")[0] for line in said] == ["tiny, 0 steps", "tiny, 3 steps"]
    with pytest.raises(ValueError, match="batches 1; needed 2"):
        validation.main((str(tmp_path / "tiny.npz"),), (open_shapes,), batches=1)


def test_matching_is_by_the_nearest_code(with_tiny):
    rng = np.random.default_rng(0)
    one = [Instance(id=k, points=rng.normal(size=(80, 3)) * [1, 1, 0.2 + k] + 5) for k in range(3)]
    other = [Instance(id=10 + i.id, points=2 * i.points + 3) for i in one][::-1]
    assert methods.by_code(with_tiny, one, other) == {0: 10, 1: 11, 2: 12}
    assert methods.by_code(with_tiny, one, []) == {}


def test_vn_onet_matches_turned_and_grown_copies_and_conv_onet_matches_nothing():
    rng, R = np.random.default_rng(0), pose(130, [0, 0, 0])[:3, :3]
    one = [Instance(id=k, points=rng.normal(size=(80, 3)) * [1, 0.6, 0.2 + k]) for k in range(3)]
    other = [Instance(id=10 + i.id, points=2 * i.points @ R.T + 5) for i in one][::-1]
    ((title, match),) = methods.learned_matchers(("vn_onet",)).items()
    assert title == "VN-ONet, small" and match(one, other) == {0: 10, 1: 11, 2: 12}
    with pytest.raises(ValueError, match="ConvONet, small is of reconstruction; needed a peer of matching"):
        methods.learned_matchers(("conv_onet",))


def legged(count, seed):
    """A table without symmetry: a top, one leg, and a box on it."""
    parts = [
        trimesh.creation.box((1.0, 0.6, 0.08), transform=pose(0, [0, 0, 0.7])),
        trimesh.creation.box((0.12, 0.5, 0.7), transform=pose(0, [0.4, 0, 0.35])),
        trimesh.creation.box((0.25, 0.2, 0.4), transform=pose(0, [-0.3, 0.15, 0.95])),
    ]
    mesh = trimesh.util.concatenate(parts)
    return np.asarray(trimesh.sample.sample_surface(mesh, count, seed=seed)[0])


def test_what_is_shipped():
    assert set(shipped()) == set(registry.PEERS)
    sizes = [(registry.SHIPPED / f"{name}.npz").stat().st_size for name in shipped()]
    assert max(sizes) < 1e6 and sum(sizes) < 3e6


@pytest.mark.slow
@pytest.mark.parametrize("name", ["rpmnet", "geotransformer"])
@pytest.mark.parametrize("degrees", [0, 20])
def test_shipped_weights_find_a_small_turn_of_a_whole_cloud(degrees, name):
    T = pose(degrees, [3, -2, 0.1])
    source, target = legged(2000, 0), legged(2000, 1) @ T[:3, :3].T + T[:3, 3]
    found = methods.learned_registrars((name,))[registry.PEERS[name].title](source, target, True)
    assert found is not None and rotation_error_deg(found[:3, :3], T[:3, :3]) < 10
    np.testing.assert_allclose(found[2, :3], [0, 0, 1], atol=1e-6)


@pytest.mark.slow
def test_shipped_weights_enclose_a_box():
    box = trimesh.creation.box((1.0, 0.8, 0.6))
    cloud = np.asarray(trimesh.sample.sample_surface(box, 2000, seed=0)[0]) + 7
    for name, make in methods.learned_surfacers(("vn_onet", "conv_onet")).items():
        mesh = make(cloud)
        assert mesh is not None, name
        solid = trimesh.Trimesh(mesh.vertices, mesh.faces)
        # Weights of minutes know an object's size and place, hardly its shape.
        assert solid.is_watertight and box.volume / 2 < solid.volume < 3 * box.volume, name
        np.testing.assert_allclose(mesh.vertices.mean(axis=0), 7, atol=0.2)


def test_few_points_have_no_pose():
    few = np.random.default_rng(0).normal(size=(3, 3))
    for register in methods.learned_registrars(("rpmnet", "geotransformer")).values():
        assert register(few, few + 1, False) is None


@pytest.mark.parametrize("name", registry.PEERS)
def test_the_page_states_how_shipped_weights_came_about(name):
    page, of = (ROOT / "docs/concepts/learned_peers.md").read_text(encoding="utf-8"), load(name)
    table = {line.split("|")[1].strip(): line for line in page.splitlines() if line.startswith("| ")}
    assert f"{registry.parameters(of.params):,}" in table["parameters"]
    assert f"{of.training.steps:,}, {of.training.clouds:,}" in table["steps, clouds drawn"]
    assert f"| {of.training.minutes:g} |" in table["minutes of one core"]
