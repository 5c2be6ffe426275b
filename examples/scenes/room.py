"""A furnished room with daylight from two windows."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from . import fittings, furniture
from .lighting import AmbientLayer, AmbientLight, AreaLight, Occupancy, Sun
from .materials import Material, glowing, painted, planks, rgb, tiles, wood
from .rendering import Scene, World
from .sky import landscape
from .solids import Colour, Interval, Label, Placement, Solid, SolidTree

Opening = tuple[float, float, float, float]
"""Where a wall is open, in metres: along from, along to, height from, height to."""

HEIGHT = 2.95
THICKNESS = 0.28

LEFT_WINDOWS: tuple[Opening, ...] = ((-2.3, -0.75, 0.78, 2.42), (0.55, 2.1, 0.78, 2.42))
REAR_WINDOW: Opening = (-2.4, -0.6, 0.78, 2.42)
SHELVES: Interval = (-2.55, 0.75)
FRAME = rgb("#2d2722")


class _Scheme(NamedTuple):
    """Linear RGB (3,) of what is painted, woven or laid."""

    wall: Colour
    trim: Colour
    cloth: Colour
    accent: Colour
    rug: Colour
    bookcase: Colour
    door: Colour
    boards: Colour


_SCHEMES = tuple(
    _Scheme(*map(rgb, codes.split()))
    for codes in (
        "#d9d2c3 #ece7dc #6f8087 #c08a52 #8d6a5c #66767a #8b9a97 #b98d5e",
        "#a9b5a0 #dfe2d6 #b8a58c #b5523b #44566c #3f5248 #e4e4da #a97d52",
        "#9fb0bb #e6e6e0 #a98467 #d0a24c #7b3f3a #2f4353 #e6e6e0 #c19a6b",
        "#d8bfae #eee4da #5d6b58 #d9cdb8 #536878 #7b4f3e #eee4da #9c714a",
    )
)


class _Walls(NamedTuple):
    """The placements of a room."""

    floor: Placement
    left: Placement
    right: Placement
    ahead: Placement
    behind: Placement


_WOODS = ("#9a6b42", "#6d4a31", "#b58a5c")


def wall_with_openings(
    wall: Placement,
    along: Interval,
    height: float,
    thickness: float,
    openings: Sequence[Opening],
    material: Material,
    colour: Colour,
    label: Label,
) -> None:
    """A wall behind the placement, from the floor up, with rectangular holes in it."""
    start = along[0]
    depth = (-thickness, 0.0)
    for left, right, low, high in sorted(openings):
        wall.box((start, left), (0, height), depth, material, colour, label)
        wall.box((left, right), (0, low), depth, material, colour, label)
        wall.box((left, right), (high, height), depth, material, colour, label)
        start = right
    wall.box((start, along[1]), (0, height), depth, material, colour, label)


def _panelling(wall: Placement, along: Interval, gaps: Sequence[Interval], colour: Colour) -> None:
    """Skirting, dado rail and panels along a wall, but for the gaps; a cornice all along."""
    paint, label = painted(0.008, arris=0.3), Label.WALL
    start = along[0]
    for gap in [*sorted(gaps), (along[1], along[1])]:
        span = (start, gap[0])
        if span[1] - span[0] > 0.02:
            wall.box(span, (0, 0.94), (0, 0.008), paint, colour, label)
            wall.box(span, (0, 0.13), (0, 0.022), paint, colour, label)
            wall.box(span, (0.13, 0.15), (0, 0.016), paint, colour, label)
            wall.box(span, (0.92, 0.96), (0, 0.035), paint, colour, label)
            count = max(1, round((span[1] - span[0]) / 0.75))
            edges = np.linspace(*span, count + 1)
            for left, right in pairwise(edges):
                if right - left > 0.25:
                    fittings.rim(
                        wall,
                        (left + 0.07, right - 0.07),
                        (0.25, 0.83),
                        (0, 0.022),
                        0.03,
                        paint,
                        colour,
                        label,
                    )
        start = gap[1]
    for rise, reach in ((0.05, 0.10), (0.10, 0.06), (0.14, 0.03)):
        wall.box(along, (HEIGHT - rise, HEIGHT), (0, reach), paint, colour, Label.CEILING)


def _ceiling(floor: Placement, x: Interval, z: Interval, wooden: bool, timber: Colour) -> None:
    """A white ceiling with wooden beams, or coffered."""
    white = rgb("#f1eee7")
    plaster = painted(0.006)
    floor.box(x, (HEIGHT, HEIGHT + 0.3), z, plaster, white, Label.CEILING)
    crossings = np.linspace(*z, round((z[1] - z[0]) / (0.95 if wooden else 1.35)) + 1)[1:-1]
    if wooden:
        for c in crossings:
            floor.box(x, (HEIGHT - 0.17, HEIGHT), (c - 0.08, c + 0.08), wood(), timber, Label.CEILING)
        return
    columns = np.linspace(*x, round((x[1] - x[0]) / 1.35) + 1)[1:-1]
    for low, half in ((0.13, 0.09), (0.05, 0.15)):
        for c in crossings:
            floor.box(x, (HEIGHT - low, HEIGHT), (c - half, c + half), plaster, white, Label.CEILING)
        for c in columns:
            floor.box((c - half, c + half), (HEIGHT - low, HEIGHT), z, plaster, white, Label.CEILING)


def room(seed: int = 0) -> Scene:
    """A living and dining room, 6.4 m wide and about 7.5 m long, the camera at its back.

    The seed sets the colours, the floor, the ceiling, the books, the pictures and small shifts.
    """
    rng = np.random.default_rng(seed)
    scheme = _SCHEMES[seed % len(_SCHEMES)]
    timber = rgb(_WOODS[rng.integers(len(_WOODS))])
    half, front, rear = 3.2, 3.6 + rng.uniform(-0.1, 0.3), -3.7
    x, z = (-half, half), (rear, front)
    rise, turn = np.radians(rng.uniform(31, 37)), np.radians(rng.uniform(12, 24))
    to_sun = np.array([-np.cos(rise) * np.cos(turn), -np.sin(rise), np.cos(rise) * np.sin(turn)])
    sun = Sun(to_sun, 9.0 * rgb("#ffe9c9"))

    def outdoors(ray: np.ndarray) -> np.ndarray:
        return 3.2 * landscape(ray, sun)

    solids: list[Solid] = []
    walls = _Walls(
        Placement(solids),
        Placement(solids, (-half, 0), (0, 1), (1, 0)),
        Placement(solids, (half, 0), (0, 1), (-1, 0)),
        Placement(solids, (0, front), (1, 0), (0, -1)),
        Placement(solids, (0, rear), (1, 0), (0, 1)),
    )
    if seed % 3 == 2:
        ground = tiles((0.45, 0.45), rgb("#8d857a"), second=rgb("#4d4a48"), reflectance=0.035)
        walls.floor.box(x, (-0.3, 0), z, ground, rgb("#d8d0c2"), Label.FLOOR)
    else:
        walls.floor.box(x, (-0.3, 0), z, planks(0.16, 1.9, 0.035), scheme.boards, Label.FLOOR)
    _ceiling(walls.floor, x, z, bool(rng.random() < 0.5), timber)
    glass = Material(lambda s: outdoors(s.ray), emits=True)
    _enclose(walls, x, z, rng.uniform(1.35, 1.65), glass, scheme)
    furniture.bookcase(walls.ahead, SHELVES, 2.52, rng, scheme.bookcase)
    _furnish_sitting(walls, 0.7 + rng.uniform(-0.2, 0.2), seed, timber, scheme)
    _furnish_dining(walls.floor, timber, scheme, rng)

    windows = [*((walls.left, opening) for opening in LEFT_WINDOWS), (walls.behind, REAR_WINDOW)]
    ambient = _daylight(solids, windows, sun, (x, z))
    position = np.array([0.35 + rng.uniform(-0.1, 0.1), -1.5, -2.0])
    return Scene(World(solids, sun, ambient, outdoors, exposure=0.95), position, np.eye(3))


def _enclose(walls: _Walls, x: Interval, z: Interval, door_at: float, glass: Material, scheme: _Scheme) -> None:
    """The four walls with their windows, curtains, doors and panelling."""
    plaster, trim = painted(0.02), scheme.trim
    for wall, span, openings in (
        (walls.left, z, LEFT_WINDOWS),
        (walls.right, z, ()),
        (walls.ahead, x, ()),
        (walls.behind, x, (REAR_WINDOW,)),
    ):
        ends = (span[0] - THICKNESS, span[1] + THICKNESS)
        wall_with_openings(wall, ends, HEIGHT, THICKNESS, openings, plaster, scheme.wall, Label.WALL)
        for a0, a1, h0, h1 in openings:
            fittings.window(wall, (a0, a1), (h0, h1), (4, 4), glass, THICKNESS, trim)
    for a0, a1, *_ in LEFT_WINDOWS:
        for edge in (a0 - 0.42, a1 + 0.12):
            fittings.curtain(walls.left, (edge, edge + 0.3), 2.62, rgb("#e3d9c6"))
        fittings.curtain_rod(walls.left, (a0 - 0.5, a1 + 0.5), 2.62)
    fittings.door(walls.ahead, door_at, scheme.door, trim)
    fittings.door(walls.behind, 1.3, scheme.door, trim)
    _panelling(walls.left, z, [(a - 0.1, b + 0.1) for a, b, *_ in LEFT_WINDOWS], trim)
    _panelling(walls.right, z, [], trim)
    _panelling(walls.ahead, x, [SHELVES, (door_at - 0.11, door_at + 1.06)], trim)
    _panelling(walls.behind, x, [(-2.5, -0.5), (1.19, 2.36)], trim)


def _furnish_sitting(walls: _Walls, sofa_at: float, seed: int, timber: Colour, scheme: _Scheme) -> None:
    """A sofa under three pictures, a rug with a low table, and a sideboard."""
    right, floor = walls.right, walls.floor
    furniture.sofa(right.at(sofa_at, 0.03), 2.3, scheme.cloth, scheme.accent)
    for i, middle in enumerate(sofa_at + np.array([-0.95, 0.0, 0.95])):
        fittings.picture(right, (middle - 0.4, middle + 0.4), (1.25, 2.25), 10 * seed + i, FRAME)
    furniture.sideboard(right, (-2.6, -0.9), timber)
    furniture.table_lamp(right.at(-2.2, 0.25), 0.77, rgb("#efe4cc"))
    fittings.picture(right, (-2.1, -1.2), (1.25, 1.95), 10 * seed + 3, FRAME)
    fittings.picture(walls.behind, (0.1, 0.85), (1.15, 2.15), 10 * seed + 4, FRAME)
    label = Label.FURNITURE
    floor.box((0.05, 2.2), (0, 0.014), (-0.75, 2.15), furniture.RUG, scheme.rug, Label.FLOOR)
    low = floor.at(1.15, 0.75)
    furniture.low_table(low, timber)
    low.box((-0.2, 0.06), (0.4, 0.43), (-0.3, 0.05), fittings.PAINT, scheme.accent, label)
    low.box((-0.17, 0.04), (0.43, 0.455), (-0.27, 0.02), fittings.PAINT, scheme.trim, label)


def _furnish_dining(floor: Placement, timber: Colour, scheme: _Scheme, rng: np.random.Generator) -> None:
    """A table with four chairs under two lamps, and plants in the corners."""
    dining = floor.at(-1.45, 1.25)
    furniture.table(dining.sideways(), 1.9, 0.9, timber)
    for out in (-0.5, 0.5):
        facing_window, facing_room = dining.at(0.62, out), dining.at(-0.62, out, turned=True)
        furniture.chair(facing_window.sideways(), timber, scheme.cloth)
        furniture.chair(facing_room.sideways(), timber, scheme.cloth)
    furniture.vase(dining, 0.0, 0.755, 0.1, 0.07, 0.26, rng)
    for out in (-0.45, 0.45):
        furniture.pendant(dining.at(0, out), HEIGHT, 1.72, FRAME, glowing())
    furniture.potted_plant(floor.at(-2.78, 3.0), 1.45, rng)
    furniture.potted_plant(floor.at(2.8, 3.05), 1.1, rng)


def _daylight(
    solids: Sequence[Solid],
    windows: Sequence[tuple[Placement, Opening]],
    sun: Sun,
    plan: tuple[Interval, Interval],
) -> AmbientLight:
    """Soft light of a room: from the windows, from the sunlit floor, and from all around."""
    (x0, x1), (z0, z1) = plan
    lo, hi = (x0 - 0.2, -HEIGHT - 0.2, z0 - 0.2), (x1 + 0.2, 0.2, z1 + 0.2)
    space = Occupancy(solids, np.array(lo), np.array(hi), 0.1)
    tree = SolidTree(solids, [i for i, solid in enumerate(solids) if solid.casts_shadow])
    panes, patches = [], []
    for wall, (a0, a1, h0, h1) in windows:
        area = (a1 - a0) * (h1 - h0) / 4
        inward = wall.point(0, 0, 1) - wall.point(0, 0, 0)
        for a in (0.25, 0.75):
            for h in (0.25, 0.75):
                centre = wall.point(a0 + a * (a1 - a0), h0 + h * (h1 - h0), -0.05)
                panes.append(AreaLight(centre, inward, area))
                start = (centre + 0.06 * inward)[:, None]
                distance, index = tree.nearest(start, -sun.direction[:, None])
                facing = max(inward @ -sun.direction, 0)
                if facing and index[0] >= 0:
                    spot = start[:, 0] - distance[0] * sun.direction
                    normal = solids[index[0]].normals(spot[:, None])[:, 0]
                    patches.append(AreaLight(spot, normal, area * facing))
    open_air = space.openness({0.12: 0.5, 0.35: 0.5, 1.0: 0.45})
    side, down, up = rgb("#e4ddd0"), rgb("#dccbb0"), rgb("#e6e4e2")
    around = np.array([side, down, side, side, up, side])
    layers = [
        AmbientLayer(open_air, 0.42 * around),
        AmbientLayer(space.lit_by(panes) * open_air, np.tile(8.0 * rgb("#e9f1fb"), (6, 1))),
        AmbientLayer(space.lit_by(patches) * open_air, np.tile(4.5 * rgb("#f3cf9d"), (6, 1))),
    ]
    return AmbientLight(space.lo, space.voxel, layers)
