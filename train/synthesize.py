"""Meshes to scenes of the open FlyingShape benchmark (paper §4).

`python -m train.synthesize --source MESHES --regime paper --scenes 100 --seed 0 --out data/flying_paper`
`python -m train.synthesize --source MESHES --regime real --masks mix --scans 2 --out data/real`

Scene number i depends on the meshes, the seed and i alone. Finished scenes are kept: a stopped run resumes.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro
from rich.progress import track

from more2_jax.workers.shares import shard_of
from train.furniture.closed_models import atomically, cache_name, make_cached, read_cached, read_models
from train.furniture.collections import SourceMesh
from train.furniture.parallel_map import Workers
from train.rooms.fused_scan import ScanSettings
from train.rooms.mask_flaws import MASKS, Masks
from train.rooms.real_files import write_real_scene
from train.rooms.real_visits import RealConfig, RealScene, real_scene
from train.rooms.regimes import REGIMES, Regime, check_scans, furniture, lived_in, scene_config
from train.rooms.scene_files import write_scene
from train.rooms.visits import FlyingScene, flying_scene
from train.run.program import run

ATTEMPTS = 4  # at furnishing a scene, before the room is called impossible
ROOM_M = (7.0, 6.0)


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What to make, and from what."""

    source: Path
    """Folder of meshes, packed .npz, or whatever else train.prepare reads."""
    regime: str
    """paper, sparse, identical, changes or real."""
    out: Path
    """Folder of the scenes."""
    scenes: int = 100
    """How many."""
    seed: int = 0
    """Of everything."""
    free: bool = False
    """Any orientation, not only upright."""
    scans: int = 5
    """Visits a scene."""
    up: Literal["y", "z"] = "z"
    """The source's vertical axis (heldout_ikea.npz is known)."""
    longest_m: float | None = None
    """Scales every mesh to this longest edge; without it the source is in meters."""
    license: str | None = None
    """Of meshes that come without one."""
    attribution: str | None = None
    """Who is to be named, for LICENSES.md."""
    masks: str | None = None
    """Of regime real: perfect (as without), cut, dirty, split, merged, missed or mix."""
    lived_in: bool = False
    """Of regime real: 14 to 24 objects a room, sets that are alike, small things on furniture."""
    reshaped: float = 0.0
    """Of regime real: share of the objects that have another shape at every visit after the first."""
    noise: float = 1.0
    """Of regime real: how many times the usual the device's noise and drift are."""
    room_m: tuple[float, float] | None = None
    """Floor, x by y; 7 by 6 without, in regime real as the furniture needs."""
    cache: Path | None = None
    """Folder of closed models, to share between benchmarks; inside `out` otherwise."""
    workers: int = 0
    """Processes; 0 for one a core."""
    ray: str | None = None
    """Address of a Ray cluster to spread the work over instead ("local" starts one here)."""
    shard: str = "1/1"
    """i/n: this process makes the i-th of n shares of the scenes, from 1. Who finds all scenes there at its end
    writes index.json and LICENSES.md; so does the same command without --shard."""


def main(settings: Annotated[Settings, tyro.conf.arg(name="")]) -> None:
    """Writes scenes with ground truth, index.json, LICENSES.md and report.json (models left out, and why)."""
    s, shard = settings, shard_of(settings.shard)
    unreadable: dict[str, str] = {}
    job = job_of(s, unreadable)
    claim(job)
    with Workers(s.workers, s.ray, shared=job) as pool:
        rejected = check_models(job, pool)
        _write(s.out / "report.json", {"rejected": rejected, "unreadable": unreadable})
        make_scenes(shard.of(range(s.scenes)), pool)
    if missing := [n for n in range(s.scenes) if not (s.out / _name(n) / "scene.json").exists()]:
        print(f"shard {shard}: its scenes are in {s.out}; {len(missing)} of other shards are not there yet")
        return
    digests = {_name(n): _digest(s.out / _name(n)) for n in range(s.scenes)}
    _write(s.out / "index.json", {**job.facts, "scenes": digests})
    write_licenses(s.out, s.attribution)
    usable = len(job.meshes) - len(rejected)
    print(f"{s.scenes} scenes of {s.scans} scans from {usable} models, {len(rejected)} rejected, in {s.out}")


def job_of(s: Settings, unreadable: dict[str, str]) -> Job:
    """What the settings ask for; names of models that cannot be read go into `unreadable`, with the reason.

    Raises ValueError if they do not fit together, or there are no models.
    """
    regime, masks, crowded = _regime(s.regime), _masks(s.regime, s.masks), _lived_in(s)
    check_scans(regime, s.scans)
    if s.scenes < 1 or s.seed < 0 or min(s.room_m or ROOM_M) <= 0:
        raise ValueError(
            f"{s.scenes} scenes, seed {s.seed}, room {s.room_m}; needed positive numbers, seed from 0"
        )
    meshes = read_models(s.source, up=s.up, longest_m=s.longest_m, license=s.license, unreadable=unreadable)
    return Job(
        meshes=tuple(meshes),
        cache=s.cache or s.out / "models",
        out=s.out,
        regime=regime,
        free=s.free,
        scans=s.scans,
        seed=s.seed,
        room_m=s.room_m if regime == "real" or s.room_m else ROOM_M,
        masks=masks,
        lived_in=crowded,
        reshaped=_reshaped(s),
        noise=_noise(s),
    )


def _regime(name: str) -> Regime:
    """Raises ValueError if there is no such regime."""
    for regime in REGIMES:
        if regime == name:
            return regime
    raise ValueError(f"regime {name!r}; needed one of {', '.join(REGIMES)}")


def _masks(regime: str, name: str | None) -> Masks:
    """Raises ValueError if there are no such masks, or the regime has true ones only."""
    for masks in MASKS:
        if regime == "real" and masks == (name or "perfect"):
            return masks
    if name is not None:
        raise ValueError(
            f"masks {name!r} in regime {regime}; needed one of {', '.join(MASKS)}, in regime real"
        )
    return "perfect"


def _lived_in(s: Settings) -> bool:
    """Raises ValueError if such rooms are not to be had."""
    if s.lived_in and (s.regime != "real" or s.free):
        raise ValueError(f"lived in, regime {s.regime}, free {s.free}; needed regime real, upright")
    return s.lived_in


def _reshaped(s: Settings) -> float:
    """Raises ValueError if that is no share, or the regime has no such objects."""
    if not 0 <= s.reshaped <= 1 or (s.reshaped and s.regime != "real"):
        raise ValueError(
            f"reshaped {s.reshaped}, regime {s.regime}; needed a share from 0 to 1, in regime real"
        )
    return s.reshaped


def _noise(s: Settings) -> float:
    """Raises ValueError if it is no factor, or the regime has no such device."""
    if not 0 <= s.noise < np.inf or (s.noise != 1 and s.regime != "real"):
        raise ValueError(f"noise {s.noise}, regime {s.regime}; needed a factor from 0, in regime real")
    return s.noise


@dataclass(frozen=True, kw_only=True, eq=False)  # itself alone is equal: what is read for it is kept
class Job:
    """Everything that scenes depend on, but their number."""

    meshes: tuple[SourceMesh, ...]
    cache: Path
    out: Path
    regime: Regime
    free: bool
    scans: int
    seed: int
    room_m: tuple[float, float] | None
    masks: Masks = "perfect"
    lived_in: bool = False
    reshaped: float = 0.0
    noise: float = 1.0

    @cached_property
    def facts(self) -> dict[str, Any]:
        """Settings for scene.json and index.json; `models` is a digest of the meshes."""
        models = hashlib.sha1("\n".join(f"{m.name} {cache_name(m)}" for m in self.meshes).encode())
        return {
            "version": 1,
            "regime": self.regime,
            "free": self.free,
            "seed": self.seed,
            "scans_a_scene": self.scans,
            "room_m": self.room_m and list(self.room_m),
            "models": models.hexdigest(),
            **({"masks": self.masks} if self.regime == "real" else {}),
            **({"lived_in": True} if self.lived_in else {}),
            **({"reshaped": self.reshaped} if self.reshaped else {}),
            **({"noise": self.noise} if self.noise != 1 else {}),
        }


def claim(job: Job) -> None:
    """Makes the folder. Raises ValueError if it holds scenes of other settings."""
    settings = job.out / "settings.json"
    job.cache.mkdir(parents=True, exist_ok=True)
    job.out.mkdir(parents=True, exist_ok=True)
    if settings.exists() and json.loads(settings.read_text()) != job.facts:
        raise ValueError(f"{job.out}: scenes of other models or settings; needed the same, or another folder")
    _write(settings, job.facts)


def check_models(job: Job, pool: Workers) -> dict[str, str]:
    """Closes every model once; the names of those that cannot be used, with the reason."""
    reasons = pool.map(partial(make_cached, cache=job.cache), job.meshes)
    shown = track(reasons, "models", total=len(job.meshes), disable=not sys.stdout.isatty())
    return {m.name: reason for m, reason in zip(job.meshes, shown, strict=True) if reason is not None}


def make_scenes(numbers: Sequence[int], pool: Workers) -> None:
    """Writes the scenes that are not there yet."""
    made = pool.map_shared(make_scene, numbers)
    for _ in track(made, "scenes", total=len(numbers), disable=not sys.stdout.isatty()):
        pass


def _name(number: int) -> str:
    return f"scene_{number:04d}"


def _digest(folder: Path) -> str:
    return json.loads((folder / "scene.json").read_text())["digest"]


def make_scene(job: Job, number: int) -> str:
    """Makes and writes one scene; returns its digest. A finished one is left alone."""
    name = _name(number)
    if (job.out / name / "scene.json").exists():
        return _digest(job.out / name)
    models, symmetry = usable_models(job)
    rng = np.random.default_rng((job.seed, number))
    facts = {**job.facts, "number": number}
    scene = _attempted(partial(_furnished, job, models, rng, name))
    # A rescaled copy has the symmetry of what it is a copy of only up to half a turn: it is left unmeasured.
    objects = tuple(dataclasses.replace(o, symmetry_order=symmetry.get(o.model)) for o in scene.objects)
    if isinstance(scene, RealScene):
        return write_real_scene(job.out / name, dataclasses.replace(scene, objects=objects), facts)
    scene = dataclasses.replace(scene, objects=objects, regime=job.regime)
    return write_scene(job.out / name, scene, facts, rng)


def _attempted(furnished: Callable[[], FlyingScene | RealScene]) -> FlyingScene | RealScene:
    """A scene; other furniture where the first does not fit. ValueError if none fits."""
    last = ValueError("no furniture fits")
    for _ in range(ATTEMPTS):
        try:
            return furnished()
        except ValueError as error:
            last = error
    raise last


def _furnished(
    job: Job, models: list[SourceMesh], rng: np.random.Generator, name: str
) -> FlyingScene | RealScene:
    """A scene of the job's regime. ValueError if the furniture that is drawn does not fit."""
    if job.regime == "real":
        chosen = lived_in(models, rng) if job.lived_in else furniture(job.regime, models, rng)
        config = RealConfig(
            scans=job.scans,
            free=job.free,
            room_m=job.room_m,
            things_on_furniture=job.lived_in,
            reshaped=job.reshaped,
            scanned=ScanSettings(masks=job.masks).with_noise(job.noise),
        )
        return real_scene(chosen, config, rng, name)
    config = scene_config(job.regime, job.scans, rng, free=job.free)
    chosen = furniture(job.regime, models, rng)
    return flying_scene(chosen, dataclasses.replace(config, room_m=job.room_m or ROOM_M), rng, name)


@lru_cache(maxsize=1)
def usable_models(job: Job) -> tuple[list[SourceMesh], dict[str, int]]:
    """The closed models, read once a process, and their symmetry."""
    return read_cached(job.meshes, job.cache)


def write_licenses(out: Path, attribution: str | None) -> None:
    """LICENSES.md: the models that the scenes show, by source and license."""
    used: dict[tuple[str, str], set[str]] = {}
    for path in sorted(out.glob("scene_*/scene.json")):
        for o in json.loads(path.read_text())["objects"]:
            used.setdefault((o["source"], o.get("license", o.get("licence"))), set()).add(
                o["model"].split("~")[0]
            )
    lines = ["# Models in these scenes", ""]
    lines += [f"Attribution: {attribution}", ""] if attribution else []
    for (source, license), models in sorted(used.items()):
        lines += [
            f"## {source}",
            "",
            f"License: {license}. Closed, and scaled to meters where it came without",
        ]
        lines += ["a unit; in regime `identical` also slightly rescaled.", ""]
        lines += [f"- {m}" for m in sorted(models)] + [""]
    atomically(out / "LICENSES.md", "\n".join(lines).encode())


def _write(path: Path, content: Sequence[Any] | dict[str, Any]) -> None:
    """Whole or not at all; several shards may at a time."""
    atomically(path, json.dumps(content, indent=1).encode())


if __name__ == "__main__":
    run(main)
