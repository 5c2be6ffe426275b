"""Choosing a view of a fisheye camera: how much of the picture to keep, how much emptiness to accept, where to look.

Perspective views are chosen in the plane Z = 1 of the camera's frame, where such a view is a rectangle, and the picture
a figure without holes: a rectangle whose border shows the picture shows nothing else inside.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from typing import Any

import numpy as np

from . import pixel
from .camera_files import read_camera_file
from .cameras import Camera, FisheyeCamera, PinholeCamera, is_tensor
from .wide_views import CylindricalView, EquirectangularView, PaniniView, StereographicView

# The widest half angle that `keep_all` shows along an edge: a perspective view of 150 degrees spends nine tenths of
# its pixels on the outer third, and one of 180 degrees would be infinitely large.
KEEP_ALL_THETA_MAX = math.radians(75)

# Projections beside the pinhole, and the widest field of view in degrees that they are given unasked: all there is, or
# as far as things at the edge are not enlarged too much.
WIDE_PROJECTIONS: dict[str, tuple[Callable[[float, tuple[int, int]], Camera], float]] = {
    "cylindrical": (CylindricalView.from_fov, 360),
    "equirectangular": (EquirectangularView.from_fov, 360),
    "stereographic": (StereographicView.from_fov, 300),
    "panini": (PaniniView.from_fov, 160),
}
PROJECTIONS = ("pinhole", *WIDE_PROJECTIONS)

_VIEWS: dict[str, type[Camera]] = {
    kind.model: kind for kind in (PinholeCamera, CylindricalView, EquirectangularView, StereographicView, PaniniView)
}


def view_for(
    camera: FisheyeCamera,
    image_size: tuple[int, int],
    mode: str | None = None,
    *,
    fov_deg: float | None = None,
    focal: float | None = None,
    balance: float | None = None,
    projection: str = "pinhole",
) -> Camera:
    """Give the view that one option asks for, and the edge-matched one without; never a useless one.

    Views are centred on the lens' axis where that lies in the inner half of the picture. Calibrations of long lenses
    put it anywhere, outside the picture too; their views are centred on the largest valid rectangle.

    Other projections than the pinhole take a field of view alone. Without, it is what the lens sees between the left
    and the right edge of its picture, as far as the projection is good for.

    Args:
        camera: one fisheye camera.
        image_size: (height, width) of the view.
        mode: "edge_matched", "keep_all", "valid_only" or "valid_rectangle", the functions of these names.
        fov_deg: field of view across the width, in (0, 180); wider for other projections, see their `from_fov`.
        focal: focal length in pixels, above 0.
        balance: as in `balanced`.
        projection: "pinhole", "cylindrical", "equirectangular", "stereographic" or "panini" (of distance 1).

    Raises:
        TypeError: camera is not a FisheyeCamera.
        ValueError: several options, one out of its range, a batch of cameras, a camera that is not finite, or one of
            whose picture no such view shows anything.
    """
    if (mode, fov_deg, focal, balance).count(None) < 3:
        raise ValueError("view_for(): expected one of mode, fov_deg, focal and balance, got several")
    if projection not in PROJECTIONS:
        raise ValueError(f"view_for(): expected projection in {PROJECTIONS}, got {projection!r}")
    if projection in WIDE_PROJECTIONS:
        if (mode, focal, balance) != (None, None, None):
            raise ValueError(f"view_for(): expected fov_deg or nothing for a {projection} view, got another option")
        from_fov, widest_deg = WIDE_PROJECTIONS[projection]
        camera = _checked(camera, "view_for")
        return from_fov(min(_fov_deg(camera), widest_deg) if fov_deg is None else fov_deg, image_size)
    if fov_deg is not None:
        focal = float(PinholeCamera.from_fov(fov_deg, image_size).params[0])
    if focal is not None:
        view = PinholeCamera.from_focal(focal, image_size)
        return _window(view, _centre(_checked(camera, "view_for"), image_size))
    if balance is not None:
        return balanced(camera, balance, image_size)
    if mode is not None and mode not in MODES:
        raise ValueError(f"view_for(): expected mode in {tuple(MODES)}, got {mode!r}")
    return MODES[mode or "edge_matched"](camera, image_size)


def load_view(path: str | os.PathLike[str], *, image_size: tuple[int, int] | None = None) -> Camera:
    """Read a view from a camera file: a pinhole of any format, or one of `PROJECTIONS` that its `save` wrote.

    Args:
        path: the file.
        image_size: (height, width), needed where the format does not hold it.

    Raises:
        ValueError: the file is no camera file, or holds a lens.
        OSError: the file cannot be read.
    """
    file = read_camera_file(path, image_size=image_size)
    kind = _VIEWS.get(file.model)
    if kind is None:
        raise ValueError(f"load_view(): expected a view, {', '.join(_VIEWS)}, in {os.fspath(path)!r}, got {file.model}")
    return kind(np.array(file.params), (file.height, file.width))


def edge_matched(camera: FisheyeCamera, image_size: tuple[int, int]) -> PinholeCamera:
    """Give the standard view (`PinholeCamera.edge_matched`), and `valid_only` of a lens whose axis lies off centre.

    Args:
        camera: one fisheye camera.
        image_size: (height, width) of the view.
    """
    camera = _checked(camera, "edge_matched")
    if _is_centred(camera):
        return PinholeCamera.edge_matched(camera, image_size)
    return valid_only(camera, image_size)


def keep_all(camera: FisheyeCamera, image_size: tuple[int, int]) -> PinholeCamera:
    """Give the closest centred view that shows the whole fisheye picture, as far as 75 degrees off the axis.

    Args:
        camera: one fisheye camera.
        image_size: (height, width) of the view.
    """
    camera = _checked(camera, "keep_all")
    return _enclose(camera, image_size, _centre(camera, image_size))


def valid_only(camera: FisheyeCamera, image_size: tuple[int, int]) -> PinholeCamera:
    """Give the widest centred view whose every pixel lies on the fisheye picture; no wider than `keep_all`.

    Args:
        camera: one fisheye camera.
        image_size: (height, width) of the view.

    Raises:
        ValueError: no perspective view shows any of the picture.
    """
    camera = _checked(camera, "valid_only")
    centre = _centre(camera, image_size)
    return _inscribe(camera, _enclose(camera, image_size, centre), centre)


def valid_rectangle(camera: FisheyeCamera, image_size: tuple[int, int]) -> PinholeCamera:
    """Give the view, centred or not, that sees the largest solid angle of all whose every pixel lies on the picture.

    By solid angle, because by area the largest would be one far off the axis of a wide lens, where it is all stretch.

    Args:
        camera: one fisheye camera.
        image_size: (height, width) of the view.

    Raises:
        ValueError: no perspective view shows any of the picture.
    """
    camera = _checked(camera, "valid_rectangle")
    widest = _enclose(camera, image_size, np.zeros(2))
    centres = [_largest_rectangle_centre(camera, widest), _centre(camera, image_size)]
    return max((_inscribe(camera, widest, centre) for centre in centres), key=_solid_angle_of)


def balanced(camera: FisheyeCamera, balance: float, image_size: tuple[int, int]) -> PinholeCamera:
    """Give a centred view between `valid_only` (balance 0) and `keep_all` (balance 1), even in the zoom.

    Args:
        camera: one fisheye camera.
        balance: in [0, 1].
        image_size: (height, width) of the view.

    Raises:
        ValueError: balance outside [0, 1], or as `valid_only`.
    """
    if not 0 <= balance <= 1:
        raise ValueError(f"balanced(): expected balance in [0, 1], got {balance:g}")
    camera = _checked(camera, "balanced")
    centre = _centre(camera, image_size)
    wide = _enclose(camera, image_size, centre)
    narrow = _inscribe(camera, wide, centre)
    focal = narrow.params[0] ** (1 - balance) * wide.params[0] ** balance
    return _window(PinholeCamera.from_focal(float(focal), image_size), centre)


def view_rotation(pan_deg: Any = 0.0, tilt_deg: Any = 0.0, roll_deg: Any = 0.0) -> Any:
    """Give the rotation that turns a view, camera_from_view, as `rectify` takes it: a virtual pan-tilt-roll head.

    R = R_y(pan) R_x(tilt) R_z(roll): the camera's vertical is the axis of pan, whatever the tilt.

    Args:
        pan_deg: to the right, in degrees; a number, or an array or tensor (...).
        tilt_deg: upwards.
        roll_deg: clockwise as seen from behind the camera, so that the picture turns anticlockwise.

    Returns:
        (..., 3, 3), a tensor where an angle is one, then differentiable in the angles; else a float64 array.

    Raises:
        ValueError: an infinite angle among numbers and arrays.
    """
    angles: list[Any] = [pan_deg, tilt_deg, roll_deg]
    xp: Any = np
    if any(map(is_tensor, angles)):
        import torch as xp

        like = next(angle for angle in angles if is_tensor(angle))
        angles = [xp.as_tensor(angle, dtype=like.dtype, device=like.device) for angle in angles]
    elif any(np.isinf(angle).any() for angle in angles):
        raise ValueError(f"view_rotation(): expected finite angles, got {pan_deg!r}, {tilt_deg!r} and {roll_deg!r}")
    # The axes are named by where they lie in the cycle x, y, z: a turn about one takes the next towards the one after.
    turns = []
    for angle, axis in zip(angles, (1, 0, 2), strict=True):
        cos, sin = xp.cos(xp.deg2rad(angle)), xp.sin(xp.deg2rad(angle))
        one, zero = xp.ones_like(cos), xp.zeros_like(cos)
        cycled = [one, zero, zero, zero, cos, -sin, zero, sin, cos]
        entries = [cycled[(i - axis) % 3 * 3 + (j - axis) % 3] for i in range(3) for j in range(3)]
        turns.append(xp.stack(entries, -1).reshape(*cos.shape, 3, 3))
    pan, tilt, roll = turns
    return pan @ tilt @ roll


MODES: dict[str, Callable[[FisheyeCamera, tuple[int, int]], PinholeCamera]] = {
    "edge_matched": edge_matched,
    "keep_all": keep_all,
    "valid_only": valid_only,
    "valid_rectangle": valid_rectangle,
}


def _checked(camera: FisheyeCamera, function: str) -> FisheyeCamera:
    """Give the camera in NumPy, once it is one that can have a view."""
    if not isinstance(camera, FisheyeCamera):
        raise TypeError(f"{function}(): expected camera as a FisheyeCamera, got {type(camera).__name__}")
    if camera.params.ndim != 1:
        raise ValueError(f"{function}(): expected one camera, got a batch of {camera.params.shape[0]}")
    camera = camera.numpy()
    if not (np.isfinite(camera.params).all() and camera.params[:2].all()):
        raise ValueError(f"{function}(): expected a camera of finite parameters and focal lengths, got {camera!r}")
    return camera


def _is_centred(camera: FisheyeCamera) -> bool:
    """Whether the axis lies in the inner half of the picture."""
    height, width = camera.image_size
    cx, cy = camera.params[2:4]
    return bool(abs(cx - pixel.centre(width)) <= width / 4 and abs(cy - pixel.centre(height)) <= height / 4)


def _fov_deg(camera: FisheyeCamera) -> float:
    """Twice the smaller of the angles that the midpoints of the left and right edges see, in degrees."""
    if not _is_centred(camera):
        raise ValueError(
            "view_for(): expected fov_deg for a lens whose axis lies outside the inner half of its picture, got none"
        )
    height, width = camera.image_size
    left, right = -pixel.HALF_PIXEL, width - pixel.HALF_PIXEL
    rays, valid = camera.unproject([[left, pixel.centre(height)], [right, pixel.centre(height)]])
    theta = np.where(valid, np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2]), camera.theta_max)
    return math.degrees(2 * theta.min())


def _centre(camera: FisheyeCamera, image_size: tuple[int, int]) -> np.ndarray:
    """Where in the plane Z = 1 a centred view has its middle: (2,)."""
    if _is_centred(camera):
        return np.zeros(2)
    return _largest_rectangle_centre(camera, _enclose(camera, image_size, np.zeros(2)))


def _window(view: PinholeCamera, centre: np.ndarray) -> PinholeCamera:
    """The same window elsewhere in the plane Z = 1, its middle at `centre`."""
    height, width = view.image_size
    focal = float(view.params[0])
    x, y = centre
    params = [focal, focal, pixel.centre(width) - focal * x, pixel.centre(height) - focal * y]
    return PinholeCamera(params, view.image_size)


def _enclose(camera: FisheyeCamera, image_size: tuple[int, int], centre: np.ndarray) -> PinholeCamera:
    """The closest view around `centre` that shows all of the picture up to KEEP_ALL_THETA_MAX."""
    reach = np.abs(_outline(camera, KEEP_ALL_THETA_MAX) - centre).max(0)
    height, width = image_size
    focal = float((np.array([width, height]) / 2 / reach).min())
    return _window(PinholeCamera.from_focal(focal, image_size), centre)


def _inscribe(camera: FisheyeCamera, widest: PinholeCamera, centre: np.ndarray) -> PinholeCamera:
    """The widest view around `centre`, no wider than `widest`, whose every pixel lies on the picture."""

    def view(focal: float) -> PinholeCamera:
        return _window(PinholeCamera.from_focal(focal, widest.image_size), centre)

    def is_valid(focal: float) -> bool:
        rays, _ = view(focal).unproject(_border(widest.image_size))
        return bool(_on_picture(camera, rays).all())

    low = high = float(widest.params[0])
    while not is_valid(high):
        low, high = high, 2 * high
        if high > 1e6 * widest.params[0]:
            raise ValueError(
                "view_for(): expected a camera whose picture shows something within 75 degrees of its axis, "
                f"got {camera!r}"
            )
    while high / low > 1 + 1e-6:
        middle = math.sqrt(low * high)
        low, high = (low, middle) if is_valid(middle) else (middle, high)
    return view(high)


def _largest_rectangle_centre(camera: FisheyeCamera, widest: PinholeCamera) -> np.ndarray:
    """The middle of the rectangle in the plane Z = 1 that shows nothing but picture and the largest solid angle: (2,).

    Of the shape of `widest` and within it. A rectangle is free of the outline if that is nowhere nearer to its middle
    than its edge is, in the maximum norm in units of half its sides. Searched on a grid that contracts.
    """
    half = np.array(widest.image_size[::-1]) / 2 / widest.params[0]
    outline = _outline(camera, math.atan(2 * math.hypot(*half))) / half  # what is cut off lies outside `widest`
    low, high = outline.min(0).clip(-1, 1), outline.max(0).clip(-1, 1)
    best, span = (low + high) / 2, (high - low) / 2
    steps = np.linspace(-1, 1, 9)
    grid = np.stack(np.meshgrid(steps, steps), -1).reshape(-1, 2)
    for _ in range(8):
        centres = best + span * grid
        distance = np.abs(centres[:, None] - outline).max(-1).min(-1)
        size = np.minimum(distance, 1 - np.abs(centres).max(-1))
        rays = np.concatenate([centres * half, np.ones((len(centres), 1))], -1)
        size = np.where(_on_picture(camera, rays) & (size > 0), size, 0)
        best = centres[_solid_angle(centres * half, size[:, None] * half).argmax()]
        span /= 3  # a little more than one step of the grid each way
    return np.asarray(best * half)


def _solid_angle_of(view: PinholeCamera) -> float:
    height, width = view.image_size
    fx, fy, cx, cy = view.numpy().params
    centre = np.array([(pixel.centre(width) - cx) / fx, (pixel.centre(height) - cy) / fy])
    return float(_solid_angle(centre, np.array([width / 2 / fx, height / 2 / fy])))


def _solid_angle(centre: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Solid angle of rectangles in the plane Z = 1: centres and half sides (..., 2) -> (...)."""

    def from_axis(corner: np.ndarray) -> np.ndarray:
        x, y = np.moveaxis(corner, -1, 0)
        return np.asarray(np.arctan2(x * y, np.sqrt(1 + x * x + y * y)))

    other = half * [1, -1]
    same, across = ((from_axis(centre + h) + from_axis(centre - h)) for h in (half, other))
    return np.asarray(same - across)


def _outline(camera: FisheyeCamera, theta_limit: float) -> np.ndarray:
    """The border of the picture in the plane Z = 1, up to an angle off the axis: (N, 2)."""
    border = _border(camera.image_size)
    rays, valid = camera.unproject(border)
    # Border points beyond the lens are as good as its rim in the same direction.
    theta = np.where(valid, np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2]), camera.theta_max)
    direction = (border - camera.params[2:4]) / camera.params[:2]
    length = np.hypot(direction[:, 0], direction[:, 1])
    direction /= np.where(length > 0, length, 1)[:, None]
    return np.asarray(direction * np.tan(np.minimum(theta, theta_limit))[:, None])


def _on_picture(camera: FisheyeCamera, rays: np.ndarray) -> np.ndarray:
    """Whether the picture shows these rays: (N, 3) -> (N,)."""
    points, valid = camera.project(rays)
    height, width = camera.image_size
    edges = points + pixel.HALF_PIXEL
    return np.asarray(valid & ((edges >= 0) & (edges <= [width, height])).all(-1))


def _border(image_size: tuple[int, int]) -> np.ndarray:
    """Points around the edge of an image, corners included: (N, 2)."""
    height, width = image_size
    x = np.linspace(-pixel.HALF_PIXEL, width - pixel.HALF_PIXEL, 257)
    y = np.linspace(-pixel.HALF_PIXEL, height - pixel.HALF_PIXEL, 257)
    sides = [np.stack(np.broadcast_arrays(x, edge), -1) for edge in y[[0, -1]]]
    sides += [np.stack(np.broadcast_arrays(edge, y), -1) for edge in x[[0, -1]]]
    return np.concatenate(sides)
