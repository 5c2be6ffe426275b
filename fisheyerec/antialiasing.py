"""Averaging where a picture shrinks, so that texture finer than a pixel fades instead of turning into coarse patterns.

The target is made larger, so that each step between its pixels is at most _STEP source pixels, and averaged down: every
pixel is the mean over its own footprint, whatever the lens makes of that. Where this would take more than _MAX_FACTOR
times the size, a source that shrinks everywhere is averaged down first; that is sooner done, and less exact.

    levels -> (shrink, factor)          numbers, of the cameras alone
    reduce the image by shrink -> resample into each of the bands -> reduce by factor
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import TypeVar

import numpy as np

from . import pixel
from .cameras import Camera

C = TypeVar("C", bound=Camera)

# Against 64 samples a pixel this costs about 51 dB at 5 samples a pixel on average; steps of 2 cost 45 dB at 3.
_STEP = 1.5
_MAX_FACTOR = 8
# Of an enlarged target, as many pixels at a time.
_BAND = 1 << 23


def levels(source: Camera, target: Camera, source_from_target: np.ndarray | None) -> tuple[int, int]:
    """Choose how a picture is resampled with averaging.

    Args:
        source: the camera that took it; one.
        target: the camera to see it through; one.
        source_from_target: (3, 3) rotation of the target's rays into the source's frame; None for none.

    Returns:
        How many times the source is to be averaged down first, and how many times as large the target is to be made.
    """
    source, target = source.numpy(), target.numpy()

    def look_up(rays: np.ndarray) -> np.ndarray:
        points, _ = source.project(rays if source_from_target is None else rays @ source_from_target.T)
        # Lens maps run wild outside the picture. Somewhat outside still counts, as steps are looked up here and there.
        height, width = source.image_size
        centre, reach = [pixel.centre(width), pixel.centre(height)], np.array([width, height]) * 9 / 16
        near = (np.abs(points - centre) <= reach).all(-1)
        return np.where(near[..., None], points, np.nan)

    smallest, largest = steps(target, look_up)
    shrink = max(1, min(int(smallest), math.ceil(largest / (_STEP * _MAX_FACTOR))))
    return shrink, oversampling(largest / shrink)


def bands(target: C, factor: int, count: int = 1) -> Iterator[C]:
    """Cut a camera whose picture is `factor` times as large into bands of whole rows of the target, of limited size.

    Args:
        target: the camera, of any kind of parameters.
        factor: how many times as large its picture is to be.
        count: how many pictures are made at once.
    """
    height, width = target.image_size
    enlarged = target.resize((factor * height, factor * width))
    rows = max(1, _BAND // (factor * factor * width * count))
    for top in range(0, height, rows):
        yield enlarged.crop(0, factor * top, (factor * min(rows, height - top), factor * width))


def shrunk_camera(camera: C, factor: int) -> C:
    """Give the camera that took a picture averaged down by `reduce`."""
    height, width = camera.image_size
    return type(camera)(camera.scale(1 / factor).params, (math.ceil(height / factor), math.ceil(width / factor)))


def shrunk(image: np.ndarray, camera: C, factor: int) -> tuple[np.ndarray, C]:
    """Give a picture averaged down, and the camera that took it so."""
    return reduce(image, factor), shrunk_camera(camera, factor)


def steps(target: Camera, look_up: Callable[[np.ndarray], np.ndarray]) -> tuple[float, float]:
    """Give how far, at least and at most, neighbouring pixels of the target lie apart in the source; 1 if nowhere.

    Args:
        target: the camera whose pixels they are.
        look_up: rays (..., 3) of the target to points (..., 2) of the source, NaN where there are none.
    """
    height, width = target.image_size
    stride = max(1, max(height, width) // 16)
    points = np.stack(np.meshgrid(np.arange(0.0, width, stride), np.arange(0.0, height, stride)), -1)
    beside = np.array([(0, 0), (1, 0), (0, 1)])[:, None, None]
    here, right, below = look_up(target.unproject(points + beside)[0])
    lengths = np.linalg.norm(np.stack([right - here, below - here]), axis=-1)
    lengths = lengths[np.isfinite(lengths)]
    return (float(lengths.min()), float(lengths.max())) if len(lengths) else (1.0, 1.0)


def oversampling(step: float) -> int:
    """Give how many times as large a picture is to be made whose steps in its source are this long."""
    return max(1, min(math.ceil(step / _STEP), _MAX_FACTOR))


def reduce(image: np.ndarray, factor: int) -> np.ndarray:
    """Average blocks of pixels, the last ones of a row or column over what there is.

    Args:
        image: (H, W, ...), uint8, uint16 or floating.
        factor: how many pixels a block is wide and high.

    Returns:
        (ceil(H / factor), ceil(W / factor), ...) of the same dtype; uint8 and uint16 are rounded half up.
    """
    if factor == 1:
        return image
    height, width = image.shape[:2]
    dtype = np.promote_types(image.dtype, np.float32)
    if image.dtype == np.uint8:
        dtype = np.dtype(np.uint16 if factor <= 8 else np.uint32)  # for twice the sum of a block and its count
    across = image[::factor].astype(dtype)
    for row in range(1, factor):
        part = image[row::factor]
        across[: len(part)] += part
    across = across.reshape(len(across), width, -1)
    total = np.zeros((len(across), math.ceil(width / factor), across.shape[2]), dtype)
    # NumPy's innermost loop runs over the channels, which is slow for few: those go one by one.
    for channels in range(across.shape[2]) if across.shape[2] < 16 else [slice(None)]:
        for column in range(factor):
            part = across[:, column::factor, channels]
            total[:, : part.shape[1], channels] += part
    total = total.reshape(*total.shape[:2], *image.shape[2:])
    count: np.ndarray = np.asarray(factor * factor, dtype)
    if height % factor or width % factor:
        rows, columns = (np.minimum(factor, size - np.arange(0, size, factor)) for size in (height, width))
        count = np.multiply.outer(rows, columns).reshape(len(rows), len(columns), *[1] * (image.ndim - 2)).astype(dtype)
    if image.dtype == np.uint8:
        return np.asarray((2 * total + count) // (2 * count), np.uint8)
    mean = total / count
    return np.asarray(np.floor(mean + 1 / 2) if image.dtype.kind == "u" else mean, image.dtype)
