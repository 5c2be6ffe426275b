"""Reading and writing picture files: upright, complete or not at all, with what the file says about itself kept."""

from __future__ import annotations

import os
import struct
import zlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from PIL import ExifTags, Image, UnidentifiedImageError

from .replacement import replacement

# Panoramas of a gigapixel are legitimate input; Pillow's own limit is meant for web servers.
Image.MAX_IMAGE_PIXELS = None

PICTURE_SUFFIXES = frozenset(
    [".jpg", ".jpeg", ".jpe", ".jfif", ".png", ".webp", ".tif", ".tiff", ".bmp", ".ppm", ".pgm", ".jp2", ".avif"]
)
"""What a folder is searched for."""

DEFAULT_QUALITY = 95
"""Of JPEG, WebP and AVIF, from 1 to 100."""

_EXACT_MODES = {"L", "RGB", "RGBA"}
_OTHER_COLOURS = {"CMYK", "LAB", "LA"}  # whose profile says nothing about the RGB they are read as
_WITH_QUALITY = {"JPEG", "WEBP", "AVIF"}
_SIXTEEN_BIT_GREY = {"PNG", "TIFF", "PPM", "JPEG2000"}
_SIXTEEN_BIT_COLOUR = {"PNG", "TIFF"}  # Pillow knows no such pixels, OpenCV does
_PNG_HEADER = 33  # bytes of the signature and the first chunk

# TIFF keeps how its pixels are stored among what EXIF says; another file stores them in its own way.
_TIFF_STORAGE = {254, 255, 256, 257, 258, 259, 262, 266, 273, 277, 278, 279, 284, 317, 320, 322, 323, 324, 325, 330}
_TIFF_STORAGE |= {338, 339, 347, 530, 531, 532, ExifTags.Base.InterColorProfile}


@dataclass(frozen=True)
class Picture:
    """A decoded picture."""

    pixels: np.ndarray
    """(H, W), (H, W, 3) RGB or (H, W, 4) RGBA: uint8 or uint16."""
    metadata: dict[str, Any] = field(default_factory=dict)
    """EXIF and ICC profile, as Pillow's save() takes them."""


def read_picture(path: str | os.PathLike[str]) -> Picture:
    """Read a picture and turn it upright as its EXIF orientation says.

    Raises:
        ValueError: not a picture, a truncated one, one of floating numbers, or one of several frames or pages.
        OSError: the file cannot be read.
    """
    try:
        with Image.open(path) as image:
            if image.mode == "F":
                raise ValueError(f"read_picture(): expected whole numbers, got {os.fspath(path)!r} of floating ones")
            # Beside the photo, cameras put its preview into one file (MPO).
            frames = 1 if image.format == "MPO" else getattr(image, "n_frames", 1)
            if frames > 1:
                raise ValueError(f"read_picture(): expected one picture, got {os.fspath(path)!r} of {frames} frames")
            has_deep_colour = image.mode in ("RGB", "RGBA") and any(";16" in str(tile) for tile in image.tile)
            image.load()
            if has_deep_colour:
                return _described(image, _deep_colour(path))
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
    """Turn a Pillow image into pixels, upright as its EXIF orientation says.

    Raises:
        ValueError: an image of floating numbers.
        OSError: an image that was opened but is truncated.
    """
    if image.mode == "F":
        raise ValueError("decode(): expected an image of whole numbers, got one of floating ones")
    image.load()
    if image.mode.startswith("I"):
        return _described(image, np.asarray(image).clip(0, 65535).astype(np.uint16))
    mode = image.mode if image.mode in _EXACT_MODES else "RGBA" if image.has_transparency_data else "RGB"
    return _described(image, np.asarray(image.convert(mode)))


def write_picture(path: str | os.PathLike[str], picture: Picture, *, quality: int | None = None) -> None:
    """Write a picture in the format of the path's suffix; an older file is replaced at the very end or not at all.

    EXIF is told the picture's size. What a format cannot hold is left out: alpha in JPEG, more than 8 bits in JPEG,
    WebP, AVIF and BMP, EXIF and ICC profile in BMP, and beside 16 bit colour in TIFF.

    Args:
        path: where to; the suffix names the format.
        picture: (H, W), (H, W, 3) or (H, W, 4), uint8 or uint16.
        quality: from 1 to 100, of JPEG, WebP and AVIF; None for 95.

    Raises:
        ValueError: a suffix of no known format, pixels that the format cannot hold, or another quality.
        OSError: the file cannot be written.
    """
    path = Path(path)
    picture_format = picture_format_of(path)
    if quality is not None and not 1 <= quality <= 100:
        raise ValueError(f"write_picture(): expected quality in [1, 100], got {quality}")
    pixels = picture.pixels
    if picture_format == "JPEG" and pixels.shape[2:] == (4,):
        pixels = pixels[..., :3]
    is_colour = pixels.ndim == 3
    deep_formats = _SIXTEEN_BIT_COLOUR if is_colour else _SIXTEEN_BIT_GREY
    if pixels.dtype == np.uint16 and picture_format not in deep_formats:
        pixels = np.rint(pixels / 257).astype(np.uint8)
    metadata = _resized(picture.metadata, pixels.shape[:2])
    options: dict[str, Any] = {"quality": quality or DEFAULT_QUALITY} if picture_format in _WITH_QUALITY else {}
    if picture_format == "JPEG":
        options["subsampling"] = 0
    with replacement(path) as temporary, open(temporary, "xb") as stream:
        if is_colour and pixels.dtype == np.uint16:
            stream.write(_deep_colour_file(picture_format, pixels, metadata))
            return
        try:
            Image.fromarray(pixels).save(stream, picture_format, **options, **metadata)
        except OSError as error:
            if error.errno is None:  # Pillow's word for a mode that a format cannot hold
                raise ValueError(
                    f"write_picture(): expected pixels that {picture_format} can hold ({error})"
                ) from error
            raise


def picture_format_of(path: Path) -> str:
    """Give Pillow's name of the format that a suffix stands for.

    Raises:
        ValueError: a suffix of no format that can be written.
    """
    picture_format = Image.registered_extensions().get(path.suffix.lower())
    if picture_format is None or picture_format not in Image.SAVE:
        raise ValueError(f"write_picture(): expected a suffix such as .jpg or .png, got {path.name!r}")
    return picture_format


def _described(image: Image.Image, pixels: np.ndarray) -> Picture:
    """Turn the pixels of an image upright, and keep what it says about itself but that they lay otherwise.

    The image must be loaded: Pillow and OpenCV both turn a TIFF themselves, and Pillow forgets its orientation then.
    """
    exif = image.getexif()
    orientation = exif.pop(ExifTags.Base.Orientation, 1)
    if image.format == "TIFF":
        for tag in _TIFF_STORAGE & set(exif):
            del exif[tag]
    icc_profile = None if image.mode in _OTHER_COLOURS else image.info.get("icc_profile")
    metadata = {"exif": exif.tobytes() if len(exif) else None, "icc_profile": icc_profile}
    pixels = np.ascontiguousarray(_upright(pixels, orientation))
    return Picture(pixels, {key: value for key, value in metadata.items() if value})


def _upright(pixels: np.ndarray, orientation: int) -> np.ndarray:
    """Undo an EXIF orientation, which says on which sides of the scene the first row and the first column lie."""
    if orientation in (5, 6, 7, 8):
        pixels = pixels.swapaxes(0, 1)
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    return pixels


def _resized(metadata: dict[str, Any], size: tuple[int, int]) -> dict[str, Any]:
    """Tell EXIF the size of the picture where it speaks of one."""
    if "exif" not in metadata:
        return metadata
    exif = Image.Exif()
    exif.load(metadata["exif"])
    details = exif.get_ifd(ExifTags.IFD.Exif)
    for tag, side in ((ExifTags.Base.ExifImageWidth, size[1]), (ExifTags.Base.ExifImageHeight, size[0])):
        if tag in details:
            details[tag] = side
    return metadata | {"exif": exif.tobytes()}


def _deep_colour(path: str | os.PathLike[str]) -> np.ndarray:
    """Read 16 bit colour, which Pillow would cut to 8: (H, W, 3) or (H, W, 4) uint16."""
    import cv2

    pixels = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None or pixels.dtype != np.uint16 or pixels.ndim != 3:
        raise ValueError(f"read_picture(): expected 16 bit colour as OpenCV reads it, got {os.fspath(path)!r}")
    order = cv2.COLOR_BGRA2RGBA if pixels.shape[2] == 4 else cv2.COLOR_BGR2RGB
    return np.asarray(cv2.cvtColor(pixels, order))


def _deep_colour_file(picture_format: str, pixels: np.ndarray, metadata: dict[str, Any]) -> bytes:
    """Encode uint16 colour as PNG or TIFF."""
    import cv2

    order = cv2.COLOR_RGBA2BGRA if pixels.shape[2] == 4 else cv2.COLOR_RGB2BGR
    _, encoded = cv2.imencode(f".{picture_format.lower()}", cv2.cvtColor(pixels, order))
    data = encoded.tobytes()
    if picture_format == "PNG":
        chunks = b""
        if "icc_profile" in metadata:
            chunks += _png_chunk(b"iCCP", b"ICC Profile\0\0" + zlib.compress(metadata["icc_profile"]))
        if "exif" in metadata:
            chunks += _png_chunk(b"eXIf", metadata["exif"].removeprefix(b"Exif\0\0"))
        data = data[:_PNG_HEADER] + chunks + data[_PNG_HEADER:]
    return data


def _png_chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
