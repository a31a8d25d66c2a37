"""What furniture stands on: four legs of many styles, sleds, trestles, panels, pedestals, stars on castors.

Each is centered under a plan of x × y, stands on z = 0 and reaches `BITE` above `height`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from train.furniture.procedural.parts import BITE, Point, Rng, bar, bent, box, pole, post, tube, turned

if TYPE_CHECKING:
    from manifold3d import Manifold

SIGNS = ((-1, -1), (-1, 1), (1, -1), (1, 1))


def four_legs(
    rng: Rng, x: float, y: float, height: float, thick: float, rungs: float = 0.0
) -> list[Manifold]:
    """Legs near the corners: square or round, straight, tapered, splayed or turned.

    `rungs` is the probability of bars between them.
    """
    tall, style = height + BITE, rng.choice(["straight", "tapered", "splayed", "turned"])
    inset = thick * rng.uniform(0.6, 1.0)
    splay = rng.uniform(0.06, 0.16) * height if style == "splayed" else 0.0
    inset += 0.8 * splay
    heads = [(a * (x / 2 - inset), b * (y / 2 - inset), tall) for a, b in SIGNS]
    feet = [(a * (x / 2 - inset + splay), b * (y / 2 - inset + splay), 0.0) for a, b in SIGNS]
    if style == "turned":
        profile = _turning(rng, tall, thick / 2)
        legs = [turned(profile, foot) for foot in feet]
    else:
        sides = int(rng.choice([4, 4, 8, 16]))
        thin = thick * (rng.uniform(0.5, 0.8) if style != "straight" else 1.0)
        legs = [post(f, h, thin, thick, sides) for f, h in zip(feet, heads, strict=True)]
    if rng.random() < rungs:
        legs += _rungs(rng, feet, heads, 0.35 * thick)
    return legs


def _turning(rng: Rng, tall: float, radius: float) -> list[tuple[float, float]]:
    """A lathe's profile: a foot, beads and hollows, a thick head."""
    heights = np.linspace(0, tall, 12)
    radii = radius * rng.uniform(0.6, 1.0, 12)
    radii[[0, 1]] = radius * rng.uniform(0.5, 0.8)
    radii[-3:] = radius
    return [(0.0, 0.0), *zip(radii.tolist(), heights.tolist(), strict=True), (0.0, tall)]


def _rungs(rng: Rng, feet: list[Point], heads: list[Point], radius: float) -> list[Manifold]:
    """Bars between neighboring legs: an H, or all around at two heights."""
    radius = max(radius, 0.007)

    def on_leg(k: int, share: float) -> Point:
        spot = (1 - share) * np.array(feet[k]) + share * np.array(heads[k])
        return float(spot[0]), float(spot[1]), float(spot[2])

    low = rng.uniform(0.2, 0.45)
    sides = [bar(on_leg(a, low), on_leg(b, low), radius) for a, b in ((0, 1), (2, 3))]
    if rng.random() < 0.5:
        middles = [np.mean([on_leg(a, low), on_leg(b, low)], axis=0) for a, b in ((0, 1), (2, 3))]
        return [*sides, bar(tuple(middles[0]), tuple(middles[1]), radius)]
    high = low + rng.uniform(-0.1, 0.25)
    return [*sides, *(bar(on_leg(a, high), on_leg(b, high), radius) for a, b in ((0, 2), (1, 3)))]


def sled(rng: Rng, x: float, y: float, height: float, thick: float) -> list[Manifold]:
    """A closed frame on each side, of bent tube or of square bars, and a bar between the two."""
    radius, parts = thick / 2, []
    lean = rng.uniform(0, 0.12) * y
    for a in (-1, 1):
        across = a * (x / 2 - thick)
        low, high = radius, height
        corners = [
            (across, -y / 2 + lean + radius, high),
            (across, -y / 2 + radius, low),
            (across, y / 2 - radius, low),
            (across, y / 2 - lean - radius, high),
        ]
        if rng.random() < 0.5:
            parts.append(tube(bent(corners, 0.07), radius))
        else:
            tops = [post(corners[1], corners[0], thick, thick), post(corners[2], corners[3], thick, thick)]
            parts += [*tops, box(thick, y, thick, (across, 0, 0))]
    middle = y / 2 - lean - 2 * thick
    parts.append(bar((-x / 2 + thick, middle, height), (x / 2 - thick, middle, height), 0.8 * radius))
    return parts


def hairpins(rng: Rng, x: float, y: float, height: float) -> list[Manifold]:
    """Four pairs of thin rods that meet at the floor."""
    radius, spread, parts = rng.uniform(0.005, 0.008), rng.uniform(0.05, 0.09), []
    for a, b in SIGNS:
        foot = (a * (x / 2 - 0.03), b * (y / 2 - 0.03), radius)
        tops = [(foot[0] - a * spread, foot[1], height), (foot[0], foot[1] - b * spread, height)]
        parts.append(tube([tops[0], foot, tops[1]], radius))
    return parts


def trestles(rng: Rng, x: float, y: float, height: float, thick: float) -> list[Manifold]:
    """Two trestles joined by a beam: a post or two on a foot, an A, or an X."""
    style, parts = rng.choice(["post", "A", "X"]), []
    reach, deep = x * rng.uniform(0.32, 0.42), 0.42 * y
    for a in (-1, 1):
        out = a * reach
        parts.append(box(thick, 0.8 * y, thick, (out, 0, height - thick + BITE)))
        if style == "post":
            width = rng.uniform(1.0, 2.5) * thick
            parts += [box(1.2 * thick, 0.85 * y, thick, (out, 0, 0)), box(thick, width, height, (out, 0, 0))]
        else:
            tops = (0.15 * y, 0.15 * y) if style == "A" else (-deep + thick, -deep + thick)
            for b, top in zip((-1, 1), tops, strict=True):
                parts.append(post((out, b * deep, 0), (out, b * top, height), thick, thick))
    middle = height * (0.5 if style == "X" else rng.uniform(0.25, 0.6))
    if style == "A":
        across = float(np.interp(middle, [0, height], [deep, 0.15 * y]))
        parts += [box(thick, 2 * across, thick, (a * reach, 0, middle)) for a in (-1, 1)]
    parts.append(box(2 * reach, 0.8 * thick, 1.6 * thick, (0, 0, middle - 0.8 * thick)))
    return parts


def panels(rng: Rng, x: float, y: float, height: float, thick: float) -> list[Manifold]:
    """Two upright boards, joined by a third behind or in the middle."""
    inset = rng.uniform(0.0, 0.1) * x
    deep = rng.uniform(0.75, 0.98) * y
    out = x / 2 - inset - thick / 2
    parts = [box(thick, deep, height + BITE, (a * out, 0, 0)) for a in (-1, 1)]
    tall = rng.uniform(0.2, 0.75) * height
    behind = rng.choice([0.0, deep / 2 - thick])
    return [*parts, box(2 * out, thick, tall + BITE, (0, behind, height - tall))]


def pedestal(rng: Rng, width: float, height: float) -> list[Manifold]:
    """One column on a disc, a tulip, or a cross of feet; `width` is the foot's."""
    column, tall = min(rng.uniform(0.09, 0.16) * width, 0.08), height + BITE
    style = rng.choice(["disc", "tulip", "cross"])
    under = turned([(0, tall - 0.02), (0.3 * width, tall - 0.02), (0.3 * width, tall), (0, tall)])
    if style == "disc":
        return [pole(width / 2, rng.uniform(0.012, 0.03)), pole(column, tall), under]
    if style == "tulip":
        heights = np.linspace(0.0, 1.0, 14)
        flare = np.cosh(3.2 * (heights - rng.uniform(0.45, 0.6)))
        radii = np.minimum(column * 0.7 * flare, width / 2)
        radii[0] = width / 2
        profile = list(zip(radii.tolist(), (tall * heights).tolist(), strict=True))
        return [turned([(0.0, 0.0), *profile, (0.0, tall)], sides=28), under]
    count, thick = int(rng.choice([3, 4, 4, 5])), rng.uniform(0.03, 0.06)
    parts = [pole(column, tall - 0.03, (0, 0, 0.03)), under]
    rise = rng.uniform(0.08, 0.2)
    for angle in 2 * np.pi * (np.arange(count) + 0.5) / count:
        out = (width / 2 * np.cos(angle), width / 2 * np.sin(angle), 0.0)
        parts.append(post(out, (0, 0, rise), thick, 1.2 * thick, 8))
    return parts


def star(rng: Rng, radius: float, height: float, castors: bool = True) -> list[Manifold]:
    """A swivel base: a gas column on four or five arms, with castors or glides."""
    count, wheel = int(rng.choice([4, 5, 5, 5])), rng.uniform(0.022, 0.032)
    raised = 2 * wheel + 0.01 if castors else 0.012
    hub, arm = rng.uniform(0.03, 0.045), rng.uniform(0.016, 0.024)
    top = raised + rng.uniform(0.05, 0.09)
    parts = [pole(hub, top + 0.03 - raised, (0, 0, raised), 0.8 * hub)]
    parts += [
        pole(0.6 * hub, (height - raised) * 0.6, (0, 0, raised)),
        pole(0.4 * hub, height + BITE - raised, (0, 0, raised)),
    ]
    for angle in 2 * np.pi * np.arange(count) / count + rng.uniform(0, 2):
        cos, sin = float(np.cos(angle)), float(np.sin(angle))
        tip = (radius * cos, radius * sin, raised + arm)
        parts.append(bar((0, 0, top - arm), tip, 1.2 * arm, arm))
        if castors:
            parts.append(pole(0.009, raised + arm - wheel, (tip[0], tip[1], wheel)))
            caster = pole(wheel, 0.045, (0, 0, -0.0225)).rotate((90, 0, float(np.degrees(angle) + 90)))
            parts.append(caster.translate((tip[0], tip[1], wheel)))
        else:
            parts.append(pole(0.018, raised + arm, (tip[0], tip[1], 0)))
    return parts
