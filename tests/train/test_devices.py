"""What training asks of XLA on CPUs, beside what a user asks."""

import os
import subprocess
import sys

import pytest

from train.run import devices
from train.run.devices import wide_vectors

WIDE = "--xla_cpu_prefer_vector_width=512"


@pytest.mark.parametrize(
    ("given", "jaxlib", "flags"),
    [
        ("", "0.10.2", WIDE),
        ("--xla_other=1", "0.10.2", f"--xla_other=1 {WIDE}"),
        ("--xla_cpu_prefer_vector_width=256", "0.10.2", "--xla_cpu_prefer_vector_width=256"),
        ("", "99.0.0", ""),
    ],
)
def test_wide_registers_are_asked_for_unless_the_user_chose(monkeypatch, given, jaxlib, flags):
    monkeypatch.setenv("XLA_FLAGS", given)
    monkeypatch.setattr(devices, "version", lambda _: jaxlib)
    for _ in range(2):
        wide_vectors()
    assert os.environ["XLA_FLAGS"] == flags


def test_the_installed_version_knows_the_flag():
    program = (
        "from train.run.devices import wide_vectors as f; f(); import jax; print(jax.jit(lambda x: x + 1)(1))"
    )
    told = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert told.stdout.strip() == "2"
