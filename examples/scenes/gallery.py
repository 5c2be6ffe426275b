"""Plain rooms to measure in: a chessboard on a wall, and a long corridor."""

from __future__ import annotations

import numpy as np

from . import fittings
from .lighting import AmbientLayer, AmbientLight, AreaLight, Occupancy, Sun
from .materials import chessboard as chessboard_material
from .materials import glowing, painted, planks, rgb, tiles
from .rendering import Scene, World
from .solids import Colour, Interval, Label, Placement, Solid

_NO_SUN = Sun(np.array([0.0, -1.0, 0.0]), np.zeros(3))
_WALLS = ("#d8d3c8", "#c9d0d2", "#d6cabb", "#c7cdbf")
_ACCENTS = ("#8b9a97", "#a8765f", "#66788a", "#98a08a")

TRIM, FRAME = rgb("#ece8df"), rgb("#2d2722")
EDGED = painted(0.008, arris=0.3)


class _Gallery:
    """An empty hall under rows of ceiling lights, ready to be furnished.

    It spans `x` and `z` metres and is `height` metres high; `left`, `right`, `ahead` and `behind`
    are its walls, whose heights count from the floor.
    """

    def __init__(self, x: Interval, z: Interval, height: float, wall: Colour) -> None:
        self.x, self.z, self.height = x, z, height
        self.solids: list[Solid] = []
        self.floor = Placement(self.solids)
        self.left = Placement(self.solids, (x[0], 0), (0, 1), (1, 0))
        self.right = Placement(self.solids, (x[1], 0), (0, 1), (-1, 0))
        self.ahead = Placement(self.solids, (0, z[1]), (1, 0), (0, -1))
        self.behind = Placement(self.solids, (0, z[0]), (1, 0), (0, 1))
        self.sides = {
            "left": (self.left, z),
            "right": (self.right, z),
            "ahead": (self.ahead, x),
            "behind": (self.behind, x),
        }
        plaster = painted(0.01)
        for side, (start, stop) in self.sides.values():
            side.box((start - 0.3, stop + 0.3), (0, height), (-0.3, 0), plaster, wall, Label.WALL)
            side.box((start, stop), (height - 0.1, height), (0, 0.04), EDGED, TRIM, Label.CEILING)
        self.floor.box(x, (height, height + 0.3), z, plaster, rgb("#f1eee7"), Label.CEILING)
        self.lamps: list[AreaLight] = []

    def ceiling_light(self, x: Interval, z: Interval) -> None:
        """A glowing panel on a dark frame."""
        at = (self.height - 0.03, self.height - 0.01)
        self.floor.box(x, at, z, glowing(), rgb("#fff6e6") * 1.9, Label.LAMP)
        middle = np.array([sum(x) / 2, -self.height + 0.05, sum(z) / 2])
        size = (x[1] - x[0]) * (z[1] - z[0])
        self.lamps.append(AreaLight(middle, np.array([0.0, 1.0, 0.0]), size))
        around = [(start - 0.04, stop + 0.04) for start, stop in (x, z)]
        frame = (self.height - 0.02, self.height)
        self.floor.box(around[0], frame, around[1], fittings.PAINT, rgb("#4a4a48"), Label.LAMP)

    def trim(self, doors: dict[str, list[float]], dado: Colour | None = None) -> None:
        """Skirting all round, and a dado of this colour on the long walls, but for the doors.

        `doors` maps a wall's name to where along it its doors start.
        """
        for name, (side, (start, stop)) in self.sides.items():
            edges = [start, stop]
            for door in doors.get(name, []):
                edges[-1:] = [door - 0.11, door + 1.06, stop]
            for span in zip(edges[::2], edges[1::2], strict=True):
                side.box(span, (0, 0.14), (0, 0.02), EDGED, TRIM, Label.WALL)
                if dado is not None and name in ("left", "right"):
                    side.box(span, (0.14, 0.92), (0, 0.006), painted(0.01), dado, Label.WALL)
                    side.box(span, (0.92, 0.97), (0, 0.03), EDGED, TRIM, Label.WALL)

    def lit(self, brightness: float) -> World:
        """The furnished hall under its own lamps."""
        lo = np.array([self.x[0] - 0.2, -self.height - 0.2, self.z[0] - 0.2])
        hi = np.array([self.x[1] + 0.2, 0.2, self.z[1] + 0.2])
        space = Occupancy(self.solids, lo, hi, 0.1)
        open_air = space.openness({0.12: 0.5, 0.35: 0.5, 1.0: 0.45})
        side, down, up = rgb("#e6e1d8"), rgb("#e4dac8"), rgb("#e6e4e2")
        layers = [
            AmbientLayer(open_air, 0.75 * np.array([side, down, side, side, up, side])),
            AmbientLayer(space.lit_by(self.lamps) * open_air, np.tile(brightness * rgb("#fff3e0"), (6, 1))),
        ]
        ambient = AmbientLight(space.lo, space.voxel, layers)
        return World(self.solids, _NO_SUN, ambient, np.zeros_like, exposure=0.95)


def chessboard(seed: int = 0, squares: tuple[int, int] = (7, 10), square: float = 0.3, distance: float = 2.0) -> Scene:
    """A chessboard of (rows, columns) `squares` of `square` metres, `distance` metres ahead.

    The camera faces the board's centre squarely; `corners` are its inner corners (rows - 1,
    columns - 1, 3), from the top left, row by row.
    """
    if min(squares) < 2 or square <= 0 or distance <= 0:
        raise ValueError(
            "chessboard(): expected squares of at least (2, 2) and positive square and distance, "
            f"got {squares}, {square} and {distance}"
        )
    rng = np.random.default_rng(seed)
    rows, columns = squares
    half, low = columns * square / 2, 0.35
    top = low + rows * square
    width, height = max(2.4, half + 0.9), max(2.9, top + 0.4)
    hall = _Gallery((-width, width), (-5.0, distance + 0.03), height, rgb(_WALLS[seed % len(_WALLS)]))
    shade = rgb(rng.choice(_ACCENTS))
    ground = tiles((0.5, 0.5), rgb("#8d857a"), second=shade, reflectance=0.02)
    hall.floor.box(hall.x, (-0.3, 0), hall.z, ground, rgb("#d8d0c2"), Label.FLOOR)
    board = chessboard_material(square, (-half, low), rgb("#1c1d20"))
    hall.ahead.box((-half, half), (low, top), (0, 0.03), board, rgb("#f2f0ea"), Label.CHESSBOARD)
    fittings.rim(
        hall.ahead,
        (-half - 0.05, half + 0.05),
        (low - 0.05, top + 0.05),
        (0, 0.02),
        0.05,
        fittings.PAINT,
        rgb("#6b6256"),
        Label.FURNITURE,
    )
    for i, z in enumerate((-3.4, -1.7, 0.0)):
        for side in (hall.left, hall.right):
            fittings.picture(side, (z - 0.45, z + 0.45), (1.1, 2.1), 10 * seed + i, FRAME)
    fittings.door(hall.behind, -0.48, shade, TRIM)
    hall.trim({"behind": [-0.48]})
    for z in (-3.8, -1.8, 0.2):
        for x in (-width / 2, width / 2):
            hall.ceiling_light((x - 0.3, x + 0.3), (z - 0.6, z + 0.6))
    x = -half + square * np.arange(1, columns)
    y = -top + square * np.arange(1, rows)
    grid = np.stack(np.broadcast_arrays(x, y[:, None], distance), -1)
    return Scene(hall.lit(11.0), np.array([0.0, -(low + top) / 2, 0.0]), np.eye(3), grid)


def corridor(seed: int = 0) -> Scene:
    """A long corridor of doors and pictures, the camera near one end."""
    rng = np.random.default_rng(seed)
    hall = _Gallery((-1.45, 1.45), (-4.0, 13.9), 2.85, rgb(_WALLS[seed % len(_WALLS)]))
    shade = rgb(rng.choice(_ACCENTS))
    ground = (
        tiles((0.4, 0.4), rgb("#8d857a"), second=shade * 0.8, reflectance=0.02)
        if seed % 2 == 0
        else planks(0.14, 1.7, 0.035)
    )
    tone = rgb("#d8d0c2") if seed % 2 == 0 else rgb("#b08658")
    hall.floor.box(hall.x, (-0.3, 0), hall.z, ground, tone, Label.FLOOR)
    doors: dict[str, list[float]] = {"behind": [-0.48]}
    for k, (name, side) in enumerate((("left", hall.left), ("right", hall.right))):
        doors[name] = list(np.arange(-2.9, 12.5, 3.1) + rng.uniform(-0.3, 0.3))
        for i, z in enumerate(doors[name]):
            fittings.door(side, z, shade * 0.75, TRIM)
            art = (z + 1.6, z + 2.5)
            if art[1] < hall.z[1]:
                fittings.picture(side, art, (1.25, 2.0), 20 * seed + 2 * i + k, FRAME)
    fittings.door(hall.behind, -0.48, shade * 0.75, TRIM)
    hall.trim(doors, dado=shade)
    for z in np.arange(-3.0, 13.6, 2.4):
        hall.floor.box(hall.x, (2.7, 2.85), (z + 1.15, z + 1.25), EDGED, TRIM, Label.CEILING)
        hall.ceiling_light((-0.3, 0.3), (z - 0.5, z + 0.5))
    fittings.picture(hall.ahead, (-0.6, 0.6), (0.9, 2.4), 20 * seed + 19, FRAME)
    return Scene(hall.lit(11.0), np.array([0.0, -1.5, -2.6]), np.eye(3))
