"""Ways in which a file or a folder of files gets damaged, drawn from a random generator.

Checksums would hide most of a format from random bytes, so half of the mutations of NPZ and E57 files are made
beneath them: on a member of the archive, or on the pages' content, with the checksums written anew.
"""

from __future__ import annotations

import io
import re
import shutil
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np

NUMBER = re.compile(rb"-?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?")
TOKENS = (
    *(
        b"0",
        b"-1",
        b"1",
        b"255",
        b"256",
        b"65536",
        b"2147483647",
        b"-2147483648",
        b"4294967295",
        b"999999999",
    ),
    *(
        b"9223372036854775807",
        b"18446744073709551616",
        b"-99999999999999999999",
        b"1e308",
        b"-1e308",
        b"1e999",
    ),
    *(b"nan", b"NaN", b"inf", b"-inf", b"0.5", b"null", b"true", b"[]", b"{}", b'""', b'"7"', b"x", b""),
)
PATTERNS = tuple(
    struct.pack(end + kind, value)
    for end in "<>"
    for kind, values in (
        ("i", (0, -1, 1, 2**31 - 1, -(2**31), 10**9)),
        ("q", (0, -1, 2**63 - 1, -(2**63), 10**12)),
        ("f", (np.nan, np.inf, -np.inf, 3e38)),
        ("d", (np.nan, np.inf, 1e308, -1e-308)),
        ("H", (0, 65535)),
    )
    for value in values
)
SUFFIXES = (".ply", ".npz", ".pcd", ".las", ".laz", ".e57", ".json", ".txt", "", ".PLY", ".bak")
PAGE = 1024  # bytes of an E57 page, of which the last four are its checksum


def damage(folder: Path, scan: Path, rng: np.random.Generator) -> tuple[Path, str]:
    """Damages one to three places of the files below `folder`; the scan's path, which may change, and what was done."""
    done = []
    for _ in range(int(rng.choice([1, 1, 1, 2, 3]))):
        files = sorted(p for p in folder.rglob("*") if p.is_file())
        if not files:
            break
        file = files[rng.integers(len(files))]
        if rng.random() < 0.08:
            scan, what = _damage_names(file, files, scan, rng)
        else:
            data = file.read_bytes()
            changed, what = _damage_content(file, data, rng)
            file.write_bytes(changed)
        done.append(f"{file.name}: {what}")
    return scan, "; ".join(done)


def _damage_names(file: Path, files: list[Path], scan: Path, rng: np.random.Generator) -> tuple[Path, str]:
    """A file goes, is renamed, becomes a folder, or changes places with another."""
    choice = int(rng.integers(4))
    if choice == 0:
        file.unlink()
        return scan, "dropped"
    if choice == 1:
        name = file.stem[: int(rng.integers(1, len(file.stem) + 1))] + str(rng.choice(SUFFIXES))
        target = file.with_name(name)
        if not target.exists():
            file.rename(target)
        return (target if file == scan else scan), f"renamed to {name}"
    if choice == 2:
        file.unlink()
        file.mkdir()
        return scan, "became a folder"
    other = files[rng.integers(len(files))]
    first, second = file.read_bytes(), other.read_bytes()
    file.write_bytes(second)
    other.write_bytes(first)
    return scan, f"changed places with {other.name}"


def _damage_content(file: Path, data: bytes, rng: np.random.Generator) -> tuple[bytes, str]:
    change = CHANGES[int(rng.integers(len(CHANGES)))]
    name = change.__name__.strip("_")
    if rng.random() < 0.5:
        try:
            if zipfile.is_zipfile(io.BytesIO(data)):
                return _inside_zip(data, change, rng), f"{name} in a member"
            if data[:8] == b"ASTM-E57":
                return _inside_e57(data, change, rng), f"{name} below the checksums"
        except (zipfile.BadZipFile, zlib.error, ValueError, OSError, RuntimeError, EOFError):
            pass  # damaged before: then from outside
    return change(data, rng), name


def _inside_zip(data: bytes, change: Callable[..., bytes], rng: np.random.Generator) -> bytes:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = sorted(members)[rng.integers(len(members))]
    members[name] = change(members[name], rng)
    if rng.random() < 0.1:
        del members[name]
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for key, content in members.items():
            archive.writestr(key, content)
    return out.getvalue()


def _inside_e57(data: bytes, change: Callable[..., bytes], rng: np.random.Generator) -> bytes:
    content = b"".join(data[at : at + PAGE - 4] for at in range(0, len(data), PAGE))
    if rng.random() < 0.7 and (start := content.find(b"<?xml")) > 0:  # the text, at its own length
        changed = change(content[start:], rng)[: len(content) - start]
        content = content[:start] + changed.ljust(len(content) - start)
    else:
        content = content[:48] + change(content[48:], rng)[: len(content) - 48].ljust(
            len(content) - 48, b"\0"
        )
    pages = [content[at : at + PAGE - 4].ljust(PAGE - 4, b"\0") for at in range(0, len(content), PAGE - 4)]
    return b"".join(page + struct.pack(">I", _crc32c(page)) for page in pages)


def _crc32c(data: bytes) -> int:
    crc = 0xFFFFFFFF
    for byte in data:
        crc = (crc >> 8) ^ CRC_TABLE[(crc ^ byte) & 255]
    return crc ^ 0xFFFFFFFF


def _crc_entry(value: int) -> int:
    for _ in range(8):
        value = (value >> 1) ^ (0x82F63B78 if value & 1 else 0)  # Castagnoli, reflected
    return value


CRC_TABLE = tuple(_crc_entry(value) for value in range(256))


# --- changes of bytes ---------------------------------------------------------------------------------------------


def _place(data: bytes, rng: np.random.Generator) -> int:
    """Anywhere, but half the time near the beginning, where headers are."""
    top = len(data) if rng.random() < 0.5 else min(len(data), 512)
    return int(rng.integers(top + 1))


def _flip(data: bytes, rng: np.random.Generator) -> bytes:
    changed = bytearray(data)
    for _ in range(int(rng.integers(1, 9))):
        if (at := _place(data, rng)) < len(data):
            changed[at] ^= 1 << int(rng.integers(8))
    return bytes(changed)


def _truncate(data: bytes, rng: np.random.Generator) -> bytes:
    return data[: int(rng.integers(len(data) + 1))]


def _insert(data: bytes, rng: np.random.Generator) -> bytes:
    at = _place(data, rng)
    return data[:at] + rng.bytes(int(rng.integers(1, 65))) + data[at:]


def _delete(data: bytes, rng: np.random.Generator) -> bytes:
    at = _place(data, rng)
    return data[:at] + data[at + int(rng.integers(1, 65)) :]


def _duplicate(data: bytes, rng: np.random.Generator) -> bytes:
    at, size = _place(data, rng), int(rng.integers(1, 513))
    return data[:at] + data[at : at + size] * int(rng.integers(2, 9)) + data[at + size :]


def _pattern(data: bytes, rng: np.random.Generator) -> bytes:
    at, pattern = _place(data, rng), PATTERNS[int(rng.integers(len(PATTERNS)))]
    return data[:at] + pattern + data[at + len(pattern) :]


def _number(data: bytes, rng: np.random.Generator) -> bytes:
    """A number in text becomes another, or no number."""
    start = _place(data, rng)
    found = NUMBER.search(data, start) or NUMBER.search(data)
    if found is None:
        return _pattern(data, rng)
    return data[: found.start()] + TOKENS[int(rng.integers(len(TOKENS)))] + data[found.end() :]


def _lines(data: bytes, rng: np.random.Generator) -> bytes:
    """Two lines change places, or one goes."""
    lines = data.split(b"\n")
    a, b = (int(i) for i in rng.integers(len(lines), size=2))
    lines[a], lines[b] = lines[b], lines[a]
    return b"\n".join(lines if rng.random() < 0.5 else lines[:a] + lines[a + 1 :])


CHANGES = (_flip, _truncate, _insert, _delete, _duplicate, _pattern, _number, _number, _lines)


def copy_fixture(source: Path, target: Path) -> None:
    """The files of a fixture, fresh; its description stays behind."""
    shutil.rmtree(target, ignore_errors=True)
    shutil.copytree(source, target, ignore=shutil.ignore_patterns("fixture.json"))
