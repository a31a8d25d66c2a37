"""What was freed goes back to the system for large scenes, and stays for small ones, which need it soon again."""

import subprocess
import sys

import pytest

from more2_jax import freed_memory
from more2_jax.freed_memory import LARGE, give_back

# Pieces below the size for which the C library asks the system anew, each followed by one that stays.
PROGRAM = """
import sys
from more2_jax.freed_memory import give_back
def resident():
    return int(next(x for x in open("/proc/self/status") if x.startswith("VmRSS")).split()[1]) / 1024
pieces = [(bytearray(64_000), bytearray(200)) for _ in range(2_000)]
pieces = [stays for _, stays in pieces]
before = resident()
give_back(int(sys.argv[1]))
print(before - resident())
"""


@pytest.mark.skipif(freed_memory._glibc() is None, reason="not glibc: there is nothing to ask")
@pytest.mark.parametrize(("objects", "least_mb", "most_mb"), [(LARGE, -5, 5), (LARGE + 1, 80, 140)])
def test_of_128_mb_freed_in_pieces_a_large_scene_gives_most_back(objects, least_mb, most_mb):
    told = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(objects)], capture_output=True, text=True, check=True
    )
    assert least_mb < float(told.stdout) < most_mb


def test_without_that_library_nothing_happens(monkeypatch):
    monkeypatch.setattr(freed_memory, "_glibc", lambda: None)
    give_back(LARGE + 1)
