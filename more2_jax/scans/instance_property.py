"""Which property of a file's points names the instance: whole numbers, whatever type they are stored in.

CloudCompare, for one, stores every property as a float, NaN where it was not set, and calls `name` `scalar_name`.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Integer

from more2_jax.scans.labeled_cloud import CUT_WITHOUT, ReadOptions, instance_ids

INSTANCE_PROPERTIES = ("instance", "instance_id", "objectId", "object_id", "label")
PREFIX = "scalar_"
EXACT = 2**53  # floats tell whole numbers apart up to here


def instance_of(
    path: Path, properties: Mapping[str, np.ndarray], others: Collection[str], options: ReadOptions, what: str
) -> tuple[str, Integer[np.ndarray, " n"]] | None:
    """Name and values of the property that names the instance; None where there is none, and none is needed.

    `properties`: name → (n,). `others`: names of those that have another meaning, such as colors. `what` a property
    is called in this format. Raises ValueError, in one line, where the one asked for, or any, is missing.
    """
    asked = options.instance_property
    found = {k: v for k, v in properties.items() if k not in others and is_whole(v)}
    short = {k.removeprefix(PREFIX): k for k in found} | {k: k for k in found}
    wanted = INSTANCE_PROPERTIES if asked is None else (asked,)
    for name in wanted:
        if name in short:
            return short[name], instance_ids(path, as_whole(found[short[name]]))
    if asked is None and not options.masks_needed:
        return None
    several = "properties" if what.endswith("property") else f"{what}s"
    told = [k for k, v in found.items() if v.dtype.kind != "f" or k.startswith(PREFIX)]
    has = f"integer {several} are {', '.join(told)}" if told else f"it has no integer {what.split()[-1]}"
    raise ValueError(
        f"{path}: no integer {what} {' or '.join(wanted)} names the instance; {has}"
        f" (choose one with --instance-property, or cut the scan without: {CUT_WITHOUT})"
    )


def is_whole(values: np.ndarray) -> bool:
    """Whether these are integers, or floats that might as well be; not if none is a number."""
    if values.dtype.kind != "f":
        return values.dtype.kind in "iu"
    known = values[~np.isnan(values)]
    return len(known) > 0 and bool((np.abs(known) < EXACT).all() and (known == np.round(known)).all())


def as_whole(values: np.ndarray) -> Integer[np.ndarray, " n"]:
    """Values of `is_whole` as integers; 0, background, where a float is NaN."""
    return np.nan_to_num(values, nan=0.0).astype(np.int64) if values.dtype.kind == "f" else values
