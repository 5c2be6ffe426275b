"""Lens files that are none: every refusal one clear line."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest
from lens_files import (
    ADAPTER_KB,
    ADAPTER_OCAM,
    COLMAP,
    COLMAP_PINHOLE,
    COLMAP_TWO,
    FU,
    GYROFLOW,
    HOUSE_JSON,
    HOUSE_YAML,
    KALIBR,
    KALIBR_PINHOLE,
    KB,
    OCAMCALIB,
    OMNIDIR,
    OPENCV,
    OPENCV_K_D,
    OPENCV_SAMPLE,
    PRISM,
    RADTAN,
    ROS,
    assert_refused,
    camodocal,
    changed,
    kalibr,
    with_coefficients,
    written,
)

from fisheyerec.camera_files import (
    entries,
    read_camera_file,
)

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
