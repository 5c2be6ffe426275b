"""Lines seen through a lens: how far edge points lie from them, which pieces belong together, where they vanish.

All rays that meet a straight line of the scene lie in one plane through the camera's centre. With its normal n, and
with parallel lines of the scene meeting in the direction v,

    n . ray(p) = 0    for every point p of the line's image,
    n . v = 0         for every line of a parallel family.

Neither knows a favoured scale or direction, and both hold beyond 180 degrees. Distances are in pixels of the fisheye
picture: e / |de/dp|, e = n . ray(p) (Sampson 1982).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from .cameras import FisheyeCamera

_MIN_SLOPE = 1e-6  # of e over a pixel: a picture is never so small that this bites
_PARALLEL_SINE = 0.05  # a line through its own vanishing point says nothing about it


@dataclass(frozen=True)
class Pieces:
    """Edge points of K pieces of lines, one after the other."""

    points: np.ndarray
    """(N, 2) in pixels."""
    starts: np.ndarray
    """(K + 1,) the points of piece i are starts[i] to starts[i + 1]."""

    def __len__(self) -> int:
        return len(self.starts) - 1

    @cached_property
    def counts(self) -> np.ndarray:
        """(K,) how many points each has."""
        return np.diff(self.starts)

    @cached_property
    def owners(self) -> np.ndarray:
        """(N,) the piece of each point."""
        return np.repeat(np.arange(len(self)), self.counts)

    @cached_property
    def lengths(self) -> np.ndarray:
        """(K,) from the first point to the last, in pixels."""
        return np.asarray(np.linalg.norm(self.points[self.starts[1:] - 1] - self.points[self.starts[:-1]], axis=-1))

    def sums(self, values: np.ndarray) -> np.ndarray:
        """Add up values of points (N, ...) over each piece: (K, ...)."""
        return np.asarray(np.add.reduceat(values, self.starts[:-1]))

    def joined(self, groups: list[np.ndarray]) -> Pieces:
        """Make one piece of each group of pieces."""
        spans = [np.arange(self.starts[i], self.starts[i + 1]) for group in groups for i in group]
        counts = [int(self.counts[group].sum()) for group in groups]
        return Pieces(self.points[np.concatenate(spans)], np.concatenate([[0], np.cumsum(counts)]))


@dataclass(frozen=True)
class Incidence:
    """e = n . ray(p) and its derivatives, for N points and a plane's normal each."""

    e: np.ndarray
    """(N,); 0 where not seen."""
    by_theta_d: np.ndarray
    """(N,) de/d(theta_d), outwards."""
    by_point: np.ndarray
    """(N, 2) de/dp, per pixel."""

    @cached_property
    def slope(self) -> np.ndarray:
        """(N,) |de/dp|."""
        return np.asarray(np.maximum(np.hypot(self.by_point[:, 0], self.by_point[:, 1]), _MIN_SLOPE))


class Sight:
    """Points seen through a Kannala-Brandt camera.

    With (u, v) = ((x - cx) / fx, (y - cy) / fy) = d (a, b) and theta_d(theta) = d, the ray is
    (a sin theta, b sin theta, cos theta).

    Args:
        params: (8,) fx, fy, cx, cy, k1..k4.
        image_size: (height, width) of the picture.
        points: (N, 2) in pixels.
    """

    def __init__(self, params: np.ndarray, image_size: tuple[int, int], points: np.ndarray) -> None:
        k1, k2, k3, k4 = params[4:]
        rays, self.seen = FisheyeCamera(params, image_size).unproject(points)
        self.rays = np.where(self.seen[:, None], rays, (0.0, 0.0, 1.0))
        self.focal = params[:2]
        self.offset = (points - params[2:4]) / self.focal
        u, v = self.offset.T
        d = np.maximum(np.hypot(u, v), 1e-9)
        self.a, self.b = u / d, v / d
        self.sine, self.cosine = np.hypot(self.rays[:, 0], self.rays[:, 1]), self.rays[:, 2]
        self.theta = np.arctan2(self.sine, self.cosine)
        self.turn = np.where(d > 1e-6, self.sine / d, 1.0)
        q = self.theta * self.theta
        self.theta_d_slope = np.maximum(1 + q * (3 * k1 + q * (5 * k2 + q * (7 * k3 + q * 9 * k4))), 1e-3)

    def incidence(self, normals: np.ndarray) -> Incidence:
        """Evaluate n . ray(p) for a normal each, (N, 3).

        de/d(theta_d) = n . (a cos theta, b cos theta, -sin theta) / theta_d', and across it, by the angle phi about
        the axis, (de/dphi) / d = n . (-b, a, 0) sin(theta) / d.
        """
        nx, ny, nz = normals.T
        by_theta_d = ((nx * self.a + ny * self.b) * self.cosine - nz * self.sine) / self.theta_d_slope
        across = (ny * self.a - nx * self.b) * self.turn
        by_offset = np.stack([by_theta_d * self.a - across * self.b, by_theta_d * self.b + across * self.a], -1)
        return Incidence((normals * self.rays).sum(-1) * self.seen, by_theta_d, by_offset / self.focal)

    def by_camera(self, incidence: Incidence) -> np.ndarray:
        """Give de/d(fx, fy, cx, cy, k1..k4), (N, 8): for k_i, d(theta)/dk_i = -theta^(2i+1) / theta_d'."""
        by_k = [-incidence.by_theta_d * self.theta ** (2 * i + 1) for i in range(1, 5)]
        columns = [-incidence.by_point * self.offset, -incidence.by_point, np.stack(by_k, -1)]
        return np.asarray(np.concatenate(columns, -1) * self.seen[:, None])


@dataclass(frozen=True)
class Fit:
    """The best line through each piece under one camera."""

    frames: np.ndarray
    """(K, 3, 3) orthonormal columns: the plane's normal, the other direction in the plane, the piece's middle."""
    sight: Sight
    """Of the points."""
    incidence: Incidence
    """Of the points and their pieces' planes."""
    distances: np.ndarray
    """(N,) from the line, in pixels, signed; 0 for points the camera does not see."""
    mean_square: np.ndarray
    """(K,) of the distances."""

    @property
    def normals(self) -> np.ndarray:
        """(K, 3)."""
        return self.frames[:, :, 0]


def fit_lines(pieces: Pieces, params: np.ndarray, image_size: tuple[int, int]) -> Fit:
    """Fit a line to each piece by least squares of the distances, the slopes |de/dp| held from the round before."""
    sight = Sight(params, image_size, pieces.points)
    products = sight.rays[:, :, None] * sight.rays[:, None, :]
    weights = sight.seen.astype(np.float64)
    for _ in range(2):
        _, frames = np.linalg.eigh(pieces.sums(weights[:, None, None] * products))
        here = sight.incidence(frames[pieces.owners, :, 0])
        weights = sight.seen / here.slope**2
    distances = here.e / here.slope
    return Fit(frames, sight, here, distances, pieces.sums(distances**2) / pieces.counts)


def feet(pieces: Pieces, fit: Fit, params: np.ndarray, image_size: tuple[int, int]) -> Sight:
    """Look at the nearest points of the lines, where derivatives of the distances are those of e over |de/dp|.

    At the edge points themselves they are not: there |de/dp| changes with the camera as well, and leaving that out
    favours cameras that shrink e.
    """
    step = (fit.distances / fit.incidence.slope)[:, None] * fit.incidence.by_point
    return Sight(params, image_size, pieces.points - step)


def merge(
    pieces: Pieces, params: np.ndarray, image_size: tuple[int, int], *, tolerance: float, straight: float
) -> list[np.ndarray]:
    """Group pieces that lie on one line: what bends, bends with the square of its length.

    Longest first, each piece collects those whose ends and middle lie near its line, which is then fitted anew.

    Args:
        pieces: longest first.
        params: (8,) of the camera.
        image_size: (height, width).
        tolerance: largest distance of an end or a middle, in pixels.
        straight: largest RMS distance of a piece from its own line, in pixels.

    Returns:
        Indices of the pieces in each group; every piece is in one.
    """
    fit = fit_lines(pieces, params, image_size)
    first, last = pieces.starts[:-1], pieces.starts[1:] - 1
    marks = np.stack([first, (first + last) // 2, last], -1)
    mark_rays, pixels = fit.sight.rays[marks], 1 / fit.incidence.slope[marks]
    weighted = fit.sight.rays * (fit.sight.seen / fit.incidence.slope**2)[:, None]
    moments = pieces.sums(weighted[:, :, None] * fit.sight.rays[:, None, :])
    free = fit.mean_square < straight**2
    near = (np.abs(mark_rays @ fit.normals.T) * pixels[:, :, None]).max(1) < tolerance  # of piece j's line is i: (i, j)
    near &= free[:, None]
    groups = []
    for i in range(len(pieces)):
        members = near[:, i] & free if free[i] else np.zeros(len(pieces), dtype=bool)
        members[i] = True
        if not free[i] and fit.mean_square[i] < straight**2:
            continue  # taken by a longer one
        for _ in range(2 if members.sum() > 1 else 0):
            normal = np.linalg.eigh(moments[members].sum(0))[1][:, 0]
            members = free & ((np.abs(mark_rays @ normal) * pixels).max(-1) < tolerance)
            members[i] = True
        free &= ~members
        groups.append(np.nonzero(members)[0])
    return groups


def turn_to(vanishing: np.ndarray, fit: Fit) -> tuple[np.ndarray, np.ndarray]:
    """Tell by how much lines miss vanishing points: the angle to turn a line about its middle m, n . v / |(m x n) . v|.

    Args:
        vanishing: (V, 3) unit vectors.
        fit: of K lines.

    Returns:
        n . v and its divisor, each (V, K).
    """
    normals, middles = fit.normals, fit.frames[:, :, 2]
    across = np.abs(vanishing @ np.cross(middles, normals).T)
    return vanishing @ normals.T, np.maximum(across, _PARALLEL_SINE)


def find_vanishing_points(
    pieces: Pieces, fit: Fit, *, straight: float, tolerance: float, most: int = 4
) -> tuple[np.ndarray, np.ndarray]:
    """Find where families of parallel lines meet: crossings of long lines that many others point at, best first.

    Args:
        pieces: the lines.
        fit: theirs.
        straight: largest RMS distance of a line's points, in pixels.
        tolerance: how far lines of a family turn away from their vanishing point, in radians, besides what noise does.
        most: families.

    Returns:
        Unit vectors (V, 3), and for each line its family or -1, (K,).
    """
    lengths = pieces.lengths
    lone = np.full(len(pieces), -1)
    (usable,) = np.nonzero((fit.mean_square < straight**2) & (lengths > 0))
    long = usable[np.argsort(-lengths[usable], kind="stable")][:50]
    i, j = np.triu_indices(len(long), 1)
    crossings = np.cross(fit.normals[long[i]], fit.normals[long[j]])
    size = np.linalg.norm(crossings, axis=-1)
    crossings = crossings[size > 0.02] / size[size > 0.02, None]
    if not len(crossings):
        return np.zeros((0, 3)), lone
    missed, divisor = turn_to(crossings, fit)
    allowed = np.hypot(tolerance, 0.3 / np.maximum(lengths, 1))
    score = np.maximum(1 - (missed / divisor / (2 * allowed)) ** 2, 0)[:, usable] * lengths[usable]
    chosen: list[int] = []
    for _ in range(most):
        best = int(score.sum(1).argmax())
        members = score[best] > 0
        if members.sum() < 4:
            break
        chosen.append(best)
        score = score * ~members
    vanishing = crossings[chosen]
    if not chosen:
        return vanishing, lone
    ratio = np.abs(missed / divisor)[chosen] / allowed
    return vanishing, np.where(ratio.min(0) < 2.5, ratio.argmin(0), -1)
