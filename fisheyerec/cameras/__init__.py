"""Cameras: parameters, points to rays and back, scaling, cropping, and other people's conventions."""

from __future__ import annotations

import os

from ..camera_files import read_camera_file
from .camera import Camera, checked_image_size, is_tensor, namespace
from .fisheye import MAX_FIT_ERROR_PX, FisheyeCamera
from .pinhole import EDGE_MATCHED_THETA_MAX, PinholeCamera

__all__ = [
    "EDGE_MATCHED_THETA_MAX",
    "MAX_FIT_ERROR_PX",
    "Camera",
    "FisheyeCamera",
    "PinholeCamera",
    "checked_image_size",
    "is_tensor",
    "load_camera",
    "namespace",
]


def load_camera(
    path: str | os.PathLike[str],
    *,
    image_size: tuple[int, int] | None = None,
    max_fit_error_px: float = MAX_FIT_ERROR_PX,
) -> Camera:
    """Read a pinhole or a fisheye camera, whichever a lens file holds; the rest is as in `FisheyeCamera.load`."""
    file = read_camera_file(path, image_size=image_size)
    if file.model == PinholeCamera.model:
        return PinholeCamera._from_file(path, file)
    return FisheyeCamera._from_file(path, file, max_fit_error_px)
