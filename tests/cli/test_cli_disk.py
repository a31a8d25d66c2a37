"""What the operating system refuses to write costs one line, and nothing that is on disk."""

import os
import subprocess
import sys

import pytest
from command_line import run_quickly, scan_file

pytestmark = pytest.mark.skipif(os.name != "posix", reason="other systems have no such limit")

LIMITED = """
import resource, sys
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[1]), int(sys.argv[1])))
from more2_jax.cli.main import main
sys.exit(main(sys.argv[2:]))
"""


def test_a_disk_that_takes_no_more_is_one_line_and_costs_nothing(tmp_path, tiny):
    """Files may grow to so many bytes and no further: the operating system refuses in the middle of a write."""
    scan = scan_file(tmp_path / "a.ply")
    assert run_quickly(scan, out=tmp_path / "room", prior=tiny) == 0
    before = {p: p.read_bytes() for p in (tmp_path / "room").rglob("*") if p.is_file()}
    for words, says in (
        (["run", scan, "--out", tmp_path / "new", "--config", tmp_path / "quick.yaml"], "new is as it was"),
        (["add", tmp_path / "room", scan], "room is as it was"),
    ):
        argv = [sys.executable, "-c", LIMITED, 3000, *words, "--prior", tiny]
        # A store of compiled programs would be cut short too, for everybody.
        env = os.environ | {"JAX_ENABLE_COMPILATION_CACHE": "false"}
        done = subprocess.run([str(a) for a in argv], capture_output=True, text=True, env=env)
        (line,) = [text for text in done.stderr.splitlines() if text.startswith("error:")]
        assert done.returncode == 1 and "File too large" in line and says in line
        assert "Traceback" not in done.stderr
    assert {p: p.read_bytes() for p in (tmp_path / "room").rglob("*") if p.is_file()} == before
    assert not (tmp_path / "new").exists()
    assert [p.name for p in tmp_path.iterdir() if p.name.startswith(".")] == []
