"""What the page shows of a photo under a lens and a view: before and after, and what can be said of them."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from .. import numpy as door
from .. import pixel
from ..cameras import FisheyeCamera
from ..file_rectifiers import ViewOptions
from ..outlines import moved_points
from ..straightness import bends_of, straightness_of
from .marks import draw_lines, hatch
from .photo import Photo


class Preview(NamedTuple):
    """Two pictures and their figures."""

    before: np.ndarray
    """(h, w, 3) uint8: the photo's preview."""
    after: np.ndarray
    """(h, w, 3) uint8: the same, rectified."""
    valid_share: float
    """Of the pixels after, in [0, 1]."""
    bend_before: float
    """RMS bend of the photo's lines in % of their length, as `straightness` tells it; NaN without lines."""
    bend_after: float
    """The same under the camera, seen in perspective."""
    fold_deg: float | None
    """Off the axis, where the lens polynomial folds back within the picture; None where it does not."""


def make_preview(
    photo: Photo, camera: FisheyeCamera, options: ViewOptions, *, lines: bool = False, mask: bool = False
) -> Preview:
    """Rectify a photo's preview.

    Args:
        photo: the photo.
        camera: its camera, at its whole size.
        options: the view to make.
        lines: whether to draw the photo's lines on both, coloured by how much they bend.
        mask: whether to hatch what the photo does not show.

    Raises:
        ValueError: there is no such view of the camera.
    """
    small = camera.resize((photo.preview.shape[0], photo.preview.shape[1]))
    view, rotation = options.view_of(small, photo.circle), options.rotation()
    before = photo.preview
    after, valid = door.rectify(before, small, view, rotation=rotation)
    if photo.circle is not None:
        valid &= photo.circle.seen(small, view, rotation)
    if mask:
        after = hatch(after, ~valid)
    if lines:
        scale = np.array(small.image_size[::-1]) / np.array(photo.working_size[::-1])
        pieces = photo.pieces
        points = _scaled(pieces.points, scale)
        bent, used = bends_of(pieces, None, photo.working_size)
        before = draw_lines(before, points, pieces.starts, np.where(used, bent, np.nan))
        moved, _ = moved_points(points, small, view, rotation)
        straightened, used = bends_of(pieces, camera, photo.working_size)
        after = draw_lines(after, moved, pieces.starts, np.where(used, straightened, np.nan))
    return Preview(
        before,
        after,
        float(valid.mean()),
        straightness_of(photo.pieces, None, photo.working_size),
        straightness_of(photo.pieces, camera, photo.working_size),
        _fold_deg(camera),
    )


def _scaled(points: np.ndarray, scale: np.ndarray) -> np.ndarray:
    return np.stack([pixel.scale(points[:, axis], scale[axis]) for axis in (0, 1)], -1)


def _fold_deg(camera: FisheyeCamera) -> float | None:
    """Where the polynomial turns, if the picture's farthest corner lies beyond: what is there has no ray."""
    height, width = camera.image_size
    corners = np.array([(x, y) for x in (0, width - 1) for y in (0, height - 1)], dtype=np.float64)
    _, seen = camera.unproject(corners)
    theta_max = float(camera.theta_max)
    return None if seen.all() or theta_max >= math.pi else math.degrees(theta_max)
