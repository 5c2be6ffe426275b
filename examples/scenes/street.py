"""A town street at a crossing, on a sunny morning."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from .buildings import STONE, clock_tower, house, weathered
from .lighting import AmbientLayer, AmbientLight, Occupancy, Sun
from .materials import Material, Surface, band, cell_random, mix, noise, painted, rgb, stripes
from .rendering import Scene, World
from .sky import clear_sky
from .solids import Colour, Interval, Label, Placement, Shape, Solid

ROAD = 5.5
"""Half the width of the street between the kerbs, in metres."""
BUILDING_LINE = 9.3
CROSSING = (12.6, 19.2)
"""Where along z the side street runs between its kerbs."""
_CORNERS = (CROSSING[0] - 3.4, CROSSING[1] + 3.4)
_REACH = 75.0

_PAINTS = ("#7d2a2a", "#27445f", "#d8d6cf", "#4b4f52", "#2f5247", "#b9a26d", "#8fa3ad", "#e3ded2")
_PATCHES = (
    (1.0, 2.2, -7.5, 3.0),
    (-2.6, -1.5, -5.0, -1.5),
    (-3.0, 2.4, 14.0, 15.1),
    (0.5, 2.8, 30.0, 41.0),
    (-2.8, -1.9, -30.0, -13.0),
)
"""Where the road was mended, in metres: x from, x to, z from, z to."""
IRON = painted(0.0, reflectance=0.04)
RUBBER = painted(0.02)
GLASS = painted(0.0, reflectance=0.16)


def _markings(u: np.ndarray, v: np.ndarray, du: np.ndarray, dv: np.ndarray) -> np.ndarray:
    """Share (N,) of white paint on the road at x = u, z = v."""
    clear = 1 - band(v, CROSSING[0] - 7.4, CROSSING[1] + 7.4, dv)
    dashes = band(u, -0.07, 0.07, du) * stripes(v, 6.0, 3.0, dv) * clear
    parking = band(np.abs(u), 3.28, 3.4, du) * clear
    bays = band(np.abs(u), 3.4, ROAD - 0.3, du) * stripes(v + 0.9, 6.2, 0.1, dv) * clear
    zebra = np.zeros_like(u)
    inside = band(u, 0.25 - ROAD, ROAD - 0.25, du) * stripes(u - 0.25, 1.0, 0.5, du)
    for near in (CROSSING[0] - 7.0, CROSSING[1] + 3.8):
        zebra += band(v, near, near + 3.2, dv) * inside
    stop = band(v, CROSSING[0] - 8.3, CROSSING[0] - 7.9, dv) * band(u, 0.0, 3.3, du)
    middle = sum(CROSSING) / 2
    side = band(v, middle - 0.07, middle + 0.07, dv) * stripes(u, 6.0, 3.0, du)
    side *= 1 - band(u, -ROAD - 4, ROAD + 4, du)
    return np.clip(dashes + parking + bays + zebra + stop + side, 0, 1)


def _asphalt(s: Surface) -> np.ndarray:
    tracks = 0.05 * np.cos((np.abs(s.u) - 1.6) * 4.2) * (np.abs(s.u) < 3.2)
    tone = weathered(s) * (1 - tracks)
    for x0, x1, z0, z1 in _PATCHES:
        patch = band(s.u, x0, x1, s.du) * band(s.v, z0, z1, s.dv)
        inner = band(s.u, x0 + 0.04, x1 - 0.04, s.du) * band(s.v, z0 + 0.04, z1 - 0.04, s.dv)
        tone *= 1 - 0.14 * patch - 0.3 * (patch - inner)
    gutter = band(np.abs(s.u), ROAD - 0.45, ROAD, s.du) * (1 - band(s.v, CROSSING[0], CROSSING[1], s.dv))
    base = mix(s.colour * tone[:, None], rgb("#8b8882"), 0.7 * gutter)
    wear = np.clip(0.9 + 0.10 * noise(s.u * 0.9, s.v * 0.9), 0, 1)
    return mix(base, rgb("#dcd9d0"), 0.9 * wear * _markings(s.u, s.v, s.du, s.dv))


def _paving(s: Surface) -> np.ndarray:
    """Slabs in rows, the joints of every other row shifted by half."""
    row = np.floor(s.v / 0.45)
    shifted = s.u + 0.3 * (row % 2)
    width = np.maximum(s.du, s.dv)
    tone = (cell_random(row, np.floor(shifted / 0.6)) - 0.5) / (1 + (width / 0.5) ** 2)
    slab = s.colour * (weathered(s) * np.exp(0.16 * tone))[:, None]
    joint = 1 - (1 - stripes(s.v, 0.45, 0.012, s.dv)) * (1 - stripes(shifted, 0.6, 0.012, s.du))
    return mix(slab, s.colour * 0.45, joint)


def _leaves(s: Surface) -> np.ndarray:
    detail = noise(s.u * 0.9, s.v * 0.9) + 0.8 * noise(s.u * 2.3 + 0.3, s.v * 2.3)
    return s.colour * np.exp(0.42 * detail / (1 + (s.du / 0.12) ** 2))[:, None]


def _bodywork(s: Surface) -> np.ndarray:
    """Car paint with door seams across the flanks."""
    length = np.where(np.abs(s.normal[:, 0]) > 0.9, s.a, 0.5)
    seams = sum(band(length, at - 0.0015, at + 0.0015, s.du / 4.3) for at in (0.3, 0.52, 0.72))
    sill = band(s.b, -1.0, 0.1, s.dv / 0.6)
    return s.colour * (1 - 0.7 * np.clip(seams + 0.5 * sill, 0, 1))[:, None]


ASPHALT, PAVING = Material(_asphalt), Material(_paving)
LEAVES, BODYWORK = Material(_leaves), Material(_bodywork, reflectance=0.06)


def car(place: Placement, colour: Colour) -> None:
    """A small car, 4.3 m long, nose at along = 0, its middle at out = 0."""
    half, label = 0.86, Label.CAR
    place.prism(
        [
            (0.02, 0.26),
            (0, 0.58),
            (0.14, 0.76),
            (1.05, 0.91),
            (3.85, 0.94),
            (4.24, 0.84),
            (4.3, 0.55),
            (4.26, 0.26),
        ],
        (-half, half),
        BODYWORK,
        colour,
        label,
    )
    inset = half - 0.1
    place.prism(
        [(0.98, 0.88), (1.78, 1.42), (2.3, 1.47), (3.1, 1.44), (3.92, 0.92)],
        (-inset, inset),
        painted(0.0, reflectance=0.06),
        colour,
        label,
    )
    dark = rgb("#14181b")
    side = (-inset - 0.006, inset + 0.006)
    place.prism([(1.3, 0.95), (1.86, 1.36), (2.3, 1.39), (2.3, 0.95)], side, GLASS, dark, label)
    place.prism([(2.38, 0.95), (2.38, 1.39), (3.02, 1.36), (3.5, 0.97)], side, GLASS, dark, label)
    screen = (-inset + 0.09, inset - 0.09)
    place.prism([(1.03, 0.94), (1.72, 1.405), (1.9, 1.36), (1.2, 0.92)], screen, GLASS, dark, label)
    place.prism([(3.22, 1.39), (3.88, 0.975), (3.7, 0.95), (3.1, 1.36)], screen, GLASS, dark, label)
    for a in (0.78, 3.42):
        for radius, reach, tone in (
            (0.37, 0.004, "#101112"),
            (0.315, 0.012, "#1d1e20"),
            (0.2, 0.02, "#a9adb0"),
            (0.05, 0.026, "#4a4d50"),
        ):
            place.box(
                (a - radius, a + radius),
                (0.315 - radius, 0.315 + radius),
                (-half - reach, half + reach),
                RUBBER,
                rgb(tone),
                label,
                Shape.CYLINDER,
                "out",
            )
    for o in (-0.8, 0.42):
        span = (o, o + 0.38)
        place.box((-0.01, 0.2), (0.58, 0.7), span, GLASS, rgb("#dfe3e2"), label)
        place.box((4.15, 4.31), (0.62, 0.78), span, GLASS, rgb("#8d1f1c"), label)
    place.box((-0.02, 0.3), (0.26, 0.42), (-0.8, 0.8), RUBBER, rgb("#202224"), label)
    place.box((4.0, 4.32), (0.26, 0.42), (-0.8, 0.8), RUBBER, rgb("#202224"), label)
    for at in (-0.025, 4.305):
        place.box((at, at + 0.02), (0.44, 0.55), (-0.26, 0.26), RUBBER, rgb("#e9e6da"), label)
    for o in (-half - 0.14, half - 0.02):
        place.box((1.28, 1.4), (0.92, 1.05), (o, o + 0.16), BODYWORK, colour, label)


def tree(place: Placement, height: float, leafiness: int, rng: np.random.Generator) -> None:
    """A street tree in a grate, its crown made of `leafiness` tufts."""
    grate = rgb("#3d3a37")
    place.box((-0.7, 0.7), (0, 0.012), (-0.7, 0.7), RUBBER, grate, Label.SIDEWALK)
    place.box(
        (-0.11, 0.11),
        (0, 0.62 * height),
        (-0.11, 0.11),
        painted(0.15),
        rgb("#5d4a3a"),
        Label.TREE,
        Shape.CYLINDER,
    )
    green = rgb(rng.choice(["#7f9a4e", "#8a9c4a", "#6d8f52"]))
    spread = np.array([1.7, 0.31 * height, 1.7])
    for _ in range(leafiness):
        direction = rng.standard_normal(3)
        direction /= np.linalg.norm(direction)
        reach = rng.uniform(0.3, 1) ** 0.6
        a, h, o = direction * reach * spread
        size = rng.uniform(2.2, 3.6) * leafiness**-0.45
        # Tufts inside and below see less of the sky.
        tone = green * (0.5 + 0.5 * reach) * (0.9 + 0.25 * h / spread[1]) * rng.uniform(0.75, 1.2)
        middle = 0.68 * height + h
        place.box(
            (a - size, a + size),
            (middle - 0.8 * size, middle + 0.8 * size),
            (o - size, o + size),
            LEAVES,
            tone,
            Label.TREE,
            Shape.ELLIPSOID,
        )


def lamp_post(place: Placement) -> None:
    """A lamp post whose arm reaches out."""
    iron = rgb("#2c3331")
    for radius, rise in ((0.14, (0, 0.5)), (0.09, (0.5, 0.8)), (0.055, (0.8, 5.4))):
        span = (-radius, radius)
        place.box(span, rise, span, IRON, iron, Label.POLE, Shape.CYLINDER)
    place.box((-0.03, 0.03), (5.3, 5.36), (0, 1.5), IRON, iron, Label.POLE)
    place.box((-0.16, 0.16), (5.16, 5.32), (0.9, 1.6), IRON, iron, Label.LAMP)
    place.box((-0.13, 0.13), (5.14, 5.16), (0.95, 1.55), GLASS, rgb("#efe9d8"), Label.LAMP)


def traffic_light(place: Placement) -> None:
    """A traffic light facing along."""
    iron = rgb("#2b2d2e")
    place.box((-0.05, 0.05), (0, 3.0), (-0.05, 0.05), IRON, iron, Label.POLE, Shape.CYLINDER)
    place.box((-0.14, 0.1), (2.2, 3.1), (-0.16, 0.16), IRON, iron, Label.POLE)
    for height, tone in ((2.92, "#c8352b"), (2.65, "#5a4a1e"), (2.38, "#1f4a33")):
        place.box(
            (-0.17, -0.14),
            (height - 0.1, height + 0.1),
            (-0.1, 0.1),
            RUBBER,
            rgb(tone),
            Label.POLE,
            Shape.CYLINDER,
            "along",
        )


def bench(place: Placement) -> None:
    """A slatted bench looking out."""
    timber, iron = rgb("#8a6240"), rgb("#2c3331")
    for o in (0.0, 0.14, 0.28):
        place.box((-0.9, 0.9), (0.43, 0.47), (o, o + 0.11), painted(), timber, Label.FURNITURE)
    for h in (0.58, 0.73):
        place.box((-0.9, 0.9), (h, h + 0.11), (-0.07, -0.03), painted(), timber, Label.FURNITURE)
    for a in (-0.75, 0.69):
        place.box((a, a + 0.06), (0, 0.43), (0, 0.38), IRON, iron, Label.FURNITURE)
        place.box((a, a + 0.06), (0.4, 0.86), (-0.1, -0.07), IRON, iron, Label.FURNITURE)


def _row(front: Placement, span: Interval, rng: np.random.Generator, corners: tuple[bool, bool]) -> None:
    """Houses side by side along a building line; the first and the last may be at a corner."""
    start, stop = span
    count = max(1, round((stop - start) / 11.5))
    edges = np.linspace(start, stop, count + 1)
    edges[1:-1] += rng.uniform(-1.5, 1.5, count - 1)
    for i, (left, right) in enumerate(pairwise(edges)):
        flanks = (corners[0] and i == 0, corners[1] and i == count - 1)
        storeys = int(rng.integers(2, 5))
        house(front.at(left, 0), right - left, storeys, rng, corners=flanks)


def street(seed: int = 0) -> Scene:
    """A street of shops and houses, the camera on the road before a zebra crossing.

    The seed sets the houses, the trees, the parked cars and the sun.
    """
    rng = np.random.default_rng(seed)
    solids: list[Solid] = []
    ground = Placement(solids)
    sides = {
        -1: Placement(solids, (-BUILDING_LINE, 0), (0, 1), (1, 0)),
        1: Placement(solids, (BUILDING_LINE, 0), (0, 1), (-1, 0)),
    }
    ground.box((-160, 160), (-0.5, 0), (-160, 190), ASPHALT, rgb("#5f6064"), Label.ROAD)
    blocks = ((-_REACH, CROSSING[0]), (CROSSING[1], _REACH + 30))
    for side in (-1, 1):
        for low, high in blocks:
            x = sorted((side * ROAD, side * 110.0))
            ground.box(tuple(x), (0, 0.13), (low, high), PAVING, rgb("#b7ada0"), Label.SIDEWALK)
            kerb = rgb("#8f8b85")
            edge = sorted((side * (ROAD - 0.16), side * ROAD))
            ground.box(tuple(edge), (0, 0.135), (low, high), STONE, kerb, Label.SIDEWALK)
            for z in (low, high):
                if z in CROSSING:
                    ground.box(tuple(x), (0, 0.135), (z - 0.08, z + 0.08), STONE, kerb, Label.SIDEWALK)
        _row(sides[side], (-_REACH, _CORNERS[0]), rng, (False, True))
        _row(sides[side], (_CORNERS[1], _REACH + 30), rng, (True, False))
        for z, facing in ((_CORNERS[0], 1), (_CORNERS[1], -1)):
            row = Placement(solids, (0, z), (1, 0), (0, facing))
            first, last = sorted((side * (BUILDING_LINE + 11), side * 70.0))
            _row(row, (first, last), rng, (False, False))
        closing = Placement(solids, (side * 72.0, 0), (0, 1), (-side, 0))
        _row(closing, (_CORNERS[0] - 6, _CORNERS[1] + 6), rng, (False, False))
    for z, facing in ((_REACH + 32, -1), (-_REACH - 2, 1)):
        _row(Placement(solids, (0, z), (1, 0), (0, facing)), (-24, 24), rng, (False, False))
    clock_tower(Placement(solids, (1.5, _REACH + 42), (1, 0), (0, -1)), 27)

    for side, wall in sides.items():
        verge = BUILDING_LINE - ROAD - 0.75
        for z in (*np.arange(-44, CROSSING[0] - 6, 13.0), *np.arange(CROSSING[1] + 8, 80, 13.0)):
            leafiness = 190 if abs(z) < 25 else 50
            tree(wall.at(z + rng.uniform(-0.8, 0.8), verge), rng.uniform(5.0, 6.4), leafiness, rng)
        for z in (*np.arange(-50.5, 6, 13.0), *np.arange(CROSSING[1] + 1.5, 80, 19.5)):
            lamp_post(wall.at(z, verge + 0.3))
        for z in (-10.0, 2.5):
            bench(wall.at(z + 1.3 * side, verge - 0.4))
        for z in np.arange(CROSSING[0] - 8, CROSSING[0] - 1.5, 1.6):
            wall.at(z, verge + 0.45).box(
                (-0.05, 0.05),
                (0.1, 1.0),
                (-0.05, 0.05),
                IRON,
                rgb("#2c3331"),
                Label.POLE,
                Shape.CYLINDER,
            )
        traffic_light(wall.at(CROSSING[0] - 8.2, verge + 0.35))
        for slot in range(-9, 13):
            z = -0.9 + 6.2 * slot
            near = CROSSING[0] - 12.5 < z < CROSSING[1] + 7.5
            if near or rng.random() < 0.35:
                continue
            nose = z + 0.9 + rng.uniform(-0.2, 0.2)
            kerbside = sides[side].at(nose, BUILDING_LINE - 4.42)
            if side > 0:
                kerbside = kerbside.at(4.3, 0, turned=True)
            car(kerbside, rgb(_PAINTS[rng.integers(len(_PAINTS))]))

    height, turn = np.radians(rng.uniform(50, 56)), np.radians(rng.uniform(28, 42))
    sun = Sun(
        np.array([np.cos(height) * np.sin(turn), -np.sin(height), -np.cos(height) * np.cos(turn)]),
        2.9 * rgb("#ffedd0"),
    )
    space = Occupancy(solids, np.array([-24, -19, -62]), np.array([24, 0.5, 84]), 0.5)
    shade = space.openness({1.0: 0.45, 2.5: 0.5, 7.0: 0.55})
    wall_light, ground_light, zenith = (
        0.55 * rgb("#d2dcea"),
        0.32 * rgb("#d9cfc0"),
        0.85 * rgb("#c6d7f0"),
    )
    radiance = np.array([wall_light, ground_light, wall_light, wall_light, zenith, wall_light])
    ambient = AmbientLight(space.lo, space.voxel, [AmbientLayer(shade, radiance)])
    world = World(solids, sun, ambient, lambda ray: clear_sky(ray, sun), haze=330, exposure=0.95)
    return Scene(world, np.array([0.5, -1.7, -11.0]), np.eye(3))
