"""The one-parameter division model (Fitzgibbon, CVPR 2001) with its centre, and what it makes of straight lines.

    P = (p - c) / (1 + L |p - c|^2)

takes a point p of the picture to the perspective plane; L < 0 for the barrel distortion of wide lenses. The straight
line n1 X + n2 Y + n3' = 0 is there the circle of the picture, q = p - c,

    n1 q_x + n2 q_y + n3' (1 + L |q|^2) = 0:

the power of c with respect to every such circle is 1 / L, which for circles in the form of arcs.py is linear,

    B c_x + C c_y - A w + D = 0,    w = 1 / L - |c|^2.

For L = -m^2 the model is the stereographic projection of focal length 1 / (2 m): with a unit vector n, n3 = 2 m n3',

    P(p) = n . v,    v = (q_x, q_y, (1 - m^2 |q|^2) / (2 m)),    A = -m n3 / 2

is in the form of arcs.py. Everything here is told in m, by the name of strength; coordinates are those of `Arcs`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from .. import pixel
from ..cameras import FisheyeCamera
from ..sightlines import Pieces
from .arcs import half_diagonal, power

STRENGTH_MIN, STRENGTH_MAX = 0.01, 1.5
"""From a corner that moves by a ten-thousandth to a lens that sees 225 degrees across the diagonal."""

CENTRE_MAX = 0.1
"""Distance of a believable centre from the picture's, in half diagonals."""

# What the edges of a photograph have in common (its lens is no division model, its lines are worn) no number of points
# averages out: on photographs at 256 px centres were so many times as far off as their covariance has it.
_SHARED_ERROR = 3.0
_CENTRE_DEVIATION = 0.015  # in half diagonals; lenses are off centre by about as much
_SQUARE_DEVIATION = 0.2  # of m^2, which is 0 for no distortion and 1 for 180 degrees across the diagonal
_WIDEST_FOCAL = 2.0  # in half diagonals: the corner of a picture without distortion is at 27 degrees
_STEP_LIMIT = 0.1
_ROUNDS = 20
_SETTLED = 1e-5


@dataclass(frozen=True)
class DivisionModel:
    """A division model about a centre, in the coordinates of `Arcs`."""

    centre: np.ndarray
    """(2,)."""
    strength: float
    """m = sqrt(-L)."""

    def undistort(self, points: np.ndarray) -> np.ndarray:
        """Take points of the picture (..., 2) to the perspective plane."""
        q = points - self.centre
        return np.asarray(q / (1 - self.strength**2 * (q * q).sum(-1, keepdims=True)))

    def camera(self, image_size: tuple[int, int]) -> FisheyeCamera:
        """Fit a Kannala-Brandt camera to the model, over the picture.

        No straightening tells the field of view. It is chosen as the stereographic lens has it, which is the same
        model and sees on beyond 90 degrees; a weaker distortion than that of a focal length of two half diagonals is
        seen at that focal length: tan(theta) = r / (f (1 - m^2 r^2)).

        Args:
            image_size: (height, width).

        Returns:
            The camera; its `fit_error_px` is the largest distance between both within the picture.
        """
        unit = half_diagonal(image_size)
        focal = min(_WIDEST_FOCAL, 1 / (2 * self.strength))
        x, y = self.centre * unit + (pixel.centre(image_size[1]), pixel.centre(image_size[0]))
        return camera_of_division(focal * unit, (x, y), -((self.strength * focal) ** 2), image_size)


def camera_of_division(
    focal: float, centre: tuple[float, float], coefficient: float, image_size: tuple[int, int]
) -> FisheyeCamera:
    """Fit a Kannala-Brandt camera to tan(theta) = x / (1 + coefficient x^2), x = r / focal, over the whole picture.

    Args:
        focal: in pixels.
        centre: (x, y) in pixels.
        coefficient: of a pincushion distortion where it is positive.
        image_size: (height, width).

    Returns:
        The camera, however far from the model; `fit_error_px` tells the largest distance.
    """
    params = [focal, focal, *centre, coefficient]
    return FisheyeCamera.from_model("division", params, image_size, max_fit_error_px=math.inf)


def clipped(strengths: np.ndarray) -> np.ndarray:
    """Bring strengths within their bounds."""
    return np.asarray(np.clip(strengths, STRENGTH_MIN, STRENGTH_MAX))


def model_of_three(circles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Give the centres (..., 2) and strengths (...) of the models with these three lines (..., 3, 4).

    NaN where there is none: circles that do not differ, or a pincushion distortion.
    """
    a, b, c, d = np.moveaxis(circles, -1, 0)
    system = np.stack([b, c, -a], -1)
    singular = np.abs(np.linalg.det(system)) < 1e-12
    solution = np.linalg.solve(np.where(singular[..., None, None], np.eye(3), system), -d[..., None])[..., 0]
    centres = solution[..., :2]
    inverse = solution[..., 2] + (centres**2).sum(-1)  # 1 / L
    strengths = 1 / np.sqrt(np.where(singular | (inverse >= 0), np.nan, -inverse))
    return centres, strengths


def strength_about(circles: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Give the strength (...) that a circle (..., 4) alone tells about a known centre: 0 where it bends outwards."""
    at_centre = power(circles, centre)
    inverse = np.where(circles[..., 0] == 0, -np.inf, at_centre / np.where(circles[..., 0] == 0, 1, circles[..., 0]))
    return np.asarray(np.where(inverse < 0, 1 / np.sqrt(np.maximum(-inverse, 1e-12)), 0.0))


def misfits(pieces: Pieces, centres: np.ndarray, strengths: np.ndarray) -> np.ndarray:
    """Tell how far pieces are from lines under H models: mean squared distances (H, K) in the picture.

    |P| is the distance to first order, so that the least mean P^2 is the smallest eigenvalue of the mean of v v'.
    """
    x, y = pieces.points.T
    rows = np.stack([x, y, np.ones_like(x), x * x + y * y], -1)
    moments = pieces.sums(rows[:, :, None] * rows[:, None, :]) / pieces.counts[:, None, None]
    cx, cy = centres.T
    zero, one, m = np.zeros_like(cx), np.ones_like(cx), strengths
    # v3 = (1 - m^2 (|p|^2 - 2 p . c + |c|^2)) / (2 m)
    third = np.stack([m * cx, m * cy, (1 - m**2 * (cx**2 + cy**2)) / (2 * m), -m / 2], -1)
    v = np.stack([np.stack([one, zero, -cx, zero], -1), np.stack([zero, one, -cy, zero], -1), third], -2)
    return np.asarray(np.maximum(np.linalg.eigvalsh(v[:, None] @ moments @ v[:, None].swapaxes(-1, -2))[..., 0], 0))


@dataclass(frozen=True)
class Refined:
    """A refined model and what is known of it."""

    model: DivisionModel
    covariance: np.ndarray
    """(3, 3) of centre and m^2, as the points' scatter has it; of m^2 alone where the centre was held: (1, 1)."""
    mean_square: np.ndarray
    """(K,) of the distances of each piece's points from its line."""

    @property
    def tells_centre(self) -> bool:
        """Whether a centre that was free is known better than the picture's own would be."""
        deviation = _SHARED_ERROR * np.sqrt(np.trace(self.covariance[:2, :2]) / 2)
        return bool(deviation < _CENTRE_DEVIATION and np.linalg.norm(self.model.centre) < CENTRE_MAX)

    @property
    def tells_strength(self) -> bool:
        """Whether the strength is within its bounds and known well enough to be of use."""
        deviation = _SHARED_ERROR * np.sqrt(self.covariance[-1, -1])
        return bool(deviation < _SQUARE_DEVIATION and self.model.strength < STRENGTH_MAX)


def refine(model: DivisionModel, pieces: Pieces, *, free_centre: bool, cut: float = math.inf) -> Refined:
    """Minimise the distances of edge points from lines over the model and the lines, by Gauss-Newton steps.

    Distances d = 2 P / (1 + Q), Q = sqrt(1 + 4 A P), are those within the picture: in the perspective plane, weaker
    models would shrink them. Pieces count by the function of Geman and McClure over their mean squares, as what bends
    on its own is no line. Unknown are the centre, m^2 and the lines, which are eliminated from each step's equations.

    Args:
        model: where to start.
        pieces: the points of each line.
        free_centre: whether the centre is to be found as well.
        cut: RMS distance where a piece begins to be given up.
    """
    free = slice(0 if free_centre else 2, 3)
    centre, m = model.centre, model.strength
    rays = _lifted(pieces.points, centre, m)
    normals = np.linalg.eigh(pieces.sums(rays[:, :, None] * rays[:, None, :]))[1][:, :, 0]
    for _ in range(_ROUNDS):
        d, by_model, by_normal, tangents = _distances(pieces, normals, centre, m)
        mean_square = pieces.sums(d * d) / pieces.counts
        weights = 1 / (1 + mean_square / cut**2) ** 2
        rows = np.concatenate([by_model[:, free], d[:, None]], -1)
        believed = weights[:, None, None]
        own = believed * pieces.sums(rows[:, :, None] * rows[:, None, :])
        cross = believed * pieces.sums(by_normal[:, :, None] * rows[:, None, :])
        normal = believed * pieces.sums(by_normal[:, :, None] * by_normal[:, None, :])
        ridge = 1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None, None] + np.finfo(float).tiny
        solved = np.linalg.solve(normal + ridge * np.eye(2), cross)
        total = (own - cross.swapaxes(1, 2) @ solved).sum(0)
        step = -np.linalg.lstsq(total[:-1, :-1], total[:-1, -1], rcond=None)[0]
        step *= min(1.0, _STEP_LIMIT / max(float(np.abs(step).max()), 1e-12))
        m_before, m = m, float(clipped(np.sqrt(max(m * m + step[-1], 0.0))))
        step[-1] = m * m - m_before * m_before
        turn = -(solved[:, :, -1] + solved[:, :, :-1] @ step)
        move = np.zeros(3)
        move[free] = step
        centre = centre + move[:2]
        normals = normals + (tangents @ turn.clip(-_STEP_LIMIT, _STEP_LIMIT)[:, :, None])[..., 0]
        normals *= (1, 1, m / m_before)  # n3' stays
        normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
        if np.abs(move).max() < _SETTLED:
            break
    variance = (weights * pieces.counts * mean_square).sum() / (weights * pieces.counts).sum()
    return Refined(DivisionModel(centre, m), variance * np.linalg.pinv(total[:-1, :-1]), mean_square)


def _lifted(points: np.ndarray, centre: np.ndarray, m: float) -> np.ndarray:
    """v of points (N, 2): (N, 3)."""
    q = points - centre
    return np.concatenate([q, (1 - m * m * (q * q).sum(-1, keepdims=True)) / (2 * m)], -1)


def _distances(
    pieces: Pieces, normals: np.ndarray, centre: np.ndarray, m: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The distances (N,), their slopes by centre and m^2 (N, 3) and by turns of the normals (N, 2), and their axes.

    dd/dP = 1 / Q and dd/dA = -d^2 / Q; by m^2 with n3' = n3 / (2 m) held.
    """
    owners = pieces.owners
    v, n = _lifted(pieces.points, centre, m), normals[owners]
    a, constant = -m * n[:, 2] / 2, n[:, 2] / (2 * m)
    p = (n * v).sum(-1)
    q = np.sqrt(np.maximum(1 + 4 * a * p, 1e-6))
    d = 2 * p / (1 + q)
    by_centre = -n[:, :2] - 2 * a[:, None] * v[:, :2]
    by_square = constant * (d * d - (v[:, :2] ** 2).sum(-1))
    aside = np.where(np.abs(normals[:, :1]) < 0.6, (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    first = np.cross(normals, aside)
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    tangents = np.stack([first, np.cross(normals, first)], -1)
    of_points = tangents[owners]
    by_normal = (v[:, :, None] * of_points).sum(1) + (d * d * m / 2)[:, None] * of_points[:, 2]
    return d, np.concatenate([by_centre, by_square[:, None]], -1) / q[:, None], by_normal / q[:, None], tangents


def refine_stepwise(model: DivisionModel, pieces: Pieces, *, cut: float = math.inf) -> DivisionModel | None:
    """Refine the strength about the picture's centre, then the centre as well; give what the pieces tell of that.

    None where they hardly tell the strength.
    """
    held = refine(DivisionModel(np.zeros(2), model.strength), pieces, cut=cut, free_centre=False)
    free = refine(held.model, pieces, cut=cut, free_centre=True)
    if free.tells_centre and free.tells_strength:
        return free.model
    return held.model if held.tells_strength else None
