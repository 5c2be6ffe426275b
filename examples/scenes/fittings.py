"""What is fitted to the walls of a room, each built against a placement."""

from __future__ import annotations

import numpy as np

from .materials import Material, Surface, Texture, band, mix, noise, painted, rgb
from .solids import Colour, Interval, Label, Placement

PAINT = painted(arris=0.35)
LACQUER = painted(0.0, reflectance=0.04)
METAL = painted(0.0, reflectance=0.12)


def _folds(s: Surface) -> np.ndarray:
    """A curtain: soft vertical folds."""
    phase = (s.u + 0.012 * noise(s.u / 3, s.v / 9)) * (2 * np.pi / 0.085)
    return s.colour * (0.80 + 0.20 * np.sin(phase) + 0.05 * np.sin(2.3 * phase + 1))[:, None]


CURTAIN = Material(_folds)


def painting(seed: int) -> Texture:
    """An abstract picture: flat fields of colour over a horizon."""
    rng = np.random.default_rng(seed)
    palettes = (
        ("#e9dfcb", "#c2703d", "#2f4858", "#d9a441"),
        ("#ece6da", "#7c9082", "#30475e", "#c98f6b"),
        ("#f0e9dd", "#b5523b", "#445b52", "#e0b97d"),
        ("#e8e4dc", "#48617a", "#a7b8bd", "#d8b08c"),
    )
    paper, *colours = (rgb(code) for code in palettes[rng.integers(len(palettes))])
    horizon = rng.uniform(0.3, 0.55)
    fields = [(0.0, 1.0, 0.0, horizon, colours[0])]
    for colour in (colours[1], colours[2], colours[1]):
        left, bottom = rng.uniform(0.05, 0.6), rng.uniform(0.08, 0.6)
        width, height = rng.uniform(0.15, 0.35), rng.uniform(0.12, 0.33)
        fields.append((left, left + width, bottom, bottom + height, colour))

    def texture(s: Surface) -> np.ndarray:
        strokes = 1 + 0.05 * noise(s.a * 0.7, s.b * 4)
        colour = np.broadcast_to(paper, s.colour.shape)
        for left, right, bottom, top, tone in fields:
            inside = band(s.a, left, right, s.du) * band(s.b, bottom, top, s.dv)
            colour = mix(colour, tone, 0.92 * inside)
        return colour * strokes[:, None]

    return texture


def rim(
    place: Placement,
    along: Interval,
    height: Interval,
    out: Interval,
    width: float,
    material: Material,
    colour: Colour,
    label: Label,
) -> None:
    """Four boards of this width along the inside of a rectangle."""
    (a0, a1), (h0, h1) = along, height
    for span in ((a0, a0 + width), (a1 - width, a1)):
        place.box(span, height, out, material, colour, label)
    for span in ((h0, h0 + width), (h1 - width, h1)):
        place.box((a0 + width, a1 - width), span, out, material, colour, label)


def window(
    wall: Placement,
    along: Interval,
    height: Interval,
    panes: tuple[int, int],
    view: Material,
    depth: float,
    colour: Colour,
) -> None:
    """A window of panes (columns, rows) in an opening of a wall `depth` metres thick."""
    (a0, a1), (h0, h1) = along, height
    frame, bar = 0.07, 0.032
    back = (-depth + 0.04, -depth + 0.11)
    wall.box(along, height, (-depth, -depth + 0.02), view, colour, Label.WINDOW, casts_shadow=False)
    rim(wall, along, height, back, frame, PAINT, colour, Label.WINDOW)
    columns, rows = panes
    for i in range(1, columns):
        a = a0 + (a1 - a0) * i / columns
        width = frame if 2 * i == columns else bar
        wall.box((a - width / 2, a + width / 2), height, back, PAINT, colour, Label.WINDOW)
    for i in range(1, rows):
        h = h0 + (h1 - h0) * i / rows
        wall.box(along, (h - bar / 2, h + bar / 2), back, PAINT, colour, Label.WINDOW)
    casing = 0.1
    rim(
        wall,
        (a0 - casing, a1 + casing),
        (h0 - casing, h1 + casing),
        (0.0, 0.025),
        casing,
        PAINT,
        colour,
        Label.WINDOW,
    )
    wall.box((a0 - 0.16, a1 + 0.16), (h0 - 0.04, h0), (-depth, 0.09), PAINT, colour, Label.WINDOW)


def door(wall: Placement, start: float, colour: Colour, trim: Colour) -> None:
    """A panelled door, 0.95 m wide and 2.15 m high, in its frame."""
    a0, a1, top = start, start + 0.95, 2.15
    wall.box((a0, a1), (0, top), (-0.03, 0.012), PAINT, colour, Label.DOOR)
    for span in ((a0 - 0.11, a0), (a1, a1 + 0.11)):
        wall.box(span, (0, top), (0, 0.04), PAINT, trim, Label.DOOR)
    wall.box((a0 - 0.11, a1 + 0.11), (top, top + 0.13), (0, 0.045), PAINT, trim, Label.DOOR)
    wall.box((a0 - 0.14, a1 + 0.14), (top + 0.13, top + 0.16), (0, 0.07), PAINT, trim, Label.DOOR)
    for low, high in ((0.16, 0.86), (1.02, 2.0)):
        for left, right in ((a0 + 0.12, a0 + 0.44), (a0 + 0.51, a0 + 0.83)):
            rim(wall, (left, right), (low, high), (0, 0.028), 0.025, PAINT, colour, Label.DOOR)
            wall.box(
                (left + 0.06, right - 0.06),
                (low + 0.06, high - 0.06),
                (0, 0.022),
                PAINT,
                colour,
                Label.DOOR,
            )
    brass = rgb("#b08d4f")
    wall.box((a1 - 0.075, a1 - 0.045), (0.88, 1.06), (0, 0.02), METAL, brass, Label.DOOR)
    wall.box((a1 - 0.18, a1 - 0.05), (0.985, 1.005), (0.045, 0.065), METAL, brass, Label.DOOR)


def picture(wall: Placement, along: Interval, height: Interval, seed: int, frame: Colour) -> None:
    """A framed picture with a white mount."""
    (a0, a1), (h0, h1) = along, height
    rim(wall, along, height, (0, 0.035), 0.025, LACQUER, frame, Label.PICTURE)
    wall.box(along, height, (0, 0.012), PAINT, rgb("#f3efe6"), Label.PICTURE)
    mount = 0.12 * min(a1 - a0, h1 - h0) + 0.025
    art = Material(painting(seed))
    wall.box((a0 + mount, a1 - mount), (h0 + mount, h1 - mount), (0, 0.014), art, frame, Label.PICTURE)


def curtain(wall: Placement, along: Interval, top: float, colour: Colour) -> None:
    """A drawn-back curtain hanging from height `top` to just above the floor."""
    wall.box(along, (0.04, top), (0.06, 0.13), CURTAIN, colour, Label.FURNITURE)


def curtain_rod(wall: Placement, along: Interval, height: float) -> None:
    """A square iron rod for curtains."""
    span = (height, height + 0.025)
    wall.box(along, span, (0.08, 0.105), METAL, rgb("#3a332c"), Label.FURNITURE)
