"""Evaluation: metrics against independent ones, identities of the displacement, runs that survive bad pictures."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.ndimage import gaussian_filter
from typer.testing import CliRunner

import fisheyerec as fr
from fisheyerec.cli import app
from fisheyerec.training import metrics, reports
from fisheyerec.training.evaluate import (
    MEASURES,
    METHODS,
    Evaluation,
    evaluate_methods,
    identity,
    load_methods,
    oracle,
    straighten,
)
from fisheyerec.training.judging import judge_folder
from fisheyerec.training.pairs import MANIFEST, camera_entry, read_manifest, write_png
from fisheyerec.training.records import HEADER, read_records, write_records
from fisheyerec.weights import save_network

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"
SIZE = (64, 80)


@pytest.fixture
def pictures():
    """Two similar pictures."""
    rng = np.random.default_rng(0)
    truth = gaussian_filter(rng.integers(0, 256, (70, 90, 3)).astype(float), (1, 1, 0))
    truth = np.clip((truth - 127.5) * 3 + 127.5, 0, 255)
    noisy = np.clip(truth + rng.normal(0, 12, truth.shape), 0, 255)
    return noisy.round().astype(np.uint8), truth.round().astype(np.uint8)


def camera_of(fov_deg=120, projection="equidistant"):
    return fr.FisheyeCamera.from_projection(projection, fov_deg, SIZE)


def drawn(number):
    """A picture with structure at several scales."""
    y, x = np.mgrid[: 2 * SIZE[0], : 2 * SIZE[1]]
    waves = [np.sin(x / (5 + number) + c) + np.cos(y / 7 - c) + np.sin((x + y) / 11) for c in range(3)]
    return (127.5 + 40 * np.stack(waves, -1)).astype(np.uint8)


@pytest.fixture
def folder(tmp_path):
    """Six pairs of three sources, with labels, as another tool may have written them."""
    lines = []
    for i in range(6):
        camera = camera_of(100 + 10 * (i % 2), ("equidistant", "equisolid")[i % 2])
        view = fr.PinholeCamera.edge_matched(camera, SIZE)
        source = fr.PinholeCamera.from_fov(140, (2 * SIZE[0], 2 * SIZE[1]))
        picture = drawn(i // 2)
        labels = (picture[..., 0] // 64).astype(np.uint8)
        write_png(tmp_path / f"f{i}.png", fr.numpy.distort(picture, source, camera, padding="border").image)
        write_png(tmp_path / f"l{i}.png", fr.numpy.distort(labels, source, camera, interpolation="nearest").image)
        tensor = torch.from_numpy(picture).permute(2, 0, 1)[None]
        straight, _ = fr.resample(tensor, source, view, padding="border")
        write_png(tmp_path / f"r{i}.png", straight[0].permute(1, 2, 0).numpy())
        entry = {"fisheye": f"f{i}.png", "rectified": f"r{i}.png", "labels": f"l{i}.png"}
        entry |= {"camera": camera_entry(camera), "view": camera_entry(view), "source": f"s{i // 2}"}
        lines.append(json.dumps(entry | {"kind": ("equidistant", "equisolid")[i % 2]}))
    (tmp_path / MANIFEST).write_text("\n".join(lines) + "\n")
    return tmp_path


# --- Pictures -------------------------------------------------------------------------------------


def test_metrics_are_those_of_scikit_image(pictures):
    skimage = pytest.importorskip("skimage.metrics", reason="scikit-image is not installed")
    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 255}
    assert metrics.ssim(*pictures) == pytest.approx(
        skimage.structural_similarity(*pictures, channel_axis=2, **options), abs=1e-6
    )
    assert metrics.psnr(*pictures) == pytest.approx(
        skimage.peak_signal_noise_ratio(pictures[1], pictures[0], data_range=255), abs=1e-9
    )


def ssim_by_scipy(picture, truth, mask):
    """Wang et al. written down with another library's Gaussian."""

    def blur(values):
        return gaussian_filter(values, (1.5, 1.5, 0), truncate=3.5)

    x, y = picture.astype(float), truth.astype(float)
    mx, my = blur(x), blur(y)
    c1, c2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2
    luminance = (2 * mx * my + c1) / (mx**2 + my**2 + c1)
    structure = (2 * (blur(x * y) - mx * my) + c2) / (blur(x * x) - mx**2 + blur(y * y) - my**2 + c2)
    return (luminance * structure).mean(-1)[5:-5, 5:-5][mask[5:-5, 5:-5]].mean()


def test_ssim_over_all_and_over_a_mask(pictures):
    everywhere = np.ones(pictures[0].shape[:2], bool)
    half = everywhere.copy()
    half[:, :50] = False
    assert metrics.ssim(*pictures) == pytest.approx(ssim_by_scipy(*pictures, everywhere), abs=1e-9)
    assert metrics.ssim(*pictures, half) == pytest.approx(ssim_by_scipy(*pictures, half), abs=1e-9)
    assert metrics.ssim(pictures[0], pictures[0]) == pytest.approx(1)
    assert math.isnan(metrics.ssim(*pictures, ~everywhere))
    assert math.isnan(metrics.ssim(pictures[0][:10], pictures[1][:10]))


def test_psnr_over_all_and_over_a_mask(pictures):
    _, truth = pictures
    shifted = np.where(truth < 128, truth + 10, truth - 10).astype(np.uint8)
    assert metrics.psnr(shifted, truth) == pytest.approx(20 * math.log10(25.5))
    assert metrics.psnr(truth, truth) == math.inf
    mask = np.zeros(truth.shape[:2], bool)
    assert math.isnan(metrics.psnr(shifted, truth, mask))
    mask[3, 4] = True
    shifted[3, 4] = truth[3, 4]
    assert metrics.psnr(shifted, truth, mask) == math.inf


def test_mean_iou():
    truth = np.array([[1, 1, 2, 2, 0, 3]])
    assert metrics.mean_iou(truth, truth) == 1
    # class 1: 1 of 2; class 2: 2 of 4; class 3: 0; what is unlabelled does not count
    assert metrics.mean_iou(np.array([[1, 2, 2, 2, 1, 2]]), truth) == pytest.approx((1 / 2 + 1 / 2 + 0) / 3)
    assert math.isnan(metrics.mean_iou(truth, 0 * truth))


# --- Positions and parameters ---------------------------------------------------------------------


def displacement_of(estimate, truth):
    views = [fr.PinholeCamera.edge_matched(camera, SIZE) for camera in (estimate, truth)]
    estimated, true = (metrics.look_up(c, v) for c, v in zip((estimate, truth), views, strict=True))
    return metrics.displacement(estimated, true, metrics.look_up_identity(truth, views[1]))


def test_the_true_camera_is_nowhere_off():
    assert displacement_of(camera_of(), camera_of()).max() == 0


def test_a_lens_that_scales_tan_theta_draws_the_same_picture():
    """What no single photo can tell does not count: another lens, another field of view, the same straight lines."""
    truth = camera_of(100)
    theta = np.linspace(0.01, math.radians(60), 200)
    scaled = np.arctan(1.3 * np.tan(theta))
    f = truth.params[0]
    powers = scaled[:, None] ** (2 * np.arange(5) + 1)
    solution = np.linalg.lstsq(powers, f * theta, rcond=None)[0]
    params = [solution[0], solution[0], *truth.params[2:4], *solution[1:] / solution[0]]
    other = fr.FisheyeCamera(params, SIZE)
    assert metrics.field_of_view_deg(other) - metrics.field_of_view_deg(truth) > 10
    assert metrics.parameter_errors(other, truth)["fx"] > 0.1
    assert displacement_of(other, truth).mean() < 0.02
    assert displacement_of(camera_of(120), truth).mean() > 0.3


def test_doing_nothing_is_off_by_the_distortion():
    camera = camera_of()
    view = fr.PinholeCamera.edge_matched(camera, (32, 40))
    nothing = metrics.look_up_identity(camera, view)
    np.testing.assert_allclose(nothing[0, 0], [0.5, 0.5])
    np.testing.assert_allclose(nothing[31, 39], [78.5, 62.5])
    truth = metrics.look_up(camera, view)
    np.testing.assert_allclose(
        metrics.displacement(nothing, truth, nothing), np.hypot(*np.moveaxis(nothing - truth, -1, 0))
    )


def test_what_the_estimate_does_not_see_counts_as_doing_nothing():
    truth, nothing = np.zeros((2, 2, 2)), np.full((2, 2, 2), [3.0, 4.0])
    estimate = np.zeros((2, 2, 2))
    estimate[0, 0] = np.nan
    truth[1, 1] = np.nan
    np.testing.assert_array_equal(metrics.displacement(estimate, truth, nothing), [[5, 0], [0, np.nan]])


def test_field_of_view():
    assert metrics.field_of_view_deg(camera_of(100)) == pytest.approx(100 * math.hypot(64, 80) / 80, rel=1e-6)


def test_bootstrap_draws_whole_sources():
    rng = np.random.default_rng(0)
    values = rng.normal(10, 2, 100)
    names = [str(i) for i in range(100)]
    low, high = metrics.bootstrap_interval(values, names)
    assert low < values.mean() < high
    assert high - low == pytest.approx(2 * 1.96 * 2 / math.sqrt(100), rel=0.25)
    # ten copies of each measurement are no more certain than one
    copies = metrics.bootstrap_interval(np.repeat(values, 10), list(np.repeat(names, 10)))
    np.testing.assert_allclose(copies, (low, high), atol=0.15)
    independent = metrics.bootstrap_interval(np.repeat(values, 10), [str(i) for i in range(1000)])
    assert independent[1] - independent[0] < (high - low) / 2
    values[3] = np.nan
    assert np.isfinite(metrics.bootstrap_interval(values, names)).all()
    assert np.isnan(metrics.bootstrap_interval(values * np.nan, names)).all()


# --- Running --------------------------------------------------------------------------------------


def test_the_frame_of_every_table(folder):
    evaluation = evaluate_methods(folder, load_methods(["identity", "oracle"]))
    nothing, true = (evaluation.summary()["methods"][name] for name in ("identity", "oracle"))
    assert (true["displacement_px"], true["label_miou"], true["fov_error_deg"]) == (0, 1, 0)
    assert set(true["parameter_errors"].values()) <= {0, None}
    assert true["psnr"] > 35 > 25 > nothing["psnr"]
    assert true["ssim"] > 0.99 > 0.95 > nothing["ssim"]
    assert nothing["displacement_px"] > 2
    assert (nothing["no_estimate"], true["no_estimate"], true["failed"], true["count"]) == (6, 0, 0, 6)
    of_kind = nothing["kinds"]["equisolid"]
    assert of_kind["count"] == 3
    assert of_kind["intervals"]["psnr"][0] <= of_kind["psnr"] <= of_kind["intervals"]["psnr"][1]
    low, high = nothing["intervals"]["psnr"]
    assert low <= nothing["psnr"] <= high
    json.dumps(evaluation.summary(), allow_nan=False)


def test_methods_are_judged_by_their_own_edge_matched_view(folder):
    def wider(image):
        assert image.shape == (*SIZE, 3)
        assert image.dtype == np.uint8
        return camera_of(115)

    result = evaluate_methods(folder, {"wider": wider}, limit=1).results[0]
    camera, files = camera_of(115), read_manifest(folder)[0]
    straight = fr.numpy.rectify(
        np.asarray(Image.open(files.fisheye)), camera, fr.PinholeCamera.edge_matched(camera, SIZE)
    )
    assert result.psnr == metrics.psnr(straight.image, np.asarray(Image.open(files.rectified)))
    assert result.displacement_px == pytest.approx(displacement_of(camera, files.camera).mean())
    np.testing.assert_array_equal(result.params, camera.params)


def test_labels_are_straightened_without_mixing():
    labels = np.random.default_rng(0).choice([0, 3, 200], SIZE).astype(np.uint8)
    view = fr.PinholeCamera.edge_matched(camera_of(), (40, 50))
    for camera in (camera_of(), None):
        straight, valid = straighten(labels, camera, view)
        assert straight.shape == valid.shape == (40, 50)
        assert set(np.unique(straight)) == {0, 3, 200}


def test_a_principal_point_that_is_not_told_has_its_price(tmp_path, folder):
    """The true profile alone: nothing where the principal point is in the middle, its offset and more elsewhere."""
    assert evaluate_methods(folder, load_methods(["oracle-centred"])).results[0].displacement_px < 1e-9
    lines = [json.loads(line) for line in (folder / MANIFEST).read_text().splitlines()]
    for line in lines:
        line["camera"]["cx"] += 3
        camera = fr.FisheyeCamera([line["camera"][name] for name in fr.FisheyeCamera.parameter_names], SIZE)
        line["view"] = camera_entry(fr.PinholeCamera.edge_matched(camera, SIZE))
    (folder / MANIFEST).write_text("\n".join(map(json.dumps, lines)))
    for result in evaluate_methods(folder, load_methods(["oracle-centred"])).results:
        assert result.params[2] == (SIZE[1] - 1) / 2
        assert result.displacement_px > 2
        assert {name for name, error in result.parameter_errors.items() if error > 0} <= {"cx"}


def test_a_weights_file_is_a_method(folder, tmp_path):
    network = fr.FishEyeRecNet.compact(scene_parsing=False).eval()
    save_network(network, tmp_path / "own.safetensors", {})
    methods = load_methods(["own", "identity"], {"own": tmp_path / "own.safetensors"})
    picture = np.asarray(Image.open(folder / "f0.png"))
    estimate = fr.Rectifier.from_pretrained(tmp_path / "own.safetensors").estimate(picture, refine=False)
    np.testing.assert_array_equal(methods["own"](picture).params, estimate.camera.params)
    with pytest.raises(ValueError, match="got other"):
        load_methods(["other"], {"own": tmp_path / "own.safetensors"})
    with pytest.raises(FileNotFoundError, match="nowhere"):
        load_methods(["own"], {"own": tmp_path / "nowhere.safetensors"})


def raises(image):
    raise ZeroDivisionError("no arcs\nat all")


def of_another_size(image):
    return fr.FisheyeCamera.from_projection("equidistant", 120, (100, 100))


def not_finite(image):
    return fr.FisheyeCamera([math.nan] * 8, SIZE)


@pytest.mark.parametrize("method", [raises, of_another_size, not_finite])
def test_a_method_that_fails_counts_as_the_identity(folder, method):
    evaluation = evaluate_methods(folder, {"identity": identity, "bad": method})
    nothing, bad = (evaluation.summary()["methods"][name] for name in ("identity", "bad"))
    assert (bad["failed"], bad["no_estimate"], bad["count"]) == (6, 6, 6)
    assert (nothing["psnr"], nothing["displacement_px"]) == (bad["psnr"], bad["displacement_px"])
    assert all(result.error and "\n" not in result.error for result in evaluation.of("bad"))


def test_a_picture_that_cannot_be_read_is_skipped_and_named(folder):
    (folder / "f1.png").unlink()
    (folder / "r2.png").write_bytes((folder / "r2.png").read_bytes()[:200])
    write_png(folder / "l3.png", np.zeros((3, 3), np.uint8))
    write_png(folder / "r4.png", np.zeros((64, 81, 3), np.uint8))
    evaluation = evaluate_methods(folder, {"oracle": oracle})
    assert list(evaluation.skipped) == ["f1.png", "f2.png", "f3.png", "f4.png"]
    assert "80x64, got 3x3" in evaluation.skipped["f3.png"]
    assert "80x64, got 81x64" in evaluation.skipped["f4.png"]
    assert [result.picture for result in evaluation.results] == ["f0.png", "f5.png"]


def load_shipped(name):
    """A method, where what it needs is there."""
    try:
        return load_methods([name])
    except (FileNotFoundError, ImportError) as error:
        pytest.skip(f"{name} is not there: {error}")


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("size", [(1, 1), (1, 40), (30, 30)])
def test_tiny_and_uniform_pictures_go_through_every_method(tmp_path, size, name):
    camera = fr.FisheyeCamera.from_projection("equidistant", 100, size)
    entry = {"fisheye": "a.png", "rectified": "a.png", "labels": None, "camera": camera_entry(camera)}
    entry["view"] = camera_entry(fr.PinholeCamera.edge_matched(camera, size))
    (tmp_path / MANIFEST).write_text(json.dumps(entry) + "\n\n")
    write_png(tmp_path / "a.png", np.full((*size, 3), 128, np.uint8))
    evaluation = evaluate_methods(tmp_path, {"identity": identity} | load_shipped(name))
    assert {result.method for result in evaluation.results} == {"identity", name}
    assert evaluation.skipped == {}
    assert evaluation.summary()["methods"]["identity"]["psnr"] == 100
    assert {result.displacement_px for result in evaluation.results if result.params is None} == {
        evaluation.of("identity")[0].displacement_px
    }
    json.dumps(evaluation.summary(), allow_nan=False)
    assert "identity" in reports.text_table(evaluation.summary())


# --- Records --------------------------------------------------------------------------------------


def untimed(path):
    """A CSV of records without the run times."""
    with open(path, newline="") as stream:
        return [{key: value for key, value in row.items() if key != "ms"} for row in csv.DictReader(stream)]


@pytest.mark.parametrize("name", ["records.csv", "records.csv.gz"])
def test_records_come_back(folder, tmp_path, name):
    evaluation = evaluate_methods(folder, {"identity": identity, "oracle": oracle, "bad": raises})
    write_records(tmp_path / name, evaluation.results)
    content = (tmp_path / name).read_bytes()
    results = read_records(tmp_path / name)
    write_records(tmp_path / name, results)
    assert (tmp_path / name).read_bytes() == content
    for there, back in zip(evaluation.results, results, strict=True):
        assert (there.picture, there.source, there.kind, there.method, there.error) == (
            back.picture,
            back.source,
            back.kind,
            back.method,
            back.error,
        )
        assert back.displacement_px == pytest.approx(there.displacement_px, rel=1e-5)
        assert (back.params is None) == (there.params is None)
    summaries = [e.summary()["methods"] for e in (evaluation, Evaluation(evaluation.methods, 6, results))]
    for method in evaluation.methods:
        for measure in MEASURES:
            assert summaries[0][method][measure] == pytest.approx(summaries[1][method][measure], rel=1e-5)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "got nothing"),
        ("a,b\n1,2\n", "got a,b"),
        (HEADER + "f0.png,s0\n", "line 2: "),
        (HEADER + "," * HEADER.count(",") + "\n" + "x," * HEADER.count(",") + "\n", "line 3: .*float"),
    ],
)
def test_files_that_are_no_records(tmp_path, text, message):
    (tmp_path / "records.csv").write_text(text)
    with pytest.raises(ValueError, match=message):
        read_records(tmp_path / "records.csv")
    (tmp_path / "records.csv.gz").write_text(text)
    with pytest.raises(ValueError, match=r"records\.csv\.gz: "):
        read_records(tmp_path / "records.csv.gz")


def test_a_killed_run_goes_on_and_ends_with_the_same_records(folder, tmp_path):
    whole, resumed = tmp_path / "whole.csv", tmp_path / "resumed.csv"
    names = ["identity", "oracle"]
    evaluation = judge_folder(folder, names, whole)
    assert [(result.picture, result.method) for result in evaluation.results] == [
        (f"f{i}.png", name) for i in range(6) for name in names
    ]
    lines = whole.read_text().splitlines(keepends=True)
    # two pictures, one method of a third, and a part of the next line
    resumed.write_text("".join(lines[:6]) + lines[6][:40])
    seen = []
    again = judge_folder(folder, names, resumed, jobs=2, on_picture=seen.append)
    assert resumed.read_text().startswith("".join(lines[:6]))
    assert untimed(resumed) == untimed(whole)
    assert seen == [6] * 6
    assert len(again.results) == 12
    before = whole.read_bytes()
    judge_folder(folder, names, whole)
    assert whole.read_bytes() == before


def test_methods_are_added_to_records(folder, tmp_path):
    records, at_once = tmp_path / "records.csv", tmp_path / "at_once.csv"
    judge_folder(folder, ["oracle"], records)
    evaluation = judge_folder(folder, ["identity"], records, limit=2)
    assert [result.method for result in evaluation.results] == ["identity"] * 2
    assert len(read_records(records)) == 8
    judge_folder(folder, ["identity", "oracle"], records)
    judge_folder(folder, ["identity", "oracle"], at_once)
    assert untimed(records) == untimed(at_once)


def test_what_could_not_be_read_is_tried_again(folder, tmp_path):
    content = (folder / "f1.png").read_bytes()
    (folder / "f1.png").unlink()
    evaluation = judge_folder(folder, ["identity"], tmp_path / "records.csv")
    assert list(evaluation.skipped) == ["f1.png"]
    assert (evaluation.count, len(evaluation.results)) == (6, 5)
    (folder / "f1.png").write_bytes(content)
    evaluation = judge_folder(folder, ["identity"], tmp_path / "records.csv")
    assert evaluation.skipped == {}
    assert [result.picture for result in evaluation.results] == [f"f{i}.png" for i in range(6)]


def test_records_of_other_pairs_are_not_mixed(folder, tmp_path):
    judge_folder(folder, ["identity"], tmp_path / "records.csv", limit=1)
    manifest = (folder / MANIFEST).read_text()
    (folder / MANIFEST).write_text(manifest.replace('"source": "s0"', '"source": "s9"'))
    with pytest.raises(ValueError, match=r"expected records of the same pairs in .*, got f0\.png of other ones"):
        judge_folder(folder, ["identity"], tmp_path / "records.csv")
    with pytest.raises(ValueError, match="expected methods out of"):
        judge_folder(folder, ["magic"], tmp_path / "other.csv")
    assert not (tmp_path / "other.csv").exists()


# --- Manifests ------------------------------------------------------------------------------------

GOOD = {
    "fisheye": "a.png",
    "rectified": "b.png",
    "labels": None,
    "camera": camera_entry(camera_of()),
    "view": camera_entry(fr.PinholeCamera.from_fov(90, SIZE)),
}


def test_a_manifest_without_extras_is_read(tmp_path):
    (tmp_path / MANIFEST).write_text(json.dumps(GOOD))
    (pair,) = read_manifest(tmp_path)
    assert (pair.fisheye, pair.rectified, pair.labels) == (tmp_path / "a.png", tmp_path / "b.png", None)
    assert (pair.name, pair.source, pair.kind) == ("a.png", "a.png", None)
    np.testing.assert_array_equal(pair.camera.params, camera_of().params)
    assert pair.camera.image_size == pair.view.image_size == SIZE


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("{", "line 2: "),
        ("[1]", "expected an object"),
        (json.dumps({k: v for k, v in GOOD.items() if k != "camera"}), "expected camera with"),
        (json.dumps(GOOD | {"view": {"width": 1}}), "missing: fx, fy, cx, cy, height"),
        (json.dumps(GOOD | {"view": [1, 2]}), "expected view with"),
        (json.dumps(GOOD | {"camera": GOOD["camera"] | {"k1": "wide"}}), "expected numbers in camera"),
        (json.dumps(GOOD | {"camera": GOOD["camera"] | {"k1": math.nan}}), "expected finite numbers"),
        (json.dumps(GOOD | {"camera": GOOD["camera"] | {"fx": 0}}), "focal lengths above 0"),
        (json.dumps(GOOD | {"view": GOOD["view"] | {"width": 0}}), "image_size of at least"),
        (json.dumps(GOOD | {"fisheye": None}), "expected file names"),
        (json.dumps(GOOD | {"rectified": 7}), "expected a file name for rectified"),
    ],
)
def test_malformed_lines_are_pointed_at(tmp_path, line, message):
    (tmp_path / MANIFEST).write_text(f"{json.dumps(GOOD)}\n{line}\n")
    with pytest.raises(ValueError, match=message) as caught:
        read_manifest(tmp_path)
    assert f"{MANIFEST}, line 2: " in str(caught.value)


def test_folders_without_pairs(tmp_path):
    with pytest.raises(ValueError, match=r"expected a folder of pairs with a manifest\.jsonl"):
        read_manifest(tmp_path)
    (tmp_path / MANIFEST).write_text("\n")
    with pytest.raises(ValueError, match="got none"):
        read_manifest(tmp_path)


# --- The command ----------------------------------------------------------------------------------


def run(*arguments):
    return CliRunner().invoke(app, ["evaluate", *map(str, arguments)])


def test_the_command_writes_everything(folder, tmp_path):
    out = {name: tmp_path / f"out.{name}" for name in ("json", "csv", "png")}
    files = ["--json", out["json"], "--csv", out["csv"], "--sheet", out["png"]]
    result = run("--pairs", folder, "--method", "identity, oracle", *files)
    assert (result.exit_code, result.stderr) == (0, "")
    header, *rows = result.stdout.splitlines()
    assert header.split()[:3] == ["method", "PSNR", "dB"]
    assert [row.split()[0] for row in rows] == ["identity", "oracle"]
    methods = json.loads(out["json"].read_text())["methods"]
    wanted = {"psnr", "ssim", "psnr_valid", "ssim_valid", "displacement_px", "no_estimate", "ms", "count"}
    assert all(wanted <= methods[name].keys() for name in ("identity", "oracle"))
    with open(out["csv"], newline="") as stream:
        table = list(csv.DictReader(stream))
    assert len(table) == 12
    assert float(table[1]["psnr"]) == pytest.approx(
        metrics.psnr(
            fr.numpy.rectify(
                np.asarray(Image.open(folder / "f0.png")), camera_of(100), read_manifest(folder)[0].view
            ).image,
            np.asarray(Image.open(folder / "r0.png")),
        ),
        abs=1e-3,
    )
    assert table[0]["k1"] == ""
    assert float(table[1]["fx"]) == pytest.approx(camera_of(100).params[0], rel=1e-5)
    # columns: fisheye, ground truth, identity, oracle; the identity shows the fisheye picture again
    with Image.open(out["png"]) as sheet:
        pixels = np.asarray(sheet)
    side = reports._CELL
    lefts = [reports._MARGIN + column * (side + reports._GAP) for column in range(4)]
    assert pixels.shape[1] == lefts[-1] + side + reports._MARGIN
    for row in range(6):
        top = reports._MARGIN + reports._HEADER + row * (side + reports._CAPTION)
        fisheye, truth, nothing, true = (pixels[top : top + side, left : left + side] for left in lefts)
        np.testing.assert_array_equal(fisheye, nothing)
        assert metrics.psnr(true, truth) > 35 > 25 > metrics.psnr(fisheye, truth)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--pairs", "nowhere"], "expected a folder of pairs"),
        (["--pairs", ".", "--method", "identity,magic"], "expected methods out of identity, "),
        (["--pairs", ".", "--method", ","], "got none"),
    ],
)
def test_the_command_says_in_one_line_what_is_wrong(folder, monkeypatch, arguments, message):
    monkeypatch.chdir(folder)
    result = run(*arguments)
    assert result.exit_code == 2
    assert message in result.stderr
    assert result.stderr.startswith("fisheyerec evaluate: ")
    assert result.stderr.count("\n") == 1


def test_the_command_counts_what_it_skipped(folder):
    (folder / "f1.png").unlink()
    result = run("--pairs", folder, "--method", "oracle")
    assert result.exit_code == 1
    first, last = result.stderr.splitlines()
    assert "f1.png" in first
    assert last == "fisheyerec evaluate: 1 of 6 pairs could not be read"
    assert "oracle" in result.stdout


# --- The protocol ---------------------------------------------------------------------------------


def test_the_standard_protocol_scores_as_it_should(tmp_path):
    if not (SHARED / "scenes").is_dir():
        pytest.skip(f"photographs not there: {SHARED / 'scenes'}")
    options = ["--split", "validation", "--sources", "15", "--count-per-source", "2", "--jobs", "2"]
    made = CliRunner().invoke(app, ["synthesize", str(SHARED / "scenes"), "-o", str(tmp_path), *options])
    assert made.exit_code == 0
    summary = evaluate_methods(tmp_path, load_methods(["identity", "oracle"])).summary()["methods"]
    assert summary["identity"]["psnr"] == pytest.approx(17.6, abs=1.5)
    assert summary["identity"]["ssim"] == pytest.approx(0.44, abs=0.08)
    assert summary["identity"]["displacement_px"] == pytest.approx(5.2, abs=1.2)
    assert summary["oracle"]["psnr"] == pytest.approx(34.3, abs=2)
    assert summary["oracle"]["ssim"] == pytest.approx(0.967, abs=0.015)
