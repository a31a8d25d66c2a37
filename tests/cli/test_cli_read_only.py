"""A folder that cannot be written is one line and exit code 2, before any work; nothing changes on disk."""

import os

import pytest
from command_line import refused, scan_file
from factories import living_scene

from more2_jax.config import preset
from more2_jax.storage.scene_folder import save_scene

pytestmark = pytest.mark.skipif(os.name != "posix", reason="other systems have other permissions")


def without_permission(folder, monkeypatch):
    """Nobody may write in the folder; root, whom permissions do not stop, is told so as others are."""
    folder.chmod(0o555)
    if os.geteuid() == 0:
        monkeypatch.setattr(os, "access", lambda path, mode: bool(os.stat(path).st_mode & 0o222))


@pytest.fixture(params=["no permission", "a file"])
def closed(request, tmp_path, monkeypatch):
    """A folder that takes no files, and what stands in the way."""
    place = tmp_path / "place"
    if request.param == "a file":
        place.write_text("of somebody")
        yield place / "below", place
    else:
        place.mkdir()
        without_permission(place, monkeypatch)
        yield place, place
        place.chmod(0o755)


def test_new_files_in_a_folder_that_cannot_be_written(tmp_path, closed, stored, tiny, capsys):
    folder, reason = closed
    scan = scan_file(tmp_path / "a.ply")
    (tmp_path / "scenes.csv").write_text(f"name,scans,prior\none,a.ply,{tiny}\ntwo,a.ply,{tiny}\n")
    for words, target in (
        (["run", scan, "--out", folder / "room", "--prior", tiny], folder / "room"),
        (["batch", tmp_path / "scenes.csv", "--out", folder], folder / "results"),
        (["export", stored, "--format", "glb", "--out", folder / "x.glb"], folder / "x.glb"),
        (["index", stored, "--out", folder / "x.npz"], folder / "x.npz"),
    ):
        said = refused(capsys, *words)
        assert said == f"error: {target}: cannot write in {reason}; needed a folder that can be written"
    assert reason.is_file() or not list(folder.iterdir())


def test_a_scene_in_a_folder_that_cannot_be_written(tmp_path, tiny, capsys, monkeypatch):
    place = tmp_path / "place"
    save_scene(living_scene(), place / "room", preset("robust", upright=True))
    before = {p: p.read_bytes() for p in place.rglob("*") if p.is_file()}
    without_permission(place, monkeypatch)
    said = refused(capsys, "add", place / "room", scan_file(tmp_path / "a.ply"), "--prior", tiny)
    place.chmod(0o755)
    assert said == f"error: {place / 'room'}: cannot write in {place}; needed a folder that can be written"
    assert {p: p.read_bytes() for p in place.rglob("*") if p.is_file()} == before
