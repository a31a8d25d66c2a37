"""LAS and LAZ, the formats of surveying, through laspy: an extra-bytes dimension names the instance."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Integer

from more2_jax.scans.instance_property import INSTANCE_PROPERTIES
from more2_jax.scans.labeled_cloud import LabeledCloud, ReadOptions, instance_ids, one_line

CHUNK = 64_000_000  # bytes of points read at once: a header that lies about their number costs no memory
COMPRESSED = 0x80  # in the point format of LAZ
LAYERS = {
    10: 9,
    11: 1,
    12: 2,
    13: 1,
}  # of LAZ items: point, RGB, RGB with infrared, wave packet; else one a byte
COLORS = ("red", "green", "blue")


def recognizes(path: Path) -> bool:
    """Whether this is a LAS or LAZ file, by its suffix."""
    return path.is_file() and path.suffix.lower() in (".las", ".laz")


def read(path: Path, options: ReadOptions) -> LabeledCloud:
    """Coordinates with the file's scale and offset, in float64; colors of 16 bits become 8."""
    columns, integers = _columns(path, options.instance_property)
    name = _instance_name(path, integers, options)
    colors = [columns[c] for c in COLORS if c in columns]
    labels = columns.get("label") if name != "label" else None
    return LabeledCloud(
        points=np.stack([columns[axis].astype(np.float64) for axis in "xyz"], axis=-1),
        instance=None if name is None else instance_ids(path, columns[name]),
        colors=_eight_bits(np.stack(colors, axis=-1)) if len(colors) == 3 else None,
        point_labels=labels,
    )


def _columns(path: Path, asked: str | None) -> tuple[dict[str, np.ndarray], list[str]]:
    """Coordinates, colors and what may name instances; with the names of all integer dimensions."""
    try:
        import laspy
        import lazrs
    except ImportError as error:
        raise ValueError(f"{path}: needs the extra formats: pip install 'more2-jax[formats]'") from error
    try:
        _check_header(path)
        with laspy.open(path, read_evlrs=False, laz_backend=laspy.LazBackend.Lazrs) as reader:  # pyright: ignore[reportCallIssue, reportArgumentType]
            integers = _integers(reader.header.point_format)
            extra = set(reader.header.point_format.extra_dimension_names)
            has = set(reader.header.point_format.dimension_names)
            wanted = {name for name in INSTANCE_PROPERTIES if name in extra} | ({asked} if asked else set())
            _check_layers(path, reader.header, lazrs)
            rows = max(1, CHUNK // max(1, reader.header.point_format.size))
            names = ["x", "y", "z", *(c for c in COLORS if c in has), *(n for n in integers if n in wanted)]
            chunks = [[np.array(chunk[name]) for name in names] for chunk in reader.chunk_iterator(rows)]
    except (KeyboardInterrupt, SystemExit):
        raise
    except BaseException as error:  # a panic of lazrs, which is written in Rust, is no Exception
        raise ValueError(f"{path}: truncated or damaged LAS ({one_line(error)})") from error
    columns = zip(*chunks, strict=True) if chunks else [[np.zeros(0, np.int64)]] * len(names)
    return {n: np.concatenate(c) for n, c in zip(names, columns, strict=True)}, integers


def _check_header(path: Path) -> None:
    """Refuses counts that cannot fit into the file, before anyone loops over them."""
    with path.open("rb") as file:
        head = file.read(255).ljust(255, b"\0")
    if head[:4] != b"LASF":
        raise ValueError("it does not begin with LASF")
    size = path.stat().st_size
    header_size, points_at, records, form, width, count = struct.unpack_from("<HIIBHI", head, 94)
    more_records, long_count = struct.unpack_from("<IQ", head, 243) if head[25] >= 4 else (0, 0)
    count = max(count, long_count)
    if header_size + 54 * records > points_at or points_at + 60 * more_records > size:
        raise ValueError(f"{records} and {more_records} records do not fit into {size} bytes")
    if not form & COMPRESSED and points_at + count * width > size:
        raise ValueError(f"{count} points of {width} bytes do not fit into {size} bytes")
    if form & COMPRESSED:
        _check_chunks(path, points_at, size)


def _check_chunks(path: Path, points_at: int, size: int) -> None:
    """Refuses a table of LAZ chunks outside the file, or with more chunks than the file has bytes."""
    with path.open("rb") as file:
        file.seek(points_at)
        (table_at,) = struct.unpack("<q", file.read(8).ljust(8, b"\0"))
        if table_at == -1:  # written to a stream: it stands at the very end
            file.seek(max(size - 8, 0))
            (table_at,) = struct.unpack("<q", file.read(8).ljust(8, b"\0"))
        if not points_at < table_at <= size - 8:
            raise ValueError(f"its table of chunks is said to begin at byte {table_at} of {size}")
        file.seek(table_at)
        _, chunks = struct.unpack("<II", file.read(8))
    if chunks > size:
        raise ValueError(f"{chunks} chunks do not fit into {size} bytes")


def _check_layers(path: Path, header: Any, lazrs: Any) -> None:
    """Refuses chunks whose layers (point formats from 6 on) are said to be longer than the chunk itself."""
    if not header.are_points_compressed or header.point_format.id < 6:
        return
    record = bytes(header.vlrs[header.vlrs.index("LasZipVlr")].record_data)
    (count,) = struct.unpack_from("<H", record, 32)
    items = [struct.unpack_from("<HH", record, 34 + 6 * i) for i in range(count)]
    first = sum(size for _, size in items)  # bytes of the chunk's first point, which is stored plain
    layers = sum(LAYERS.get(kind, size) for kind, size in items)
    at = header.offset_to_point_data
    with path.open("rb") as file:
        file.seek(at)
        chunks = lazrs.read_chunk_table(file, lazrs.LazVlr(record))
        if (room := sum(points for points, _ in chunks)) < header.point_count:
            raise ValueError(f"its chunks hold {room} points; the header says {header.point_count}")
        at += 8  # the place of the table itself
        for _, size in chunks:
            file.seek(at + first + 4)
            said = np.frombuffer(file.read(4 * layers).ljust(4 * layers, b"\0"), "<u4")
            if said.sum(dtype=np.uint64) > size:
                raise ValueError(f"a chunk of {size} bytes claims layers of {said.sum(dtype=np.uint64)}")
            at += size


def _integers(point_format: Any) -> list[str]:
    """Whole-number dimensions, one number a point, that are neither coordinates nor colors."""
    plain = [d for d in point_format.dimensions if d.num_elements == 1 and d.kind.name != "FloatingPoint"]
    return [d.name for d in plain if not d.is_scaled and d.name not in ("X", "Y", "Z", *COLORS)]


def _instance_name(path: Path, integers: list[str], options: ReadOptions) -> str | None:
    if (asked := options.instance_property) is not None:
        if asked not in integers:
            raise ValueError(
                f"{path}: no integer dimension {asked}; integer dimensions are {', '.join(integers)}"
            )
        return asked
    return next((name for name in INSTANCE_PROPERTIES if name in integers), None)


def _eight_bits(colors: Integer[np.ndarray, "n 3"]) -> Integer[np.ndarray, "n 3"]:
    """LAS holds 16 bits a channel; writers that put 8 bits there never exceed 255."""
    return (colors >> 8 if colors.max(initial=0) > 255 else colors).astype(np.uint8)
