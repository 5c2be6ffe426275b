"""Lens files: every format read, made by hand, by OpenCV and by others."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from lens_files import HOUSE_JSON, KALIBR, KB, OPENCV, READ, assert_refused, written

from fisheyerec.camera_files import (
    COLMAP_PIXEL_CENTRE,
    CameraFile,
    read_camera_file,
)


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
