"""Lens models of other tools: the rays that their pixels see, and the Kannala-Brandt camera that fits those best.

The order of parameters is that of `camera_files`. Where a model bends a plane of its own (radial, tangential and thin
prism terms), that is undone by Newton's method; everything else has a closed inverse. A pixel that no ray reaches, or
that lies beyond the first fold of its lens, has NaN for a ray.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from . import pixel
from .camera_files import record

# A straight line through the plane of a pinhole's rays is followed to 89.9 degrees off the axis.
_WIDEST_TANGENT = np.tan(np.radians(89.9))

# Radians: a picture that spans less has no focal length in double precision.
_NARROWEST = 1e-6

# Positions along each side of the picture, from edge to edge, that a camera is fitted on and its error measured on.
_FITTED, _MEASURED = 33, 65

_Ray = tuple[Any, Any, Any]


class FittedParams(NamedTuple):
    """A Kannala-Brandt camera fitted to rays, and how far it is from them."""

    params: np.ndarray
    """(8,) fx, fy, cx, cy, k1, k2, k3, k4."""
    max_error_px: float
    """The largest distance between where both models see a ray, over the grid; infinite if the fit folds."""
    rms_error_px: float
    """The root of the mean square of these distances."""


def unproject(model: str, params: Sequence[float], points: np.ndarray) -> np.ndarray:
    """Lift pixels to the rays that a lens of another model sees there.

    Args:
        model: a key of `MODELS`.
        params: as `camera_files.record.PARAMETERS` names them.
        points: (..., 2) in pixels as (x, y), float64.

    Returns:
        rays (..., 3), x right, y down, z forward, of unit length; NaN where there is none.
    """
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        rays = np.stack(np.broadcast_arrays(*MODELS[model](points[..., 0], points[..., 1], *params)), -1)
        rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    return np.where(np.isfinite(rays).all(-1, keepdims=True), rays, np.nan)


def fit(model: str, params: Sequence[float], image_size: tuple[int, int]) -> FittedParams:
    """Fit a Kannala-Brandt camera to a lens of another model, over the rays that the picture's pixels see.

    Least squares of the distance in pixels at Chebyshev nodes across the picture, which is close to the best fit in the
    largest distance; that is then measured on an even grid of 65 x 65 positions, from edge to edge.

    Args:
        model: a key of `MODELS`.
        params: as `camera_files.record.PARAMETERS` names them.
        image_size: (height, width).

    Raises:
        ValueError: the pixels see too few rays to tell a camera by, or rays that no camera of positive focal length
            fits.
    """
    from . import _numpy

    nodes, node_rays = _seen(model, params, image_size, np.cos(np.linspace(np.pi, 0, _FITTED)))
    points, rays = _seen(model, params, image_size, np.linspace(-1, 1, _MEASURED))
    if min(len(nodes), len(points)) < _FITTED or np.abs(node_rays[:, :2]).max() < _NARROWEST:
        raise ValueError(
            f"expected a {model} lens whose picture sees rays off its axis, got rays at {len(points)} of "
            f"{_MEASURED**2} positions"
        )
    fitted = _fit_kannala_brandt(nodes, node_rays)
    again, valid = _numpy.project(record.KANNALA_BRANDT, fitted, rays)
    error = np.where(valid, np.hypot(*(again - points).T), np.inf)
    return FittedParams(fitted, float(error.max()), float(np.sqrt(np.mean(error**2))))


def _seen(
    model: str, params: Sequence[float], image_size: tuple[int, int], places: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The points (N, 2) at these places in [-1, 1] across and down the picture that see a ray, and the rays (N, 3)."""
    height, width = image_size
    x, y = (pixel.centre(size) + places * size / 2 for size in (width, height))
    points = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    rays = unproject(model, params, points)
    seen = ~np.isnan(rays[:, 0])
    return points[seen], rays[seen]


def _fit_kannala_brandt(points: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Least squares of x = fx theta_d cos phi + cx, y = fy theta_d sin phi + cy in the eight parameters.

    With p_i = fx k_i (k_0 = 1) and a = fy / fx, x is linear in p and cx, and then y is linear in a and cy. From there
    Gauss-Newton on both, whose residual is bilinear.
    """
    radius = np.hypot(rays[:, 0], rays[:, 1])
    theta = np.arctan2(radius, rays[:, 2])
    cos_phi, sin_phi = np.where(radius > 0, rays[:, :2].T / np.where(radius > 0, radius, 1), 0)
    widest = theta.max()
    powers = (theta / widest)[:, None] ** (2 * np.arange(5) + 1)  # within [0, 1], where they are well conditioned
    one, zero = np.ones_like(theta)[:, None], np.zeros_like(theta)[:, None]
    across, down = powers * cos_phi[:, None], powers * sin_phi[:, None]

    *p, cx = np.linalg.lstsq(np.hstack([across, one]), points[:, 0])[0]
    a, cy = np.linalg.lstsq(np.hstack([(down @ p)[:, None], one]), points[:, 1])[0]
    unknowns = np.array([*p, cx, cy, a])
    for _ in range(20):
        *p, cx, cy, a = unknowns
        x, y = across @ p + cx, a * (down @ p) + cy
        jacobian = np.vstack(
            [np.hstack([across, one, zero, zero]), np.hstack([a * down, zero, one, (down @ p)[:, None]])]
        )
        step = np.linalg.lstsq(jacobian, np.concatenate([points[:, 0] - x, points[:, 1] - y]))[0]
        unknowns = unknowns + step
        if np.abs(step).max() <= 1e-12 * np.abs(unknowns).max():
            break
    *p, cx, cy, a = unknowns
    p = np.array(p) / widest ** (2 * np.arange(5) + 1)
    if not (p[0] > 0 and a > 0):
        raise ValueError(f"expected rays that a camera of positive focal length fits, got fx {p[0]:g}, fy {a * p[0]:g}")
    return np.array([p[0], a * p[0], cx, cy, *(p[1:] / p[0])])


# --- Bending and straightening a plane ------------------------------------------------------------


def _first_positive_root(polynomial: Sequence[float]) -> float:
    """The smallest positive root of a polynomial by rising powers; infinite if there is none."""
    roots = np.roots(np.trim_zeros(np.array(polynomial[::-1], dtype=np.float64), "f"))
    real = roots.real[(np.abs(roots.imag) <= 1e-9 * np.abs(roots)) & (roots.real > 0)]
    return float(real.min(initial=np.inf))


class _Bending(NamedTuple):
    """x' = x N/D + 2 p1 x y + p2 (s + 2 x^2) + s1 s + s2 s^2, and y' with p1, p2 and s3, s4 in their place.

    s = x^2 + y^2; N = 1 + n1 s + n2 s^2 + ... and D likewise (Brown 1966; OpenCV's order of names).
    """

    numerator: tuple[float, ...] = ()
    denominator: tuple[float, ...] = ()
    tangential: tuple[float, float] = (0.0, 0.0)
    prism: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)

    def bend(self, x: Any, y: Any) -> tuple[Any, Any]:
        s = x * x + y * y
        radial = self._radial(s)
        p1, p2 = self.tangential
        s1, s2, s3, s4 = self.prism
        return (
            x * radial + 2 * p1 * x * y + p2 * (s + 2 * x * x) + s1 * s + s2 * s * s,
            y * radial + p1 * (s + 2 * y * y) + 2 * p2 * x * y + s3 * s + s4 * s * s,
        )

    def straighten(self, x: Any, y: Any, widest: float) -> tuple[Any, Any]:
        """The point that is bent to (x, y), no farther out than `widest` or the first fold; NaN where there is none."""
        # Begun where the radial part alone would have it, which is unique up to the fold.
        table = np.tan(np.linspace(0, np.arctan(min(widest, self._fold() * (1 - 1e-12))), 4001))
        bent = table * self._radial(table * table)
        target = np.hypot(x, y)
        start = np.interp(target, bent, table)
        scale = np.where(target > 0, start / np.where(target > 0, target, 1), 1)
        a, b = x * scale, y * scale
        tiny = 1e-30  # complex step: derivatives without a difference
        for _ in range(20):
            bent_x, bent_y = self.bend(a, b)
            x_a, y_a = (value.imag / tiny for value in self.bend(a + 1j * tiny, b))
            x_b, y_b = (value.imag / tiny for value in self.bend(a, b + 1j * tiny))
            determinant = x_a * y_b - x_b * y_a
            off_x, off_y = x - bent_x, y - bent_y
            a = a + (y_b * off_x - x_b * off_y) / determinant
            b = b + (x_a * off_y - y_a * off_x) / determinant
        bent_x, bent_y = self.bend(a, b)
        # Newton may leave for another branch where the tangential terms reach beyond the fold.
        found = (np.hypot(x - bent_x, y - bent_y) <= 1e-9 * (1 + target)) & (determinant > 0)
        found &= np.hypot(a, b) <= table[-1]
        return np.where(found, a, np.nan), np.where(found, b, np.nan)

    def _radial(self, s: Any) -> Any:
        return np.polyval((*self.numerator[::-1], 1), s) / np.polyval((*self.denominator[::-1], 1), s)

    def _fold(self) -> float:
        """The radius r at which r N/D first turns: N D + 2 s (N' D - N D') = 0, or a pole, D = 0."""
        n, d = np.polynomial.Polynomial((1, *self.numerator)), np.polynomial.Polynomial((1, *self.denominator))
        s = np.polynomial.Polynomial((0, 1))
        turn = n * d + 2 * s * (n.deriv() * d - n * d.deriv())
        return float(np.sqrt(min(_first_positive_root(tuple(turn.coef)), _first_positive_root(tuple(d.coef)))))


# --- The models -----------------------------------------------------------------------------------


def _brown_conrady(
    u: Any, v: Any, fx: float, fy: float, cx: float, cy: float, k1: float, k2: float, p1: float, p2: float, *more: float
) -> _Ray:
    """OpenCV's pinhole model; rational where k4, k5, k6 are not 0."""
    k3, k4, k5, k6, s1, s2, s3, s4 = more
    bending = _Bending((k1, k2, k3), (k4, k5, k6), (p1, p2), (s1, s2, s3, s4))
    x, y = bending.straighten((u - cx) / fx, (v - cy) / fy, _WIDEST_TANGENT)
    return x, y, 1.0


def _unified(
    u: Any, v: Any, fx: float, fy: float, cx: float, cy: float, xi: float, k1: float, k2: float, p1: float, p2: float
) -> _Ray:
    """Mei and Rives 2007 (kalibr omni, cv2.omnidir): (X, Y) / (Z + xi |(X, Y, Z)|), then bent as by Brown."""
    x, y = _Bending((k1, k2), (), (p1, p2)).straighten((u - cx) / fx, (v - cy) / fy, _WIDEST_TANGENT)
    r2 = x * x + y * y
    scale = (xi + np.sqrt(1 + (1 - xi * xi) * r2)) / (1 + r2)
    return scale * x, scale * y, scale - xi


def _extended_unified(u: Any, v: Any, fx: float, fy: float, cx: float, cy: float, alpha: float, beta: float) -> _Ray:
    """Khomutenko, Garcia and Martinet 2016: (X, Y) / (alpha d + (1 - alpha) Z), d^2 = beta (X^2 + Y^2) + Z^2."""
    x, y = (u - cx) / fx, (v - cy) / fy
    r2 = x * x + y * y
    root = np.sqrt(1 - (2 * alpha - 1) * beta * r2)
    return x, y, (1 - alpha * alpha * beta * r2) / (alpha * root + 1 - alpha)


def _double_sphere(u: Any, v: Any, fx: float, fy: float, cx: float, cy: float, xi: float, alpha: float) -> _Ray:
    """Usenko, Demmel and Cremers 2018: the unit sphere, seen from a second one xi away, then as unified with alpha."""
    x, y = (u - cx) / fx, (v - cy) / fy
    r2 = x * x + y * y
    z = (1 - alpha * alpha * r2) / (alpha * np.sqrt(1 - (2 * alpha - 1) * r2) + 1 - alpha)
    scale = (z * xi + np.sqrt(z * z + (1 - xi * xi) * r2)) / (z * z + r2)
    return scale * x, scale * y, scale * z - xi


def _division(u: Any, v: Any, fx: float, fy: float, cx: float, cy: float, k1: float) -> _Ray:
    """Fitzgibbon 2001 (COLMAP DIVISION): (x, y, 1 + k1 r^2); its angle turns at r^2 = 1 / k1."""
    x, y = (u - cx) / fx, (v - cy) / fy
    r2 = x * x + y * y
    return x, y, np.where(k1 * r2 <= 1, 1 + k1 * r2, np.nan)


def _field_of_view(u: Any, v: Any, fx: float, fy: float, cx: float, cy: float, omega: float) -> _Ray:
    """Devernay and Faugeras 2001 (COLMAP FOV, kalibr pinhole-fov): tan theta = tan(r omega) / (2 tan(omega / 2))."""
    x, y = (u - cx) / fx, (v - cy) / fy
    r = np.hypot(x, y)
    angle = np.where(r * omega < np.pi / 2, r * omega, np.nan)
    return x * np.sin(angle), y * np.sin(angle), 2 * np.tan(omega / 2) * r * np.cos(angle)


def _thin_prism_fisheye(
    u: Any, v: Any, fx: float, fy: float, cx: float, cy: float, k1: float, k2: float, p1: float, p2: float, *more: float
) -> _Ray:
    """COLMAP THIN_PRISM_FISHEYE: theta (cos phi, sin phi), bent as by Brown."""
    k3, k4, s1, s3 = more
    bending = _Bending((k1, k2, k3, k4), (), (p1, p2), (s1, 0.0, s3, 0.0))
    x, y = bending.straighten((u - cx) / fx, (v - cy) / fy, np.pi)
    theta = np.hypot(x, y)
    return x * np.sinc(theta / np.pi), y * np.sinc(theta / np.pi), np.cos(theta)


def _ocam(u: Any, v: Any, cx: float, cy: float, xx: float, xy: float, yx: float, yy: float, *polynomial: float) -> _Ray:
    """Scaramuzza, Martinelli and Siegwart 2006: (x, y, a0 + a1 r + a2 r^2 + ...), after an affine map of the pixels.

    Its angle turns where the polynomial without r times its derivative does: sum (1 - i) a_i r^i = 0. The affine map is
    a stretch after a turn (polar decomposition). The turn, which calibrations may hold degrees of, is left out: it
    belongs to the camera's frame and says nothing about the lens.
    """
    affine = np.array([[xx, xy], [yx, yy]])
    left, stretches, _ = np.linalg.svd(affine)
    pixel_from_plane = np.where(np.linalg.det(affine) > 0, (left * stretches) @ left.T, np.nan)  # else it is mirrored
    x, y = np.einsum("ij,j...->i...", np.linalg.inv(pixel_from_plane), np.stack([u - cx, v - cy]))
    r = np.hypot(x, y)
    turn = _first_positive_root([(1 - i) * a for i, a in enumerate(polynomial)])
    return x, y, np.where(r < turn, np.polyval(polynomial[::-1], r), np.nan)


MODELS: dict[str, Callable[..., _Ray]] = {
    record.BROWN_CONRADY: _brown_conrady,
    record.UNIFIED: _unified,
    record.EXTENDED_UNIFIED: _extended_unified,
    record.DOUBLE_SPHERE: _double_sphere,
    record.DIVISION: _division,
    record.FIELD_OF_VIEW: _field_of_view,
    record.THIN_PRISM_FISHEYE: _thin_prism_fisheye,
    record.OCAM: _ocam,
}
"""The rays of each model: (u, v, *params) -> (X, Y, Z), NaN where there is none."""
