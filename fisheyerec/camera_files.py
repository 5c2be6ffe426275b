"""Reads and writes lens files: the house's JSON and YAML, OpenCV, kalibr, COLMAP and gyroflow.

Every format is read into one plain record, `CameraFile`, in the house's order and pixel convention
(integer coordinates are pixel centres). Formats are told apart by what a file holds, not by its
suffix. Nothing here knows about tensors or cameras, and PyYAML is imported only where YAML is met.

A new format is one `_parse_*` function and one row of `_FORMATS`.
"""

from __future__ import annotations

import importlib
import json
import math
import os
import re
import reprlib
import textwrap
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from numbers import Real
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

from .pixel import HALF_PIXEL

__all__ = ["COLMAP_PIXEL_CENTRE", "CameraFile", "read_camera_file", "write_camera_file"]

# COLMAP puts the image's corner at (0, 0), hence the centre of the first pixel at (0.5, 0.5). The
# house, like OpenCV, kalibr and gyroflow, puts that centre at (0, 0): cx and cy differ by this.
COLMAP_PIXEL_CENTRE = HALF_PIXEL

_KANNALA_BRANDT = "kannala_brandt"
_PINHOLE = "pinhole"
_PARAMETERS = {
    _KANNALA_BRANDT: ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
    _PINHOLE: ("fx", "fy", "cx", "cy"),
}

# Lens files are small: a film named by mistake is refused before it is read whole.
_MAX_BYTES = 16 * 1024 * 1024

# A message may quote the file: it stays one readable line even where that holds a page of text.
_MAX_MESSAGE = 400

# Rounding dust in a camera matrix, in pixels; a real skew is refused rather than dropped silently.
_MATRIX_TOLERANCE = 1e-6


@dataclass(frozen=True)
class CameraFile:
    """One camera as a lens file tells it, the same for every format."""

    model: str
    """`"kannala_brandt"` or `"pinhole"`."""
    width: int
    height: int
    params: tuple[float, ...]
    """fx, fy, cx, cy, and for kannala_brandt k1, k2, k3, k4."""


def read_camera_file(path: str | os.PathLike[str], *, image_size: tuple[int, int] | None = None) -> CameraFile:
    """Reads a camera from a lens file of any known format.

    `image_size` is (height, width); it is used only where the file does not hold the size.

    Raises ValueError, in one line naming the file and the key, if the file is not text, not a known
    format, misses a key, holds a value that makes no camera, or another lens model; RuntimeError if
    it is YAML and PyYAML is not installed; OSError if the file cannot be read.
    """
    with _named_errors("read_camera_file", path):
        lens = _parse_text(_read_text(path))
        width, height = lens.size or _given_size(image_size)
        return _checked(lens.model, width, height, lens.params)


def write_camera_file(path: str | os.PathLike[str], camera_file: CameraFile) -> None:
    """Writes a camera in the house's format, JSON or YAML by suffix, exact to the last bit.

    The file appears whole or not at all: an older file of that name stays until the new one is
    complete.

    Raises ValueError for another suffix or for a record that makes no camera; RuntimeError if it
    is YAML and PyYAML is not installed; OSError if the file cannot be written.
    """
    with _named_errors("write_camera_file", path):
        suffix = Path(path).suffix.lower()
        if suffix not in _HOUSE_WRITERS:
            raise ValueError(f"suffix: expected {', '.join(_HOUSE_WRITERS)}, got {suffix!r}")
        checked = _checked(camera_file.model, camera_file.width, camera_file.height, camera_file.params)
        entries = {"model": checked.model, "width": checked.width, "height": checked.height}
        parameters = dict(zip(_PARAMETERS[checked.model], checked.params, strict=True))
        text = _HOUSE_WRITERS[suffix]({**entries, **parameters})
    _replace_text(Path(path), text)


# --- From bytes to entries ------------------------------------------------------------------------


@contextmanager
def _named_errors(function: str, path: str | os.PathLike[str]) -> Iterator[None]:
    """Puts the function and the file before an error's message, and keeps it on one line."""
    try:
        yield
    except (ValueError, RuntimeError) as error:
        message = textwrap.shorten(str(error), _MAX_MESSAGE, placeholder=" ...")
        kind = RuntimeError if isinstance(error, RuntimeError) else ValueError
        raise kind(f"{function}(): {os.fspath(path)!r}: {message}") from None


def _read_text(path: str | os.PathLike[str]) -> str:
    """Reads a small text file; raises ValueError if it is large or not UTF-8 text."""
    with open(path, "rb") as stream:
        data = stream.read(_MAX_BYTES + 1)
    if len(data) > _MAX_BYTES:
        raise ValueError(f"expected a lens file of at most {_MAX_BYTES} bytes, got a larger file")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise ValueError("expected UTF-8 text, got a binary file") from None
    if "\0" in text:  # valid UTF-8, but no lens format holds it
        raise ValueError("expected UTF-8 text, got a binary file")
    return text


def _load_entries(text: str) -> object:
    """Parses JSON or YAML into dicts, lists and scalars; raises ValueError if it is neither."""
    start = text.lstrip()
    if start.startswith("<"):
        raise ValueError("expected JSON, YAML or COLMAP text, got XML (OpenCV can write .yml)")
    if start.startswith("{"):
        try:
            return json.loads(text)
        except (ValueError, RecursionError) as error:
            raise ValueError(f"expected JSON, got text its parser refuses: {error}") from None
    yaml = _import_yaml()
    # OpenCV up to 4 writes this header, which is no YAML directive.
    text = re.sub(r"\A\s*%YAML:.*", "", text)
    try:
        # BaseLoader leaves every scalar as text and passes over tags such as !!opencv-matrix: no
        # object is ever built, and YAML 1.1's surprises (1e-5 is text, 0640 is octal) do not occur.
        return yaml.load(text, Loader=yaml.BaseLoader)
    except (yaml.YAMLError, RecursionError) as error:
        problem, mark = getattr(error, "problem", error), getattr(error, "problem_mark", None)
        place = f" (line {mark.line + 1})" if mark else ""
        raise ValueError(f"expected YAML, got text its parser refuses: {problem}{place}") from None


def _import_yaml() -> ModuleType:
    """Imports PyYAML; raises RuntimeError if it is not installed."""
    try:
        return importlib.import_module("yaml")
    except ImportError:
        raise RuntimeError("YAML: expected PyYAML to be installed, got no module yaml") from None


# --- From entries to numbers ----------------------------------------------------------------------


def _number(value: object, key: str) -> float:
    """Converts one scalar (YAML's are text); raises ValueError if it is not a finite number."""
    number = math.nan
    if isinstance(value, str | Real) and not isinstance(value, bool):
        with suppress(ValueError, OverflowError):  # refused below, with all that is not finite
            number = float(value)
    if not math.isfinite(number):
        raise ValueError(f"{key}: expected a finite number, got {reprlib.repr(value)}")
    return number


class _Section:
    """A mapping in a file and where it stands there, so that errors name the whole key."""

    def __init__(self, entries: object, prefix: str = "") -> None:
        if not isinstance(entries, dict):
            place = prefix.rstrip(".") or "top level"
            raise ValueError(f"{place}: expected keys with values, got {reprlib.repr(entries)}")
        self.entries: dict[str, Any] = entries
        self.prefix = prefix

    def __contains__(self, key: str) -> bool:
        return key in self.entries

    def find(self, *keys: str) -> tuple[str, Any]:
        """The full name and the value of the first key there is; raises ValueError for none."""
        for key in keys:
            if key in self.entries:
                return self.prefix + key, self.entries[key]
        wanted = " or ".join(repr(self.prefix + key) for key in keys)
        raise ValueError(f"expected key {wanted}, got {_listed(self.entries)}")

    def section(self, key: str) -> _Section:
        """The mapping under a key; raises ValueError if there is none."""
        name, value = self.find(key)
        return _Section(value, prefix=f"{name}.")

    def text(self, key: str, default: str | None = None) -> str:
        """The words under a key, or the default for none or null; raises ValueError otherwise."""
        if default is not None and self.entries.get(key) is None:
            return default
        name, value = self.find(key)
        if not isinstance(value, str):
            raise ValueError(f"{name}: expected text, got {reprlib.repr(value)}")
        return value

    def number(self, *keys: str) -> float:
        """The number under the first key there is; raises ValueError if it is not one."""
        name, value = self.find(*keys)
        return _number(value, name)

    def numbers(self, *keys: str, count: int | None = None) -> list[float]:
        """The numbers of a list, nested rows or OpenCV matrix; raises ValueError if not `count`."""
        name, value = self.find(*keys)
        if isinstance(value, dict) and "data" in value:
            name, value = f"{name}.data", value["data"]
        if not isinstance(value, list):
            raise ValueError(f"{name}: expected a list of numbers, got {reprlib.repr(value)}")
        flat = [item for row in value for item in (row if isinstance(row, list) else [row])]
        if count is not None and len(flat) != count:
            raise ValueError(f"{name}: expected {count} numbers, got {len(flat)}")
        return [_number(item, f"{name}[{index}]") for index, item in enumerate(flat)]

    def camera_matrix(self, *keys: str) -> list[float]:
        """fx, fy, cx, cy of a 3x3 camera matrix; raises ValueError if it holds a skew."""
        values = self.numbers(*keys, count=9)
        fx, _, cx, _, fy, cy, *_ = values
        plain = [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]
        if any(abs(a - b) > _MATRIX_TOLERANCE for a, b in zip(values, plain, strict=True)):
            name, _ = self.find(*keys)
            raise ValueError(f"{name}: expected fx 0 cx, 0 fy cy, 0 0 1 (no skew), got {values}")
        return [fx, fy, cx, cy]


def _listed(items: Sequence[str] | dict[str, Any]) -> str:
    """The first few items in one line, for an error."""
    shown = [str(item) for item in items][:8]
    more = f", ... ({len(items)} in all)" if len(items) > len(shown) else ""
    return (", ".join(shown) + more) or "none"


# --- The formats ----------------------------------------------------------------------------------


class _Lens(NamedTuple):
    """What one format's function finds; `_checked` makes the record of it."""

    model: str
    size: tuple[float, float] | None  # (width, height)
    params: list[float]


def _other_model(model: str) -> ValueError:
    """The error for a lens model that is known, or not, but cannot be read."""
    known = " or ".join(_PARAMETERS)
    return ValueError(f"model: expected {known}, which alone can be read, got {model}")


def _parse_house(file: _Section) -> _Lens:
    """The house's own format; raises ValueError if it does not hold a camera."""
    model = file.text("model")
    if model not in _PARAMETERS:
        raise _other_model(model)
    size = file.number("width"), file.number("height")
    return _Lens(model, size, [file.number(name) for name in _PARAMETERS[model]])


# What distortion_model may say of four coefficients: OpenCV's word, and the one of ROS, whose
# camera_info files share OpenCV's layout.
_OPENCV_FISHEYE_NAMES = ("fisheye", "equidistant")
_OPENCV_RADTAN_COUNTS = (5, 8, 12, 14)


def _parse_opencv(file: _Section) -> _Lens:
    """OpenCV FileStorage; raises ValueError if it does not hold a fisheye camera.

    Four coefficients are taken for cv2.fisheye's, unless the file says otherwise: they might also
    be the pinhole model's k1, k2, p1, p2, and nothing in their number tells.
    """
    model = file.text("distortion_model", default=_OPENCV_FISHEYE_NAMES[0])
    if model not in _OPENCV_FISHEYE_NAMES:
        raise _other_model(model)
    coefficients = ("dist_coeffs", "D", "distortion_coefficients")
    count = len(file.numbers(*coefficients))
    # The flag fisheye_model is what OpenCV's calibration sample writes.
    is_fisheye = "fisheye_model" not in file or file.number("fisheye_model") != 0
    if count in _OPENCV_RADTAN_COUNTS or not is_fisheye:
        raise _other_model(f"radtan (OpenCV's pinhole model with {count} coefficients)")
    size = None
    if "resolution" in file:
        width, height = file.numbers("resolution", count=2)
        size = width, height
    elif "image_width" in file or "image_height" in file:
        size = file.number("image_width"), file.number("image_height")
    params = file.camera_matrix("camera_matrix", "K") + file.numbers(*coefficients, count=4)
    return _Lens(_KANNALA_BRANDT, size, params)


_KALIBR_MODELS = {"pinhole-equidistant": _KANNALA_BRANDT, "pinhole-none": _PINHOLE}


def _kalibr_cameras(file: _Section) -> list[str]:
    """The names of a camchain's cameras, cam0 first if it is there."""
    names = [key for key in file.entries if re.fullmatch(r"cam\d+", key)]
    return sorted(names, key=lambda name: name != "cam0")


def _parse_kalibr(file: _Section) -> _Lens:
    """kalibr camchain, its first camera; raises ValueError if that is not a readable camera."""
    camera = file.section(_kalibr_cameras(file)[0])
    kind = f"{camera.text('camera_model')}-{camera.text('distortion_model', default='none')}"
    if kind not in _KALIBR_MODELS:
        raise _other_model(kind)
    model = _KALIBR_MODELS[kind]
    params = camera.numbers("intrinsics", count=4)
    if model == _KANNALA_BRANDT:
        params += camera.numbers("distortion_coeffs", count=4)
    width, height = camera.numbers("resolution", count=2)
    return _Lens(model, (width, height), params)


def _parse_gyroflow(file: _Section) -> _Lens:
    """gyroflow lens profile; raises ValueError if its lens is not OpenCV's fisheye alone.

    The camera holds for pictures of calib_dimension: after input_horizontal_stretch, where the
    profile has one.
    """
    model = file.text("distortion_model", default="opencv_fisheye")
    digital = file.text("digital_lens", default="")
    if model != "opencv_fisheye" or digital:  # a digital lens bends the picture a second time
        raise _other_model(f"{model} with digital lens {digital}" if digital else model)
    size = file.section("calib_dimension")
    lens = file.section("fisheye_params")
    params = lens.camera_matrix("camera_matrix") + lens.numbers("distortion_coeffs", count=4)
    return _Lens(_KANNALA_BRANDT, (size.number("w"), size.number("h")), params)


# The parameter that gives a model away in fisheye-calib-adapter files, which never name it; the
# most telling first.
_ADAPTER_MODELS = {
    "coefficients": "OCam",
    "beta": "EUCM",
    "xi": "DS (double sphere)",
    "alpha": "UCM",
    "p1": "radtan",
    "k1": _KANNALA_BRANDT,
    "fx": _PINHOLE,
}


def _parse_adapter(file: _Section) -> _Lens:
    """fisheye-calib-adapter YAML; raises ValueError if its parameters are another model's."""
    parameter, image = file.section("parameter"), file.section("image")
    model = next((name for key, name in _ADAPTER_MODELS.items() if key in parameter), _PINHOLE)
    if model not in _PARAMETERS:
        raise _other_model(model)
    size = image.number("width"), image.number("height")
    return _Lens(model, size, [parameter.number(name) for name in _PARAMETERS[model]])


# The house's model, and where its parameters stand in COLMAP's PARAMS[].
_COLMAP_MODELS = {
    "OPENCV_FISHEYE": (_KANNALA_BRANDT, (0, 1, 2, 3, 4, 5, 6, 7)),
    "PINHOLE": (_PINHOLE, (0, 1, 2, 3)),
    "SIMPLE_PINHOLE": (_PINHOLE, (0, 0, 1, 2)),
}


def _colmap_rows(text: str) -> list[list[str]]:
    """The lines of a cameras.txt split into fields, without comments."""
    lines = (line.strip() for line in text.splitlines())
    return [line.split() for line in lines if line and not line.startswith("#")]


def _is_colmap(text: str) -> bool:
    """Whether the first line that is no comment reads CAMERA_ID MODEL ..."""
    rows = _colmap_rows(text)
    return bool(rows) and bool(re.match(r"\d+ [A-Z][A-Z0-9_]*( |$)", " ".join(rows[0])))


def _parse_colmap(text: str) -> _Lens:
    """COLMAP cameras.txt; raises ValueError unless exactly one of its cameras can be read."""
    rows = _colmap_rows(text)
    for row in rows:
        if len(row) < 5:
            got = reprlib.repr(" ".join(row))
            raise ValueError(f"expected lines CAMERA_ID MODEL WIDTH HEIGHT PARAMS[], got {got}")
    readable = [row for row in rows if row[1] in _COLMAP_MODELS]
    if len(readable) != 1:
        if len(rows) == 1:
            raise _other_model(rows[0][1])
        ids = _listed([f"{row[0]} ({row[1]})" for row in rows])
        raise ValueError(f"CAMERA_ID: expected exactly one camera of {', '.join(_COLMAP_MODELS)}, got ids {ids}")
    identifier, name, width, height, *values = readable[0]
    model, places = _COLMAP_MODELS[name]
    camera = _Section({"WIDTH": width, "HEIGHT": height, "PARAMS": values}, f"camera {identifier} ")
    found = camera.numbers("PARAMS", count=max(places) + 1)
    fx, fy, cx, cy, *coefficients = [found[place] for place in places]
    centre = [cx - COLMAP_PIXEL_CENTRE, cy - COLMAP_PIXEL_CENTRE]
    size = camera.number("WIDTH"), camera.number("HEIGHT")
    return _Lens(model, size, [fx, fy, *centre, *coefficients])


class _Format(NamedTuple):
    name: str
    recognises: Callable[[_Section], object]
    parse: Callable[[_Section], _Lens]


# The first row that recognises a file reads it. The house's comes last: `model` is a common word.
_FORMATS = (
    _Format("gyroflow profile", lambda file: "fisheye_params" in file, _parse_gyroflow),
    _Format("kalibr camchain", _kalibr_cameras, _parse_kalibr),
    _Format("OpenCV (camera_matrix)", lambda f: "camera_matrix" in f or "K" in f, _parse_opencv),
    _Format("fisheye-calib-adapter", lambda file: "parameter" in file, _parse_adapter),
    _Format("fisheyerec (model, fx)", lambda f: "model" in f or "fx" in f, _parse_house),
)


def _parse_text(text: str) -> _Lens:
    """Parses the text of a lens file of any format; raises ValueError if it is none."""
    if _is_colmap(text):
        return _parse_colmap(text)
    entries = _load_entries(text)
    if entries is None:  # no character, or nothing but comments
        raise ValueError("expected a camera, got an empty file")
    file = _Section(entries)
    for kind in _FORMATS:
        if kind.recognises(file):
            return kind.parse(file)
    known = ", ".join(kind.name for kind in _FORMATS)
    got = _listed(file.entries)
    raise ValueError(f"expected a COLMAP cameras.txt or the keys of one of: {known}; got {got}")


# --- The record, and the way back to a file -------------------------------------------------------


def _given_size(image_size: tuple[int, int] | None) -> tuple[int, int]:
    """(width, height) of the caller's (height, width); raises ValueError if there is none."""
    if image_size is None:
        raise ValueError("expected image_size=(height, width), as the file holds no size, got None")
    if len(image_size) != 2:
        raise ValueError(f"image_size: expected (height, width), got {reprlib.repr(image_size)}")
    height, width = image_size
    return width, height


def _checked(model: str, width: float, height: float, params: Sequence[float]) -> CameraFile:
    """The record of these values; raises ValueError if they make no camera."""
    if model not in _PARAMETERS:
        raise _other_model(model)
    names = _PARAMETERS[model]
    if len(params) != len(names):
        raise ValueError(f"params: expected {', '.join(names)}, got {len(params)} numbers")
    numbers = tuple(_number(value, name) for name, value in zip(names, params, strict=True))
    for name, value in zip(("fx", "fy"), numbers, strict=False):
        if value <= 0:
            raise ValueError(f"{name}: expected a positive number, got {value}")
    sides = {name: _number(side, name) for name, side in (("width", width), ("height", height))}
    for name, side in sides.items():
        if side < 1 or not side.is_integer():
            raise ValueError(f"{name}: expected a positive whole number, got {side:g}")
    return CameraFile(model, int(sides["width"]), int(sides["height"]), numbers)


def _json_text(entries: dict[str, Any]) -> str:
    """The house's JSON."""
    return json.dumps(entries, indent=1) + "\n"


def _yaml_text(entries: dict[str, Any]) -> str:
    """The house's YAML; raises RuntimeError if PyYAML is not installed."""
    return str(_import_yaml().safe_dump(entries, sort_keys=False))


_HOUSE_WRITERS: dict[str, Callable[[dict[str, Any]], str]] = {
    ".json": _json_text,
    ".yaml": _yaml_text,
    ".yml": _yaml_text,
}


def _replace_text(path: Path, text: str) -> None:
    """Writes the file whole or not at all; raises OSError if it cannot be written."""
    # Not tempfile: its files are private to the user (0600), and os.replace would keep that.
    temporary = path.with_name(f".camera-{os.urandom(8).hex()}.tmp")
    try:
        with open(temporary, "x", encoding="utf-8", newline="\n") as stream:
            stream.write(text)
            stream.flush()
            os.fsync(stream.fileno())  # else a power cut may leave the new name with no content
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)  # gone already where the replacing succeeded
