"""The YAML of fisheye-calib-adapter (Lee 2024), which never names its model; source: its src/model."""

from __future__ import annotations

from .entries import Section
from .record import (
    DOUBLE_SPHERE,
    EXTENDED_UNIFIED,
    KANNALA_BRANDT,
    OCAM,
    PARAMETERS,
    PINHOLE,
    Lens,
    brown_conrady,
    with_zeros,
)


def parse_adapter(file: Section) -> Lens:
    """fisheye-calib-adapter YAML, told apart by the most telling key; raises ValueError if a parameter is missing."""
    parameter, image = file.section("parameter"), file.section("image")
    size = image.number("width"), image.number("height")
    if "coefficients" in parameter:
        return Lens(OCAM, size, _ocam(parameter))
    intrinsics = [parameter.number(name) for name in PARAMETERS[PINHOLE]]
    if "p1" in parameter:
        coefficients = [parameter.number(name) for name in ("k1", "k2", "p1", "p2", "k3")]
        return brown_conrady(size, intrinsics, coefficients)
    if "alpha" in parameter and "beta" not in parameter and "xi" not in parameter:
        return Lens(EXTENDED_UNIFIED, size, [*intrinsics, parameter.number("alpha"), 1.0])  # UCM, with beta = 1
    telling = {"beta": EXTENDED_UNIFIED, "xi": DOUBLE_SPHERE, "k1": KANNALA_BRANDT}
    model = next((model for key, model in telling.items() if key in parameter), PINHOLE)
    return Lens(model, size, [parameter.number(name) for name in PARAMETERS[model]])


def _ocam(parameter: Section) -> list[float]:
    """x - cx = c X + d Y, y - cy = e X + Y: not the axes of OCamCalib, and z to the front."""
    cx, cy, c, d, e = (parameter.number(name) for name in ("cx", "cy", "c", "d", "e"))
    polynomial = parameter.section("coefficients").numbers("unprojection")
    return with_zeros(OCAM, [cx, cy, c, d, e, 1.0, *polynomial])
