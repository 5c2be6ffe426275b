"""Reads and writes lens files: the house's JSON and YAML, OpenCV, ROS, kalibr, COLMAP, gyroflow...

Every format is read into one plain record, `CameraFile`, in the house's order and pixel convention
(integer coordinates are pixel centres). Formats are told apart by what a file holds, not by its
suffix. Nothing here knows about tensors or cameras, and PyYAML is imported only where YAML is met.

Every reader may give a model that the house converts (`lens_models.py`); written are fisheye lenses and pinholes, and
in the house's own format its other views.
A new format is one file of this folder and one row of each table below that it has a part in.
"""

from __future__ import annotations

import os
import textwrap
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from ..replacement import replacement
from .adapter import parse_adapter
from .camodocal import parse_camodocal
from .colmap import COLMAP_PIXEL_CENTRE, colmap_text, is_colmap, parse_colmap
from .entries import Section, load_entries, read_text
from .gyroflow import gyroflow_text, parse_gyroflow
from .house import house_text, parse_house
from .kalibr import kalibr_cameras, kalibr_text, parse_kalibr
from .ocamcalib import is_ocamcalib, parse_ocamcalib
from .opencv import has_camera_matrix, opencv_text, parse_opencv, ros_text
from .record import HOUSE_MODELS, KANNALA_BRANDT, PINHOLE, CameraFile, Lens, checked, listed, other_model

__all__ = ["COLMAP_PIXEL_CENTRE", "WRITERS", "CameraFile", "read_camera_file", "write_camera_file"]

# A message may quote the file: it stays one readable line even where that holds a page of text.
_MAX_MESSAGE = 400


class _TextReader(NamedTuple):
    recognises: Callable[[str], bool]
    parse: Callable[[str], Lens]


class _Reader(NamedTuple):
    name: str
    recognises: Callable[[Section], object]
    parse: Callable[[Section], Lens]


class _Writer(NamedTuple):
    suffixes: tuple[str, ...]
    text: Callable[[CameraFile, str], str]
    models: tuple[str, ...] = (KANNALA_BRANDT, PINHOLE)


_TEXT_READERS = (_TextReader(is_colmap, parse_colmap), _TextReader(is_ocamcalib, parse_ocamcalib))

# Of JSON and YAML. The first row that recognises a file reads it. The house's comes last: `model` is a common word.
_READERS = (
    _Reader("gyroflow profile", lambda file: "fisheye_params" in file, parse_gyroflow),
    _Reader("kalibr camchain", kalibr_cameras, parse_kalibr),
    _Reader("OpenCV or ROS (camera_matrix)", has_camera_matrix, parse_opencv),
    _Reader("camodocal (model_type)", lambda file: "model_type" in file, parse_camodocal),
    _Reader("fisheye-calib-adapter", lambda file: "parameter" in file, parse_adapter),
    _Reader("fisheyerec (model, fx)", lambda file: "model" in file or "fx" in file, parse_house),
)

WRITERS = {
    "fisheyerec": _Writer((".json", ".yaml", ".yml"), house_text, HOUSE_MODELS),
    "opencv": _Writer((".yml", ".yaml", ".json"), opencv_text),
    "kalibr": _Writer((".yaml", ".yml"), kalibr_text),
    "colmap": _Writer((".txt",), colmap_text),
    "gyroflow": _Writer((".json",), gyroflow_text),
    "ros": _Writer((".yaml", ".yml"), ros_text),
}
"""By the name of the format: the suffixes its files have, the text of one, and the models it holds."""


def read_camera_file(path: str | os.PathLike[str], *, image_size: tuple[int, int] | None = None) -> CameraFile:
    """Reads a camera from a lens file of any known format.

    `image_size` is (height, width); it is used only where the file does not hold the size.

    Raises ValueError, in one line naming the file and the key, if the file is not text, not a known
    format, misses a key, holds a value that makes no camera, or an unknown lens model; RuntimeError if
    it is YAML and PyYAML is not installed; OSError if the file cannot be read.
    """
    with _named_errors("read_camera_file", path):
        lens = _parse(read_text(path))
        width, height = lens.size or _given_size(image_size)
        return checked(lens.model, width, height, lens.params)


def write_camera_file(path: str | os.PathLike[str], camera_file: CameraFile, *, format: str = "fisheyerec") -> None:
    """Writes a camera in a format of `WRITERS`, the house's being exact to the last bit.

    The file appears whole or not at all: an older file of that name stays until the new one is
    complete.

    Raises ValueError for an unknown format, a suffix it does not have, a model that it cannot hold, or a
    record that makes no camera; RuntimeError if it is YAML and PyYAML is not installed; OSError if the file
    cannot be written.
    """
    with _named_errors("write_camera_file", path):
        if format not in WRITERS:
            raise ValueError(f"format: expected one of {', '.join(WRITERS)}, got {format!r}")
        suffixes, text, models = WRITERS[format]
        suffix = Path(path).suffix.lower()
        if suffix not in suffixes:
            raise ValueError(f"suffix: expected {', '.join(suffixes)}, got {suffix!r}")
        if camera_file.model not in models:
            raise other_model(camera_file.model, models)
        written = text(checked(camera_file.model, camera_file.width, camera_file.height, camera_file.params), suffix)
    with replacement(path) as temporary:
        temporary.write_text(written, encoding="utf-8", newline="\n")


@contextmanager
def _named_errors(function: str, path: str | os.PathLike[str]) -> Iterator[None]:
    """Puts the function and the file before an error's message, and keeps it on one line."""
    try:
        yield
    except (ValueError, RuntimeError) as error:
        message = textwrap.shorten(str(error), _MAX_MESSAGE, placeholder=" ...")
        kind = RuntimeError if isinstance(error, RuntimeError) else ValueError
        raise kind(f"{function}(): {os.fspath(path)!r}: {message}") from None


def _parse(text: str) -> Lens:
    """Parses the text of a lens file of any format; raises ValueError if it is none."""
    for reader in _TEXT_READERS:
        if reader.recognises(text):
            return reader.parse(text)
    entries = load_entries(text)
    if entries is None:  # no character, or nothing but comments
        raise ValueError("expected a camera, got an empty file")
    file = Section(entries)
    for kind in _READERS:
        if kind.recognises(file):
            return kind.parse(file)
    known = ", ".join(kind.name for kind in _READERS)
    got = listed(file.entries)
    raise ValueError(f"expected a COLMAP cameras.txt, OCamCalib's text or the keys of one of: {known}; got {got}")


def _given_size(image_size: tuple[int, int] | None) -> tuple[int, int]:
    """(width, height) of the caller's (height, width); raises ValueError if there is none."""
    if image_size is None:
        raise ValueError(
            "expected image_size=(height, width), as the file holds no size, got None; "
            "`fisheyerec convert FILE --size WIDTHxHEIGHT -o lens.json` makes one that does"
        )
    if len(image_size) != 2:
        raise ValueError(f"image_size: expected (height, width), got {image_size!r:.60}")
    height, width = image_size
    return width, height
