"""What mends masks before objects are registered, in the order in which it does."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from itertools import repeat

from more2_jax.tracking.comparison import Comparison
from more2_jax.tracking.crossed_masks import join_crossed
from more2_jax.tracking.joined_masks import join_parts
from more2_jax.tracking.merged_masks import divide_merged
from more2_jax.tracking.objects import next_number
from more2_jax.tracking.regrouped import Regrouped
from more2_jax.tracking.unmasked import add_unmasked, without_unfound
from more2_jax.tracking.unseen_wholes import join_smooth
from more2_jax.types import LivingScene, Scan

# What it makes of masks as they were compared; None if it finds nothing to do.
Mend = Callable[[Regrouped, Comparison], Regrouped | None]


def mends_of_masks(scene: LivingScene, scan: Scan) -> Iterator[Mend]:
    """Yields what mends masks, in turn; the last until nothing is left to do."""
    crossed: list[Regrouped | None] = []

    def joined(masks: Regrouped, compared: Comparison) -> Regrouped | None:
        crossed.append(join_crossed(masks, compared))
        return crossed[-1]

    def joined_anew(masks: Regrouped, compared: Comparison) -> Regrouped | None:
        return join_parts(masks, compared) if any(crossed) else None  # the new wholes may have more parts

    def divided(masks: Regrouped, compared: Comparison) -> Regrouped | None:
        return divide_merged(masks, compared, next_number(masks.objects, scene.scans))

    yield join_parts
    yield joined
    yield joined_anew
    yield divided
    yield lambda masks, compared: divided(masks, compared) if masks.divided else None
    yield partial(join_smooth, scans=scene.scans, scan=scan)
    yield partial(add_unmasked, scans=scene.scans, scan=scan)
    yield from repeat(without_unfound)
