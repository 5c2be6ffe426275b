"""A wall one metre ahead, with something drawn on it, photographed through any camera.

Every pixel looks along its own rays at the drawing: no picture is resampled, so what is drawn here judges the op.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

import fisheyerec as fr
from fisheyerec.pictures import Picture, write_picture

Camera = fr.FisheyeCamera | fr.PinholeCamera
Drawing = Callable[[Tensor], Tensor]
"""From points (..., 2) of the wall in metres, x right and y down, to brightness (B, ...) in [0, 1] of B walls."""


def photograph(drawing: Drawing, camera: Camera, *, supersample: int = 3) -> Tensor:
    """Give the pictures (B, 1, H, W) float32 that a camera takes of drawings; what is no wall is black.

    Args:
        drawing: what is on the walls.
        camera: the one camera that takes all the pictures.
        supersample: rays per pixel each way.
    """
    height, width = (supersample * side for side in camera.image_size)
    pixels = np.stack(np.meshgrid(np.arange(float(width)), np.arange(float(height))), -1)
    rays, valid = camera.numpy().resize((height, width)).unproject(pixels)
    ahead = valid & (rays[..., 2] > 0)
    points = torch.from_numpy(rays[..., :2] / np.where(ahead, rays[..., 2], np.inf)[..., None]).float()
    return F.avg_pool2d((drawing(points) * torch.from_numpy(ahead))[:, None], supersample)


def polygons(corners: Tensor, centre: Tensor, radius: Tensor, angle: Tensor) -> Drawing:
    """Draw one white regular polygon on each of B walls.

    Args:
        corners: (B,) integers from 3.
        centre: (B, 2) in metres.
        radius: (B,) in metres, of the circle around it.
        angle: (B,) in radians, towards one corner.
    """
    corners, radius, angle = (value.view(-1, 1, 1) for value in (corners, radius, angle))

    def drawing(points: Tensor) -> Tensor:
        x, y = (points - centre.view(-1, 1, 1, 2)).unbind(-1)
        half_side = torch.pi / corners
        from_normal = torch.remainder(torch.atan2(y, x) - angle, 2 * half_side) - half_side
        return (torch.hypot(x, y) * from_normal.cos() < radius * half_side.cos()).float()

    return drawing


def save(path: str, *pictures: Tensor) -> None:
    """Write pictures (1, H, W) or (3, H, W) in [0, 1] beside one another, upper edges aligned, on grey."""
    height = max(picture.shape[1] for picture in pictures)
    columns = [
        F.pad(picture.detach().float().expand(3, -1, -1), (2, 2, 2, 2 + height - picture.shape[1]), value=0.5)
        for picture in pictures
    ]
    pixels = torch.cat(columns, -1).permute(1, 2, 0).clamp(0, 1).mul(255).round().byte()
    write_picture(path, Picture(pixels.numpy()))
