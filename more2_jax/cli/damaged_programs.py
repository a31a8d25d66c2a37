"""Damaged files among the compiled programs that JAX keeps: they are removed when they are met, and made anew.

A process that is killed while it writes one, or a full disk, leaves a part of a file. JAX warns, compiles, and does
not write a program whose file exists: without this, every later process would warn and compile again.
"""

from __future__ import annotations

import re
import warnings
from pathlib import Path
from typing import TextIO

MET = re.compile(r"Error reading persistent compilation cache entry for '([^']+)'")  # jax._src.compiler


def replace_damaged_programs() -> None:
    """From now on a program whose file JAX cannot read is compiled and written again, without a warning.

    All files of programs of that name go, as the warning does not say which it was; they are made again as needed.
    """
    shown = warnings.showwarning

    def show(
        message: Warning | str,
        category: type[Warning],
        filename: str,
        lineno: int,
        file: TextIO | None = None,
        line: str | None = None,
    ) -> None:
        met = MET.match(str(message))
        if met is None or not forget_program(met.group(1)):
            shown(message, category, filename, lineno, file, line)

    warnings.showwarning = show


def forget_program(name: str) -> bool:
    """Removes the files of compiled programs of that name; False where there are none, or they cannot be removed."""
    import jax

    folder = jax.config.values["jax_compilation_cache_dir"]
    files = [p for p in Path(folder).iterdir() if p.name.startswith(f"{name}-")] if folder else []
    try:
        for file in files:
            file.unlink(missing_ok=True)
    except OSError:
        return False
    return bool(files)
