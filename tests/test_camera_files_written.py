"""Lens files written: exact, complete or not at all, and read by others."""

from __future__ import annotations

import json
import os
import re
import stat
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from lens_files import COLMAP, KB, PINHOLE

from fisheyerec.camera_files import (
    WRITERS,
    CameraFile,
    read_camera_file,
    write_camera_file,
)

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
