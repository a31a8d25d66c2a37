"""How right the fields are of masks in rooms, without meshing: `python -m eval.room_fields --data rooms/real_mix606`.

Every mask that is mostly one object's is encoded as it is, foreign points included, and its field is asked at points
of known distance from the object's true surface, in its true pose.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float
from rich.console import Console
from rich.progress import track
from rich.table import Table
from scipy.spatial import KDTree

from eval.data.flyingshape import open_flyingshape
from eval.data.truth import KnownObject, KnownScene
from eval.scores.figures import mean_ci95
from more2_jax.geometry.padding import MAX_POINTS, pad_clouds
from more2_jax.geometry.poses import Points, apply_pose
from more2_jax.network.prior import Prior, encode_one, load_prior, sdf_one
from more2_jax.types import Instance
from train.furniture.closed_solids import canonical, canonical_frame
from train.run.program import run
from train.shards.signed_distance import signed_distances

QUERIES = 4096  # of each kind
FEWEST_POINTS = 100
SEEN = 0.05  # a query so near an observed point lies where the mask tells, canonical units


@dataclass(frozen=True)
class FieldScores:
    """Of one mask; distances in true canonical units (longest edge of the object 0.9)."""

    sign: float  # share of the queries near the surface that the field puts on the right side
    sign_seen: float  # of those near observed points
    sign_unseen: float
    iou: float  # of the insides, over uniform queries
    volume: float  # filled, in true volumes
    error: float  # of distances near the surface
    error_seen: float
    error_unseen: float


def main(
    data: Path, prior: tuple[str, ...] = ("small",), scenes: int | None = None, out: Path | None = None
) -> None:
    """Prints means over all masks.

    Args:
        data: rooms of `train.synthesize`.
        prior: names of shipped weights, or files.
        scenes: the first so many rooms.
        out: a JSON file for the scores of every mask.
    """
    benchmark = open_flyingshape(data)
    known = [benchmark.read(name) for name in benchmark.names[:scenes]]
    masks = [m for scene in known for m in masks_of(scene)]
    if not masks:
        raise ValueError(f"{data}: no mask of {FEWEST_POINTS} points; needed some")
    found = {name: scores_of(load_prior(name), masks) for name in prior}
    Console().print(table(found))
    if out is not None:
        rows = {name: [asdict(s) for s in scores] for name, scores in found.items()}
        out.write_text(json.dumps(rows, indent=1) + "\n")


@dataclass(frozen=True)
class KnownMask:
    """A mask and queries in its object's canonical frame, with true distances."""

    points: Points
    normals: Points  # zeros where not known
    near: Float[np.ndarray, "q 4"]  # x y z and signed distance, negative inside
    uniform: Float[np.ndarray, "q 4"]


def masks_of(scene: KnownScene) -> Iterator[KnownMask]:
    """The masks of a scene that are mostly one object's."""
    for o in scene.objects:
        assert o.mesh is not None
        vertices, _ = canonical(o.mesh.vertices)
        faces = np.asarray(o.mesh.faces)
        uniform, near = signed_distances(vertices, faces, np.random.default_rng(0), QUERIES)
        for k in o.T_scan_model:
            for id_ in o.masks(k):
                mask = next((i for i in scene.scans[k].instances if i.id == id_), None)
                if mask is not None and len(mask.points) >= FEWEST_POINTS:
                    yield KnownMask(
                        *in_canonical_frame(o, k, mask), near.astype(float), uniform.astype(float)
                    )


def in_canonical_frame(o: KnownObject, scan: int, mask: Instance) -> tuple[Points, Points]:
    """A mask's points and normals in the canonical frame of the object that it shows."""
    assert o.mesh is not None
    center, scale = canonical_frame(o.mesh.vertices)
    T = o.T_scan_model[scan]
    points = (apply_pose(np.linalg.inv(T), mask.points) - center) / scale
    normals = np.zeros_like(points) if mask.normals is None else mask.normals @ T[:3, :3]
    return points, normals


@jax.jit
def _distances(prior: Prior, points: Array, mask: Array, normals: Array, queries: Array) -> Array:
    """Of one cloud's field, in the cloud's unit."""
    code = encode_one(prior, points, mask, normals)
    return code.scale * sdf_one(prior, code, queries)


def scores_of(prior: Prior, masks: list[KnownMask]) -> list[FieldScores]:
    """A row a mask."""
    return [scored(prior, m) for m in track(masks, description=prior.name)]


def scored(prior: Prior, m: KnownMask) -> FieldScores:
    """The field of one mask at its queries."""
    cloud = pad_clouds([m.points], MAX_POINTS, [m.normals])
    assert cloud.normals is not None and cloud.origin is not None
    queries = np.concatenate([m.near, m.uniform])
    asked = jnp.asarray(queries[:, :3] - cloud.origin[0], jnp.float32)
    distance = np.asarray(_distances(prior, cloud.points[0], cloud.mask[0], cloud.normals[0], asked))
    right = (distance < 0) == (queries[:, 3] < 0)
    error = np.abs(distance - queries[:, 3])
    near = slice(len(m.near))
    seen = KDTree(m.points).query(m.near[:, :3])[0] < SEEN
    inside, true = distance[len(m.near) :] < 0, m.uniform[:, 3] < 0
    return FieldScores(
        sign=float(right[near].mean()),
        sign_seen=mean(right[near][seen]),
        sign_unseen=mean(right[near][~seen]),
        iou=float((inside & true).sum() / max(1, (inside | true).sum())),
        volume=float(inside.sum() / max(1, true.sum())),
        error=float(error[near].mean()),
        error_seen=mean(error[near][seen]),
        error_unseen=mean(error[near][~seen]),
    )


def mean(values: np.ndarray) -> float:
    """NaN of none."""
    return float(values.mean()) if len(values) else float("nan")


def table(found: dict[str, list[FieldScores]]) -> Table:
    """Means with 95 % intervals, a column a prior."""
    table = Table("", *found)
    for name in asdict(next(iter(found.values()))[0]):
        cells = []
        for scores in found.values():
            values = np.array([getattr(s, name) for s in scores])
            values = values[np.isfinite(values)]
            low, high = mean_ci95(values)
            cells.append(f"{values.mean():.4f} ({low:.4f} to {high:.4f})")
        table.add_row(name.replace("_", ", "), *cells)
    return table


if __name__ == "__main__":
    run(main)
