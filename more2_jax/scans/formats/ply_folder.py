"""A folder of one PLY per object."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from more2_jax.scans.files.ply_cloud import read_ply
from more2_jax.scans.labeled_cloud import LabeledCloud, ReadOptions
from more2_jax.types import Skipped


def recognizes(path: Path) -> bool:
    """Whether this is a folder that holds PLY files."""
    return path.is_dir() and any(path.glob("*.ply"))


def read(path: Path, options: ReadOptions) -> LabeledCloud:
    """One PLY, one object; the options have nothing to choose here."""
    files = sorted(path.glob("*.ply"))
    clouds = [read_ply(file) for file in files]
    ids = _folder_ids([file.stem for file in files])
    colors = [cloud.colors for cloud in clouds if cloud.colors is not None]
    normals = [cloud.normals for cloud in clouds if cloud.normals is not None]
    return LabeledCloud(
        points=np.concatenate([cloud.points for cloud in clouds]),
        instance=np.repeat(np.array(ids, np.int64), [len(cloud.points) for cloud in clouds]),
        colors=np.concatenate(colors) if len(colors) == len(clouds) else None,
        normals=np.concatenate(normals) if len(normals) == len(clouds) else None,
        labels={i: file.stem for i, file in zip(ids, files, strict=True)},
        skipped=tuple(
            Skipped(what=file.name, reason="no points")
            for file, cloud in zip(files, clouds, strict=True)
            if not len(cloud.points)
        ),
    )


def _folder_ids(stems: list[str]) -> list[int]:
    """The trailing digits of every name where they are positive and unique, else 1, 2, …"""
    digits = [re.search(r"\d+$", stem) for stem in stems]
    numbers = [int(found[0]) for found in digits if found]
    named = len(set(numbers)) == len(stems) and min(numbers) > 0 and max(numbers) < 2**31
    return numbers if named else list(range(1, len(stems) + 1))
