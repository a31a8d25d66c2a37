"""Tables and desks."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from train.furniture.procedural.fronts import drawers
from train.furniture.procedural.parts import BITE, Outline, Rng, box, post, rounded, slab, superellipse, union
from train.furniture.procedural.supports import four_legs, hairpins, panels, pedestal, sled, trestles

if TYPE_CHECKING:
    from manifold3d import Manifold

SIZES = {  # width, depth, height (m), lowest and highest
    "dining": ((1.1, 2.2), (0.75, 1.05), (0.71, 0.78)),
    "small": ((0.6, 0.95), (0.6, 0.9), (0.7, 0.78)),
    "coffee": ((0.7, 1.3), (0.45, 0.75), (0.32, 0.48)),
    "side": ((0.35, 0.55), (0.35, 0.5), (0.45, 0.65)),
    "console": ((0.8, 1.4), (0.28, 0.42), (0.72, 0.85)),
    "bar": ((0.55, 0.9), (0.55, 0.75), (0.95, 1.1)),
}


def table(rng: Rng) -> list[Manifold]:
    """Dining, coffee, side, console and bar tables; tops of any outline on legs, pedestals, trestles, panels."""
    size = SIZES[str(rng.choice(list(SIZES), p=[0.35, 0.12, 0.2, 0.15, 0.1, 0.08]))]
    x, y, top = (rng.uniform(*span) for span in size)
    thick = rng.uniform(0.018, 0.045)
    outline, is_round = _outline(rng, x, y)
    x, y = np.ptp(outline, axis=0).tolist()
    parts = [slab(outline, thick, (0, 0, top - thick), rng.choice([0.0, rng.uniform(0.004, 0.03)]))]
    under = top - thick
    parts += _base(rng, x, y, under, is_round)
    if not is_round and rng.random() < 0.2 and under < 0.6:  # a shelf below, carried by four posts of its own
        low = rng.uniform(0.25, 0.5) * under
        parts.append(slab(rounded(0.82 * x, 0.82 * y, 0.02), 0.02, (0, 0, low)))
        corners = [(a * 0.38 * x, b * 0.38 * y, low + 0.01) for a in (-1, 1) for b in (-1, 1)]
        parts += [post(c, (c[0], c[1], under + BITE), 0.025, 0.025) for c in corners]
    return parts


def _outline(rng: Rng, x: float, y: float) -> tuple[Outline, bool]:
    """The top's outline, and whether its corners are too round for legs there."""
    style = rng.choice(
        ["rectangle", "rounded", "oval", "round", "barrel", "octagon"], p=[0.3, 0.2, 0.12, 0.2, 0.1, 0.08]
    )
    if style == "round":
        return superellipse((x + y) / 2, (x + y) / 2, 2, 48), True
    if style == "oval":
        return superellipse(x, y, rng.uniform(2, 3), 48), True
    if style == "barrel":
        return superellipse(x, y, rng.uniform(4, 8), 48), True
    if style == "octagon":
        cut = rng.uniform(0.1, 0.2) * y
        corner = np.array([[x / 2, y / 2 - cut], [x / 2 - cut, y / 2]])
        half = np.concatenate([corner, corner[::-1] * (-1, 1)])
        return np.concatenate([half, -half]), True
    return rounded(x, y, 0.0 if style == "rectangle" else rng.uniform(0.02, 0.12)), False


def _base(rng: Rng, x: float, y: float, under: float, is_round: bool) -> list[Manifold]:
    """What carries a table's top; a round one has its legs further in."""
    long, inner = x > 1.6 * y, 0.68 if is_round else 0.96
    styles = ["legs", "legs", "legs", "hairpins", "sled"]
    styles += ["trestles", "trestles", "panels", "twin"] if long and not is_round else []
    styles += ["pedestal", "pedestal"] if not long else ["twin"]
    style = rng.choice(styles)
    if style == "legs":
        thick = rng.uniform(0.035, 0.09) if x > 0.7 else rng.uniform(0.025, 0.045)
        parts = four_legs(rng, inner * x, inner * y, under, thick, rungs=0.2)
        if rng.random() < 0.6:
            parts.append(_apron(0.9 * inner * x, 0.88 * inner * y, under, rng.uniform(0.05, 0.11)))
        return parts
    if style == "hairpins":
        return hairpins(rng, inner * x, inner * y, under + BITE)
    if style == "sled":
        return sled(rng, inner * x, inner * y, under + BITE, rng.uniform(0.02, 0.045))
    if style == "trestles":
        return trestles(rng, x, y, under, rng.uniform(0.045, 0.08))
    if style == "panels":
        return panels(rng, x, y, under, rng.uniform(0.02, 0.045))
    if style == "pedestal":
        return pedestal(rng, rng.uniform(0.5, 0.75) * min(x, y), under)
    state = rng.bit_generator.state  # twins: the same draws twice
    feet = []
    for a in (-1, 1):
        rng.bit_generator.state = state
        feet.append(union(pedestal(rng, 0.6 * y, under)).translate((a * 0.27 * x, 0, 0)))
    return feet


def _apron(x: float, y: float, under: float, tall: float) -> Manifold:
    """A frame of boards below the top."""
    outer = box(x, y, tall + BITE, (0, 0, under - tall))
    return outer - box(x - 0.044, y - 0.044, tall + 1, (0, 0, under - tall - 0.5))


def desk(rng: Rng) -> list[Manifold]:
    """A writing desk: straight or L-shaped, with pedestals of drawers, a back panel, a hutch, or bare legs."""
    x, y, top = rng.uniform(1.0, 1.8), rng.uniform(0.5, 0.8), rng.uniform(0.7, 0.78)
    thick = rng.uniform(0.018, 0.038)
    under = top - thick
    parts = [slab(rounded(x, y, rng.choice([0.0, rng.uniform(0.01, 0.06)])), thick, (0, 0, under))]
    style = rng.choice(["pedestals", "one pedestal", "legs", "panels", "trestles", "sled"])
    wide = rng.uniform(0.3, 0.45)
    if style in ("pedestals", "one pedestal"):
        sides = (-1, 1) if style == "pedestals" and x > 1.25 else (int(rng.choice([-1, 1])),)
        for a in sides:
            chest = drawers(rng, wide, 0.92 * y, under + BITE, int(rng.integers(2, 5)), plinth=0.04)
            parts.append(chest.translate((a * (x / 2 - wide / 2 - 0.02), 0, 0)))
        if len(sides) == 1:
            end = -sides[0] * (x / 2 - 0.03)
            parts.append(box(0.03, 0.92 * y, under + BITE, (end, 0, 0)))
        tall = rng.uniform(0.2, 0.55)
        parts.append(box(x - 0.06, 0.02, tall, (0, 0.4 * y, under + BITE - tall)))
    elif style == "legs":
        parts += four_legs(rng, 0.96 * x, 0.94 * y, under, rng.uniform(0.035, 0.06), rungs=0.15)
        tall = rng.uniform(0.08, 0.14)
        box_of = drawers(rng, 0.84 * x, 0.8 * y, tall, 1, across=int(rng.integers(1, 4)))
        parts.append(box_of.translate((0, 0, under + BITE - tall)))
    elif style == "panels":
        parts += panels(rng, x, y, under, rng.uniform(0.02, 0.035))
    elif style == "trestles":
        parts += trestles(rng, x, y, under, rng.uniform(0.04, 0.06))
    else:
        parts += sled(rng, 0.95 * x, 0.95 * y, under + BITE, rng.uniform(0.025, 0.045))
    extra = rng.choice(["none", "L", "hutch", "riser"], p=[0.45, 0.25, 0.15, 0.15])
    if extra == "L":
        parts += _return(rng, x, y, top, thick)
    elif extra != "none":
        parts += _upper(rng, x, y, top, extra == "hutch")
    return parts


def _return(rng: Rng, x: float, y: float, top: float, thick: float) -> list[Manifold]:
    """The wing of an L-shaped desk, toward the front on one side, on a panel."""
    a, wide, long = int(rng.choice([-1, 1])), rng.uniform(0.4, 0.55), rng.uniform(0.4, 0.9)
    across, front = a * (x / 2 - wide / 2), -y / 2 - long
    wing = box(wide, long + 0.05, thick, (across, front + (long + 0.05) / 2, top - thick))
    return [wing, box(wide, 0.03, top - thick + BITE, (across, front + 0.05, 0))]


def _upper(rng: Rng, x: float, y: float, top: float, tall: bool) -> list[Manifold]:
    """A hutch with compartments, or a low riser, on the rear of the top."""
    deep, board = rng.uniform(0.2, 0.28), 0.018
    rise, rear = rng.uniform(0.35, 0.6) if tall else rng.uniform(0.1, 0.15), y / 2 - 0.14
    wide = x * (1.0 if tall else rng.uniform(0.5, 0.95))
    count = int(rng.integers(2, 5)) if tall else 2
    spots = np.linspace(-wide / 2 + board / 2, wide / 2 - board / 2, count)
    parts = [box(board, deep, rise, (float(s), rear, top - BITE)) for s in spots]
    parts.append(box(wide, deep, board, (0, rear, top + rise - board)))
    if tall:
        parts.append(box(wide, deep, board, (0, rear, top + rise * rng.uniform(0.4, 0.6))))
        parts.append(box(wide, 0.012, rise, (0, rear + deep / 2 - 0.006, top - BITE)))
    return parts
