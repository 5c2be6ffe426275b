"""One camera in the words of every lens file that is read, for the tests of those."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from fisheyerec.camera_files import (
    CameraFile,
    read_camera_file,
)
from fisheyerec.camera_files.record import PARAMETERS

KB = CameraFile("kannala_brandt", 640, 480, (301.5, 302.25, 319.75, 240.5, 0.125, -0.0625, 1e-05, -0.03125))
PINHOLE = CameraFile("pinhole", 640, 480, (301.5, 302.25, 319.75, 240.5))

HOUSE_JSON = """{"model": "kannala_brandt", "width": 640, "height": 480, "fx": 301.5, "fy": 302.25,
 "cx": 319.75, "cy": 240.5, "k1": 0.125, "k2": -0.0625, "k3": 1e-05, "k4": -0.03125,
 "source": "by hand"}"""

HOUSE_YAML = """\
# a comment
model: kannala_brandt
width: 640
height: 480
fx: 301.5
fy: 302.25
cx: 319.75
cy: 240.5
k1: 0.125
k2: -0.0625
k3: 1e-05
k4: -0.03125
source: by hand
"""

HOUSE_PINHOLE = """{"model": "pinhole", "width": 640, "height": 480,
 "fx": 301.5, "fy": 302.25, "cx": 319.75, "cy": 240.5}"""

OPENCV = """\
%YAML:1.0
---
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 3.015e+02, 0., 3.1975e+02, 0., 3.0225e+02, 2.405e+02, 0., 0.,
       1. ]
dist_coeffs: !!opencv-matrix
   rows: 4
   cols: 1
   dt: d
   data: [ 1.25e-01, -6.25e-02, 1e-05, -3.125e-02 ]
resolution: !!opencv-matrix
   rows: 2
   cols: 1
   dt: i
   data: [ 640, 480 ]
"""

# OpenCV 5's header, the names of K and D, one row of coefficients, the size in two keys.
OPENCV_K_D = """\
%YAML 1.2
---
image_width: 640
image_height: 480
K: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 301.5, 0., 319.75, 0., 302.25, 240.5, 0., 0., 1. ]
D: !!opencv-matrix
   rows: 1
   cols: 4
   dt: d
   data: [ 0.125, -0.0625, 1e-05, -0.03125 ]
"""

OPENCV_SAMPLE = OPENCV.replace("dist_coeffs", "distortion_coefficients") + "fisheye_model: 1\n"

OPENCV_JSON = """{
    "image_width": 640, "image_height": 480,
    "camera_matrix": {"type_id": "opencv-matrix", "rows": 3, "cols": 3, "dt": "d",
        "data": [ 301.5, 0.0, 319.75, 0.0, 302.25, 240.5, 0.0, 0.0, 1.0 ]},
    "dist_coeffs": {"type_id": "opencv-matrix", "rows": 4, "cols": 1, "dt": "d",
        "data": [ 0.125, -0.0625, 1e-05, -0.03125 ]}
}"""

ROS = """\
image_width: 640
image_height: 480
camera_name: left
camera_matrix: {rows: 3, cols: 3, data: [301.5, 0, 319.75, 0, 302.25, 240.5, 0, 0, 1]}
distortion_model: equidistant
distortion_coefficients: {rows: 1, cols: 4, data: [0.125, -0.0625, 1e-05, -0.03125]}
"""

KALIBR = """\
cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [0.125, -0.0625, 1e-05, -0.03125]
  distortion_model: equidistant
  intrinsics: [301.5, 302.25, 319.75, 240.5]
  resolution: [640, 480]
  rostopic: /cam0/image_raw
cam1:
  camera_model: omni
  distortion_coeffs: [0.0, 0.0, 0.0, 0.0]
  distortion_model: radtan
  intrinsics: [1.0, 301.5, 302.25, 319.75, 240.5]
  resolution: [640, 480]
"""

KALIBR_PINHOLE = """\
cam3:
  camera_model: pinhole
  distortion_coeffs: []
  distortion_model: none
  intrinsics: [301.5, 302.25, 319.75, 240.5]
  resolution: [640, 480]
"""

COLMAP = """\
# Camera list with one line of data per camera:
#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]
# Number of cameras: 1
7 OPENCV_FISHEYE 640 480 301.5 302.25 320.25 241 0.125 -0.0625 1e-05 -0.03125
"""

COLMAP_TWO = COLMAP + "8 EQUIRECTANGULAR 640 480 640 480\n"
COLMAP_PINHOLE = "1 PINHOLE 640 480 301.5 302.25 320.25 241\n"
COLMAP_SIMPLE = "1 SIMPLE_PINHOLE 640 480 301.5 320.25 241\n"

GYROFLOW = """{
  "name": "somebody's lens", "camera_model": "HERO", "lens_model": "Wide", "note": "",
  "calib_dimension": {"w": 640, "h": 480}, "orig_dimension": {"w": 1280, "h": 960},
  "input_horizontal_stretch": 1.0, "num_images": 12, "digital_lens": null,
  "fisheye_params": {"RMS_error": 0.5,
    "camera_matrix": [[301.5, 0.0, 319.75], [0.0, 302.25, 240.5], [0.0, 0.0, 1.0]],
    "distortion_coeffs": [0.125, -0.0625, 1e-05, -0.03125]}
}"""

ADAPTER = """\
image:
  width: 640
  height: 480
parameter:
  fx: 301.5
  fy:  302.25
  cx: 319.75
  cy: 240.5
"""
ADAPTER_KB = ADAPTER + "  k1: 0.125\n  k2: -0.0625\n  k3: 1e-05\n  k4: -0.03125\n"

ADAPTER_OCAM = """\
image: {width: 640, height: 480}
parameter:
  c: 0.75
  d: 0.0625
  e: 0.125
  cx: 319.75
  cy: 240.5
  coefficients:
    projection: [287.5, 140]
    unprojection: [200.0, 0, -0.002, 5e-06]
"""

# x down the rows, y along the columns, z backwards: the house turns all three.
OCAMCALIB = """\
#polynomial coefficients for the DIRECT mapping function (ocam_model.ss in MATLAB). These are used by cam2world

4 -2.000000e+02 0.000000e+00 2.000000e-03 -5.000000e-06

#polynomial coefficients for the inverse mapping function (ocam_model.invpol in MATLAB). These are used by world2cam

2 287.5 140.0

#center: "row" and "column", starting from 0 (C convention)

240.5 319.75

#affine parameters "c", "d", "e"

0.75 0.0625 0.125

#image size: "height" and "width"

480 640
"""

OMNIDIR = OPENCV.replace("resolution", "xi: !!opencv-matrix { rows: 1, cols: 1, dt: d, data: [ 1.5 ] }\nresolution")


def lens(model: str, *params: float) -> CameraFile:
    """The camera of KB's intrinsics, or of none, in another model, with zeros for what a format leaves out."""
    missing = len(PARAMETERS[model]) - 4 - len(params)
    return CameraFile(model, 640, 480, (*PINHOLE.params, *params, *[0.0] * missing))


def with_coefficients(text: str, *coefficients: float) -> str:
    """An OpenCV or ROS file with other coefficients."""
    return re.sub(r"\[ ?(1.25e-01|0.125),[^]]*\]", str(list(coefficients)), text)


def colmap_line(model: str, *params: float) -> str:
    return " ".join(["1", model, "640", "480", *map(str, params)])


def kalibr(camera: str, distortion: str, intrinsics: list[float], coefficients: list[float]) -> str:
    return (
        f"cam0:\n  camera_model: {camera}\n  distortion_model: {distortion}\n  intrinsics: {intrinsics}\n"
        f"  distortion_coeffs: {coefficients}\n  resolution: [640, 480]\n"
    )


def camodocal(model: str, *names: str) -> str:
    return (
        f"%YAML:1.0\n---\nmodel_type: {model}\ncamera_name: left\nimage_width: 640\nimage_height: 480\n"
        "distortion_parameters:\n   k1: 0.125\n   k2: -0.0625\n   p1: 1e-05\n   p2: -0.03125\nprojection_parameters:\n"
        + "".join(f"   {name}: {value}\n" for name, value in zip(names, PINHOLE.params, strict=True))
    )


RADTAN = (0.125, -0.0625, 1e-05, -0.03125)
RATIONAL = (*RADTAN, 0.5, 0.25, 0.375, 0.75)
PRISM = (*RATIONAL, 1e-3, 2e-3, 3e-3, 4e-3)
FU, PIXEL = [301.5, 302.25, 319.75, 240.5], (301.5, 302.25, 320.25, 241.0)
POLYNOMIAL = (200.0, 0.0, -0.002, 5e-06, *[0.0] * 6)

READ_OTHER_MODELS = {
    "opencv, 5 coefficients": (with_coefficients(OPENCV, *RATIONAL[:5]), lens("brown_conrady", *RATIONAL[:5])),
    "opencv, 8 coefficients": (with_coefficients(OPENCV, *RATIONAL), lens("brown_conrady", *RATIONAL)),
    "opencv, 12 coefficients": (with_coefficients(OPENCV, *PRISM), lens("brown_conrady", *PRISM)),
    "opencv, 14 coefficients": (with_coefficients(OPENCV, *PRISM, 0, 0), lens("brown_conrady", *PRISM)),
    "opencv, flag 0": (OPENCV_SAMPLE.replace("model: 1", "model: 0"), lens("brown_conrady", *RADTAN)),
    "opencv, all 0": (with_coefficients(OPENCV, *[0.0] * 5), PINHOLE),
    "omnidir": (OMNIDIR, lens("unified", 1.5, *RADTAN)),
    "omnidir, plain xi": (OPENCV_K_D + "xi: 1.5\n", lens("unified", 1.5, *RADTAN)),
    "ros plumb_bob": (
        with_coefficients(ROS, *RATIONAL[:5]).replace("equidistant", "plumb_bob"),
        lens("brown_conrady", *RATIONAL[:5]),
    ),
    "ros rational_polynomial": (
        with_coefficients(ROS, *RATIONAL).replace("equidistant", "rational_polynomial"),
        lens("brown_conrady", *RATIONAL),
    ),
    "ros plumb_bob without coefficients": (with_coefficients(ROS).replace("equidistant", "plumb_bob"), PINHOLE),
    "ros 2 message": (
        "height: 480\nwidth: 640\ndistortion_model: equidistant\nd:\n- 0.125\n- -0.0625\n- 1.0e-05\n- -0.03125\n"
        "k:\n- 301.5\n- 0.0\n- 319.75\n- 0.0\n- 302.25\n- 240.5\n- 0.0\n- 0.0\n- 1.0\nbinning_x: 0\n",
        KB,
    ),
    "kalibr radtan": (kalibr("pinhole", "radtan", FU, list(RADTAN)), lens("brown_conrady", *RADTAN)),
    "kalibr equi": (kalibr("pinhole", "equi", FU, list(RADTAN)), KB),
    "kalibr fov": (kalibr("pinhole", "fov", FU, [0.9]), lens("field_of_view", 0.9)),
    "kalibr omni": (kalibr("omni", "radtan", [1.5, *FU], list(RADTAN)), lens("unified", 1.5, *RADTAN)),
    "kalibr omni-none": (kalibr("omni", "none", [1.5, *FU], []), lens("unified", 1.5)),
    "kalibr ds": (kalibr("ds", "none", [-0.25, 0.5625, *FU], []), lens("double_sphere", -0.25, 0.5625)),
    "kalibr eucm": (kalibr("eucm", "none", [0.5625, 1.125, *FU], []), lens("extended_unified", 0.5625, 1.125)),
    "colmap simple radial": (
        colmap_line("SIMPLE_RADIAL", 300, 320, 240, 0.125),
        CameraFile("brown_conrady", 640, 480, (300, 300, 319.5, 239.5, 0.125, *[0.0] * 11)),
    ),
    "colmap radial": (
        colmap_line("RADIAL", 300, 320, 240, 0.125, 0.25),
        CameraFile("brown_conrady", 640, 480, (300, 300, 319.5, 239.5, 0.125, 0.25, *[0.0] * 10)),
    ),
    "colmap opencv": (colmap_line("OPENCV", *PIXEL, *RADTAN), lens("brown_conrady", *RADTAN)),
    "colmap full opencv": (colmap_line("FULL_OPENCV", *PIXEL, *RATIONAL), lens("brown_conrady", *RATIONAL)),
    "colmap fov": (colmap_line("FOV", *PIXEL, 0.9), lens("field_of_view", 0.9)),
    "colmap fisheye": (colmap_line("FISHEYE", *PIXEL), lens("kannala_brandt")),
    "colmap simple fisheye": (
        colmap_line("SIMPLE_FISHEYE", 300, 320, 240),
        CameraFile("kannala_brandt", 640, 480, (300, 300, 319.5, 239.5, 0, 0, 0, 0)),
    ),
    "colmap simple radial fisheye": (
        colmap_line("SIMPLE_RADIAL_FISHEYE", 300, 320, 240, 0.125),
        CameraFile("kannala_brandt", 640, 480, (300, 300, 319.5, 239.5, 0.125, 0, 0, 0)),
    ),
    "colmap radial fisheye": (
        colmap_line("RADIAL_FISHEYE", 300, 320, 240, 0.125, 0.25),
        CameraFile("kannala_brandt", 640, 480, (300, 300, 319.5, 239.5, 0.125, 0.25, 0, 0)),
    ),
    "colmap division": (colmap_line("DIVISION", *PIXEL, -0.1), lens("division", -0.1)),
    "colmap simple division": (
        colmap_line("SIMPLE_DIVISION", 300, 320, 240, -0.1),
        CameraFile("division", 640, 480, (300, 300, 319.5, 239.5, -0.1)),
    ),
    "colmap eucm": (colmap_line("EUCM", *PIXEL, 0.5625, 1.125), lens("extended_unified", 0.5625, 1.125)),
    "colmap thin prism fisheye": (
        colmap_line("THIN_PRISM_FISHEYE", *PIXEL, *RATIONAL),
        lens("thin_prism_fisheye", *RATIONAL),
    ),
    "gyroflow standard": (
        GYROFLOW.replace('"digital_lens"', '"distortion_model": "opencv_standard", "digital_lens"'),
        lens("brown_conrady", *RADTAN),
    ),
    "adapter radtan": (
        ADAPTER + "  k1: 0.125\n  k2: -0.0625\n  p1: 1e-05\n  p2: -0.03125\n  k3: 0.5\n",
        lens("brown_conrady", *RATIONAL[:5]),
    ),
    "adapter ucm": (ADAPTER + "  alpha: 0.5625\n", lens("extended_unified", 0.5625, 1.0)),
    "adapter eucm": (ADAPTER + "  alpha: 0.5625\n  beta: 1.125\n", lens("extended_unified", 0.5625, 1.125)),
    "adapter ds": (ADAPTER + "  alpha: 0.5625\n  xi: -0.25\n", lens("double_sphere", -0.25, 0.5625)),
    "adapter ocam": (
        ADAPTER_OCAM,
        CameraFile("ocam", 640, 480, (319.75, 240.5, 0.75, 0.0625, 0.125, 1.0, *POLYNOMIAL)),
    ),
    "camodocal mei": (
        camodocal("MEI", "gamma1", "gamma2", "u0", "v0") + "mirror_parameters:\n   xi: 1.5\n",
        lens("unified", 1.5, *RADTAN),
    ),
    "camodocal pinhole": (camodocal("PINHOLE", "fx", "fy", "cx", "cy"), lens("brown_conrady", *RADTAN)),
    "camodocal fisheye": (
        camodocal("KANNALA_BRANDT", "mu", "mv", "u0", "v0")
        + "   k2: 0.125\n   k3: -0.0625\n   k4: 1e-05\n   k5: -0.03125\n",
        KB,
    ),
    "ocamcalib": (
        OCAMCALIB,
        CameraFile("ocam", 640, 480, (319.75, 240.5, 1.0, 0.125, 0.0625, 0.75, *POLYNOMIAL)),
    ),
}

READ = {
    "house json": (HOUSE_JSON, KB),
    "house yaml": (HOUSE_YAML, KB),
    "house json with a byte order mark": ("\ufeff" + HOUSE_JSON, KB),
    "opencv with a byte order mark": ("\ufeff" + OPENCV, KB),
    "house pinhole": (HOUSE_PINHOLE, PINHOLE),
    "opencv": (OPENCV, KB),
    "opencv K and D": (OPENCV_K_D, KB),
    "opencv calibration sample": (OPENCV_SAMPLE, KB),
    "opencv json": (OPENCV_JSON, KB),
    "ros camera_info": (ROS, KB),
    "kalibr": (KALIBR, KB),
    "kalibr pinhole": (KALIBR_PINHOLE, PINHOLE),
    "colmap": (COLMAP, KB),
    "colmap, one of two fits": (COLMAP_TWO, KB),
    "colmap pinhole": (COLMAP_PINHOLE, PINHOLE),
    "colmap simple pinhole": (
        COLMAP_SIMPLE,
        CameraFile("pinhole", 640, 480, (301.5, 301.5, 319.75, 240.5)),
    ),
    "gyroflow": (GYROFLOW, KB),
    "fisheye-calib-adapter": (ADAPTER_KB, KB),
    "fisheye-calib-adapter pinhole": (ADAPTER, PINHOLE),
    **READ_OTHER_MODELS,
}


def written(folder: Path, text: str | bytes, name: str = "lens.txt") -> Path:
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def changed(text: str, old: str, new: str) -> str:
    """The text with one place spoilt: a replacement that misses would test nothing."""
    assert text.count(old) == 1, f"{old!r} stands {text.count(old)} times"
    return text.replace(old, new)


def assert_refused(path: Path, words: str) -> None:
    """Reading raises one line that names the function and the file and holds these words."""
    with pytest.raises(ValueError, match=re.escape(words)) as caught:
        read_camera_file(path)
    message = str(caught.value)
    assert message.startswith(f"read_camera_file(): {str(path)!r}: ")
    assert len(message.splitlines()) == 1
    assert len(message) < 1000
