"""The image circle of a lens: where a picture ends that does not fill its frame."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import cv2
import numpy as np

from . import numpy as door
from . import pixel
from .cameras import Camera, FisheyeCamera
from .sightlines import Pieces

# Grey levels of 255, in the brightest channel, of the surround: noise and compression leave it so far above its
# corners, and at most so bright.
_ABOVE_CORNERS, _BLACK = 16, 80
_FEWEST_POINTS = 60  # of the border, on the circle
# Of the radius: how far border points may lie from the circle, from its first guess to the last. Dark things at the rim
# belong to the surround, so that parts of the border lie within.
_TOLERANCES = (0.1, 0.05, 0.03, *[0.015] * 6)
# How much of what lies outside is black, how much of the circle within the frame is border, and how much of the whole
# circle that is, the last two counted in sectors.
_BLACK_OUTSIDE, _ON_CIRCLE, _LEAST_TURN, _SECTORS = 0.9, 0.6, 0.15, 90
_DIRECTIONS = 720
_CORNERS_PER_SIDE = 24  # how often a corner's square fits along the frame's shorter side
_SMALLEST, _LARGEST = 0.3, 1.0  # radius, of the frame's shorter and longer side
_RIM_WIDTH = 0.04  # of the radius: edges nearer to the rim are its own


class ImageCircle(NamedTuple):
    """A circle in pixels of its picture."""

    x: float
    y: float
    radius: float

    @property
    def inscribed(self) -> Square:
        """The largest square in which the picture has something to show: the lens is judged by its chart there."""
        return self._around(math.sqrt(2) * self.radius)

    @property
    def circumscribed(self) -> Square:
        """The smallest square that holds all there is to see."""
        return self._around(2 * self.radius)

    def resize(self, factor: float) -> ImageCircle:
        """Give the circle of the same picture `factor` times as large."""
        return ImageCircle(pixel.scale(self.x, factor), pixel.scale(self.y, factor), factor * self.radius)

    def contains(self, points: np.ndarray, shrink: float = 1.0) -> np.ndarray:
        """Tell which points (..., 2) lie within the circle, or one `shrink` times as large: (...) bool."""
        return np.asarray(np.hypot(points[..., 0] - self.x, points[..., 1] - self.y) <= shrink * self.radius)

    def to_view(self, mode: str | None = None, balance: float | None = None) -> Square:
        """Give the part that `view_for` is to choose a view by: where that is to be valid only the inscribed square."""
        is_cut = balance is not None or mode in ("valid_only", "valid_rectangle")
        return self.inscribed if is_cut else self.circumscribed

    def seen(self, camera: FisheyeCamera, view: Camera, rotation: Any) -> np.ndarray:
        """Tell which pixels (h, w) of a view show something within the circle, as `rectify` tells what is valid."""
        height, width = camera.image_size
        points = np.stack(np.meshgrid(np.arange(float(width)), np.arange(float(height))), -1)
        within = self.contains(points).astype(np.uint8)
        return door.rectify(within, camera, view, rotation=rotation, interpolation="nearest").image.astype(bool)

    def _around(self, side: float) -> Square:
        whole = max(1, round(side))
        return Square(self.x - pixel.centre(whole), self.y - pixel.centre(whole), whole)


class Square(NamedTuple):
    """A part of a picture, which may reach outside."""

    x0: float
    y0: float
    side: int

    def of(self, camera: FisheyeCamera) -> FisheyeCamera:
        """Give the camera of this part."""
        return camera.crop(self.x0, self.y0, (self.side, self.side))

    def pieces(self, pieces: Pieces) -> Pieces:
        """Give pieces of the picture in pixels of this part."""
        return Pieces(pieces.points - (self.x0, self.y0), pieces.starts)

    def whole(self, camera: FisheyeCamera, image_size: tuple[int, int]) -> FisheyeCamera:
        """Give the camera of the picture (height, width) from that of this part."""
        return camera.crop(-self.x0, -self.y0, image_size)


def find_image_circle(image: np.ndarray) -> ImageCircle | None:
    """Find the image circle of a picture whose corners are black.

    Args:
        image: (H, W, 3) uint8.

    Returns:
        The circle, or None where the picture fills its frame or what is black has another shape.
    """
    brightest = cv2.GaussianBlur(image, (5, 5), 0).max(-1)
    side = max(1, min(brightest.shape) // _CORNERS_PER_SIDE)
    ends = (slice(side), slice(-side, None))
    corners = [(rows, columns) for rows in ends for columns in ends]
    level = max(float(np.median(brightest[corner])) for corner in corners) + _ABOVE_CORNERS
    if level > _BLACK:
        return None
    black = brightest <= level
    _, regions = cv2.connectedComponents(black.astype(np.uint8), connectivity=4)
    surround = black & np.isin(regions, [regions[corner] for corner in corners])
    border = _outer_border(surround)
    near = np.ones(len(border), dtype=bool)
    for tolerance in _TOLERANCES:
        if near.sum() < _FEWEST_POINTS:
            return None
        circle = _fit(border[near])
        distances = np.hypot(border[:, 0] - circle.x, border[:, 1] - circle.y)
        near = np.abs(distances - circle.radius) <= max(1.0, tolerance * circle.radius)
    return circle if _is_convincing(circle, border[near], black) else None


def without_rim(pieces: Pieces, circle: ImageCircle) -> Pieces:
    """Leave out pieces that are, or touch, edges of the rim."""
    if not len(pieces):
        return pieces
    outside = ~circle.contains(pieces.points, 1 - _RIM_WIDTH)
    inside = np.flatnonzero(pieces.sums(outside.astype(float)) == 0)
    if not len(inside):
        return Pieces(np.zeros((0, 2)), np.zeros(1, dtype=int))
    return pieces.joined([np.array([piece]) for piece in inside])


def _is_convincing(circle: ImageCircle, border: np.ndarray, black: np.ndarray) -> bool:
    height, width = black.shape
    if not _SMALLEST * min(height, width) <= circle.radius <= _LARGEST * max(height, width):
        return False
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1)
    if black[~circle.contains(pixels, 1 + _TOLERANCES[-1])].mean() < _BLACK_OUTSIDE:
        return False
    turns = np.arctan2(border[:, 1] - circle.y, border[:, 0] - circle.x) / (2 * math.pi)
    on_border = np.zeros(_SECTORS, dtype=bool)
    on_border[(np.floor(turns * _SECTORS) % _SECTORS).astype(int)] = True
    middles = 2 * math.pi * (np.arange(_SECTORS) + 1 / 2) / _SECTORS
    x, y = circle.x + circle.radius * np.cos(middles), circle.y + circle.radius * np.sin(middles)
    within = (x > 0) & (x < width - 1) & (y > 0) & (y < height - 1)
    return bool(within.mean() >= _LEAST_TURN and (on_border & within).sum() >= _ON_CIRCLE * within.sum())


def _outer_border(surround: np.ndarray) -> np.ndarray:
    """Points (N, 2) where the largest thing within a surround begins, in all directions from the frame's middle.

    Dates and names written into corners are smaller things; black things at the rim belong to the surround.
    """
    _, regions, statistics, _ = cv2.connectedComponentsWithStats((~surround).astype(np.uint8), connectivity=4)
    if len(statistics) == 1:
        return np.zeros((0, 2))
    thing = regions == 1 + statistics[1:, cv2.CC_STAT_AREA].argmax()
    right, below = np.argwhere(thing[:, 1:] != thing[:, :-1]), np.argwhere(thing[1:] != thing[:-1])
    between = pixel.HALF_PIXEL
    points = np.concatenate([right[:, ::-1] + (between, 0), below[:, ::-1] + (0, between)])
    middle = np.array([pixel.centre(side) for side in surround.shape[::-1]])
    away = points - middle
    direction = np.floor(np.arctan2(away[:, 1], away[:, 0]) / (2 * math.pi) * _DIRECTIONS).astype(int)
    order = np.lexsort((-np.hypot(away[:, 0], away[:, 1]), direction))
    _, first = np.unique(direction[order], return_index=True)
    return np.asarray(points[order[first]])


def _fit(points: np.ndarray) -> ImageCircle:
    """Fit the circle of least squared algebraic distance, x^2 + y^2 = 2 a x + 2 b y + c (Kasa 1976)."""
    middle = points.mean(0)
    local = points - middle
    rows = np.column_stack([2 * local, np.ones(len(local))])
    a, b, c = np.linalg.lstsq(rows, (local**2).sum(-1), rcond=None)[0].tolist()
    return ImageCircle(a + float(middle[0]), b + float(middle[1]), math.sqrt(c + a * a + b * b))
