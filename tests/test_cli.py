"""The command line as a user meets it, in its own process."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import fisheyerec as fr
from fisheyerec import views
from fisheyerec.pictures import Picture, read_picture, write_picture

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
ROOM, ROOM_CAMERA = EXAMPLES / "room.jpg", EXAMPLES / "room.json"


def run(*arguments, cwd=None):
    command = [sys.executable, "-P", "-m", "fisheyerec.cli", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, cwd=cwd, timeout=60)


def rectify(*arguments, camera=ROOM_CAMERA, **options):
    return run("rectify", *arguments, "--camera", camera, **options)


@pytest.fixture
def small(tmp_path):
    """A 64 x 48 picture and its lens file."""
    picture = np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    camera = fr.FisheyeCamera.from_projection("equidistant", fov_deg=120, image_size=(48, 64))
    write_picture(tmp_path / "small.png", Picture(picture))
    camera.save(tmp_path / "small.json")
    return tmp_path / "small.png", tmp_path / "small.json"


def test_pan_tilt_and_roll_turn_the_view(small, tmp_path):
    picture, camera_file = small
    turn = ["--pan", "20", "--tilt", "-10", "--roll", "5"]
    result = rectify(picture, "-o", tmp_path / "out.png", "--fov-deg", "70", *turn, camera=camera_file)
    assert (result.returncode, result.stderr) == (0, "")
    camera, view = fr.FisheyeCamera.load(camera_file), fr.PinholeCamera.from_fov(70, (48, 64))
    pixels = read_picture(picture).pixels
    expected = fr.numpy.rectify(pixels, camera, view, rotation=fr.view_rotation(20, -10, 5)).image
    np.testing.assert_array_equal(read_picture(tmp_path / "out.png").pixels, expected)


@pytest.mark.parametrize(
    ("options", "view"),
    [
        ([], lambda camera: fr.PinholeCamera.edge_matched(camera, camera.image_size)),
        (["--fov-deg", "90"], lambda camera: fr.PinholeCamera.from_fov(90, camera.image_size)),
        (["--focal", "40"], lambda camera: fr.PinholeCamera.from_focal(40, camera.image_size)),
        (["--balance", "0.5"], lambda camera: views.balanced(camera, 0.5, camera.image_size)),
        (["--projection", "cylindrical"], lambda camera: fr.CylindricalView.from_fov(120, camera.image_size)),
        (
            ["--projection", "stereographic", "--fov-deg", "200"],
            lambda camera: fr.StereographicView.from_fov(200, camera.image_size),
        ),
        (["--view", "valid-only"], lambda camera: views.valid_only(camera, camera.image_size)),
        (["--size", "30x20", "--fov-deg", "90"], lambda camera: fr.PinholeCamera.from_fov(90, (20, 30))),
    ],
)
def test_rectify_writes_what_the_library_computes(small, tmp_path, options, view):
    picture, camera_file = small
    result = rectify(picture, "-o", tmp_path / "out.png", *options, camera=camera_file)
    assert (result.returncode, result.stderr) == (0, "")
    camera = fr.FisheyeCamera.load(camera_file)
    expected = fr.numpy.rectify(read_picture(picture).pixels, camera, view(camera)).image
    np.testing.assert_array_equal(read_picture(tmp_path / "out.png").pixels, expected)


def test_a_picture_of_another_scale_takes_the_scaled_camera(small, tmp_path):
    picture, camera_file = small
    with Image.open(picture) as image:
        image.resize((128, 96)).save(tmp_path / "large.png")
    result = rectify(tmp_path / "large.png", "-o", tmp_path / "out.png", camera=camera_file)
    assert result.returncode == 0, result.stderr
    camera = fr.FisheyeCamera.load(camera_file).resize((96, 128))
    view = fr.PinholeCamera.edge_matched(camera, (96, 128))
    expected = fr.numpy.rectify(read_picture(tmp_path / "large.png").pixels, camera, view).image
    np.testing.assert_array_equal(read_picture(tmp_path / "out.png").pixels, expected)


def test_several_pictures_go_to_a_folder_and_one_bad_one_does_not_stop_the_rest(small, tmp_path):
    picture, camera_file = small
    (tmp_path / "bad.png").write_bytes(picture.read_bytes()[:300])
    result = rectify(tmp_path / "bad.png", picture, "-o", tmp_path / "out", camera=camera_file)
    assert result.returncode == 1
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["manifest.jsonl", "small.png"]
    assert result.stderr.splitlines()[-1] == "fisheyerec rectify: 1 of 2 files failed"


def test_grey_sixteen_bit_and_transparency_survive(small, tmp_path):
    _, camera_file = small
    grey16 = np.linspace(0, 65535, 48 * 64).reshape(48, 64).astype(np.uint16)
    Image.fromarray(grey16).save(tmp_path / "grey16.png")
    Image.fromarray(np.full((48, 64, 4), 200, np.uint8)).save(tmp_path / "rgba.png")
    result = rectify(tmp_path / "grey16.png", tmp_path / "rgba.png", "-o", tmp_path / "out", camera=camera_file)
    assert result.returncode == 0, result.stderr
    assert np.asarray(Image.open(tmp_path / "out" / "grey16.png")).max() > 255
    assert Image.open(tmp_path / "out" / "rgba.png").mode == "RGBA"


def test_exif_orientation_is_applied_and_the_rest_kept(small, tmp_path):
    picture, camera_file = small
    with Image.open(picture) as image:
        exif = image.getexif()
        exif[0x0112], exif[0x010F] = 6, "Maker"  # turned by 90 degrees
        image.rotate(90, expand=True).save(tmp_path / "turned.png", exif=exif)
    result = rectify(tmp_path / "turned.png", "-o", tmp_path / "out.png", camera=camera_file)
    assert result.returncode == 0, result.stderr
    plain = rectify(picture, "-o", tmp_path / "plain.png", camera=camera_file)
    assert plain.returncode == 0
    with Image.open(tmp_path / "out.png") as out:
        assert out.getexif().get(0x0112) is None
        assert out.getexif()[0x010F] == "Maker"
        np.testing.assert_array_equal(np.asarray(out), read_picture(tmp_path / "plain.png").pixels)


BAD = {
    "no such picture": (["{missing}.jpg"], {}, r"missing\.jpg: No such file"),
    "not a picture": (["{camera}"], {}, r"expected a picture, got .*small\.json"),
    "truncated": (["{truncated}"], {}, r"expected a complete picture, got .*truncated"),
    "no such lens file": (["{picture}"], {"camera": "missing.json"}, r"missing\.json: No such file"),
    "lens file with NaN": (["{picture}"], {"camera": "{nan}"}, r"fx"),
    "lens file without k4": (["{picture}"], {"camera": "{short}"}, r"k4"),
    "view of 180 degrees": (["{picture}", "--fov-deg", "180"], {}, r"fov_deg in \(0, 180\).*got 180"),
    "two views": (
        ["{picture}", "--fov-deg", "90", "--focal", "30"],
        {},
        r"one of --view, --fov-deg, --focal and --balance",
    ),
    "unknown projection": (["{picture}", "--projection", "fish"], {}, r"projection in \('pinhole', .*got 'fish'"),
    "mode of a cylinder": (["{picture}", "--projection", "cylindrical", "--balance", "1"], {}, r"a cylindrical view"),
    "unknown view": (["{picture}", "--view", "best"], {}, r"mode in \('edge_matched', .*got 'best'"),
    "view and focal": (["{picture}", "--view", "keep-all", "--focal", "30"], {}, r"one of --view, --fov-deg"),
    "balance above 1": (["{picture}", "--balance", "2"], {}, r"balance in \[0, 1\], got 2"),
    "negative focal": (["{picture}", "--focal", "-3"], {}, r"focal length above 0, got -3"),
    "size": (["{picture}", "--size", "axb"], {}, r"--size as WIDTHxHEIGHT.*got 'axb'"),
    "interpolation": (["{picture}", "--interpolation", "cubic"], {}, r"interpolation in .*got 'cubic'"),
    "unknown suffix": (["{picture}", "-o", "{tmp}/out.xyz"], {}, r"suffix such as \.jpg or \.png, got 'out\.xyz'"),
    "no such folder": (["{picture}", "-o", "{tmp}/no/out.png"], {}, r"out\.png: No such file"),
    "onto itself": (["{picture}", "-o", "{picture}"], {}, r"an output other than the picture itself"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_one_line_and_leaves_nothing(case, small, tmp_path):
    picture, camera_file = small
    lens = json.loads(camera_file.read_text())
    (tmp_path / "nan.json").write_text(json.dumps(lens | {"fx": float("nan")}))
    (tmp_path / "short.json").write_text(json.dumps({k: v for k, v in lens.items() if k != "k4"}))
    (tmp_path / "truncated.png").write_bytes(picture.read_bytes()[:-2000])
    names = {
        "missing": tmp_path / "missing",
        "camera": camera_file,
        "picture": picture,
        "truncated": tmp_path / "truncated.png",
        "nan": tmp_path / "nan.json",
        "short": tmp_path / "short.json",
        "tmp": tmp_path,
    }
    arguments, options, message = BAD[case]
    arguments = [a.format(**names) for a in arguments]
    if "-o" not in arguments:
        arguments += ["-o", str(tmp_path / "out.png")]
    before = {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()}
    result = rectify(*arguments, camera=options.get("camera", str(camera_file)).format(**names), cwd=tmp_path)
    assert result.returncode == 2, result.stderr
    assert len(result.stderr.splitlines()) == 1
    assert result.stderr.startswith("fisheyerec rectify: ")
    assert re.search(message, result.stderr), result.stderr
    assert {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()} == before


def test_a_lens_file_of_another_shape_is_refused(tmp_path, small):
    picture, _ = small
    fr.FisheyeCamera.from_projection("equidistant", 120, (64, 64)).save(tmp_path / "square.json")
    result = rectify(picture, "-o", tmp_path / "out.png", camera=tmp_path / "square.json")
    assert result.returncode == 2
    assert "in the shape of its lens file, 64x64, got 64x48" in result.stderr


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_without_permission_is_refused(tmp_path, small):
    picture, camera_file = small
    (tmp_path / "locked").mkdir(mode=0o500)
    result = rectify(picture, "-o", tmp_path / "locked" / "out.png", camera=camera_file)
    assert result.returncode == 2
    assert "Permission denied" in result.stderr


def test_a_calibrated_picture_never_imports_torch(tmp_path):
    code = (
        "import sys, typer\n"
        "from fisheyerec.cli import app\n"
        f"sys.argv = ['fisheyerec', 'rectify', {str(ROOM)!r}, '--camera', {str(ROOM_CAMERA)!r},"
        f" '-o', {str(tmp_path / 'out.jpg')!r}]\n"
        "app(standalone_mode=False)\n"
        "print('torch' in sys.modules)\n"
    )
    result = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, timeout=60)
    assert result.stdout.splitlines()[-1] == "False", result.stderr


def test_version_and_help():
    assert run("--version").stdout.strip() == fr.__version__
    assert "rectify" in run("--help").stdout


def test_the_package_runs_as_a_module():
    command = [sys.executable, "-P", "-m", "fisheyerec", "--version"]
    assert subprocess.run(command, capture_output=True, text=True, timeout=60).stdout.strip() == fr.__version__
