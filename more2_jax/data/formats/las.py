"""LAS and LAZ, the formats of surveying, through laspy: an extra-bytes dimension names the instance."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int

from more2_jax.data.labelled import LabelledCloud, ReadOptions, instance_ids, one_line
from more2_jax.data.ply import INSTANCE_PROPERTIES

CHUNK = 1_000_000  # points read at once: a header that lies about their number costs no memory
COLORS = ("red", "green", "blue")


def recognises(path: Path) -> bool:
    """Whether this is a LAS or LAZ file, by its suffix."""
    return path.is_file() and path.suffix.lower() in (".las", ".laz")


def read(path: Path, options: ReadOptions) -> LabelledCloud:
    """Coordinates with the file's scale and offset, in float64; colours of 16 bits become 8."""
    columns, integers = _columns(path, options.instance_property)
    name = _instance_name(path, integers, options)
    colors = [columns[c] for c in COLORS if c in columns]
    labels = columns.get("label") if name != "label" else None
    return LabelledCloud(
        points=np.stack([columns[axis].astype(np.float64) for axis in "xyz"], axis=-1),
        instance=None if name is None else instance_ids(path, columns[name]),
        colors=_eight_bits(np.stack(colors, axis=-1)) if len(colors) == 3 else None,
        point_labels=labels,
    )


def _columns(path: Path, asked: str | None) -> tuple[dict[str, np.ndarray], list[str]]:
    """Coordinates, colours and what may name instances; with the names of all integer dimensions."""
    try:
        import laspy
        import lazrs  # noqa: F401 (laspy finds it by itself)
    except ImportError as error:
        raise ValueError(f"{path}: needs the extra formats: pip install 'more2-jax[formats]'") from error
    try:
        with laspy.open(path) as reader:
            integers = _integers(reader.header.point_format)
            extra = set(reader.header.point_format.extra_dimension_names)
            has = set(reader.header.point_format.dimension_names)
            wanted = {name for name in INSTANCE_PROPERTIES if name in extra} | ({asked} if asked else set())
            names = ["x", "y", "z", *(c for c in COLORS if c in has), *(n for n in integers if n in wanted)]
            chunks = [[np.array(chunk[name]) for name in names] for chunk in reader.chunk_iterator(CHUNK)]
    except Exception as error:
        raise ValueError(f"{path}: truncated or damaged LAS ({one_line(error)})") from error
    columns = zip(*chunks, strict=True) if chunks else [[np.zeros(0, np.int64)]] * len(names)
    return {n: np.concatenate(c) for n, c in zip(names, columns, strict=True)}, integers


def _integers(point_format: Any) -> list[str]:
    """Whole-number dimensions, one number a point, that are neither coordinates nor colours."""
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


def _eight_bits(colors: Int[np.ndarray, "n 3"]) -> Int[np.ndarray, "n 3"]:
    """LAS holds 16 bits a channel; writers that put 8 bits there never exceed 255."""
    return (colors >> 8 if colors.max(initial=0) > 255 else colors).astype(np.uint8)
