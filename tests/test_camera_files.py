"""Lens files: every format read and written, every refusal one clear line."""

from __future__ import annotations

import json
import os
import re
import stat
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fisheyerec.camera_files import (
    COLMAP_PIXEL_CENTRE,
    WRITERS,
    CameraFile,
    entries,
    read_camera_file,
    write_camera_file,
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


# --- Reading --------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".txt", ".json", ".yaml"])
@pytest.mark.parametrize("name", READ)
def test_reads_every_format_by_its_content(tmp_path: Path, name: str, suffix: str) -> None:
    text, expected = READ[name]
    camera = read_camera_file(written(tmp_path, text, f"lens{suffix}"))
    assert camera == expected
    assert [type(value) for value in camera.params] == [float] * len(camera.params)
    assert (type(camera.width), type(camera.height)) == (int, int)


def test_reads_a_path_given_as_text(tmp_path: Path) -> None:
    assert read_camera_file(str(written(tmp_path, HOUSE_JSON))) == KB


def test_colmap_principal_point_moves_by_half_a_pixel(tmp_path: Path) -> None:
    # A symmetric lens: COLMAP's centre of the image is (W/2, H/2), the house's ((W-1)/2, (H-1)/2).
    width, height = 641, 480
    line = f"1 PINHOLE {width} {height} 300 300 {width / 2} {height / 2}"
    camera = read_camera_file(written(tmp_path, line))
    assert COLMAP_PIXEL_CENTRE == 0.5
    assert camera.params[2:4] == ((width - 1) / 2, (height - 1) / 2)


def test_kalibr_prefers_cam0(tmp_path: Path) -> None:
    first, second = KALIBR.split("cam1:")
    assert read_camera_file(written(tmp_path, "cam1:" + second + first)) == KB


OPENCV_WITHOUT_SIZE = OPENCV.partition("resolution:")[0]


def test_image_size_is_used_only_where_the_file_holds_none(tmp_path: Path) -> None:
    path = written(tmp_path, OPENCV_WITHOUT_SIZE)
    assert read_camera_file(path, image_size=(480, 640)) == KB
    with pytest.raises(ValueError, match=r"image_size=\(height, width\).*got None"):
        read_camera_file(path)
    for text, expected in READ.values():
        assert read_camera_file(written(tmp_path, text), image_size=(11, 22)) == expected


@pytest.mark.parametrize(
    ("size", "words"),
    [
        ((480,), "image_size: expected"),
        ((0, 640), "height: expected"),
        ((480, 640.5), "width: exp"),
    ],
)
def test_bad_image_size(tmp_path: Path, size: tuple[int, int], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        read_camera_file(written(tmp_path, OPENCV_WITHOUT_SIZE), image_size=size)


@pytest.mark.parametrize("suffix", ["yml", "json"])
@pytest.mark.parametrize("shape", [(4, 1), (1, 4), (4,)])
@pytest.mark.parametrize("keys", [("K", "D"), ("camera_matrix", "dist_coeffs")])
def test_reads_what_opencv_writes(tmp_path: Path, suffix: str, shape: tuple[int, ...], keys: tuple[str, str]) -> None:
    cv2 = pytest.importorskip("cv2")
    fx, fy, cx, cy, *coefficients = params = (300 / 7, 1e3 / 3, 959 / 9, 53.7, 1 / 3, -1e-7, 2.0, 0)
    path = tmp_path / f"camera.{suffix}"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write(keys[0], np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]))
    storage.write(keys[1], np.array(coefficients, dtype=np.float64).reshape(shape))
    storage.write("rms", 0.25)
    storage.release()
    camera = read_camera_file(path, image_size=(480, 640))
    assert camera == CameraFile("kannala_brandt", 640, 480, params)


def test_importing_loads_neither_yaml_nor_torch_nor_numpy() -> None:
    code = "import sys, fisheyerec.camera_files\nprint(sorted({'yaml', 'torch', 'numpy', 'cv2'} & sys.modules.keys()))"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.stdout.strip() == "[]", result.stderr


# --- Real files -----------------------------------------------------------------------------------

FISHEYE = Path(__file__).resolve().parents[2] / "shared" / "data" / "fisheye"
needs_fisheye = pytest.mark.skipif(
    not FISHEYE.is_dir(), reason="the development data folder ../shared/data/fisheye is absent"
)


@needs_fisheye
@pytest.mark.parametrize("side", ["front", "left"])
def test_surround_view_yaml_and_json_agree(side: str) -> None:
    folder = FISHEYE / "surround_view"
    camera = read_camera_file(folder / f"{side}.yaml")
    assert camera == read_camera_file(folder / f"{side}.json")
    assert (camera.model, camera.width, camera.height) == ("kannala_brandt", 960, 640)


@needs_fisheye
@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("gopro_chessboard/camera.json", ("kannala_brandt", 1280, 960, 565.2324417188896)),
        ("wide_chessboard/camera.json", ("kannala_brandt", 1032, 778, 336.91429583222214)),
        ("camera_files/kalibr/KB.yml", ("kannala_brandt", 752, 480, 461.58688085556616)),
        ("camera_files/pinhole.yml", ("pinhole", 754, 480, 377.752)),
        ("camera_files/UCM.yml", ("extended_unified", 1920, 1080, 1313.83)),
        ("camera_files/kalibr/DS.yml", ("double_sphere", 752, 480, 348.112754378549)),
        ("camera_files/kalibr/EUCM.yml", ("extended_unified", 752, 480, 460.92588889854693)),
        ("camera_files/kalibr/RadTan.yml", ("brown_conrady", 752, 480, 459.2595646276051)),
        ("camera_files/OcamCalib/OcamCalib.yml", ("ocam", 752, 480, 359.829671)),
    ],
)
def test_real_cameras(name: str, expected: tuple[str, int, int, float]) -> None:
    camera = read_camera_file(FISHEYE / name)
    assert (camera.model, camera.width, camera.height, camera.params[0]) == expected


@needs_fisheye
@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("camera_files/kalibr/image.png", "got a binary file"),
        ("gopro_chessboard/corners.json", "got pattern_inner_corners, order, corners"),
    ],
)
def test_real_files_that_are_refused(name: str, words: str) -> None:
    assert_refused(FISHEYE / name, words)


# --- Refusals -------------------------------------------------------------------------------------


def assert_refused(path: Path, words: str) -> None:
    """Reading raises one line that names the function and the file and holds these words."""
    with pytest.raises(ValueError, match=re.escape(words)) as caught:
        read_camera_file(path)
    message = str(caught.value)
    assert message.startswith(f"read_camera_file(): {str(path)!r}: ")
    assert len(message.splitlines()) == 1
    assert len(message) < 1000


# What is spoilt in a good file, and what the message must say. The good file is read beside it.
REFUSED = {
    "missing key": (HOUSE_JSON, '"fx": 301.5, ', "", "expected key 'fx', got model, width"),
    "missing model": (HOUSE_YAML, "model: kannala_brandt\n", "", "expected key 'model'"),
    "missing width": (HOUSE_JSON, '"width": 640, ', "", "expected key 'width'"),
    "missing coefficient": (HOUSE_JSON, '"k3": 1e-05, ', "", "expected key 'k3'"),
    "nan": (HOUSE_JSON, "301.5", "NaN", "fx: expected a finite number, got nan"),
    "infinity": (HOUSE_YAML, "319.75", "-inf", "cx: expected a finite number, got '-inf'"),
    "yaml nan": (HOUSE_YAML, "0.125", ".nan", "k1: expected a finite number, got '.nan'"),
    "too large": (HOUSE_JSON, "301.5", "1" + "0" * 400, "fx: expected a finite number"),
    "words": (HOUSE_JSON, "301.5", '"wide"', "fx: expected a finite number, got 'wide'"),
    "true": (HOUSE_JSON, "301.5", "true", "fx: expected a finite number, got True"),
    "null": (HOUSE_JSON, "301.5", "null", "fx: expected a finite number, got None"),
    "list": (HOUSE_YAML, "301.5", "[301.5]", "fx: expected a finite number, got ['301.5']"),
    "zero fx": (HOUSE_JSON, "301.5", "0", "fx: expected a positive number, got 0"),
    "negative fy": (HOUSE_JSON, "302.25", "-302.25", "fy: expected a positive number, got -302.25"),
    "zero width": (HOUSE_JSON, "640", "0", "width: expected a positive whole number, got 0"),
    "broken height": (HOUSE_YAML, "480", "480.5", "height: expected a positive whole number"),
    "other model": (
        HOUSE_JSON,
        "kannala_brandt",
        "double_sphere",
        "stereographic, panini, got double_sphere",
    ),
    "model a list": (HOUSE_JSON, '"kannala_brandt"', "[1]", "model: expected text, got [1]"),
    "page as model": (HOUSE_JSON, "kannala_brandt", "x\\n" * 10_000, "panini, got x x x"),
    "broken json": (HOUSE_JSON, '"cx"', "cx", "expected JSON, got text its parser refuses"),
    "deep json": (HOUSE_JSON, '"by hand"', "[" * 100_000, "expected JSON, got text its parser"),
    "broken yaml": (
        HOUSE_YAML,
        "fx: 301.5",
        "fx: [301.5",
        "its parser refuses: expected ',' or ']'",
    ),
    "deep yaml": (HOUSE_YAML, "by hand", "[" * 2_000, "expected YAML, got text its parser"),
    "opencv missing": (OPENCV, "dist_coeffs:", "other:", "'dist_coeffs' or 'D'"),
    "opencv three": (OPENCV, "1.25e-01,", "", "dist_coeffs: expected 0, 4, 5, 8, 12, 14 coefficients of brown_conrady"),
    "opencv fisheye five": (OPENCV_SAMPLE, "1.25e-01,", "1.25e-01, 0.,", "distortion_coefficients.data: expected 4"),
    "opencv tilt": (
        with_coefficients(OPENCV, *PRISM, 0, 0),
        "0.004, 0, 0]",
        "0.004, 0, 0.1]",
        "dist_coeffs: tau_x, tau_y: expected 0, as no tilted sensor can be read, got [0.0, 0.1]",
    ),
    "omnidir five": (OMNIDIR, "1.25e-01,", "1.25e-01, 0.,", "dist_coeffs.data: expected 4 numbers, got 5"),
    "omnidir xi": (OMNIDIR, "1.5 ]", "1.5, 2 ]", "xi.data: expected 1 numbers, got 2"),
    "opencv matrix": (OPENCV, "3.1975e+02, ", "", "camera_matrix.data: expected 9 numbers, got 8"),
    "opencv skew": (OPENCV, "3.015e+02, 0.,", "3.015e+02, 0.5,", "camera_matrix: expected fx 0 cx"),
    "opencv nan": (OPENCV_K_D, "0.125", ".Nan", "D.data[0]: expected a finite number, got '.Nan'"),
    "opencv words": (OPENCV_K_D, "[ 0.125,", "word #", "D.data: expected a list of numbers"),
    "opencv half size": (OPENCV_K_D, "image_height: 480\n", "", "expected key 'image_height'"),
    "opencv size": (OPENCV, "[ 640, 480 ]", "[ 640 ]", "resolution.data: expected 2 numbers"),
    "ros other": (
        ROS,
        "equidistant",
        "modified_brown_conrady",
        "model: expected one of fisheye, equidistant, plumb_bob, rational_polynomial, got modified_brown_conrady",
    ),
    "ros half size": (ROS, "image_height: 480\n", "", "expected key 'image_height'"),
    "kalibr radtan count": (
        kalibr("pinhole", "radtan", FU, list(RADTAN)),
        ", -0.03125]",
        "]",
        "cam0.distortion_coeffs: expected 4 numbers, got 3",
    ),
    "kalibr omni": (KALIBR, "camera_model: pinhole", "camera_model: omni", "got omni-equidistant"),
    "kalibr ds count": (kalibr("ds", "none", [-0.25, 0.5, *FU], []), "-0.25, ", "", "cam0.intrinsics: expected 6"),
    "kalibr missing": (KALIBR_PINHOLE, "resolution", "size", "expected key 'cam3.resolution'"),
    "kalibr nan": (KALIBR_PINHOLE, "302.25", "nan", "cam3.intrinsics[1]: expected a finite number"),
    "kalibr count": (KALIBR_PINHOLE, "302.25,", "", "cam3.intrinsics: expected 4 numbers, got 3"),
    "kalibr empty": (
        KALIBR_PINHOLE,
        KALIBR_PINHOLE.partition("\n")[2],
        "",
        "cam3: expected keys with values, got ''",
    ),
    "colmap other": (COLMAP, "OPENCV_FISHEYE", "EQUIRECTANGULAR", "THIN_PRISM_FISHEYE, got EQUIRECTANGULAR"),
    "colmap two fit": (
        COLMAP_TWO,
        "EQUIRECTANGULAR",
        "PINHOLE",
        "got ids 7 (OPENCV_FISHEYE), 8 (PINHOLE)",
    ),
    "colmap none fits": (
        COLMAP_TWO,
        "OPENCV_FISHEYE",
        "RAD_TAN_THIN_PRISM_FISHEYE",
        "exactly one camera that can be read, got ids 7 (RAD_TAN_THIN_PRISM_FISHEYE), 8 (EQUIRECTANGULAR)",
    ),
    "colmap count": (COLMAP, " -0.03125", "", "camera 7 PARAMS: expected 8 numbers, got 7"),
    "colmap nan": (COLMAP, "320.25", "nan", "camera 7 PARAMS[2]: expected a finite number"),
    "colmap short": (COLMAP_PINHOLE, " 480 301.5 302.25 320.25 241", "", "lines CAMERA_ID MODEL"),
    "gyroflow model": (
        GYROFLOW,
        '"digital_lens": null',
        '"distortion_model": "poly5"',
        "got poly5",
    ),
    "gyroflow digital": (
        GYROFLOW,
        "null",
        '"gopro_superview"',
        "with digital lens gopro_superview",
    ),
    "gyroflow missing": (GYROFLOW, '"w": 640, ', "", "expected key 'calib_dimension.w'"),
    "gyroflow count": (GYROFLOW, "[0.125, ", "[", "fisheye_params.distortion_coeffs: expected 4"),
    "gyroflow skew": (GYROFLOW, "[301.5, 0.0,", "[301.5, 2,", "fisheye_params.camera_matrix"),
    "adapter missing": (ADAPTER_KB, "k4", "k5", "expected key 'parameter.k4'"),
    "adapter polynomial": (
        ADAPTER_OCAM,
        "5e-06]",
        "5e-06, 0, 0, 0, 0, 0, 0, 0]",
        "expected at most 16 parameters of ocam, got 17",
    ),
    "camodocal other": (
        camodocal("PINHOLE", "fx", "fy", "cx", "cy"),
        "PINHOLE",
        "SCARAMUZZA",
        "model: expected one of MEI, KANNALA_BRANDT, PINHOLE, got SCARAMUZZA",
    ),
    "camodocal missing": (
        camodocal("PINHOLE", "fx", "fy", "cx", "cy"),
        "p2:",
        "p3:",
        "expected key 'distortion_parameters.p2', got k1, k2, p1, p3",
    ),
    "ocamcalib nan": (OCAMCALIB, "319.75", "nan", "center[1]: expected a finite number, got 'nan'"),
    "ocamcalib count": (OCAMCALIB, "4 -2.0", "5 -2.0", "polynomial: expected 5 coefficients"),
    "ocamcalib lines": (OCAMCALIB, "480 640", "", "expected 5 lines of numbers: polynomial, "),
    "ocamcalib affine": (OCAMCALIB, "0.0625 0.125", "0.0625", "affine parameters: expected 3 numbers, got 2"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_refuses_with_one_clear_line(tmp_path: Path, name: str) -> None:
    good, old, new, words = REFUSED[name]
    assert read_camera_file(written(tmp_path, good)).width == 640
    assert_refused(written(tmp_path, changed(good, old, new)), words)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "got an empty file"),
        (b" \n\n", "got an empty file"),
        (b"# only a comment\n", "got an empty file"),
        (b"\x89PNG\r\n\x1a\n\x00\x00", "got a binary file"),
        (b"model: kannala_brandt\0", "got a binary file"),
        (HOUSE_YAML.encode("utf-16"), "got a binary file"),
        (b"<?xml version='1.0'?><opencv_storage/>", "got XML"),
        (b"[1, 2, 3]", "top level: expected keys with values, got ['1', '2', '3']"),
        (b"just words", "top level: expected keys with values, got 'just words'"),
        (b"{}", "got none"),
        (b"a: 1\nb: 2\n", "expected a COLMAP cameras.txt, OCamCalib's text or the keys of one of"),
    ],
)
def test_refuses_what_is_no_lens_file(tmp_path: Path, content: bytes, words: str) -> None:
    assert_refused(written(tmp_path, content), words)


def test_refuses_a_large_file_without_reading_it_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = written(tmp_path, HOUSE_JSON)
    monkeypatch.setattr(entries, "MAX_BYTES", len(HOUSE_JSON))
    assert read_camera_file(path) == KB
    monkeypatch.setattr(entries, "MAX_BYTES", len(HOUSE_JSON) - 1)
    assert_refused(path, "got a larger file")


def test_unreadable_paths_raise_what_the_system_says(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        read_camera_file(tmp_path / "absent.json")
    with pytest.raises(OSError, match=re.escape(str(tmp_path))):
        read_camera_file(tmp_path)


def test_yaml_without_pyyaml_is_a_broken_installation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "yaml", None)  # importing it now fails
    assert read_camera_file(written(tmp_path, HOUSE_JSON)) == KB
    with pytest.raises(RuntimeError, match=r"read_camera_file\(\): .*PyYAML"):
        read_camera_file(written(tmp_path, HOUSE_YAML))


# --- Writing --------------------------------------------------------------------------------------

AWKWARD = CameraFile("kannala_brandt", 3, 2, (1 / 3, 5e-324, 1e22, -0.0, 1e-05, -1.7976931348623157e308, 0.1, 2.0))


@pytest.mark.parametrize("suffix", [".json", ".yaml", ".yml", ".JSON"])
@pytest.mark.parametrize("camera", [KB, PINHOLE, AWKWARD], ids=["fisheye", "pinhole", "awkward"])
def test_round_trip_is_exact_to_the_last_bit(tmp_path: Path, camera: CameraFile, suffix: str) -> None:
    path = tmp_path / f"camera{suffix}"
    write_camera_file(path, camera)
    read = read_camera_file(path)
    assert read == camera
    assert [value.hex() for value in read.params] == [value.hex() for value in camera.params]


@pytest.mark.parametrize(("format", "suffix"), [(name, end) for name, row in WRITERS.items() for end in row.suffixes])
@pytest.mark.parametrize("camera", [KB, PINHOLE, AWKWARD], ids=["fisheye", "pinhole", "awkward"])
def test_every_format_written_is_read_back(tmp_path: Path, camera: CameraFile, format: str, suffix: str) -> None:
    path = tmp_path / f"camera{suffix}"
    write_camera_file(path, camera, format=format)
    read = read_camera_file(path)
    assert (read.model, read.width, read.height) == (camera.model, camera.width, camera.height)
    # COLMAP's half pixel costs the last bits of cx and cy; every other number is exact.
    exact = camera.params if format != "colmap" else pytest.approx(camera.params, rel=1e-15, abs=1e-15)
    assert read.params == exact


@pytest.mark.parametrize("suffix", [".yml", ".yaml", ".json"])
@pytest.mark.parametrize("camera", [KB, PINHOLE], ids=["fisheye", "pinhole"])
def test_opencv_reads_what_is_written_for_it(tmp_path: Path, camera: CameraFile, suffix: str) -> None:
    cv2 = pytest.importorskip("cv2")
    path = tmp_path / f"camera{suffix}"
    write_camera_file(path, camera, format="opencv")
    assert path.read_text().count("opencv-matrix") == 2
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    fx, fy, cx, cy, *coefficients = camera.params
    assert storage.getNode("camera_matrix").mat().tolist() == [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]
    assert storage.getNode("distortion_coefficients").mat().ravel().tolist() == (coefficients or [0.0] * 5)
    assert storage.getNode("image_width").real() == 640
    assert storage.getNode("image_height").real() == 480
    assert storage.getNode("fisheye_model").real() == (camera is KB)


@pytest.mark.parametrize(
    ("format", "keys"),
    [
        ("kalibr", ("cam0", "distortion_coeffs")),
        ("ros", ("distortion_coefficients", "data")),
        ("gyroflow", ("fisheye_params", "distortion_coeffs")),
    ],
)
def test_other_parsers_find_numbers_in_what_is_written(tmp_path: Path, format: str, keys: tuple[str, str]) -> None:
    """YAML 1.1, which kalibr and ROS read, takes 1e-05 for text: it wants 1.0e-05."""
    yaml = pytest.importorskip("yaml")
    path = tmp_path / f"camera{WRITERS[format].suffixes[0]}"
    write_camera_file(path, KB, format=format)
    load = json.loads if format == "gyroflow" else yaml.safe_load
    outer, inner = keys
    assert load(path.read_text())[outer][inner] == list(KB.params[4:])


def test_colmap_is_written_with_its_own_origin(tmp_path: Path) -> None:
    path = tmp_path / "cameras.txt"
    write_camera_file(path, KB, format="colmap")
    assert path.read_text() == COLMAP.replace("7 OPENCV", "1 OPENCV").replace(" 241 ", " 241.0 ")


def test_written_files_are_plain_json_and_yaml(tmp_path: Path) -> None:
    yaml = pytest.importorskip("yaml")
    names = ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")
    expected = {"model": "kannala_brandt", "width": 640, "height": 480}
    expected.update(zip(names, KB.params, strict=True))
    for suffix, load in ((".json", json.loads), (".yaml", yaml.safe_load)):
        path = tmp_path / f"camera{suffix}"
        write_camera_file(path, KB)
        assert list(load(path.read_text()).items()) == list(expected.items())


def test_numpy_numbers_are_written(tmp_path: Path) -> None:
    params = tuple(np.asarray(KB.params, dtype=np.float32))
    for suffix in (".json", ".yaml"):
        path = tmp_path / f"camera{suffix}"
        write_camera_file(path, CameraFile(KB.model, np.int64(640), np.int32(480), params))  # type: ignore[arg-type]
        assert read_camera_file(path).params == tuple(float(value) for value in params)


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        ("camera.txt", {}, "suffix: expected .json, .yaml, .yml, got '.txt'"),
        ("camera", {}, "got ''"),
        ("camera.json", {"model": "fov"}, "got fov"),
        (
            "camera.json",
            {"model": "double_sphere"},
            "stereographic, panini, got double_sphere",
        ),
        ("camera.json", {"model": "pinhole"}, "params: expected fx, fy, cx, cy, got 8 numbers"),
        ("camera.yaml", {"params": KB.params[:7]}, "k4, got 7 numbers"),
        ("camera.json", {"width": 0}, "width: expected a positive whole number, got 0"),
        ("camera.json", {"height": 4.5}, "height: expected a positive whole number, got 4.5"),
        ("camera.json", {"params": (1.0, -1.0, *KB.params[2:])}, "fy: expected a positive number"),
        ("camera.json", {"params": (1.0, 1.0, np.nan, *KB.params[3:])}, "cx: expected a finite"),
    ],
)
def test_refuses_to_write(tmp_path: Path, name: str, change: dict[str, object], words: str) -> None:
    path = tmp_path / name
    with pytest.raises(ValueError, match=re.escape(words)) as caught:
        write_camera_file(path, replace(KB, **change))  # type: ignore[arg-type]
    assert str(caught.value).startswith(f"write_camera_file(): {str(path)!r}: ")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "format", "words"),
    [
        ("camera.json", "opencv3", "format: expected one of fisheyerec, opencv, kalibr, colmap, gyroflow, ros, got"),
        ("camera.json", "kalibr", "suffix: expected .yaml, .yml, got '.json'"),
        ("camera.txt", "opencv", "suffix: expected .yml, .yaml, .json, got '.txt'"),
    ],
)
def test_refuses_formats_and_suffixes_that_do_not_belong(tmp_path: Path, name: str, format: str, words: str) -> None:
    with pytest.raises(ValueError, match=re.escape(words)):
        write_camera_file(tmp_path / name, KB, format=format)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", [".json", ".yaml"])
@pytest.mark.parametrize("step", ["fsync", "replace"])
def test_a_failure_in_the_middle_leaves_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str, step: str
) -> None:
    path = tmp_path / f"camera{suffix}"
    write_camera_file(path, PINHOLE)
    before = path.read_bytes()
    met: list[list[str]] = []

    def failing(*_: object) -> None:
        met.append(sorted(entry.name for entry in tmp_path.iterdir()))
        raise OSError("the disk is full")

    with monkeypatch.context() as patch:
        patch.setattr(os, step, failing)
        with pytest.raises(OSError, match="the disk is full"):
            write_camera_file(path, KB)
    assert [len(names) for names in met] == [2], "the new content lay beside the old, in its folder"
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]

    write_camera_file(path, KB)
    assert read_camera_file(path) == KB
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.skipif(os.name != "posix", reason="file permissions as POSIX has them")
def test_written_files_have_ordinary_permissions(tmp_path: Path) -> None:
    plain = tmp_path / "plain"
    plain.touch()
    path = tmp_path / "camera.json"
    write_camera_file(path, KB)
    assert stat.S_IMODE(path.stat().st_mode) == stat.S_IMODE(plain.stat().st_mode)


def test_a_missing_folder_is_the_systems_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        write_camera_file(tmp_path / "absent" / "camera.json", KB)
