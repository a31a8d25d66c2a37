"""What the programs of this folder share: how they end on bad input."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import tyro


def run(main: Callable[..., Any]) -> None:
    """Runs `main` with the command line's arguments; a ValueError becomes one line and exit code 2."""
    try:
        tyro.cli(main)
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
