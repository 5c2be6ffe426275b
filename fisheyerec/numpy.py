"""The op for NumPy arrays: the same kernels, no torch, no gradients."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ._arguments import (
    DISTORT,
    RECTIFY,
    RESAMPLE,
    Names,
    check_camera,
    check_interpolates,
    check_options,
    check_size,
)
from ._numpy import resample as _resample_channels
from .cameras import Camera, FisheyeCamera


class Resampled(NamedTuple):
    """A picture and its mask."""

    image: np.ndarray
    """(h, w, C) or (h, w), of the input's dtype."""
    valid: np.ndarray
    """(h, w) bool."""


def rectify(
    image: np.ndarray,
    camera: FisheyeCamera,
    view: Camera,
    *,
    rotation: Any = None,
    interpolation: str = "bilinear",
    padding: str = "zeros",
    threads: int | None = None,
) -> Resampled:
    """Show a fisheye picture as another view sees it.

    Args:
        image: (H, W) or (H, W, C), uint8 or floating; nearest takes integers as well. Any strides.
        camera: the fisheye camera, of image size (H, W).
        view: the view to make, of image size (h, w).
        rotation: (3, 3) camera_from_view, turning the view, as `view_rotation` gives it; None for none.
        interpolation: "bilinear" or "nearest" (labels).
        padding: what lies outside the picture: "zeros" or "border".
        threads: how many threads; None for OpenMP's default (OMP_NUM_THREADS).

    Returns:
        image (h, w) or (h, w, C), and valid (h, w).

    Raises:
        TypeError: an argument of another type.
        ValueError: another shape, dtype or name, or a batch of cameras.
    """
    return _resample(RECTIFY, image, camera, view, rotation, interpolation, padding, threads)


def distort(
    picture: np.ndarray,
    view: Camera,
    camera: FisheyeCamera,
    *,
    rotation: Any = None,
    interpolation: str = "bilinear",
    padding: str = "zeros",
    threads: int | None = None,
) -> Resampled:
    """Show a picture as a fisheye camera would have taken it: the mirror of `rectify`, its arguments and errors."""
    view_from_camera = None if rotation is None else _rotation("distort", rotation).T
    return _resample(DISTORT, picture, view, camera, view_from_camera, interpolation, padding, threads)


def resample(
    image: np.ndarray,
    source: Camera,
    target: Camera,
    *,
    source_from_target: Any = None,
    interpolation: str = "bilinear",
    padding: str = "zeros",
    threads: int | None = None,
) -> Resampled:
    """Resample a picture from any camera into any other: the one op behind `rectify` and `distort`.

    Args:
        image: (H, W) or (H, W, C), as in `rectify`.
        source: the camera that took the image.
        target: the camera to see it through.
        source_from_target: (3, 3) rotation of the target's rays into the source's frame; None for none.
        interpolation: "bilinear" or "nearest".
        padding: "zeros" or "border".
        threads: how many threads; None for OpenMP's default (OMP_NUM_THREADS).

    Returns:
        image (h, w) or (h, w, C), and valid (h, w).

    Raises:
        TypeError, ValueError: as `rectify`.
    """
    return _resample(RESAMPLE, image, source, target, source_from_target, interpolation, padding, threads)


def _resample(
    names: Names,
    image: np.ndarray,
    source: Camera,
    target: Camera,
    source_from_target: Any,
    interpolation: str,
    padding: str,
    threads: int | None,
) -> Resampled:
    function = names.function
    if not isinstance(image, np.ndarray):
        raise TypeError(f"{function}(): expected {names.image} as a NumPy array, got {type(image).__name__}")
    if image.ndim not in (2, 3) or 0 in image.shape:
        raise ValueError(f"{function}(): expected {names.image} of shape (H, W) or (H, W, C), got {image.shape}")
    if image.dtype.kind not in "biuf" or image.dtype.itemsize > 8 or not image.dtype.isnative:
        raise ValueError(f"{function}(): expected {names.image} of a floating or integer dtype, got {image.dtype}")
    check_options(function, interpolation, padding)
    check_interpolates(names, image.dtype.kind == "f" or image.dtype == np.uint8, interpolation, image.dtype)
    for name, camera in ((names.source, source), (names.target, target)):
        check_camera(function, name, camera)
        if camera.params.ndim != 1:
            raise ValueError(f"{function}(): expected one {name}, got a batch of {camera.params.shape[0]}")
    check_size(names, image.shape[:2], source)
    if source_from_target is not None:
        source_from_target = _rotation(function, source_from_target)
    if threads is not None and not (isinstance(threads, int) and threads >= 1):
        raise ValueError(f"{function}(): expected threads of at least 1, as an integer, got {threads!r}")
    if any(stride % image.itemsize for stride in image.strides):  # a field of a record array
        image = image.copy()
    channels = image if image.ndim == 3 else image[..., None]
    height, width = target.image_size
    out, valid = _resample_channels(
        channels,
        source.model,
        source.numpy().params,
        target.model,
        target.numpy().params,
        source_from_target,
        height,
        width,
        interpolation,
        padding,
        threads or 0,
    )
    return Resampled(out.reshape(height, width, *image.shape[2:]), valid)


def _rotation(function: str, rotation: Any) -> np.ndarray:
    try:
        matrix = np.asarray(rotation, dtype=np.float64)
    except (TypeError, ValueError):
        raise TypeError(f"{function}(): expected rotation as (3, 3) numbers, got {rotation!r:.60}") from None
    if matrix.shape != (3, 3):
        raise ValueError(f"{function}(): expected rotation of shape (3, 3), got {matrix.shape}")
    return matrix
