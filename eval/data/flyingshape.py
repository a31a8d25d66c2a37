"""FlyingShape, as `train.synthesize` writes it (open models) and in the published layout (npz files)."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np

from eval.data.masks import LOST
from eval.data.truth import Benchmark, KnownObject, KnownScene
from more2_jax.geometry.poses import Points, Pose
from more2_jax.scans.files.json_file import read_json
from more2_jax.scans.files.npz import read_arrays
from more2_jax.scans.files.ply_cloud import read_ply
from more2_jax.types import Instance, Mesh, Scan
from train.furniture.symmetry import SymmetryGroup, measure
from train.rooms.scene_files import read_scene
from train.rooms.visits import TrueObject

RIGHT_DEG = 5.0
LONGEST = 0.9  # of a model in canonical units
ARRAYS = ("pc", "transform", "class_id", "obj_id")  # of the published files


def flyingshape(folder: Path) -> Benchmark:
    """The benchmark in a folder, whichever layout it has. Raises ValueError if it has neither."""
    if list(folder.glob("scene_*/scene.json")):
        return open_flyingshape(folder)
    if published := published_scenes(folder):
        return Benchmark(
            names=tuple(sorted(published)),
            read=lambda name: read_published(name, published[name]),
            facts={"dataset": "FlyingShape, published files", "regime": "paper"},
            upright=False,
            right_deg=RIGHT_DEG,
            files=lambda name: published[name],
        )
    raise ValueError(
        f"{folder}: neither scene_*/scene.json (train.synthesize) nor scenes of npz files (published); needed one"
    )


def open_flyingshape(folder: Path) -> Benchmark:
    """Scenes of train.synthesize."""
    files = {p.parent.name: p.parent for p in sorted(folder.glob("scene_*/scene.json"))}
    files = {name: path for name, path in files.items() if path.suffix != ".partial"}
    first = read_json(next(iter(files.values())) / "scene.json")
    facts = {k: first.get(k) for k in ("regime", "free", "seed", "models")}
    facts |= {"masks": first["masks"]} if "masks" in first else {}
    return Benchmark(
        names=tuple(files),
        read=lambda name: read_open(files[name]),
        facts={"dataset": "open FlyingShape", **facts},
        upright=not first.get("free", True),
        right_deg=RIGHT_DEG,
        files=lambda name: [files[name]],
    )


def read_open(folder: Path) -> KnownScene:
    """One scene with the truth."""
    scene = read_scene(folder)
    objects = tuple(known(o, scene.T_scan_room) for o in scene.objects if o.instance)
    return KnownScene(
        name=folder.name,
        scans=scene.scans,
        objects=objects,
        facts={"regime": scene.regime},
        true_points=tuple(vertices_of(k, scan, objects) for k, scan in enumerate(scene.scans))
        if scene.regime == "real"
        else (),
        looked_at=scene.looked_at,
        looked_at_next=scene.looked_at_next,
        T_scan_room=scene.T_scan_room if scene.room_m else (),
        room_m=scene.room_m or (0.0, 0.0),
    )


def vertices_of(k: int, scan: Scan, objects: Sequence[KnownObject]) -> dict[str, Points]:
    """The vertices of each object that scan `k` shows, by its name, as the file beside the scan has them.

    Raises ValueError, in one line, where that file is missing or does not fit the scan.
    """
    file = Path(scan.source)
    points = read_ply(file).points
    arrays, has = read_arrays(file.with_suffix(".truth.npz"), ("owner", "object"))
    if len(arrays) < 2 or len(arrays["owner"]) != len(points):
        raise ValueError(
            f"{file}: {len(points)} vertices, truth {has}; needed owner (one a vertex) and object"
        )
    row = {name: n for n, name in enumerate(arrays["object"].tolist())}
    return {o.name: points[arrays["owner"] == row[o.name]] for o in objects if k in o.instance}


def known(o: TrueObject, T_scan_room: Sequence[Pose] = ()) -> KnownObject:
    """A benchmark's object with its measured symmetry; `T_scan_room` where scans have frames of their own.

    Where its only mask is mostly another object's, the object is `LOST`: it is there, and stays in all denominators,
    though no instance is it.
    """
    poses = {k: np.linalg.inv(T_scan_room[k]) @ T if T_scan_room else T for k, T in o.T_scan_model.items()}
    reference = poses[min(o.instance)]
    return KnownObject(
        name=o.name,
        category=o.category,
        copies=o.model,
        instance={k: LOST if k in o.merged else i for k, i in o.instance.items()},
        T_scan_model=o.T_scan_model,
        symmetry=symmetry_of(o.vertices.astype(np.float64).tobytes(), o.faces.astype(np.int64).tobytes()),
        mesh=Mesh(vertices=o.vertices, faces=o.faces),
        moved={k: bool(np.abs(T - reference).max() > 1e-6) for k, T in poses.items()},
        canonical=LONGEST / float(np.ptp(o.vertices, axis=0).max()),
        shared={k: o.instance[k] for k in o.merged},
        parts={k: ids for k, ids in o.parts.items() if k not in o.merged and ids},
        reshaped=o.reshaped,
    )


@lru_cache(maxsize=512)
def symmetry_of(vertices: bytes, faces: bytes) -> SymmetryGroup:
    """Measured once a mesh, which many scenes show."""
    return measure(np.frombuffer(vertices).reshape(-1, 3), np.frombuffer(faces, np.int64).reshape(-1, 3))


# --- the published layout (FORMATS: pc (n, N, 3), transform (n, 3 or 4, 4), class_id (n,), obj_id (n,)) ---------


def published_scenes(folder: Path) -> dict[str, list[Path]]:
    """Folders that hold npz files, each a scene whose files, sorted, are its scans."""
    scenes: dict[str, list[Path]] = {}
    for file in sorted(folder.rglob("*.npz")):
        scenes.setdefault(str(file.parent.relative_to(folder)).replace("/", "-"), []).append(file)
    return scenes


def read_published(name: str, files: list[Path]) -> KnownScene:
    """One scene: objects keep their row in every file; poses are rigid, models canonical (longest edge 0.9)."""
    scans, poses, ids, classes = [], [], [], []
    for k, file in enumerate(files):
        arrays, has = read_arrays(file, ARRAYS)
        if missing := [a for a in ARRAYS if a not in arrays]:
            raise ValueError(f"{file}: arrays are {has}; needed {', '.join(missing)} too")
        _check(file, arrays)
        pc, T = arrays["pc"].astype(np.float64), arrays["transform"].astype(np.float64)
        instances = tuple(Instance(id=n + 1, points=pc[n]) for n in range(len(pc)))
        scans.append(Scan(name=f"{name}/{k}", source=str(file), instances=instances))
        poses.append([square(t) for t in T])
        ids.append([str(i) for i in arrays["obj_id"]])
        classes.append([str(c) for c in arrays["class_id"]])
    if any(row != ids[0] for row in ids):
        raise ValueError(f"{files[0].parent}: obj_id differs between scans; needed one order in all")
    return KnownScene(name=name, scans=tuple(scans), objects=_published_objects(poses, ids[0], classes[0]))


def _published_objects(
    poses: list[list[np.ndarray]], ids: list[str], classes: list[str]
) -> tuple[KnownObject, ...]:
    return tuple(
        KnownObject(
            name=f"object_{n}",
            category=classes[n],
            copies=ids[n],
            instance=dict.fromkeys(range(len(poses)), n + 1),
            T_scan_model={k: row[n] for k, row in enumerate(poses)},
            symmetry=SymmetryGroup.trivial(),  # the meshes are not in the files
        )
        for n in range(len(ids))
    )


def _check(file: Path, arrays: dict[str, np.ndarray]) -> None:
    pc, T = arrays["pc"], arrays["transform"]
    if pc.ndim != 3 or pc.shape[2] != 3 or T.shape not in ((len(pc), 3, 4), (len(pc), 4, 4)):
        raise ValueError(
            f"{file}: pc {pc.shape}, transform {T.shape}; needed (n, N, 3) and (n, 3, 4) or (n, 4, 4)"
        )
    if any(len(arrays[k]) != len(pc) for k in ("class_id", "obj_id")):
        raise ValueError(f"{file}: class_id and obj_id do not have the {len(pc)} rows of pc")


def square(T: np.ndarray) -> np.ndarray:
    """A pose of three rows with its fourth."""
    return T if T.shape == (4, 4) else np.concatenate([T, [[0, 0, 0, 1.0]]])


def digest(folder: Path) -> str:
    """Names the data: the hash of index.json, or of the list of files where there is none."""
    index = folder / "index.json"
    content = (
        index.read_bytes()
        if index.is_file()
        else "\n".join(sorted(p.name for p in folder.rglob("*"))).encode()
    )
    return hashlib.sha256(content).hexdigest()[:12]
