"""What each part of registration by surfaces is worth, on true pairs, beside many starts of GICP.

`python -m eval.ablation_robust --data rooms/sparse --scenes 5`
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from eval.data.flyingshape import flyingshape
from eval.harness.extra import has
from eval.peers.registration import many_starts
from eval.registration import own_records, peer_records, true_pairs
from eval.scores.figures import Record
from more2_jax.config import RegistrationConfig, preset
from more2_jax.network.prior import load_prior
from train.run.program import run

PEER = "multi-start GICP"


def main(
    data: Path, scenes: int = 0, prior: str = "small", batch: int = 8, only: tuple[str, ...] = ()
) -> None:
    """Registers the second scan's objects onto the first's, by every variant.

    Args:
        data: rooms of train.synthesize.
        scenes: how many, from the first; 0 for all.
        prior: name of shipped weights, or a file.
        batch: pairs a compiled call takes.
        only: names of variants; all without it.
    """
    rooms = flyingshape(data)
    known = [rooms.read(name) for name in rooms.names[: scenes or None]]
    pairs = [p for s in known for p in true_pairs(s, "first")]
    if not pairs:
        raise ValueError(f"{data}: no object in both of the first two scans; needed one")
    named = variants(preset("robust", upright=rooms.upright).registration)
    if unknown := set(only) - set(named):
        raise ValueError(f"variants {sorted(unknown)}; needed some of {', '.join(named)}")
    chosen = {k: v for k, v in named.items() if not only or k in only}
    found = own_records(pairs, load_prior(prior), chosen, rooms.upright, batch)
    if has("small_gicp"):
        found += peer_records(pairs, {PEER: many_starts}, rooms.upright)
    Console().print(table([r for _, r in found], rooms.right_deg))


def variants(robust: RegistrationConfig) -> dict[str, RegistrationConfig]:
    """Registration as `robust` has it, and without or with one thing."""
    changes = {
        "robust": {},
        "without the prior's surfaces": {"field_weight": 0.0},
        "without polish": {"polish_steps": 0},
        "without 'it did not move'": {"identity_start": False},
        "height is free": {"lift_weight": 0.0},
        "truncation halved": {"truncation": robust.truncation / 2},
        "3 starts kept": {"keep_starts": 3},
        "12 turns to start from": {"yaw_starts": 12},
        "from the embedding's turn alone": {"starts": "embedding"},
        "descent on the field": {"refine": "descent", "keep_starts": 3, "steps": 25, "learning_rate": 0.01},
    }
    return {name: dataclasses.replace(robust, **change) for name, change in changes.items()}


def table(records: list[Record], right_deg: float) -> Table:
    """A row a variant; a failure counts as 180°."""
    result = Table("variant", f"RE < {right_deg:g}°", "RE < 15°", "median", "pairs", "s a pair")
    for method in dict.fromkeys(r["method"] for r in records):
        rows = [r for r in records if r["method"] == method]
        errors = np.array([180.0 if r["re_deg.strict"] is None else r["re_deg.strict"] for r in rows])
        shares = [f"{100 * np.mean(errors < limit):.1f} %" for limit in (right_deg, 15)]
        seconds = np.mean([r["seconds"] for r in rows])
        result.add_row(method, *shares, f"{np.median(errors):.2f}°", str(len(rows)), f"{seconds:.2f}")
    return result


if __name__ == "__main__":
    run(main)
