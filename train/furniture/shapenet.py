"""ShapeNet's layout: `<root>/<synset>/<model>/models/model_normalized.obj` and its table of splits."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import cast

from train.furniture.mesh_files import Report, attempt, read_mesh_file
from train.furniture.source_mesh import SourceMesh, Split

# The seven classes that the method is trained on (paper §3.1).
SYNSETS = {
    "02747177": "trash can",
    "02818832": "bed",
    "02828884": "bench",
    "03001627": "chair",
    "03938244": "pillow",
    "04256520": "sofa",
    "04379243": "table",
}
MODEL_FILES = ("models/model_normalized.obj", "model.obj", "models/model_normalized.glb")
LICENSE = "ShapeNet terms of use (research only)"


def is_shapenet(folder: Path) -> bool:
    """Whether a folder has sub-folders named like the classes."""
    return any((folder / synset).is_dir() for synset in SYNSETS)


def read_shapenet(folder: Path, report: Report | None = None) -> Iterator[SourceMesh]:
    """The models of the seven classes, y up as they come, with the split of a table in the folder.

    The table is any .csv with columns synsetId, modelId and split; models it does not name are split by name.
    A model without a file, or with a broken one, goes to `report`; without one it raises ValueError.
    """
    splits = read_splits(folder)
    for synset, category in SYNSETS.items():
        for model in sorted(p for p in (folder / synset).glob("*") if p.is_dir()):
            name = f"{synset}/{model.name}"
            split: Split | None = splits.get((synset, model.name))
            yield from attempt(partial(_read_model, model, name, category, split), name, report)


def _read_model(model: Path, name: str, category: str, split: Split | None) -> SourceMesh:
    for file in MODEL_FILES:
        if (model / file).is_file():
            return read_mesh_file(model / file, name, category, "shapenet", LICENSE, split)
    raise ValueError(f"{model}: no {MODEL_FILES[0]}; needed one")


def read_splits(folder: Path) -> dict[tuple[str, str], Split]:
    """(synset, model) → split, of every table in the folder. ValueError for a split that is none."""
    splits: dict[tuple[str, str], Split] = {}
    for table in sorted(folder.glob("*.csv")):
        with table.open(newline="", encoding="utf-8") as file:
            for row in csv.DictReader(file):
                if {"synsetId", "modelId", "split"} <= row.keys():
                    if row["split"] not in ("train", "val", "test"):
                        raise ValueError(f"{table}: split {row['split']!r}; needed train, val or test")
                    # Spreadsheets drop the zero that synsets begin with.
                    splits[row["synsetId"].zfill(8), row["modelId"]] = cast("Split", row["split"])
    return splits
