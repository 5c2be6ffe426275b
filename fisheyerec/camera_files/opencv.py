"""OpenCV's FileStorage and the camera_info of ROS, which share the names of their keys and the order of coefficients.

Sources: OpenCV's samples calibration.cpp (fisheye_model) and omni_calibration.cpp (xi); ROS sensor_msgs/CameraInfo,
whose messages, printed, have the keys K and D (ROS 1) or k and d (ROS 2), and camera_calibration_parsers.
"""

from __future__ import annotations

from typing import Any

from .entries import Section, json_text, yaml_text
from .record import KANNALA_BRANDT, PINHOLE, UNIFIED, CameraFile, Lens, brown_conrady, other_model

_MATRIX = ("camera_matrix", "K", "k")
_COEFFICIENTS = ("dist_coeffs", "D", "distortion_coefficients", "d")

# What distortion_model may say: OpenCV's word and that of ROS for one model, and ROS's two for the other.
_FISHEYE_NAMES = ("fisheye", "equidistant")
_BROWN_CONRADY_NAMES = ("plumb_bob", "rational_polynomial")


def has_camera_matrix(file: Section) -> bool:
    """Whether there is a camera matrix under one of its names."""
    return any(key in file for key in _MATRIX)


def parse_opencv(file: Section) -> Lens:
    """OpenCV FileStorage or ROS camera_info; raises ValueError if it does not hold a camera.

    Four coefficients are taken for cv2.fisheye's, unless the file says otherwise: they might also
    be the pinhole model's k1, k2, p1, p2, and nothing in their number tells.
    """
    size, intrinsics = _size(file), file.camera_matrix(*_MATRIX)
    coefficients = file.numbers(*_COEFFICIENTS)
    if "xi" in file:  # cv2.omnidir, which writes a matrix of one number
        _, value = file.find("xi")
        xi = file.numbers("xi", count=1) if isinstance(value, dict | list) else [file.number("xi")]
        return Lens(UNIFIED, size, [*intrinsics, *xi, *file.numbers(*_COEFFICIENTS, count=4)])
    if _is_fisheye(file, len(coefficients)):
        return Lens(KANNALA_BRANDT, size, [*intrinsics, *file.numbers(*_COEFFICIENTS, count=4)])
    try:
        return brown_conrady(size, intrinsics, coefficients)
    except ValueError as error:
        name, _ = file.find(*_COEFFICIENTS)
        raise ValueError(f"{name}: {error}") from None


def _is_fisheye(file: Section, count: int) -> bool:
    """Whether the coefficients are cv2.fisheye's; raises ValueError if they are of neither known model."""
    named = file.text("distortion_model", default="")
    if named and named not in (*_FISHEYE_NAMES, *_BROWN_CONRADY_NAMES):
        raise other_model(named, (*_FISHEYE_NAMES, *_BROWN_CONRADY_NAMES))
    if named:
        return named in _FISHEYE_NAMES
    if "fisheye_model" in file:
        return file.number("fisheye_model") != 0
    return count == 4


def _size(file: Section) -> tuple[float, float] | None:
    """(width, height), or None where there is none; raises ValueError for half of it."""
    if "resolution" in file:
        width, height = file.numbers("resolution", count=2)
        return width, height
    for names in (("image_width", "image_height"), ("width", "height")):
        if any(name in file for name in names):
            return file.number(names[0]), file.number(names[1])
    return None


def opencv_text(camera: CameraFile, suffix: str) -> str:
    """FileStorage as OpenCV's calibration sample writes it, JSON or YAML by suffix."""
    fx, fy, cx, cy, *coefficients = camera.params
    matrix = [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]
    coefficients = coefficients or [0.0] * 5
    flag = int(camera.model == KANNALA_BRANDT)
    sizes = {"image_width": camera.width, "image_height": camera.height}
    matrices = {
        "camera_matrix": {"rows": 3, "cols": 3, "dt": "d", "data": matrix},
        "distortion_coefficients": {"rows": len(coefficients), "cols": 1, "dt": "d", "data": coefficients},
    }
    if suffix == ".json":
        typed = {name: {"type_id": "opencv-matrix", **value} for name, value in matrices.items()}
        return json_text({**sizes, **typed, "fisheye_model": flag})
    # Header and tags as OpenCV up to 4 writes them, which later ones read.
    text = yaml_text({**sizes, **matrices, "fisheye_model": flag})
    for name in matrices:
        text = text.replace(f"{name}:\n", f"{name}: !!opencv-matrix\n")
    return f"%YAML:1.0\n---\n{text}"


def ros_text(camera: CameraFile, suffix: str) -> str:
    """YAML of a camera_info, as camera_calibration_parsers reads and writes it."""
    fx, fy, cx, cy, *coefficients = camera.params
    coefficients = coefficients or [0.0] * 5

    def matrix(rows: int, cols: int, data: list[float]) -> dict[str, Any]:
        return {"rows": rows, "cols": cols, "data": data}

    return yaml_text(
        {
            "image_width": camera.width,
            "image_height": camera.height,
            "camera_name": "camera",
            "camera_matrix": matrix(3, 3, [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]),
            "distortion_model": "plumb_bob" if camera.model == PINHOLE else "equidistant",
            "distortion_coefficients": matrix(1, len(coefficients), coefficients),
            "rectification_matrix": matrix(3, 3, [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]),
            "projection_matrix": matrix(3, 4, [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]),
        }
    )
