"""COLMAP's cameras.txt; source: its page "Camera Models" and sensor/models.h, for the order of PARAMS[]."""

from __future__ import annotations

import re
import reprlib

from ..pixel import HALF_PIXEL
from .entries import Section
from .record import (
    BROWN_CONRADY,
    DIVISION,
    EXTENDED_UNIFIED,
    FIELD_OF_VIEW,
    KANNALA_BRANDT,
    PINHOLE,
    THIN_PRISM_FISHEYE,
    CameraFile,
    Lens,
    brown_conrady,
    listed,
    other_model,
    with_zeros,
)

# COLMAP puts the image's corner at (0, 0), hence the centre of the first pixel at (0.5, 0.5). The
# house, like OpenCV, kalibr and gyroflow, puts that centre at (0, 0): cx and cy differ by this.
COLMAP_PIXEL_CENTRE = HALF_PIXEL

_ONE_FOCAL = (0, 0, 1, 2)

# The house's model, and where its first parameters stand in PARAMS[]; those COLMAP's model lacks are 0.
_MODELS: dict[str, tuple[str, tuple[int, ...]]] = {
    "OPENCV_FISHEYE": (KANNALA_BRANDT, tuple(range(8))),
    "PINHOLE": (PINHOLE, tuple(range(4))),
    "SIMPLE_PINHOLE": (PINHOLE, _ONE_FOCAL),
    "SIMPLE_FISHEYE": (KANNALA_BRANDT, _ONE_FOCAL),
    "FISHEYE": (KANNALA_BRANDT, tuple(range(4))),
    "SIMPLE_RADIAL_FISHEYE": (KANNALA_BRANDT, (*_ONE_FOCAL, 3)),
    "RADIAL_FISHEYE": (KANNALA_BRANDT, (*_ONE_FOCAL, 3, 4)),
    "SIMPLE_RADIAL": (BROWN_CONRADY, (*_ONE_FOCAL, 3)),
    "RADIAL": (BROWN_CONRADY, (*_ONE_FOCAL, 3, 4)),
    "OPENCV": (BROWN_CONRADY, tuple(range(8))),
    "FULL_OPENCV": (BROWN_CONRADY, tuple(range(12))),
    "FOV": (FIELD_OF_VIEW, tuple(range(5))),
    "SIMPLE_DIVISION": (DIVISION, (*_ONE_FOCAL, 3)),
    "DIVISION": (DIVISION, tuple(range(5))),
    "EUCM": (EXTENDED_UNIFIED, tuple(range(6))),
    "THIN_PRISM_FISHEYE": (THIN_PRISM_FISHEYE, tuple(range(12))),
}


def _rows(text: str) -> list[list[str]]:
    """The lines of a cameras.txt split into fields, without comments."""
    lines = (line.strip() for line in text.splitlines())
    return [line.split() for line in lines if line and not line.startswith("#")]


def is_colmap(text: str) -> bool:
    """Whether the first line that is no comment reads CAMERA_ID MODEL ..."""
    rows = _rows(text)
    return bool(rows) and bool(re.match(r"\d+ [A-Z][A-Z0-9_]*( |$)", " ".join(rows[0])))


def parse_colmap(text: str) -> Lens:
    """COLMAP cameras.txt; raises ValueError unless exactly one of its cameras can be read."""
    rows = _rows(text)
    for row in rows:
        if len(row) < 5:
            got = reprlib.repr(" ".join(row))
            raise ValueError(f"expected lines CAMERA_ID MODEL WIDTH HEIGHT PARAMS[], got {got}")
    readable = [row for row in rows if row[1] in _MODELS]
    if len(readable) != 1:
        if len(rows) == 1:
            raise other_model(rows[0][1], tuple(_MODELS))
        ids = listed([f"{row[0]} ({row[1]})" for row in rows])
        raise ValueError(f"CAMERA_ID: expected exactly one camera that can be read, got ids {ids}")
    identifier, name, width, height, *values = readable[0]
    model, places = _MODELS[name]
    camera = Section({"WIDTH": width, "HEIGHT": height, "PARAMS": values}, f"camera {identifier} ")
    found = camera.numbers("PARAMS", count=max(places) + 1)
    fx, fy, cx, cy, *coefficients = [found[place] for place in places]
    intrinsics = [fx, fy, cx - COLMAP_PIXEL_CENTRE, cy - COLMAP_PIXEL_CENTRE]
    size = camera.number("WIDTH"), camera.number("HEIGHT")
    if model == BROWN_CONRADY:
        return brown_conrady(size, intrinsics, [*coefficients, *[0.0] * (8 - len(coefficients))])
    return Lens(model, size, with_zeros(model, [*intrinsics, *coefficients]))


def colmap_text(camera: CameraFile, suffix: str) -> str:
    """A cameras.txt of one camera, with COLMAP's own heading."""
    fx, fy, cx, cy, *coefficients = camera.params
    params = [fx, fy, cx + COLMAP_PIXEL_CENTRE, cy + COLMAP_PIXEL_CENTRE, *coefficients]
    model = "OPENCV_FISHEYE" if camera.model == KANNALA_BRANDT else "PINHOLE"
    line = " ".join(["1", model, str(camera.width), str(camera.height), *map(repr, params)])
    return (
        "# Camera list with one line of data per camera:\n"
        "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
        f"# Number of cameras: 1\n{line}\n"
    )
