"""Makes the bundled demo scans: `python -m train.tools.bundle_demo --catalog CATALOG.sh3f`.

Three visits to one room: two identical armchairs, a sofa that stays, a cabinet that goes, a lounger that
comes, the rest moved and turned. The catalog is SweetHome3D's BlendSwap-CC-0: CC0, and never trained on.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyElement

from train.furniture.closed_solids import canonical
from train.furniture.sweethome3d import Furniture, read_catalog
from train.furniture.symmetry import yaw_symmetry
from train.rooms.ray_scanner import PlacedMesh, SensorConfig, scan_room
from train.rooms.visits import arrange
from train.run.program import run
from train.shards.depth_views import depth_views

# Object of the room → piece of the catalog.
ROOM = {"armchair_a": 86, "armchair_b": 86, "sofa": 132, "desk": 152, "chair": 101, "bookcase": 6}
REMOVED, ADDED, STATIC = "cabinet", "lounger", "sofa"
EXTRA = {REMOVED: 52, ADDED: 37}
SIZE_M = (7.0, 6.0)
POINTS_AN_OBJECT, BACKGROUND_POINTS, FEWEST = 4500, 8000, 1500


def main(catalog: Path, out: Path = Path("more2_jax/assets/demo"), seed: int = 5) -> None:
    """Renders the scans and writes their ground truth.

    Args:
        catalog: BlendSwap-CC-0.sh3f.
        out: folder for the scans, ground_truth.json, ground_truth_surfaces.npz and LICENSES.md.
        seed: of places, poses and noise.
    """
    rng = np.random.default_rng(seed)
    numbers = ROOM | EXTRA
    pieces = {f.id: f for f in read_catalog(catalog, tuple(numbers.values()))}
    out.mkdir(parents=True, exist_ok=True)
    poses: dict[str, np.ndarray] = {}
    truth = []
    for scan in range(3):
        present = [*ROOM, REMOVED if scan == 0 else ADDED]
        standing = {n: pieces[numbers[n]].vertices for n in present}
        poses = arrange(standing, poses, {STATIC}, SIZE_M, rng, moved_m=(0.3, 2.5))
        truth.append(render(out / f"scan_{scan}.ply", present, poses, numbers, pieces, rng))
    models = {
        f"piece_{k}": {"name": f.name, "symmetry_order": yaw_symmetry(f.vertices, f.faces)}
        for k, f in pieces.items()
    }
    (out / "ground_truth.json").write_text(json.dumps({"models": models, "scans": truth}, indent=1))
    np.savez_compressed(out / "ground_truth_surfaces.npz", **surfaces(pieces, rng))  # pyright: ignore[reportArgumentType]
    (out / "LICENSES.md").write_text(licenses(pieces))


def render(
    path: Path,
    present: list[str],
    poses: dict[str, np.ndarray],
    numbers: dict[str, int],
    pieces: dict[int, Furniture],
    rng: np.random.Generator,
) -> list[dict[str, object]]:
    """Scans the room, writes the PLY, returns the ground truth of every instance."""
    placed = [
        PlacedMesh(
            model=f"piece_{numbers[n]}",
            vertices=pieces[numbers[n]].vertices,
            faces=pieces[numbers[n]].faces,
            T_room_model=poses[n],
        )
        for n in present
    ]
    points, objects = scan_room(placed, SIZE_M, SensorConfig(), rng)
    ids = rng.permutation(len(present)) + 1  # ids say nothing from scan to scan
    kept, rows = thinned(objects, len(present), rng), []
    for k, name in enumerate(present):
        if (count := int((objects == k).sum())) < FEWEST:
            raise ValueError(f"{name} has {count} points in {path.name}; needed {FEWEST}: try another seed")
        rows.append(
            {
                "instance": int(ids[k]),
                "object": name,
                "model": f"piece_{numbers[name]}",
                "T_scan_model": poses[name].tolist(),
            }
        )
    instance = np.where(objects < 0, 0, ids[np.maximum(objects, 0)])
    write_scan(path, points[kept], instance[kept])
    return rows


def thinned(objects: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Row numbers to keep: so many of every object, and of the room."""
    chosen = []
    for k in range(-1, count):
        rows = np.flatnonzero(objects == k)
        most = BACKGROUND_POINTS if k < 0 else POINTS_AN_OBJECT
        chosen.append(rng.permutation(rows)[:most])
    return rng.permutation(np.concatenate(chosen))


def write_scan(path: Path, points: np.ndarray, instance: np.ndarray) -> None:
    """Binary PLY: float x y z, int instance (0 is the room)."""
    vertex = np.zeros(len(points), [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("instance", "<i4")])
    for axis, name in enumerate("xyz"):
        vertex[name] = points[:, axis]
    vertex["instance"] = instance
    PlyData([PlyElement.describe(vertex, "vertex")], byte_order="<").write(str(path))


def surfaces(pieces: dict[int, Furniture], rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Points of every model's outer surface, meters, model frame: what meshes are compared with."""
    result = {}
    for number, piece in pieces.items():
        low, high = piece.vertices.min(axis=0), piece.vertices.max(axis=0)
        vertices, scale = canonical(piece.vertices)
        seen = depth_views(vertices, piece.faces, rng)[0].reshape(-1, 3)
        result[f"piece_{number}"] = (seen * scale + (low + high) / 2).astype(np.float16)
    return result


def licenses(pieces: dict[int, Furniture]) -> str:
    """Who made what."""
    lines = [f"- {f.name} (catalog number {k}), by {f.creator}" for k, f in sorted(pieces.items())]
    head = (
        "# Furniture of the demo scans\n\nSweetHome3D's BlendSwap-CC-0 catalog, public domain (CC0); models"
        " from blendswap.com, converted by Emmanuel Puybaret. Not used in any training.\n\n"
    )
    return head + "\n".join(lines) + "\n"


if __name__ == "__main__":
    run(main)
