"""The perspective view."""

from __future__ import annotations

import math
from typing import Any, Self

import numpy as np

from .. import pixel
from .camera import Camera, checked_image_size, is_tensor, namespace
from .fisheye import FisheyeCamera
from .matrices import camera_matrix, checked_matrix, matrix_columns

# The widest view that `PinholeCamera.edge_matched` gives is 120 degrees: beyond, a pinhole picture is mostly stretch.
EDGE_MATCHED_THETA_MAX = math.radians(60)


class PinholeCamera(Camera):
    """A perspective view: x = fx X/Z + cx, y = fy Y/Z + cy.

    Args:
        params: (4,) or (B, 4): fx, fy, cx, cy in pixels.
        image_size: (height, width) of the view.
    """

    model = "pinhole"
    parameter_names = ("fx", "fy", "cx", "cy")

    @classmethod
    def from_fov(cls, fov_deg: float, image_size: tuple[int, int]) -> Self:
        """Give a centred view with square pixels that is fov_deg wide, edge to edge.

        Raises:
            ValueError: fov_deg outside (0, 180), which no perspective view can show.
        """
        if not 0 < fov_deg < 180:
            raise ValueError(
                f"{cls.__name__}.from_fov(): expected fov_deg in (0, 180), as a perspective view is narrower than "
                f"180 degrees, got {fov_deg:g}"
            )
        _, width = checked_image_size(cls, image_size)
        return cls.from_focal(width / 2 / math.tan(math.radians(fov_deg) / 2), image_size)

    @classmethod
    def from_focal(cls, focal: float, image_size: tuple[int, int]) -> Self:
        """Give a centred view with square pixels and the given focal length in pixels.

        Raises:
            ValueError: a focal length that is not positive and finite.
        """
        if not (focal > 0 and math.isfinite(focal)):
            raise ValueError(f"{cls.__name__}.from_focal(): expected a focal length above 0, got {focal:g}")
        height, width = checked_image_size(cls, image_size)
        return cls([focal, focal, pixel.centre(width), pixel.centre(height)], image_size)

    @classmethod
    def from_matrix(cls, K: Any, image_size: tuple[int, int]) -> Self:
        """Take a (3, 3) or (B, 3, 3) camera matrix without skew, such as OpenCV's new camera matrix.

        Raises:
            ValueError: another shape, or a skew.
        """
        K = checked_matrix(f"{cls.__name__}.from_matrix()", K)
        return cls(namespace(K).stack(matrix_columns(K), -1), image_size)

    def to_matrix(self) -> np.ndarray:
        """Give the (3, 3) camera matrix in float64."""
        return camera_matrix(self._single("to_matrix"))

    @classmethod
    def edge_matched(cls, camera: FisheyeCamera, image_size: tuple[int, int]) -> Self:
        """Give the standard view of a fisheye camera: its nearest picture edge stays at the edge of the view.

        Centred, with square pixels and focal (size / 2) / tan(theta_e), where theta_e, at most 60 degrees, is the
        smallest angle that the camera gives to the midpoints of the picture's edges. On a view that is not square,
        left and right edges bound its width, upper and lower edges its height. Valid everywhere unless the lens
        folds within the frame. Differentiable in the camera's parameters where these are a tensor.

        Args:
            camera: one camera or a batch.
            image_size: (height, width) of the view.

        Raises:
            TypeError: camera is not a FisheyeCamera.
            ValueError: image_size below 1.
        """
        if not isinstance(camera, FisheyeCamera):
            raise TypeError(
                f"{cls.__name__}.edge_matched(): expected camera as a FisheyeCamera, got {type(camera).__name__}"
            )
        height, width = checked_image_size(cls, image_size)
        source_height, source_width = camera.image_size
        x, y = pixel.centre(source_width), pixel.centre(source_height)
        left, upper = -pixel.HALF_PIXEL, -pixel.HALF_PIXEL
        right, lower = source_width - pixel.HALF_PIXEL, source_height - pixel.HALF_PIXEL
        midpoints = np.array([(left, y), (right, y), (x, upper), (x, lower)])
        params, xp = camera.params, namespace(camera.params)
        points = xp.asarray(midpoints)
        if is_tensor(params):
            points = points.to(params)
        if params.ndim == 2:
            points = xp.broadcast_to(points, (params.shape[0], 4, 2))
        rays, valid = camera.unproject(points)
        widest = EDGE_MATCHED_THETA_MAX * xp.ones_like(params[..., :1])
        # Where an edge lies beyond the lens, its angle is unknown but no smaller than theta_max.
        beyond = camera.theta_max.clip(max=EDGE_MATCHED_THETA_MAX)
        rays = xp.where(valid[..., None], rays, xp.ones_like(rays))
        theta = xp.atan2(xp.hypot(rays[..., 0], rays[..., 1]), rays[..., 2])
        theta = xp.where(valid, theta, beyond[..., None])
        theta = xp.where(theta < widest, theta, widest)
        across = xp.minimum(theta[..., 0], theta[..., 1])
        down = xp.minimum(theta[..., 2], theta[..., 3])
        focal = xp.maximum(width / 2 / xp.tan(across), height / 2 / xp.tan(down))
        one = xp.ones_like(focal)
        return cls(xp.stack([focal, focal, pixel.centre(width) * one, pixel.centre(height) * one], -1), image_size)
