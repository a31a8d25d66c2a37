"""A small living scene by hand: every way an object can come and go, a kilometer from the world's zero."""

import numpy as np

from more2_jax.types import (
    Changes,
    Embedding,
    LivingScene,
    Mesh,
    Observation,
    ScanRecord,
    SceneObject,
    Skipped,
)

WORLD_M = np.array([1000.0, -2000.0, 5.0])
STAGES = {"encode": 1.5, "match": 0.25, "register": 3.0, "close": 0.5, "joint": 2.0, "mesh": 0.5}


def turn_z(angle: float, center: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """A turn by `angle` radians about the vertical through `center`, then a shift; 4×4."""
    c, s = np.cos(angle), np.sin(angle)
    T = np.eye(4)
    T[:2, :2] = [[c, -s], [s, c]]
    T[:3, 3] = center + shift - T[:3, :3] @ center
    return T


def cube(center: np.ndarray) -> Mesh:
    """The surface of a cube with an edge of one meter."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) - 0.5
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]
    return Mesh(vertices=corners + center, faces=np.array(faces, np.int32))


def embedding(rng: np.random.Generator, origin: np.ndarray, channels: int = 4) -> Embedding:
    """Random numbers in the shapes an encoder gives for one object."""
    return Embedding(
        inv=rng.normal(size=channels).astype(np.float32),
        eqv=rng.normal(size=(3, channels)).astype(np.float32),
        scale=np.float32(1.1),
        center=rng.normal(size=3).astype(np.float32),
        origin=origin,
    )


def upward(count: int) -> np.ndarray:
    """Normals, of which every third is not known."""
    return np.where(np.arange(count)[:, None] % 3 == 0, 0.0, np.array([0.6, 0.0, 0.8]))


def scene_object(
    number: int, poses: dict[int, np.ndarray], label: str | None = None, *, mesh: bool = True
) -> SceneObject:
    """An object seen in the scans of `poses`, scan → T_ref_scan; 50 points of a unit cube each."""
    rng = np.random.default_rng(number)
    center = WORLD_M + [3.0 * number, 0.0, 0.0]
    scans = sorted(poses)
    seen = [
        Observation(
            scan=s,
            instance=10 + number,
            T_ref_scan=poses[s],
            score=1.0 if s == scans[0] else 0.9,
            rms_m=0.0 if s == scans[0] else 0.01,
            converged=True,
            interchangeable=number == 1 and s != scans[0],
            sigma_m=0.0 if s == scans[0] else 0.001,
            sigma_deg=0.0 if s == scans[0] else 0.1,
        )
        for s in scans
    ]
    return SceneObject(
        id=f"object_{number:03d}",
        label=label,
        reference_scan=scans[0],
        observations=tuple(seen),
        points=center + rng.uniform(-0.5, 0.5, size=(50 * len(scans), 3)),
        point_scan=np.repeat(scans, 50),
        embedding=embedding(rng, center),
        normals=upward(50 * len(scans)) if number % 2 else None,
        mesh=cube(center) if mesh else None,
    )


def living_scene() -> LivingScene:
    """Three scans: 0 stands, 1 moves, 2 is removed, 3 is added, 4 goes and comes back and has no mesh."""
    still, moved = np.eye(4), turn_z(np.deg2rad(90), WORLD_M + [3.0, 0, 0], np.array([0.0, 2.0, 0.0]))
    objects = (
        scene_object(0, {0: still, 1: still, 2: still}, "table"),
        scene_object(1, {0: still, 1: moved, 2: moved}, "<b>chair & co</b>"),
        scene_object(2, {0: still}),
        scene_object(3, {1: still, 2: still}),
        scene_object(4, {0: still, 2: still}, mesh=False),
    )
    ids = [o.id for o in objects]
    return LivingScene(
        preset="robust",
        prior="small",
        upright=True,
        scans=(
            ScanRecord(index=0, name="monday", source="in/monday.ply", instances=(10, 11, 12, 14)),
            ScanRecord(
                index=1,
                name="tuesday",
                source="in/tuesday.ply",
                instances=(10, 11, 13),
                skipped=(Skipped(what="instance 5", reason="9 points; needed 64"),),
            ),
            ScanRecord(index=2, name="friday", source="in/friday.ply", instances=(10, 11, 13, 14)),
        ),
        objects=objects,
        changes=(
            Changes(
                from_scan=0,
                to_scan=1,
                moved=(ids[1],),
                static=(ids[0],),
                added=(ids[3],),
                removed=(ids[2], ids[4]),
                probability={ids[1]: 0.99, ids[2]: 0.8},
            ),
            Changes(from_scan=1, to_scan=2, static=(ids[0], ids[1], ids[3]), added=(ids[4],)),
        ),
        timing_s=dict(STAGES),
    )
