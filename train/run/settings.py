"""Settings of a training run, as one YAML file holds them: the model, and how it is trained."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from more2_jax.config import PriorConfig
from train.shards.settings import LossConfig, SampleConfig


@dataclass(frozen=True)
class TrainingConfig(SampleConfig, LossConfig):
    """Training of the prior (paper §3.1): its steps, beside its samples and losses."""

    steps: int = 200_000  # Steps in all.
    batch: int = 64  # Shapes a step, with two partial clouds each.
    learning_rate: float = 1e-4  # The highest learning rate of Adam.
    warmup_steps: int = 200  # The rate rises to it over so many steps.
    # `cosine` falls to the end. `steps` multiplies by 0.3 at 60, 75 and 90 % of the steps, as published.
    # `trapezoid` is constant, and falls in the last fifth.
    schedule: Literal["cosine", "steps", "trapezoid"] = "cosine"
    clip: float = 1.0  # The gradient's norm is clipped to this.
    ema: float = 0.999  # The averaged weights keep this share of themselves at every step.
    validate_every: int = 250  # Steps from one validation to the next.
    # Steps from one set of pictures to the next, drawn at the validation that follows.
    picture_every: int = 1000
    seed: int = 0  # Seed of all that is drawn.


@dataclass(frozen=True)
class TrainingRun:
    """One configuration file of `train.prior`."""

    model: PriorConfig = field(default_factory=PriorConfig)
    training: TrainingConfig = field(default_factory=TrainingConfig)
