"""Color as evidence of who is who, where both scans have it: identical copies of different colors are told apart.

Beyond the paper (preset `robust`). An object's color is the mean of its points in CIE L*a*b*.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int, Integer
from skimage.color import rgb2lab

from more2_jax.types import Color

# Standard deviations of differences in (L*, a*, b*). Assumptions, not fitted: no openly licensed pairs of colored
# scans with known identities are at hand.
SAME = np.array([12.0, 8.0, 8.0])  # of one object in two scans: light, exposure and white balance differ
DIFFERENT = np.array([25.0, 20.0, 20.0])  # of two objects, in a room of many colors
ODD = 0.1  # probability that one object looks like another: painted, covered, lit by a lamp, seen from behind


def color_of(colors: Integer[np.ndarray, "n 3"] | None) -> Color | None:
    """The color of points, RGB from 0 to 255 (sRGB); None without colors or points."""
    if colors is None or not len(colors):
        return None
    return Color(points=len(colors), lab=rgb2lab(np.asarray(colors) / 255.0).mean(axis=0))


def pooled(*parts: Color | None) -> Color | None:
    """The color of the union of clouds, from theirs; those without colors do not count."""
    known = [c for c in parts if c is not None]
    if not known:
        return None
    count = np.array([c.points for c in known])
    return Color(points=int(count.sum()), lab=count @ np.stack([c.lab for c in known]) / count.sum())


def color_evidence(
    old: Sequence[Color | None], new: Sequence[Color | None], pairs: Int[np.ndarray, "p 2"]
) -> Float[np.ndarray, " p"]:
    """Log likelihood ratio of the colors of pairs: one object against two; 0 where either has none.

    The difference of one object's colors is normal (`SAME`), but with probability `ODD` that of two objects;
    so no pair loses more than log `ODD`. Differences of two objects are normal with the spread of the room's own
    colors, `DIFFERENT` at most: things all of one color, or a file that paints all alike, say nothing. A shift
    common to a scan (white balance) is not estimated: few objects could not tell it from objects exchanged.
    """
    a, b = (np.stack([np.full(3, np.nan) if c is None else c.lab for c in side]) for side in (old, new))
    different = np.clip(np.minimum(_spread(a), _spread(b)), SAME, DIFFERENT)
    squared = (a[pairs[:, 0]] - b[pairs[:, 1]]) ** 2
    exponent = 0.5 * (squared * (different**-2 - SAME**-2)).sum(axis=-1)
    alike = exponent + np.log(different / SAME).sum()
    ratio = np.logaddexp(np.log1p(-ODD) + np.nan_to_num(alike), np.log(ODD))
    return np.where(np.isnan(alike), 0.0, ratio)


def _spread(lab: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "3"]:
    """Standard deviation of the difference of two objects' colors in one scan; infinite if fewer than two have any."""
    known = lab[~np.isnan(lab).any(axis=1)]
    return np.sqrt(2 * known.var(axis=0, ddof=1)) if len(known) > 1 else np.full(3, np.inf)
