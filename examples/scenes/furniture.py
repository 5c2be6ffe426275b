"""Furniture of a room, each piece built against a placement."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from .fittings import LACQUER, METAL, PAINT, rim
from .materials import Material, Surface, band, mix, noise, painted, rgb, stripes, wood
from .solids import Colour, Interval, Label, Placement, Shape

OAK = wood(horizontal=True)
UPRIGHT_OAK = wood(horizontal=False)
OILED_OAK = wood(0.03)

_BOOKS = (
    "#7d2f2a",
    "#24405a",
    "#c9b07f",
    "#3f5a45",
    "#d9d0be",
    "#2e2d33",
    "#a8592f",
    "#5d6f86",
    "#e6dfd0",
    "#7a6a55",
    "#8c8f6c",
    "#b98a7a",
)


def _woven(s: Surface) -> np.ndarray:
    """A rug with a double border and faint weft lines."""
    edge_u = np.minimum(s.a, 1 - s.a) * 2.9
    edge_v = np.minimum(s.b, 1 - s.b) * 2.0
    edge = np.minimum(edge_u, edge_v)
    width = np.maximum(s.du, s.dv)
    border = band(edge, 0.10, 0.22, width) + band(edge, 0.27, 0.29, width)
    weft = 1 - 0.10 * stripes(s.u, 0.04, 0.012, s.du)
    cloth = mix(s.colour, rgb("#efe6d5"), 0.75 * border)
    return cloth * (weft * (1 + 0.05 * noise(s.u, s.v)))[:, None]


RUG = Material(_woven)


def bookcase(wall: Placement, along: Interval, top: float, rng: np.random.Generator, colour: Colour) -> None:
    """Shelves full of books over a row of cupboards."""
    (a0, a1), depth, board, base = along, 0.34, 0.035, 0.72
    label = Label.FURNITURE
    bays = max(2, round((a1 - a0) / 0.85))
    edges = np.linspace(a0, a1, bays + 1)
    wall.box(along, (base, top), (0, 0.02), PAINT, colour * 0.8, label)
    wall.box((a0 - 0.04, a1 + 0.04), (top, top + 0.09), (0, depth + 0.05), PAINT, colour, label)
    wall.box((a0 - 0.02, a1 + 0.02), (base, base + 0.04), (0, depth + 0.1), PAINT, colour, label)
    wall.box(along, (0.09, base), (0, depth + 0.05), PAINT, colour, label)
    wall.box(along, (0, 0.09), (0, depth), PAINT, colour * 0.7, label)
    for a in edges:
        low, high = max(a - board / 2, a0), min(a + board / 2, a1)
        wall.box((low, high), (base, top), (0, depth), PAINT, colour, label)
    for left, right in pairwise(edges):
        middle = (left + right) / 2
        for a, b, knob in ((left, middle, middle - 0.05), (middle, right, middle + 0.05)):
            front = (a + 0.02, b - 0.02), (0.12, base - 0.03)
            wall.box(*front, (depth, depth + 0.062), PAINT, colour, label)
            rim(wall, *front, (depth, depth + 0.072), 0.05, PAINT, colour, label)
            wall.box(
                (knob - 0.012, knob + 0.012),
                (0.55, 0.574),
                (depth, depth + 0.1),
                METAL,
                rgb("#b08d4f"),
                label,
            )
    rows = max(3, round((top - base) / 0.36))
    levels = np.linspace(base + 0.04, top, rows + 1)
    for low, high in pairwise(levels):
        wall.box(along, (high - board, high), (0, depth), PAINT, colour, label)
        for left, right in pairwise(edges):
            span = (left + board / 2, right - board / 2)
            _books(wall, span, (low, high - board), depth, rng)


def _books(wall: Placement, along: Interval, height: Interval, depth: float, rng: np.random.Generator) -> None:
    """A row of books, now and then broken by a pile or a vase."""
    a, end = along[0] + 0.004, along[1]
    low, clearance = height[0], height[1] - height[0]
    while a < end - 0.03:
        if rng.random() < 0.07 and end - a > 0.24:
            if rng.random() < 0.5:
                vase(wall, a + 0.11, low, depth / 2, 0.055, 0.2, rng)
            else:
                h = low
                for _ in range(rng.integers(2, 5)):
                    thick, cover = rng.uniform(0.025, 0.045), rgb(rng.choice(_BOOKS))
                    wall.box(
                        (a + 0.01, a + rng.uniform(0.18, 0.22)),
                        (h, h + thick),
                        (0.06, depth - 0.05),
                        PAINT,
                        cover,
                        Label.FURNITURE,
                    )
                    h += thick
            a += 0.23
            continue
        cover = rgb(rng.choice(_BOOKS))
        tall = rng.uniform(0.62, 0.93) * clearance
        front = depth - rng.uniform(0.03, 0.07)
        for _ in range(rng.integers(1, 4)):
            thick = rng.uniform(0.022, 0.05)
            if a + thick > end:
                return
            spine = (a, a + thick - 0.0015)
            wall.box(spine, (low, low + tall), (0.05, front), PAINT, cover, Label.FURNITURE)
            strip = low + tall * 0.78
            wall.box(
                spine,
                (strip, strip + 0.012),
                (0.05, front + 0.001),
                PAINT,
                rgb("#d8c69a"),
                Label.FURNITURE,
            )
            a += thick


def vase(
    place: Placement,
    along: float,
    low: float,
    out: float,
    radius: float,
    height: float,
    rng: np.random.Generator,
) -> None:
    """A vase whose foot stands at (along, low, out)."""
    clay = rgb(rng.choice(["#d9cfbf", "#8c6a55", "#6f8087", "#e8e2d6"]))
    cylinder = Shape.CYLINDER
    for share, low_share, high_share in ((1.0, 0.0, 0.7), (0.55, 0.7, 1.0)):
        r = radius * share
        place.box(
            (along - r, along + r),
            (low + low_share * height, low + high_share * height),
            (out - r, out + r),
            LACQUER,
            clay,
            Label.FURNITURE,
            cylinder,
        )


def table(place: Placement, length: float, width: float, colour: Colour) -> None:
    """A dining table centred on the placement."""
    a, o, label = length / 2, width / 2, Label.FURNITURE
    place.box((-a, a), (0.72, 0.755), (-o, o), OILED_OAK, colour, label)
    place.box((-a + 0.1, a - 0.1), (0.64, 0.72), (-o + 0.1, o - 0.1), OAK, colour * 0.9, label)
    for da in (-a + 0.06, a - 0.13):
        for do in (-o + 0.06, o - 0.13):
            place.box((da, da + 0.07), (0, 0.72), (do, do + 0.07), UPRIGHT_OAK, colour, label)


def low_table(place: Placement, colour: Colour) -> None:
    """A table for a sofa, with a shelf, centred on the placement."""
    label = Label.FURNITURE
    place.box((-0.32, 0.32), (0.36, 0.4), (-0.55, 0.55), OILED_OAK, colour, label)
    place.box((-0.3, 0.3), (0.12, 0.14), (-0.53, 0.53), OAK, colour, label)
    for a in (-0.32, 0.27):
        for o in (-0.55, 0.5):
            place.box((a, a + 0.05), (0, 0.36), (o, o + 0.05), UPRIGHT_OAK, colour, label)


def chair(place: Placement, colour: Colour, seat: Colour) -> None:
    """A chair on the placement, looking out."""
    w, d, label = 0.22, 0.21, Label.FURNITURE
    place.box((-w, w), (0.42, 0.45), (-d, d), OAK, colour, label)
    place.box((-w + 0.02, w - 0.02), (0.45, 0.475), (-d + 0.03, d), PAINT, seat, label)
    for a in (-w, w - 0.04):
        place.box((a, a + 0.04), (0, 0.42), (d - 0.04, d), UPRIGHT_OAK, colour, label)
        place.box((a, a + 0.04), (0, 0.92), (-d, -d + 0.04), UPRIGHT_OAK, colour, label)
    for h in (0.58, 0.84):
        place.box((-w, w), (h, h + 0.06), (-d + 0.01, -d + 0.03), OAK, colour, label)
    for a in np.linspace(-w + 0.075, w - 0.095, 4):
        place.box((a, a + 0.02), (0.62, 0.86), (-d + 0.013, -d + 0.027), UPRIGHT_OAK, colour, label)
    for a in (-w + 0.01, w - 0.03):
        place.box((a, a + 0.02), (0.2, 0.23), (-d, d), OAK, colour, label)


def sofa(place: Placement, length: float, cloth: Colour, accent: Colour) -> None:
    """A sofa against the placement, looking out."""
    a, label = length / 2, Label.FURNITURE
    fabric = painted(0.03, arris=0.3)
    place.box((-a, a), (0.12, 0.3), (0.05, 0.92), fabric, cloth * 0.92, label)
    place.box((-a, a), (0.12, 0.78), (0.02, 0.22), fabric, cloth, label)
    for side in ((-a, -a + 0.18), (a - 0.18, a)):
        place.box(side, (0.12, 0.6), (0.05, 0.92), fabric, cloth, label)
    seats = np.linspace(-a + 0.18, a - 0.18, 4)
    for left, right in pairwise(seats):
        span = (left + 0.006, right - 0.006)
        place.box(span, (0.3, 0.45), (0.22, 0.94), fabric, cloth * 1.04, label)
        place.prism(
            [(0.22, 0.45), (0.42, 0.45), (0.34, 0.84), (0.22, 0.84)],
            span,
            fabric,
            cloth * 1.04,
            label,
            across="along",
        )
    for span in ((-a + 0.24, -a + 0.64), (a - 0.66, a - 0.26)):
        place.prism(
            [(0.43, 0.46), (0.53, 0.48), (0.42, 0.86), (0.33, 0.84)],
            span,
            fabric,
            accent,
            label,
            across="along",
        )
    for foot in (-a + 0.06, a - 0.12):
        for out in (0.1, 0.82):
            place.box((foot, foot + 0.05), (0, 0.12), (out, out + 0.05), OAK, rgb("#4a3526"), label)


def sideboard(wall: Placement, along: Interval, colour: Colour) -> None:
    """A low cabinet on feet, with drawers in the middle and doors beside."""
    (a0, a1), label = along, Label.FURNITURE
    wall.box(along, (0.16, 0.74), (0.02, 0.45), OAK, colour * 0.9, label)
    wall.box((a0 - 0.02, a1 + 0.02), (0.74, 0.77), (0.02, 0.47), OILED_OAK, colour, label)
    edges = np.linspace(a0 + 0.02, a1 - 0.02, 4)
    for i, (left, right) in enumerate(pairwise(edges)):
        levels = np.linspace(0.18, 0.73, 4 if i == 1 else 2)
        for low, high in pairwise(levels):
            span, rise = (left + 0.008, right - 0.008), (low + 0.008, high - 0.008)
            wall.box(span, rise, (0.4, 0.468), OAK, colour, label)
            middle = (left + right) / 2
            wall.box(
                (middle - 0.07, middle + 0.07),
                (high - 0.07, high - 0.055),
                (0.46, 0.49),
                METAL,
                rgb("#2f2c2a"),
                label,
            )
    for a in (a0 + 0.08, a1 - 0.12):
        for out in (0.06, 0.38):
            wall.box((a, a + 0.04), (0, 0.16), (out, out + 0.04), OAK, rgb("#3a2b20"), label)


def table_lamp(place: Placement, low: float, shade: Colour) -> None:
    """A lamp standing at height `low` on the placement."""
    for radius, rise, material, colour in (
        (0.08, (0.0, 0.02), METAL, rgb("#6d5a3c")),
        (0.015, (0.02, 0.3), METAL, rgb("#6d5a3c")),
        (0.15, (0.28, 0.48), PAINT, shade),
    ):
        span = (-radius, radius)
        height = (low + rise[0], low + rise[1])
        place.box(span, height, span, material, colour, Label.LAMP, Shape.CYLINDER)


def pendant(place: Placement, ceiling: float, low: float, colour: Colour, bulb: Material) -> None:
    """A lamp hanging from the ceiling, its shade's rim at height `low`."""
    for radius, rise, material, tone in (
        (0.006, (low + 0.2, ceiling), PAINT, rgb("#222222")),
        (0.05, (low + 0.14, low + 0.24), METAL, rgb("#b08d4f")),
        (0.19, (low, low + 0.14), PAINT, colour),
        (0.17, (low - 0.004, low), bulb, rgb("#fff1d8") * 1.1),
    ):
        span = (-radius, radius)
        place.box(span, rise, span, material, tone, Label.LAMP, Shape.CYLINDER)


def potted_plant(place: Placement, height: float, rng: np.random.Generator) -> None:
    """A leafy plant in a square pot."""
    pot = rgb(rng.choice(["#c9c2b5", "#8d5f49", "#4d5457"]))
    place.box((-0.19, 0.19), (0, 0.4), (-0.19, 0.19), painted(0.02), pot, Label.FURNITURE)
    place.box((-0.165, 0.165), (0.3, 0.404), (-0.165, 0.165), PAINT, rgb("#3b2f26"), Label.PLANT)
    for _ in range(46):
        turn, rise = rng.uniform(0, 2 * np.pi), rng.uniform(0.45, 1)
        reach = 0.34 * np.sin(np.pi * min(rise, 0.97) ** 1.3) * rng.uniform(0.35, 1)
        a, o, h = reach * np.cos(turn), reach * np.sin(turn), rise * height
        size = rng.uniform(0.05, 0.1)
        green = rgb("#4f7340") * rng.uniform(0.6, 1.25)
        place.box(
            (a - size, a + size),
            (h - 0.45 * size, h + 0.45 * size),
            (o - 0.7 * size, o + 0.7 * size),
            PAINT,
            green,
            Label.PLANT,
            Shape.ELLIPSOID,
        )
    place.box(
        (-0.015, 0.015),
        (0.4, height * 0.8),
        (-0.015, 0.015),
        PAINT,
        rgb("#5b4632"),
        Label.PLANT,
        Shape.CYLINDER,
    )
