"""Arrays of an NPZ file, or one line that says what is wrong."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from more2_jax.scans.labeled_cloud import one_line

# Of Unicode; and halves of characters, which are none by themselves.
LAST_CHARACTER, SURROGATES = np.uint32(0x10FFFF), (np.uint32(0xD800), np.uint32(0xDFFF))


def read_arrays(path: Path, wanted: Iterable[str]) -> tuple[dict[str, np.ndarray], str]:
    """Those of the wanted arrays that the file has, and the names of all, for a message.

    Raises ValueError, in one line, when the file is no NPZ, is damaged, or one of these is no plain array.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            names = one_line(ValueError(", ".join(file.files) or "nothing"))
            arrays = {name: file[name] for name in wanted if name in file.files}
    except Exception as error:  # NumPy, zipfile and the parser of headers raise nearly anything
        raise ValueError(f"{path}: not a readable NPZ file ({one_line(error)})") from error
    if other := [name for name, array in arrays.items() if not isinstance(array, np.ndarray)]:
        raise ValueError(f"{path}: not a readable NPZ file ({', '.join(other)} is no array)")
    if broken := [name for name, array in arrays.items() if not is_text(array)]:
        raise ValueError(f"{path}: not a readable NPZ file ({', '.join(broken)} holds what is no text)")
    return arrays, names


def is_text(array: np.ndarray) -> bool:
    """Whether all strings of an array are of characters that there are; of other arrays True."""
    if array.dtype.kind != "U" or not array.size or not array.dtype.itemsize:
        return True
    codes = np.ascontiguousarray(array.astype(array.dtype.newbyteorder("="))).reshape(-1).view(np.uint32)
    return not ((codes > LAST_CHARACTER) | (codes - SURROGATES[0] <= SURROGATES[1] - SURROGATES[0])).any()
