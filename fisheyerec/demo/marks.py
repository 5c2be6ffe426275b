"""What is drawn on pictures: lines coloured by how much they bend, hatching where there is no picture."""

from __future__ import annotations

import cv2
import numpy as np

# Bend in % of a line's length, and the colour of such a line: green is as straight as photographs without distortion.
_BENDS = (0.15, 0.45, 1.2)
_COLOURS = np.array([(52, 211, 153), (251, 191, 36), (248, 72, 72)], dtype=np.float64)
_OUTLINE = (15, 23, 42)
_FRACTION_BITS = 4  # of the positions that OpenCV draws at

_STRIPE = 8  # px
_STRIPES = np.array([(51, 65, 85), (71, 85, 105)], dtype=np.uint8)


def draw_lines(picture: np.ndarray, points: np.ndarray, starts: np.ndarray, bends: np.ndarray) -> np.ndarray:
    """Draw lines on a copy of a picture.

    Args:
        picture: (h, w, 3) uint8.
        points: (N, 2) in its pixels; NaN where a line is interrupted.
        starts: (K + 1,) the points of line i are starts[i] to starts[i + 1].
        bends: (K,) in % of each line's length; lines of NaN are left out.

    Returns:
        (h, w, 3) uint8.
    """
    drawn = picture.copy()
    width = max(picture.shape[:2]) / 480
    shown = [i for i in np.argsort(bends) if np.isfinite(bends[i])]  # the most bent come last, on top
    runs = [(_runs(points[starts[i] : starts[i + 1]]), _colour(bends[i])) for i in shown]
    for thickness, outlined in ((width + 2, True), (width, False)):
        for lines, colour in runs:
            cv2.polylines(
                drawn,
                lines,
                False,
                _OUTLINE if outlined else colour,
                max(1, round(thickness)),
                cv2.LINE_AA,
                _FRACTION_BITS,
            )
    return drawn


def hatch(picture: np.ndarray, where: np.ndarray) -> np.ndarray:
    """Lay diagonal stripes over part of a picture: (h, w, 3) uint8, (h, w) bool -> (h, w, 3)."""
    height, width = where.shape
    diagonal = np.arange(height)[:, None] + np.arange(width)
    return np.where(where[..., None], _STRIPES[diagonal // _STRIPE % 2], picture)


def _runs(points: np.ndarray) -> list[np.ndarray]:
    """Cut a line where points are missing, in OpenCV's fixed-point positions."""
    known = np.isfinite(points).all(-1)
    fixed = np.rint(np.where(known[:, None], points, 0) * 2**_FRACTION_BITS).astype(np.int32)
    ends = np.nonzero(np.diff(known))[0] + 1
    return [fixed[run] for run in np.split(np.arange(len(points)), ends) if known[run[0]] and len(run) > 1]


def _colour(bend: float) -> tuple[float, ...]:
    return tuple(float(np.interp(bend, _BENDS, channel)) for channel in _COLOURS.T)
