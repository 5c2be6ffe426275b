"""Points and outlines from one camera into another: where they land, bent as the lens bends them, cut where unseen.

An outline is a closed chain of points, and what it encloses. It is cut three times, each time where what it may not
cross is a circle or a rectangle: at the source lens' rim, in the source picture; at the rim of a cone around the
target's axis that holds all the target shows, in the azimuthal equidistant projection around that axis (a ray at angle
theta lies theta from the origin), which unlike the target's own is defined for rays behind it too; and at the target's
frame. Where an outline leaves and returns, the border between closes it, so that of a region cut in two the parts
stay joined by a line along the border.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from . import pixel
from .cameras import Camera, FisheyeCamera, is_tensor, namespace

# Rims are drawn at this part of their angle, so that rounding leaves no point of them invalid: where theta_d turns, its
# radius is 1e-12 smaller.
_WITHIN = 1 - 1e-6
# A chord of a rim then lies within 1e-5 of its radius.
_CHORDS_PER_TURN = 720
# An outline straight through the point behind the target's axis has no side there; this far beside it, in radians, it
# has one. Halving finds the turn: 2^-_MAX_HALVINGS of an edge is less.
_NUDGE = np.array([1e-9, 2e-9])
_MAX_HALVINGS = 48
# An edge is first cut into pieces no longer than this part of the source's diagonal, that no bend hides between their
# ends and middles; one that reaches far outside the picture, into this many. An edge that passes the point behind jumps
# across the target: no piece of an image is longer than the target's own size.
_PIECE, _MAX_PIECES = 1 / 32, 64
# The largest share of an outline of which anything was cut off.
_ALMOST_ALL = 1 - 1e-9
# On the target's frame, in pixels.
_TOUCHING = 1e-9


def moved_points(points: Any, source: Camera, target: Camera, source_from_target: Any) -> tuple[Any, Any]:
    """Give where points lie in the target's frame.

    Args:
        points: (..., 2) array, or tensor: differentiable then in all there is.
        source: the camera in whose picture they are given; one.
        target: the camera in whose picture they are wanted; one.
        source_from_target: (3, 3) rotation of the target's rays into the source's frame, of the points' kind, or None.

    Returns:
        (..., 2), NaN where the target does not show a point, and valid (...).
    """
    rays, known = source.unproject(points)
    xp = namespace(rays)
    if source_from_target is not None:
        rays = xp.where(known[..., None], rays, 0)  # or NaN would reach the rotation's gradient
        rays = rays @ (source_from_target.to(rays) if is_tensor(rays) else source_from_target)
    positions, valid = target.project(rays)
    height, width = target.image_size
    valid = known & valid
    for positions_along, size in ((positions[..., 0], width), (positions[..., 1], height)):
        valid = valid & (positions_along >= -pixel.HALF_PIXEL) & (positions_along <= size - pixel.HALF_PIXEL)
    return xp.where(valid[..., None], positions, math.nan), valid


class Transfer:
    """Outlines, from one camera into another of the same centre.

    Args:
        source: the camera in whose picture outlines are given; one.
        target: the camera in whose picture they are wanted; one.
        source_from_target: (3, 3) rotation of the target's rays into the source's frame; None for none.
        tolerance_px: how far, in the target, an outline's chords may stray from its curve.
    """

    def __init__(
        self, source: Camera, target: Camera, source_from_target: np.ndarray | None, tolerance_px: float
    ) -> None:
        self.source, self.target, self.tolerance_px = source.numpy(), target.numpy(), tolerance_px
        self.rotation = np.eye(3) if source_from_target is None else source_from_target
        size = np.array(target.image_size[::-1])
        self.frame = np.stack([0 * size, size]) - pixel.HALF_PIXEL
        # What lies further off than the frame is large can neither be seen nor bend back into the frame unnoticed.
        self._surroundings = self.frame + np.stack([-size, size])
        self._target_limit = _theta_farthest(self.target, self._surroundings) * _WITHIN
        self._source_limit = _theta_rim(self.source) * _WITHIN
        self._is_usable = all(np.isfinite(c.params).all() and c.params[:2].all() for c in (self.source, self.target))
        self._piece = _PIECE * math.hypot(*source.image_size)

    def polygons(self, polygons: Sequence[np.ndarray]) -> tuple[list[np.ndarray], np.ndarray]:
        """Give `polygon` of each: N arrays (K, 2), and the shares (N,)."""
        seen = [self.polygon(vertices) for vertices in polygons]
        return [outline for outline, _ in seen], np.array([share for _, share in seen], dtype=np.float64)

    def polygon(self, vertices: np.ndarray) -> tuple[np.ndarray, float]:
        """Give what the target shows of a polygon (M, 2), and the share of its area in the source that this is.

        Returns:
            (K, 2), no vertices where nothing is seen; and the share in [0, 1], 1 where nothing was cut off.
        """
        if not (self._is_usable and np.isfinite(vertices).all()):
            return np.empty((0, 2)), 0.0
        chain, beyond_lens = self._cut_at_lens(vertices)
        if abs(_area(chain)) == 0:
            return np.empty((0, 2)), 0.0
        chain = _trace(chain, self._near, self.tolerance_px, self._piece, max(self.target.image_size))
        azimuthal = self._azimuthal(chain)
        behind, behind_seen = self.source.project(self.rotation @ [*-_NUDGE, -1])
        if behind_seen and _contains(chain, behind):
            azimuthal = _turned_inside_out(azimuthal)
        azimuthal, beyond_cone = _cut_at_circle(azimuthal, self._target_limit)
        polygon, beyond_frame = _cut_at_frame(self._positions(azimuthal), self.frame)
        if not (beyond_lens or beyond_cone or beyond_frame):
            return polygon, 1.0
        if len(polygon) < 3:
            return np.empty((0, 2)), 0.0
        seen = self._back(_trace(polygon, self._back, self.tolerance_px))
        share = abs(_area(seen) / _area(vertices))
        return (polygon, min(share, _ALMOST_ALL)) if share > 0 else (np.empty((0, 2)), 0.0)

    def _cut_at_lens(self, vertices: np.ndarray) -> tuple[np.ndarray, bool]:
        if not isinstance(self.source, FisheyeCamera):
            return vertices, False
        # In (x - cx) / fx, (y - cy) / fy the rim is a circle.
        rim, _ = self.source.project(_rays(np.array([[self._source_limit, 0]])))
        focal, centre = self.source.params[:2], self.source.params[2:4]
        chain, is_cut = _cut_at_circle((vertices - centre) / focal, float((rim[0, 0] - centre[0]) / focal[0]))
        return (chain * focal + centre if is_cut else vertices), is_cut

    def _azimuthal(self, points: np.ndarray) -> np.ndarray:
        """Source pixels in the azimuthal equidistant projection around the target's axis."""
        return _azimuthal(self.source.unproject(points)[0] @ self.rotation, self._target_limit)

    def _positions(self, azimuthal: np.ndarray) -> np.ndarray:
        """From there to the target's pixels."""
        return np.asarray(self.target.project(_rays(azimuthal))[0])

    def _near(self, points: np.ndarray) -> np.ndarray:
        """Source pixels to target pixels, with what lies far off moved nearer, so that its bends do not count."""
        return self._positions(_limited(self._azimuthal(points), self._target_limit)).clip(*self._surroundings)

    def _back(self, points: np.ndarray) -> np.ndarray:
        """Target pixels to source pixels, at most to the lens' rim, from where a chord may stray."""
        azimuthal = _azimuthal(self.target.unproject(points)[0] @ self.rotation.T, self._source_limit)
        return np.asarray(self.source.project(_rays(_limited(azimuthal, self._source_limit)))[0])


def _azimuthal(rays: np.ndarray, theta_limit: float) -> np.ndarray:
    """Rays (N, 3) in the azimuthal equidistant projection (N, 2): theta from the origin."""
    x, y, z = rays.T
    across = np.hypot(x, y)
    theta = np.arctan2(across, z)
    beyond = theta > theta_limit
    if beyond.any():
        x, y = x + _NUDGE[0] * beyond, y + _NUDGE[1] * beyond
        across = np.hypot(x, y)
    stretch = theta / np.where(across > 0, across, 1)
    return np.stack([x * stretch, y * stretch], -1)


def _rays(azimuthal: np.ndarray) -> np.ndarray:
    """The inverse, of unit length."""
    theta = np.hypot(azimuthal[:, 0], azimuthal[:, 1])[:, None]
    # sin(theta) / theta, which numpy gives for pi theta
    return np.concatenate([azimuthal * np.sinc(theta / math.pi), np.cos(theta)], -1)


def _limited(azimuthal: np.ndarray, theta_limit: float) -> np.ndarray:
    """What lies beyond an angle moved to it, in the same direction."""
    theta = np.hypot(azimuthal[:, 0], azimuthal[:, 1])[:, None]
    return np.asarray(azimuthal * np.where(theta > theta_limit, theta_limit / theta, 1))


def _theta_rim(camera: Camera) -> float:
    """The angle off the axis where a camera's picture ends, however large."""
    return float(camera.theta_max) if isinstance(camera, FisheyeCamera) else math.pi / 2


def _theta_farthest(camera: Camera, window: np.ndarray) -> float:
    """The largest angle off the axis within a rectangle of the picture, given by two of its corners."""
    corners = np.stack(np.meshgrid(*window.T), -1).reshape(4, 2)
    rays, valid = camera.unproject(corners)
    theta = np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2])
    return float(np.where(valid, theta, _theta_rim(camera)).max())


def _trace(
    chain: np.ndarray,
    through: Callable[[np.ndarray], np.ndarray],
    tolerance: float,
    longest: float = math.inf,
    longest_image: float = math.inf,
) -> np.ndarray:
    """Divide a chain's edges until their images are straight to a tolerance."""
    edges = np.roll(chain, -1, 0) - chain
    counts = np.ceil(np.hypot(edges[:, 0], edges[:, 1]) / longest).clip(1, _MAX_PIECES).astype(int)
    edge = np.repeat(np.arange(len(chain)), counts)
    place = np.arange(len(edge)) - np.repeat(np.cumsum(counts) - counts, counts)
    chain = chain[edge] + (place / counts[edge])[:, None] * edges[edge]
    images = through(chain)
    for _ in range(_MAX_HALVINGS):
        middles = (chain + np.roll(chain, -1, 0)) / 2
        images_of_middles = through(middles)
        ends = np.roll(images, -1, 0)
        is_bent = _distance(images_of_middles, images, ends) > tolerance
        bent = np.flatnonzero(is_bent | (np.linalg.norm(ends - images, axis=-1) > longest_image))
        if not len(bent):
            break
        chain = np.insert(chain, bent + 1, middles[bent], 0)
        images = np.insert(images, bent + 1, images_of_middles[bent], 0)
    return chain


def _distance(points: np.ndarray, starts: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Distance of points to segments, each (N, 2)."""
    along, across = ends - starts, points - starts
    square = (along * along).sum(-1)
    place = ((along * across).sum(-1) / np.where(square > 0, square, 1)).clip(0, 1)
    return np.asarray(np.linalg.norm(across - place[:, None] * along, axis=-1))


def _cut_at_circle(chain: np.ndarray, radius: float) -> tuple[np.ndarray, bool]:
    """Cut a chain at a circle around the origin; whether anything was cut off.

    What runs outside is replaced by the arc that it runs along, as often around as it does.
    """
    outside = np.hypot(chain[:, 0], chain[:, 1]) > radius
    if not outside.any():
        return chain, False
    # |chain + t edge| = radius
    edges = np.roll(chain, -1, 0) - chain
    a, b = (edges * edges).sum(-1), (chain * edges).sum(-1)
    c = (chain * chain).sum(-1) - radius * radius
    with np.errstate(invalid="ignore", divide="ignore"):
        root = np.sqrt(b * b - a * c)
        points, is_vertex = _with_crossings(chain, edges, np.stack([(-b - root) / a, (-b + root) / a], -1))
    outside = np.hypot(points[:, 0], points[:, 1]) > radius
    outside &= is_vertex  # crossings are on the circle, whatever rounding says
    if outside.all():
        turn = _turns(points, np.roll(points, -1, 0)).sum()
        return _arc(points[0], radius, turn if abs(turn) > math.pi else 0.0)[1:], True
    start = int(np.argmin(outside))
    points, outside = np.roll(points, -start, 0), np.roll(outside, -start)
    parts = []
    for part in np.split(np.arange(len(points)), np.flatnonzero(np.diff(outside)) + 1):
        if outside[part[0]]:
            run = points[[part[0] - 1, *part, (part[-1] + 1) % len(points)]]
            parts.append(_arc(run[0], radius, _turns(run[:-1], run[1:]).sum())[1:-1])
        else:
            parts.append(points[part])
    return np.concatenate(parts), True


def _arc(start: np.ndarray, radius: float, turn: float) -> np.ndarray:
    """Points along a circle, both ends included, from where `start` lies as seen from its centre."""
    count = math.ceil(abs(turn) / (2 * math.pi) * _CHORDS_PER_TURN) + 1
    angles = math.atan2(start[1], start[0]) + np.linspace(0, turn, count)
    return radius * np.stack([np.cos(angles), np.sin(angles)], -1)


def _turns(starts: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Angles from one point to the next as seen from the origin, in (-pi, pi]."""
    return np.asarray(np.arctan2(_cross(starts, ends), (starts * ends).sum(-1)))


def _turned_inside_out(azimuthal: np.ndarray) -> np.ndarray:
    """Enclose what lies around a chain, to the point behind: it, joined to the circle that this point is drawn as.

    Joined where it is farthest out, so that the join crosses nothing.
    """
    chain = np.roll(azimuthal, -int(np.hypot(azimuthal[:, 0], azimuthal[:, 1]).argmax()), 0)
    around = _arc(chain[0], math.pi, -math.copysign(2 * math.pi, _area(chain)))
    return np.concatenate([chain, chain[:1], around])


def _cut_at_frame(chain: np.ndarray, frame: np.ndarray) -> tuple[np.ndarray, bool]:
    """Cut a chain at a rectangle, given by two of its corners; whether anything was cut off.

    Divided where it crosses the rectangle's extended sides, what lies outside is moved to the nearest point inside.
    """
    if ((chain >= frame[0]) & (chain <= frame[1])).all():
        return chain, False
    edges = np.roll(chain, -1, 0) - chain
    with np.errstate(invalid="ignore", divide="ignore"):
        places = (frame - chain[:, None]) / edges[:, None]
    points, _ = _with_crossings(chain, edges, places.reshape(-1, 4))
    points = points.clip(*frame)
    for side in frame:
        points = np.where(np.abs(points - side) < _TOUCHING, side, points)
    # What remains of excursions are spikes along the sides, folding back onto themselves.
    idle = np.ones(1, bool)
    while idle.any():
        points = points[(points != np.roll(points, 1, 0)).any(-1)]
        on_side = (points[:, None] == frame).reshape(-1, 4)
        idle = (on_side & np.roll(on_side, 1, 0) & np.roll(on_side, -1, 0)).any(-1)
        points = points[~idle]
    return points, True


def _with_crossings(chain: np.ndarray, edges: np.ndarray, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Insert points at some places of each edge, 0 to 1 along it; and tell which points are the chain's own."""
    places = np.sort(np.where((places > 0) & (places < 1), places, np.nan), -1)
    places = np.concatenate([np.zeros((len(chain), 1)), places], -1)
    points = chain[:, None] + places[..., None] * edges[:, None]
    there = np.isfinite(places)
    is_vertex = np.zeros_like(there)
    is_vertex[:, 0] = True
    return points[there], is_vertex[there]


def _contains(chain: np.ndarray, point: np.ndarray) -> bool:
    """Whether a chain encloses a point: whether it crosses an odd number of times what lies to the right of it."""
    starts, ends = chain - point, np.roll(chain, -1, 0) - point
    crosses = (starts[:, 1] > 0) != (ends[:, 1] > 0)
    to_the_right = _cross(starts, ends) * np.sign(ends[:, 1] - starts[:, 1]) > 0
    return bool((crosses & to_the_right).sum() % 2)


def _area(chain: np.ndarray) -> float:
    """Twice the enclosed area would do as well: only signs and ratios are asked for."""
    if len(chain) < 3:
        return 0.0
    around = chain - chain[0]
    return float(_cross(around, np.roll(around, -1, 0)).sum())


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
