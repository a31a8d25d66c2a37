"""Lamps and trash cans."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from train.furniture.procedural.parts import (
    Outline,
    Rng,
    bar,
    bent,
    box,
    kernel,
    pole,
    post,
    rounded,
    superellipse,
    tube,
    turned,
)

if TYPE_CHECKING:
    from manifold3d import Manifold

WALL = 0.01  # of shades and cans: thin, and still seen by a coarse sampling


def lamp(rng: Rng) -> list[Manifold]:
    """A floor, table, desk or arc lamp; drum, cone, dome, globe or bell for a shade."""
    style = rng.choice(["floor", "tripod", "arc", "table", "desk"], p=[0.25, 0.15, 0.15, 0.25, 0.2])
    if style == "desk":
        return _desk_lamp(rng)
    if style == "arc":
        return _arc_lamp(rng)
    top = rng.uniform(1.2, 1.65) if style != "table" else rng.uniform(0.28, 0.5)
    wide = rng.uniform(0.13, 0.27) if style != "table" else rng.uniform(0.09, 0.2)
    parts = [shade(rng, wide, wide * rng.uniform(1.0, 1.8)).translate((0, 0, top))]
    parts.append(pole(0.009, 0.1, (0, 0, top - 0.06)))
    if style == "tripod":
        thick, reach = rng.uniform(0.02, 0.032), rng.uniform(0.2, 0.32)
        parts.append(pole(0.035, 0.05, (0, 0, top - 0.07)))
        for angle in 2 * np.pi * np.arange(3) / 3 + 0.4:
            foot = (reach * float(np.cos(angle)), reach * float(np.sin(angle)), 0.0)
            parts.append(post(foot, (0.1 * foot[0], 0.1 * foot[1], top - 0.03), 0.7 * thick, thick, 12))
        return parts
    if style == "table":
        return [*parts, _vase(rng, top - 0.04, rng.uniform(0.4, 0.65) * wide)]
    parts += [pole(rng.uniform(0.009, 0.018), top + 0.02), _foot(rng, rng.uniform(0.12, 0.17))]
    return parts


def _foot(rng: Rng, radius: float) -> Manifold:
    """A disc, a low dome or a square plate."""
    tall = rng.uniform(0.012, 0.035)
    if rng.random() < 0.25:
        return box(1.7 * radius, 1.7 * radius, tall)
    return turned(
        [(0, 0), (radius, 0), (radius, 0.6 * tall), (rng.uniform(0.2, 0.95) * radius, tall), (0, tall)],
        sides=28,
    )


def _vase(rng: Rng, tall: float, radius: float) -> Manifold:
    """A turned body of a few swellings."""
    knots = rng.uniform(0.35, 1.0, 5)
    knots[0], knots[-1] = rng.uniform(0.7, 1.0), rng.uniform(0.15, 0.3)
    share = np.linspace(0, 1, 14)
    radii = radius * np.interp(share, np.linspace(0, 1, 5), knots / knots.max())
    smooth = np.convolve(np.pad(radii, 1, mode="edge"), [0.25, 0.5, 0.25], mode="valid")
    profile = list(zip(np.maximum(smooth, 0.012).tolist(), (tall * share).tolist(), strict=True))
    return turned([(0.0, 0.0), *profile, (0.0, tall)], sides=int(rng.choice([4, 6, 28, 28])))


def shade(rng: Rng, radius: float, tall: float) -> Manifold:
    """A shade about the upright axis, its middle at z = 0, its rim carried by a cross of rods; open or closed."""
    style = rng.choice(["drum", "cone", "dome", "globe", "bell", "square"])
    if style == "globe":
        return (
            kernel()
            .Manifold.sphere(0.8 * radius, 32)
            .scale((1, 1, rng.uniform(0.8, 1.1)))
            .translate((0, 0, 0.6 * radius))
        )
    share = np.linspace(0, 1, 2 if style in ("drum", "cone", "square") else 9)
    narrow = {"drum": rng.uniform(0.85, 1.0), "cone": rng.uniform(0.3, 0.65)}.get(
        str(style), rng.uniform(0.4, 1.0)
    )
    if style == "dome":
        outer, tall = radius * np.sqrt(1 - (0.95 * share) ** 2), 0.7 * tall
    elif style == "bell":
        outer = radius * (narrow * 0.6 + (1 - narrow * 0.6) * (1 - share) ** 2)
    else:
        outer = radius * (1 - (1 - narrow) * share)
    heights = tall * (share - 0.5)
    outer = np.maximum(outer, 0.035)
    inner = list(zip((outer - WALL).tolist(), heights.tolist(), strict=True))[::-1]
    ring = [*zip(outer.tolist(), heights.tolist(), strict=True), *inner]
    hollow = turned(ring, sides=4 if style == "square" else 32)
    arm = float(np.interp(0, heights, outer)) - 0.8 * WALL
    spokes = [bar((-arm * c, -arm * s, 0), (arm * c, arm * s, 0), 0.005) for c, s in ((1, 0), (0, 1))]
    bulb = kernel().Manifold.sphere(min(0.03, 0.5 * arm), 12)
    solid = hollow + spokes[0] + spokes[1] + bulb
    return solid.rotate((0, 0, 45)) if style == "square" else solid


def _arc_lamp(rng: Rng) -> list[Manifold]:
    """A long bow from a heavy foot, the shade hanging from its end."""
    tall, reach, radius = rng.uniform(1.5, 1.95), rng.uniform(0.6, 1.1), rng.uniform(0.01, 0.016)
    drop = rng.uniform(0.15, 0.4)
    angle = np.linspace(0, np.pi * rng.uniform(0.55, 0.75), 12)
    half = reach / (1 - np.cos(angle[-1]))
    rise = rng.uniform(0.4, 0.7) * tall
    bow = [(float(half * (1 - np.cos(a))), 0.0, float(rise + (tall - rise) * np.sin(a))) for a in angle]
    end = bow[-1]
    hang = (end[0], 0.0, end[2] - drop * 0.5)
    parts = [tube([(0, 0, 0.01), *bow], radius), _foot(rng, rng.uniform(0.14, 0.2)), bar(end, hang, 0.007)]
    return [*parts, shade(rng, rng.uniform(0.12, 0.2), rng.uniform(0.14, 0.25)).translate(hang)]


def _desk_lamp(rng: Rng) -> list[Manifold]:
    """Two arms with a joint, or a swan's neck, and a tilted head."""
    foot, radius = rng.uniform(0.075, 0.11), rng.uniform(0.006, 0.009)
    low, high = rng.uniform(0.2, 0.35), rng.uniform(0.35, 0.55)
    elbow, wrist = (rng.uniform(-0.18, -0.02), 0.0, low), (rng.uniform(0.1, 0.28), 0.0, high)
    parts = [_foot(rng, foot)]
    if rng.random() < 0.5:
        parts += [tube([(0, 0, 0.01), elbow, wrist], radius)]
        parts += [kernel().Manifold.sphere(2 * radius, 14).translate(p) for p in (elbow, wrist)]
    else:
        corners = [(0, 0, 0.01), (0, 0, high + 0.05), (wrist[0], 0, high + 0.05), wrist]
        parts.append(tube(bent(corners, 0.12, 7), radius))
    wide, long = rng.uniform(0.05, 0.085), rng.uniform(0.09, 0.15)
    neck, wall = rng.uniform(0.022, 0.04), 0.008
    outer = [(0.0, 0.0), (neck, 0.0), (neck * 1.1, 0.3 * long), (wide, long)]
    head = turned(
        [*outer, (wide - wall, long), (neck * 1.1 - wall, 0.3 * long + wall), (0.0, 0.3 * long)], sides=24
    )
    return [*parts, head.rotate((0, float(rng.uniform(115, 185)), 0)).translate(wrist)]


# --- trash cans ---------------------------------------------------------------------------------------------


def trash_can(rng: Rng) -> list[Manifold]:
    """Round, oval, square or many-sided; open, domed, with a swing top or a lid and pedal; perhaps slotted."""
    x = rng.uniform(0.2, 0.4)
    y, tall = x * rng.choice([1.0, rng.uniform(0.6, 1.0)]), rng.uniform(1.0, 1.9) * x + 0.04
    outline, taper = _plan(rng, x, y), rng.uniform(0.7, 1.0)
    body = _prism(outline * taper, outline, 0.0, tall)
    style = rng.choice(["open", "dome", "swing", "pedal"])
    if style == "open":
        wall = rng.uniform(0.008, 0.014)
        shrink = 1 - 2 * wall / np.ptp(outline, axis=0)
        body = body - _prism(outline * taper * shrink, outline * shrink, 0.015, tall + 0.001)
        if rng.random() < 0.4:
            body = _rim(outline, shrink, tall) + body
        if rng.random() < 0.35:
            body = _slotted(rng, body, x, tall)
        return [body]
    lid, over = rng.uniform(0.02, 0.05), rng.uniform(1.0, 1.06)
    parts = [body, _prism(over * outline, over * outline, tall - 0.005, tall + lid)]
    if style == "dome":
        parts.append(
            _prism(
                over * outline,
                rng.uniform(0.3, 0.8) * outline,
                tall + lid - 1e-3,
                tall + lid + rng.uniform(0.03, 0.12),
            )
        )
    elif style == "swing":
        top = tall + lid + rng.uniform(0.08, 0.16)
        ridge = outline * (0.9, rng.uniform(0.15, 0.4))
        cap = _prism(over * outline, ridge, tall + lid - 1e-3, top)
        flap = box(0.6 * x, 0.05, 0.5 * (top - tall - lid), (0, -0.42 * y, tall + lid + 0.02))
        parts.append(cap - flap)
    else:
        parts.append(box(0.35 * x, 0.07, 0.018, (0, taper * outline[:, 1].min() - 0.015, 0.008)))
        parts.append(box(0.3 * x, 0.03, 0.05, (0, outline[:, 1].max() - 0.005, tall - 0.02)))
    return parts


def _plan(rng: Rng, x: float, y: float) -> Outline:
    """The outline of a can, seen from above."""
    style = rng.choice(["round", "square", "rounded", "polygon", "half"], p=[0.35, 0.1, 0.25, 0.2, 0.1])
    if style == "round":
        return superellipse(x, y, 2, 36)
    if style == "square":
        return rounded(x, y, 0.0)
    if style == "rounded":
        return rounded(x, y, rng.uniform(0.1, 0.35) * y)
    if style == "polygon":
        return superellipse(x, y, 2, int(rng.choice([6, 8, 12])))
    half = superellipse(x, 1.6 * y, 2, 36)
    flat = half[half[:, 1] < 0.2 * y]
    return flat - (flat.min(axis=0) + flat.max(axis=0)) / 2


def _prism(below: Outline, above: Outline, low: float, high: float) -> Manifold:
    """The hull of an outline at the height `low` and another at `high`."""
    layers = [np.column_stack([flat, np.full(len(flat), z)]) for flat, z in ((below, low), (above, high))]
    return kernel().Manifold.hull_points(np.concatenate(layers))


def _rim(outline: Outline, shrink: np.ndarray, tall: float) -> Manifold:
    """A thicker edge round the opening."""
    wide = outline * (2 - shrink) if np.all(shrink < 1) else outline
    return _prism(wide, wide, tall - 0.02, tall) - _prism(
        outline * shrink, outline * shrink, tall - 1, tall + 1
    )


def _slotted(rng: Rng, body: Manifold, x: float, tall: float) -> Manifold:
    """The body with upright slots all around, as baskets have."""
    count, low = int(rng.integers(5, 11)), 0.15 * tall
    slot = box(2 * x, 0.016, 0.6 * tall, (0, 0, low))
    slots = [slot.rotate((0, 0, 180 * k / count)) for k in range(count)]
    for one in slots:
        body = body - one
    return body
