"""`more2` commands of the pages run word by word: *Start* on small true files of every source that it names."""

import itertools
import re
import shlex
import shutil
import threading
from collections.abc import Callable
from dataclasses import replace
from http.server import ThreadingHTTPServer
from pathlib import Path
from urllib.request import urlopen

import numpy as np
import pytest
import trimesh
from dataset_writers.masks import write_masks
from dataset_writers.pcd import write_pcd
from dataset_writers.ply_file import vertex_columns, write_ply
from dataset_writers.scannet import write_scannet
from dataset_writers.threerscan import write_annotated_mesh, write_semseg
from factories import living_scene
from furnished import cabinet, chair, corner
from guide_pages import blocks, commands, lines
from inline_team import Inline
from places import DATA, ROOT
from scipy.spatial.transform import Rotation

from eval.survival import FEW_STEPS
from more2_jax.cli.main import main
from more2_jax.cli.server import address_of, scene_server
from more2_jax.cli.settings import scene_config
from more2_jax.config import preset
from more2_jax.network.prior import load_prior, save_prior
from more2_jax.report import report_html
from more2_jax.scans.demo import demo_scan_paths
from more2_jax.storage.scene_folder import load_scene, save_scene

DOCS = ROOT / "docs"
SCRIPTS = [body for language, body in blocks(DOCS / "start/first_scans.md") if language == "bash"]
CHAIR, CABINET = 1, 2
WITH_MASKS, LATER = "more2 show my_room", "more2 add"  # words of two blocks
CHAIR_MIDDLE = [1.45, 1.45, 0.0]  # meters


def room(visit: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) and the object of each (0: floor and walls); the chair has another place at every visit."""
    turned = Rotation.from_euler("z", 90 * visit, degrees=True).apply(chair(10 + visit) - CHAIR_MIDDLE)
    clouds = [corner(visit), turned + CHAIR_MIDDLE + np.array([-0.45, 0.4, 0]) * visit, cabinet(20 + visit)]
    return np.concatenate(clouds), np.repeat([0, CHAIR, CABINET], [len(c) for c in clouds])


def own_frame(points: np.ndarray, visit: int) -> np.ndarray:
    """As a rescan has it: turned about the vertical and meters away."""
    return Rotation.from_euler("z", 110 * visit, degrees=True).apply(points) + np.array([4.0, -2, 0]) * visit


def labeled_ply(folder: Path) -> None:
    """`monday.ply`, `friday.ply`, `sunday.ply`, with masks."""
    for visit, name in enumerate(("monday", "friday", "sunday")):
        points, ids = room(visit)
        write_ply(folder / f"{name}.ply", vertex_columns(points, instance=ids.astype(np.int32)))


def phone_ply(folder: Path) -> None:
    """The first two as an app exports them: no masks."""
    for visit, name in enumerate(("monday", "friday")):
        write_ply(folder / f"{name}.ply", vertex_columns(room(visit)[0]))


def phone_ply_y_up(folder: Path) -> None:
    """The same, y up."""
    for visit, name in enumerate(("monday", "friday")):
        x, y, z = room(visit)[0].T
        write_ply(folder / f"{name}.ply", vertex_columns(np.stack([x, z, -y], axis=1)))


def threerscan(folder: Path) -> None:
    """A reference scan and a rescan; object 1 is the room."""
    for visit, name in enumerate(("REFERENCE", "RESCAN")):
        points, ids = room(visit)
        write_annotated_mesh(folder / "3RScan" / name, own_frame(points, visit), ids + 1)
        write_semseg(folder / "3RScan" / name, {1: "floor", 2: "chair", 3: "cabinet"})


def scannet(folder: Path) -> None:
    """Two scans of a scene; every object has two segments, floor and walls are a group as well."""
    for visit in range(2):
        points, ids = room(visit)
        segments = 2 * ids + (points[:, 2] > 0.4)
        groups = [(k, label, [2 * k, 2 * k + 1]) for k, label in enumerate(("floor", "chair", "cabinet"))]
        write_scannet(folder / f"scene0000_0{visit}", own_frame(points, visit), segments, groups)


# By words of a block: what writes its files, the instances of chair and cabinet there (none: cut), and labels.
SOURCES: dict[str, tuple[Callable[[Path], None], set[int], set[str | None]]] = {
    "more2 inspect monday.ply --segment geometric": (phone_ply, set(), {None}),
    "--up y": (phone_ply_y_up, set(), {None}),
    "3RScan/REFERENCE": (threerscan, {2, 3}, {"chair", "cabinet"}),
    "scene0000_00": (scannet, {2, 3}, {"chair", "cabinet"}),
}
QUICK = ("scene0000_00",)  # of these; what else they run, tests of readers and segmentation run as well


def script_with(words: str) -> str:
    """The one block of the page that has the words."""
    (found,) = [s for s in SCRIPTS if words in s]
    return found


@pytest.fixture
def follow(tmp_path, monkeypatch, capsys):
    """Runs a block of the page in an empty folder, where no browser opens."""
    monkeypatch.setattr("webbrowser.open", lambda _: True)
    monkeypatch.chdir(tmp_path)

    def run(script: str) -> None:
        for line in lines(script):
            program, *words = shlex.split(line, comments=True)
            assert program == "more2"
            assert main(words) == 0, f"{line}\n{capsys.readouterr().err}"

    return run


@pytest.fixture
def quickly(tmp_path, tiny_prior, monkeypatch):
    """The commands with the smallest weights and few steps in place of what they take by default."""
    few = tmp_path / "few.yaml"
    few.write_text(FEW_STEPS)
    monkeypatch.setattr("more2_jax.network.prior.load_prior", lambda name: replace(tiny_prior, name=name))
    for where in ("main", "manifest"):
        monkeypatch.setattr(
            f"more2_jax.cli.{where}.scene_config",
            lambda name, upright, path, **more: scene_config(name, upright, path or few, **more),
        )


def test_every_block_of_the_page_is_run_here():
    assert {script_with(words) for words in (*SOURCES, WITH_MASKS, LATER)} == set(SCRIPTS)


@pytest.mark.parametrize(
    "words", [pytest.param(w, marks=[] if w in QUICK else [pytest.mark.slow]) for w in SOURCES]
)
def test_the_commands_of_a_source_make_a_scene(words, follow, quickly, tmp_path):
    write, instances, labels = SOURCES[words]
    write(tmp_path)
    follow(script_with(words))
    scene = load_scene(tmp_path / "my_room")[0]
    assert len(scene.scans) == 2
    assert (tmp_path / "my_room" / "report.html").stat().st_size > 100_000
    first = {x.observations[0].instance for x in scene.objects if x.observations[0].scan == 0}
    assert first == instances if instances else first
    assert {x.label for x in scene.objects} == labels


@pytest.mark.slow
def test_a_scan_is_added_and_the_scene_exported(follow, quickly, tmp_path):
    labeled_ply(tmp_path)
    follow(script_with(WITH_MASKS))
    follow(script_with(LATER))
    scene = load_scene(tmp_path / "my_room")[0]
    assert len(scene.scans) == 3
    assert {x.observations[0].instance for x in scene.objects if x.observations[0].scan == 0} == {
        CHAIR,
        CABINET,
    }
    follow("more2 export my_room --format glb")
    assert trimesh.load(tmp_path / "my_room.glb").geometry


@pytest.mark.slow
@pytest.mark.parametrize("words", ["3RScan/REFERENCE", "scene0000_00"])
def test_both_objects_are_found_again_with_the_shipped_weights(words, follow, tmp_path):
    write, instances, labels = SOURCES[words]
    write(tmp_path)
    follow(script_with(words))
    scene = load_scene(tmp_path / "my_room")[0]
    assert all(len(x.observations) == 2 for x in scene.objects)
    assert [{o.instance for o in x.observations} for x in scene.objects] == [{i} for i in sorted(instances)]
    assert {x.label for x in scene.objects} == labels


def more2_of(page: str) -> list[str]:
    """The `more2` commands of a page."""
    return [line for line in commands(ROOT / page) if line.startswith("more2 ")]


def stored(folder: Path) -> None:
    """A small scene, with its page."""
    scene, config = living_scene(), preset("robust", upright=True)
    save_scene(scene, folder, config, page=report_html(scene, config))


@pytest.fixture
def visited(monkeypatch):
    """What a browser gets of `--serve`, by the port of the page; another may be in use on this machine."""
    seen: dict[int, str] = {}

    def free_port(folder: Path, port: int) -> ThreadingHTTPServer:
        server = scene_server(folder, 0)

        def look() -> None:
            with urlopen(address_of(server), timeout=10) as answer:
                seen[port] = answer.read().decode()
            server.shutdown()  # as ctrl-C does

        threading.Thread(target=look).start()
        return server

    monkeypatch.setattr("more2_jax.cli.scenes.scene_server", free_port)
    return seen


def test_a_stored_scene_is_shown_served_and_exported(follow, visited, tmp_path):
    stored(tmp_path / "my_room")
    follow("\n".join(more2_of("docs/guides/page.md")))
    assert list(visited) == [8000]
    assert "Living scene" in visited[8000]
    follow("\n".join(more2_of("docs/guides/exporting.md")))
    made = {path.suffix for path in tmp_path.iterdir() if path.is_file()}
    assert made == {".glb", ".usda", ".ply", ".json"}


def test_an_object_is_found_in_other_rooms(follow, tmp_path, capsys):
    for room_name in ("room_1", "room_2", "room_3"):
        stored(tmp_path / "offices" / room_name)
    follow("\n".join(line for line in more2_of("docs/guides/many_rooms.md") if "batch" not in line))
    told = capsys.readouterr().out
    assert "15 objects of 3 scenes" in told
    assert "object_003" in told


@pytest.mark.slow
def test_settings_and_weights_are_told_and_published_weights_imported(follow, tmp_path, capsys):
    shutil.copy(DATA / "tiny_checkpoint.pt", tmp_path / "published.pt")
    shutil.copy(DATA / "tiny_checkpoint_reference.npz", tmp_path / "reference.npz")
    follow("\n".join(more2_of("docs/concepts/prior.md")))
    follow("more2 settings --preset robust")
    told = capsys.readouterr().out
    assert "parameters" in told and "memory_mb" in told and "F_inv" in told
    assert load_prior(tmp_path / "published.npz").name == "published"


def table_of_scenes(folder: Path) -> None:
    """`scenes.csv` as the page prints it, and the scans that it names."""
    (text,) = [b for language, b in blocks(DOCS / "guides/many_rooms.md") if b.startswith("name,scans")]
    (folder / "scenes.csv").write_text(text, encoding="utf-8")
    labeled_ply(folder)
    for name in ("kitchen", "office"):
        for day in ("monday", "friday"):
            (folder / day).mkdir(exist_ok=True)
            shutil.copy(folder / f"{day}.ply", folder / day / f"{name}.ply")


BATCHES = [
    line
    for page in ("many_rooms", "cluster")
    for line in more2_of(f"docs/guides/{page}.md")
    if line.startswith("more2 batch")
]


@pytest.mark.slow
def test_a_table_of_scenes_is_built(follow, quickly, tmp_path, monkeypatch, capsys):
    """By both commands of the guide, here by this process in place of workers and actors."""
    asked: list[tuple[int | None, str | None]] = []

    def team(workers: int | None, ray: str | None, tasks: int, limit_s: float | None) -> Inline:
        assert limit_s is None
        asked.append((workers, ray))
        return Inline()

    monkeypatch.setattr("more2_jax.cli.batch.team_of", team)
    table_of_scenes(tmp_path)
    follow(BATCHES[0])
    assert "2 scenes done" in capsys.readouterr().out
    scenes = [load_scene(tmp_path / "buildings" / name) for name in ("kitchen", "office")]
    assert [(len(scene.scans), config.preset) for scene, config in scenes] == [(2, "robust"), (2, "paper")]
    assert scenes[0][1].upright and scenes[1][1].upright
    follow(BATCHES[1])
    assert "0 failed" in capsys.readouterr().out
    assert asked == [(2, None), (None, "HEAD:6379")]


@pytest.mark.slow
def test_a_table_of_scenes_is_built_by_actors(follow, tmp_path, monkeypatch, capsys):
    """The command of the page word by word, but for the address: a cluster of this machine."""
    pytest.importorskip("ray", reason="needs the extra `cluster`")
    monkeypatch.setenv("PYTHONPATH", str(ROOT))  # for the actors
    monkeypatch.setenv("RAY_worker_niceness", "0")
    table_of_scenes(tmp_path)
    follow(BATCHES[1].replace("HEAD:6379", "local"))
    assert "2 scenes done" in capsys.readouterr().out
    assert (tmp_path / "buildings/office/report.html").is_file()


def test_inspect_prints_what_the_page_of_scans_says(follow, tmp_path, capsys):
    shutil.copy(demo_scan_paths()[1], tmp_path)
    (line,) = more2_of("docs/guides/scans.md")
    follow(line)
    printed = [body for language, body in blocks(DOCS / "guides/scans.md") if language == "text"]
    assert capsys.readouterr().out.strip() == printed[0].strip()


def prepared(folder: Path, tiny_prior) -> None:
    """Whatever the pages below name: scans, their masks, settings, weights, and the PCD of a depth camera."""
    for visit, name in enumerate(("monday", "friday", "sunday")):
        points, ids = room(visit)
        write_ply(folder / f"{name}.ply", vertex_columns(points, my_id=ids.astype(np.int32)))
        write_masks(
            folder / f"{name}.txt", ids[:, None] == [CHAIR, CABINET], ("chair", "cabinet"), (0.9, 0.8)
        )
    points = room(0)[0].astype(np.float32)
    write_pcd(folder / "monday.pcd", dict(zip("xyz", points.T, strict=True)), "binary")
    (folder / "mine.yaml").write_text("static_m: 0.1\n")
    weights = folder / "runs/small/weights.npz"
    weights.parent.mkdir(parents=True)
    save_prior(tiny_prior, weights)


LONGER = [
    (page, k)
    for page in (
        "guides/masks",
        "guides/settings",
        "guides/training",
        "concepts/robust",
        "concepts/field",
        "concepts/paper",
    )
    for k, (language, body) in enumerate(blocks(DOCS / f"{page}.md"))
    if language == "bash" and any(line.startswith(("more2 run", "more2 prior")) for line in lines(body))
]


@pytest.mark.slow
@pytest.mark.parametrize(("page", "k"), LONGER)
def test_the_commands_of_a_guide_make_a_scene(page, k, follow, quickly, tmp_path, tiny_prior):
    prepared(tmp_path, tiny_prior)
    if page in ("guides/settings", "guides/training") or page.startswith("concepts"):
        labeled_ply(tmp_path)
    script = blocks(DOCS / f"{page}.md")[k][1]
    follow("\n".join(line for line in lines(script) if line.startswith("more2 ")))
    assert load_scene(tmp_path / "my_room")[0].objects


@pytest.mark.slow
def test_the_readme_prints_what_it_says(follow, tmp_path, capsys):
    for path in demo_scan_paths()[:2]:
        shutil.copy(path, tmp_path)
    script, printed = next(
        (one[1], two[1]) for one, two in itertools.pairwise(blocks(ROOT / "README.md")) if two[0] == "text"
    )
    follow(script)
    told = capsys.readouterr().out
    rows = [line for line in printed.splitlines() if line.startswith("│")]
    assert len(rows) == 8
    for row in rows:
        assert without_figures(row) in [without_figures(line) for line in told.splitlines()]


def without_figures(row: str) -> list[str]:
    """The words of a row; figures differ in the last digits from machine to machine."""
    return re.sub(r"\d[\d.]*", "#", row).split()
