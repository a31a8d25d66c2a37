"""Memory that was freed goes back to the system, between the steps of work on large scenes."""

from __future__ import annotations

import ctypes
import gc
from functools import lru_cache
from typing import Any

LARGE = 64  # objects: with fewer, what is freed is soon needed again


def give_back(objects: int) -> None:
    """Returns what was freed, where a scene is large.

    The C library keeps it otherwise, in pieces that later steps do not fit in: a quarter of what a building of 74
    objects took. Does nothing where that library is not glibc.
    """
    if objects > LARGE and (library := _glibc()) is not None:
        gc.collect()
        library.malloc_trim(0)


@lru_cache(maxsize=1)
def _glibc() -> Any:
    """The C library of this process, where it can be told to return memory."""
    try:
        library = ctypes.CDLL(None)
    except (OSError, TypeError):  # such as on Windows
        return None
    return library if hasattr(library, "malloc_trim") else None
