"""Choosing a perspective view of a fisheye camera: how much of the picture to keep, how much emptiness to accept."""

from __future__ import annotations

import math

import numpy as np

from . import pixel
from .cameras import FisheyeCamera, PinholeCamera

# The widest half angle that `keep_all` shows along an edge: a perspective view of 150 degrees spends nine tenths of
# its pixels on the outer third, and one of 180 degrees would be infinitely large.
KEEP_ALL_THETA_MAX = math.radians(75)


def keep_all(camera: FisheyeCamera, image_size: tuple[int, int]) -> PinholeCamera:
    """Give the closest centred view that shows the whole fisheye picture, as far as 75 degrees off the axis.

    Args:
        camera: one fisheye camera.
        image_size: (height, width) of the view.
    """
    camera = camera.numpy()
    border = _border(camera.image_size)
    rays, valid = camera.unproject(border)
    # Border points beyond the lens are as good as its rim in the same direction.
    theta = np.where(valid, np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2]), camera.theta_max)
    directions = (border - camera.params[2:4]) / camera.params[:2]
    directions /= np.hypot(directions[:, 0], directions[:, 1])[:, None]
    reach = np.abs(directions) * np.tan(np.minimum(theta, KEEP_ALL_THETA_MAX))[:, None]
    height, width = image_size
    focal = min(width / 2 / reach[:, 0].max(), height / 2 / reach[:, 1].max())
    return PinholeCamera.from_focal(float(focal), image_size)


def valid_only(camera: FisheyeCamera, image_size: tuple[int, int]) -> PinholeCamera:
    """Give the widest centred view whose every pixel lies on the fisheye picture.

    Args:
        camera: one fisheye camera.
        image_size: (height, width) of the view.

    Raises:
        ValueError: the camera's axis misses its own picture, so that no centred view is valid.
    """
    camera = camera.numpy()
    height, width = camera.image_size

    def is_valid(focal: float) -> bool:
        rays, _ = PinholeCamera.from_focal(focal, image_size).unproject(_border(image_size))
        points, valid = camera.project(rays)
        x, y = points[:, 0] + pixel.HALF_PIXEL, points[:, 1] + pixel.HALF_PIXEL
        return bool((valid & (x >= 0) & (x <= width) & (y >= 0) & (y <= height)).all())

    low = high = float(keep_all(camera, image_size).params[0])
    while not is_valid(high):
        low, high = high, 2 * high
        if high > 1e9:
            raise ValueError(f"valid_only(): expected a camera whose axis meets its picture, got {camera!r}")
    while high / low > 1 + 1e-6:
        middle = math.sqrt(low * high)
        low, high = (low, middle) if is_valid(middle) else (middle, high)
    return PinholeCamera.from_focal(float(high), image_size)


def balanced(camera: FisheyeCamera, balance: float, image_size: tuple[int, int]) -> PinholeCamera:
    """Give a centred view between `valid_only` (balance 0) and `keep_all` (balance 1), even in the zoom.

    Args:
        camera: one fisheye camera.
        balance: in [0, 1].
        image_size: (height, width) of the view.

    Raises:
        ValueError: balance outside [0, 1], or as `valid_only`.
    """
    if not 0 <= balance <= 1:
        raise ValueError(f"balanced(): expected balance in [0, 1], got {balance:g}")
    narrow, wide = valid_only(camera, image_size).params[0], keep_all(camera, image_size).params[0]
    return PinholeCamera.from_focal(float(narrow ** (1 - balance) * wide**balance), image_size)


def choose(
    camera: FisheyeCamera,
    image_size: tuple[int, int],
    *,
    fov_deg: float | None = None,
    focal: float | None = None,
    balance: float | None = None,
) -> PinholeCamera:
    """Give the view that one option at most asks for, and the edge-matched one without.

    Args:
        camera: one fisheye camera.
        image_size: (height, width) of the view.
        fov_deg: field of view across the width, in (0, 180).
        focal: focal length in pixels.
        balance: as in `balanced`.

    Raises:
        ValueError: several options, or one out of its range.
    """
    if sum(option is not None for option in (fov_deg, focal, balance)) > 1:
        raise ValueError("choose(): expected one of fov_deg, focal and balance, got several")
    if fov_deg is not None:
        return PinholeCamera.from_fov(fov_deg, image_size)
    if focal is not None:
        return PinholeCamera.from_focal(focal, image_size)
    if balance is not None:
        return balanced(camera, balance, image_size)
    return PinholeCamera.edge_matched(camera, image_size)


def _border(image_size: tuple[int, int]) -> np.ndarray:
    """Points around the edge of an image, corners included: (N, 2)."""
    height, width = image_size
    x = np.linspace(-pixel.HALF_PIXEL, width - pixel.HALF_PIXEL, 129)
    y = np.linspace(-pixel.HALF_PIXEL, height - pixel.HALF_PIXEL, 129)
    sides = [np.stack(np.broadcast_arrays(x, edge), -1) for edge in y[[0, -1]]]
    sides += [np.stack(np.broadcast_arrays(edge, y), -1) for edge in x[[0, -1]]]
    return np.concatenate(sides)
