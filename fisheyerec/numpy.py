"""The op for NumPy arrays: the same kernels, no torch, no gradients."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ._arguments import (
    DISTORT,
    PLAN,
    RECTIFY,
    RESAMPLE,
    Names,
    check_antialias,
    check_interpolates,
    check_interpolation,
    check_padding,
    check_single,
    check_size,
    rotation_matrix,
)
from ._numpy import Plan as _KeptCoordinates
from ._numpy import resample as _resample_channels
from .antialiasing import bands, levels, reduce, shrunk
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
    antialias: bool = False,
    threads: int | None = None,
) -> Resampled:
    """Show a fisheye picture as another view sees it.

    Args:
        image: (H, W) or (H, W, C), uint8, uint16 or floating; nearest takes integers as well. Any strides.
        camera: the fisheye camera, of image size (H, W).
        view: the view to make, of image size (h, w).
        rotation: (3, 3) camera_from_view, turning the view, as `view_rotation` gives it; None for none.
        interpolation: "bilinear" or "nearest" (labels).
        padding: what lies outside the picture: "zeros" or "border".
        antialias: whether to average where the picture shrinks; slower by the square of how much it does, at most 64.
        threads: how many threads; None for OpenMP's default (OMP_NUM_THREADS).

    Returns:
        image (h, w) or (h, w, C), and valid (h, w).

    Raises:
        TypeError: an argument of another type.
        ValueError: another shape, dtype or name, or a batch of cameras.
    """
    return resample_named(RECTIFY, image, camera, view, rotation, interpolation, padding, antialias, threads)


def distort(
    picture: np.ndarray,
    view: Camera,
    camera: FisheyeCamera,
    *,
    rotation: Any = None,
    interpolation: str = "bilinear",
    padding: str = "zeros",
    antialias: bool = False,
    threads: int | None = None,
) -> Resampled:
    """Show a picture as a fisheye camera would have taken it: the mirror of `rectify`, its arguments and errors."""
    view_from_camera = None if rotation is None else rotation_matrix("distort", rotation).T
    return resample_named(DISTORT, picture, view, camera, view_from_camera, interpolation, padding, antialias, threads)


def resample(
    image: np.ndarray,
    source: Camera,
    target: Camera,
    *,
    source_from_target: Any = None,
    interpolation: str = "bilinear",
    padding: str = "zeros",
    antialias: bool = False,
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
        antialias: whether to average where the picture shrinks, as in `rectify`.
        threads: how many threads; None for OpenMP's default (OMP_NUM_THREADS).

    Returns:
        image (h, w) or (h, w, C), and valid (h, w).

    Raises:
        TypeError, ValueError: as `rectify`.
    """
    return resample_named(
        RESAMPLE, image, source, target, source_from_target, interpolation, padding, antialias, threads
    )


class Plan:
    """The same cameras for picture after picture (video): the bits of `resample`, without the lens each time.

    Keeps where each target pixel lies in the source, 8 bytes a pixel, and the mask. `Plan(camera, view)(frame)` is
    `rectify(frame, camera, view)`; `Plan(view, camera)(picture)` is `distort(picture, view, camera)`.
    """

    def __init__(
        self,
        source: Camera,
        target: Camera,
        *,
        source_from_target: Any = None,
        padding: str = "zeros",
        threads: int | None = None,
    ) -> None:
        """Plan for one pair of cameras.

        Args:
            source: the camera that takes the pictures, of image size (H, W).
            target: the camera to see them through, of image size (h, w).
            source_from_target: (3, 3) rotation of the target's rays into the source's frame; None for none.
            padding: "zeros" or "border".
            threads: how many threads, now and for each picture; None for OpenMP's default (OMP_NUM_THREADS).

        Raises:
            TypeError, ValueError: as `resample`.
        """
        check_padding(PLAN.function, padding)
        rotation = check_single(PLAN, source, target, source_from_target)
        _check_threads(PLAN, threads)
        self.source, self.target, self._threads = source, target, threads or 0
        self._coordinates = _KeptCoordinates(
            source.model,
            source.numpy().params,
            *source.image_size,
            target.model,
            target.numpy().params,
            *target.image_size,
            rotation,
            padding,
            self._threads,
        )
        self.valid = self._coordinates.valid()
        """(h, w) bool, the same for every picture; read-only."""
        self.valid.flags.writeable = False

    def __call__(self, image: np.ndarray, *, interpolation: str = "bilinear") -> Resampled:
        """Resample one picture.

        Args:
            image: (H, W) or (H, W, C), uint8, uint16, float16 or float32; nearest takes integers as well. Any strides.
            interpolation: "bilinear" or "nearest" (labels).

        Returns:
            image (h, w) or (h, w, C), and `valid`.

        Raises:
            TypeError: an argument of another type.
            ValueError: another shape, dtype or name; float64, which `resample` computes in float64.
        """
        channels = _as_channels(PLAN, image, interpolation)
        if image.dtype == np.float64:
            raise ValueError(
                "Plan(): expected image of uint8, uint16, float16 or float32, got float64; resample() takes it"
            )
        check_size(PLAN, image.shape[:2], self.source)
        out = self._coordinates.resample(channels, interpolation, self._threads)
        return Resampled(out.reshape(*self.target.image_size, *image.shape[2:]), self.valid)


def resample_named(
    names: Names,
    image: np.ndarray,
    source: Camera,
    target: Camera,
    source_from_target: Any,
    interpolation: str,
    padding: str,
    antialias: bool,
    threads: int | None,
) -> Resampled:
    """Resample in the name of another function of the package, and in its words where it raises."""
    check_padding(names.function, padding)
    channels = _as_channels(names, image, interpolation)
    check_antialias(names.function, antialias, interpolation)
    rotation = check_single(names, source, target, source_from_target)
    check_size(names, image.shape[:2], source)
    _check_threads(names, threads)

    def take(channels: np.ndarray, source: Camera, target: Camera) -> Resampled:
        out, valid = _resample_channels(
            channels,
            source.model,
            source.params,
            target.model,
            target.params,
            rotation,
            *target.image_size,
            interpolation,
            padding,
            threads or 0,
        )
        return Resampled(out, valid)

    source, target = source.numpy(), target.numpy()
    if antialias:
        valid = take(channels[..., :1], source, target).valid
        shrink, factor = levels(source, target, rotation)
        small = shrunk(channels, source, shrink)
        out = np.concatenate([reduce(take(*small, band).image, factor) for band in bands(target, factor)])
    else:
        out, valid = take(channels, source, target)
    return Resampled(out.reshape(*target.image_size, *image.shape[2:]), valid)


def _as_channels(names: Names, image: np.ndarray, interpolation: str) -> np.ndarray:
    """Give the picture as (H, W, C), its strides as they are."""
    function = names.function
    if not isinstance(image, np.ndarray):
        raise TypeError(f"{function}(): expected {names.image} as a NumPy array, got {type(image).__name__}")
    if image.ndim not in (2, 3) or 0 in image.shape:
        raise ValueError(f"{function}(): expected {names.image} of shape (H, W) or (H, W, C), got {image.shape}")
    if image.dtype.kind not in "biuf" or image.dtype.itemsize > 8 or not image.dtype.isnative:
        raise ValueError(f"{function}(): expected {names.image} of a floating or integer dtype, got {image.dtype}")
    check_interpolation(function, interpolation)
    interpolates = image.dtype.kind == "f" or image.dtype in (np.uint8, np.uint16)
    check_interpolates(names, interpolates, interpolation, image.dtype, ", uint8 or uint16")
    if any(stride % image.itemsize for stride in image.strides):  # a field of a record array
        image = image.copy()
    return image if image.ndim == 3 else image[..., None]


def _check_threads(names: Names, threads: int | None) -> None:
    if threads is not None and not (isinstance(threads, int) and threads >= 1):
        raise ValueError(f"{names.function}(): expected threads of at least 1, as an integer, got {threads!r}")
