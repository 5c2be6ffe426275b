"""Town houses, their shops and roofs, each built against a placement on the building line."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from .materials import (
    Material,
    Surface,
    band,
    bricks,
    cell_random,
    mix,
    noise,
    painted,
    rgb,
    slats,
    stripes,
    tiles,
)
from .solids import Colour, Label, Placement

STONE = painted(0.04)
STUCCO = painted(0.05)
TRIM = painted(0.02)
BRICK = bricks(rgb("#b5aa9a"))
SLATE = tiles((0.3, 0.22), rgb("#2b2e33"), joint=0.012, variation=0.35)
FANLIGHT = Material(lambda s: s.colour * 0 + rgb("#1d2327"), reflectance=0.14)
AWNING = slats(0.5, 0.25)

_STYLES = (
    (BRICK, "#9a5340", "#e3d9c8"),
    (STUCCO, "#e0d3b8", "#f3ede0"),
    (BRICK, "#a9805b", "#efe6d6"),
    (STUCCO, "#b9c4c4", "#f2efe8"),
    (STUCCO, "#d3a184", "#f4ebdf"),
    (BRICK, "#80503f", "#d8cfc0"),
    (STONE, "#cdc3b2", "#e6dece"),
    (STUCCO, "#bfc2ab", "#f1eddf"),
)
_SHOPFRONTS = ("#2f4a43", "#3b3f4a", "#6b2f2b", "#284a66", "#4a3a2e", "#7b7350")
_AWNINGS = ("#b5483a", "#3f6b5c", "#d9b25f", "#4a6585", "#e6dcc8")

_GOODS = np.array([rgb(c) for c in ("#c9bfa8", "#8a5a3c", "#5f7a78", "#b08a4e", "#7a4238", "#39434d")])

_GROUND = 4.0
_STOREY = 3.15
_REVEAL = 0.24
_SILL, _HEAD = 0.85, 2.65


@dataclass(frozen=True)
class _Bays:
    """Where the windows are: centres along world axis u from `start`, `pitch` apart, in metres."""

    start: float
    pitch: float
    width: float


def _sash_windows(bays: _Bays, frame: Colour) -> Material:
    """Panes behind the openings of the upper storeys: frames, glazing bars, curtains, rooms."""

    def texture(s: Surface) -> np.ndarray:
        column = np.floor((s.u - bays.start) / bays.pitch)
        storey = np.floor((s.v - _GROUND) / _STOREY)
        x = s.u - bays.start - (column + 0.5) * bays.pitch
        y = s.v - _GROUND - storey * _STOREY - _SILL
        half, height = bays.width / 2, _HEAD - _SILL
        chance = cell_random(column, storey, 5)
        room = rgb("#1d2327") * (0.6 + 0.8 * cell_random(column, storey, 9))[:, None]
        drawn = np.where(chance < 0.45, half * (0.45 + chance), half)
        curtain = 1 - band(x, -drawn, drawn, s.du)
        folds = 0.75 + 0.25 * np.sin(70 * x)
        glass = mix(room, rgb("#cfc8b9"), 0.8 * curtain * folds)
        blind = band(y, height * np.where(chance > 0.72, 0.72, 1.0), 9.0, s.dv)
        glass = mix(glass, rgb("#d8d0bd"), blind * 0.85)
        bars = 1 - (1 - band(np.abs(x), half - 0.06, 9.0, s.du)) * (1 - band(np.abs(x), -0.03, 0.03, s.du)) * (
            1 - band(y, -9.0, 0.07, s.dv)
        ) * (1 - band(y, height - 0.06, 9.0, s.dv)) * (1 - band(np.abs(y - 0.62 * height), -0.03, 0.03, s.dv))
        return mix(glass, frame, bars)

    return Material(texture, reflectance=0.14)


def _shop_windows(frame: Colour) -> Material:
    """Shop windows with slim mullions and goods on display inside."""

    def texture(s: Surface) -> np.ndarray:
        cell, shelf = np.floor(s.u / 0.3), np.floor((s.v - 0.75) / 0.55)
        chance = cell_random(cell, shelf, 3)
        glow = np.clip((s.v - 0.4) / 2.6, 0, 1) * (0.75 + 0.25 * np.cos(s.u * 2 * np.pi / 2.7))
        inside = mix(np.broadcast_to(rgb("#2c2620"), s.colour.shape), rgb("#a8855a"), glow)
        above = s.v - 0.75 - shelf * 0.55
        shown = band(s.u - cell * 0.3, 0.03, 0.27, s.du) * band(above, 0, 0.1 + 0.3 * chance, s.dv)
        shown *= (chance > 0.35) & (s.v > 0.75) & (s.v < 1.85)
        inside = mix(inside, _GOODS[(chance * 997).astype(int) % len(_GOODS)], 0.75 * shown)
        board = band(above, -0.04, 0.0, s.dv) * (s.v < 1.9)
        inside = mix(inside, rgb("#4a3a2a"), board)
        bars = 1 - (1 - stripes(s.u, 1.35, 0.06, s.du)) * (1 - band(s.v, 2.35, 2.43, s.dv))
        return mix(inside, frame, bars)

    return Material(texture, reflectance=0.12)


def house(
    front: Placement,
    width: float,
    storeys: int,
    rng: np.random.Generator,
    *,
    depth: float = 11.0,
    corners: tuple[bool, bool] = (False, False),
) -> None:
    """A town house from along = 0 to `width` with `storeys` over a ground floor.

    `corners` says which flanks, the one at 0 and the one at `width`, have windows too.
    """
    material, wall_code, trim_code = _STYLES[rng.integers(len(_STYLES))]
    wall, trim = rgb(wall_code) * rng.uniform(0.9, 1.08), rgb(trim_code)
    shop = rgb(rng.choice(_SHOPFRONTS))
    top = _GROUND + storeys * _STOREY
    flank = 0.36
    for span, open_flank in zip(((0, flank), (width - flank, width)), corners, strict=True):
        if not open_flank:
            front.box(span, (0, top), (-depth, -_REVEAL), material, wall, Label.BUILDING)
    front.box((0, width), (top - 0.3, top + 0.05), (-depth, 0), material, wall, Label.BUILDING)
    front.box((0, width), (0, top), (-depth, -depth + 0.3), material, wall, Label.BUILDING)
    trimmed = bool(rng.random() < 0.75)
    faces = [(front, width)]
    if corners[0]:
        faces.append((front.sideways().at(-depth, 0.0), depth))
    if corners[1]:
        faces.append((front.at(width, 0, turned=True).sideways(), depth))
    for face, length in faces:
        _upper_storeys(face, length, storeys, material, wall, trim, trimmed)
        if rng.random() < 0.7 or length < width:
            _shopfront(face, length, shop, material, wall, rng)
        else:
            _entrance(face, length, material, wall, trim, shop)
        _cornice(face, length, top, trim)
    _roof(front, width, depth, top, wall, rng)


def _upper_storeys(
    face: Placement,
    length: float,
    storeys: int,
    material: Material,
    wall: Colour,
    trim: Colour,
    trimmed: bool,
) -> None:
    count = max(2, round(length / 2.5))
    pitch = length / count
    opening = min(1.25, 0.52 * pitch)
    ends = face.point(0, 0, 0), face.point(length, 0, 0)
    axis = 0 if face.along[0] else 2
    bays = _Bays(min(end[axis] for end in ends), pitch, opening)
    top = _GROUND + storeys * _STOREY
    panes = _sash_windows(bays, trim)
    face.box((0.05, length - 0.05), (_GROUND, top - 0.1), (-0.9, -_REVEAL), panes, trim, Label.WINDOW)
    shell = (-_REVEAL, 0.0)
    edges = np.concatenate([[0], np.repeat((np.arange(count) + 0.5) * pitch, 2), [length]])
    edges[1:-1] += np.tile([-opening / 2, opening / 2], count)
    for left, right in zip(edges[::2], edges[1::2], strict=True):
        face.box((left, right), (_GROUND - 0.6, top), shell, material, wall, Label.BUILDING)
    for storey in range(storeys + 1):
        floor = _GROUND + storey * _STOREY
        low = _GROUND - 0.6 if storey == 0 else floor - _STOREY + _HEAD
        high = top if storey == storeys else floor + _SILL
        face.box((0, length), (low, high), shell, material, wall, Label.BUILDING)
        if storey == storeys:
            continue
        for i in range(count):
            middle = (i + 0.5) * pitch
            span = (middle - opening / 2 - 0.1, middle + opening / 2 + 0.1)
            sill, head = floor + _SILL, floor + _HEAD
            face.box(span, (sill - 0.09, sill), (-_REVEAL, 0.09), TRIM, trim, Label.BUILDING)
            if trimmed:
                face.box(span, (head, head + 0.2), (-0.02, 0.045), TRIM, trim, Label.BUILDING)
    face.box((0, length), (_GROUND - 0.12, _GROUND + 0.12), (0, 0.1), TRIM, trim, Label.BUILDING)


def _shopfront(
    face: Placement,
    length: float,
    colour: Colour,
    material: Material,
    wall: Colour,
    rng: np.random.Generator,
) -> None:
    frame = rgb("#26282a")
    face.box(
        (0.05, length - 0.05),
        (0, _GROUND - 0.5),
        (-0.9, -0.42),
        _shop_windows(frame),
        frame,
        Label.WINDOW,
    )
    for span in ((0, 0.45), (length - 0.45, length)):
        face.box(span, (0, _GROUND), (-0.45, 0), material, wall, Label.BUILDING)
    count = max(1, round(length / 4.5))
    edges = np.linspace(0.45, length - 0.45, count + 1)
    for a in edges:
        face.box((a - 0.14, a + 0.14), (0, 3.0), (-0.42, 0.05), TRIM, colour, Label.BUILDING)
    face.box((0.3, length - 0.3), (2.95, 3.62), (-0.42, 0.12), TRIM, colour, Label.BUILDING)
    face.box((0.25, length - 0.25), (3.62, 3.7), (-0.42, 0.24), TRIM, colour * 1.2, Label.BUILDING)
    face.box((0.3, length - 0.3), (2.88, 2.95), (-0.42, 0.16), TRIM, colour * 1.2, Label.BUILDING)
    door_bay = int(rng.integers(count))
    cloth = rgb(rng.choice(_AWNINGS))
    shaded = bool(rng.random() < 0.5)
    for i, (left, right) in enumerate(pairwise(edges)):
        stop = right - 1.25 if i == door_bay else right
        face.box((left, stop), (0, 0.55), (-0.42, -0.05), TRIM, colour, Label.BUILDING)
        if i == door_bay:
            face.box((stop - 0.08, stop), (0, 3.0), (-0.42, -0.05), TRIM, colour, Label.DOOR)
            face.box((stop, right), (2.2, 2.3), (-0.42, -0.1), TRIM, colour, Label.DOOR)
            face.box((stop, right), (0, 0.22), (-0.42, -0.36), TRIM, colour, Label.DOOR)
            for edge in (stop, right - 0.12):
                face.box((edge, edge + 0.12), (0, 2.2), (-0.42, -0.36), TRIM, colour, Label.DOOR)
        if shaded:
            face.prism(
                [(0.05, 2.84), (0.05, 2.92), (1.25, 2.52), (1.25, 2.36)],
                (left + 0.2, right - 0.2),
                AWNING,
                cloth,
                Label.BUILDING,
                across="along",
            )


def _entrance(face: Placement, length: float, material: Material, wall: Colour, trim: Colour, leaf: Colour) -> None:
    """A ground floor of flats: a plinth, windows, and a front door with steps."""
    count = max(2, round(length / 2.5))
    pitch = length / count
    opening = min(1.25, 0.52 * pitch)
    ends = face.point(0, 0, 0), face.point(length, 0, 0)
    start = min(end[0 if face.along[0] else 2] for end in ends)
    # The pane texture repeats each storey; one storey down, its sill is at _GROUND - _STOREY.
    sill, head = _GROUND - _STOREY + _SILL, _GROUND - _STOREY + _HEAD
    panes = _sash_windows(_Bays(start, pitch, opening), trim)
    face.box((0.05, length - 0.05), (0, _GROUND - 0.1), (-0.9, -_REVEAL), panes, trim, Label.WINDOW)
    shell = (-_REVEAL, 0.0)
    door_bay = count // 2
    face.box((0, length), (head, _GROUND), shell, material, wall, Label.BUILDING)
    previous = 0.0
    for i in range(count):
        middle = (i + 0.5) * pitch
        left, right = middle - opening / 2, middle + opening / 2
        face.box((previous, left), (0, head), shell, material, wall, Label.BUILDING)
        previous = right
        if i == door_bay:
            door = (left + 0.08, right - 0.08)
            face.box((left, right), (0, head), (-_REVEAL, -0.16), TRIM, trim, Label.DOOR)
            face.box(door, (0.16, 2.5), (-_REVEAL, -0.12), TRIM, leaf, Label.DOOR)
            face.box(door, (2.62, head - 0.1), (-_REVEAL, -0.15), FANLIGHT, leaf, Label.WINDOW)
            face.box(
                (left - 0.15, right + 0.15),
                (0, 0.16),
                (-0.2, 0.4),
                STONE,
                rgb("#a8a196"),
                Label.BUILDING,
            )
            face.box((left - 0.2, right + 0.2), (head, head + 0.18), (0, 0.3), TRIM, trim, Label.BUILDING)
            continue
        face.box((left, right), (0, sill), shell, material, wall, Label.BUILDING)
        face.box(
            (left - 0.1, right + 0.1),
            (sill - 0.09, sill),
            (-_REVEAL, 0.09),
            TRIM,
            trim,
            Label.BUILDING,
        )
    face.box((previous, length), (0, head), shell, material, wall, Label.BUILDING)
    for span in ((0, (door_bay + 0.5) * pitch - 0.8), ((door_bay + 0.5) * pitch + 0.8, length)):
        face.box(span, (0, 0.6), (0, 0.06), STONE, rgb("#a39b8e"), Label.BUILDING)


def _cornice(face: Placement, length: float, top: float, trim: Colour) -> None:
    for low, high, reach in ((-0.45, -0.3, 0.1), (-0.12, 0.06, 0.25), (0.06, 0.18, 0.4)):
        face.box((0, length), (top + low, top + high), (0, reach), TRIM, trim, Label.BUILDING)
    for a in np.arange(0.3, length - 0.2, 0.6):
        face.box((a, a + 0.16), (top - 0.3, top - 0.12), (0, 0.2), TRIM, trim, Label.BUILDING)


def _roof(
    front: Placement,
    width: float,
    depth: float,
    top: float,
    wall: Colour,
    rng: np.random.Generator,
) -> None:
    """A pitched slate roof with a chimney, or a parapet."""
    if rng.random() < 0.65:
        slate = rgb(rng.choice(["#59606a", "#6b5a52", "#7d4e40"]))
        rise = rng.uniform(1.6, 2.6)
        front.prism(
            [(0.1, top + 0.15), (-depth / 2, top + rise + 0.6), (-depth, top + 0.15)],
            (0, width),
            SLATE,
            slate,
            Label.BUILDING,
            across="along",
        )
    else:
        front.box((0, width), (top + 0.18, top + 0.95), (-0.3, -0.02), STUCCO, wall, Label.BUILDING)
        front.box(
            (0, width),
            (top + 0.95, top + 1.05),
            (-0.36, 0.06),
            TRIM,
            rgb("#d8d0c2"),
            Label.BUILDING,
        )
    stack = rng.uniform(0.1, 0.8) * (width - 1.2)
    behind = (-depth / 2 - 0.35, -depth / 2 + 0.35)
    front.box((stack, stack + 1.1), (top, top + 3.9), behind, BRICK, rgb("#8d5542"), Label.BUILDING)
    front.box(
        (stack - 0.08, stack + 1.18),
        (top + 3.7, top + 3.85),
        (behind[0] - 0.08, behind[1] + 0.08),
        STONE,
        rgb("#b8ad9c"),
        Label.BUILDING,
    )


def clock_tower(front: Placement, height: float) -> None:
    """A square tower with a pyramid roof, 7 m wide, centred on the placement."""
    stone, trim = rgb("#c9b898"), rgb("#e2d7c1")
    front.box((-3.5, 3.5), (0, height), (-7, 0), STONE, stone, Label.BUILDING)
    for share in (0.3, 0.55, 0.78, 1.0):
        level = share * height
        front.box((-3.75, 3.75), (level - 0.5, level), (-7.25, 0.25), TRIM, trim, Label.BUILDING)
    for share in (0.36, 0.6):
        for a in (-1.6, 0.5):
            level = share * height
            front.box(
                (a, a + 1.1),
                (level, level + 2.6),
                (-0.1, 0.03),
                STONE,
                rgb("#3a3d42"),
                Label.WINDOW,
            )
    front.box(
        (-1.5, 1.5),
        (0.82 * height, 0.82 * height + 3),
        (-0.1, 0.06),
        TRIM,
        rgb("#f2ecdc"),
        Label.BUILDING,
    )
    ridge, slate = height + 7, rgb("#5d7468")
    front.prism([(-3.6, height), (0, ridge), (3.6, height)], (-7.1, 0.1), SLATE, slate, Label.BUILDING)


def weathered(s: Surface) -> np.ndarray:
    """Tone (N,) of ground that has been walked and driven on: broad patches and fine grain."""
    width = np.maximum(s.du, s.dv)
    fine = noise(s.u * 1.7, s.v * 1.7) / (1 + (width / 0.02) ** 2)
    return np.exp(0.05 * noise(s.u / 14, s.v / 14) + 0.07 * fine)
