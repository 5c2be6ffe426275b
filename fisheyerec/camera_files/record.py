"""What every lens file is read into: one plain record, in the house's order and pixel convention."""

from __future__ import annotations

import math
import reprlib
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from numbers import Real
from typing import Any, NamedTuple

KANNALA_BRANDT = "kannala_brandt"
PINHOLE = "pinhole"
CYLINDRICAL = "cylindrical"
EQUIRECTANGULAR = "equirectangular"
STEREOGRAPHIC = "stereographic"
PANINI = "panini"
BROWN_CONRADY = "brown_conrady"
UNIFIED = "unified"
EXTENDED_UNIFIED = "extended_unified"
DOUBLE_SPHERE = "double_sphere"
DIVISION = "division"
FIELD_OF_VIEW = "field_of_view"
THIN_PRISM_FISHEYE = "thin_prism_fisheye"
OCAM = "ocam"

HOUSE_MODELS = (KANNALA_BRANDT, PINHOLE, CYLINDRICAL, EQUIRECTANGULAR, STEREOGRAPHIC, PANINI)
"""What the house computes with; all others are converted."""

_PINHOLE_PARAMETERS = ("fx", "fy", "cx", "cy")

# The equations are in lens_models.py. ocam: the affine matrix by rows, then the polynomial by rising powers.
PARAMETERS = {
    KANNALA_BRANDT: (*_PINHOLE_PARAMETERS, "k1", "k2", "k3", "k4"),
    PINHOLE: _PINHOLE_PARAMETERS,
    CYLINDRICAL: _PINHOLE_PARAMETERS,
    EQUIRECTANGULAR: _PINHOLE_PARAMETERS,
    STEREOGRAPHIC: _PINHOLE_PARAMETERS,
    PANINI: (*_PINHOLE_PARAMETERS, "d"),
    BROWN_CONRADY: (*_PINHOLE_PARAMETERS, *["k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4"]),
    UNIFIED: (*_PINHOLE_PARAMETERS, "xi", "k1", "k2", "p1", "p2"),
    EXTENDED_UNIFIED: (*_PINHOLE_PARAMETERS, "alpha", "beta"),
    DOUBLE_SPHERE: (*_PINHOLE_PARAMETERS, "xi", "alpha"),
    DIVISION: (*_PINHOLE_PARAMETERS, "k1"),
    FIELD_OF_VIEW: (*_PINHOLE_PARAMETERS, "omega"),
    THIN_PRISM_FISHEYE: (*_PINHOLE_PARAMETERS, *["k1", "k2", "p1", "p2", "k3", "k4", "s1", "s3"]),
    OCAM: ("cx", "cy", "xx", "xy", "yx", "yy", *(f"a{power}" for power in range(10))),
}

# k1 k2 p1 p2, k3, k4 k5 k6, s1..s4, tau_x tau_y: as many as the calibration's flags asked for; ROS may leave out all.
_BROWN_CONRADY_COUNTS = (0, 4, 5, 8, 12, 14)


@dataclass(frozen=True)
class CameraFile:
    """One camera as a lens file tells it, the same for every format."""

    model: str
    """A key of `PARAMETERS`: one of `HOUSE_MODELS`, or a model that is converted to `"kannala_brandt"`."""
    width: int
    height: int
    params: tuple[float, ...]
    """As named by `PARAMETERS`; fx, fy, cx, cy, and for kannala_brandt k1, k2, k3, k4."""


class Lens(NamedTuple):
    """What one format's function finds; `checked` makes the record of it."""

    model: str
    size: tuple[float, float] | None  # (width, height)
    params: list[float]


def checked(model: str, width: float, height: float, params: Sequence[float]) -> CameraFile:
    """The record of these values; raises ValueError if they make no camera."""
    if model not in PARAMETERS:
        raise other_model(model)
    names = PARAMETERS[model]
    if len(params) != len(names):
        raise ValueError(f"params: expected {', '.join(names)}, got {len(params)} numbers")
    numbers = tuple(number(value, name) for name, value in zip(names, params, strict=True))
    for name, value in zip(names, numbers, strict=True):
        if name in ("fx", "fy") and value <= 0:
            raise ValueError(f"{name}: expected a positive number, got {value}")
    if model == PANINI and numbers[-1] < 0:
        raise ValueError(f"d: expected at least 0, got {numbers[-1]:g}")
    sides = {name: number(side, name) for name, side in (("width", width), ("height", height))}
    for name, side in sides.items():
        if side < 1 or not side.is_integer():
            raise ValueError(f"{name}: expected a positive whole number, got {side:g}")
    return CameraFile(model, int(sides["width"]), int(sides["height"]), numbers)


def with_zeros(model: str, params: Sequence[float]) -> list[float]:
    """The model's parameters where a format leaves the last ones out; raises ValueError for more than it has."""
    missing = len(PARAMETERS[model]) - len(params)
    if missing < 0:
        raise ValueError(f"expected at most {len(PARAMETERS[model])} parameters of {model}, got {len(params)}")
    return [*params, *[0.0] * missing]


def brown_conrady(size: tuple[float, float] | None, intrinsics: list[float], coefficients: list[float]) -> Lens:
    """The lens of OpenCV's coefficients, a pinhole where all are 0; raises ValueError for a count it never writes."""
    if len(coefficients) not in _BROWN_CONRADY_COUNTS:
        counts = ", ".join(map(str, _BROWN_CONRADY_COUNTS))
        raise ValueError(f"expected {counts} coefficients of {BROWN_CONRADY}, got {len(coefficients)}")
    plain, tilt = coefficients[:12], coefficients[12:]
    if any(tilt):
        raise ValueError(f"tau_x, tau_y: expected 0, as no tilted sensor can be read, got {tilt}")
    if not any(coefficients):
        return Lens(PINHOLE, size, intrinsics)
    return Lens(BROWN_CONRADY, size, with_zeros(BROWN_CONRADY, [*intrinsics, *plain]))


def other_model(model: str, known: Sequence[str] = tuple(PARAMETERS)) -> ValueError:
    """The error for a lens model that cannot be read, or not from this format."""
    return ValueError(f"model: expected one of {', '.join(known)}, got {model}")


def number(value: object, key: str) -> float:
    """Converts one scalar (YAML's are text); raises ValueError if it is not a finite number."""
    converted = math.nan
    if isinstance(value, str | Real) and not isinstance(value, bool):
        with suppress(ValueError, OverflowError):  # refused below, with all that is not finite
            converted = float(value)
    if not math.isfinite(converted):
        raise ValueError(f"{key}: expected a finite number, got {reprlib.repr(value)}")
    return converted


def listed(items: Sequence[str] | dict[str, Any]) -> str:
    """The first few items in one line, for an error."""
    shown = [str(item) for item in items][:8]
    more = f", ... ({len(items)} in all)" if len(items) > len(shown) else ""
    return (", ".join(shown) + more) or "none"
