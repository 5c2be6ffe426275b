"""kalibr's camchain; source: its page "Supported models", for the order of intrinsics and distortion_coeffs."""

from __future__ import annotations

import re

from .entries import Section, yaml_text
from .record import (
    DOUBLE_SPHERE,
    EXTENDED_UNIFIED,
    FIELD_OF_VIEW,
    KANNALA_BRANDT,
    PINHOLE,
    UNIFIED,
    CameraFile,
    Lens,
    brown_conrady,
    other_model,
    with_zeros,
)

# camera_model-distortion_model -> the house's model, how many intrinsics stand before fu, fv, pu, pv, and how many
# coefficients there are.
_MODELS = {
    "pinhole-none": (PINHOLE, 0, 0),
    "pinhole-equidistant": (KANNALA_BRANDT, 0, 4),
    "pinhole-equi": (KANNALA_BRANDT, 0, 4),
    "pinhole-fov": (FIELD_OF_VIEW, 0, 1),
    "omni-none": (UNIFIED, 1, 0),
    "omni-radtan": (UNIFIED, 1, 4),
    "ds-none": (DOUBLE_SPHERE, 2, 0),
    "eucm-none": (EXTENDED_UNIFIED, 2, 0),
}
_RADTAN = "pinhole-radtan"


def kalibr_cameras(file: Section) -> list[str]:
    """The names of a camchain's cameras, cam0 first if it is there."""
    names = [key for key in file.entries if re.fullmatch(r"cam\d+", key)]
    return sorted(names, key=lambda name: name != "cam0")


def parse_kalibr(file: Section) -> Lens:
    """kalibr camchain, its first camera; raises ValueError if that is not a readable camera."""
    camera = file.section(kalibr_cameras(file)[0])
    kind = f"{camera.text('camera_model')}-{camera.text('distortion_model', default='none')}"
    width, height = camera.numbers("resolution", count=2)
    size = width, height
    if kind == _RADTAN:
        return brown_conrady(size, camera.numbers("intrinsics", count=4), camera.numbers("distortion_coeffs", count=4))
    if kind not in _MODELS:
        raise other_model(kind, (*_MODELS, _RADTAN))
    model, shapes, count = _MODELS[kind]
    intrinsics = camera.numbers("intrinsics", count=shapes + 4)
    coefficients = camera.numbers("distortion_coeffs", count=count) if count else []
    return Lens(model, size, with_zeros(model, [*intrinsics[shapes:], *intrinsics[:shapes], *coefficients]))


def kalibr_text(camera: CameraFile, suffix: str) -> str:
    """YAML of a camchain of one camera, cam0."""
    fisheye = camera.model == KANNALA_BRANDT
    entries = {
        "camera_model": "pinhole",
        "intrinsics": list(camera.params[:4]),
        "distortion_model": "equidistant" if fisheye else "none",
        "distortion_coeffs": list(camera.params[4:]),
        "resolution": [camera.width, camera.height],
    }
    return yaml_text({"cam0": entries})
