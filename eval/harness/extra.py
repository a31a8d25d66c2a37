"""Libraries of the extra `peers`, imported when they are used."""

from __future__ import annotations

import importlib
from typing import Any


def library(name: str) -> Any:
    """A module of the extra. Raises ValueError, naming the extra, if it cannot be imported."""
    try:
        return importlib.import_module(name)
    except (ImportError, OSError) as error:
        text = " ".join(str(error).split())
        raise ValueError(f"{name} ({text}): install more2-jax[peers]") from error


def has(name: str) -> bool:
    """Whether a module can be imported."""
    try:
        importlib.import_module(name)
    except (ImportError, OSError):
        return False
    return True
