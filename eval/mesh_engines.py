"""Meshes of the host beside those of the device: `python -m eval.mesh_engines`. Seconds a mesh, and how far apart.

The same command runs on an accelerator. Objects are those of the bundled scans, or of rooms of `train.synthesize`, seen
by one scan and by all.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import jax
import numpy as np
import trimesh
from rich.console import Console
from rich.table import Table
from scipy.spatial import KDTree

from eval.data.flyingshape import open_flyingshape
from eval.performance.stopwatch import Seconds, interleaved, timed
from more2_jax.config import SceneConfig, preset
from more2_jax.meshing.device.batch import placed_mesh, surfaces
from more2_jax.meshing.engine import as_row, device_meshes
from more2_jax.meshing.object_mesh import object_meshes
from more2_jax.network.prior import Prior, load_prior
from more2_jax.scans.demo import demo_scan_paths
from more2_jax.scans.read_scan import read_scan
from more2_jax.scene import run_scenes
from more2_jax.tracking.accumulated import accumulated_objects
from more2_jax.types import AccumulatedObject, Mesh, Scan
from train.run.devices import cores
from train.run.program import run

SAMPLES, ASKED = 300_000, 30_000  # points of the one surface, and of the other, whose distance is taken


@dataclass(frozen=True)
class Compared:
    """Both engines' meshes of some objects; seconds are of the processor, per mesh."""

    scans: str
    objects: int
    host_s: float
    device_s: float
    device_host_work_s: float  # of the device's: what NumPy does before and after the compiled call
    apart_cm: float  # the two surfaces, mean over both ways and objects
    worst_percent_cm: float  # the 99th percentile of that, mean over objects
    volume_differs: float  # share of the host's volume, mean over objects
    triangles: float  # the device's as a share of the host's
    watertight: int  # of the device's


def main(
    data: Path | None = None,
    scenes: int = 4,
    prior: str = "small",
    repeats: int = 3,
    out: Path | None = None,
) -> None:
    """Prints a row for objects of one scan and one for those of all.

    Args:
        data: rooms of `train.synthesize`; by default the bundled scans.
        scenes: rooms.
        prior: name of shipped weights, or a file.
        repeats: rounds, each engine once a round, after one that does not count.
        out: a JSON file for the rows.
    """
    weights, config = load_prior(prior), preset("robust", upright=True)
    visits = list(rooms(data, scenes))
    rows = [
        compared(weights, name, objects_of(weights, taken, config), config, repeats)
        for name, taken in (("one", [v[:1] for v in visits]), ("all", visits))
    ]
    Console().print(printed(rows))
    said = {"device": jax.default_backend(), "cores": cores(), "repeats": repeats}
    if out is not None:
        out.write_text(json.dumps(said | {"rows": [asdict(r) for r in rows]}, indent=1) + "\n")


def rooms(data: Path | None, count: int) -> Iterator[Sequence[Scan]]:
    """The scans of each room."""
    if data is None:
        yield [read_scan(path) for path in demo_scan_paths()]
        return
    benchmark = open_flyingshape(data)
    for name in benchmark.names[:count]:
        yield benchmark.read(name).scans


def objects_of(
    prior: Prior, visits: Sequence[Sequence[Scan]], config: SceneConfig
) -> list[AccumulatedObject]:
    """All objects of some rooms, as meshing takes them."""
    found = run_scenes(prior, visits, config, meshes=False)
    return [o for s in found for o in accumulated_objects(s.objects, list(range(len(s.objects))), s.scans)]


def compared(
    prior: Prior, scans: str, objects: Sequence[AccumulatedObject], config: SceneConfig, repeats: int
) -> Compared:
    """Both engines' meshes of the same objects."""
    host = list(object_meshes(prior, objects, config))
    device = list(device_meshes(prior, objects, config))
    jobs: dict[str, Callable[[], object]] = {
        "host": lambda: list(object_meshes(prior, objects, config)),
        "device": lambda: list(device_meshes(prior, objects, config)),
        "work": host_work(prior, objects, config),
    }
    taken = interleaved({name: timed(work) for name, work in jobs.items()}, repeats)
    pairs = [(a, b) for a, b in zip(host, device, strict=True) if a is not None and b is not None]
    if len(pairs) < len(objects):
        raise ValueError(f"{len(objects) - len(pairs)} objects have no mesh; needed one of each")
    apart = np.array([distances_cm(a, b) for a, b in pairs])
    volumes = np.array([[solid(m).volume for m in pair] for pair in pairs])
    return Compared(
        scans=scans,
        objects=len(objects),
        **seconds_a_mesh(taken, len(objects)),
        apart_cm=float(apart[:, 0].mean()),
        worst_percent_cm=float(apart[:, 1].mean()),
        volume_differs=float(np.abs(volumes[:, 1] / volumes[:, 0] - 1).mean()),
        triangles=sum(len(b.faces) for _, b in pairs) / sum(len(a.faces) for a, _ in pairs),
        watertight=sum(bool(solid(b).is_watertight) for _, b in pairs),
    )


def host_work(
    prior: Prior, objects: Sequence[AccumulatedObject], config: SceneConfig
) -> Callable[[], object]:
    """What the device's engine does outside of compiled calls, of surfaces that are made once."""
    rows = [as_row(o, config) for o in objects]
    made = [surfaces(prior, [row], config.meshing, 1) for row in rows]
    made = [jax.tree.map(lambda x: np.asarray(x[0]), surface) for surface in made]

    def work() -> object:
        return [
            placed_mesh(surface, o.embedding, float(as_row(o, config).half_width), config.meshing)
            for o, surface in zip(objects, made, strict=True)
        ]

    return work


def seconds_a_mesh(taken: dict[str, Seconds], count: int) -> dict[str, float]:
    """Processor seconds by the names of `Compared`."""
    names = {"host": "host_s", "device": "device_s", "work": "device_host_work_s"}
    return {names[job]: seconds.cpu / count for job, seconds in taken.items()}


def solid(mesh: Mesh) -> trimesh.Trimesh:
    """About its own middle, so that a volume keeps its digits."""
    return trimesh.Trimesh(mesh.vertices - mesh.vertices.mean(axis=0), mesh.faces, process=False)


def distances_cm(a: Mesh, b: Mesh) -> tuple[float, float]:
    """Mean and 99th percentile of how far samples of either lie from the plane of the other's nearest sample."""
    found = []
    for one, other in ((a, b), (b, a)):
        points, face = trimesh.sample.sample_surface(solid(one), SAMPLES, seed=0)[:2]
        asked = trimesh.sample.sample_surface(solid(other), ASKED, seed=1)[0]
        asked = asked + other.vertices.mean(axis=0) - one.vertices.mean(axis=0)
        near = KDTree(points).query(asked)[1]
        off = np.einsum("ni,ni->n", asked - points[near], solid(one).face_normals[face[near]])
        found.append(100 * np.abs(off))
    return float(np.mean(found)), float(np.quantile(found, 0.99))


def printed(rows: Sequence[Compared]) -> Table:
    """The rows as a table."""
    table = Table(
        "scans", "objects", "host [s]", "device [s]", "of it NumPy [s]", "apart [cm]", "worst 1 % [cm]",
        "volume differs", "triangles", "watertight",
    )  # fmt: skip
    for r in rows:
        numbers = (r.host_s, r.device_s, r.device_host_work_s, r.apart_cm, r.worst_percent_cm)
        shares = (f"{100 * r.volume_differs:.2f} %", f"{r.triangles:.3f} ×", f"{r.watertight}/{r.objects}")
        table.add_row(r.scans, str(r.objects), *(f"{x:.3f}" for x in numbers), *shares)
    return table


if __name__ == "__main__":
    run(main)
