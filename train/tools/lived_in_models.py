"""The models of rooms that are lived in: validation furniture, and training pieces for what it lacks.

`python -m train.tools.lived_in_models --data data --out data/home.npz` packs what `home606` of the results is made of.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from train.furniture.closed_models import read_models
from train.furniture.collections import write_packed
from train.rooms.things_on_furniture import is_small
from train.run.program import run

FURNITURE = "heldout_ikea"
SMALL = "open_train"  # of which the small pieces alone are taken
PIECES = {  # collections of training pieces, and how many are drawn of each
    SMALL: 14,
    "infinigen_Pillow": 8,
    "infinigen_DeskLamp": 8,
    "infinigen_Trash": 8,
    "infinigen_CellShelf": 2,
    "infinigen_OfficeChair": 4,
    "infinigen_Sofa": 5,
    "infinigen_LargeShelf": 4,
    "infinigen_FloorLamp": 5,
    "infinigen_TVStand": 2,
    "infinigen_SingleCabinet": 4,
}


def main(data: Path, out: Path) -> None:
    """Packs the models in meters, z up; every run the same.

    Args:
        data: folder of the collections, npz files.
        out: the packed file.
    """
    rng, models = np.random.default_rng(0), read_models(data / f"{FURNITURE}.npz")
    for name, count in PIECES.items():
        pieces = read_models(data / f"{name}.npz")
        if name == SMALL:
            pieces = [m for m in pieces if is_small(m.vertices)]
        models += [pieces[k] for k in rng.permutation(len(pieces))[:count]]
    write_packed(out, models)


if __name__ == "__main__":
    run(main)
