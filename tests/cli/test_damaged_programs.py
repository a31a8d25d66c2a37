"""Compiled programs that were cut off on disk: made anew once, without a word; whole ones are left alone."""

from __future__ import annotations

import subprocess
import sys

import pytest
from places import ROOT

PROGRAM = """
import jax
from more2_jax.cli.session import compile_sooner, keep_compiled_programs
{kept}
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)

@jax.jit
def cut_off(x):
    return (x * x).sum()

@jax.jit
def whole(x):
    return (x + x).sum()

print(cut_off(jax.numpy.arange(4.0)), whole(jax.numpy.arange(4.0)))
"""


def run(folder, kept="keep_compiled_programs()"):
    """What a process says that keeps its programs in a folder."""
    environment = {"JAX_PLATFORMS": "cpu", "JAX_COMPILATION_CACHE_DIR": str(folder), "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM.format(kept=kept)], env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0 and done.stdout == "14.0 12.0\n", done.stderr
    return done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("left", [0, 100])
def test_a_program_that_was_cut_off_is_made_anew_without_a_word(tmp_path, left):
    assert run(tmp_path) == ""
    (whole,) = tmp_path.glob("jit_whole-*-cache")
    (file,) = tmp_path.glob("jit_cut_off-*-cache")
    full, untouched = file.read_bytes(), whole.stat().st_mtime_ns
    file.write_bytes(full[:left])
    assert "Error reading" in run(
        tmp_path, kept="compile_sooner()"
    )  # JAX by itself warns, each time, and leaves it so
    assert len(file.read_bytes()) == left
    assert run(tmp_path) == ""
    assert len(file.read_bytes()) == pytest.approx(len(full), rel=0.05)
    assert whole.stat().st_mtime_ns == untouched
    assert run(tmp_path, kept="compile_sooner()") == ""
