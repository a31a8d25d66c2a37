"""PCD 0.7, the format of the Point Cloud Library: ascii, binary or binary_compressed."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from pathlib import Path

import lzf
import numpy as np

from more2_jax.scans.files.ply_faces import unit_or_zero
from more2_jax.scans.instance_property import instance_of
from more2_jax.scans.labeled_cloud import LabeledCloud, ReadOptions

LONGEST_HEADER = 65_536  # bytes
LONGEST_REFERENCE = 264  # bytes that three bytes of LZF, a reference back, can yield
LARGEST_EXACT = 2**53  # whole numbers that a text's float64 holds exactly
COLORS = ("rgb", "rgba")
NORMALS = ("normal_x", "normal_y", "normal_z")
KINDS = {"F": "f", "I": "i", "U": "u"}
SIZES = {"F": (4, 8), "I": (1, 2, 4, 8), "U": (1, 2, 4, 8)}
IDENTITY = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class Header:
    """What the text at the beginning of the file says."""

    names: tuple[str, ...]
    types: tuple[np.dtype, ...]
    counts: tuple[int, ...]  # values a point, of every field
    points: int
    viewpoint: tuple[float, ...]  # translation, then quaternion with w first
    data: str

    @property
    def widths(self) -> tuple[int, ...]:
        """Bytes a point, of every field."""
        return tuple(t.itemsize * c for t, c in zip(self.types, self.counts, strict=True))


def recognizes(path: Path) -> bool:
    """Whether this is a PCD file, by its suffix."""
    return path.is_file() and path.suffix.lower() == ".pcd"


def read(path: Path, options: ReadOptions) -> LabeledCloud:
    """Coordinates as they are stored: VIEWPOINT is stated, not applied. Points without depth are left out.

    `rows` of the cloud says which were kept: masks beside the file speak of all its rows.
    """
    content = path.read_bytes()
    try:
        header, body = _header(content)
        columns = {"ascii": _ascii, "binary": _binary, "binary_compressed": _compressed}[header.data](
            header, body
        )
    except ValueError as error:
        raise ValueError(f"{path}: not a readable PCD file ({error})") from error
    if missing := [axis for axis in "xyz" if axis not in columns]:
        names = ", ".join(columns) or "nothing"
        raise ValueError(f"{path}: fields are {names}; needed {', '.join(missing)} too")
    points = np.stack([columns[axis].astype(np.float64) for axis in "xyz"], axis=-1)
    valid = np.isfinite(points).all(axis=1)
    name, instance = instance_of(path, columns, (*COLORS, *NORMALS), options, "field") or ("", None)
    labels = columns.get("label") if name != "label" else None
    colors = next((_unpacked(columns[c]) for c in COLORS if c in columns), None)
    return LabeledCloud(
        points=points[valid],
        instance=None if instance is None else instance[valid],
        colors=None if colors is None else colors[valid],
        normals=_normals(columns, np.asarray(valid)),
        point_labels=labels[valid] if labels is not None and labels.dtype.kind in "iu" else None,
        warnings=_warnings(header, int((~valid).sum())),
        rows=np.asarray(valid),
    )


def _normals(columns: dict[str, np.ndarray], valid: np.ndarray) -> np.ndarray | None:
    if not all(n in columns for n in NORMALS):
        return None
    return unit_or_zero(np.stack([columns[n] for n in NORMALS], axis=-1)[valid])


def _warnings(header: Header, dropped: int) -> tuple[str, ...]:
    said = []
    if dropped:
        said.append(f"{dropped} of {header.points} points have no depth (NaN) and are left out")
    if header.viewpoint != IDENTITY:
        values = " ".join(f"{v:g}" for v in header.viewpoint)
        said.append(f"VIEWPOINT {values} is not applied: coordinates are taken as they are stored")
    return tuple(said)


def _unpacked(packed: np.ndarray) -> np.ndarray | None:
    """Red, green and blue of the four bytes 0xAARRGGBB, whether they are called a float or an integer."""
    if packed.dtype.itemsize != 4:
        return None
    bits = packed.view(np.uint32)
    return np.stack([bits >> 16 & 255, bits >> 8 & 255, bits & 255], axis=-1).astype(np.uint8)


# --- the header ---------------------------------------------------------------------------------------------


def _header(content: bytes) -> tuple[Header, memoryview]:
    """The header, and what follows its last line."""
    said: dict[str, list[str]] = {}
    at = 0
    while "DATA" not in said:
        end = content.find(b"\n", at, LONGEST_HEADER)
        if end < 0:
            raise ValueError("no line DATA; needed a header that ends in one")
        words = content[at:end].decode("ascii", "replace").split()
        at = end + 1
        if words and not words[0].startswith("#"):
            said[words[0].upper()] = words[1:]
    return _parsed(said), memoryview(content)[at:]


def _parsed(said: dict[str, list[str]]) -> Header:
    if missing := [k for k in ("FIELDS", "SIZE", "TYPE") if k not in said]:
        raise ValueError(f"header lacks {', '.join(missing)}")
    names = said["FIELDS"]
    sizes = _integers("SIZE", said["SIZE"], 8)
    counts = _integers("COUNT", said.get("COUNT", ["1"] * len(names)), 1_000_000)
    types = said["TYPE"]
    if not names or not len(names) == len(sizes) == len(types) == len(counts):
        raise ValueError(
            f"{len(names)} FIELDS, {len(sizes)} SIZE, {len(types)} TYPE, {len(counts)} COUNT; needed as many"
        )
    for kind, size, count in zip(types, sizes, counts, strict=True):
        if size not in SIZES.get(kind, ()) or count < 1:
            raise ValueError(f"a field of TYPE {kind[:20]!a}, SIZE {size}, COUNT {count}")
    named = [n for n in names if n != "_"]
    if len(set(named)) < len(named):
        raise ValueError("two fields have the same name")
    data = " ".join(said["DATA"]).lower()
    if data not in ("ascii", "binary", "binary_compressed"):
        raise ValueError(f"DATA {data[:40]!a}; needed ascii, binary or binary_compressed")
    return Header(
        names=tuple(n.encode("ascii", "replace").decode()[:80] for n in names),
        types=tuple(np.dtype(f"<{KINDS[k]}{s}") for k, s in zip(types, sizes, strict=True)),
        counts=tuple(counts),
        points=_points(said),
        viewpoint=_viewpoint(said.get("VIEWPOINT")),
        data=data,
    )


def _points(said: dict[str, list[str]]) -> int:
    """POINTS; in files that leave it out, WIDTH times HEIGHT."""
    needed = ("POINTS",) if "POINTS" in said else ("WIDTH", "HEIGHT")
    values = [_integers(k, said.get(k, []), 2**40) for k in needed]
    if any(len(v) != 1 for v in values):
        raise ValueError("number of points is not said; needed POINTS, or WIDTH and HEIGHT")
    return math.prod(v[0] for v in values)


def _integers(what: str, words: list[str], largest: int) -> list[int]:
    for word in words:
        if not (word.isascii() and word.isdigit() and len(word) < 16 and int(word) <= largest):
            raise ValueError(f"{what} {word[:20]!a}; needed a whole number up to {largest}")
    return [int(word) for word in words]


def _viewpoint(words: list[str] | None) -> tuple[float, ...]:
    if words is None:
        return IDENTITY
    try:
        values = tuple(float(word) for word in words)
    except ValueError:
        values = ()
    if len(values) != 7:
        raise ValueError("VIEWPOINT needs seven numbers")
    return values


# --- the points ---------------------------------------------------------------------------------------------


def _binary(header: Header, body: memoryview) -> dict[str, np.ndarray]:
    """Point after point."""
    width = sum(header.widths)
    if len(body) < width * header.points:
        raise ValueError(f"{len(body)} bytes of points; needed {width * header.points}")
    rows = np.frombuffer(body, np.uint8, width * header.points).reshape(header.points, width)
    columns, at = {}, 0
    for name, kind, count, bytes_ in zip(
        header.names, header.types, header.counts, header.widths, strict=True
    ):
        if count == 1 and name != "_":
            columns[name] = np.ascontiguousarray(rows[:, at : at + bytes_]).view(kind)[:, 0]
        at += bytes_
    return columns


def _compressed(header: Header, body: memoryview) -> dict[str, np.ndarray]:
    """Field after field, compressed by LZF as one; two sizes stand before."""
    if len(body) < 8:
        raise ValueError("no sizes before the compressed points")
    packed, size = struct.unpack("<II", body[:8])
    if size != sum(header.widths) * header.points:
        raise ValueError(f"{size} bytes of points; needed {sum(header.widths) * header.points}")
    if packed > len(body) - 8:
        raise ValueError(f"{len(body) - 8} compressed bytes; needed {packed}")
    content = decompressed(bytes(body[8 : 8 + packed]), size)
    columns, at = {}, 0
    for name, kind, count, bytes_ in zip(
        header.names, header.types, header.counts, header.widths, strict=True
    ):
        if count == 1 and name != "_":
            columns[name] = np.frombuffer(content, kind, header.points, at)
        at += bytes_ * header.points
    return columns


def decompressed(packed: bytes, size: int) -> bytes:
    """The `size` bytes that `packed` (LZF) stands for. ValueError if it yields another number or is damaged.

    What it could yield at most is held against `size` before anything is allocated.
    """
    if size > len(packed) * LONGEST_REFERENCE:
        raise ValueError(f"{len(packed)} compressed bytes cannot yield {size}")
    content = lzf.decompress(packed, size) if packed else b""
    if content is None or len(content) != size:
        raise ValueError(
            f"compressed bytes yield {'more' if content is None else len(content)}; needed {size}"
        )
    return content


def _ascii(header: Header, body: memoryview) -> dict[str, np.ndarray]:
    """A line a point."""
    lines = bytes(body).decode("ascii", "replace").split("\n")
    lines = [line for line in lines if line.strip()]
    if len(lines) != header.points:
        raise ValueError(f"{len(lines)} lines of points; needed {header.points}")
    width = sum(header.counts)
    if lines and len(lines[0].split()) != width:
        raise ValueError(f"{len(lines[0].split())} values in the first line of points; needed {width}")
    table = np.loadtxt(lines, np.float64, comments=None, ndmin=2) if lines else np.zeros((0, width))
    columns, at = {}, 0
    for name, kind, count in zip(header.names, header.types, header.counts, strict=True):
        if count == 1 and name != "_":
            columns[name] = _typed(name, table[:, at], kind)
        at += count
    return columns


def _typed(name: str, values: np.ndarray, kind: np.dtype) -> np.ndarray:
    """A text's numbers in the field's type. ValueError where they do not fit."""
    if kind.kind == "f":
        with np.errstate(over="ignore"):  # becomes infinite, and is left out
            return values.astype(kind)
    low, high = np.iinfo(kind).min, min(np.iinfo(kind).max, LARGEST_EXACT)
    if not ((values == np.floor(values)) & (values >= max(low, -LARGEST_EXACT)) & (values <= high)).all():
        raise ValueError(f"field {name} holds numbers that are not of its type")
    return values.astype(kind)
