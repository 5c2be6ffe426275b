"""What was measured, one line a picture and method, as CSV and back; what is not known is empty."""

from __future__ import annotations

import csv
import gzip
import io
import math
import os
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from ..cameras import FisheyeCamera
from .evaluate import PictureResult
from .pairs import write_bytes

_NUMBERS = (
    "psnr",
    "ssim",
    "psnr_valid",
    "ssim_valid",
    "valid",
    "displacement_px",
    "displacement_median_px",
    "label_miou",
    "fov_error_deg",
    "ms",
)
_PARAMETERS = FisheyeCamera.parameter_names
_ERRORS = tuple(f"{name}_error" for name in _PARAMETERS)
_COLUMNS = ("picture", "source", "kind", "method", *_NUMBERS, *_PARAMETERS, *_ERRORS, "error")

HEADER = ",".join(_COLUMNS) + "\n"


def to_csv(results: Iterable[PictureResult]) -> str:
    """Give the lines of results, without HEADER; numbers to six digits."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    for result in results:
        params = [math.nan] * len(_PARAMETERS) if result.params is None else result.params.tolist()
        numbers = [getattr(result, name) for name in _NUMBERS]
        values = [*numbers, *params, *(result.parameter_errors[name] for name in _PARAMETERS)]
        known = ["" if math.isnan(value) else f"{value:.6g}" for value in values]
        writer.writerow([result.picture, result.source, result.kind or "", result.method, *known, result.error or ""])
    return stream.getvalue()


def from_csv(text: str) -> list[PictureResult]:
    """Read what HEADER and `to_csv` make.

    Raises:
        ValueError: another header, or a line that is not as above; the message tells which.
    """
    lines = text.splitlines()
    if not lines or lines[0] + "\n" != HEADER:
        raise ValueError(f"expected the columns {HEADER.strip()}, got {lines[0] if lines else 'nothing':.200}")
    results = []
    for number, fields in enumerate(csv.reader(lines[1:]), 2):
        try:
            results.append(_result(dict(zip(_COLUMNS, fields, strict=True))))
        except ValueError as error:
            raise ValueError(f"line {number}: {error}") from error
    return results


def write_records(path: str | os.PathLike[str], results: Iterable[PictureResult]) -> None:
    """Write results, compressed where the name ends in .gz; whole or not at all."""
    path = Path(path)
    content = (HEADER + to_csv(results)).encode()
    # No time stamp: the same results are the same bytes.
    write_bytes(path, gzip.compress(content, mtime=0) if path.suffix == ".gz" else content)


def read_records(path: str | os.PathLike[str]) -> list[PictureResult]:
    """Read results, compressed where the name ends in .gz.

    Raises:
        ValueError: another file, or a broken one.
        OSError: the file cannot be read.
    """
    content = Path(path).read_bytes()
    try:
        return from_csv((gzip.decompress(content) if Path(path).suffix == ".gz" else content).decode())
    except (ValueError, EOFError, gzip.BadGzipFile) as error:
        raise ValueError(f"{os.fspath(path)}: {error}") from error


def _result(fields: dict[str, str]) -> PictureResult:
    def number(column: str) -> float:
        return float(fields[column]) if fields[column] else math.nan

    params = np.array([number(name) for name in _PARAMETERS])
    return PictureResult(
        picture=fields["picture"],
        source=fields["source"],
        kind=fields["kind"] or None,
        method=fields["method"],
        params=None if np.isnan(params).any() else params,
        error=fields["error"] or None,
        **{name: number(name) for name in _NUMBERS},
        parameter_errors={name: number(error) for name, error in zip(_PARAMETERS, _ERRORS, strict=True)},
    )
