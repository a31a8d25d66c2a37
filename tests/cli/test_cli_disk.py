"""What the operating system refuses to write costs one line, and nothing that is on disk."""

import os
import subprocess
import sys

import pytest
from command_line import run_quickly, scan_file

pytestmark = [
    pytest.mark.skipif(os.name != "posix", reason="other systems have no such limit"),
    pytest.mark.optimized,  # what the processes below look for in the store of compiled programs
]

LIMITED = """
import resource, sys
import more2_jax.cli.living_scenes as commands
# A store of compiled programs would be cut short too, for everybody: it is read alone.
commands.keep_compiled_programs = lambda: None
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[1]), int(sys.argv[1])))
from more2_jax.cli.main import main
sys.exit(main(sys.argv[2:]))
"""
# Nothing takes so long to compile that it were kept; all else as in this process.
READS_ALONE = {
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "1e9",
    "JAX_DEFAULT_MATMUL_PRECISION": "highest",
}


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
        env = os.environ | READS_ALONE
        done = subprocess.run([str(a) for a in argv], capture_output=True, text=True, env=env)
        (line,) = [text for text in done.stderr.splitlines() if text.startswith("error:")]
        assert done.returncode == 1 and "File too large" in line and says in line
        assert "Traceback" not in done.stderr
    assert {p: p.read_bytes() for p in (tmp_path / "room").rglob("*") if p.is_file()} == before
    assert not (tmp_path / "new").exists()
    assert [p.name for p in tmp_path.iterdir() if p.name.startswith(".")] == []
