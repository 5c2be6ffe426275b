"""Label maps, masks and depth in files: numbers that are read and written as they are, never converted."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, UnidentifiedImageError

from .replacement import replacement

# Formats that keep numbers exactly -> what they hold as grey, beside bytes and truth values.
_GREY_DTYPES = {
    ".png": {"uint16"},
    ".tif": {"uint16", "int32", "float32"},
    ".tiff": {"uint16", "int32", "float32"},
    ".bmp": set[str](),
}

SUFFIXES = (*_GREY_DTYPES, ".npy")
"""Of files that can be read and written."""

_EXACT_MODES = {"1", "L", "P", "RGB", "RGBA", "I;16", "I", "F"}


@dataclass(frozen=True)
class Raster:
    """What such a file holds."""

    values: np.ndarray
    """(H, W) or (H, W, C), of the file's own type; of a picture with a palette its indices, uint8."""
    palette: list[int] | None = None
    """Red, green and blue of each index in turn, for those who look at it."""


def read_raster(path: str | os.PathLike[str]) -> Raster:
    """Read a raster.

    Raises:
        ValueError: no such file, a broken one, or one whose numbers Pillow would convert, as 16 bit colour.
        OSError: the file cannot be read.
    """
    path = Path(path)
    if path.suffix.lower() == ".npy":
        return Raster(_read_array(path))
    try:
        with Image.open(path) as image:
            is_deep_colour = image.mode in ("RGB", "RGBA") and any(";16" in str(tile) for tile in image.tile)
            if image.mode not in _EXACT_MODES or is_deep_colour:
                kind = "16 bit colour" if is_deep_colour else f"mode {image.mode}"
                raise ValueError(f"read_raster(): expected a raster of 8 bits or of one channel, got {path} of {kind}")
            palette = image.getpalette() if image.mode == "P" else None
            return Raster(np.array(image), palette)
    except (UnidentifiedImageError, SyntaxError) as error:
        raise ValueError(f"read_raster(): expected a raster, got {path} of an unknown format") from error
    except OSError as error:
        if error.filename is not None:
            raise
        raise ValueError(f"read_raster(): expected a complete raster, got {path} that is broken ({error})") from error


def _read_array(path: Path) -> np.ndarray:
    try:
        values = np.load(path, allow_pickle=False)
    except (ValueError, EOFError) as error:
        raise ValueError(f"read_raster(): expected a NumPy array, got {path} that is none ({error})") from error
    if values.ndim not in (2, 3) or values.dtype.kind not in "biuf":
        raise ValueError(
            f"read_raster(): expected numbers of shape (H, W) or (H, W, C), got {path} of {values.dtype} {values.shape}"
        )
    return np.asarray(values)


def write_raster(path: str | os.PathLike[str], raster: Raster) -> None:
    """Write a raster, whole or not at all; truth values as 0 and 255 in a picture.

    Raises:
        ValueError: another suffix, or values that its format cannot hold; see `check_holds`.
        OSError: the file cannot be written.
    """
    path, values = Path(path), raster.values
    check_holds(path, values)
    with replacement(path) as temporary, open(temporary, "xb") as stream:
        if path.suffix.lower() == ".npy":
            np.save(stream, values)
            return
        image = Image.fromarray(np.where(values, np.uint8(255), np.uint8(0)) if values.dtype == bool else values)
        if raster.palette is not None:
            image.putpalette(raster.palette)
        image.save(stream, Image.registered_extensions()[path.suffix.lower()])


def check_holds(path: Path, values: np.ndarray) -> None:
    """Raise ValueError unless files of this suffix hold these values exactly."""
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise ValueError(f"write_raster(): expected a suffix in {SUFFIXES}, got {path.name!r}")
    if suffix == ".npy":
        return
    is_grey, is_bytes = values.ndim == 2, values.dtype in (bool, np.uint8)
    is_colour = values.shape[2:] in ((3,), (4,)) and values.dtype == np.uint8
    if not (is_colour or (is_grey and (is_bytes or values.dtype.name in _GREY_DTYPES[suffix]))):
        raise ValueError(f"write_raster(): expected values that {suffix} can hold, got {values.dtype} {values.shape}")
