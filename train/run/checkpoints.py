"""Checkpoints of a run: the newest, from which it resumes, and the best by the validation score."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import orbax.checkpoint as ocp
from orbax.checkpoint.checkpoint_managers import AnyPreservationPolicy, BestN, LatestN

from train.run.state import TrainingState


def open_checkpoints(folder: Path) -> ocp.CheckpointManager:
    """Keeps two: last and best. A checkpoint appears whole or not at all, so a killed run leaves none damaged."""
    best = BestN(n=1, get_metric_fn=_score, keep_checkpoints_without_metrics=False)
    return ocp.CheckpointManager(
        folder.absolute(),
        options=ocp.CheckpointManagerOptions(
            preservation_policy=AnyPreservationPolicy([LatestN(n=1), best]),
            best_fn=_score,
            cleanup_tmp_directories=True,
        ),
    )


def _score(metrics: Mapping[str, float]) -> float:
    return metrics["score"]


def resume(manager: ocp.CheckpointManager, state: TrainingState) -> tuple[TrainingState, int]:
    """The newest checkpoint and its step; `state`, and 0, if there is none.

    `state` also says where the arrays go. Raises ValueError if the checkpoint is of another configuration.
    """
    if (latest := manager.latest_step()) is None:
        return state, 0
    try:
        restored = manager.restore(latest, args=ocp.args.StandardRestore(state))
    except (ValueError, KeyError, TypeError) as error:
        reason = " ".join(str(error).split())[:200]
        raise ValueError(f"checkpoint {latest} is not of this configuration ({reason})") from error
    assert isinstance(restored, TrainingState)  # as `state` is
    return restored, latest


def keep(manager: ocp.CheckpointManager, step: int, state: TrainingState, score: float | None = None) -> None:
    """Saves in the background; `score`, where it is known, decides which checkpoint is the best."""
    metrics = None if score is None else {"score": score}
    if manager.latest_step() != step:
        manager.save(step, args=ocp.args.StandardSave(state), metrics=metrics)
