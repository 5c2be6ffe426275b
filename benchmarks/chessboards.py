"""How straight do real chessboards become? Finds the corners in each picture before and after rectification.

    python benchmarks/chessboards.py FOLDER... [--json FILE]

A FOLDER holds camera.json, corners.json ("pattern_inner_corners": [columns, rows]) and images/. The pictures are
rectified by the command line into a view that keeps the whole board, and OpenCV looks for the board again. Reported:
the distance of the corners of one row or column of the board from their best straight line, RMS, in pixels and in
percent of the line's length.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np

BALANCE = 0.5


def find_corners(picture: Path, pattern: tuple[int, int]) -> np.ndarray | None:
    """Give the board's inner corners (rows, columns, 2), or None where the board is not seen whole."""
    grey = cv2.imread(str(picture), cv2.IMREAD_GRAYSCALE)
    flags = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
    found, corners = cv2.findChessboardCornersSB(grey, pattern, flags=flags)
    return corners.reshape(pattern[1], pattern[0], 2).astype(np.float64) if found else None


def bends(corners: np.ndarray) -> np.ndarray:
    """Give (lines, 2): each line's RMS distance from straight in pixels, and its length in pixels."""
    results = []
    for lines in (corners, corners.swapaxes(0, 1)):
        for line in lines:
            centred = line - line.mean(0)
            _, singular_values, _ = np.linalg.svd(centred)
            length = np.linalg.norm(line[-1] - line[0])
            results.append((singular_values[1] / np.sqrt(len(line)), length))
    return np.array(results)


def measure(folder: Path) -> dict[str, object]:
    """Rectify a folder's pictures and measure the boards that are found both before and after."""
    columns, rows = json.loads((folder / "corners.json").read_text())["pattern_inner_corners"]
    pictures = sorted((folder / "images").iterdir())
    before, after = [], []
    with tempfile.TemporaryDirectory() as out:
        command = [sys.executable, "-m", "fisheyerec.cli", "rectify", *map(str, pictures)]
        command += ["--camera", str(folder / "camera.json"), "--balance", str(BALANCE), "-o", out]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        for picture in pictures:
            found = [find_corners(path, (columns, rows)) for path in (picture, Path(out) / picture.name)]
            if found[0] is not None and found[1] is not None:
                before.append(bends(found[0]))
                after.append(bends(found[1]))

    def rms(lines: np.ndarray) -> tuple[float, float]:
        return float(np.sqrt((lines[:, 0] ** 2).mean())), float(
            100 * np.sqrt(((lines[:, 0] / lines[:, 1]) ** 2).mean())
        )

    raw, straight = rms(np.concatenate(before)), rms(np.concatenate(after))
    return {
        "folder": folder.name,
        "pictures": len(pictures),
        "boards": len(before),
        "raw_px": raw[0],
        "raw_percent": raw[1],
        "rectified_px": straight[0],
        "rectified_percent": straight[1],
    }


def main() -> None:
    """Measure and print a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    records = [measure(folder) for folder in arguments.folders]
    print("| pictures | boards found | raw, px (%) | rectified, px (%) |\n|---|---|---|---|")
    for r in records:
        print(
            f"| {r['folder']} | {r['boards']} of {r['pictures']} | {r['raw_px']:.2f} ({r['raw_percent']:.2f}) "
            f"| {r['rectified_px']:.2f} ({r['rectified_percent']:.2f}) |"
        )
    if arguments.json:
        arguments.json.write_text(json.dumps(records, indent=1) + "\n")


if __name__ == "__main__":
    main()
