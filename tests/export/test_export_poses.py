"""`T_ref_scan` means the same in every format: each object stands on the points the scan observed."""

import dataclasses

import numpy as np
import pytest
import trimesh
from export_readers import Gltf, json_shown, ply_shown, usd_shown
from factories import living_scene, scene_object
from scipy.spatial.transform import Rotation

from more2_jax.export import export_scene
from more2_jax.types import Mesh, Observation, SceneObject


def rigid(seed: int) -> np.ndarray:
    """A turn about all axes and a shift of meters, 50 m from zero."""
    T = np.eye(4)
    T[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    T[:3, 3] = 50 + np.random.default_rng(seed).uniform(-3, 3, 3)
    return T


def simulated(number: int, scans: tuple[int, ...], *, mesh: bool = True) -> tuple[SceneObject, dict]:
    """A chair-like shape put down anywhere in every scan; the object, and the points each scan observed.

    Nothing here uses T_ref_scan except to store it: the observed points come from where the shape was put.
    """
    parts = [
        trimesh.creation.box((0.6, 0.5, 0.1)),
        trimesh.creation.box((0.1, 0.5, 0.9)).apply_translation([0.25, 0, 0.5]),
    ]
    shape = trimesh.util.concatenate(parts)
    T_scan_shape = {s: rigid(10 * number + s) for s in scans}
    observed = {
        s: trimesh.transform_points(trimesh.sample.sample_surface(shape, 200, seed=s)[0], T)
        for s, T in T_scan_shape.items()
    }
    T_ref_shape = T_scan_shape[scans[0]]
    T_ref_scan = {s: T_ref_shape @ np.linalg.inv(T) for s, T in T_scan_shape.items()}
    points = [trimesh.transform_points(observed[s], T_ref_scan[s]) for s in scans]
    seen = tuple(
        Observation(scan=s, instance=1, T_ref_scan=T_ref_scan[s], score=1.0, rms_m=0.0, converged=True)
        for s in scans
    )
    o = dataclasses.replace(
        scene_object(number, {scans[0]: np.eye(4)}),
        observations=seen,
        points=np.concatenate(points),
        point_scan=np.repeat(scans, 200),
        mesh=Mesh(vertices=trimesh.transform_points(shape.vertices, T_ref_shape), faces=shape.faces),
    )
    return (o if mesh else dataclasses.replace(o, mesh=None)), observed


OBJECTS = [
    simulated(0, (0, 1, 2)),
    simulated(1, (1, 2)),
    simulated(2, (0, 2)),
    simulated(3, (0, 1), mesh=False),
]
ROOM = dataclasses.replace(living_scene(), objects=tuple(o for o, _ in OBJECTS), changes=())
OBSERVED = {o.id: observed for o, observed in OBJECTS}
LARGEST_M = 1e-4  # files hold single precision, a few meters about the nodes


def off_surface(vertices, faces, points) -> float:
    """Largest distance of points from a mesh, meters; from the vertices where there are no faces."""
    if faces is None:
        return np.linalg.norm(points[:, None] - vertices[None], axis=-1).min(axis=1).max()
    return np.abs(trimesh.proximity.signed_distance(trimesh.Trimesh(vertices, faces), points)).max()


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    folder = tmp_path_factory.mktemp("exported")
    paths = {f: export_scene(ROOM, folder, f) for f in ("glb", "usd", "json")}
    return paths | {("ply", s): export_scene(ROOM, folder / f"room{s}.ply", "ply", scan=s) for s in range(3)}


@pytest.mark.parametrize("scan", [0, 1, 2])
@pytest.mark.parametrize("format", ["glb", "usd", "ply", "json"])
def test_every_format_puts_objects_on_the_points_the_scan_observed(exported, format, scan):
    """`T_ref_scan` means the same everywhere: its inverse brings the reference onto the scan; absent is absent."""
    for k, o in enumerate(ROOM.objects):
        shown = {
            "glb": lambda o=o: Gltf(exported["glb"]).shown(o.id, scan),
            "usd": lambda o=o: usd_shown(exported["usd"], o.id, scan),
            "ply": lambda k=k: ply_shown(exported["ply", scan], k),
            "json": lambda o=o: json_shown(exported["json"], o, scan),
        }[format]()
        assert (shown is not None) == (scan in OBSERVED[o.id])
        if shown is not None:
            assert off_surface(*shown, OBSERVED[o.id][scan]) < LARGEST_M
            others = [p for s, p in OBSERVED[o.id].items() if s != scan]
            assert all(off_surface(*shown, p) > 0.1 for p in others)  # another scan's place is another place
