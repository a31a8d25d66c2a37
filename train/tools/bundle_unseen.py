"""Packs furniture that no training uses: `python -m train.tools.bundle_unseen --catalog CATALOG.sh3f`.

The catalog is SweetHome3D's BlendSwap-CC-0 (CC0); the pieces are others than the demo's.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from train.furniture.collections import SourceMesh, write_packed
from train.furniture.sweethome3d import Furniture, read_catalog
from train.run.program import run

# Number in the catalog → category.
PIECES = {
    4: "bedside table",
    39: "shelf",
    65: "deck chair",
    68: "wardrobe",
    75: "desk",
    79: "chair",
    99: "armchair",
    103: "bench",
    112: "sofa",
    114: "chair",
    115: "trash can",
    125: "chair",
    134: "table",
    144: "cabinet",
    168: "stool",
}


def main(catalog: Path, out: Path = Path("tests/data/unseen_furniture.npz")) -> None:
    """Writes the packed meshes (meters, z up, standing on z = 0) and, beside them, who made what.

    Args:
        catalog: BlendSwap-CC-0.sh3f.
        out: the .npz.
    """
    pieces = list(read_catalog(catalog, tuple(PIECES)))
    write_packed(out, [packed(piece) for piece in pieces])
    lines = [f"- {piece.name} (catalog number {piece.id}), by {piece.creator}" for piece in pieces]
    head = (
        f"# Furniture in {out.name}\n\n"
        "SweetHome3D's BlendSwap-CC-0 catalog, public domain (CC0): models from blendswap.com, converted\n"
        "by Emmanuel Puybaret. Used in no training.\n\n"
    )
    out.with_suffix(".LICENSES.md").write_text(head + "\n".join(lines) + "\n", encoding="utf-8")


def packed(piece: Furniture) -> SourceMesh:
    """The piece without the repeated vertices that an OBJ has along its seams."""
    vertices, index = np.unique(np.round(piece.vertices, 5), axis=0, return_inverse=True)
    return SourceMesh(
        name=f"{piece.name.lower().replace(' ', '_')}_{piece.id:03d}",
        category=PIECES[piece.id],
        vertices=vertices,
        faces=index.reshape(-1)[piece.faces],
        source="BlendSwap-CC-0",
    )


if __name__ == "__main__":
    run(main)
