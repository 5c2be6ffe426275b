"""OCamCalib's calib_results.txt; source: its export_data.m and cam2world.

OCamCalib counts rows first: its x runs down, its y to the right, and its z out of the back of the camera. Hence
row - row0 = c x + d y, column - column0 = e x + y, and the polynomial changes its sign.
"""

from __future__ import annotations

import re

from .entries import Section
from .record import OCAM, Lens, with_zeros


def is_ocamcalib(text: str) -> bool:
    """Whether the text begins as export_data.m begins it."""
    return re.match(r"\s*#\s*polynomial coefficients for the DIRECT mapping", text) is not None


def parse_ocamcalib(text: str) -> Lens:
    """calib_results.txt; raises ValueError unless it holds its five lines of numbers."""
    names = ("polynomial", "inverse polynomial", "center", "affine parameters", "image size")
    lines = [line.split() for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    if len(lines) != len(names):
        raise ValueError(f"expected {len(names)} lines of numbers: {', '.join(names)}; got {len(lines)}")
    file = Section(dict(zip(names, lines, strict=True)))
    count, *polynomial = file.numbers("polynomial")
    if count != len(polynomial):
        raise ValueError(
            f"polynomial: expected {count:g} coefficients, as its first number says, got {len(polynomial)}"
        )
    row, column = file.numbers("center", count=2)
    c, d, e = file.numbers("affine parameters", count=3)
    height, width = file.numbers("image size", count=2)
    params = [column, row, 1.0, e, d, c, *(-a for a in polynomial)]
    return Lens(OCAM, (width, height), with_zeros(OCAM, params))
