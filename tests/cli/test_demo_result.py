"""The README's first command ends as it says: every object that stays is found again and put where it is."""

import subprocess
import sys


def test_the_demo_finds_and_poses_all_six_objects_that_stay(tmp_path):
    """As a process of its own, compiled as it is for users."""
    command = [sys.executable, "-m", "more2_jax.cli.main", "demo", "--out", str(tmp_path / "demo")]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "6 of 6 persisting objects right" in done.stdout
    assert (tmp_path / "demo" / "report.html").is_file()
