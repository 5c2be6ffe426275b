"""How straight a camera makes the lines of a picture, told without labels; and the lines this is told by."""

from __future__ import annotations

import cv2
import numpy as np

from .cameras import FisheyeCamera
from .lines import find_chains
from .sightlines import Pieces

WORKING_SIDE = 512
"""Larger pictures are reduced to this long side, in pixels."""

_MOST_PIECES = 100  # more cost time and tell nothing
_STRIDE = 3  # neighbouring edge points share their noise: so many become one
_LONG = 0.15  # of the long side: pieces whose bend is looked at
_BEND_CUT = 0.3  # %, where rho begins to give up


def straightness(image: np.ndarray, camera: FisheyeCamera | None) -> float:
    """Tell how much the lines of a picture bend once a camera has straightened it.

    Args:
        image: (H, W) or (H, W, 3) uint8.
        camera: one fisheye camera of image size (H, W), or None for the picture as it is.

    Returns:
        RMS bend of long edge chains (of the parabola through each) in % of their length, within 75 degrees of the
        axis: a robust mean weighted by length, so that real curves count little; NaN where there are none. Street
        photographs without distortion have about 0.2.

    Raises:
        TypeError: image is not an array or camera is not a FisheyeCamera.
        ValueError: another shape or dtype, or a batch of cameras.
    """
    check_picture("straightness", image, camera)
    pieces, size = find_pieces(image)
    return straightness_of(pieces, camera, size)


def find_pieces(image: np.ndarray) -> tuple[Pieces, tuple[int, int]]:
    """Edge chains of a picture at its working size, every few points averaged, and that (height, width)."""
    grey = working_copy(image)
    height, width = grey.shape
    chains = find_chains(grey, min_length=max(12.0, max(height, width) / 20))
    counts = np.diff(chains.starts)
    groups = np.maximum(counts // _STRIDE, 1)
    place = np.arange(len(chains.points)) - chains.starts[:-1][chains.owners]
    first = np.concatenate([[0], np.cumsum(groups)])
    target = first[:-1][chains.owners] + np.minimum(place // _STRIDE, groups[chains.owners] - 1)
    members = np.bincount(target, minlength=first[-1])[:, None]
    sums = np.stack([np.bincount(target, chains.points[:, axis], minlength=first[-1]) for axis in (0, 1)], -1)
    first = first[: _MOST_PIECES + 1]
    return Pieces((sums / members)[: first[-1]], first), (height, width)


def working_copy(image: np.ndarray) -> np.ndarray:
    """Give the grey picture (h, w) that edges are looked for in: no side longer than WORKING_SIDE."""
    grey = image if image.ndim == 2 else cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY)
    height, width = grey.shape
    shrink = WORKING_SIDE / max(height, width)
    if shrink < 1:
        size = (max(1, round(width * shrink)), max(1, round(height * shrink)))
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    return np.asarray(grey)


def straightness_of(pieces: Pieces, camera: FisheyeCamera | None, size: tuple[int, int]) -> float:
    """Give the `straightness` of pieces found in a picture of a working size (height, width)."""
    bends, used = bends_of(pieces, camera, size)
    if not used.any():
        return float("nan")
    share = np.average(bends[used] ** 2 / (bends[used] ** 2 + _BEND_CUT**2), weights=pieces.lengths[used])
    return float(_BEND_CUT * np.sqrt(share / (1 - share)))


def bends_of(pieces: Pieces, camera: FisheyeCamera | None, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Give how much each piece bends, in % of its length, and which `straightness_of` goes by: (K,), (K,) bool."""
    if not len(pieces):
        return np.zeros(0), np.zeros(0, dtype=bool)
    points, seen = pieces.points, np.ones(len(pieces.points), dtype=bool)
    if camera is not None:
        rays, seen = camera.numpy().resize(size).unproject(points)
        seen = seen & (rays[:, 2] > np.cos(np.radians(75)))
        points = rays[:, :2] / np.where(seen, rays[:, 2], np.inf)[:, None]
    owners, counts = pieces.owners, pieces.counts
    whole = (pieces.sums(seen) == counts) & (counts >= 5)
    if not whole.any():
        return np.zeros(len(pieces)), whole
    points = np.where(whole[owners, None], points, pieces.points)
    shortest = min(_LONG * max(size), np.sort(pieces.lengths[whole])[-5:][0])
    local = points - (pieces.sums(points) / counts[:, None])[owners]
    _, axes = np.linalg.eigh(pieces.sums(local[:, :, None] * local[:, None, :]))
    across, along = (local[:, None, :] @ axes[owners])[:, 0].T
    # across = bow * shape, shape = along^2 less its best straight line
    squares, cubes = pieces.sums(along**2), pieces.sums(along**3)
    shape = along**2 - (squares / counts)[owners] - (cubes / squares)[owners] * along
    power = np.maximum(pieces.sums(shape**2), 1e-300)
    bow = pieces.sums(across * shape) / power
    length = np.linalg.norm(points[pieces.starts[1:] - 1] - points[pieces.starts[:-1]], axis=-1)
    bends = 100 * np.abs(bow) * np.sqrt(power / counts) / length
    return bends, whole & (pieces.lengths >= shortest)


def check_picture(function: str, image: object, camera: object) -> None:
    """Refuse what is no picture with its camera, in the words of the function it was given to."""
    if not isinstance(image, np.ndarray):
        raise TypeError(f"{function}(): expected image as a NumPy array, got {type(image).__name__}")
    if image.ndim not in (2, 3) or 0 in image.shape or (image.ndim == 3 and image.shape[2] != 3):
        raise ValueError(f"{function}(): expected image of shape (H, W) or (H, W, 3), got {image.shape}")
    if image.dtype != np.uint8:
        raise ValueError(f"{function}(): expected image of dtype uint8, got {image.dtype}")
    if camera is None and function == "straightness":
        return
    if not isinstance(camera, FisheyeCamera):
        raise TypeError(f"{function}(): expected camera as a FisheyeCamera, got {type(camera).__name__}")
    if camera.params.ndim != 1:
        raise ValueError(f"{function}(): expected one camera, got a batch of {camera.params.shape[0]}")
    if camera.image_size != image.shape[:2]:
        raise ValueError(
            f"{function}(): expected camera of the image's size {image.shape[:2]}, got {camera.image_size}"
        )
