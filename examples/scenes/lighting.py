"""Light: the sun, soft light from windows and sky kept on a grid, and the tone curve."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .solids import Solid

AXES = np.concatenate([np.eye(3), -np.eye(3)])
"""The six directions (6, 3) an ambient light is kept for."""


@dataclass(frozen=True)
class Sun:
    """Light from far away: the unit direction (3,) towards it and its radiance (3,)."""

    direction: np.ndarray
    radiance: np.ndarray


@dataclass(frozen=True)
class AreaLight:
    """A small glowing patch: centre (3,) and outward normal (3,) in metres, area in m^2."""

    centre: np.ndarray
    normal: np.ndarray
    area: float


@dataclass(frozen=True)
class AmbientLayer:
    """One kind of soft light: its share (6, X, Y, Z) per direction and its radiance (6, 3)."""

    share: np.ndarray
    radiance: np.ndarray


class Occupancy:
    """How much of each voxel of a box of space is filled: the source of all soft shadows.

    The box runs from `lo` (3,) to `hi` (3,) in voxels of `voxel` metres.
    """

    def __init__(self, solids: Sequence[Solid], lo: np.ndarray, hi: np.ndarray, voxel: float):
        self.lo, self.voxel = np.asarray(lo, dtype=float), voxel
        shape = np.ceil((np.asarray(hi) - self.lo) / voxel).astype(int)
        self.filled = np.zeros(shape, dtype=np.float32)
        casters = [solid for solid in solids if solid.casts_shadow]
        starts = (np.array([solid.lo for solid in casters]) - self.lo) / voxel
        stops = (np.array([solid.hi for solid in casters]) - self.lo) / voxel
        firsts = np.clip(np.floor(starts).astype(int), 0, shape)
        lasts = np.clip(np.ceil(stops).astype(int), 0, shape)
        for solid, *bounds in zip(casters, starts, stops, firsts, lasts, strict=True):
            cover = []
            for start, stop, first, last in zip(*bounds, strict=True):
                cell = np.arange(first, last)
                cover.append(np.minimum(stop, cell + 1) - np.maximum(start, cell))
            block = cover[0][:, None, None] * cover[1][:, None] * cover[2]
            region = tuple(map(slice, bounds[2], bounds[3]))
            self.filled[region] += block * solid.shape.value
        np.minimum(self.filled, 1, out=self.filled)

    def blurred(self, radius: float) -> np.ndarray:
        """Mean filling (X, Y, Z) of the cube reaching `radius` metres each way."""
        reach = max(1, round(radius / self.voxel))
        volume = self.filled
        for axis in range(3):
            ends = [(reach + 1, reach) if i == axis else (0, 0) for i in range(3)]
            total = np.pad(volume, ends, mode="edge").cumsum(axis, dtype=np.float32)
            size = volume.shape[axis]
            width = 2 * reach + 1
            volume = (total.take(range(width, width + size), axis) - total.take(range(size), axis)) / width
        return volume

    def openness(self, reaches: dict[float, float]) -> np.ndarray:
        """Share of soft light (6, X, Y, Z) that arrives; `reaches` maps a radius in metres to the
        strength of the darkening by what lies within it."""
        share = np.ones((6, *self.filled.shape), dtype=np.float32)
        for radius, strength in reaches.items():
            dimming = 1 - strength * self.blurred(radius)
            # Looking one radius ahead keeps the surface itself out of its own shadow.
            step = max(1, round(radius / self.voxel)) + 1
            for direction, axis in enumerate(AXES):
                dimension = int(np.abs(axis).argmax())
                size = dimming.shape[dimension]
                ahead = np.clip(np.arange(size) + step * int(axis[dimension]), 0, size - 1)
                share[direction] *= dimming.take(ahead, dimension)
        return share

    def lit_by(self, lights: Sequence[AreaLight]) -> np.ndarray:
        """Irradiance (6, X, Y, Z) from area lights of radiance 1 / pi, softly shadowed."""
        shape = self.filled.shape
        cells = np.indices(shape, dtype=np.float32).reshape(3, -1)
        cones = [(t, self.blurred(0.35 * t).ravel()) for t in (0.25, 0.5, 1.0, 1.8)]
        share = np.zeros((6, cells.shape[1]), dtype=np.float32)
        for light in lights:
            target = ((light.centre - self.lo) / self.voxel - 0.5).astype(np.float32)
            towards = target[:, None] - cells
            distance = np.sqrt((towards * towards).sum(0)) + np.float32(1e-3)
            towards /= distance
            distance *= np.float32(self.voxel)
            facing = np.maximum(-light.normal.astype(np.float32) @ towards, 0)
            flux = facing * np.float32(light.area) / (np.float32(np.pi) * distance**2 + light.area)
            for t, blurred in cones:
                reach = np.minimum(np.float32(t), 0.8 * distance) / np.float32(self.voxel)
                column = np.zeros(cells.shape[1], dtype=np.int32)
                for axis, size in enumerate(shape):
                    cell = (cells[axis] + reach * towards[axis] + 0.5).astype(np.int32)
                    column = column * size + np.clip(cell, 0, size - 1)
                flux *= 1 - np.minimum(0.9 * blurred[column], 1)
            for direction, axis in enumerate(AXES.astype(np.float32)):
                share[direction] += flux * np.maximum(axis @ towards, 0)
        return share.reshape(6, *shape)


class AmbientLight:
    """Soft light looked up between the voxels of a grid that starts at `lo` (3,)."""

    def __init__(self, lo: np.ndarray, voxel: float, layers: Sequence[AmbientLayer]) -> None:
        self._lo, self._voxel = np.asarray(lo, dtype=float)[:, None], voxel
        self._shape = np.array(layers[0].share.shape[1:])
        self._shares = [layer.share.reshape(6, -1) for layer in layers]
        self._radiances = [np.asarray(layer.radiance) for layer in layers]

    def irradiance(self, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Irradiance over pi (N, 3) at points (3, N) with unit normals (3, N)."""
        total = np.zeros((points.shape[1], 3))
        # One voxel off the surface: the cells below it are inside the solid.
        cell = (points + normals * self._voxel - self._lo) / self._voxel - 0.5
        cell = np.clip(cell, 0, (self._shape - 1.001)[:, None])
        for direction, axis in enumerate(AXES):
            facing = axis @ normals
            rows = np.flatnonzero(facing > 1e-3)
            if rows.size == 0:
                continue
            weight = facing[rows] ** 2
            base, corners = self._corners(cell[:, rows])
            for share, radiance in zip(self._shares, self._radiances, strict=True):
                amount = sum(share[direction, base + offset] * w for offset, w in corners)
                total[rows] += (weight * amount)[:, None] * radiance[direction]
        return total

    def _corners(self, cell: np.ndarray) -> tuple[np.ndarray, list[tuple[int, np.ndarray]]]:
        whole = cell.astype(np.int64)
        part = cell - whole
        stride = (int(self._shape[1] * self._shape[2]), int(self._shape[2]), 1)
        corners = [(0, np.ones(cell.shape[1]))]
        for axis in range(3):
            corners = [(o, w * (1 - part[axis])) for o, w in corners] + [
                (o + stride[axis], w * part[axis]) for o, w in corners
            ]
        return stride[0] * whole[0] + stride[1] * whole[1] + whole[2], corners


def tone_curve(radiance: np.ndarray) -> np.ndarray:
    """Scene radiance to display light in [0, 1]: soft in the highlights."""
    return 1 - np.exp(-1.25 * np.maximum(radiance, 0) ** 1.12)


def encode_srgb(light: np.ndarray) -> np.ndarray:
    """Linear display light in [0, 1] to uint8 sRGB."""
    light = np.clip(light, 0, 1)
    encoded = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.round(255 * encoded).astype(np.uint8)
