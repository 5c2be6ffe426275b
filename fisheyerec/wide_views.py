"""Views that show more than a perspective can: cylindrical, equirectangular, stereographic and Panini.

Each is a camera like any other: what `rectify` makes, what `distort` reads, and points to rays and back. On the axis
all have the scale of a pinhole of the same focal lengths. Equations: csrc/geometry.
"""

from __future__ import annotations

import math
from typing import ClassVar, Self

from . import pixel
from .cameras import Camera, checked_image_size


class _WideView(Camera):
    """What these views share: a field of view, from where their right edge lies on the plane of focal length 1."""

    _holds_widest: ClassVar[bool] = True

    @classmethod
    def from_fov(cls, fov_deg: float, image_size: tuple[int, int]) -> Self:
        """Give a centred view that is fov_deg wide, edge to edge, with pixels that are square in its middle.

        Raises:
            ValueError: fov_deg outside (0, 360], of a stereographic view (0, 360).
        """
        half_fov = cls._checked_half_fov(fov_deg, 360, holds_widest=cls._holds_widest)
        return cls._from_half_width(cls._half_width(half_fov), image_size)

    @staticmethod
    def _half_width(half_fov: float) -> float:
        """Where the right edge lies; columns are angles unless a view says otherwise."""
        return half_fov

    @classmethod
    def _from_half_width(cls, half_width: float, image_size: tuple[int, int], *more: float) -> Self:
        height, width = checked_image_size(cls, image_size)
        focal = width / 2 / half_width
        return cls([focal, focal, pixel.centre(width), pixel.centre(height), *more], image_size)

    @classmethod
    def _checked_half_fov(cls, fov_deg: float, widest_deg: float, *, holds_widest: bool) -> float:
        """Half of fov_deg in radians."""
        if not (0 < fov_deg < widest_deg or (holds_widest and fov_deg == widest_deg)):
            end = "]" if holds_widest else ")"
            raise ValueError(f"{cls.__name__}.from_fov(): expected fov_deg in (0, {widest_deg:g}{end}, got {fov_deg:g}")
        return math.radians(fov_deg) / 2


class CylindricalView(_WideView):
    """A view on a cylinder around the vertical: x = fx atan2(X, Z) + cx, y = fy Y / hypot(X, Z) + cy.

    Columns are angles, verticals stay straight, and people at the sides keep their shape. Up to 360 degrees.

    Args:
        params: (4,) or (B, 4): fx in pixels per radian, fy, cx, cy in pixels.
        image_size: (height, width) of the view.
    """

    model = "cylindrical"
    parameter_names = ("fx", "fy", "cx", "cy")


class EquirectangularView(_WideView):
    """A view whose columns are longitudes and rows latitudes, the format of panoramas.

    x = fx atan2(X, Z) + cx, y = fy atan2(Y, hypot(X, Z)) + cy: 360 degrees wide and twice as wide as high, it shows
    everything.

    Args:
        params: (4,) or (B, 4): fx, fy in pixels per radian, cx, cy in pixels.
        image_size: (height, width) of the view.
    """

    model = "equirectangular"
    parameter_names = ("fx", "fy", "cx", "cy")


class StereographicView(_WideView):
    """The view that keeps every small shape: r = 2 f tan(theta / 2) from the principal point.

    Theta may be anything below 180 degrees. A full turn is the "little planet".

    Args:
        params: (4,) or (B, 4): fx, fy, cx, cy in pixels.
        image_size: (height, width) of the view.
    """

    model = "stereographic"
    parameter_names = ("fx", "fy", "cx", "cy")
    _holds_widest = False

    @staticmethod
    def _half_width(half_fov: float) -> float:
        return 2 * math.tan(half_fov / 2)


class PaniniView(_WideView):
    """A wide view that looks like a perspective: verticals and lines to the middle stay straight.

    x = fx s X + cx, y = fy s Y + cy with s = (d + 1) / (d hypot(X, Z) + Z): the world on a cylinder, seen from d behind
    its axis (Sharpless, Postle, German: Pannini, Computational Aesthetics 2010). d = 0 is the perspective view, d = 1
    the usual choice, up to 150 degrees or more.

    Args:
        params: (5,) or (B, 5): fx, fy, cx, cy in pixels, and the distance d, at least 0.
        image_size: (height, width) of the view.
    """

    model = "panini"
    parameter_names = ("fx", "fy", "cx", "cy", "d")

    @classmethod
    def from_fov(cls, fov_deg: float, image_size: tuple[int, int], *, distance: float = 1.0) -> Self:
        """Give a centred view with square pixels that is fov_deg wide, edge to edge.

        Args:
            fov_deg: in (0, 2 acos(-distance)): 180 degrees for distance 0, 360 for distance 1.
            image_size: (height, width) of the view.
            distance: d, in [0, 1].

        Raises:
            ValueError: distance or fov_deg outside its range.
        """
        if not 0 <= distance <= 1:
            raise ValueError(f"{cls.__name__}.from_fov(): expected distance in [0, 1], got {distance:g}")
        longitude = cls._checked_half_fov(fov_deg, math.degrees(2 * math.acos(-distance)), holds_widest=False)
        half_width = (distance + 1) * math.sin(longitude) / (distance + math.cos(longitude))
        return cls._from_half_width(half_width, image_size, distance)
