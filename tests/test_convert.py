"""`fisheyerec convert` as a user meets it, in its own process."""

from __future__ import annotations

import re
import subprocess
import sys

import numpy as np
import pytest

import fisheyerec as fr
from fisheyerec.camera_files import WRITERS
from fisheyerec.cameras import MAX_FIT_ERROR_PX, load_camera
from fisheyerec.pictures import Picture, write_picture

DOUBLE_SPHERE = """\
cam0:
  camera_model: ds
  intrinsics: [-0.25, 0.5625, 211.5, 212.25, 319.75, 240.5]
  distortion_model: none
  distortion_coeffs: []
  resolution: [640, 480]
"""
# Wider than a polynomial of the angle follows: it fits within 2.3 px.
RATIONAL = """\
image_width: 640
image_height: 480
camera_matrix: {rows: 3, cols: 3, data: [300, 0, 319.75, 0, 300, 240.5, 0, 0, 1]}
distortion_model: rational_polynomial
distortion_coefficients: {rows: 1, cols: 8, data: [0.8, 0.1, 0.0002, -0.0003, 0.01, 1.1, 0.3, 0.02]}
"""
FISHEYE_WITHOUT_SIZE = """\
%YAML:1.0
---
K: !!opencv-matrix { rows: 3, cols: 3, dt: d, data: [ 300., 0., 319.75, 0., 300., 240.5, 0., 0., 1. ] }
D: !!opencv-matrix { rows: 4, cols: 1, dt: d, data: [ 0.125, -0.0625, 1e-05, -0.03125 ] }
"""


def command(*arguments):
    words = [sys.executable, "-P", "-m", "fisheyerec.cli", *map(str, arguments)]
    return subprocess.run(words, capture_output=True, text=True, timeout=60)


def convert(*arguments):
    return command("convert", *arguments)


@pytest.fixture
def double_sphere(tmp_path):
    path = tmp_path / "camchain.yaml"
    path.write_text(DOUBLE_SPHERE)
    return path


@pytest.mark.parametrize("format", WRITERS)
def test_a_fitted_lens_is_written_in_every_format(double_sphere, tmp_path, format):
    output = tmp_path / f"out{WRITERS[format].suffixes[0]}"
    result = convert(double_sphere, "-o", output, "--format", format)
    assert (result.returncode, result.stderr) == (0, "")
    line = r".*: kannala_brandt 640x480, fx \S+, .*, k4 \S+; fitted to double_sphere: \S+ px RMS, \S+ px at most\n"
    assert re.fullmatch(line, result.stdout)
    expected = fr.FisheyeCamera.load(double_sphere)
    assert fr.FisheyeCamera.load(output).params == pytest.approx(expected.params, rel=1e-12)
    assert f"{expected.fit_error_px:.2g} px at most" in result.stdout


def test_a_pinhole_stays_one(tmp_path):
    fr.PinholeCamera.from_fov(60, (480, 640)).save(tmp_path / "view.json")
    result = convert(tmp_path / "view.json", "-o", tmp_path / "cameras.txt", "--format", "colmap")
    assert result.returncode == 0, result.stderr
    assert re.fullmatch(r".*cameras\.txt: pinhole 640x480, fx 554\.256, .*, cy 239\.5\n", result.stdout)
    assert load_camera(tmp_path / "cameras.txt").model == "pinhole"


def test_the_size_that_a_file_does_not_say(tmp_path):
    (tmp_path / "opencv.yml").write_text(FISHEYE_WITHOUT_SIZE)
    result = convert(tmp_path / "opencv.yml", "-o", tmp_path / "out.json", "--size", "640x480")
    assert result.returncode == 0, result.stderr
    assert fr.FisheyeCamera.load(tmp_path / "out.json").image_size == (480, 640)


def test_a_file_without_size_is_told_how_to_get_one(tmp_path):
    (tmp_path / "opencv.yml").write_text(FISHEYE_WITHOUT_SIZE)
    write_picture(tmp_path / "in.png", Picture(np.zeros((48, 64, 3), np.uint8)))
    arguments = [tmp_path / "in.png", "-o", tmp_path / "out.png", "--camera"]
    refused = command("rectify", *arguments, tmp_path / "opencv.yml")
    assert (refused.returncode, len(refused.stderr.splitlines())) == (2, 1)
    remedy = re.search(r"`fisheyerec (.+?)`", refused.stderr)[1].replace("WIDTHxHEIGHT", "640x480")
    places = {"FILE": tmp_path / "opencv.yml", "lens.json": tmp_path / "lens.json"}
    made = command(*[places.get(word, word) for word in remedy.split()])
    assert made.returncode == 0, made.stderr
    assert command("rectify", *arguments, tmp_path / "lens.json").returncode == 0


def test_a_worse_fit_is_taken_where_the_user_says_so(tmp_path):
    (tmp_path / "ros.yaml").write_text(RATIONAL)
    refused = convert(tmp_path / "ros.yaml", "-o", tmp_path / "out.json")
    assert refused.returncode == 2
    assert f"fits within {MAX_FIT_ERROR_PX:g} px (max_fit_error_px), got 2.34 px at most" in refused.stderr
    taken = convert(tmp_path / "ros.yaml", "-o", tmp_path / "out.json", "--max-fit-error-px", "3")
    assert taken.returncode == 0, taken.stderr
    assert "fitted to brown_conrady: 0.53 px RMS, 2.3 px at most" in taken.stdout


def test_rectify_tells_the_fit_as_well(tmp_path):
    write_picture(tmp_path / "in.png", Picture(np.zeros((480, 640, 3), np.uint8)))
    (tmp_path / "ros.yaml").write_text(RATIONAL)
    arguments = [tmp_path / "in.png", "-o", tmp_path / "out.png", "--camera", tmp_path / "ros.yaml", "--size", "64x48"]
    refused = command("rectify", *arguments)
    assert (refused.returncode, refused.stdout) == (2, "")
    assert refused.stderr.endswith("0.528 px RMS: allow more, or calibrate with cv2.fisheye\n")
    taken = command("rectify", *arguments, "--max-fit-error-px", "3")
    assert taken.returncode == 0, taken.stderr
    first, second = taken.stdout.splitlines()
    assert first == f"{tmp_path / 'ros.yaml'}: fitted to brown_conrady: 0.53 px RMS, 2.3 px at most"
    assert second.startswith(f"{tmp_path / 'out.png'}: 64x48, ")
    fr.FisheyeCamera.load(tmp_path / "ros.yaml", max_fit_error_px=3).save(tmp_path / "lens.json")
    plain = command("rectify", *arguments[:3], "--camera", tmp_path / "lens.json", "--overwrite")
    assert (plain.returncode, len(plain.stdout.splitlines())) == (0, 1), plain.stderr


def test_a_file_that_is_there_is_replaced_on_demand_only(double_sphere, tmp_path):
    (tmp_path / "lens.json").write_text("precious")
    refused = convert(double_sphere, "-o", tmp_path / "lens.json")
    assert (refused.returncode, refused.stdout) == (2, "")
    assert refused.stderr == (
        f"fisheyerec convert: expected a new file, or --overwrite, got {tmp_path / 'lens.json'}\n"
    )
    assert (tmp_path / "lens.json").read_text() == "precious"
    taken = convert(double_sphere, "-o", tmp_path / "lens.json", "--overwrite")
    assert taken.returncode == 0, taken.stderr
    assert fr.FisheyeCamera.load(tmp_path / "lens.json").image_size == (480, 640)


# What is written into camera.yaml, the options, and what the one line says.
BAD = {
    "no file": (None, ["-o", "out.json"], "camera.yaml: No such file or directory"),
    "binary": (b"\x89PNG\r\n\x1a\n\x00\xff", ["-o", "out.json"], "expected UTF-8 text, got a binary file"),
    "missing key": (DOUBLE_SPHERE.replace("intrinsics", "x").encode(), ["-o", "out.json"], "key 'cam0.intrinsics'"),
    "nan": (DOUBLE_SPHERE.replace("211.5", ".nan").encode(), ["-o", "out.json"], r"intrinsics\[2\]: expected a finite"),
    "no size": (FISHEYE_WITHOUT_SIZE.encode(), ["-o", "out.json"], "expected image_size=.height, width."),
    "bad size": (
        FISHEYE_WITHOUT_SIZE.encode(),
        ["-o", "out.json", "--size", "wide"],
        "expected --size as WIDTHxHEIGHT",
    ),
    "poor fit": (RATIONAL.encode(), ["-o", "out.json"], "expected a brown_conrady lens that kannala_brandt fits"),
    "format": (DOUBLE_SPHERE.encode(), ["-o", "out.json", "--format", "xml"], "format: expected one of fisheyerec"),
    "suffix": (DOUBLE_SPHERE.encode(), ["-o", "out.json", "--format", "ros"], "suffix: expected .yaml, .yml, got"),
    "itself": (DOUBLE_SPHERE.encode(), ["-o", "camera.yaml"], "expected an output other than the lens file itself"),
    "no folder": (DOUBLE_SPHERE.encode(), ["-o", "absent/out.json"], "No such file or directory"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_one_line_and_leaves_nothing(case, tmp_path):
    content, options, message = BAD[case]
    if content is not None:
        (tmp_path / "camera.yaml").write_bytes(content)
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    flag, output, *more = options
    result = convert(tmp_path / "camera.yaml", flag, tmp_path / output, *more)
    assert (result.returncode, result.stdout) == (2, "")
    assert len(result.stderr.splitlines()) == 1
    assert re.search(f"^fisheyerec convert: .*{message}", result.stderr), result.stderr
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before
