"""Lens files: every format read, the house's written, every refusal one clear line."""

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

from fisheyerec import camera_files
from fisheyerec.camera_files import (
    COLMAP_PIXEL_CENTRE,
    CameraFile,
    read_camera_file,
    write_camera_file,
)

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

COLMAP_TWO = COLMAP + "8 SIMPLE_RADIAL 640 480 300 320 240 0.01\n"
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
    ],
)
def test_real_cameras(name: str, expected: tuple[str, int, int, float]) -> None:
    camera = read_camera_file(FISHEYE / name)
    assert (camera.model, camera.width, camera.height, camera.params[0]) == expected


@needs_fisheye
@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("camera_files/UCM.yml", "got UCM"),
        ("camera_files/kalibr/DS.yml", "got DS"),
        ("camera_files/kalibr/EUCM.yml", "got EUCM"),
        ("camera_files/kalibr/RadTan.yml", "got radtan"),
        ("camera_files/OcamCalib/OcamCalib.yml", "got OCam"),
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
    "other model": (HOUSE_JSON, "kannala_brandt", "double_sphere", "got double_sphere"),
    "model a list": (HOUSE_JSON, '"kannala_brandt"', "[1]", "model: expected text, got [1]"),
    "page as model": (HOUSE_JSON, "kannala_brandt", "x\\n" * 10_000, "which alone can be read"),
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
    "opencv five": (OPENCV, "1.25e-01,", "1.25e-01, 0.,", "got radtan (OpenCV's pinhole model"),
    "opencv three": (OPENCV, "1.25e-01,", "", "dist_coeffs.data: expected 4 numbers, got 3"),
    "opencv flag": (OPENCV_SAMPLE, "model: 1", "model: 0", "got radtan"),
    "opencv matrix": (OPENCV, "3.1975e+02, ", "", "camera_matrix.data: expected 9 numbers, got 8"),
    "opencv skew": (OPENCV, "3.015e+02, 0.,", "3.015e+02, 0.5,", "camera_matrix: expected fx 0 cx"),
    "opencv nan": (OPENCV_K_D, "0.125", ".Nan", "D.data[0]: expected a finite number, got '.Nan'"),
    "opencv words": (OPENCV_K_D, "[ 0.125,", "word #", "D.data: expected a list of numbers"),
    "opencv half size": (OPENCV_K_D, "image_height: 480\n", "", "expected key 'image_height'"),
    "opencv size": (OPENCV, "[ 640, 480 ]", "[ 640 ]", "resolution.data: expected 2 numbers"),
    "ros radtan": (ROS, "equidistant", "plumb_bob", "got plumb_bob"),
    "kalibr radtan": (
        KALIBR.replace("distortion_model: radtan", ""),
        "equidistant",
        "radtan",
        "model: expected kannala_brandt or pinhole, which alone can be read, got pinhole-radtan",
    ),
    "kalibr omni": (KALIBR, "camera_model: pinhole", "camera_model: omni", "got omni-equidistant"),
    "kalibr missing": (KALIBR_PINHOLE, "resolution", "size", "expected key 'cam3.resolution'"),
    "kalibr nan": (KALIBR_PINHOLE, "302.25", "nan", "cam3.intrinsics[1]: expected a finite number"),
    "kalibr count": (KALIBR_PINHOLE, "302.25,", "", "cam3.intrinsics: expected 4 numbers, got 3"),
    "kalibr empty": (
        KALIBR_PINHOLE,
        KALIBR_PINHOLE.partition("\n")[2],
        "",
        "cam3: expected keys with values, got ''",
    ),
    "colmap other": (COLMAP, "OPENCV_FISHEYE", "FULL_OPENCV", "got FULL_OPENCV"),
    "colmap two fit": (
        COLMAP_TWO,
        "SIMPLE_RADIAL",
        "PINHOLE",
        "got ids 7 (OPENCV_FISHEYE), 8 (PINHOLE)",
    ),
    "colmap none fits": (
        COLMAP_TWO,
        "OPENCV_FISHEYE",
        "FOV",
        "CAMERA_ID: expected exactly one camera of OPENCV_FISHEYE, PINHOLE, SIMPLE_PINHOLE, got "
        "ids 7 (FOV), 8 (SIMPLE_RADIAL)",
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
        (b"a: 1\nb: 2\n", "expected a COLMAP cameras.txt or the keys of one of"),
    ],
)
def test_refuses_what_is_no_lens_file(tmp_path: Path, content: bytes, words: str) -> None:
    assert_refused(written(tmp_path, content), words)


def test_refuses_a_large_file_without_reading_it_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = written(tmp_path, HOUSE_JSON)
    monkeypatch.setattr(camera_files, "_MAX_BYTES", len(HOUSE_JSON))
    assert read_camera_file(path) == KB
    monkeypatch.setattr(camera_files, "_MAX_BYTES", len(HOUSE_JSON) - 1)
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
