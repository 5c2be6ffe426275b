"""Looking into an equirectangular panorama along any rays.

The panorama of width W shows the direction (x right, y down, z forward) of longitude atan2(x, z) and latitude
asin(-y): z in its middle, -y in its first row. The op has no such camera yet, so this samples by itself.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch.nn import functional

from .. import pixel

_PIECE = 1 << 14


def view_rotation(yaw: float, pitch: float, roll: float) -> np.ndarray:
    """Give (3, 3) panorama_from_camera of a camera turned right by yaw, up by pitch and around its axis by roll."""
    cos_yaw, sin_yaw = math.cos(yaw), math.sin(yaw)
    cos_pitch, sin_pitch = math.cos(pitch), math.sin(pitch)
    cos_roll, sin_roll = math.cos(roll), math.sin(roll)
    turn = np.array([[cos_yaw, 0, sin_yaw], [0, 1, 0], [-sin_yaw, 0, cos_yaw]])
    tilt = np.array([[1, 0, 0], [0, cos_pitch, -sin_pitch], [0, sin_pitch, cos_pitch]])
    bank = np.array([[cos_roll, -sin_roll, 0], [sin_roll, cos_roll, 0], [0, 0, 1]])
    return np.asarray(turn @ tilt @ bank)


def sample_panorama(panorama: np.ndarray, rays: np.ndarray, factor: int = 1) -> np.ndarray:
    """Read a panorama bilinearly along rays and between them.

    Args:
        panorama: (H, 2 H, 3) uint8.
        rays: (h, w, 3) of unit length in the panorama's frame, one for each pixel, h and w at least 2.
        factor: how many times as large the picture is made; rays in between are interpolated, which for rays a pixel
            apart is right to a thousandth of that pixel.

    Returns:
        (factor h, factor w, 3) uint8.
    """
    height, width = panorama.shape[:2]
    # one more column each side, so that the seam is interpolated like anything else
    wrapped = np.concatenate([panorama[:, -1:], panorama, panorama[:, :1]], axis=1)
    values = torch.from_numpy(wrapped).permute(2, 0, 1)[None].to(torch.float32, memory_format=torch.contiguous_format)
    x, y, z = _refine(torch.from_numpy(np.asarray(rays, dtype=np.float32)).permute(2, 0, 1), factor).unbind(0)
    # angles as coordinates of a picture of one pixel, which spans -1/2 to 1/2, scaled up
    column = pixel.scale(_atan2(x, z) / (2 * math.pi), width)
    row = pixel.scale(_atan2(y, (x * x + z * z).sqrt()) / math.pi, height)
    # grid_sample's -1 and 1 are the outer edges of the picture, as wrapped has one column more on the left
    edge = pixel.HALF_PIXEL
    grid = torch.stack([(column + 1 + edge) / (width + 2), (row + edge) / height], -1) * 2 - 1
    sampled = functional.grid_sample(values, grid[None], padding_mode="border", align_corners=False)[0]
    return sampled.round_().to(torch.uint8).permute(1, 2, 0).contiguous().numpy()


def _refine(rays: torch.Tensor, factor: int) -> torch.Tensor:
    """Interpolate (3, h, w) rays to (3, factor h, factor w), extrapolating within the outermost half pixels."""
    if factor == 1:
        return rays
    for axis in (1, 2):
        count = rays.shape[axis]
        position = pixel.scale(torch.arange(factor * count, dtype=rays.dtype), 1 / factor)
        before = position.floor().clamp(0, count - 2)
        weight = (position - before).view(-1, *[1] * (2 - axis))
        index = before.long()
        rays = rays.index_select(axis, index) * (1 - weight) + rays.index_select(axis, index + 1) * weight
    return rays


def _atan2(y: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
    # In pieces too small for torch to hand to several threads: where it cuts decides the last bit of some angles.
    pieces = zip(torch.split(y.flatten(), _PIECE), torch.split(x.flatten(), _PIECE), strict=True)
    return torch.cat([torch.atan2(*piece) for piece in pieces]).view_as(y)
