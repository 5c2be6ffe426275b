"""Circular arcs in a picture: what straight lines become under the one-parameter division model.

A circle or a straight line is

    A (x^2 + y^2) + B x + C y + D = 0,    B^2 + C^2 - 4 A D = 1,

so that A is half the curvature and nothing is singular where an arc is straight (Pratt 1987). The distance of a point
from it, with P the left side at the point, is

    d = 2 P / (1 + sqrt(1 + 4 A P)).

Least squares of P itself under another constraint (Kasa 1976) pulls shallow noisy arcs towards small circles; the fit
here is Taubin's (1991), then Levenberg-Marquardt on d (Chernov and Lesort, "Least Squares Fitting of Circles", 2005).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from .. import pixel
from ..sightlines import Pieces
from ..straightness import find_pieces

_SAMPLES = 60  # triples of points a chain
_SHARE = 0.6  # of a chain's points that its arc must hold
_FEWEST = 5  # points of an arc: a circle through three says nothing
_REFIT_ROUNDS = 12


@dataclass(frozen=True)
class Arcs:
    """K arcs of a picture and the edge points they were fitted to, longest chain first.

    Coordinates are relative to the picture's centre, in units of its half diagonal.
    """

    pieces: Pieces
    """The points of each arc, in their order along it."""
    circles: np.ndarray
    """(K, 4) A, B, C, D."""
    pixel: float
    """One pixel of the picture the edges were found in, which may be a reduced copy."""

    def __len__(self) -> int:
        return len(self.circles)

    def subset(self, chosen: np.ndarray) -> Arcs:
        """Give some of the arcs, by their indices (M,)."""
        if not len(chosen):
            return Arcs(Pieces(np.zeros((0, 2)), np.zeros(1, dtype=np.intp)), np.zeros((0, 4)), self.pixel)
        return Arcs(self.pieces.joined([np.array([i]) for i in chosen]), self.circles[chosen], self.pixel)


def find_chains(image: np.ndarray) -> tuple[Pieces, float]:
    """Find edge chains and say how large a pixel of theirs is.

    Args:
        image: (H, W, 3) RGB uint8.

    Returns:
        chains in the coordinates of `Arcs`, and a pixel of the picture they were found in, in the same units.
    """
    pieces, size = find_pieces(image)
    points = normalise(pieces.points, size, (image.shape[0], image.shape[1]))
    return Pieces(points, pieces.starts), 1 / half_diagonal(size)


def normalise(points: np.ndarray, size: tuple[int, int], image_size: tuple[int, int]) -> np.ndarray:
    """Give points (N, 2), in pixels of a copy of some (height, width) of a picture, the coordinates of `Arcs`."""
    (rows, columns), (height, width) = size, image_size
    scaled = [pixel.scale(points[:, 0], width / columns), pixel.scale(points[:, 1], height / rows)]
    centre = (pixel.centre(width), pixel.centre(height))
    return np.asarray((np.stack(scaled, -1) - centre) / half_diagonal(image_size))


def half_diagonal(image_size: tuple[int, int]) -> float:
    """Give the unit of the coordinates of `Arcs`, in pixels."""
    return math.hypot(*image_size) / 2


def find_arcs(
    chains: Pieces, pixel_size: float, *, tolerance_px: float, min_length: float, rng: np.random.Generator
) -> Arcs:
    """Fit an arc to each chain that has one: the circle through three of its points that most others lie near.

    Args:
        chains: in the coordinates of `Arcs`.
        pixel_size: in the same units.
        tolerance_px: distance of a point that still belongs to the arc.
        min_length: from its first point to its last, in units of the half diagonal.
        rng: draws the triples.
    """
    (long,) = np.nonzero((chains.counts >= _FEWEST) & (chains.lengths >= min_length))
    if not len(long):
        return Arcs(Pieces(np.zeros((0, 2)), np.zeros(1, dtype=np.intp)), np.zeros((0, 4)), pixel_size)
    chains = chains.joined([np.array([i]) for i in long])
    near = _near_best(chains, tolerance_px * pixel_size, rng)
    held = chains.sums(near.astype(np.float64))
    near &= ((held >= _SHARE * chains.counts) & (held >= _FEWEST))[chains.owners]
    owners = chains.owners[near]
    found, starts = np.unique(owners, return_index=True)
    pieces = Pieces(chains.points[near], np.append(starts, len(owners)))
    if not len(found):
        return Arcs(pieces, np.zeros((0, 4)), pixel_size)
    arcs = Arcs(pieces, refit(taubin(pieces), pieces), pixel_size)
    return arcs.subset(np.nonzero(pieces.lengths >= min_length)[0])


def _near_best(chains: Pieces, tolerance: float, rng: np.random.Generator) -> np.ndarray:
    """Which points lie near the best of the sampled circles of their chain: (N,) bool."""
    counts = chains.counts[:, None]
    # One point of each third: a circle through neighbours is mostly their noise.
    thirds = (np.arange(3) + rng.random((len(chains), _SAMPLES, 3))) / 3
    chosen = chains.starts[:-1, None, None] + np.minimum(
        (thirds * counts[..., None]).astype(np.intp), counts[..., None] - 1
    )
    circles = circle_through(chains.points[chosen])
    near = np.abs(distance(circles[chains.owners], chains.points[:, None])) < tolerance
    best = chains.sums(near.astype(np.float64)).argmax(-1)
    return np.asarray(near[np.arange(len(near)), best[chains.owners]])


def circle_through(points: np.ndarray) -> np.ndarray:
    """Give the circle (..., 4) through three points (..., 3, 2); NaN where two of them are one."""
    (x1, y1), (x2, y2), (x3, y3) = np.moveaxis(points - points[..., :1, :], (-2, -1), (0, 1))
    r2, r3 = x2 * x2 + y2 * y2, x3 * x3 + y3 * y3
    # The first point is the origin, so D = 0.
    circles = np.stack([x2 * y3 - x3 * y2, y2 * r3 - y3 * r2, x3 * r2 - x2 * r3, 0 * x1 + 0 * y1], -1)
    return _normed(moved(circles, points[..., 0, :]))


def moved(circles: np.ndarray, by: np.ndarray) -> np.ndarray:
    """Move circles (..., 4) by (..., 2)."""
    a, b, c, d = np.moveaxis(circles, -1, 0)
    x, y = np.moveaxis(by, -1, 0)
    return np.stack([a, b - 2 * a * x, c - 2 * a * y, d - b * x - c * y + a * (x * x + y * y)], -1)


def _normed(circles: np.ndarray) -> np.ndarray:
    a, b, c, d = np.moveaxis(circles, -1, 0)
    square = b * b + c * c - 4 * a * d
    size = np.sqrt(np.where(square > 0, square, np.nan))
    return np.asarray(circles / size[..., None])


def power(circles: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Evaluate P = A (x^2 + y^2) + B x + C y + D at points (..., 2)."""
    a, b, c, d = np.moveaxis(circles, -1, 0)
    x, y = np.moveaxis(points, -1, 0)
    return np.asarray(a * (x * x + y * y) + b * x + c * y + d)


def distance(circles: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Give the signed distances of points (..., 2) from circles (..., 4)."""
    p = power(circles, points)
    return np.asarray(2 * p / (1 + np.sqrt(np.maximum(1 + 4 * circles[..., 0] * p, 0))))


def taubin(pieces: Pieces) -> np.ndarray:
    """Fit a circle (K, 4) to each piece: least mean P^2 over the mean squared gradient of P (Taubin 1991)."""
    counts, owners = pieces.counts[:, None], pieces.owners
    middles = pieces.sums(pieces.points) / counts
    local = pieces.points - middles[owners]
    squares = (local**2).sum(-1)
    spread = np.maximum(pieces.sums(squares) / counts[:, 0], np.finfo(float).tiny)
    # With x, y and z = x^2 + y^2 from their means and A' = 2 A sqrt(mean z), |(A', B, C)| = 1 is Taubin's constraint.
    z = (squares - spread[owners]) / (2 * np.sqrt(spread))[owners]
    rows = np.concatenate([z[:, None], local], -1)
    _, axes = np.linalg.eigh(pieces.sums(rows[:, :, None] * rows[:, None, :]))
    a = axes[:, 0, 0] / (2 * np.sqrt(spread))
    circles = np.stack([a, axes[:, 1, 0], axes[:, 2, 0], -a * spread], -1)
    return _normed(moved(circles, middles))


def refit(circles: np.ndarray, pieces: Pieces) -> np.ndarray:
    """Improve circles (K, 4) by Levenberg-Marquardt on the squared distances of their pieces' points.

    In Chernov and Lesort's A, D and phi with B = E cos(phi), C = E sin(phi), E^2 = 1 + 4 A D, about the points' middle:
    dd/dP = 1 / Q and dd/dA = -d^2 / Q with Q = sqrt(1 + 4 A P).
    """
    owners = pieces.owners
    middles = pieces.sums(pieces.points) / pieces.counts[:, None]
    local = pieces.points - middles[owners]
    x, y = local.T
    circles = moved(circles, -middles)
    damping = np.full(len(pieces), 1e-3)
    d = distance(circles[owners], local)
    cost = pieces.sums(d * d)
    for _ in range(_REFIT_ROUNDS):
        a, b, c, constant = circles.T
        e, phi = np.hypot(b, c), np.arctan2(c, b)
        along = (x * np.cos(phi)[owners] + y * np.sin(phi)[owners]) * 2
        q = np.sqrt(np.maximum(1 + 4 * a[owners] * power(circles[owners], local), 1e-6))
        by_a = x * x + y * y + along * (constant / e)[owners] - d * d
        by_constant = 1 + along * (a / e)[owners]
        by_phi = (y * np.cos(phi)[owners] - x * np.sin(phi)[owners]) * e[owners]
        slopes = np.stack([by_a, by_constant, by_phi], -1) / q[:, None]
        hessian = pieces.sums(slopes[:, :, None] * slopes[:, None, :])
        gradient = pieces.sums(slopes * d[:, None])
        diagonal = np.einsum("kii->ki", hessian) * damping[:, None] + np.finfo(float).tiny
        step = np.linalg.solve(hessian + diagonal[:, :, None] * np.eye(3), -gradient[..., None])[..., 0]
        a, constant, phi = a + step[:, 0], constant + step[:, 1], phi + step[:, 2]
        e = np.sqrt(np.maximum(1 + 4 * a * constant, 0))
        tried = np.stack([a, e * np.cos(phi), e * np.sin(phi), constant], -1)
        d_tried = distance(tried[owners], local)
        cost_tried = pieces.sums(d_tried * d_tried)
        better = (cost_tried < cost) & (e > 0)
        circles = np.where(better[:, None], tried, circles)
        d = np.where(better[owners], d_tried, d)
        cost = np.where(better, cost_tried, cost)
        damping *= np.where(better, 0.1, 10.0)
    return moved(circles, middles)
