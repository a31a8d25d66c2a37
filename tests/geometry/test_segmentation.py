"""Geometric segmentation: boxes on a floor come apart, whatever the order and frame of the points."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from command_line import TINY, refused, run_quickly
from factories import living_scene
from places import DATA
from scipy.spatial.transform import Rotation

from more2_jax.cli.main import main
from more2_jax.config import preset
from more2_jax.geometry.segmentation import segment_geometric
from more2_jax.geometry.segmentation_config import SegmentationConfig
from more2_jax.network.prior import init_prior, save_prior
from more2_jax.scans.read_scan import read_scan
from more2_jax.storage.scene_folder import load_scene, save_scene
from more2_jax.types import Scan
from train.furniture.collections import read_meshes
from train.rooms.visits import FlyingConfig, flying_scene

CONFIG = SegmentationConfig()
UNSEEN = DATA / "unseen_furniture.npz"


def rectangle(low, high, n: int, rng: np.random.Generator) -> np.ndarray:
    return rng.uniform(low, high, (n, 3))


def box(center, side: float, rng: np.random.Generator) -> np.ndarray:
    p = rng.uniform(-0.5, 0.5, (6000, 3))
    p[np.arange(6000), rng.integers(0, 3, 6000)] = rng.choice([-0.5, 0.5], 6000)
    return p * side + center


def room(*objects: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A floor of 3 × 3 m and a wall, then objects numbered from 1."""
    rng = np.random.default_rng(0)
    floor = rectangle([0, 0, 0], [3, 3, 0], 30_000, rng)
    wall = rectangle([0, 0, 0], [0, 3, 2], 20_000, rng)
    parts = [np.concatenate([floor, wall]), *objects]
    return np.concatenate(parts), np.repeat(np.arange(len(parts)), [len(p) for p in parts])


def two_boxes() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(1)
    return room(box([1, 1, 0.36], 0.7, rng), box([2.2, 2.0, 0.31], 0.6, rng))


def agreement(found: np.ndarray, truth: np.ndarray) -> float:
    """Least over true objects of the best intersection over union."""
    return min(
        max(
            ((found == f) & (truth == t)).sum() / ((found == f) | (truth == t)).sum()
            for f in set(found) - {0}
        )
        for t in set(truth) - {0}
    )


def test_two_boxes_on_a_floor_are_two_instances():
    points, truth = two_boxes()
    found = segment_geometric(points, CONFIG)
    assert found.instance.max() == 2
    assert agreement(found.instance, truth) > 0.75
    assert (found.instance[truth == 0] == 0).mean() > 0.98
    assert sum(p.structure for p in found.planes) == 2


def test_order_of_points_does_not_matter():
    points, _ = two_boxes()
    order = np.random.default_rng(2).permutation(len(points))
    plain = segment_geometric(points, CONFIG).instance
    assert (segment_geometric(points[order], CONFIG).instance == plain[order]).mean() > 0.999


@pytest.mark.parametrize("turn", [Rotation.from_euler("z", 0.5), Rotation.from_euler("x", np.pi / 2)])
def test_the_frame_does_not_matter(turn: Rotation):
    points, truth = two_boxes()
    found = segment_geometric(turn.apply(points) + [3, -2, 1], CONFIG).instance
    assert found.max() == 2
    assert agreement(found, truth) > 0.75


def test_a_table_top_over_a_floor_stays():
    rng = np.random.default_rng(3)
    top = rectangle([1, 1, 0.7], [2.4, 2.0, 0.72], 15_000, rng)
    legs = [rectangle([x, y, 0], [x + 0.05, y + 0.05, 0.7], 1500, rng) for x in (1, 2.3) for y in (1, 1.9)]
    points, truth = room(np.concatenate([top, *legs]))
    found = segment_geometric(points, CONFIG)
    of_top = found.instance[(truth == 1) & (points[:, 2] > 0.69)]
    assert (of_top == 1).mean() > 0.95
    assert any(not p.structure for p in found.planes)


def table(rng: np.random.Generator) -> np.ndarray:
    """A top of 1 × 0.8 m, 0.7 m above the floor, on a column."""
    return np.concatenate(
        [
            rectangle([1, 1, 0.68], [2, 1.8, 0.7], 12_000, rng),
            rectangle([1.4, 1.3, 0], [1.6, 1.5, 0.68], 4000, rng),
        ]
    )


def of_parts(found: np.ndarray, truth: np.ndarray) -> list[int]:
    """The instance that most points of each part are in."""
    return [int(np.bincount(found[truth == t]).argmax()) for t in range(1, truth.max() + 1)]


@pytest.mark.parametrize("turn_deg", [0, 35])
def test_what_stands_on_a_table_is_a_thing_of_its_own(turn_deg: float):
    rng = np.random.default_rng(8)
    points, truth = room(table(rng), box([1.6, 1.3, 0.86], 0.3, rng))
    points = Rotation.from_euler("z", turn_deg, degrees=True).apply(points)
    found = segment_geometric(points, CONFIG).instance
    assert found.max() == 2
    assert len(set(of_parts(found, truth))) == 2
    assert agreement(found, truth) > 0.75


def test_a_back_at_the_edge_of_a_seat_and_a_column_below_a_top_are_no_things():
    rng = np.random.default_rng(9)
    back = rectangle([1, 1, 0.7], [1.04, 1.8, 1.2], 8000, rng)
    points, truth = room(table(rng), back)
    found = segment_geometric(points, CONFIG).instance
    assert found.max() == 1
    assert (found[truth > 0] == 1).mean() > 0.98


def test_arms_and_back_around_a_seat_are_no_thing():
    rng = np.random.default_rng(12)
    seat = rectangle([1, 1, 0.4], [2.2, 1.9, 0.42], 12_000, rng)
    base = rectangle([1, 1, 0], [2.2, 1.02, 0.4], 6000, rng)
    arms = [rectangle([x, 1.1, 0.4], [x + 0.05, 1.8, 0.65], 4000, rng) for x in (1.1, 2.05)]
    back = rectangle([1.1, 1.75, 0.4], [2.1, 1.8, 0.8], 6000, rng)
    points, truth = room(np.concatenate([seat, base, *arms, back]))
    found = segment_geometric(points, CONFIG).instance
    assert found.max() == 1
    assert (found[truth == 1] == 1).mean() > 0.95


def test_without_a_floor_nothing_is_said_to_stand_on_another():
    rng = np.random.default_rng(8)
    points = np.concatenate([table(rng), box([1.6, 1.3, 0.86], 0.3, rng)])
    assert segment_geometric(points, CONFIG).instance.max() == 1


@pytest.mark.parametrize(("rises_m", "things"), [(0.13, 1), (0.06, 0)])
def test_a_pillow_on_the_floor_is_a_thing_and_a_rug_is_not(rises_m: float, things: int):
    rng = np.random.default_rng(10)
    p = rectangle([1.2, 1.2, 0], [1.8, 1.7, 0], 8000, rng)
    across = np.abs((p[:, :2] - [1.5, 1.45]) / [0.3, 0.25]).max(axis=1)
    p[:, 2] = rises_m * np.minimum(4 * (1 - across), 1)
    points, truth = room(p)
    found = segment_geometric(points, CONFIG).instance
    assert found.max() == things
    assert (found[truth == 0] > 0).mean() < 0.01


def test_what_is_left_of_a_wall_joins_no_two():
    """Boxes along a wall, of which a strip lies 7 cm before the rest, as drift doubles it."""
    rng = np.random.default_rng(11)
    strip = rectangle([0.06, 0, 0.1], [0.08, 3, 0.7], 20_000, rng)
    points, truth = room(box([0.42, 0.6, 0.36], 0.6, rng), box([0.42, 2.2, 0.36], 0.6, rng), strip)
    found = segment_geometric(points, CONFIG).instance
    first, second, _ = of_parts(found, truth)
    assert first != second
    assert agreement(found[truth < 3], truth[truth < 3]) > 0.75


def test_a_wide_table_in_a_room_without_a_ceiling_is_no_ceiling():
    rng = np.random.default_rng(4)
    points, truth = room(rectangle([0.8, 0.5, 0.72], [2.8, 2.5, 0.75], 30_000, rng))
    found = segment_geometric(points, CONFIG)
    assert (found.instance[truth == 1] == 1).mean() > 0.95


def test_a_ceiling_is_removed():
    rng = np.random.default_rng(5)
    points, truth = room(box([1.5, 1.5, 0.36], 0.7, rng), rectangle([0, 0, 2.4], [3, 3, 2.4], 30_000, rng))
    found = segment_geometric(points, CONFIG)
    assert found.instance.max() == 1
    assert not found.instance[truth == 2].any()


def test_a_wall_that_bends_off_its_plane_is_no_object():
    """As depth sensors show walls at the border of their view."""
    points, truth = room(box([1.5, 1.5, 0.36], 0.7, np.random.default_rng(6)))
    of_wall = (truth == 0) & (points[:, 0] == 0)
    corner = np.clip(np.hypot(points[:, 1] - 3, points[:, 2] - 2) - 1.0, -1, 0)
    points[of_wall, 0] += 0.13 * corner[of_wall] ** 2
    found = segment_geometric(points, CONFIG)
    assert found.instance.max() == 1
    assert agreement(found.instance, truth) > 0.75


def test_a_strip_that_drift_leaves_in_a_corner_is_no_object():
    rng = np.random.default_rng(13)
    along = rectangle([0.07, 0.3, 0.07], [0.09, 2.7, 0.09], 3000, rng)
    across = rectangle([0.07, 0.3, 0.07], [0.09, 0.5, 1.5], 6000, rng)
    foot = rectangle([0.07, 0.3, 0.06], [0.6, 2.7, 0.08], 9000, rng)
    points, truth = room(box([2, 2, 0.36], 0.7, rng), np.concatenate([along, across, foot]))
    found = segment_geometric(points, CONFIG).instance
    assert found.max() == 1
    assert not found[truth == 2].any()


@pytest.mark.parametrize("spacing_m", [0.01, 0.03, 0.06])
def test_the_spacing_of_the_points_decides_what_touches(spacing_m: float):
    """Two sheets 0.25 m apart: two instances, each whole, whether points are dense or sparse."""
    side = np.arange(0, 1.2, spacing_m)
    y, z = (a.ravel() for a in np.meshgrid(side, side))
    jitter = np.random.default_rng(7).normal(0, spacing_m / 10, (2, len(y), 3))
    points = np.concatenate(
        [np.stack([np.full_like(y, x), y, z], axis=-1) + j for x, j in zip((0, 0.25), jitter, strict=True)]
    )
    found = segment_geometric(points, SegmentationConfig(planes=0)).instance
    shares = [np.bincount(sheet, minlength=3) / len(y) for sheet in (found[: len(y)], found[len(y) :])]
    assert found.max() == 2
    assert {int(share.argmax()) for share in shares} == {1, 2}
    assert all(share.max() > 0.98 for share in shares)  # corners may be left to the background


def test_nothing_but_planes_and_nothing_at_all(tmp_path):
    points, _ = room()
    for name, cloud in (("planes", points), ("empty", points[:0])):
        np.savez(tmp_path / f"{name}.npz", points=cloud)
        with pytest.raises(ValueError, match="no instances left"):
            read_scan(tmp_path / f"{name}.npz", segment="geometric")
    assert not segment_geometric(np.ones((1, 3)), CONFIG).instance.any()
    assert not segment_geometric(np.ones((500, 3)), CONFIG).instance.any()


def test_a_cloud_too_wide_is_refused():
    with pytest.raises(ValueError, match="measures"):
        segment_geometric(np.array([[0.0, 0, 0], [1e9, 0, 0]]), CONFIG)


def test_the_scan_says_what_was_done_and_that_masks_are_better(tmp_path):
    np.savez(tmp_path / "a.npz", points=two_boxes()[0])
    scan = read_scan(tmp_path / "a.npz", segment="geometric")
    assert len(scan.instances) == 2
    assert any("--masks" in w for w in scan.warnings)
    assert any("removed as floor or wall" in w for w in scan.warnings)


# --- an independent truth -----------------------------------------------------------------------------------


def adjusted_rand(a: np.ndarray, b: np.ndarray) -> float:
    """Hubert and Arabie 1985, by the contingency table: 1 for the same partition, 0 by chance."""
    table = np.zeros((a.max() + 1, b.max() + 1))
    np.add.at(table, (a, b), 1)
    pairs = [float((n * (n - 1) / 2).sum()) for n in (table, table.sum(0), table.sum(1), table.sum()[None])]
    both, first, second, every = pairs
    return (both - first * second / every) / ((first + second) / 2 - first * second / every)


def test_adjusted_rand_is_the_definition():
    a = np.random.default_rng(0).integers(0, 4, 60)
    b = np.where(np.arange(60) < 40, a, np.random.default_rng(1).integers(0, 3, 60))
    i, j = np.triu_indices(60, 1)
    same_a, same_b = a[i] == a[j], b[i] == b[j]
    expected = same_a.mean() * same_b.mean()
    by_pairs = ((same_a & same_b).mean() - expected) / ((same_a.mean() + same_b.mean()) / 2 - expected)
    assert adjusted_rand(a, b) == pytest.approx(by_pairs)
    assert adjusted_rand(a, (a + 1) % 4) == pytest.approx(1)


@pytest.fixture(scope="module")
def furnished() -> list[tuple[np.ndarray, np.ndarray]]:
    """Points and true instances of rooms in the regime `sparse`: sensor noise, occlusion, a floor."""
    models = list(read_meshes(UNSEEN))
    scans = []
    for seed in (1, 2):  # settings were chosen on others
        rng = np.random.default_rng(seed)
        chosen = [models[k] for k in rng.choice(len(models), 6, replace=False)]
        for scan in flying_scene(chosen, FlyingConfig(scans=1), rng).scans:
            parts = [scan.background, *(i.points for i in scan.instances)]
            ids = [0, *(i.id for i in scan.instances)]
            scans.append((np.concatenate(parts), np.repeat(ids, [len(p) for p in parts])))
    return scans


def test_furnished_rooms_against_the_truth(furnished):
    hits, rand = [], []
    for points, truth in furnished:
        found = segment_geometric(points, CONFIG).instance
        rand.append(adjusted_rand(truth, found))
        hits += [agreement(found, np.where(truth == t, t, 0)) > 0.5 for t in set(truth) - {0}]
    assert np.mean(rand) > 0.95
    assert np.mean(hits) > 0.9


# --- the command line ---------------------------------------------------------------------------------------


def unmasked(path: Path, shift: float) -> Path:
    rng = np.random.default_rng(8)
    np.savez(path, points=room(box([1 + shift, 1, 0.36], 0.7, rng), box([2.2, 2.3, 0.31], 0.6, rng))[0])
    return path


@pytest.mark.slow
def test_a_whole_run_and_add_without_masks(tmp_path: Path, capsys, monkeypatch):
    monkeypatch.setenv("MORE2_CACHE", str(tmp_path / "cache"))
    prior, out = tmp_path / "tiny.npz", tmp_path / "room"
    save_prior(init_prior(TINY, jax.random.key(0), "tiny"), prior)
    a, b, c = (
        unmasked(tmp_path / f"{name}.npz", shift) for name, shift in (("a", 0), ("b", 0.2), ("c", 0.1))
    )
    assert run_quickly(a, b, out=out, prior=prior, more=("--segment", "geometric")) == 0
    told = capsys.readouterr()
    assert "Masks from a network are better" in " ".join((told.out + told.err).split())
    scene, _ = load_scene(out)
    assert [len(s.instances) for s in scene.scans] == [2, 2]
    assert main(["add", str(out), str(c), "--prior", str(prior), "--segment", "geometric"]) == 0
    assert [len(s.instances) for s in load_scene(out)[0].scans] == [2, 2, 2]


@pytest.mark.parametrize("command", ["run", "add"])
def test_run_and_add_hand_clusters_to_the_method(tmp_path: Path, capsys, monkeypatch, command: str):
    """Up to the first stage; what the stages make of them, the slow test above tells."""
    monkeypatch.setenv("MORE2_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr("more2_jax.network.prior.load_prior", lambda _: SimpleNamespace(name="tiny"))
    out, given = tmp_path / "room", []

    def stage(*args, **options):
        given.extend(a for a in (*args, *options.values()) if isinstance(a, Scan))
        raise ValueError("enough")

    monkeypatch.setattr("more2_jax.scene.start_scene", stage)
    monkeypatch.setattr("more2_jax.scene.add_scan", stage)
    a = unmasked(tmp_path / "a.npz", 0)
    if command == "add":
        stored = replace(living_scene(), prior="tiny")
        save_scene(stored, out, preset("robust", upright=True))
    place = (out, a) if command == "add" else (a, "--out", out)
    assert main([str(x) for x in (command, *place, "--prior", "tiny", "--segment", "geometric")]) == 2
    assert "enough" in capsys.readouterr().err
    (scan,) = given
    assert [i.id for i in scan.instances] == [1, 2]
    assert any("Masks from a network are better" in w for w in scan.warnings)


def test_without_the_flag_the_line_names_it(tmp_path: Path, capsys):
    a = unmasked(tmp_path / "a.npz", 0)
    assert "--segment geometric" in refused(capsys, "run", a, "--out", tmp_path / "room")
    assert "--segment" in refused(capsys, "inspect", a)
