"""The bundled example: three scans of one room, and what is true of them."""

from __future__ import annotations

import json
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True, kw_only=True)
class TrueInstance:
    """One object in one scan; `object` is its name in the room, `model` what it is a copy of."""

    scan: int
    instance: int
    object: str
    model: str
    T_scan_model: Float[np.ndarray, "4 4"]


@dataclass(frozen=True, kw_only=True)
class DemoTruth:
    """Ground truth of the demo scans."""

    instances: tuple[TrueInstance, ...]
    symmetry_order: dict[str, int]  # of a model about its vertical: 1 none, 2, 4, 0 any angle
    names: dict[str, str]  # of a model, for people
    surfaces: dict[str, Float[np.ndarray, "_ 3"]]  # meters, model frame

    def at(self, scan: int, instance: int) -> TrueInstance:
        """The truth of one instance. Raises KeyError if the scan has none of that number."""
        for one in self.instances:
            if (one.scan, one.instance) == (scan, instance):
                return one
        raise KeyError(f"scan {scan} has no instance {instance}")


def _folder() -> Path:
    return Path(str(resources.files("more2_jax"))) / "assets" / "demo"


def demo_scan_paths() -> list[Path]:
    """The bundled scans, in time order."""
    return sorted(_folder().glob("scan_*.ply"))


def demo_ground_truth() -> DemoTruth:
    """What is true of the bundled scans."""
    truth = json.loads((_folder() / "ground_truth.json").read_text())
    instances = [
        TrueInstance(
            scan=scan,
            instance=row["instance"],
            object=row["object"],
            model=row["model"],
            T_scan_model=np.array(row["T_scan_model"]),
        )
        for scan, rows in enumerate(truth["scans"])
        for row in rows
    ]
    with np.load(_folder() / "ground_truth_surfaces.npz") as file:
        surfaces = {name: file[name].astype(np.float64) for name in file.files}
    return DemoTruth(
        instances=tuple(instances),
        symmetry_order={k: v["symmetry_order"] for k, v in truth["models"].items()},
        names={k: v["name"] for k, v in truth["models"].items()},
        surfaces=surfaces,
    )
