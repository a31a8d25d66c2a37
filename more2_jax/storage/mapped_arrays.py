"""Arrays of an .npz that stay in the file until they are looked at, as `np.load(mmap_mode=...)` has it for one .npy.

`np.savez` puts every array as it is into the archive, so its bytes can be mapped where they lie. Compressed members
are read.
"""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import IO

import numpy as np

# In a zip archive, a member's header: where the lengths of its name and of what follows that stand, two bytes each, and
# how long it is without both.
LENGTHS_AT, HEADER_BYTES = 26, 30
HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}


def mapped_arrays(path: Path) -> dict[str, np.ndarray]:
    """All arrays of an .npz by name, read-only; those that are compressed, or a single number, in memory.

    Raises what `np.load` and `np.memmap` raise of a file that is damaged. What is mapped has no checksum.
    """
    with np.load(path, allow_pickle=False) as file, path.open("rb") as raw:
        members = {info.filename.removesuffix(".npy"): info for info in file.zip.infolist()}
        found = {name: _mapped(path, raw, info) for name, info in members.items()}
        return {name: file[name] if array is None else array for name, array in found.items()}


def _mapped(path: Path, raw: IO[bytes], info: zipfile.ZipInfo) -> np.ndarray | None:
    """A member where it lies in the file; None where it must be read."""
    if info.compress_type != zipfile.ZIP_STORED:
        return None
    raw.seek(info.header_offset + LENGTHS_AT)
    name, extra = (int.from_bytes(raw.read(2), "little") for _ in range(2))
    raw.seek(info.header_offset + HEADER_BYTES + name + extra)
    header = HEADERS.get(np.lib.format.read_magic(raw))
    if header is None:
        return None
    shape, fortran, kind = header(raw)
    if kind.hasobject or 0 in shape or not shape:
        return None
    return np.memmap(path, kind, "r", raw.tell(), shape, "F" if fortran else "C")
