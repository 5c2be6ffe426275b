"""Refining a camera on the curved lines of its picture, and telling without labels how straight a camera makes them.

`refine` looks for the most probable lens chart c (lens_chart.py) given the edges and a Gaussian prior (m, C), usually
a network's estimate with the covariance of its errors:

    (c - m)' C^-1 (c - m) + sum_i rho(distances of piece i from its best line) + sum_i rho(turns to vanishing points)

with rho of Geman and McClure over whole pieces: trees, arches and wheels are smooth curves, but no lines. Normals of
lines are eliminated (variable projection), vanishing points are unknowns beside the chart. Pieces are merged, and
families of parallel lines found, anew as the camera improves.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch

from . import sightlines
from .cameras import FisheyeCamera
from .lens_chart import (
    FIELD_OF_VIEW,
    PRINCIPAL_POINT,
    PROFILE,
    SIZE,
    angle_to_g,
    camera_from_chart,
    chart_of,
    perspective_chart,
    stretch,
)
from .sightlines import Fit, Pieces
from .straightness import check_picture, find_pieces, straightness_of

# Of 64 photographs without distortion 6 % pass both; of 29 whose lens stretches by 7 % or more 86 %, refined from the
# middle of the wide prior alone.
DISTORTED_EVIDENCE, DISTORTED_STRETCH = 2.0, 0.05

_NOISE_PX = 0.2  # of an averaged edge point, at 256 px
# A piece's points also share what makes its line no line (worn edges, the photograph's own lens): a piece counts for
# this many points at most.
_MOST_POINTS = 15
# What all lines of a photograph have in common, such as the bend of its own lens, no number of them averages out: so
# many times as large as they suggest is the error of the outcome, measured on photographs.
_SHARED_ERROR = 3.0
_TURN = 0.005  # rad, of a line in a family of parallels besides its noise
_TURN_CUT = 0.01  # rad, where rho begins to give up
_STRAIGHT_PX = 0.4
# Where the lines contradict the prior by so much (chi squared of 8 exceeds it once in 1,000 times), or a lens of the
# wide prior lowers their cost by so much, the wide prior takes its place.
_SURPRISE, _STRAIGHTER = 26.1, 150.0
# Lenses with an image circle are sold with 180 to 190 degrees, rarely with 160 or 220.
_RIM, _RIM_DEVIATION = np.radians((92.5, 7))
_CENTRE_DEVIATION = 0.02  # of the principal point from the circle's centre, in units of R
_STEP_LIMIT = 2.0  # in standard deviations of the prior
# Cut of rho in pixels before merging; then tolerance of merging and cut.
_LOOSE_CUTS = (1.0, 0.7, 0.4)
_ROUNDS = ((1.0, 0.4), (0.7, 0.4), (0.55, 0.3))
_MORE_ROUNDS = 6
_SETTLED = 1.0  # squared standard deviations of the outcome that a round may move


class Prior(NamedTuple):
    """What is known of a camera before its picture is looked at: a Gaussian over lens charts."""

    mean: np.ndarray
    """(8,)."""
    covariance: np.ndarray
    """(8, 8), positive definite."""

    def given(self, row: np.ndarray, value: float, deviation: float) -> Prior:
        """Give the prior once row . chart, for a row (8,), is measured as a value up to a standard deviation."""
        spread = self.covariance @ row
        gain = spread / (row @ spread + deviation**2)
        return Prior(self.mean + gain * (value - row @ self.mean), self.covariance - np.outer(gain, spread))


@dataclass(frozen=True)
class Refinement:
    """A refined camera and what speaks for it."""

    camera: FisheyeCamera
    """The refined one if accepted, else the one that was given."""
    accepted: bool
    """Whether lines were found and the refined camera makes them straighter."""
    straightness_before: float
    """`straightness` of the picture under the given camera; NaN without lines."""
    straightness_after: float
    """The same under `camera`."""
    lines: int
    """How many lines, after merging, took part."""
    covariance: np.ndarray
    """(8, 8) of the chart of `camera`: the prior's where there are no lines."""
    evidence: float
    """By how much more probable, as a logarithm, the lines are under `camera` than in a picture without distortion."""

    @property
    def stretch(self) -> float:
        """By how much `camera` pulls the corners out to straighten the picture (`lens_chart.stretch`)."""
        return stretch(chart_of(self.camera))

    @property
    def distorted(self) -> bool:
        """Whether the lines show a distortion worth mentioning; False where there are no lines to tell by."""
        return self.evidence > DISTORTED_EVIDENCE and self.stretch > DISTORTED_STRETCH


def wide_prior() -> Prior:
    """Give the prior over fisheye lenses of 50 to 220 degrees across the diagonal, off centre by 3/128 a half side.

    From 6,000 draws of the CC0 lens profiles and ideal projections; the least spreads are widened to 1 and 2 %.
    """
    mean = np.array([-1.546, -0.827, -0.374, 0.638, -0.366, 0, 0, 0])
    spread = np.array([0.012, 0.02, 0.113, 0.23, 0.818])
    axes = np.array(
        [
            [-0.5066, -0.5201, 0.6224, -0.0273, -0.2911],
            [0.7956, 0.0254, 0.5506, -0.02, -0.2507],
            [-0.3323, 0.8536, 0.365, 0.0004, -0.1664],
            [-0.0039, 0.0095, 0.2167, -0.8199, 0.5299],
            [-0.0017, -0.0109, 0.3595, 0.5715, 0.7376],
        ]
    )
    covariance = np.diag([0, 0, 0, 0, 0, (3 / 128) ** 2, (3 / 128) ** 2, 0.003**2])
    covariance[:5, :5] = axes * spread**2 @ axes.T
    return Prior(mean, covariance)


def circle_prior() -> Prior:
    """Give the prior over the charts of the square inscribed in an image circle, whose corners lie on the rim.

    The rim, in the chart the sum of the profile's last number and the field of view, sees about 90 degrees; and the
    principal point is the circle's centre.
    """
    prior = wide_prior()
    corner = np.zeros(SIZE)
    corner[range(SIZE)[PROFILE][-1]] = corner[FIELD_OF_VIEW] = 1
    rim, beyond = angle_to_g(torch.tensor([_RIM, _RIM + _RIM_DEVIATION], dtype=torch.float64)).tolist()
    prior = prior.given(corner, rim, beyond - rim)
    for axis in np.eye(SIZE)[PRINCIPAL_POINT]:
        prior = prior.given(axis, 0.0, _CENTRE_DEVIATION)
    return prior


def refine(image: np.ndarray, camera: FisheyeCamera, *, prior: Prior | None = None) -> Refinement:
    """Refine a camera on the lines of its picture.

    Args:
        image: (H, W) or (H, W, 3) uint8.
        camera: one fisheye camera of image size (H, W): where to start, and what to keep if nothing better is found.
        prior: over charts; None for `wide_prior()`.

    Raises:
        TypeError: image is not an array or camera is not a FisheyeCamera.
        ValueError: another shape or dtype, a batch of cameras, or a prior that is not a finite Gaussian of 8 numbers.
    """
    check_picture("refine", image, camera)
    pieces, size = find_pieces(image)
    return refine_on(pieces, size, camera, wide_prior() if prior is None else _checked_prior(prior))


def refine_on(pieces: Pieces, size: tuple[int, int], camera: FisheyeCamera, prior: Prior) -> Refinement:
    """Refine a camera on pieces found in a picture of a working size (height, width), as `find_pieces` gives them."""
    before = straightness_of(pieces, camera, size)
    unchanged = Refinement(camera, False, before, before, 0, prior.covariance, 0.0)
    if not len(pieces):
        return unchanged
    search, wide = _Search(pieces, prior, size), _Search(pieces, wide_prior(), size)
    chart, covariance = search.run(chart_of(camera))
    cost, *others = (wide.lines_cost(_params(c, size), _LOOSE_CUTS[0]) for c in wide.starts(chart))
    if search.surprise(chart) > _SURPRISE or cost - min(others) > _STRAIGHTER:
        search = wide
        chart, covariance = search.run(chart)
    refined = FisheyeCamera(_params(chart, camera.image_size), camera.image_size)
    after = straightness_of(pieces, refined, size)
    if not after < before:
        return replace(unchanged, evidence=_evidence(pieces, camera, size))
    evidence = _evidence(pieces, refined, size)
    return Refinement(refined, True, before, after, len(search.pieces), covariance, evidence)


class _Search:
    """Gauss-Newton steps on the chart, the vanishing points and, eliminated, the lines."""

    def __init__(self, pieces: Pieces, prior: Prior, size: tuple[int, int]) -> None:
        self.found, self.pieces, self.prior, self.size = pieces, pieces, prior, size
        self.precision = np.linalg.inv(prior.covariance)
        self.noise = _NOISE_PX * np.sqrt(max(size) / 256)
        self.vanishing, self.family = np.zeros((0, 3)), np.full(len(pieces), -1)

    def run(self, chart: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Search from a chart: the best chart (8,) and its covariance (8, 8)."""
        chart = min(self.starts(chart), key=lambda c: self.cost(c, _LOOSE_CUTS[0]))
        for cut in _LOOSE_CUTS:
            chart, hessian = self.step(chart, cut)
        for tolerance, cut in (*_ROUNDS, *[_ROUNDS[-1]] * _MORE_ROUNDS):
            params, before = _params(chart, self.size), chart
            limits = {"straight": _STRAIGHT_PX, "tolerance": tolerance}
            self.pieces = self.found.joined(sightlines.merge(self.found, params, self.size, **limits))
            fit = sightlines.fit_lines(self.pieces, params, self.size)
            self.vanishing, self.family = sightlines.find_vanishing_points(
                self.pieces, fit, straight=_STRAIGHT_PX, tolerance=2 * _TURN
            )
            for _ in range(2):
                chart, hessian = self.step(chart, cut)
            moved = chart - before
            if (tolerance, cut) == _ROUNDS[-1] and moved @ hessian[:SIZE, :SIZE] @ moved < _SETTLED:
                break
        hessian /= _SHARED_ERROR**2
        hessian[:SIZE, :SIZE] += (1 - 1 / _SHARED_ERROR**2) * self.precision
        return chart, np.linalg.inv(hessian)[:SIZE, :SIZE]

    def surprise(self, chart: np.ndarray) -> float:
        """The squared Mahalanobis distance from the prior's mean."""
        off = chart - self.prior.mean
        return float(off @ self.precision @ off)

    def starts(self, chart: np.ndarray) -> list[np.ndarray]:
        """Give five charts along the prior, from weak to strong curvature, after the given one if that is finite."""
        mean, covariance = self.prior
        ridge = covariance[:, 0] / np.sqrt(covariance[0, 0])
        along = [mean + z * ridge for z in (0.0, -1.0, 1.0, -2.0, 2.0)]
        return [chart, *along] if np.isfinite(chart).all() else along

    def cost(self, chart: np.ndarray, cut: float) -> float:
        """Twice the negative logarithm of the posterior, without vanishing points."""
        return self.lines_cost(_params(chart, self.size), cut) + self.surprise(chart)

    def lines_cost(self, params: np.ndarray, cut: float) -> float:
        """The part of the lines in `cost`."""
        fit = sightlines.fit_lines(self.pieces, params, self.size)
        lines = (self._shares() * cut**2 * fit.mean_square / (cut**2 + fit.mean_square)).sum()
        return float(lines / self.noise**2)

    def step(self, chart: np.ndarray, cut: float) -> tuple[np.ndarray, np.ndarray]:
        """Take one step: the chart and the Hessian before it, with the lines eliminated."""
        hessian, gradient = self.system(chart, cut)
        move = -np.linalg.solve(hessian, gradient)
        turn = move[SIZE:].reshape(-1, 2)
        move = move[:SIZE]
        move *= min(1.0, _STEP_LIMIT / max(float(np.sqrt(move @ self.precision @ move)), 1e-12))
        moved = self.vanishing + (_tangents(self.vanishing) * turn.clip(-0.2, 0.2)[:, None, :]).sum(-1)
        self.vanishing = moved / np.linalg.norm(moved, axis=-1, keepdims=True)
        return chart + move, hessian

    def system(self, chart: np.ndarray, cut: float) -> tuple[np.ndarray, np.ndarray]:
        """Half the Hessian (Gauss-Newton) and half the gradient over chart and vanishing points."""
        pieces, vanishing = self.pieces, self.vanishing
        params, params_by_chart = _params_and_slope(chart, self.prior.covariance, self.size)
        fit = sightlines.fit_lines(pieces, params, self.size)
        foot = sightlines.feet(pieces, fit, params, self.size)
        incidence = foot.incidence(fit.normals[pieces.owners])
        scale = (foot.seen / incidence.slope)[:, None]
        in_plane = fit.frames[:, :, 1:]  # (K, 3, 2) how a normal may turn

        # For each piece the products of the columns [chart, vanishing points, distance] and of the normal's two.
        columns = SIZE + 2 * len(vanishing) + 1
        by_point = np.concatenate([foot.by_camera(incidence) @ params_by_chart * scale, fit.distances[:, None]], -1)
        by_normal = (foot.rays[:, :, None] * in_plane[pieces.owners]).sum(1) * scale
        weight = self._shares() / pieces.counts / self.noise**2 / (1 + fit.mean_square / cut**2) ** 2
        place = np.array([*range(SIZE), columns - 1])
        own = np.zeros((len(pieces), columns, columns))
        cross = np.zeros((len(pieces), 2, columns))
        own[:, place[:, None], place] = weight[:, None, None] * pieces.sums(by_point[:, :, None] * by_point[:, None, :])
        cross[:, :, place] = weight[:, None, None] * pieces.sums(by_normal[:, :, None] * by_point[:, None, :])
        normal = weight[:, None, None] * pieces.sums(by_normal[:, :, None] * by_normal[:, None, :])
        if len(vanishing):
            row, row_by_normal, row_weight = self._turns(fit, cut, columns)
            own += row_weight * row[:, :, None] * row[:, None, :]
            cross += row_weight * row_by_normal[:, :, None] * row[:, None, :]
            normal += row_weight * row_by_normal[:, :, None] * row_by_normal[:, None, :]
        ridge = 1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None, None] + 1e-12
        total = (own - cross.swapaxes(1, 2) @ np.linalg.solve(normal + ridge * np.eye(2), cross)).sum(0)
        hessian, gradient = total[:-1, :-1], total[:-1, -1]
        hessian[:SIZE, :SIZE] += self.precision
        hessian[SIZE:, SIZE:] += 1e-3 * np.eye(columns - 1 - SIZE)
        gradient[:SIZE] += self.precision @ (chart - self.prior.mean)
        return hessian, gradient

    def _turns(self, fit: Fit, cut: float, columns: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """One equation for each line: its turn to its vanishing point; rows (K, columns), (K, 2), weights (K, 1, 1)."""
        own = np.maximum(self.family, 0)
        lines = np.arange(len(own))
        missed, divisor = (value[own, lines] for value in sightlines.turn_to(self.vanishing, fit))
        turn = missed / divisor
        row = np.zeros((len(own), columns))
        by_vanishing = (fit.normals[:, :, None] * _tangents(self.vanishing)[own]).sum(1) / divisor[:, None]
        first = SIZE + 2 * own
        row[lines, first], row[lines, first + 1] = by_vanishing.T
        row[:, -1] = turn
        row_by_normal = (self.vanishing[own][:, :, None] * fit.frames[:, :, 1:]).sum(1) / divisor[:, None]
        trust = (1 + fit.mean_square / cut**2) ** 2 * (1 + (turn / _TURN_CUT) ** 2) ** 2 * _TURN**2
        return row, row_by_normal, ((self.family >= 0) / trust)[:, None, None]

    def _shares(self) -> np.ndarray:
        """For how many independent points each piece counts: (K,)."""
        counts = self.pieces.counts
        return np.asarray(counts / (1 + counts / _MOST_POINTS))


def _evidence(pieces: Pieces, camera: FisheyeCamera, size: tuple[int, int]) -> float:
    search = _Search(pieces, wide_prior(), size)
    flat = _params(perspective_chart(), size)
    params = np.asarray(camera.numpy().resize(size).params)
    return (search.lines_cost(flat, _STRAIGHT_PX) - search.lines_cost(params, _STRAIGHT_PX)) / 2


def _tangents(vectors: np.ndarray) -> np.ndarray:
    """Two unit vectors across each unit vector: (V, 3) to (V, 3, 2)."""
    aside = np.where(np.abs(vectors[:, :1]) < 0.6, (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    first = np.cross(vectors, aside)
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    return np.stack([first, np.cross(vectors, first)], -1)


def _params(chart: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    return np.asarray(camera_from_chart(torch.as_tensor(chart), (size[0], size[1])).numpy())


def _params_and_slope(
    chart: np.ndarray, covariance: np.ndarray, size: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """The camera (8,) and, by central differences, its derivative to the chart (8, 8)."""
    steps = 1e-4 * np.sqrt(np.diag(covariance))
    both = _params(np.concatenate([chart[None], chart + np.diag(steps), chart - np.diag(steps)]), size)
    return both[0], ((both[1 : SIZE + 1] - both[SIZE + 1 :]) / (2 * steps[:, None])).T


def _checked_prior(prior: Prior) -> Prior:
    try:
        mean, covariance = (np.asarray(part, dtype=np.float64) for part in prior)
    except (TypeError, ValueError):
        raise TypeError(f"refine(): expected prior as (mean, covariance), got {prior!r:.60}") from None
    if mean.shape != (SIZE,) or covariance.shape != (SIZE, SIZE):
        raise ValueError(
            f"refine(): expected prior of shapes ({SIZE},) and ({SIZE}, {SIZE}), got {mean.shape} and "
            f"{covariance.shape}"
        )
    if not (np.isfinite(mean).all() and np.isfinite(covariance).all() and np.linalg.eigvalsh(covariance)[0] > 0):
        raise ValueError("refine(): expected prior finite, with a positive definite covariance, got another")
    return Prior(mean, covariance)
