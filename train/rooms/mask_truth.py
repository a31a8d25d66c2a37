"""Which object each predicted mask shows, and which masks show each object."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int

LOST = -1  # the instance of an object that a scan shows and no mask has
HELD = 0.5  # share of an object's points in another's mask, for the mask to hold it too


@dataclass(frozen=True, kw_only=True)
class Shown:
    """How the masks of one scan show one object."""

    instance: int  # the mask with most of its points among those that are mostly its own; `LOST`: none
    instances: tuple[int, ...]  # all masks that are mostly its own, largest share of it first
    merged: bool = False  # `instance` is mostly another object's and holds this one too


def shown_by(
    mask: Int[np.ndarray, " v"], owner: Int[np.ndarray, " v"], count: int, fewest: int
) -> dict[int, Shown]:
    """How masks (0: none) show the objects 0 to `count` − 1 that the points truly lie on (−1: none).

    An object with fewer than `fewest` points is not shown by the scan at all, and left out.
    """
    table = np.zeros((count + 1, int(mask.max(initial=0)) + 1), np.int64)
    np.add.at(table, (owner, mask), 1)  # row −1, the last: nobody's points
    table[:, 0], whole = 0, np.bincount(owner[owner >= 0], minlength=count)
    held_by = table[:count].argmax(axis=0)
    shown = {}
    for k in range(count):
        own = [int(i) for i in np.flatnonzero((held_by == k) & (table[k] > 0))]
        own.sort(key=lambda i: -table[k, i])
        most = int(table[k].argmax())
        if own:
            shown[k] = Shown(instance=own[0], instances=tuple(own))
        elif most and table[k, most] >= HELD * whole[k] and whole[k] >= fewest:
            shown[k] = Shown(instance=most, instances=(most,), merged=True)
        elif whole[k] >= fewest:
            shown[k] = Shown(instance=LOST, instances=())
    return shown
