"""Parametric furniture of kinds that open collections lack: metres, z up, standing on z = 0, watertight.

A piece depends on its category and seed alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from more2_jax.data.meshes import SourceMesh, standing

Rng = np.random.Generator


def procedural_meshes(count: int) -> Iterator[SourceMesh]:
    """`count` pieces, the categories in turn. Raises ValueError if `count` is negative."""
    if count < 0:
        raise ValueError(f"{count} procedural meshes; needed 0 or more")
    categories = list(CATEGORIES)
    for index in range(count):
        yield procedural_mesh(categories[index % len(categories)], index // len(categories))


def procedural_mesh(category: str, seed: int) -> SourceMesh:
    """One piece of furniture. Raises ValueError for a category that is not in `CATEGORIES`."""
    if category not in CATEGORIES:
        raise ValueError(f"category {category!r}; needed one of {', '.join(CATEGORIES)}")
    rng = np.random.default_rng([list(CATEGORIES).index(category), seed])
    solid = trimesh.boolean.union(CATEGORIES[category](rng), engine="manifold")
    return SourceMesh(
        name=f"procedural_{category.replace(' ', '_')}_{seed:04d}",
        category=category,
        vertices=standing(np.asarray(solid.vertices, np.float64)),
        faces=np.asarray(solid.faces, np.int64),
        source="procedural",
    )


# --- parts --------------------------------------------------------------------------------------------------


def box(x: float, y: float, z: float, at: tuple[float, float, float]) -> trimesh.Trimesh:
    """A box of edges x, y, z; `at` is the middle of its underside."""
    part = trimesh.creation.box(extents=(x, y, z))
    part.apply_translation((at[0], at[1], at[2] + z / 2))
    return part


def pole(radius: float, length: float, at: tuple[float, float, float]) -> trimesh.Trimesh:
    """An upright cylinder; `at` is the middle of its underside."""
    part = trimesh.creation.cylinder(radius=radius, height=length, sections=20)
    part.apply_translation((at[0], at[1], at[2] + length / 2))
    return part


def cushion_solid(x: float, y: float, z: float, squareness: float) -> trimesh.Trimesh:
    """A superellipsoid of edges x, y, z: a box for large `squareness`, an ellipsoid for 2; centred."""
    part = trimesh.creation.icosphere(subdivisions=4)
    v = np.asarray(part.vertices)
    plan = (np.abs(v[:, :2]) ** squareness).sum(axis=1) ** (1 / squareness)
    radius = (plan**2 + v[:, 2] ** 2) ** 0.5
    part.vertices = v / radius[:, None] * (x / 2, y / 2, z / 2)
    return part


def legs(rng: Rng, x: float, y: float, height: float, thickness: float) -> list[trimesh.Trimesh]:
    """Four legs under the corners of x × y, round or square, reaching a little into what they carry."""
    inset, tall = thickness * rng.uniform(0.6, 1.5), height + 0.01
    corners = [(a * (x / 2 - inset), b * (y / 2 - inset), 0.0) for a in (-1, 1) for b in (-1, 1)]
    if rng.random() < 0.5:
        return [pole(thickness / 2, tall, c) for c in corners]
    return [box(thickness, thickness, tall, c) for c in corners]


# --- furniture ----------------------------------------------------------------------------------------------


def bench(rng: Rng) -> list[trimesh.Trimesh]:
    """A seat, solid or of slats, on legs or side panels, with a back or without."""
    x, y, height = rng.uniform(0.9, 1.8), rng.uniform(0.3, 0.5), rng.uniform(0.38, 0.5)
    top = rng.uniform(0.03, 0.06)
    under = height - top
    if rng.random() < 0.5:
        parts = [box(x, y, top, (0, 0, under))]
    else:
        count = int(rng.integers(3, 6))
        width = y / count * 0.8
        middles = np.linspace(-y / 2 + width / 2, y / 2 - width / 2, count)
        parts = [box(x, width, top, (0, float(m), under)) for m in middles]
        parts += [box(0.04, y, 0.03, (a * 0.4 * x, 0, under - 0.02)) for a in (-1, 1)]
    if rng.random() < 0.6:
        parts += legs(rng, 0.9 * x, 0.9 * y, under, rng.uniform(0.04, 0.08))
    else:
        parts += [box(0.05, 0.9 * y, under + 0.01, (a * 0.42 * x, 0, 0)) for a in (-1, 1)]
    if rng.random() < 0.5:
        back = rng.uniform(0.3, 0.5)
        parts += [box(0.05, 0.04, back, (a * 0.4 * x, y / 2 - 0.02, height - 0.01)) for a in (-1, 1)]
        parts.append(box(x, 0.04, 0.4 * back, (0, y / 2 - 0.02, height + 0.55 * back)))
    return parts


def bed(rng: Rng) -> list[trimesh.Trimesh]:
    """A frame with mattress, headboard, pillows, perhaps a footboard."""
    x, y, low = rng.uniform(0.85, 1.9), rng.uniform(1.9, 2.15), rng.uniform(0.05, 0.3)
    frame, mattress = rng.uniform(0.1, 0.25), rng.uniform(0.12, 0.25)
    parts = [box(x, y, frame, (0, 0, low)), *legs(rng, x, y, low, rng.uniform(0.05, 0.1))]
    parts.append(box(0.96 * x, 0.97 * y, mattress + 0.01, (0, 0, low + frame - 0.01)))
    parts.append(box(x, 0.06, rng.uniform(0.6, 1.1), (0, y / 2 - 0.01, 0)))
    if rng.random() < 0.4:
        parts.append(box(x, 0.05, low + frame + mattress * rng.uniform(0.8, 1.5), (0, -y / 2 + 0.01, 0)))
    count = 1 if x < 1.3 else 2
    for k in range(count):
        pillow = cushion_solid(0.8 * x / count, 0.45, 0.16, 4)
        across = (k - (count - 1) / 2) * 0.9 * x / count
        pillow.apply_translation((across, y / 2 - 0.35, low + frame + mattress + 0.05))
        parts.append(pillow)
    return parts


def cushion(rng: Rng) -> list[trimesh.Trimesh]:
    """A pillow, lying or leaning."""
    x, y, z = rng.uniform(0.35, 0.75), rng.uniform(0.3, 0.5), rng.uniform(0.1, 0.22)
    part = cushion_solid(x, y, z, rng.uniform(3, 8))
    lean = Rotation.from_euler("x", rng.choice([0.0, rng.uniform(50, 80)]), degrees=True)
    part.vertices = np.asarray(part.vertices) @ lean.as_matrix().T
    return [part]


def trash_can(rng: Rng) -> list[trimesh.Trimesh]:
    """A container of any number of sides, wider at the top, open, lidded or with a swing top."""
    height, radius = rng.uniform(0.25, 0.7), rng.uniform(0.11, 0.2)
    taper, sections = rng.uniform(0.7, 1.0), int(rng.choice([4, 6, 32]))
    stretch = rng.uniform(0.65, 1.0)
    outline = [(0, 0), (taper * radius, 0), (radius, height)]
    closed = rng.random() < 0.5
    if closed:
        outline += [(1.06 * radius, height), (1.06 * radius, height + 0.03)]
        outline += [(0.5 * radius, height + rng.uniform(0.03, 0.12)), (0, height + 0.13)]
    else:
        wall = rng.uniform(0.008, 0.015)
        outline += [(radius - wall, height), (taper * radius - wall, wall), (0, wall)]
    body = trimesh.creation.revolve(np.array(outline), sections=sections)
    body.vertices = np.asarray(body.vertices) * (1, stretch, 1)
    if closed and rng.random() < 0.6:
        return [body, box(0.12, 0.05, 0.02, (0, -stretch * taper * radius, 0.005))]  # a pedal
    return [body]


def stool(rng: Rng) -> list[trimesh.Trimesh]:
    """A round or square seat on four legs or on one foot."""
    height, width, top = rng.uniform(0.4, 0.78), rng.uniform(0.28, 0.42), rng.uniform(0.03, 0.09)
    under = height - top
    round_seat = rng.random() < 0.5
    seat = pole(width / 2, top, (0, 0, under)) if round_seat else box(width, width, top, (0, 0, under))
    if rng.random() < 0.3:
        foot = rng.uniform(0.15, 0.22)
        return [seat, pole(0.03, under + 0.01, (0, 0, 0)), pole(foot, 0.03, (0, 0, 0))]
    span, thick = 0.7 * width if round_seat else width, rng.uniform(0.03, 0.05)
    reach, rung = span / 2 - thick, rng.uniform(0.25, 0.6) * under  # at `reach` a rung meets two legs
    rungs = [box(2 * reach, thick / 2, 0.025, (0, a * reach, rung)) for a in (-1, 1)]
    rungs += [box(thick / 2, 2 * reach, 0.025, (a * reach, 0, rung)) for a in (-1, 1)]
    return [seat, *legs(rng, span, span, under, thick), *rungs]


def sofa(rng: Rng) -> list[trimesh.Trimesh]:
    """Base, back, cushions; arms on both sides, one side or none; perhaps a chaise."""
    x, y, seat = rng.uniform(1.3, 2.4), rng.uniform(0.75, 1.0), rng.uniform(0.36, 0.46)
    low, back = rng.uniform(0.05, 0.15), rng.uniform(0.7, 0.95)
    depth = rng.uniform(0.15, 0.25)
    parts = [box(x, y, seat - low - 0.1, (0, 0, low)), *legs(rng, x, y, low, 0.06)]
    parts.append(box(x, depth, back - low, (0, y / 2 - depth / 2, low)))
    arm, tall = rng.uniform(0.1, 0.25), rng.uniform(0.5, 0.68)
    arms = [(-1, 1), (-1,), (1,), ()][int(rng.choice(4, p=[0.6, 0.15, 0.15, 0.1]))]
    parts += [box(arm, y, tall - low, (a * (x - arm) / 2, 0, low)) for a in arms]
    count = int(rng.integers(1, 4))
    for k in range(count):
        across = (k - (count - 1) / 2) * x / count
        parts.append(box(0.98 * x / count, y - depth, 0.11, (across, -depth / 2, seat - 0.11)))
    if rng.random() < 0.25:
        side = 1 if rng.random() < 0.5 else -1
        parts.append(box(0.35 * x, 0.7, seat - low, (side * 0.325 * x, -y / 2 - 0.3, low)))
    return parts


CATEGORIES: dict[str, Callable[[Rng], list[trimesh.Trimesh]]] = {
    "bench": bench,
    "bed": bed,
    "cushion": cushion,
    "trash can": trash_can,
    "stool": stool,
    "sofa": sofa,
}
