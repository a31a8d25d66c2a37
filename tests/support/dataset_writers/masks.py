"""Predicted masks as Mask3D writes them for the ScanNet benchmark."""

from pathlib import Path

import numpy as np


def write_masks(file: Path, masks: np.ndarray, classes, scores) -> Path:
    """`masks` (n, k). Writes `<scene>.txt` and `pred_mask/<scene>_000.txt` …"""
    (file.parent / "pred_mask").mkdir(parents=True, exist_ok=True)
    lines = []
    for k, (name, score) in enumerate(zip(classes, scores, strict=True)):
        mask = f"pred_mask/{file.stem}_{k:03d}.txt"
        (file.parent / mask).write_text("".join(f"{int(v)}\n" for v in masks[:, k]))
        lines.append(f"{mask} {name} {score}\n")
    file.write_text("".join(lines))
    return file
