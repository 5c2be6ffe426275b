"""What an evaluation is shown as: a text table, JSON, a sheet of pictures."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from ..cameras import FisheyeCamera, PinholeCamera
from ..pictures import Picture, write_picture
from .evaluate import Evaluation, PictureResult, straighten
from .pairs import PairFiles, read_manifest, write_text
from .sources import read_rgb

# key of the summary, heading, format
_COLUMNS = (
    ("psnr", "PSNR dB", ".2f"),
    ("ssim", "SSIM", ".3f"),
    ("displacement_px", "displ. px", ".2f"),
    ("displacement_median_px", "median px", ".2f"),
    ("label_miou", "mIoU", ".3f"),
    ("fov_error_deg", "FOV err deg", ".1f"),
    ("ms", "ms", ".1f"),
    ("no_estimate", "no estimate", "d"),
    ("failed", "failed", "d"),
    ("count", "pictures", "d"),
)
_WITH_INTERVAL = {"psnr", "ssim", "displacement_px"}

# the sheet, in pixels
_CELL, _GAP, _MARGIN, _HEADER, _CAPTION = 224, 10, 24, 40, 26
_INK, _GREY, _PAPER = (30, 30, 30), (110, 110, 110), (255, 255, 255)


def text_table(summary: dict[str, Any]) -> str:
    """Lay out the summary of an `Evaluation` as a table, with 95 % intervals where they matter most."""
    rows = [["method", *(heading for _, heading, _ in _COLUMNS)]]
    for name, measures in summary["methods"].items():
        rows.append([name, *(_cell(measures, key, form) for key, _, form in _COLUMNS)])
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = []
    for row in rows:
        cells = [cell.rjust(width) for cell, width in zip(row, widths, strict=True)]
        lines.append("  ".join([row[0].ljust(widths[0]), *cells[1:]]).rstrip())
    return "\n".join(lines)


def write_json(path: str | os.PathLike[str], evaluation: Evaluation) -> None:
    """Write the summary, whole or not at all."""
    write_text(Path(path), json.dumps(evaluation.summary(), indent=1) + "\n")


def write_sheet(
    path: str | os.PathLike[str], folder: str | os.PathLike[str], evaluation: Evaluation, *, rows: int = 8
) -> None:
    """Write a contact sheet: for pictures spread over the folder, the input, the truth, and what each method made.

    Args:
        path: .png or .jpg.
        folder: the pairs that were evaluated.
        evaluation: what came out.
        rows: how many pictures at most.

    Raises:
        ValueError: nothing was evaluated, or an unknown suffix.
        OSError: the file cannot be written.
    """
    files = {pair.name: pair for pair in read_manifest(folder)}
    pictures = list(dict.fromkeys(result.picture for result in evaluation.results))
    if not pictures:
        raise ValueError("write_sheet(): expected evaluated pictures, got none")
    chosen = [pictures[i] for i in np.linspace(0, len(pictures) - 1, min(rows, len(pictures))).round().astype(int)]
    columns = ["fisheye", "ground truth", *evaluation.methods]
    width = 2 * _MARGIN + len(columns) * _CELL + (len(columns) - 1) * _GAP
    height = 2 * _MARGIN + _HEADER + len(chosen) * (_CELL + _CAPTION)
    sheet = Image.new("RGB", (width, height), _PAPER)
    draw = ImageDraw.Draw(sheet)
    heading, caption = ImageFont.load_default(20), ImageFont.load_default(13)
    for column, name in enumerate(columns):
        draw.text((_left(column), _MARGIN), name, _INK, heading)
    for row, picture in enumerate(chosen):
        results = [result for result in evaluation.results if result.picture == picture]
        top = _MARGIN + _HEADER + row * (_CELL + _CAPTION)
        for column, (pixels, text) in enumerate(_row(files[picture], results)):
            image = Image.fromarray(pixels).resize((_CELL, _CELL), Image.Resampling.LANCZOS)
            sheet.paste(image, (_left(column), top))
            draw.text((_left(column), top + _CELL + 4), text, _GREY, caption)
    write_picture(path, Picture(np.asarray(sheet)))


def _row(pair: PairFiles, results: list[PictureResult]) -> Iterator[tuple[np.ndarray, str]]:
    fisheye = read_rgb(pair.fisheye)
    yield fisheye, pair.kind or ""
    yield read_rgb(pair.rectified), ""
    for result in results:
        camera, view = None, pair.view
        if result.params is not None:
            camera = FisheyeCamera(result.params, pair.camera.image_size)
            view = PinholeCamera.edge_matched(camera, view.image_size)
        note = "no estimate   " if camera is None and result.method != "identity" else ""
        text = f"{note}{result.psnr:.1f} dB   {result.ssim:.2f}   {result.displacement_px:.1f} px"
        yield straighten(fisheye, camera, view)[0], text


def _left(column: int) -> int:
    return _MARGIN + column * (_CELL + _GAP)


def _cell(measures: dict[str, Any], key: str, form: str) -> str:
    value = measures[key]
    if value is None:
        return "-"
    text = format(value, form)
    if key in _WITH_INTERVAL:
        low, high = measures["intervals"][key]
        text += f" [{low:{form}}, {high:{form}}]" if low is not None else ""
    return text
