"""What the operating system refuses to write costs one line, and nothing that is on disk."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from command_line import run_quickly, scan_file

from more2_jax.cli.main import main

resource = pytest.importorskip("resource", reason="other systems have no such limit")
pytestmark = pytest.mark.optimized  # scenes run for longer than their programs compile


@contextmanager
def files_end_at(size: int) -> Iterator[None]:
    """Files may grow to so many bytes and no further: the operating system refuses in the middle of a write."""
    before, most = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, most))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (before, most))


def test_a_disk_that_takes_no_more_is_one_line_and_costs_nothing(tmp_path, tiny, capsys):
    scan, room = scan_file(tmp_path / "a.ply"), tmp_path / "room"
    assert run_quickly(scan, out=room, prior=tiny) == 0
    # All is compiled before: the store of compiled programs would be cut short, too.
    shutil.copytree(room, tmp_path / "elsewhere")
    assert main(["add", str(tmp_path / "elsewhere"), str(scan), "--prior", str(tiny)]) == 0
    before = {p: p.read_bytes() for p in room.rglob("*") if p.is_file()}
    for words, says in (
        (["run", scan, "--out", tmp_path / "new", "--config", tmp_path / "quick.yaml"], "new is as it was"),
        (["add", room, scan], "room is as it was"),
    ):
        capsys.readouterr()
        with files_end_at(3000):
            code = main([str(a) for a in (*words, "--prior", tiny)])
        (line,) = [text for text in capsys.readouterr().err.splitlines() if text.startswith("error:")]
        assert code == 1 and "File too large" in line and says in line
    assert {p: p.read_bytes() for p in room.rglob("*") if p.is_file()} == before
    assert not (tmp_path / "new").exists()
    assert [p.name for p in tmp_path.iterdir() if p.name.startswith(".")] == []
