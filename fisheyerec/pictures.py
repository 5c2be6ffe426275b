"""Reading and writing picture files: upright, complete or not at all, with what the file says about itself kept."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import Any

import numpy as np
from PIL import ExifTags, Image, ImageOps, UnidentifiedImageError

# Panoramas of a gigapixel are legitimate input; Pillow's own limit is meant for web servers.
Image.MAX_IMAGE_PIXELS = None

_EXACT_MODES = {"L", "RGB", "RGBA"}
_WRITE_OPTIONS = {"JPEG": {"quality": 95, "subsampling": 0}, "WEBP": {"quality": 95}}


@dataclass(frozen=True)
class Picture:
    """A decoded picture."""

    pixels: np.ndarray
    """(H, W), (H, W, 3) RGB or (H, W, 4) RGBA, uint8; or (H, W) float32 holding 16 bit grey."""
    metadata: dict[str, Any] = field(default_factory=dict)
    """EXIF and ICC profile, as Pillow's save() takes them."""


def read_picture(path: str | os.PathLike[str]) -> Picture:
    """Read a picture and turn it upright as its EXIF orientation says.

    Raises:
        ValueError: not a picture, or a truncated one.
        OSError: the file cannot be read.
    """
    try:
        with Image.open(path) as image:
            image.load()
            return decode(image)
    except (UnidentifiedImageError, SyntaxError) as error:
        raise ValueError(f"read_picture(): expected a picture, got {os.fspath(path)!r} of an unknown format") from error
    except OSError as error:
        if error.filename is not None:
            raise
        raise ValueError(
            f"read_picture(): expected a complete picture, got {os.fspath(path)!r} that is broken ({error})"
        ) from error


def decode(image: Image.Image) -> Picture:
    """Turn a Pillow image upright as its EXIF orientation says, and into pixels.

    Raises:
        OSError: an image that was opened but is truncated.
    """
    upright = ImageOps.exif_transpose(image)
    exif = upright.getexif()
    exif.pop(ExifTags.Base.Orientation, None)
    metadata = {"exif": exif.tobytes() if len(exif) else None, "icc_profile": image.info.get("icc_profile")}
    if upright.mode.startswith("I"):
        pixels = np.asarray(upright, dtype=np.float32)
    else:
        has_alpha = upright.has_transparency_data
        mode = upright.mode if upright.mode in _EXACT_MODES else "RGBA" if has_alpha else "RGB"
        pixels = np.asarray(upright.convert(mode))
    return Picture(pixels, {key: value for key, value in metadata.items() if value})


def write_picture(path: str | os.PathLike[str], picture: Picture) -> None:
    """Write a picture in the format of the path's suffix; an older file is replaced at the very end or not at all.

    Raises:
        ValueError: a suffix of no known format, or pixels that the format cannot hold.
        OSError: the file cannot be written.
    """
    path = Path(path)
    picture_format = Image.registered_extensions().get(path.suffix.lower())
    if picture_format is None or picture_format not in Image.SAVE:
        raise ValueError(f"write_picture(): expected a suffix such as .jpg or .png, got {path.name!r}")
    pixels = picture.pixels
    if pixels.dtype != np.uint8:
        pixels = np.clip(np.rint(pixels), 0, 65535).astype(np.uint16)
    if picture_format == "JPEG" and pixels.shape[2:] == (4,):
        pixels = pixels[..., :3]
    image = Image.fromarray(pixels)
    try:
        temporary = NamedTemporaryFile(dir=path.parent, prefix=f".{path.name}.", delete=False)  # noqa: SIM115
    except OSError as error:  # say the name that the user gave
        raise OSError(error.errno, error.strerror, str(path)) from error
    try:
        with temporary:
            image.save(temporary, picture_format, **_WRITE_OPTIONS.get(picture_format, {}), **picture.metadata)
        os.chmod(temporary.name, 0o666 & ~_umask())
        os.replace(temporary.name, path)
    except BaseException as error:
        Path(temporary.name).unlink(missing_ok=True)
        if isinstance(error, OSError) and error.errno is None:  # Pillow's word for a mode that a format cannot hold
            raise ValueError(f"write_picture(): expected pixels that {picture_format} can hold ({error})") from error
        raise


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
