"""Scenes, and pictures of them through any camera: exact ray casting, no rasterisation."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from .lighting import AmbientLight, Sun, encode_srgb, tone_curve
from .materials import Material, Surface
from .solids import Label, Shape, Solid, SolidTree, box_edges

_CHUNK = 1 << 15
"""Rays traced at once: few enough for the processor's cache."""

Unproject = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class Rendering:
    """What rays (...) see: RGB `image` (..., 3) uint8, class `labels` (...) uint8, and `depth`
    (...) in metres along the ray, inf where it meets nothing."""

    image: np.ndarray
    labels: np.ndarray
    depth: np.ndarray


class World:
    """Solids under a light: everything of a scene but the camera.

    `sky` gives the radiance (N, 3) of unit rays (N, 3) that leave the world. `haze` is the distance
    in metres at which two thirds of the colour are the horizon's.
    """

    def __init__(
        self,
        solids: Sequence[Solid],
        sun: Sun,
        ambient: AmbientLight,
        sky: Callable[[np.ndarray], np.ndarray],
        haze: float = np.inf,
        exposure: float = 1.0,
    ) -> None:
        self.solids = list(solids)
        self.sun, self.ambient, self.sky = sun, ambient, sky
        self.haze, self.exposure = haze, exposure
        self.tree = SolidTree(self.solids)
        casting = [i for i, solid in enumerate(self.solids) if solid.casts_shadow]
        everything = len(casting) == len(self.solids)
        self.casters = self.tree if everything else SolidTree(self.solids, casting)
        materials = list(dict.fromkeys(solid.material for solid in self.solids))
        self._materials: list[Material] = materials
        self._material = np.array([materials.index(solid.material) for solid in self.solids])
        self._colour = np.array([solid.colour for solid in self.solids])
        self._lo = np.array([solid.lo for solid in self.solids]).T
        self._hi = np.array([solid.hi for solid in self.solids]).T
        self._is_box = np.array([solid.shape is Shape.BOX for solid in self.solids])
        self.labels = np.array([solid.label for solid in self.solids] + [Label.SKY], dtype=np.uint8)

    def radiance(
        self, origin: np.ndarray, ray: np.ndarray, footprint: np.ndarray, bounces: int = 1
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Radiance (N, 3), distance (N,) and class (N,) seen along unit rays (3, N) from (3, N).

        `footprint` (N,) is the angle in radians a ray stands for; mirrors follow `bounces` times.
        """
        distance, index = self.tree.nearest(origin, ray)
        light = np.empty((ray.shape[1], 3))
        missed = index < 0
        light[missed] = self.sky(ray[:, missed].T)
        hit = np.flatnonzero(~missed)
        for start in range(0, hit.size, _CHUNK):
            rows = hit[start : start + _CHUNK]
            light[rows] = self._shade(
                origin[:, rows], ray[:, rows], distance[rows], index[rows], footprint[rows], bounces
            )
        return light, distance, self.labels[index]

    def is_smooth(self, origin: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """Whether (N,) two rays (3, N) from each origin meet one flat surface of one colour."""
        distances, indices = zip(*(self.tree.nearest(origin, ray) for ray in (first, second)), strict=True)
        both = np.flatnonzero((indices[0] >= 0) & (indices[1] >= 0))
        (t0, t1), (i0, i1) = ([each[both] for each in pair] for pair in (distances, indices))
        points = [origin[:, both] + t * r[:, both] for t, r in ((t0, first), (t1, second))]
        normals = [self._normals(p, i) for p, i in zip(points, (i0, i1), strict=True)]
        smooth = indices[0] == indices[1]
        smooth[both] = (
            (self._material[i0] == self._material[i1])
            & (self._colour[i0] == self._colour[i1]).all(-1)
            & ((normals[0] * normals[1]).sum(0) > 1 - 1e-9)
            & (np.abs((normals[0] * (points[1] - points[0])).sum(0)) < 1e-6)
        )
        return smooth

    def _shade(
        self,
        origin: np.ndarray,
        ray: np.ndarray,
        distance: np.ndarray,
        index: np.ndarray,
        footprint: np.ndarray,
        bounces: int,
    ) -> np.ndarray:
        point = origin + distance * ray
        normal = self._normals(point, index)
        surface = self._surface(point, normal, ray, index, distance * footprint)
        light = np.empty((index.size, 3))
        mirror = np.zeros(index.size)
        for number in np.unique(self._material[index]):
            material = self._materials[number]
            rows = np.flatnonzero(self._material[index] == number)
            part = Surface(**{name: value[rows] for name, value in vars(surface).items()})
            light[rows] = material.texture(part)
            if not material.emits:
                light[rows] *= self._irradiance(point[:, rows], normal[:, rows])
            mirror[rows] = material.reflectance
        if bounces:
            shiny = np.flatnonzero(mirror)
            light[shiny] = self._reflected(
                light[shiny],
                mirror[shiny],
                point[:, shiny],
                normal[:, shiny],
                ray[:, shiny],
                footprint[shiny],
                bounces,
            )
        if np.isfinite(self.haze):
            level = ray.copy()
            level[1] = np.minimum(level[1], -0.02)
            veil = 1 - np.exp(-distance / self.haze)[:, None]
            light += veil * (self.sky((level / np.linalg.norm(level, axis=0)).T) - light)
        return light

    def _normals(self, point: np.ndarray, index: np.ndarray) -> np.ndarray:
        centre = (self._lo + self._hi)[:, index] / 2
        offset = point - centre
        face = (np.abs(offset) - (self._hi - self._lo)[:, index] / 2).argmax(0)
        columns = np.arange(index.size)
        normal = np.zeros_like(point)
        normal[face, columns] = np.sign(offset[face, columns])
        for number in np.unique(index[~self._is_box[index]]):
            rows = np.flatnonzero(index == number)
            normal[:, rows] = self.solids[number].normals(point[:, rows])
        return normal

    def _surface(
        self,
        point: np.ndarray,
        normal: np.ndarray,
        ray: np.ndarray,
        index: np.ndarray,
        width: np.ndarray,
    ) -> Surface:
        face = np.abs(normal).argmax(0)
        columns = np.arange(index.size)
        across = np.where(face == 0, 2, 0)
        up = np.where(face == 1, 2, 1)
        flip = np.where(face == 1, 1.0, -1.0)
        # A ray's cone cuts the face in an ellipse; these are its extents along u and v.
        cosine = np.maximum(np.abs((normal * ray).sum(0)), 0.01)
        du = width * np.sqrt(1 + (ray[across, columns] / cosine) ** 2)
        dv = width * np.sqrt(1 + (ray[up, columns] / cosine) ** 2)
        lo, hi = self._lo[:, index], self._hi[:, index]
        size = hi - lo
        inside = (point - lo) / size
        a, b = inside[across, columns], inside[up, columns]
        edge = np.minimum(np.minimum(a, 1 - a) * size[across, columns], np.minimum(b, 1 - b) * size[up, columns])
        return Surface(
            u=point[across, columns],
            v=flip * point[up, columns],
            du=du,
            dv=dv,
            a=a,
            b=np.where(face == 1, b, 1 - b),
            edge=edge,
            position=point.T,
            normal=normal.T,
            ray=ray.T,
            colour=self._colour[index],
        )

    def _irradiance(self, point: np.ndarray, normal: np.ndarray) -> np.ndarray:
        light = self.ambient.irradiance(point, normal)
        facing = self.sun.direction @ normal
        rows = np.flatnonzero(facing > 0)
        towards = np.broadcast_to(self.sun.direction[:, None], (3, rows.size))
        blocked = self.casters.nearest(point[:, rows], towards, beyond=1e-4)[1] >= 0
        rows = rows[~blocked]
        light[rows] += facing[rows, None] * self.sun.radiance
        return light

    def _reflected(
        self,
        light: np.ndarray,
        reflectance: np.ndarray,
        point: np.ndarray,
        normal: np.ndarray,
        ray: np.ndarray,
        footprint: np.ndarray,
        bounces: int,
    ) -> np.ndarray:
        cosine = -(normal * ray).sum(0)
        fresnel = reflectance + (1 - reflectance) * np.clip(1 - cosine, 0, 1) ** 5 * np.sqrt(reflectance)
        mirrored = ray + 2 * cosine * normal
        image = self.radiance(point + 1e-4 * normal, mirrored, footprint, bounces - 1)[0]
        return light + fresnel[:, None] * (image - light)


@dataclass(frozen=True)
class Scene:
    """A world and the camera's place in it.

    `position` (3,) is the camera centre in world metres, `rotation` (3, 3) takes camera vectors to
    the world. `inner_corners` (rows, columns, 3) are a chessboard's, in world metres.
    """

    world: World
    position: np.ndarray
    rotation: np.ndarray
    inner_corners: np.ndarray | None = None

    @property
    def corners(self) -> np.ndarray:
        """The chessboard's inner corners (rows, columns, 3) in the camera frame, in metres."""
        if self.inner_corners is None:
            raise ValueError("Scene.corners: expected a scene with a chessboard, got one without")
        return self.to_camera(self.inner_corners)

    def to_camera(self, points: np.ndarray) -> np.ndarray:
        """World points (..., 3) in the camera frame, in metres."""
        return (points - self.position) @ self.rotation

    def posed(
        self,
        position: Sequence[float] | None = None,
        yaw_deg: float = 0.0,
        pitch_deg: float = 0.0,
        roll_deg: float = 0.0,
    ) -> Scene:
        """The same world from another place: `position` (3,) in world metres, y down.

        The camera turns right by yaw, then up by pitch, then clockwise by roll.
        """
        place = self.position if position is None else np.asarray(position, dtype=float)
        if place.shape != (3,):
            raise ValueError(f"posed(): expected position of shape (3,), got {place.shape}")
        yaw, pitch, roll = np.radians([yaw_deg, pitch_deg, roll_deg])
        turn = _rotation(yaw, 2, 0) @ _rotation(pitch, 1, 2) @ _rotation(roll, 0, 1)
        return replace(self, position=place, rotation=turn)

    def lines(self, min_angle_deg: float = 5.0) -> np.ndarray:
        """End points (N, 2, 3) of the straight box edges that span at least this angle and that the
        camera can see for most of their length, in the camera frame, in metres."""
        boxes = [solid for solid in self.world.solids if solid.shape is Shape.BOX]
        edges = np.array([edge for solid in boxes for edge in box_edges(solid)]) - self.position
        towards = edges / np.linalg.norm(edges, axis=-1, keepdims=True)
        cosine = (towards[:, 0] * towards[:, 1]).sum(-1)
        edges = np.unique(edges[cosine <= np.cos(np.radians(min_angle_deg))].round(9), axis=0)
        # A few samples first: they rule out most edges, which lie inside or behind something.
        for samples in (3, 15):
            edges = edges[self._visible_share(edges, samples) > 0.7]
        return edges @ self.rotation

    def _visible_share(self, edges: np.ndarray, samples: int) -> np.ndarray:
        """Share (N,) of edges (N, 2, 3), in world axes from the camera, that can be made out:
        nothing hides them, and they are not flush with a surface of the same colour."""
        along = np.linspace(0.02, 0.98, samples)[:, None]
        points = (edges[:, :1] * (1 - along) + edges[:, 1:] * along).reshape(-1, 3).T
        courses = np.repeat(edges[:, 1] - edges[:, 0], samples, axis=0).T
        visible = np.zeros(points.shape[1], dtype=bool)
        for start in range(0, visible.size, _CHUNK):
            rows = slice(start, start + _CHUNK)
            visible[rows] = self._makes_out(points[:, rows], courses[:, rows])
        return visible.reshape(-1, samples).mean(1)

    def _makes_out(self, points: np.ndarray, courses: np.ndarray) -> np.ndarray:
        """Whether (N,) points (3, N) of edges running along `courses` (3, N) can be made out."""
        distance = np.linalg.norm(points, axis=0)
        ray = points / distance
        origin = np.broadcast_to(self.position[:, None], ray.shape)
        visible = self.world.tree.nearest(origin, ray)[0] > distance * (1 - 1e-6)
        rows = np.flatnonzero(visible)
        aside = np.cross(courses[:, rows], ray[:, rows], axis=0)
        aside *= 1e-3 / np.linalg.norm(aside, axis=0)
        visible[rows] = ~self.world.is_smooth(origin[:, rows], ray[:, rows] - aside, ray[:, rows] + aside)
        return visible


def _rotation(angle: float, first: int, second: int) -> np.ndarray:
    """Rotation (3, 3) by an angle in radians that takes axis `first` towards axis `second`."""
    matrix = np.eye(3)
    matrix[first, first] = matrix[second, second] = np.cos(angle)
    matrix[second, first] = np.sin(angle)
    matrix[first, second] = -np.sin(angle)
    return matrix


def render(scene: Scene, rays: np.ndarray, *, footprint: float | np.ndarray = 0.0) -> Rendering:
    """Look along camera rays (..., 3): x right, y down, z forward, of any length and direction.

    `footprint`, a number or (...), is the angle in radians each ray stands for: textures are
    averaged over it. Rays that are zero or not finite see black, class 0, at an infinite depth.
    """
    light, labels, depth = _trace(scene, rays, footprint)
    return Rendering(encode_srgb(light), labels, depth)


def render_camera(scene: Scene, unproject: Unproject, image_size: tuple[int, int], supersample: int = 3) -> Rendering:
    """Picture of (height, width) pixels through the camera that `unproject` describes.

    `unproject` takes pixel coordinates (..., 2) as (x, y), integers at pixel centres, to camera
    rays (..., 3) and valid (...). Each pixel is the mean, in linear light, of `supersample`^2
    samples; labels and depth are those of its centre, so the number must be odd. What is not valid
    is black, class 0, at an infinite depth.
    """
    if len(image_size) != 2 or min(image_size) < 1:
        raise ValueError(f"render_camera(): expected image_size as positive (height, width), got {image_size}")
    if supersample < 1 or supersample % 2 == 0:
        raise ValueError(f"render_camera(): expected supersample as an odd positive number, got {supersample}")
    height, width = image_size
    image = np.zeros((height, width, 3), dtype=np.uint8)
    labels = np.zeros((height, width), dtype=np.uint8)
    depth = np.full((height, width), np.inf)
    middle = supersample // 2
    for rows, columns in _tiles(image_size, max(1, 180 // supersample)):
        y, x = (
            (np.arange(span.start * supersample, span.stop * supersample) + 0.5) / supersample - 0.5
            for span in (rows, columns)
        )
        points = np.stack(np.meshgrid(x, y), -1)
        rays, valid = unproject(points)
        _check_unprojected(points, rays, valid)
        rays = np.where(valid[..., None], rays, np.nan)
        light, seen, far = _trace(scene, rays, _footprint(rays))
        count = (rows.stop - rows.start, supersample, columns.stop - columns.start, supersample)
        image[rows, columns] = encode_srgb(light.reshape(*count, 3).mean((1, 3)))
        labels[rows, columns] = seen.reshape(count)[:, middle, :, middle]
        depth[rows, columns] = far.reshape(count)[:, middle, :, middle]
    return Rendering(image, labels, depth)


def _tiles(image_size: tuple[int, int], side: int) -> Iterator[tuple[slice, slice]]:
    height, width = image_size
    for top in range(0, height, side):
        for left in range(0, width, side):
            yield slice(top, min(top + side, height)), slice(left, min(left + side, width))


def _check_unprojected(points: np.ndarray, rays: np.ndarray, valid: np.ndarray) -> None:
    shape = points.shape[:-1]
    for name, got, expected in (("rays", rays, (*shape, 3)), ("valid", valid, shape)):
        if np.shape(got) != expected:
            raise ValueError(
                f"render_camera(): expected unproject to return {name} of shape {expected} for "
                f"points of shape {points.shape}, got {np.shape(got)}"
            )


def _footprint(rays: np.ndarray) -> np.ndarray:
    """Angle in radians (H, W) between neighbouring rays of a grid (H, W, 3), 0 where unknown."""
    with np.errstate(invalid="ignore", divide="ignore"):
        unit = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    area = np.ones(rays.shape[:2])
    for axis in (0, 1):
        if rays.shape[axis] > 1:
            area *= np.linalg.norm(np.gradient(unit, axis=axis), axis=-1)
        else:
            area *= 0
    return np.nan_to_num(np.sqrt(area))


def _trace(scene: Scene, rays: np.ndarray, footprint: float | np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Display light (..., 3), class (...) and depth (...) along camera rays (..., 3)."""
    rays = np.asarray(rays, dtype=float)
    if rays.ndim == 0 or rays.shape[-1] != 3:
        raise ValueError(f"render(): expected rays of shape (..., 3), got {rays.shape}")
    shape = rays.shape[:-1]
    if np.shape(footprint) not in ((), shape):
        raise ValueError(f"render(): expected footprint of shape () or {shape}, got {np.shape(footprint)}")
    flat = rays.reshape(-1, 3)
    angle = np.broadcast_to(footprint, shape).ravel()
    length = np.linalg.norm(flat, axis=1)
    usable = np.flatnonzero(np.isfinite(length) & (length > 0))
    light = np.zeros((len(flat), 3))
    labels = np.zeros(len(flat), dtype=np.uint8)
    depth = np.full(len(flat), np.inf)
    for start in range(0, usable.size, _CHUNK):
        rows = usable[start : start + _CHUNK]
        ray = np.ascontiguousarray(scene.rotation @ (flat[rows] / length[rows, None]).T)
        origin = np.repeat(scene.position[:, None], rows.size, axis=1)
        radiance, depth[rows], labels[rows] = scene.world.radiance(origin, ray, angle[rows])
        light[rows] = tone_curve(scene.world.exposure * radiance)
    return light.reshape(*shape, 3), labels.reshape(shape), depth.reshape(shape)
