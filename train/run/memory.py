"""How much memory there is, and keeping what a step gives back, for the next step to take."""

from __future__ import annotations

import ctypes
import os
from contextlib import suppress
from pathlib import Path

import jax

TRIM_THRESHOLD, TOP_PAD, MMAP_THRESHOLD = -1, -2, -3  # of mallopt, in glibc's malloc.h
LIMIT = 2**30  # glibc takes no larger threshold on all machines; a block beyond it is mapped
OPTIONS = ((MMAP_THRESHOLD, LIMIT), (TRIM_THRESHOLD, 2**31 - 1), (TOP_PAD, 2**28))
# The same for a process that is to be started.
GLIBC_KEEPS_MEMORY = {
    "MALLOC_MMAP_THRESHOLD_": str(LIMIT),
    "MALLOC_TRIM_THRESHOLD_": str(2**31 - 1),
    "MALLOC_TOP_PAD_": str(2**28),
}


def keep_freed_memory() -> bool:
    """Stops glibc from giving large blocks back to the system; False where there is no glibc.

    XLA on CPUs asks for every intermediate array anew. By default each is mapped, cleared by the kernel and unmapped
    again: 50,000 page faults a second, a sixth of a training run's time. The price is memory that stays taken.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:
        return False
    return all([mallopt(option, value) == 1 for option, value in OPTIONS])


def memory_bytes() -> int:
    """Of the first device, or of the machine (of the container, where one is limited) if that is a CPU."""
    device = jax.local_devices()[0]
    if device.platform != "cpu":
        return int(device.memory_stats()["bytes_limit"])  # pyright: ignore[reportOptionalSubscript]
    found = [os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")]
    with suppress(OSError, ValueError):  # no such file, or "max"
        found.append(int(Path("/sys/fs/cgroup/memory.max").read_text()))
    return min(found)
