"""Points in CSV files: a header with x and y, a point a line, and whatever else is said of it."""

from __future__ import annotations

import csv
import math
import os
from dataclasses import dataclass

import numpy as np

from .replacement import replacement

SUFFIXES = (".csv",)
"""Of files that can be read and written."""

VALID = "valid"
"""The column that tells, by 1 or 0, which points are seen; the others have no x and y."""

_DECIMALS = 4  # px


@dataclass(frozen=True)
class PointTable:
    """What such a file holds."""

    header: list[str]
    rows: list[list[str]]
    """The cells of each line, as they were read."""
    points: np.ndarray
    """(N, 2) in pixels as (x, y), integers at pixel centres; NaN where a point is not valid."""


def read_points(path: str | os.PathLike[str]) -> PointTable:
    """Read points; one without x and y, or of which a column `valid` says 0, is NaN.

    Raises:
        ValueError: a header without x and y, or a line that does not fit it, with its number.
        OSError: the file cannot be read.
    """
    name = os.fspath(path)
    try:
        with open(path, encoding="utf-8-sig", newline="") as stream:
            reader = csv.reader(stream)
            header = [cell.strip() for cell in next(reader, [])]
            if header.count("x") != 1 or header.count("y") != 1 or header.count(VALID) > 1:
                raise ValueError(f"expected {name} with a header that names x and y once, got {','.join(header)!r:.60}")
            rows, points = [], []
            for row in reader:
                if row:
                    rows.append(row)
                    points.append(_point(header, row, f"{name}, line {reader.line_num}"))
    except (csv.Error, UnicodeDecodeError) as error:
        raise ValueError(f"expected {name} as CSV in UTF-8, got a file that is not ({error})") from error
    return PointTable(header, rows, np.array(points, dtype=np.float64).reshape(-1, 2))


def _point(header: list[str], row: list[str], where: str) -> tuple[float, float]:
    if len(row) != len(header):
        raise ValueError(f"{where}: expected {len(header)} cells as in the header, got {len(row)}")
    cells = dict(zip(header, row, strict=True))
    try:
        x, y = (float(cells[axis].strip() or math.nan) for axis in "xy")
    except ValueError:
        raise ValueError(f"{where}: expected x and y as numbers, got {cells['x']!r} and {cells['y']!r}") from None
    return (x, y) if cells.get(VALID, "1").strip() != "0" else (math.nan, math.nan)


def write_points(path: str | os.PathLike[str], table: PointTable) -> None:
    """Write points, whole or not at all: x and y to 1e-4 pixels, other columns as they were, and `valid`.

    Raises:
        OSError: the file cannot be written.
    """
    header = table.header if VALID in table.header else [*table.header, VALID]
    with replacement(path) as temporary, open(temporary, "x", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(header)
        for row, (x, y) in zip(table.rows, table.points.tolist(), strict=True):
            valid = math.isfinite(x) and math.isfinite(y)
            moved = {"x": _number(x) if valid else "", "y": _number(y) if valid else "", VALID: str(int(valid))}
            writer.writerow((dict(zip(table.header, row, strict=True)) | moved)[name] for name in header)


def _number(value: float) -> str:
    return f"{value:.{_DECIMALS}f}"
