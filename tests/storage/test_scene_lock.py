"""One process at a time works on a scene; a second is told which; a process that is killed holds nothing."""

import os
import socket
import subprocess
import sys
import threading

import pytest
from command_line import refused, scan_file
from factories import living_scene

from more2_jax.config import preset
from more2_jax.network.prior import save_prior
from more2_jax.storage import scene_lock as module
from more2_jax.storage.scene_folder import save_scene
from more2_jax.storage.scene_lock import scene_lock

pytestmark = pytest.mark.skipif(os.name != "posix", reason="other systems have no flock")
HOLDING = """
import sys
from more2_jax.storage.scene_lock import scene_lock
with scene_lock(sys.argv[1]):
    print("holds", flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def holder(tmp_path):
    """Another process that holds tmp_path / room until it is told to end."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLDING, str(tmp_path / "room")], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    assert process.stdout is not None and process.stdout.readline() == b"holds\n"
    yield process
    process.kill()
    process.communicate()


def test_a_second_process_is_told_who_holds_it(tmp_path, holder):
    text = rf"room: process {holder.pid} on {socket.gethostname()}, since \d{{4}}-.* works on it"
    with pytest.raises(ValueError, match=text), scene_lock(tmp_path / "room"):
        pass
    with scene_lock(tmp_path / "other"):  # another scene is free
        pass
    holder.communicate()  # its input ends, and so does it
    with scene_lock(tmp_path / "room"):
        pass
    assert list(tmp_path.iterdir()) == []


def test_a_killed_process_holds_nothing(tmp_path, holder):
    holder.kill()
    holder.wait()
    assert [p.name for p in tmp_path.iterdir()] == [".room.lock"]
    with scene_lock(tmp_path / "room"):
        assert str(os.getpid()) in (tmp_path / ".room.lock").read_text()
    assert list(tmp_path.iterdir()) == []


def test_run_add_and_save_say_it_in_one_line_and_leave_all_as_it_was(tmp_path, holder, tiny_prior, capsys):
    scan = scan_file(tmp_path / "a.ply")
    save_prior(tiny_prior, tmp_path / "tiny.npz")
    argv = ["--out", tmp_path / "room", "--prior", tmp_path / "tiny.npz"]
    assert f"process {holder.pid} on " in refused(capsys, "run", scan, *argv)
    scene, config = living_scene(), preset("robust", upright=True)
    with pytest.raises(ValueError, match=f"process {holder.pid} on "):
        save_scene(scene, tmp_path / "room", config)
    assert not (tmp_path / "room").exists()
    save_scene(scene, tmp_path / "saved", config)
    (tmp_path / "saved").rename(tmp_path / "room")
    before = {p: p.read_bytes() for p in (tmp_path / "room").rglob("*") if p.is_file()}
    assert f"process {holder.pid} on " in refused(capsys, "add", tmp_path / "room", scan)
    assert {p: p.read_bytes() for p in (tmp_path / "room").rglob("*") if p.is_file()} == before


def test_the_thread_that_holds_it_may_take_it_again_and_no_other(tmp_path):
    said = []

    def other():
        try:
            with scene_lock(tmp_path / "room"):
                said.append("held")
        except ValueError as error:
            said.append(str(error))

    with scene_lock(tmp_path / "room"):
        with scene_lock(tmp_path / "room"):
            pass
        thread = threading.Thread(target=other)
        thread.start()
        thread.join()
    assert f"process {os.getpid()} on" in said[0]
    with scene_lock(tmp_path / "room"):
        pass


def test_the_lock_of_a_file_that_was_removed_meanwhile_is_not_taken_for_one(tmp_path, monkeypatch):
    """Who waits with the old file open must not hold that, while a third holds the new one."""
    path, seen = tmp_path / ".room.lock", []
    real = module.fcntl.flock

    def removed_before(file, how):
        if not seen:
            seen.append(os.fstat(file).st_ino)
            path.rename(tmp_path / "gone")
        return real(file, how)

    monkeypatch.setattr(module.fcntl, "flock", removed_before)
    with scene_lock(tmp_path / "room"):
        assert path.stat().st_ino != seen[0]


def test_without_locks_in_the_file_system_nothing_is_held(tmp_path, monkeypatch):
    def none(file, how):
        raise OSError(module.errno.ENOLCK, "No locks available")

    monkeypatch.setattr(module.fcntl, "flock", none)
    with scene_lock(tmp_path / "room"):
        pass
    monkeypatch.setattr(module, "fcntl", None)
    with scene_lock(tmp_path / "room"):
        pass


def test_a_full_disk_is_refused_before_any_work_and_nothing_is_left(tmp_path, monkeypatch):
    def full(file, text):
        raise OSError(module.errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(module.os, "write", full)
    with (
        pytest.raises(OSError, match=r"No space left on device: .*room\.lock"),
        scene_lock(tmp_path / "room"),
    ):
        pass
    assert list(tmp_path.iterdir()) == []
