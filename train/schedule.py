"""How the learning rate changes over a run."""

from __future__ import annotations

import optax

from more2_jax.config import TrainingConfig

PUBLISHED = {0.6: 0.3, 0.75: 0.3, 0.9: 0.3}  # share of the steps: factor from there on
LAST = 0.01  # share of the peak that the cosine ends at


def learning_rate(config: TrainingConfig) -> optax.Schedule:
    """A linear warm-up, then a cosine to 1 % of the peak, or the published steps (METHOD 2)."""
    peak, warmup = config.learning_rate, config.warmup_steps
    if config.schedule == "cosine":
        return optax.warmup_cosine_decay_schedule(0.0, peak, warmup, config.steps, LAST * peak)
    drops = {max(round(share * config.steps) - warmup, 0): factor for share, factor in PUBLISHED.items()}
    rising = optax.linear_schedule(0.0, peak, warmup)
    return optax.join_schedules([rising, optax.piecewise_constant_schedule(peak, drops)], [warmup])
