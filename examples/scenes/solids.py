"""Convex solids, the tree that finds the one a ray meets first, and the placements that build them.

World axes are the camera's at rest: x right, y down, z forward, in metres. Heights count upwards
from the ground at y = 0, so a height h lies at y = -h.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from enum import Enum, IntEnum

import numpy as np

from .materials import Material

Interval = tuple[float, float]
Colour = np.ndarray


class Label(IntEnum):
    """Class ids of the label images."""

    UNLABELLED = 0
    WALL = 1
    FLOOR = 2
    CEILING = 3
    WINDOW = 4
    DOOR = 5
    FURNITURE = 6
    PICTURE = 7
    LAMP = 8
    PLANT = 9
    SKY = 10
    BUILDING = 11
    ROAD = 12
    SIDEWALK = 13
    CAR = 14
    TREE = 15
    POLE = 16
    CHESSBOARD = 17


class Shape(Enum):
    """What a solid fills of its bounding box; the value is the share of the volume it fills."""

    BOX = 1.0
    PRISM = 0.7
    CYLINDER = 0.78
    ELLIPSOID = 0.52


@dataclass(frozen=True, eq=False)
class Solid:
    """A convex solid: its bounding box `lo` (3,) to `hi` (3,) in metres, cut to its shape.

    A cylinder runs along world axis `axis`; a prism is where `planes` (K, 4) hold: n . p <= c.
    """

    lo: np.ndarray
    hi: np.ndarray
    material: Material
    colour: Colour
    label: Label
    shape: Shape = Shape.BOX
    axis: int = 1
    planes: np.ndarray | None = None
    casts_shadow: bool = True

    def cut(
        self, origin: np.ndarray, ray: np.ndarray, near: np.ndarray, far: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Cut the bounding box's interval `near`, `far` (N,) of rays (3, N) down to the shape."""
        if self.shape is Shape.BOX:
            return near, far
        if self.planes is not None:
            for plane in self.planes:
                along = plane[:3] @ ray
                along = np.where(np.abs(along) < 1e-12, 1e-12, along)
                t = (plane[3] - plane[:3] @ origin) / along
                near = np.where(along < 0, np.maximum(near, t), near)
                far = np.where(along > 0, np.minimum(far, t), far)
            return near, far
        axes = [i for i in range(3) if self.shape is Shape.ELLIPSOID or i != self.axis]
        centre = ((self.lo + self.hi) / 2)[axes, None]
        radius = ((self.hi - self.lo) / 2)[axes, None]
        start, step = (origin[axes] - centre) / radius, ray[axes] / radius
        a = np.maximum((step * step).sum(0), 1e-24)
        b = (start * step).sum(0)
        discriminant = b * b - a * ((start * start).sum(0) - 1)
        root = np.sqrt(np.maximum(discriminant, 0))
        near = np.where(discriminant > 0, np.maximum(near, (-b - root) / a), np.inf)
        return near, np.minimum(far, (-b + root) / a)

    def normals(self, points: np.ndarray) -> np.ndarray:
        """Outward unit normals (3, N) at surface points (3, N)."""
        half = ((self.hi - self.lo) / 2)[:, None]
        offset = points - ((self.lo + self.hi) / 2)[:, None]
        if self.shape is Shape.ELLIPSOID:
            gradient = offset / (half * half)
            return gradient / np.linalg.norm(gradient, axis=0)
        distance = np.abs(offset) - half
        if self.shape is Shape.CYLINDER:
            axes = [i for i in range(3) if i != self.axis]
            radial = offset[axes] / half[axes]
            distance[axes] = (np.hypot(*radial) - 1) * half[axes].min()
        face = distance.argmax(0)
        columns = np.arange(points.shape[1])
        normal = np.zeros_like(points)
        normal[face, columns] = np.sign(offset[face, columns])
        if self.shape is Shape.CYLINDER:
            side = face != self.axis
            radial = offset[axes] / (half[axes] * half[axes])
            rounded = radial / np.maximum(np.linalg.norm(radial, axis=0), 1e-12)
            for row, axis in enumerate(axes):
                normal[axis] = np.where(side, rounded[row], normal[axis])
        elif self.planes is not None:
            slack = self.planes[:, :3] @ points - self.planes[:, 3:]
            slanted = slack.max(0) > distance.max(0)
            normal = np.where(slanted, self.planes[slack.argmax(0), :3].T, normal)
        return normal


@dataclass(frozen=True)
class _Node:
    lo: np.ndarray
    hi: np.ndarray
    solid: int | None = None
    children: tuple[_Node, ...] = ()


def _split(indices: np.ndarray, lows: np.ndarray, highs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two parts of the solids `indices` (N,) with bounds (N, 3) that few rays will both meet."""
    centres = lows + highs
    half = indices.size // 2
    if indices.size <= 8:
        order = centres[:, (centres.max(0) - centres.min(0)).argmax()].argsort(kind="stable")
        return indices[order[:half]], indices[order[half:]]
    # The chance that a ray meets a box goes with its surface, so weigh each part by it.
    counts = np.arange(1, indices.size)
    best = np.inf
    for axis in range(3):
        order = centres[:, axis].argsort(kind="stable")
        backwards = order[::-1]
        before = _area(np.minimum.accumulate(lows[order]), np.maximum.accumulate(highs[order]))[:-1]
        after = _area(np.minimum.accumulate(lows[backwards]), np.maximum.accumulate(highs[backwards]))[-2::-1]
        cost = before * counts + after * counts[::-1]
        cut = int(cost.argmin())
        if cost[cut] < best:
            best, parts = cost[cut], (indices[order[: cut + 1]], indices[order[cut + 1 :]])
    return parts


def _area(lo: np.ndarray, hi: np.ndarray) -> np.ndarray:
    """Half the surface (N,) of boxes from lo (N, 3) to hi (N, 3)."""
    x, y, z = (hi - lo).T
    return x * y + y * z + z * x


class SolidTree:
    """A bounding box tree over solids, walked by many rays at once."""

    def __init__(self, solids: Sequence[Solid], members: Sequence[int] | None = None) -> None:
        self.solids = solids
        self._lo = np.array([solid.lo for solid in solids]).reshape(-1, 3)
        self._hi = np.array([solid.hi for solid in solids]).reshape(-1, 3)
        indices = np.arange(len(solids)) if members is None else np.asarray(members, dtype=int)
        self._root = self._build(indices) if indices.size else None

    def _build(self, indices: np.ndarray) -> _Node:
        lows, highs = self._lo[indices], self._hi[indices]
        lo, hi = lows.min(0), highs.max(0)
        node = (lo[:, None], hi[:, None])
        if indices.size == 1:
            return _Node(*node, solid=int(indices[0]))
        left, right = _split(indices, lows, highs)
        return _Node(*node, children=(self._build(left), self._build(right)))

    def nearest(self, origin: np.ndarray, ray: np.ndarray, beyond: float = 1e-6) -> tuple[np.ndarray, np.ndarray]:
        """First hit of rays (3, N): distance (N,), inf for none, and solid index (N,), -1 for none.

        Only hits farther than `beyond` count. A solid is seen from outside only.
        """
        count = ray.shape[1]
        distance = np.full(count, np.inf)
        index = np.full(count, -1)
        if self._root is None or count == 0:
            return distance, index
        # A zero component would make 0 * inf = nan in the slab test below.
        inverse = 1 / np.where(np.abs(ray) < 1e-15, 1e-15, ray)
        shift = origin * inverse
        heading = ray.mean(1)
        pending = [(self._root, np.arange(count))]
        while pending:
            node, active = pending.pop()
            scale, offset = inverse.take(active, axis=1), shift.take(active, axis=1)
            first, second = scale * node.lo - offset, scale * node.hi - offset
            near = np.minimum(first, second).max(0)
            far = np.minimum(np.maximum(first, second).min(0), distance[active])
            hit = (near < far) & (far > beyond)
            active = active[hit]
            if active.size == 0:
                continue
            if node.solid is None:
                # The child popped first should be the closer one, so that it hides the other.
                pending.extend(
                    (child, active) for child in sorted(node.children, key=lambda c: -heading @ (c.lo + c.hi))
                )
                continue
            solid = self.solids[node.solid]
            near, far = near[hit], far[hit]
            if solid.shape is not Shape.BOX:
                near, far = solid.cut(origin[:, active], ray[:, active], near, far)
            hit = (near < far) & (near > beyond)
            distance[active[hit]] = near[hit]
            index[active[hit]] = node.solid
        return distance, index


@dataclass
class Placement:
    """A vertical reference plane to build against: `along` it, up it and `out` of it.

    `origin` (2,) is where along = out = 0 lies in (x, z); `along` and `out` are perpendicular
    axis-aligned unit vectors in (x, z). Solids go to the shared list `solids`.
    """

    solids: list[Solid]
    origin: tuple[float, float] = (0.0, 0.0)
    along: tuple[int, int] = (1, 0)
    out: tuple[int, int] = (0, 1)
    _frame: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        along, out = self.along, self.out
        self._frame = np.array([[along[0], 0, out[0]], [0, -1, 0], [along[1], 0, out[1]]], dtype=float)

    def at(self, along: float, out: float, turned: bool = False) -> Placement:
        """The placement moved to (`along`, `out`), facing the other way when `turned`."""
        x, _, z = self.point(along, 0, out)
        sign = -1 if turned else 1
        return Placement(
            self.solids,
            (x, z),
            (sign * self.along[0], sign * self.along[1]),
            (sign * self.out[0], sign * self.out[1]),
        )

    def sideways(self) -> Placement:
        """The placement turned by a quarter: what ran along now runs out."""
        return Placement(self.solids, self.origin, self.out, (-self.along[0], -self.along[1]))

    def point(self, along: float, height: float, out: float) -> np.ndarray:
        """World point (3,) in metres."""
        return self._frame @ (along, height, out) + (self.origin[0], 0, self.origin[1])

    def box(
        self,
        along: Interval,
        height: Interval,
        out: Interval,
        material: Material,
        colour: Colour,
        label: Label,
        shape: Shape = Shape.BOX,
        axis: str = "height",
        casts_shadow: bool = True,
    ) -> None:
        """Add a solid filling these intervals; a cylinder runs along the placement's `axis`."""
        corners = np.sort([self.point(*p) for p in zip(along, height, out, strict=True)], axis=0)
        column = ("along", "height", "out").index(axis)
        world_axis = int(np.abs(self._frame[:, column]).argmax())
        self.solids.append(Solid(*corners, material, colour, label, shape, world_axis, None, casts_shadow))

    def prism(
        self,
        profile: Sequence[tuple[float, float]],
        depth: Interval,
        material: Material,
        colour: Colour,
        label: Label,
        across: str = "out",
    ) -> None:
        """Add a convex `profile` of (along, height) points swept over `depth` along `out`.

        With across="along", the profile is of (out, height) points swept along `along`.
        """
        polygon = np.asarray(profile, dtype=float)
        swap = across == "along"

        def world(a: float, h: float, o: float) -> np.ndarray:
            return self.point(o, h, a) if swap else self.point(a, h, o)

        planes = []
        middle = world(*polygon.mean(0), sum(depth) / 2)
        for (a0, h0), (a1, h1) in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
            start, sweep = world(a0, h0, depth[0]), world(a0, h0, depth[1])
            normal = np.cross(world(a1, h1, depth[0]) - start, sweep - start)
            normal /= np.linalg.norm(normal)
            normal *= np.sign(normal @ (start - middle))
            planes.append([*normal, normal @ start])
        corners = np.array([world(a, h, o) for a, h in polygon for o in depth])
        self.solids.append(
            Solid(
                corners.min(0),
                corners.max(0),
                material,
                colour,
                label,
                Shape.PRISM,
                planes=np.array(planes),
            )
        )


def box_edges(solid: Solid) -> Iterator[np.ndarray]:
    """The twelve edges (2, 3) of a box, in metres."""
    bounds = np.array([solid.lo, solid.hi])
    for axis in range(3):
        first, second = (i for i in range(3) if i != axis)
        for a in (0, 1):
            for b in (0, 1):
                edge = bounds.copy()
                edge[:, first] = bounds[a, first]
                edge[:, second] = bounds[b, second]
                yield edge
