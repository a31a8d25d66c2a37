"""The commands of `docs/start/first_scans.md` run word by word, on small true files of every source that it names."""

import shlex
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from dataset_writers.ply_file import vertex_columns, write_ply
from dataset_writers.scannet import write_scannet
from dataset_writers.threerscan import write_annotated_mesh, write_semseg
from furnished import cabinet, chair, corner
from guide_pages import blocks, lines
from places import ROOT
from scipy.spatial.transform import Rotation

from eval.survival import FEW_STEPS
from more2_jax.cli.main import main
from more2_jax.cli.settings import scene_config
from more2_jax.storage.scene_folder import load_scene

SCRIPTS = [body for language, body in blocks(ROOT / "docs/start/first_scans.md") if language == "bash"]
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
    monkeypatch.setattr(
        "more2_jax.cli.main.scene_config",
        lambda name, upright, path, **more: scene_config(name, upright, path or few, **more),
    )


def test_every_block_of_the_page_is_run_here():
    assert {script_with(words) for words in (*SOURCES, WITH_MASKS, LATER)} == set(SCRIPTS)


@pytest.mark.no_cover
@pytest.mark.parametrize("words", list(SOURCES))
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


@pytest.mark.no_cover
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
