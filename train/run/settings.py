"""Settings of a training run, as one YAML file holds them: the model, and how it is trained."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from more2_jax.config import PriorConfig
from train.shards.settings import LossConfig, SampleConfig


@dataclass(frozen=True)
class TrainingConfig(SampleConfig, LossConfig):
    """Training of the prior (paper §3.1): its steps, beside its samples and losses."""

    steps: int = 200_000
    batch: int = 64  # shapes; two partial clouds each
    learning_rate: float = 1e-4
    warmup_steps: int = 200
    # or ×0.3 at 60, 75 and 90 % of the steps, as published; or constant, and falling in the last fifth
    schedule: Literal["cosine", "steps", "trapezoid"] = "cosine"
    clip: float = 1.0  # of the gradient's norm
    ema: float = 0.999  # of the averaged weights, a step
    validate_every: int = 250  # steps
    picture_every: int = 1000  # steps; drawn at the next validation
    seed: int = 0


@dataclass(frozen=True)
class TrainingRun:
    """One configuration file of `train.prior`."""

    model: PriorConfig = field(default_factory=PriorConfig)
    training: TrainingConfig = field(default_factory=TrainingConfig)
