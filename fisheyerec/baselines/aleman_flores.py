"""Alemán-Flores, Alvarez, Gomez and Santana-Cedrés, "Automatic lens distortion correction using one-parameter division
models", IPOL 4 (2014) 327-343; from the article, not from its code, whose licence is another.

Canny edges vote for lines (angle, distance) at each of a row of distortions, as far as their own direction agrees; the
distortion whose strongest lines have most votes is refined on the edge points near these lines. A distortion is told
by the part p that it adds to the radius of the farthest corner,

    r / (1 + L r^2) = (1 + p) r,    L = -p / ((1 + p) r^2).

Where this had to choose: the sum of votes goes over the 10 strongest lines, not over 30 and more, as a picture of 256
px has few long ones; there is no estimate where these are short. Angles have steps of 0.5 degrees, which is a pixel
over such a picture, not 0.1; a vote is shared by the two nearest distances; edges below a slope do not count, whatever
their rank. The refinement minimises distances within the picture, as weaker corrections shrink those in the corrected
one. The centre is kept only where it is known better than lenses are off centre anyway. Large pictures are reduced
first. Known limit: a vote's tolerance of a pixel is one of the corrected picture, as in the article, so that strong
distortions, which stretch it, get few votes and small pictures are corrected too little. Tolerances of the picture
itself find them where all edges are lines, and did worse than no correction on photographs.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from ..cameras import FisheyeCamera
from ..lines import HIGH, SIGMA
from ..sightlines import Pieces
from ..straightness import working_copy
from .arcs import half_diagonal, normalise
from .division import DivisionModel, clipped, refine_stepwise

DISTORTIONS = np.arange(31) / 10
"""p: from none to corners four times as far out."""

_QUANTILES = (0.7, 0.8)  # of the gradients, for Canny's hysteresis
_ANGLE_STEP_DEG, _AGREE_DEG = 0.5, 2.0
_LINES_COUNTED, _LINES_KEPT = 10, 30
_MIN_LENGTH = 0.15  # of the lines counted, a vote a pixel, in half diagonals
_NEAR_PX = 3.0  # of a line that an edge point belongs to
_FEWEST = 10  # points of a line
_APART = (4, 3)  # steps of angle and distance that a line keeps weaker ones away


class Edges(NamedTuple):
    """Edge points in the coordinates of `Arcs`."""

    points: np.ndarray
    """(N, 2)."""
    tangents: np.ndarray
    """(N, 2) unit vectors along the edge."""
    pixel: float
    """One pixel of the picture they were found in."""


class Lines(NamedTuple):
    """Lines x cos(angle) + y sin(angle) = distance, strongest first."""

    angles: np.ndarray
    """(L,) in radians."""
    distances: np.ndarray
    """(L,)."""
    votes: np.ndarray
    """(L,)."""


def estimate(image: np.ndarray) -> FisheyeCamera | None:
    """Estimate the camera of a picture (H, W, 3) RGB uint8; None where no lines tell it."""
    edges = find_edges(image)
    if len(edges.points) < _FEWEST:
        return None
    voted = [strongest_lines(undistorted(edges, p)) for p in DISTORTIONS]
    votes = [lines.votes[:_LINES_COUNTED].sum() for lines in voted]
    best = int(np.argmax(votes))
    if votes[best] * edges.pixel < _LINES_COUNTED * _MIN_LENGTH:
        return None
    p = DISTORTIONS[best]
    pieces = points_of_lines(edges, undistorted(edges, p), voted[best])
    if not len(pieces):
        return None
    start = DivisionModel(np.zeros(2), float(clipped(np.sqrt(p / (1 + p)))))
    model = refine_stepwise(start, pieces)
    return None if model is None else model.camera((image.shape[0], image.shape[1]))


def find_edges(image: np.ndarray) -> Edges:
    """Find the edge points of a picture (H, W, 3) by Canny's detector."""
    grey = working_copy(image)
    smooth = cv2.GaussianBlur(grey, (0, 0), SIGMA)
    gx, gy = (cv2.Sobel(smooth, cv2.CV_16S, *order) for order in ((1, 0), (0, 1)))
    slopes = np.hypot(gx.astype(np.float64), gy)
    low, high = np.maximum(np.quantile(slopes, _QUANTILES), 8 * HIGH)  # Sobel's weights add up to 8
    rows, columns = np.nonzero(cv2.Canny(gx, gy, low, high, L2gradient=True))
    tangents = np.stack([-gy[rows, columns], gx[rows, columns]], -1) / slopes[rows, columns, None]
    height, width = grey.shape
    points = normalise(np.stack([columns, rows], -1).astype(np.float64), (height, width), image.shape[:2])
    return Edges(points, tangents, 1 / half_diagonal((height, width)))


def undistorted(edges: Edges, p: float) -> Edges:
    """Correct edges by a distortion: u = q / g with g = 1 + L |q|^2, and du = dq / g - q (2 L q . dq) / g^2."""
    square = -p / (1 + p)
    q, dq = edges.points, edges.tangents
    g = 1 + square * (q * q).sum(-1, keepdims=True)
    du = dq / g - q * (2 * square * (q * dq).sum(-1, keepdims=True)) / g**2
    return Edges(q / g, du / np.linalg.norm(du, axis=-1, keepdims=True), edges.pixel)


def strongest_lines(edges: Edges) -> Lines:
    """Let edges vote for the lines through them whose directions agree with theirs, and give those with most votes."""
    x, y = (edges.points / edges.pixel).T[:, :, None]
    count, spread = round(180 / _ANGLE_STEP_DEG), round(_AGREE_DEG / _ANGLE_STEP_DEG)
    normals_deg = np.degrees(np.arctan2(edges.tangents[:, 0], -edges.tangents[:, 1])) % 180
    steps = np.round(normals_deg / _ANGLE_STEP_DEG).astype(np.intp)[:, None] + np.arange(2 * spread + 1)
    angles = np.radians((np.arange(count + 2 * spread + 1) - spread) * _ANGLE_STEP_DEG)
    distances = x * np.cos(angles)[steps] + y * np.sin(angles)[steps]
    reach = int(np.abs(distances).max()) + 2
    shape = (len(angles), 2 * reach + 1)
    distances += reach
    lower = distances.astype(np.intp)
    above = (distances - lower).ravel()
    place = (steps * shape[1] + lower).ravel()
    votes = np.bincount(place, 1 - above, shape[0] * shape[1])
    votes += np.bincount(place + 1, above, shape[0] * shape[1])
    votes = votes.reshape(shape)
    # Half a turn on, a line comes back with the other sign.
    votes[count : count + spread] += votes[:spread, ::-1]
    votes[spread : 2 * spread + 1] += votes[-spread - 1 :, ::-1]
    votes = votes[spread : count + spread].astype(np.float32)

    rows, columns = _APART
    around = np.concatenate([votes[-rows:, ::-1], votes, votes[:rows, ::-1]])
    highest = cv2.dilate(around, np.ones((2 * rows + 1, 2 * columns + 1), np.uint8))[rows:-rows]
    row, column = np.nonzero((votes == highest) & (votes > 1))
    best = np.argsort(-votes[row, column], kind="stable")[:_LINES_KEPT]
    row, column = row[best], column[best]
    return Lines(np.radians(row * _ANGLE_STEP_DEG), (column - reach) * edges.pixel, votes[row, column])


def points_of_lines(edges: Edges, corrected: Edges, lines: Lines) -> Pieces:
    """Give the uncorrected edge points near each line, each point to its nearest."""
    cos, sin = np.cos(lines.angles), np.sin(lines.angles)
    off = np.abs(corrected.points[:, :1] * cos + corrected.points[:, 1:] * sin - lines.distances)
    turned = np.abs(corrected.tangents[:, :1] * cos + corrected.tangents[:, 1:] * sin)  # sine of the angle between
    belongs = (off < _NEAR_PX * edges.pixel) & (turned < np.sin(np.radians(_AGREE_DEG)))
    owners = np.where(belongs.any(-1), np.where(belongs, off, np.inf).argmin(-1), -1)
    groups = [np.nonzero(owners == line)[0] for line in range(len(lines.angles))]
    groups = [group for group in groups if len(group) >= _FEWEST]
    order = np.concatenate(groups) if groups else np.zeros(0, dtype=np.intp)
    return Pieces(edges.points[order], np.cumsum([0, *map(len, groups)]))
