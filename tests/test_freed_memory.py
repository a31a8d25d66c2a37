"""What was freed goes back to the system for large scenes, and stays for small ones, which need it soon again."""

import subprocess
import sys

import pytest

from more2_jax import freed_memory
from more2_jax.freed_memory import LARGE, give_back

# Pieces below the size for which the C library asks the system anew, each followed by one that stays. Those that stay
# are above the 512 bytes that Python takes from pools of its own: smaller ones would lie elsewhere.
PROGRAM = """
import mmap, sys
from more2_jax.freed_memory import give_back
def resident():
    return int(next(x for x in open("/proc/self/status") if x.startswith("VmRSS")).split()[1]) / 1024
mapped = mmap.mmap(-1, 64 << 20, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
mapped.write(bytes(64 << 20))
filled = resident()
mapped.madvise(mmap.MADV_DONTNEED)
told = filled - resident()  # what the system says of 64 MB that are certainly its own again
start = resident()
pieces = [(bytearray(64_000), bytearray(2_000)) for _ in range(2_000)]
pieces = [stays for _, stays in pieces]
before = resident()
give_back(int(sys.argv[1]))
print(told, before - resident(), resident() - start)
"""


def after_freeing(objects: int) -> tuple[float, float]:
    """What `give_back` returned of 128 MB that were freed, and what the process then holds above its start, in MB."""
    run = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(objects)], capture_output=True, text=True, check=True
    )
    told, returned, held = map(float, run.stdout.split())
    if told < 60:
        pytest.skip(f"this system does not say what was given back to it: {told:.1f} MB of 64")
    return returned, held


glibc = pytest.mark.skipif(freed_memory._glibc() is None, reason="not glibc: there is nothing to ask")


@glibc
def test_of_128_mb_freed_in_pieces_a_large_scene_holds_little():
    assert after_freeing(LARGE + 1)[1] < 40


@glibc
def test_a_small_scene_is_left_what_it_freed():
    assert abs(after_freeing(LARGE)[0]) < 5


def test_without_that_library_nothing_happens(monkeypatch):
    monkeypatch.setattr(freed_memory, "_glibc", lambda: None)
    give_back(LARGE + 1)
