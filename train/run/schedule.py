"""How the learning rate changes over a run."""

from __future__ import annotations

import optax

from train.run.settings import TrainingConfig

PUBLISHED = {0.6: 0.3, 0.75: 0.3, 0.9: 0.3}  # share of the steps: factor from there on
LAST = 0.01  # share of the peak that the cosine and the trapezoid end at
FALL = 0.2  # share of the steps in which the trapezoid falls


def learning_rate(config: TrainingConfig) -> optax.Schedule:
    """A linear warm-up, then a cosine to 1 % of the peak, the published steps (paper §3.1), or a trapezoid.

    The trapezoid stays at the peak until its last fifth falls in a line to 1 %: as long as it stays, a stopped run may
    go on with another number of steps as if it had been meant from the start.
    """
    peak, warmup = config.learning_rate, config.warmup_steps
    if config.schedule == "cosine":
        return optax.warmup_cosine_decay_schedule(0.0, peak, warmup, config.steps, LAST * peak)
    rising = optax.linear_schedule(0.0, peak, warmup)
    if config.schedule == "trapezoid":
        fall = round(FALL * config.steps)
        falling = optax.linear_schedule(peak, LAST * peak, fall, max(config.steps - fall - warmup, 0))
        return optax.join_schedules([rising, falling], [warmup])
    drops = {max(round(share * config.steps) - warmup, 0): factor for share, factor in PUBLISHED.items()}
    return optax.join_schedules([rising, optax.piecewise_constant_schedule(peak, drops)], [warmup])
