"""A picture to play with: whole for the download, small for what is shown while a slider moves."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ..cameras import FisheyeCamera
from ..file_rectifiers import camera_at
from ..image_circle import ImageCircle, find_image_circle, without_rim
from ..pictures import Picture, read_picture
from ..sightlines import Pieces
from ..straightness import find_pieces

PREVIEW_SIDE = 960
"""Larger pictures are shown with this long side, in pixels."""


@dataclass(frozen=True)
class Photo:
    """A picture that was opened."""

    path: Path
    """The file it came from, of which only the name is used from now on."""
    picture: Picture
    """All of it."""
    preview: np.ndarray
    """(h, w, 3) uint8, at most PREVIEW_SIDE on its long side."""
    pieces: Pieces
    """Its lines, in pixels of `working_size`."""
    working_size: tuple[int, int]
    """(height, width) that lines are looked for at."""
    circle: ImageCircle | None
    """Where the preview ends, if it does not fill its frame."""

    @classmethod
    def open(cls, path: Path) -> Photo:
        """Read a picture and look for its lines.

        Raises:
            ValueError: not a picture, or a broken one.
            OSError: the file cannot be read.
        """
        picture = read_picture(path)
        preview = preview_of(picture.pixels)
        pieces, working_size = find_pieces(preview)
        circle = find_image_circle(preview)
        if circle is not None:
            pieces = without_rim(pieces, circle.resize(max(working_size) / max(preview.shape[:2])))
        return cls(path, picture, preview, pieces, working_size, circle)

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) of the whole picture."""
        height, width = self.picture.pixels.shape[:2]
        return height, width

    def load_camera(self, path: Path) -> FisheyeCamera:
        """Read the camera that took the picture from a lens file of any format; one of another scale is scaled.

        Raises:
            ValueError: not a lens file, or the lens of pictures of another shape.
            OSError: the file cannot be read.
        """
        return camera_at(FisheyeCamera.load(path, image_size=self.size), self.size, Path(self.path.name))


def preview_of(pixels: np.ndarray) -> np.ndarray:
    """Give a picture as it is shown: (h, w, 3) uint8, no side longer than PREVIEW_SIDE.

    Args:
        pixels: (H, W), (H, W, 3) or (H, W, 4), uint8 or uint16.
    """
    colour = pixels[..., :3] if pixels.ndim == 3 else np.repeat(pixels[..., None], 3, -1)
    height, width = colour.shape[:2]
    shrink = PREVIEW_SIDE / max(height, width)
    if shrink < 1:
        size = (max(1, round(width * shrink)), max(1, round(height * shrink)))
        colour = cv2.resize(np.ascontiguousarray(colour), size, interpolation=cv2.INTER_AREA)
    if colour.dtype != np.uint8:
        colour = np.rint(colour / 257).clip(0, 255).astype(np.uint8)
    return np.ascontiguousarray(colour)
