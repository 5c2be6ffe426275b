"""Curved lines of a picture: sub-pixel edge points, linked to smooth chains.

A straight line of the scene is a smooth curve in a fisheye picture. Chains end at corners and where they leave a
smooth curve, so that each is a candidate for one line; which of them are straight in the scene only a camera can tell.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

SIGMA = 1.0
"""Smoothing before differentiation, in pixels: an arc of radius r moves inwards by sigma^2 / 2r, 0.005 px at 100."""
LOW, HIGH = 1.0, 3.0
"""Slope of the smoothed picture, in grey levels a pixel, that an edge point and a chain on average must reach."""

_REACH = 2  # a chain bridges a gap of one pixel
_SAME_DIRECTION = 0.8  # cosine between the gradients of neighbours in a chain
_CORNER_ARM, _CORNER_SINE = 4, 0.3  # px, sine of the turn: an arc of a lens turns by 3 degrees over two arms
_SMOOTH_PX = 0.6  # from the cubic through a chain
_SMOOTH_ROUNDS = 5
_INNER = 0.75


@dataclass(frozen=True)
class Chains:
    """Edge points of several chains, one after the other, longest chain first."""

    points: np.ndarray
    """(N, 2) x, y in pixels."""
    gradients: np.ndarray
    """(N, 2) unit vectors towards the brighter side."""
    slopes: np.ndarray
    """(N,) grey levels a pixel."""
    starts: np.ndarray
    """(K + 1,) the points of chain i are starts[i] to starts[i + 1]."""

    def __len__(self) -> int:
        return len(self.starts) - 1

    @property
    def owners(self) -> np.ndarray:
        """(N,) the chain of each point."""
        return np.repeat(np.arange(len(self)), np.diff(self.starts))


def find_chains(grey: np.ndarray, *, min_length: float = 12.0) -> Chains:
    """Find edge chains in a grey picture.

    Edge points are the maxima of the gradient (Canny 1986) along the row or column it is closest to, refined by a
    parabola through its logarithm: exact for a blurred step. Points are linked where each is the other's best
    successor and predecessor (after Grompone von Gioi and Randall, "A Sub-Pixel Edge Detector", IPOL 2017).

    Args:
        grey: (H, W) uint8 or floating, in grey levels of 0..255.
        min_length: between a chain's ends, in pixels.
    """
    points, gradients, slopes, pixels = _edge_points(grey)
    order, starts = _linked(points, gradients, pixels, grey.shape)
    points, gradients, slopes = points[order], gradients[order], slopes[order]
    points, gradients, slopes, starts = _cut(points, gradients, slopes, starts, ~_corners(points, starts))
    for _ in range(_SMOOTH_ROUNDS if len(starts) > 1 else 0):
        deviation, s = _cubic_deviation(points, starts)
        owners = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
        rough = np.maximum.reduceat(deviation, starts[:-1]) > _SMOOTH_PX
        inner = np.where(np.abs(s) < _INNER, deviation, 0)  # at an end a cut would only take a point away
        cut = rough[owners] & (inner > 0) & (inner == np.maximum.reduceat(inner, starts[:-1])[owners])
        if not cut.any():
            break
        points, gradients, slopes, starts = _cut(points, gradients, slopes, starts, ~cut)
    return _longest_first(points, gradients, slopes, starts, min_length)


def _edge_points(grey: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Points (N, 2), unit gradients (N, 2), slopes (N,) and the pixels (N, 2) as row, column."""
    radius = int(np.ceil(4 * SIGMA))
    u = np.arange(-radius, radius + 1, dtype=np.float64)
    smooth = np.exp(-u * u / (2 * SIGMA**2))
    smooth /= smooth.sum()
    derivative = u * smooth / (u * u * smooth).sum()
    picture = grey.astype(np.float32)
    border = cv2.BORDER_REFLECT_101
    gx = cv2.sepFilter2D(picture, cv2.CV_32F, derivative, smooth, borderType=border)
    gy = cv2.sepFilter2D(picture, cv2.CV_32F, smooth, derivative, borderType=border)
    m = cv2.magnitude(gx, gy)

    inner, steep = m[1:-1, 1:-1], np.abs(gx[1:-1, 1:-1]) >= np.abs(gy[1:-1, 1:-1])
    before = np.where(steep, m[1:-1, :-2], m[:-2, 1:-1])
    after = np.where(steep, m[1:-1, 2:], m[2:, 1:-1])
    row, column = np.nonzero((inner > LOW) & (inner > before) & (inner >= after))
    steep = steep[row, column]
    a, b, c = (np.log(np.maximum(v[row, column], 1e-3).astype(np.float64)) for v in (before, inner, after))
    shift = (c - a) / (2 * (2 * b - a - c))  # of the parabola's top; within half a pixel, as b is the largest
    row, column = row + 1, column + 1
    points = np.stack([column + steep * shift, row + ~steep * shift], -1)
    slopes = m[row, column].astype(np.float64)
    gradients = np.stack([gx[row, column], gy[row, column]], -1) / slopes[:, None]
    return points, gradients, slopes, np.stack([row, column], -1)


def _linked(
    points: np.ndarray, gradients: np.ndarray, pixels: np.ndarray, shape: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Order the points along chains: indices (M,) of those in chains, and where chains start (K + 1,)."""
    count = len(points)
    margin = _REACH
    index = np.full((shape[0] + 2 * margin, shape[1] + 2 * margin), -1)
    index[pixels[:, 0] + margin, pixels[:, 1] + margin] = np.arange(count)
    tangents = np.stack([-gradients[:, 1], gradients[:, 0]], -1)
    best = np.full((2, count), -1)  # successor, predecessor
    least = np.full((2, count), np.inf)
    for dy in range(-margin, margin + 1):
        for dx in range(-margin, margin + 1):
            j = index[pixels[:, 0] + margin + dy, pixels[:, 1] + margin + dx]
            (i,) = np.nonzero(j >= 0)
            if dx == dy == 0 or not len(i):
                continue
            j = j[i]
            step = points[j] - points[i]
            along = (step * tangents[i]).sum(-1)
            across = (step * gradients[i]).sum(-1)
            agree = (gradients[i] * gradients[j]).sum(-1)
            cost = np.hypot(along, 3 * across)  # an edge goes on along itself
            usable = (agree > _SAME_DIRECTION) & (np.abs(across) < np.abs(along))
            for side, forward in enumerate((along > 0, along < 0)):
                better = usable & forward & (cost < least[side, i])
                best[side, i[better]], least[side, i[better]] = j[better], cost[better]
    successor, predecessor = best
    mutual = (successor >= 0) & (predecessor[successor] == np.arange(count))
    following = np.where(mutual, successor, -1)
    first = np.ones(count, dtype=bool)
    first[following[mutual]] = False

    order: list[int] = []
    starts = [0]
    after = following.tolist()
    # Open chains from their first points, then what is left: closed ones, from anywhere.
    for start in [*np.nonzero(first & mutual)[0].tolist(), *np.nonzero(~first & mutual)[0].tolist()]:
        place: int = start
        while place >= 0:
            order.append(place)
            following_place, after[place] = after[place], -1
            place = following_place
        if len(order) - starts[-1] > 1:
            starts.append(len(order))
        else:
            order.pop()  # walked before
    return np.array(order, dtype=np.intp), np.array(starts)


def _corners(points: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """Where a chain turns sharply: (N,) bool."""
    place = np.arange(len(points))
    lengths = np.diff(starts)
    first, last = np.repeat(starts[:-1], lengths), np.repeat(starts[1:] - 1, lengths)
    before = points - points[np.maximum(place - _CORNER_ARM, first)]
    after = points[np.minimum(place + _CORNER_ARM, last)] - points
    cross = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    size = np.linalg.norm(before, axis=-1) * np.linalg.norm(after, axis=-1)
    inside = (place - first >= _CORNER_ARM) & (last - place >= _CORNER_ARM)
    return np.asarray(inside & ((np.abs(cross) > _CORNER_SINE * size) | ((before * after).sum(-1) < 0)))


def _cut(
    points: np.ndarray, gradients: np.ndarray, slopes: np.ndarray, starts: np.ndarray, keep: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Take points out, cutting chains there."""
    owners = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
    pieces = (owners * (len(points) + 1) + np.cumsum(~keep))[keep]
    starts = np.concatenate([[0], np.nonzero(np.diff(pieces))[0] + 1, [len(pieces)]])
    return points[keep], gradients[keep], slopes[keep], np.unique(starts)


def _cubic_deviation(points: np.ndarray, starts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How far each point lies from the cubic curve through its chain, in pixels, and where on it, in [-1, 1]: (N,)."""
    lengths = np.diff(starts)
    owners = np.repeat(np.arange(len(lengths)), lengths)
    steps = np.linalg.norm(np.diff(points, axis=0, prepend=points[:1]), axis=-1)
    s = np.cumsum(steps)
    low, high = s[starts[:-1]], s[starts[1:] - 1]
    s = 2 * (s - low[owners]) / np.maximum(high - low, 1e-9)[owners] - 1
    basis = np.stack([np.ones_like(s), s, 1.5 * s * s, 2.5 * s**3 - 1.5 * s], -1)  # Legendre's, nearly orthogonal
    middle = points[starts[:-1]]
    local = points - middle[owners]
    normal = np.add.reduceat(basis[:, :, None] * basis[:, None, :], starts[:-1])
    right = np.add.reduceat(basis[:, :, None] * local[:, None, :], starts[:-1])
    solution = np.linalg.solve(normal + 1e-6 * np.eye(4), right)
    fitted = (basis[:, :, None] * solution[owners]).sum(1)
    return np.asarray(np.linalg.norm(local - fitted, axis=-1)), s


def _longest_first(
    points: np.ndarray, gradients: np.ndarray, slopes: np.ndarray, starts: np.ndarray, min_length: float
) -> Chains:
    counts = np.diff(starts)
    if not len(counts):
        return Chains(points, gradients, slopes, np.zeros(1, dtype=np.intp))
    length = np.linalg.norm(points[starts[1:] - 1] - points[starts[:-1]], axis=-1)
    strength = np.add.reduceat(slopes, starts[:-1]) / counts
    (kept,) = np.nonzero((length >= min_length) & (strength > HIGH))
    kept = kept[np.argsort(-length[kept], kind="stable")]
    order = np.concatenate([np.arange(starts[i], starts[i + 1]) for i in kept] or [np.zeros(0, dtype=np.intp)])
    return Chains(points[order], gradients[order], slopes[order], np.concatenate([[0], np.cumsum(counts[kept])]))
