"""Synthesis: what pairs show, against OpenCV; what they are drawn from; folders that survive a kill."""

from __future__ import annotations

import csv
import itertools
import json
import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from typer.testing import CliRunner

import fisheyerec as fr
from fisheyerec.cli import app
from fisheyerec.training import lenses, panoramas
from fisheyerec.training.pairs import read_manifest, write_png
from fisheyerec.training.recipes import STANDARD, WIDE, Recipe
from fisheyerec.training.sources import DecodedSource, Source, SourceError, Sources
from fisheyerec.training.synthesis import SyntheticPairs
from fisheyerec.training.writing import write_pairs

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"

cv2 = pytest.importorskip("cv2", reason="the independent implementation is OpenCV's")


def in_memory(*decoded, is_panorama=False):
    """Sources that never were files."""
    sources = [Source(f"source {i}", None, None, is_panorama) for i in range(len(decoded))]
    return Sources(sources, [DecodedSource(*each) for each in decoded])


@pytest.fixture
def photograph(picture):
    """photograph(height, width, seed=0): uint8 with the spectrum of photographs, softened as by a camera's optics."""

    def make(height, width, seed=0):
        values = picture(1, 3, height, width, seed)[0].permute(1, 2, 0).numpy()
        return cv2.GaussianBlur(values * 255, None, 1.0).round().astype(np.uint8)

    return make


@pytest.fixture
def scenes(photograph, tmp_path):
    """A SceneParse150 folder: three pictures for training, two for validation, labels 0, 7 and 150."""
    root = tmp_path / "scenes"
    for split, count in (("training", 3), ("validation", 2)):
        for kind in ("images", "annotations"):
            (root / kind / split).mkdir(parents=True)
        for i in range(count):
            pixels = photograph(90, 120, seed=i)
            Image.fromarray(pixels).save(root / "images" / split / f"{i}.jpg", quality=95)
            labels = np.choose(pixels[..., 0] // 86, [0, 7, 150]).astype(np.uint8)
            Image.fromarray(labels).save(root / "annotations" / split / f"{i}.png")
    return root


def psnr(a, b):
    return 10 * math.log10(255**2 / np.mean((a.astype(float) - b) ** 2))


# --- What a pair shows ----------------------------------------------------------------------------


def opencv_source_positions(pair, size, focal, side, factor):
    """Where OpenCV finds the pixels of the enlarged fisheye picture and of the enlarged view in the square source."""
    fx, fy, cx, cy = pair.camera[:4]
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    step = (np.arange(size * factor) + 0.5) / factor - 0.5
    points = np.stack(np.meshgrid(step, step), -1).reshape(-1, 1, 2)
    fisheye = cv2.fisheye.undistortPoints(points, K, pair.camera[4:])
    straight = (points - pair.view[2:]) / pair.view[:2]
    centre = (side - 1) / 2
    return [(focal * rays + centre).reshape(size * factor, -1, 2).astype(np.float32) for rays in (fisheye, straight)]


@pytest.mark.parametrize("index", range(6))
def test_a_pair_is_what_opencv_makes_of_the_source(photograph, index):
    pixels = photograph(300, 400)
    pair = SyntheticPairs(in_memory((pixels, None)), size=(128, 128), seed=3)[index]
    square = np.ascontiguousarray(pixels[:, 50:350])
    focal = 300 / math.sqrt(2) / math.tan(pair.theta_c)
    for positions, made in zip(
        opencv_source_positions(pair, 128, focal, 300, 8), (pair.fisheye, pair.rectified), strict=True
    ):
        large = cv2.remap(square, positions, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        expected = cv2.resize(large, (128, 128), interpolation=cv2.INTER_AREA)
        assert psnr(made, expected) > 45
        # no seam, shift or stripe hides in the mean
        assert np.abs(made.astype(int) - expected).max() < 16


def test_large_photographs_are_reduced_and_do_not_alias():
    """Stripes finer than the result's pixels come out grey."""
    stripes = np.zeros((1500, 1500, 3), np.uint8)
    stripes[:, ::2] = 255
    pair = SyntheticPairs(in_memory((stripes, None)), size=(64, 64), seed=1)[0]
    for made in (pair.fisheye, pair.rectified):
        assert made.std() < 6
        assert abs(made.mean() - 127.5) < 2


def test_labels_are_never_mixed(photograph):
    pixels = photograph(300, 400)
    labels = np.choose(pixels[..., 0] // 64, [0, 3, 90, 255]).astype(np.uint8)
    pairs = SyntheticPairs(in_memory((pixels, labels)), size=(128, 128), seed=3, rectified_labels=True)
    for index in range(4):
        pair = pairs[index]
        focal = 300 / math.sqrt(2) / math.tan(pair.theta_c)
        square = np.ascontiguousarray(labels[:, 50:350])
        for positions, made in zip(
            opencv_source_positions(pair, 128, focal, 300, 1), (pair.labels, pair.rectified_labels), strict=True
        ):
            expected = cv2.remap(square, positions, None, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
            assert set(np.unique(made)) <= {0, 3, 90, 255}
            assert np.mean(made == expected) > 0.99  # OpenCV rounds positions to 1/32 px


def test_the_ground_truth_is_what_the_true_camera_rectifies_to(photograph):
    pairs = SyntheticPairs(in_memory((photograph(300, 400), None)), size=(128, 128))
    for index in range(5):
        pair = pairs[index]
        camera = fr.FisheyeCamera(pair.camera, (128, 128))
        view = fr.PinholeCamera.edge_matched(camera, (128, 128))
        np.testing.assert_array_equal(pair.view, view.params)
        assert psnr(fr.numpy.rectify(pair.fisheye, camera, view, padding="border").image, pair.rectified) > 32


@pytest.mark.parametrize("shape", [(200, 200), (150, 260), (260, 150)])
@pytest.mark.parametrize("recipe", [STANDARD, Recipe("all over", anywhere=True, blend=0.3)])
def test_nothing_is_empty(shape, recipe):
    """No border cue: a white source gives white pictures, for photographs of any shape and panoramas."""
    white = np.full((*shape, 3), 255, np.uint8), np.full(shape, 9, np.uint8)
    panorama = np.full((100, 200, 3), 255, np.uint8), None
    for sources in (in_memory(white), in_memory(panorama, is_panorama=True)):
        for pair in map(SyntheticPairs(sources, recipe=recipe, size=(48, 48)).__getitem__, range(10)):
            assert pair.fisheye.min() == 255
            assert pair.rectified.min() == 255
            assert pair.labels is None or pair.labels.min() == 9


def test_the_black_rim_of_image_circles_tells_nothing_about_the_lens():
    white = np.full((64, 64, 3), 255, np.uint8), np.full((64, 64), 9, np.uint8)
    recipe = Recipe("circles", circular_share=1.0)
    pairs = SyntheticPairs(in_memory(white), recipe=recipe, size=(32, 32), rectified=False)
    made = [pairs[i] for i in range(300)]
    dark = [(pair.fisheye[..., 0] < 8).mean() for pair in made]
    assert np.ptp(dark) > 0.2
    for quantity in ([p.theta_c for p in made], [p.camera[0] for p in made], [p.camera[4] for p in made]):
        assert abs(np.corrcoef(dark, quantity)[0, 1]) < 0.15
    for pair in made:
        brightness = pair.fisheye[..., 0]
        assert (pair.labels[brightness < 12] == 0).all()
        assert (pair.labels[brightness > 14] == 9).all()


# --- Panoramas ------------------------------------------------------------------------------------


def directions(height):
    """A panorama whose colours are the directions it shows."""
    longitude = ((np.arange(2 * height) + 0.5) / height - 1) * np.pi
    latitude = (0.5 - (np.arange(height) + 0.5) / height) * np.pi
    longitude, latitude = np.meshgrid(longitude, latitude)
    rays = np.stack([np.cos(latitude) * np.sin(longitude), -np.sin(latitude), np.cos(latitude) * np.cos(longitude)], -1)
    return np.round((rays + 1) * 127.5).astype(np.uint8)


def test_a_panorama_shows_what_lies_along_a_ray():
    rays = np.random.default_rng(0).standard_normal((200, 200, 3))
    rays[0, :100] = [0, 0, -1]  # the seam
    rays[0, :100, 0] = np.linspace(-0.01, 0.01, 100)
    rays[1, :2] = [[0, 1, 0], [0, -1, 0]]
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    shown = panoramas.sample_panorama(directions(256), rays) / 127.5 - 1
    np.testing.assert_allclose(shown, rays, atol=1.2 / 127.5)


def test_the_seam_of_a_panorama_is_like_any_other_place():
    panorama = np.random.default_rng(0).integers(0, 256, (4, 8, 3), dtype=np.uint8)
    latitude = math.pi / 8  # the row below the horizon
    ray = np.array([[[0, math.sin(latitude), -math.cos(latitude)]]])
    shown = panoramas.sample_panorama(panorama, ray)[0, 0]
    np.testing.assert_allclose(shown, (panorama[2, 0].astype(float) + panorama[2, -1]) / 2, atol=0.6)


def test_a_panorama_does_not_depend_on_threads(photograph, threads):
    rays = np.random.default_rng(0).standard_normal((301, 303, 3))
    y, x = torch.from_numpy(rays.astype(np.float32).ravel()[: 2 * 57593].reshape(2, -1))
    shown, angles = [], []
    for count in (1, 2, 3):
        threads(count)
        shown.append(panoramas.sample_panorama(photograph(128, 256), rays, 2))
        angles.append(panoramas._atan2(y, x).numpy())
    for other in (1, 2):
        np.testing.assert_array_equal(shown[other], shown[0])
        # a last bit would hardly ever show in grey levels
        np.testing.assert_array_equal(angles[other], angles[0])


def test_rays_between_pixels_are_those_of_the_enlarged_camera():
    camera = fr.FisheyeCamera.from_projection("equisolid", 170, (64, 64))
    grid = np.stack(np.meshgrid(np.arange(64.0), np.arange(64.0)), -1)
    fine = np.stack(np.meshgrid(np.arange(192.0), np.arange(192.0)), -1)
    between = panoramas.sample_panorama(directions(256), camera.unproject(grid)[0], 3)
    exact = panoramas.sample_panorama(directions(256), camera.resize((192, 192)).unproject(fine)[0])
    assert np.abs(between.astype(int) - exact).max() <= 1


@pytest.mark.parametrize(
    ("angles", "forward"), [((0.3, 0, 0), (0.29552, 0, 0.95534)), ((0, 0.3, 0), (0, -0.29552, 0.95534))]
)
def test_yaw_turns_right_and_pitch_turns_up(angles, forward):
    rotation = panoramas.view_rotation(*angles)
    np.testing.assert_allclose(rotation @ [0, 0, 1], forward, atol=1e-5)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)


def test_angles_within_a_panorama_are_true():
    """The angle between the directions that two pixels show is the angle between the camera's rays."""
    pairs = SyntheticPairs(in_memory((directions(256), None), is_panorama=True), size=(64, 64), seed=2)
    grid = np.stack(np.meshgrid(np.arange(64.0), np.arange(64.0)), -1)
    for index in range(6):
        pair = pairs[index]
        rays, _ = fr.FisheyeCamera(pair.camera, (64, 64)).unproject(grid)
        shown = pair.fisheye / 127.5 - 1
        cosines = shown.reshape(-1, 3) @ shown[32, 32]
        np.testing.assert_allclose(cosines, rays.reshape(-1, 3) @ rays[32, 32], atol=0.03)


def test_a_panorama_pair_belongs_together(photograph):
    noise = photograph(128, 256)
    pairs = SyntheticPairs(in_memory((noise, None), is_panorama=True), size=(128, 128))
    for index in range(4):
        pair = pairs[index]
        camera, view = fr.FisheyeCamera(pair.camera, (128, 128)), fr.PinholeCamera(pair.view, (128, 128))
        assert psnr(fr.numpy.rectify(pair.fisheye, camera, view, padding="border").image, pair.rectified) > 32


# --- What pairs are drawn from --------------------------------------------------------------------


@pytest.mark.parametrize("panorama", [False, True])
def test_the_standard_protocol(panorama):
    rng, size = np.random.default_rng(0), (256, 256)
    drawn = [lenses.draw_camera(rng, STANDARD, "all", size, panorama=panorama) for _ in range(1500)]
    params = np.array([d.params for d in drawn])
    theta_c = np.degrees([d.theta_c for d in drawn])
    kinds = np.array([d.kind for d in drawn])
    assert np.mean(kinds == "profile") == pytest.approx(0.65, abs=0.04)
    assert {*kinds} == {"profile", *lenses.PROJECTIONS}
    widest = 100 if panorama else 70
    assert 35 <= theta_c.min() < 36
    assert widest - 3 < theta_c[kinds != "profile"].max() <= widest
    np.testing.assert_allclose(params[:, 2:4].mean(0), 127.5, atol=0.3)
    np.testing.assert_allclose(params[:, 2:4].std(0), 3, atol=0.2)
    aspect = params[:, 1] / params[:, 0] - 1
    assert 0.004 < np.abs(aspect).max() <= 0.005

    corners = np.array([(x, y) for x in (-0.5, 255.5) for y in (-0.5, 255.5)])
    limits = {tuple(profile.k): profile.theta_max for profile in lenses.load_profiles("all")}
    for d in drawn[:300]:
        camera = fr.FisheyeCamera(d.params, size)
        rays, valid = camera.unproject(corners)
        assert valid.all()
        theta = np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2])
        assert theta.max() == pytest.approx(d.theta_c, abs=1e-6)
        assert camera.theta_max > d.theta_c
        if d.kind == "profile":
            assert d.theta_c <= limits[tuple(d.params[4:])]


def test_ideal_projections_are_what_their_names_say():
    rng = np.random.default_rng(0)
    formulas = {"equidistant": lambda t: t, "stereographic": lambda t: 2 * np.tan(t / 2)}
    formulas |= {"equisolid": lambda t: 2 * np.sin(t / 2), "orthographic": np.sin}
    for _ in range(60):
        d = lenses.draw_camera(rng, Recipe("ideal", profile_share=0), "all", (256, 256))
        theta = np.linspace(0, d.theta_c, 50)
        rays = np.stack([np.sin(theta), 0 * theta, np.cos(theta)], -1)
        radius = fr.FisheyeCamera(d.params, (256, 256)).project(rays)[0][:, 0] - d.params[2]
        ideal = formulas[d.kind](theta)
        np.testing.assert_allclose(radius, ideal * radius[-1] / ideal[-1], atol=0.1)


def test_the_wide_recipe_reaches_beyond_170_degrees_and_always_rises():
    rng = np.random.default_rng(0)
    drawn = [lenses.draw_camera(rng, WIDE, "all", (192, 256), panorama=True) for _ in range(3000)]
    assert sum(d.theta_c > math.radians(85) for d in drawn) > 200
    powers = 2 * np.arange(4) + 2
    k = np.array([d.params[4:] for d in drawn])
    theta = np.linspace(0, 1, 100) * np.array([d.theta_c for d in drawn])[:, None]
    slope = 1 + np.einsum("bi,i,bti->bt", k, powers + 1, theta[..., None] ** powers)
    assert slope.min() > 0.05


def test_a_lens_that_folds_is_not_used_beyond_its_fold(monkeypatch):
    """Whatever field of view a profile claims."""
    folding = lenses.Profile("folds at 58 degrees", np.array([-0.3, -0.01, 0, 0]), math.radians(80))
    monkeypatch.setattr(lenses, "load_profiles", lambda split: (folding,))
    rng, recipe = np.random.default_rng(0), Recipe("profiles", profile_share=1)
    theta_c = np.degrees([lenses.draw_camera(rng, recipe, "all", (256, 256)).theta_c for _ in range(200)])
    assert 50 < theta_c.max() < 58


def test_validation_lenses_are_unseen_in_training():
    names = {split: {profile.name for profile in lenses.load_profiles(split)} for split in lenses.SPLITS}
    assert not names["training"] & names["validation"]
    assert names["training"] | names["validation"] == names["all"]
    assert len(names["validation"]) > 50


def test_the_shipped_profiles_are_the_whole_ones_of_the_collection():
    if not (SHARED / "lens_profiles.csv").exists():
        pytest.skip(f"the collection is not there: {SHARED / 'lens_profiles.csv'}")
    with open(SHARED / "lens_profiles.csv", newline="", encoding="utf-8") as stream:
        rows = [row for row in csv.DictReader(stream) if row["dfov_deg"] and float(row["dfov_deg"]) >= 72]
    shipped = lenses.load_profiles("all")
    assert len(shipped) == len(rows)
    for profile, row in zip(shipped, rows, strict=True):
        assert profile.name == f"{row['brand']} {row['model']}"
        np.testing.assert_array_equal(profile.k, [float(row[f"k{i}"]) for i in (1, 2, 3, 4)])
        assert math.degrees(2 * profile.theta_max) == pytest.approx(float(row["dfov_deg"]))


# --- Sources --------------------------------------------------------------------------------------


def test_folders_of_every_layout_can_be_mixed(scenes, photograph, tmp_path):
    for name, shape in (("photos", (40, 50)), ("pano", (40, 80))):
        (tmp_path / name / "deep").mkdir(parents=True)
        for i in range(30):
            Image.fromarray(photograph(*shape)).save(tmp_path / name / ("deep" if i % 2 else "") / f"{i}.png")
    roots = scenes, tmp_path / "photos", tmp_path / "pano"
    by_split = {split: Sources.open(*roots, split=split) for split in lenses.SPLITS}
    names = {split: [source.name for source in sources] for split, sources in by_split.items()}
    assert sorted(names["training"] + names["validation"]) == sorted(names["all"])
    assert len(names["all"]) == 5 + 30 + 30
    assert names["validation"][:2] == ["scenes/images/validation/0.jpg", "scenes/images/validation/1.jpg"]
    for source in by_split["all"]:
        assert source.is_panorama == source.name.startswith("pano/")
        assert (source.decode().labels is not None) == source.name.startswith("scenes/")


def test_palette_labels_are_read_as_numbers(scenes):
    path = scenes / "annotations" / "training" / "0.png"
    with Image.open(path) as image:
        labels = np.asarray(image)
    palette = Image.fromarray(labels).convert("P")
    palette.putdata(labels.ravel())
    palette.save(path)
    np.testing.assert_array_equal(Sources.open(scenes)[0].decode().labels, labels)


def damage_picture(root):
    path = root / "images" / "training" / "1.jpg"
    path.write_bytes(path.read_bytes()[:500])


def damage_labels(root):
    (root / "annotations" / "training" / "1.png").write_bytes(b"not a picture")


def remove_labels(root):
    (root / "annotations" / "training" / "1.png").unlink()


def shrink_labels(root):
    Image.new("L", (20, 20)).save(root / "annotations" / "training" / "1.png")


def colour_labels(root):
    Image.new("RGB", (120, 90)).save(root / "annotations" / "training" / "1.png")


@pytest.mark.parametrize("harm", [damage_picture, damage_labels, remove_labels, shrink_labels, colour_labels])
def test_a_source_that_cannot_be_read_is_named_and_skipped(scenes, tmp_path, harm):
    harm(scenes)
    sources = Sources.open(scenes)
    failures = []
    kept = sources.into_memory(on_failure=failures.append)
    assert [source.name for source in kept] == [f"scenes/images/training/{i}.jpg" for i in (0, 2)]
    assert [error.source for error in failures] == ["scenes/images/training/1.jpg"]
    with pytest.raises(SourceError, match=r"training/1\.(jpg|png)"):
        sources.into_memory()

    pairs = SyntheticPairs(sources, size=(32, 32), cameras_per_source=2)
    written = write_pairs(pairs, tmp_path / "pairs", 6, jobs=2)
    assert list(written.failures) == ["scenes/images/training/1.jpg"]
    assert written.pairs == len(read_manifest(tmp_path / "pairs")) == 4


# --- Determinism and folders ----------------------------------------------------------------------


def content(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_a_pair_depends_on_seed_and_index_alone(photograph):
    sources = in_memory(*((photograph(100, 120, seed), None) for seed in range(3)))
    pairs = SyntheticPairs(sources, size=(48, 48), recipe="wide", cameras_per_source=2)
    forwards = list(pairs)
    assert len(forwards) == len(pairs) == 6
    assert [a.source == b.source for a, b in itertools.pairwise(forwards)] == [1, 0, 1, 0, 1]
    assert {pair.source for pair in forwards} == {source.name for source in sources}
    again = SyntheticPairs(sources, size=(48, 48), recipe="wide", cameras_per_source=2)
    other = SyntheticPairs(sources, size=(48, 48), recipe="wide", cameras_per_source=2, seed=1)
    for index in (5, 2, 0):
        np.testing.assert_array_equal(again[index].fisheye, forwards[index].fisheye)
        np.testing.assert_array_equal(again[index].camera, forwards[index].camera)
        assert not np.array_equal(other[index].camera, forwards[index].camera)
    # the next round has other cameras
    assert not np.array_equal(pairs[6].camera, forwards[0].camera)


def test_the_folder_is_the_same_at_any_worker_count(photograph, tmp_path):
    sources = in_memory(*((photograph(80, 160, seed), None) for seed in range(2)), is_panorama=True)
    pairs = SyntheticPairs(sources, size=(40, 40), cameras_per_source=4)
    for jobs in (1, 3):
        assert write_pairs(pairs, tmp_path / str(jobs), 8, jobs=jobs) == (8, {})
    assert content(tmp_path / "1") == content(tmp_path / "3")
    for files, pair in zip(read_manifest(tmp_path / "1"), pairs, strict=True):
        np.testing.assert_array_equal(files.camera.params, pair.camera)
        np.testing.assert_array_equal(files.view.params, pair.view)
        np.testing.assert_array_equal(np.asarray(Image.open(files.fisheye)), pair.fisheye)
        assert (files.labels, files.source, files.kind) == (None, pair.source, pair.kind)


def test_a_killed_run_is_taken_up_where_it_was(scenes, tmp_path):
    options = ["--count-per-source", "40", "--size", "64", "--jobs", "2"]
    command = [sys.executable, "-P", "-m", "fisheyerec.cli", "synthesize", str(scenes), *options]
    killed, whole = tmp_path / "killed", tmp_path / "whole"
    process = subprocess.Popen([*command, "-o", str(killed)])
    manifest, deadline = killed / "manifest.jsonl", time.monotonic() + 60
    while process.poll() is None and not (manifest.exists() and manifest.read_bytes().count(b"\n") >= 5):
        assert time.monotonic() < deadline
        time.sleep(0.002)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert len(read_manifest(killed)) < 120, "too late to be killed"
    with open(manifest, "a") as stream:
        stream.write('{"fisheye": "half a li')

    pairs = SyntheticPairs(Sources.open(scenes), size=(64, 64), cameras_per_source=40)
    with pytest.raises(ValueError, match="--resume"):
        write_pairs(pairs, killed, 120)
    assert write_pairs(pairs, killed, 120, resume=True) == (120, {})
    assert write_pairs(pairs, whole, 120, jobs=2) == (120, {})
    found = content(killed)
    assert {name: found[name] for name in content(whole)} == content(whole)
    assert all(name.startswith(".") for name in found.keys() - content(whole).keys())


def test_a_source_that_was_mended_finds_its_place(scenes, tmp_path):
    pairs = SyntheticPairs(Sources.open(scenes), size=(32, 32))
    path = pairs.sources[pairs.source_number(0)].path
    good = path.read_bytes()
    path.write_bytes(b"")
    assert write_pairs(pairs, tmp_path / "mended", 3).pairs == 2
    path.write_bytes(good)
    pairs = SyntheticPairs(Sources.open(scenes), size=(32, 32))
    assert write_pairs(pairs, tmp_path / "mended", 3, resume=True) == (3, {})
    write_pairs(pairs, tmp_path / "whole", 3)
    assert content(tmp_path / "mended") == content(tmp_path / "whole")


def test_resuming_with_other_settings_is_refused(scenes, tmp_path):
    sources = Sources.open(scenes)
    write_pairs(SyntheticPairs(sources, size=(32, 32)), tmp_path, 1)
    for other in ({"size": (40, 40)}, {"size": (32, 32), "seed": 1}, {"size": (32, 32), "recipe": "wide"}):
        with pytest.raises(ValueError, match="settings"):
            write_pairs(SyntheticPairs(sources, **other), tmp_path, 1, resume=True)


@pytest.mark.parametrize("shape", [(1, 1, 3), (5, 7, 3), (64, 48, 3), (1, 1), (33, 20)])
def test_png_files_hold_the_pixels(tmp_path, shape):
    pixels = np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)
    write_png(tmp_path / "a.png", pixels)
    with Image.open(tmp_path / "a.png") as image:
        np.testing.assert_array_equal(np.asarray(image), pixels)
    assert os.listdir(tmp_path) == ["a.png"]


# --- Bad input ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"recipe": "narrow"}, "expected recipe in"),
        ({"split": "test"}, "expected split in"),
        ({"size": (256, 4)}, "expected size of at least"),
        ({"cameras_per_source": 0}, "expected cameras_per_source"),
        ({"seed": -1}, "seed of at least 0"),
    ],
)
def test_unusable_arguments(arguments, message):
    white = np.full((20, 20, 3), 255, np.uint8), None
    with pytest.raises(ValueError, match=message):
        SyntheticPairs(in_memory(white), **arguments)
    with pytest.raises(ValueError, match="at least one source"):
        SyntheticPairs(Sources([]))


def run(*arguments):
    return CliRunner().invoke(app, ["synthesize", *map(str, arguments)])


@pytest.mark.parametrize(
    ("root", "options", "message"),
    [
        ("absent", [], "expected a folder of pictures, got"),
        ("empty", [], "expected pictures of the split 'training' in"),
        ("scenes", ["--recipe", "narrow"], "expected recipe in"),
    ],
)
def test_the_command_says_in_one_line_what_is_wrong(scenes, tmp_path, root, options, message):
    (tmp_path / "empty").mkdir()
    result = run(tmp_path / root, "-o", tmp_path / "out", *options)
    assert result.exit_code == 2
    assert result.stderr.startswith("fisheyerec synthesize: ")
    assert message in result.stderr
    assert result.stderr.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_the_command_counts_what_failed(scenes, tmp_path):
    damage_picture(scenes)
    result = run(scenes, "-o", tmp_path / "out", "--count-per-source", 2, "--size", 32)
    assert result.exit_code == 1
    first, last = result.stderr.splitlines()
    assert "training/1.jpg" in first
    assert last == "fisheyerec synthesize: 1 of 3 sources failed"
    assert result.stdout == f"{tmp_path / 'out'}: 4 pairs of 2 sources\n"
    entries = [json.loads(line) for line in (tmp_path / "out" / "manifest.jsonl").read_text().splitlines()]
    assert len({entry["source"] for entry in entries}) == 2
    assert all((tmp_path / "out" / entry[key]).exists() for entry in entries for key in ("fisheye", "labels"))
