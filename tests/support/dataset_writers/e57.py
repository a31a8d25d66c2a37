"""E57 files of several posed scans, with optional colors and invalid points."""

from pathlib import Path

import numpy as np
import pye57


def write_e57(path: Path, scans: list[dict]) -> Path:
    """A scan: `points` (n, 3) in its frame; optional colors, invalid, rotation (w, x, y, z), translation."""
    with pye57.E57(str(path), mode="w") as file:
        for scan in scans:
            points = np.asarray(scan["points"], np.float64)
            data = {f"cartesian{axis}": points[:, i].copy() for i, axis in enumerate("XYZ")}
            if "colors" in scan:
                names = ("colorRed", "colorGreen", "colorBlue")
                data |= {name: scan["colors"][:, i].astype(np.uint8) for i, name in enumerate(names)}
            if "invalid" in scan:
                data["cartesianInvalidState"] = np.asarray(scan["invalid"], np.int8)
            rotation = np.asarray(scan.get("rotation", (1.0, 0, 0, 0)), np.float64)
            translation = np.asarray(scan.get("translation", (0.0, 0, 0)), np.float64)
            file.write_scan_raw(data, rotation=rotation, translation=translation)
    return path
