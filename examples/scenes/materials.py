"""Procedural surface textures, filtered over the footprint a pixel has on the surface."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

TABLE_SIZE = 256


def rgb(code: str) -> np.ndarray:
    """Linear RGB (3,) in [0, 1] of an sRGB colour code such as "#c8b6a6"."""
    encoded = np.array([int(code[i : i + 2], 16) for i in (1, 3, 5)]) / 255
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def _noise_table() -> np.ndarray:
    """Periodic 1/f noise (TABLE_SIZE, TABLE_SIZE) of zero mean and unit deviation."""
    frequency = np.hypot(*np.meshgrid(*[np.fft.fftfreq(TABLE_SIZE, 1 / TABLE_SIZE)] * 2))
    frequency[0, 0] = np.inf
    # Below 4 cycles the tile would show its repetition; above 48 it would only alias.
    band = np.where((frequency >= 4) & (frequency <= 48), frequency**-1.2, 0)
    white = np.random.default_rng(5).standard_normal((TABLE_SIZE, TABLE_SIZE))
    table = np.fft.ifft2(np.fft.fft2(white) * band).real
    return (table / table.std()).astype(np.float32)


_NOISE = _noise_table().ravel()
_RANDOM = np.random.default_rng(7).random(4096).astype(np.float32)


def noise(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Smooth noise (N,) of unit deviation, with features from 1/4 down to 1/48 of a unit."""
    x, y = u * TABLE_SIZE, v * TABLE_SIZE
    left, top = np.floor(x), np.floor(y)
    fx, fy = x - left, y - top
    mask = TABLE_SIZE - 1
    column, row = left.astype(np.int64) & mask, top.astype(np.int64) & mask
    right, below = (column + 1) & mask, ((row + 1) & mask) * TABLE_SIZE
    row *= TABLE_SIZE
    upper = _NOISE[row + column] * (1 - fx) + _NOISE[row + right] * fx
    lower = _NOISE[below + column] * (1 - fx) + _NOISE[below + right] * fx
    return upper * (1 - fy) + lower * fy


def cell_random(*cells: np.ndarray | int) -> np.ndarray:
    """A fixed random number in [0, 1) for each combination of integer cell coordinates."""
    key = np.int64(0)
    for factor, cell in zip((7919, 104729, 1299709), cells, strict=False):
        key = key + np.asarray(cell).astype(np.int64) * factor
    return _RANDOM[(key ^ (key >> 7)) & 4095]


def stripes(x: np.ndarray, period: float, width: float, footprint: np.ndarray) -> np.ndarray:
    """Share (N,) of [x - footprint/2, x + footprint/2] covered by stripes [0, width) + k period."""

    def integral(t: np.ndarray) -> np.ndarray:
        whole = np.floor(t / period)
        return whole * width + np.minimum(t - whole * period, width)

    span = np.maximum(footprint, 1e-7)
    return (integral(x + span / 2) - integral(x - span / 2)) / span


def band(x: np.ndarray, start: float, stop: float, footprint: np.ndarray) -> np.ndarray:
    """Share (N,) of [x - footprint/2, x + footprint/2] that lies between start and stop."""
    span = np.maximum(footprint, 1e-7)
    return np.clip((np.minimum(x + span / 2, stop) - np.maximum(x - span / 2, start)) / span, 0, 1)


def _fade(size: float, footprint: np.ndarray) -> np.ndarray:
    """How much of a detail of this size survives a footprint, from 1 to 0."""
    return 1 / (1 + (footprint / size) ** 2)


def mix(a: np.ndarray, b: np.ndarray, share: np.ndarray) -> np.ndarray:
    """a (N, 3) where share (N,) is 0, b where it is 1."""
    return a + (b - a) * share[:, None]


@dataclass(frozen=True)
class Surface:
    """N surface points as a texture sees them.

    `u`, `v` (N,) are metres on the face, v along the height on upright faces; `du`, `dv` (N,) the
    pixel's extent along them; `a`, `b` (N,) the same position from 0 to 1 across the face; `edge`
    (N,) the distance in metres to the border of the face. `position`, `normal`, `ray`, `colour`
    are (N, 3), in world axes and linear RGB.
    """

    u: np.ndarray
    v: np.ndarray
    du: np.ndarray
    dv: np.ndarray
    a: np.ndarray
    b: np.ndarray
    edge: np.ndarray
    position: np.ndarray
    normal: np.ndarray
    ray: np.ndarray
    colour: np.ndarray


Texture = Callable[[Surface], np.ndarray]


@dataclass(frozen=True, eq=False)
class Material:
    """A texture giving linear RGB (N, 3): reflected light, or emitted light when `emits`.

    `reflectance` is the mirror reflection at normal incidence, from 0 to 1.
    """

    texture: Texture
    reflectance: float = 0.0
    emits: bool = False


def painted(mottle: float = 0.015, reflectance: float = 0.0, arris: float = 0.0) -> Material:
    """Paint, plaster or cloth of the solid's colour with a faint mottle.

    Faces darken by the share `arris` along their borders, as joints and rounded edges do.
    """

    def texture(s: Surface) -> np.ndarray:
        width = np.maximum(s.du, s.dv)
        tone = 1 + mottle * _fade(0.05, width) * noise(s.u / 3, s.v / 3)
        if arris:
            tone *= 1 - arris * band(s.edge, -0.005, 0.005, width)
        return s.colour * tone[:, None]

    return Material(texture, reflectance)


def wood(reflectance: float = 0.0, horizontal: bool = True) -> Material:
    """Wood with its grain running along u (or v)."""

    def texture(s: Surface) -> np.ndarray:
        along, across, width = (s.u, s.v, s.dv) if horizontal else (s.v, s.u, s.du)
        grain = noise(along / 9, across / 0.9)
        return s.colour * np.exp(0.13 * _fade(0.012, width) * grain)[:, None]

    return Material(texture, reflectance)


def planks(width: float, length: float, reflectance: float) -> Material:
    """Floor boards along v, each with a tone and a grain of its own."""

    def texture(s: Surface) -> np.ndarray:
        row = np.floor(s.u / width)
        shifted = s.v + length * cell_random(row, 3)
        column = np.floor(shifted / length)
        tone = cell_random(row, column, 11) - 0.5
        grain = noise(shifted / 7 + tone, s.u / 0.8 + 5 * tone)
        detail = _fade(width, s.du)
        board = s.colour * np.exp(0.55 * tone * detail + 0.12 * grain * _fade(0.012, s.du))[:, None]
        gap = stripes(s.u, width, 0.004, s.du)
        butt = stripes(shifted, length, 0.004, s.dv)
        return mix(board, s.colour * 0.16, np.maximum(gap, butt))

    return Material(texture, reflectance)


def bricks(mortar: np.ndarray, length: float = 0.24, height: float = 0.077) -> Material:
    """Running-bond brickwork of the solid's colour."""
    joint = 0.011

    def texture(s: Surface) -> np.ndarray:
        row = np.floor(s.v / height)
        shifted = s.u + (row % 2) * length / 2
        tone = cell_random(row, np.floor(shifted / length)) - 0.5
        face = s.colour * np.exp(0.5 * tone * _fade(length / 2, s.du) + 0.10 * noise(s.u / 2, s.v / 2))[:, None]
        bed = stripes(s.v, height, joint, s.dv)
        head = stripes(shifted, length, joint, s.du)
        return mix(face, np.broadcast_to(mortar, face.shape), 1 - (1 - bed) * (1 - head))

    return Material(texture)


def tiles(
    size: tuple[float, float],
    grout: np.ndarray,
    *,
    joint: float = 0.006,
    second: np.ndarray | None = None,
    variation: float = 0.1,
    reflectance: float = 0.0,
) -> Material:
    """Square-laid tiles or slabs, in alternating colours when `second` (3,) is given."""

    def texture(s: Surface) -> np.ndarray:
        column, row = np.floor(s.u / size[0]), np.floor(s.v / size[1])
        detail = _fade(min(size), np.maximum(s.du, s.dv))
        tone = (cell_random(row, column, 2) - 0.5) * variation * detail
        face = s.colour
        if second is not None:
            odd = stripes(s.u, 2 * size[0], size[0], s.du)
            face = mix(face, second, odd + (1 - 2 * odd) * stripes(s.v, 2 * size[1], size[1], s.dv))
        face = face * np.exp(tone + 0.04 * noise(s.u / 1.3, s.v / 1.3))[:, None]
        lines = 1 - (1 - stripes(s.u, size[0], joint, s.du)) * (1 - stripes(s.v, size[1], joint, s.dv))
        return mix(face, np.broadcast_to(grout, face.shape), lines)

    return Material(texture, reflectance)


def slats(period: float, gap: float) -> Material:
    """Vertical boards or folds with dark gaps between them."""

    def texture(s: Surface) -> np.ndarray:
        return s.colour * (1 - 0.55 * stripes(s.u, period, gap, s.du))[:, None]

    return Material(texture)


def glowing() -> Material:
    """A lamp: the colour is the radiance it emits."""
    return Material(lambda s: s.colour, emits=True)


def chessboard(square: float, origin: tuple[float, float], dark: np.ndarray) -> Material:
    """Squares of the solid's colour and of `dark` (3,), one dark square's corner at `origin` (2,).

    The origin is in metres in the face's (u, v).
    """

    def texture(s: Surface) -> np.ndarray:
        across = stripes(s.u - origin[0], 2 * square, square, s.du)
        up = stripes(s.v - origin[1], 2 * square, square, s.dv)
        return mix(s.colour, dark, across * up + (1 - across) * (1 - up))

    return Material(texture)
