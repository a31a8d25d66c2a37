"""JSON as datasets ship it, or one line that says what is wrong."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any


def read_json(path: Path) -> Any:
    """The content of a JSON file. ValueError, in one line, if it is missing, cut short or malformed."""
    try:
        return json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError) as error:
        raise ValueError(f"{path}: not readable JSON ({' '.join(str(error).split())})") from error
