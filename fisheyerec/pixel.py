"""The pixel convention in Python, the twin of csrc/geometry/pixel.h, where it is stated in full.

Integer coordinates are pixel centres: an image of width W spans [-1/2, W - 1/2].
"""

from __future__ import annotations

from typing import Any

HALF_PIXEL = 0.5  # from the centre of a pixel to its edge


def centre(size: float) -> float:
    """Give the coordinate of the middle of an image `size` pixels wide (or high)."""
    return (size - 1) / 2


def scale(coordinate: Any, factor: float) -> Any:
    """Give the coordinate of the same point once the image is `factor` times as large."""
    return (coordinate + HALF_PIXEL) * factor - HALF_PIXEL
