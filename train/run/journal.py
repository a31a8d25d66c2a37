"""What a run writes down: log.jsonl, curves for TensorBoard, pictures. A resumed run leaves no line twice."""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from more2_jax.whole_file import whole_file


class Journal:
    """The log of one run in one folder; a context manager. Of all processes one keeps it.

    Lines of steps after `step` are of work that was lost: they are removed. Curves go to `OUT/tensorboard` if
    tensorboardX (extra `train`) is installed.
    """

    def __init__(self, out: Path, step: int) -> None:
        self.path, self.pictures = out / "log.jsonl", out / "pictures"
        self.lines = [line for line in read_log(self.path) if line["step"] <= step]
        with whole_file(self.path) as partial:
            partial.write_text("".join(json.dumps(line) + "\n" for line in self.lines))
        self.curves = _curves(out / "tensorboard", step)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self.curves is not None:
            self.curves.close()

    @property
    def best(self) -> float:
        """The best validation score so far; −inf before the first."""
        return max((line["val"].get("score", -np.inf) for line in self.lines), default=-np.inf)

    @property
    def seconds(self) -> float:
        """How long the run took up to its last line, all calls together."""
        return self.lines[-1]["seconds"] if self.lines else 0.0

    def write(self, step: int, seconds: float, train: Mapping[str, float], val: Mapping[str, float]) -> None:
        """Adds means over the last training steps and validation scores."""
        line = {"step": step, "seconds": round(seconds, 1), "train": dict(train), "val": dict(val)}
        self.lines.append(line)
        with self.path.open("a") as log:
            log.write(json.dumps(line) + "\n")
        if self.curves is not None:
            for group, values in (("train", train), ("val", val)):
                for name, value in values.items():
                    self.curves.add_scalar(f"{group}/{name}", value, step)
            self.curves.flush()

    def picture(self, step: int, image: UInt8[np.ndarray, "h w 3"]) -> None:
        """Writes `OUT/pictures/step_NNNNNN.png`."""
        self.pictures.mkdir(exist_ok=True)
        Image.fromarray(image).save(self.pictures / f"step_{step:06d}.png", optimize=True)
        if self.curves is not None:
            self.curves.add_image("held out", image, step, dataformats="HWC")


def read_log(path: Path) -> list[dict[str, Any]]:
    """The lines of a log. A last line that a killed run left half written is none."""
    lines = []
    for text in path.read_text().splitlines() if path.exists() else []:
        try:
            lines.append(json.loads(text))
        except json.JSONDecodeError:
            break
    return lines


def _curves(folder: Path, step: int) -> Any:
    if importlib.util.find_spec("tensorboardX") is None:
        print("no TensorBoard curves: tensorboardX is not installed (extra `train`)")
        return None
    from tensorboardX import SummaryWriter  # pyright: ignore[reportMissingImports]

    return SummaryWriter(str(folder), purge_step=step + 1)
