"""gyroflow's lens profiles; source: its lens_profile.rs, for the keys, and distortion_models, for their meaning."""

from __future__ import annotations

from .entries import Section, json_text
from .record import KANNALA_BRANDT, PINHOLE, CameraFile, Lens, brown_conrady, other_model

_FISHEYE, _STANDARD = "opencv_fisheye", "opencv_standard"


def parse_gyroflow(file: Section) -> Lens:
    """gyroflow lens profile; raises ValueError if its lens is not one of OpenCV's models alone.

    The camera holds for pictures of calib_dimension: after input_horizontal_stretch, where the
    profile has one.
    """
    model = file.text("distortion_model", default=_FISHEYE)
    digital = file.text("digital_lens", default="")
    if model not in (_FISHEYE, _STANDARD) or digital:  # a digital lens bends the picture a second time
        raise other_model(f"{model} with digital lens {digital}" if digital else model, (_FISHEYE, _STANDARD))
    dimension = file.section("calib_dimension")
    size = dimension.number("w"), dimension.number("h")
    lens = file.section("fisheye_params")
    intrinsics = lens.camera_matrix("camera_matrix")
    if model == _STANDARD:
        return brown_conrady(size, intrinsics, lens.numbers("distortion_coeffs"))
    return Lens(KANNALA_BRANDT, size, [*intrinsics, *lens.numbers("distortion_coeffs", count=4)])


def gyroflow_text(camera: CameraFile, suffix: str) -> str:
    """JSON of a profile with what gyroflow asks of one; brand, model and read-out time are the user's to add."""
    fx, fy, cx, cy, *coefficients = camera.params
    size = {"w": camera.width, "h": camera.height}
    return json_text(
        {
            "name": "",
            "camera_brand": "",
            "camera_model": "",
            "lens_model": "",
            "calib_dimension": size,
            "orig_dimension": size,
            "input_horizontal_stretch": 1.0,
            "input_vertical_stretch": 1.0,
            "distortion_model": _STANDARD if camera.model == PINHOLE else _FISHEYE,
            "fisheye_params": {
                "RMS_error": 0.0,
                "camera_matrix": [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]],
                "distortion_coeffs": coefficients or [0.0] * 4,
            },
            "calibrator_version": "fisheyerec",
        }
    )
