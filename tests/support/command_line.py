"""Scan files, quick settings and refusals for tests of the command line."""

import signal
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from places import ROOT

from eval.survival import FEW_STEPS
from more2_jax.cli.main import main
from more2_jax.config import load_config
from more2_jax.storage.ply_files import write_points
from train.run.settings import TrainingRun

TINY = load_config(ROOT / "configs/tiny.yaml", TrainingRun).model


def run_quickly(*scans: Path, out: Path, prior: Path, unit: str = "m", more: Sequence[object] = ()) -> int:
    """`more2 run` with few steps."""
    settings = out.with_name("quick.yaml")
    settings.write_text(FEW_STEPS)
    options = ["--out", out, "--prior", prior, "--config", settings, "--unit", unit, *more]
    return main([str(a) for a in ("run", *scans, *options)])


def boxes(shift: float = 0.0, count: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """Points of `count` boxes of different proportions beside each other, meters, and their instance ids."""
    rng = np.random.default_rng(0)
    sizes = np.array([[1.0, 0.5, 0.3], [0.4, 0.4, 1.2], [0.8, 0.9, 0.5]])[:count]
    clouds = [rng.uniform(-0.5, 0.5, (100, 3)) * s + [2.0 * k + shift, 0, 0] for k, s in enumerate(sizes)]
    return np.concatenate(clouds), np.repeat(np.arange(count) + 1, 100)


def scan_file(path: Path, points=None, ids=None, name="instance") -> Path:
    default = boxes()
    write_points(path, default[0] if points is None else points, default[1] if ids is None else ids, name)
    return path


def refused(capsys, *argv: object) -> str:
    """The one line of standard error of a command that must exit with 2."""
    assert main([str(a) for a in argv]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("error: ")
    return lines[0]


def heed_interrupts() -> None:
    """For new processes: SIGINT stops them even where the tests run in the background, which ignores it."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
