"""The written benchmark: the truth is true, regimes are what they say, a seed decides alone, runs resume."""

import dataclasses
import json
import shutil
import sys
from functools import partial
from itertools import combinations, pairwise
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
import trimesh

from more2_jax.scans.read_scan import read_scan
from train import synthesize
from train.furniture.closed_models import cache_name, closed_model, make_cached, read_models
from train.furniture.collections import SourceMesh, write_packed
from train.rooms.cameras import SPARSE
from train.rooms.regimes import FLYING, balanced, by_category, furniture, near_twin, scene_config
from train.rooms.scene_files import GRID_M, read_scene
from train.rooms.visits import FlyingScene, TrueObject, surface_samples
from train.run.program import run


def box(name: str, category: str, extents: tuple[float, float, float]) -> SourceMesh:
    mesh = trimesh.creation.box(extents)
    back = trimesh.creation.box((extents[0], 0.05, 0.5))
    back.apply_translation((0, extents[1] / 2 - 0.025, extents[2] / 2 + 0.24))
    both = trimesh.util.concatenate([mesh, back])
    return SourceMesh(
        name=name, category=category, vertices=both.vertices, faces=both.faces, source="boxes", license="CC0"
    )


MODELS = [
    box(f"{category}_{k}", category, (0.4 + 0.05 * k, 0.5, 0.3 + 0.04 * k))
    for category in ("seat", "shelf", "crate")
    for k in range(4)
]


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("source") / "boxes.npz"
    write_packed(path, MODELS)
    return path


@pytest.fixture(scope="module")
def models(source: Path, tmp_path_factory: pytest.TempPathFactory) -> synthesize.Job:
    """A job whose models are closed, for scenes made in this process."""
    folder = tmp_path_factory.mktemp("job")
    job = synthesize.Job(
        meshes=tuple(read_models(source)),
        cache=folder / "models",
        out=folder / "sparse",
        regime="sparse",
        free=False,
        scans=3,
        seed=0,
        room_m=(7.0, 6.0),
    )
    job.cache.mkdir()
    assert [make_cached(m, job.cache) for m in job.meshes] == [None] * len(MODELS)
    return job


def make(job: synthesize.Job, folder: Path, regime: str, *, free: bool = False, number: int = 0) -> Path:
    one = dataclasses.replace(
        job, out=folder / f"{regime}{free}", regime=synthesize._regime(regime), free=free, scans=4
    )
    synthesize.claim(one)
    synthesize.make_scene(one, number)
    return one.out / f"scene_{number:04d}"


CASES = [
    pytest.param(
        (r, f),
        id=f"{r}-{'free' if f else 'upright'}",
        marks=[pytest.mark.slow] if f and r != "sparse" else [],
    )
    for r in FLYING
    for f in (False, True)
]


@pytest.fixture(scope="module", params=CASES)
def scene(request, models, tmp_path_factory) -> tuple[FlyingScene, bool, Path]:
    regime, free = request.param
    folder = make(models, tmp_path_factory.mktemp("made"), regime, free=free)
    return read_scene(folder), free, folder


def solid(o: TrueObject, scan: int) -> trimesh.Trimesh:
    mesh = trimesh.Trimesh(o.vertices, o.faces, process=False)
    return mesh.apply_transform(o.T_scan_model[scan])


def test_points_lie_on_their_posed_mesh(scene):
    room, _, _ = scene
    for k, scan in enumerate(room.scans):
        for o in (o for o in room.objects if k in o.instance):
            (points,) = [i.points for i in scan.instances if i.id == o.instance[k]]
            _, distance, _ = trimesh.proximity.closest_point(solid(o, k), points[::15])
            if room.regime == "paper":
                assert distance.max() < GRID_M
            else:
                # Noise grows with the square of the distance; which camera saw a point is not told.
                eyes = room.T_scan_camera[k][:, :3, 3]
                farthest = np.linalg.norm(points[::15, None] - eyes, axis=-1).max(axis=1)
                std = SPARSE.noise_m + SPARSE.noise_per_m2 * farthest**2
                assert (distance < 5 * std).all()
                assert np.median(distance / std) < 0.9
            assert [i.label for i in scan.instances if i.id == o.instance[k]] == [o.category]


def test_objects_rest_on_the_floor_and_do_not_overlap(scene):
    room, free, _ = scene
    for k in range(len(room.scans)):
        solids = [solid(o, k) for o in room.objects if k in o.instance]
        for mesh in solids:
            assert mesh.is_watertight
            assert mesh.volume > 0
            assert mesh.bounds[0, 2] == pytest.approx(0, abs=1e-6)
        for a, b in combinations(solids, 2):
            assert not a.contains(np.asarray(b.sample(200, seed=0))).any()
            assert not b.contains(np.asarray(a.sample(200, seed=0))).any()
    upright = [np.allclose(T[:3, 2], [0, 0, 1]) for o in room.objects for T in o.T_scan_model.values()]
    assert not any(upright) if free else all(upright)


def test_regimes_are_what_they_say(scene):
    room, _, _ = scene
    roles = [o.role for o in room.objects]
    names = [o.model for o in room.objects]
    assert 4 <= len(names) <= 8
    copies = max(names.count(n) for n in names)
    if room.regime == "identical":
        assert 2 <= copies <= 4
    else:
        assert copies == 1
        per_category = np.unique([o.category for o in room.objects], return_counts=True)[1]
        assert np.ptp(per_category) <= 1
    if room.regime == "changes":
        assert set(roles) == {"static", "moved", "removed", "added", "returning"}
    else:
        assert set(roles) == {"moved"}
    for o in room.objects:
        has = [k in o.instance for k in range(4)]
        assert has[0] == (o.role != "added")
        assert has[-1] == (o.role != "removed")
        assert all(has) == (o.role in ("static", "moved"))
        poses = [o.T_scan_model[k] for k in sorted(o.instance)]
        for a, b in pairwise(poses):
            assert np.array_equal(a, b) == (o.role == "static")


def test_visibility_is_measured_on_the_surface(scene):
    room, free, _ = scene
    shares = [o.visible(k) for o in room.objects for k in o.instance]
    assert min(shares) > 0.02
    assert free or max(shares) < 0.95  # undersides of upright boxes are not seen
    for k, scan in enumerate(room.scans):
        for o in (o for o in room.objects if k in o.instance):
            samples = surface_samples(o.vertices, o.faces)[o.seen[k]]
            samples = samples @ o.T_scan_model[k][:3, :3].T + o.T_scan_model[k][:3, 3]
            (points,) = [i.points for i in scan.instances if i.id == o.instance[k]]
            nearest = np.linalg.norm(samples[::20, None] - points[None, ::2], axis=-1).min(axis=1)
            assert np.median(nearest) < 0.05
            assert o.overlap(k, k) == 1


def test_cameras_are_where_the_regime_puts_them(scene):
    room, _, _ = scene
    for T in room.T_scan_camera:
        np.testing.assert_allclose(
            T[:, :3, :3] @ T[:, :3, :3].transpose(0, 2, 1), np.eye(3) + 0 * T[:, :3, :3], atol=1e-7
        )
        assert (T[:, 2, 2] < 0).all()  # all look down
        if room.regime == "paper":
            assert (T[:, 2, 3] > 0.5).all()
        else:
            assert (np.abs(T[:, :2, 3]) <= [3.5, 3.0]).all()
            assert (np.abs(T[:, 2, 3] - 1.5) <= 0.15).all()
    assert all((len(s.background) == 0) == (room.regime == "paper") for s in room.scans)


def test_files_are_on_the_grid_and_read_by_the_common_reader(scene):
    _, _, folder = scene
    with np.load(folder / "scan_0.npz") as arrays:
        points = arrays["points"].astype(np.float64)
    np.testing.assert_allclose(points / GRID_M, np.round(points / GRID_M), atol=0.01)
    truth = json.loads((folder / "scene.json").read_text())
    present = {r["instance"] for o in truth["objects"] for r in o["observations"] if r["scan"] == 0}
    assert {i.id for i in read_scan(folder / "scan_0.npz").instances} == present


def test_a_scene_depends_on_seed_and_number_alone(models, tmp_path):
    one = json.loads((make(models, tmp_path / "a", "sparse", number=3) / "scene.json").read_text())
    make(models, tmp_path / "b", "sparse", number=1)
    two = json.loads((make(models, tmp_path / "b", "sparse", number=3) / "scene.json").read_text())
    other = json.loads((tmp_path / "b" / "sparseFalse" / "scene_0001" / "scene.json").read_text())
    assert one["digest"] == two["digest"] != other["digest"]


@pytest.fixture
def command(source, capsys):
    """The program with a command line, in this process: its exit code and standard error."""

    def started(out: Path, *more: str, regime: str = "changes") -> tuple[int, str]:
        line = f"train.synthesize --source {source} --regime {regime} --scenes 2 --scans 3 --out {out}"
        code = 0
        with patch.object(sys, "argv", [*line.split(), *more]):
            try:
                run(synthesize.main)
            except SystemExit as end:
                code = int(end.code or 0)
        return code, capsys.readouterr().err

    return started


@pytest.mark.slow
def test_any_number_of_workers_gives_the_same_and_a_stopped_run_resumes(command, tmp_path):
    assert command(tmp_path / "one", "--workers", "1")[0] == 0
    index = json.loads((tmp_path / "one" / "index.json").read_text())
    assert command(tmp_path / "two", "--workers", "2")[0] == 0
    assert json.loads((tmp_path / "two" / "index.json").read_text()) == index
    # As after a kill: one scene half written, no index.
    kept = tmp_path / "one" / "scene_0000" / "scene.json"
    before = kept.stat().st_mtime_ns
    shutil.move(tmp_path / "one" / "scene_0001", tmp_path / "one" / "scene_0001.partial")
    (tmp_path / "one" / "scene_0001.partial" / "scan_0.npz").unlink()
    (tmp_path / "one" / "index.json").unlink()
    assert command(tmp_path / "one", "--workers", "1")[0] == 0
    assert json.loads((tmp_path / "one" / "index.json").read_text()) == index
    assert kept.stat().st_mtime_ns == before
    index_names = ["scene_0000", "scene_0001"]
    assert [read_scene(tmp_path / "one" / n).name for n in index_names] == index_names
    assert "License: CC0" in (tmp_path / "one" / "LICENSES.md").read_text()
    code, said = command(tmp_path / "one", "--seed", "1")
    assert (code, said.count("\n")) == (2, 1)


class Alone:
    """Workers that are this process."""

    def __init__(self, processes=0, ray=None, shared=None):
        self.shared = shared

    def map(self, function, items):
        return map(function, items)

    def map_shared(self, function, items):
        return map(partial(function, self.shared), items)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass


def same_files(one: Path, other: Path) -> bool:
    """Every file below, to the byte."""
    files = [{p.relative_to(f): p.read_bytes() for p in f.rglob("*") if p.is_file()} for f in (one, other)]
    return files[0] == files[1] and len(files[0]) > 0


def test_shards_make_the_scenes_of_one_process_and_the_last_writes_the_index(
    command, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(synthesize, "Workers", Alone)
    assert command(tmp_path / "whole")[0] == 0
    shared = tmp_path / "shared"
    shared.mkdir()
    shutil.copytree(tmp_path / "whole/models", shared / "models")
    assert command(shared, "--shard", "2/2")[0] == 0
    assert {p.name for p in shared.iterdir()} == {"models", "scene_0001", "settings.json", "report.json"}
    assert command(shared, "--shard", "1/2")[0] == 0
    assert same_files(shared, tmp_path / "whole")
    before = (shared / "index.json").read_bytes()
    (shared / "index.json").unlink()
    assert command(shared)[0] == 0  # without a shard, as where two ended at once
    assert (shared / "index.json").read_bytes() == before
    code, said = command(shared, "--shard", "3/2")
    assert (code, said) == (2, "error: --shard 3/2; needed i/n with 1 ≤ i ≤ n, such as 2/8\n")


@pytest.mark.slow
def test_a_cluster_makes_the_same_bytes(source, tmp_path):
    """Two nodes of a Ray cluster on this machine against one process; what fails there is one line, too."""
    pytest.importorskip("ray", reason="the cluster extra is not installed")
    from ray.cluster_utils import Cluster

    def settings(folder: str, **more) -> synthesize.Settings:
        given = {"source": source, "regime": "changes", "out": tmp_path / folder, "scenes": 3, "scans": 3}
        return synthesize.Settings(**(given | more))

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    cluster.add_node(num_cpus=1)
    try:
        synthesize.main(settings("ray", ray=cluster.address))
        with pytest.raises(ValueError, match="needed more room") as raised:
            synthesize.main(settings("small", ray=cluster.address, room_m=(1.0, 1.0)))
    finally:
        cluster.shutdown()
    assert "\n" not in str(raised.value)
    synthesize.main(settings("alone", workers=1))
    assert same_files(tmp_path / "ray", tmp_path / "alone")


def test_bad_input_is_one_line(source, tmp_path):
    def refusal(**settings) -> str:
        given = {"source": source, "regime": "paper", "out": tmp_path / "x", "scenes": 1} | settings
        with pytest.raises(ValueError) as raised:
            synthesize.main(synthesize.Settings(**given))
        assert "\n" not in str(raised.value)
        return str(raised.value)

    assert "needed one of paper, sparse" in refusal(regime="papers")
    assert "needed 3" in refusal(regime="changes", scans=2)
    assert "needed positive numbers" in refusal(scenes=0)
    assert "needed" in refusal(source=tmp_path / "none.npz")
    with pytest.raises(ValueError, match="3 usable models; needed 8"):
        furniture("paper", MODELS[:3], np.random.default_rng(0))


def test_a_room_that_is_too_small_ends_in_one_line(command, tmp_path):
    code, said = command(tmp_path / "small", "--room-m", "1", "1", "--workers", "1", regime="paper")
    assert (code, said.count("\n")) == (2, 1)
    assert "needed more room" in said


def test_models_that_cannot_be_used_are_told_with_the_reason(tmp_path):
    flat = box("flat", "x", (1.0, 1.0, 1.0))
    flat.vertices[:, 2] = 0
    huge = box("huge", "x", (50.0, 1.0, 1.0))
    assert "flat" in (make_cached(flat, tmp_path) or "")
    assert "see --longest-m" in (make_cached(huge, tmp_path) or "")
    assert make_cached(huge, tmp_path) == make_cached(huge, tmp_path)


def test_a_cache_does_not_give_one_source_what_was_made_of_another_that_differs_by_rounding():
    first = MODELS[0]
    other = dataclasses.replace(first, vertices=np.nextafter(first.vertices, np.inf))
    assert other.content_hash == first.content_hash
    assert cache_name(other) != cache_name(first)
    assert cache_name(dataclasses.replace(first, name="another")) == cache_name(first)


def test_units_axes_and_licenses_of_a_source(source):
    plain = read_models(source)
    turned = read_models(source, up="y", longest_m=2.0, license="CC-BY-4.0")
    for a, b in zip(plain, turned, strict=True):
        assert np.ptp(b.vertices, axis=0).max() == pytest.approx(2.0)
        scale = 2.0 / np.ptp(a.vertices, axis=0).max()
        np.testing.assert_allclose(np.ptp(b.vertices, axis=0), scale * np.ptp(a.vertices, axis=0)[[0, 2, 1]])
        assert b.license == "CC0"  # the source's own word counts
    with pytest.raises(ValueError, match="category 'shelf'; needed one of seat"):
        read_models(source, longest_m={"seat": 1.0})


def test_closed_models_stand_on_the_floor():
    model, symmetry = closed_model(MODELS[0])
    assert model.vertices[:, 2].min() == 0
    assert symmetry == 1
    assert trimesh.Trimesh(model.vertices, model.faces, process=False).is_watertight


def test_furniture_is_balanced_and_twins_are_near():
    rng = np.random.default_rng(0)
    for count in range(4, 9):
        chosen = balanced(by_category(MODELS), count, rng)
        assert len({m.name for m in chosen}) == count
        assert np.ptp([len(v) for v in by_category(chosen).values()]) <= 1
    for _ in range(20):
        twin = near_twin(MODELS[1], MODELS, rng)
        assert twin.name != MODELS[1].name
        assert twin.category == "seat"
        ratio = np.ptp(twin.vertices, axis=0) / np.ptp(MODELS[1].vertices, axis=0)
        assert (np.abs(ratio - 1) < 0.2).all()
        assert np.abs(ratio - 1).max() > 0.03
    assert scene_config("changes", 5, rng, free=True).returning == 1
