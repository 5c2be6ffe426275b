"""How straight does the one call make real chessboards of a lens that it is not told?

    python benchmarks/blind_chessboards.py FOLDER... [--every N] [--json FILE]

A FOLDER holds camera.json, corners.json and images/. For each picture alone, `Rectifier.estimate` finds a camera; the
board's known corners are lifted through it, and what is reported is the distance of the corners of one row or column
from their best straight line, RMS, in percent of the line's length, over lines within 75 degrees of the axis. Beside
it: the picture as it is, the calibrated camera, and the network without the refinement on lines.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
from chessboards import bends

from fisheyerec import FisheyeCamera, Rectifier

THETA_MAX = math.radians(75)


def bend_percent(corners: np.ndarray, camera: FisheyeCamera | None) -> np.ndarray:
    """Give the bend of each line of a board (rows, columns, 2) in percent, under a camera or as it is."""
    if camera is not None:
        rays, seen = camera.unproject(corners)
        corners = rays[..., :2] / rays[..., 2:]
        corners[~(seen & (rays[..., 2] > math.cos(THETA_MAX)))] = np.nan
    keep = [line for lines in (corners, corners.swapaxes(0, 1)) for line in lines if np.isfinite(line).all()]
    measured = [bends_of_line(line) for line in keep]
    return 100 * np.array(measured)


def bends_of_line(line: np.ndarray) -> float:
    """Give the RMS distance of points (N, 2) from their best straight line, in units of its length."""
    distance, length = bends(np.stack([line, line]))[0]
    return float(distance / length)


def measure(folder: Path, rectifier: Rectifier, every: int) -> dict[str, object]:
    """Measure a folder's pictures, one camera for each."""
    data = json.loads((folder / "corners.json").read_text())
    columns, rows = data["pattern_inner_corners"]
    calibrated = FisheyeCamera.load(folder / "camera.json")
    pictures = [path for path in sorted((folder / "images").iterdir()) if path.name in data["corners"]][::every]
    contenders: dict[str, Callable[[Path], FisheyeCamera | None]] = {
        "raw": lambda path: None,
        "network": lambda path: rectifier.estimate(path, refine=False).camera,
        "one_call": lambda path: rectifier.estimate(path).camera,
        "calibrated": lambda path: calibrated,
    }
    record: dict[str, object] = {"folder": folder.name, "pictures": len(pictures)}
    for name, camera_of in contenders.items():
        lines = [
            bend_percent(np.reshape(data["corners"][path.name], (rows, columns, 2)).astype(float), camera_of(path))
            for path in pictures
        ]
        record[name] = float(np.sqrt((np.concatenate(lines) ** 2).mean()))
        record[f"{name}_median"] = float(np.median([np.sqrt((board**2).mean()) for board in lines]))
    return record


def main() -> None:
    """Measure and print a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--every", type=int, default=1, help="take every N-th picture")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    rectifier = Rectifier.from_pretrained()
    records = [measure(folder, rectifier, arguments.every) for folder in arguments.folders]
    print("| pictures | raw | network alone | one call | calibrated |\n|---|---|---|---|---|")
    for r in records:
        cells = (f"{r[name]:.2f} ({r[f'{name}_median']:.2f})" for name in ("raw", "network", "one_call", "calibrated"))
        print(f"| {r['folder']}, {r['pictures']} | " + " | ".join(cells) + " |")
    if arguments.json:
        arguments.json.write_text(json.dumps(records, indent=1) + "\n")


if __name__ == "__main__":
    main()
