"""camodocal's YAML, which VINS and KITTI-360 use; source: its camera_models (CataCamera, EquidistantCamera)."""

from __future__ import annotations

from .entries import Section
from .record import KANNALA_BRANDT, UNIFIED, Lens, brown_conrady, other_model


def parse_camodocal(file: Section) -> Lens:
    """The lens by its model_type; raises ValueError if that is not MEI, KANNALA_BRANDT or PINHOLE."""
    kind = file.text("model_type")
    if kind not in _PARSERS:
        raise other_model(kind, tuple(_PARSERS))
    size = file.number("image_width"), file.number("image_height")
    return _PARSERS[kind](file, size, file.section("projection_parameters"))


def _mei(file: Section, size: tuple[float, float], projection: Section) -> Lens:
    intrinsics = [projection.number(name) for name in ("gamma1", "gamma2", "u0", "v0")]
    xi = file.section("mirror_parameters").number("xi")
    return Lens(UNIFIED, size, [*intrinsics, xi, *_distortion(file)])


def _kannala_brandt(file: Section, size: tuple[float, float], projection: Section) -> Lens:
    """theta + k2 theta^3 + ... + k5 theta^9: the numbers count one further than the house's."""
    names = ("mu", "mv", "u0", "v0", "k2", "k3", "k4", "k5")
    return Lens(KANNALA_BRANDT, size, [projection.number(name) for name in names])


def _pinhole(file: Section, size: tuple[float, float], projection: Section) -> Lens:
    intrinsics = [projection.number(name) for name in ("fx", "fy", "cx", "cy")]
    return brown_conrady(size, intrinsics, _distortion(file))


def _distortion(file: Section) -> list[float]:
    distortion = file.section("distortion_parameters")
    return [distortion.number(name) for name in ("k1", "k2", "p1", "p2")]


_PARSERS = {"MEI": _mei, "KANNALA_BRANDT": _kannala_brandt, "PINHOLE": _pinhole}
