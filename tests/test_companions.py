"""What belongs to pictures moves with them on the command line: labels, masks, depth, points and COCO annotations."""

# ruff: noqa: E501  a table is read by its columns: one bad case a line

import csv
import json
import os
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

import fisheyerec as fr
from fisheyerec import file_rectifiers, rle
from fisheyerec.cli import app
from fisheyerec.pictures import Picture, read_picture, write_picture
from fisheyerec.point_files import read_points
from fisheyerec.rasters import Raster, read_raster, write_raster

SIZE, VIEW_SIZE = (48, 64), (40, 50)
CAMERA = fr.FisheyeCamera.from_projection("equidistant", 140, SIZE)
VIEW = fr.PinholeCamera.from_fov(100, VIEW_SIZE)
TURN = fr.view_rotation(pan_deg=20)
CALIBRATED = ["--camera", "lens.json", "--fov-deg", "100", "--size", "50x40"]
TURNED = [*CALIBRATED, "--pan", "20"]
NAMES = ("0", "b/1")
KINDS = ("labels", "mask", "depth", "distance", "points")


def rectify(*arguments):
    return CliRunner().invoke(app, ["rectify", *map(str, arguments)])


def along(*kinds):
    """Options that move files of these kinds from in to out."""
    return [part for kind in kinds for part in (f"--{kind}", f"in/{kind}", f"out/{kind}")]


def files():
    return {path: path.read_bytes() for path in Path().rglob("*") if path.is_file()}


@pytest.fixture
def data(tmp_path, monkeypatch):
    """in/images, two pictures, and beside it a folder for each kind of companion; what is in them by name and kind."""
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    for kind in ("images", *KINDS):
        (tmp_path / "in" / kind / "b").mkdir(parents=True)
    known = {}
    for name in NAMES:
        made = known[name] = {
            "image": rng.integers(0, 256, (*SIZE, 3), dtype=np.uint8),
            "labels": rng.integers(0, 30, SIZE, dtype=np.uint8),
            "mask": rng.random(SIZE) < 0.5,
            "depth": rng.integers(0, 60000, SIZE, dtype=np.uint16),
            "distance": rng.uniform(0, 9, SIZE).astype(np.float32),
            "points": np.round(rng.random((7, 2)) * [70, 50] - 3, 2),
        }
        write_picture(f"in/images/{name}.png", Picture(made["image"]))
        write_raster(f"in/labels/{name}.png", Raster(made["labels"], list(range(90))))
        write_raster(f"in/mask/{name}.bmp", Raster(made["mask"]))
        write_raster(f"in/depth/{name}.png", Raster(made["depth"]))
        write_raster(f"in/distance/{name}.npy", Raster(made["distance"]))
        lines = [f'"a, {i}",{y},{x},{i}' for i, (x, y) in enumerate(made["points"])]
        Path(f"in/points/{name}.csv").write_text("\n".join(["name,y,x,id", *lines]))
    CAMERA.save("lens.json")
    return known


# --- What becomes of them -------------------------------------------------------------------------


def test_companions_of_a_folder_move_as_the_library_moves_them(data):
    result = rectify("in/images", "-o", "out/images", *TURNED, *along(*KINDS))
    assert (result.exit_code, result.stderr) == (0, "")
    for name, known in data.items():
        given = {kind: known[kind] for kind in ("image", "labels", "mask", "depth", "points")}
        expected = fr.rectify_sample(fr.Sample(**given), CAMERA, VIEW, rotation=TURN)
        np.testing.assert_array_equal(read_picture(f"out/images/{name}.png").pixels, expected.image)
        labels = read_raster(f"out/labels/{name}.png")
        np.testing.assert_array_equal(labels.values, expected.labels)
        assert labels.palette[:90] == list(range(90))
        np.testing.assert_array_equal(read_raster(f"out/mask/{name}.bmp").values, 255 * expected.mask.astype(int))
        np.testing.assert_array_equal(read_raster(f"out/depth/{name}.png").values, expected.depth)
        distance = fr.Sample(depth=known["distance"], depth_kind="distance")
        expected_distance = fr.rectify_sample(distance, CAMERA, VIEW, rotation=TURN).depth
        np.testing.assert_array_equal(read_raster(f"out/distance/{name}.npy").values, expected_distance)
        with open(f"out/points/{name}.csv", newline="") as stream:
            rows = list(csv.DictReader(stream))
        assert list(rows[0]) == ["name", "y", "x", "id", "valid"]
        assert [row["name"] for row in rows] == [f"a, {i}" for i in range(7)]
        assert [row["valid"] for row in rows] == [str(int(valid)) for valid in expected.points_valid]
        assert 0 < expected.points_valid.sum() < 7
        for row, (x, y), valid in zip(rows, expected.points, expected.points_valid, strict=True):
            assert (row["x"], row["y"]) == ((f"{x:.4f}", f"{y:.4f}") if valid else ("", ""))


def test_labels_are_what_the_picture_of_them_is_by_nearest(data):
    assert rectify("in/images", "-o", "out/images", *CALIBRATED, *along("labels")).exit_code == 0
    grey = Path("grey.png")
    for name, known in data.items():
        write_picture(grey, Picture(known["labels"]))
        assert (
            rectify(grey, "-o", "nearest.png", "--overwrite", *CALIBRATED, "--interpolation", "nearest").exit_code == 0
        )
        np.testing.assert_array_equal(read_raster(f"out/labels/{name}.png").values, read_picture("nearest.png").pixels)


def test_points_that_were_moved_come_back(data):
    assert rectify("in/images", "-o", "out/images", *TURNED, *along("points")).exit_code == 0
    for name, known in data.items():
        moved = read_points(f"out/points/{name}.csv").points
        back = fr.distort_sample(fr.Sample(points=moved), VIEW, CAMERA, rotation=TURN)
        np.testing.assert_array_equal(back.points_valid, np.isfinite(moved).all(-1))
        np.testing.assert_allclose(back.points[back.points_valid], known["points"][back.points_valid], atol=1e-3)


def test_points_that_were_invalid_stay_so(data):
    Path("p.csv").write_text("x,y,valid\n30,20,1\n31,21,0\n,,1\nnan,3,1\n\n")
    assert rectify("in/images/0.png", "-o", "o.png", *CALIBRATED, "--points", "p.csv", "q.csv").exit_code == 0
    lines = Path("q.csv").read_text().splitlines()
    assert [line.split(",")[2] for line in lines] == ["valid", "1", "0", "0", "0"]
    assert lines[2:] == [",,0"] * 3


def test_one_picture_takes_files_or_finds_them_in_folders(data):
    options = [
        "--labels",
        "in/labels/0.png",
        "labels.tif",
        "--depth",
        "in/depth",
        "new/depth",
        "--mask",
        "in/mask/0.bmp",
        ".",
    ]
    assert rectify("in/images/0.png", "-o", "out.png", *CALIBRATED, *options).exit_code == 0
    for file, kind in {"labels.tif": "labels", "new/depth/0.png": "depth", "0.bmp": "mask"}.items():
        expected = getattr(fr.rectify_sample(fr.Sample(**{kind: data["0"][kind]}), CAMERA, VIEW), kind)
        np.testing.assert_array_equal(read_raster(file).values, 255 * expected if kind == "mask" else expected)


def test_averaging_is_for_the_picture_alone(data):
    coarse = ["--camera", "lens.json", "--fov-deg", "100", "--size", "10x8", "--antialias"]
    assert rectify("in/images", "-o", "out/images", *coarse, *along("labels")).exit_code == 0
    view = fr.PinholeCamera.from_fov(100, (8, 10))
    for name, known in data.items():
        sample = fr.Sample(image=known["image"], labels=known["labels"])
        expected, plain = (fr.rectify_sample(sample, CAMERA, view, antialias=a) for a in (True, False))
        np.testing.assert_array_equal(read_picture(f"out/images/{name}.png").pixels, expected.image)
        np.testing.assert_array_equal(read_raster(f"out/labels/{name}.png").values, plain.labels)


class Told:
    """Stands for a Rectifier that finds CAMERA in every picture, or no distortion."""

    def __init__(self, distorted):
        self.distorted = distorted

    def __call__(self, photo, *, rotation, antialias, **options):
        found = {"confidence": 1, "straightness_before": 0, "straightness_after": 0, "refined": True}
        image, valid = (
            fr.numpy.rectify(photo, CAMERA, VIEW, rotation=rotation) if self.distorted else (photo, np.ones(SIZE))
        )
        return SimpleNamespace(image=image, valid=valid, camera=CAMERA, view=VIEW, distorted=self.distorted, **found)


@pytest.mark.parametrize("distorted", [True, False])
def test_the_camera_that_is_estimated_for_a_picture_moves_what_belongs_to_it(data, coco, monkeypatch, distorted):
    monkeypatch.setattr(file_rectifiers, "_load", lambda weights: Told(distorted))
    command = [
        "in/images",
        "-o",
        "out/images",
        *along(*KINDS),
        "--annotations",
        "in/coco.json",
        "out/coco.json",
        "--pan",
        "20",
    ]
    assert rectify(*command).exit_code == 0
    for name, known in data.items():
        sample = fr.Sample(labels=known["labels"], depth=known["depth"])
        moved = fr.rectify_sample(sample, CAMERA, VIEW, rotation=TURN) if distorted else sample
        np.testing.assert_array_equal(read_raster(f"out/labels/{name}.png").values, moved.labels)
        np.testing.assert_array_equal(read_raster(f"out/depth/{name}.png").values, moved.depth)
        points = read_points(f"out/points/{name}.csv").points
        if not distorted:
            np.testing.assert_allclose(points, known["points"], atol=1e-4)
    blind = json.loads(Path("out/coco.json").read_text())
    if not distorted:
        assert blind["annotations"] == coco["annotations"][:5]
    else:
        assert (
            rectify(
                "in/images", "-o", "same/images", *TURNED, "--annotations", "in/coco.json", "same/coco.json"
            ).exit_code
            == 0
        )
        assert json.loads(Path("same/coco.json").read_text()) == blind
    # Taken up again, the cameras that were written down are used.
    assert rectify(*command, "--resume").exit_code == 0
    assert json.loads(Path("out/coco.json").read_text()) == blind


# --- Runs -----------------------------------------------------------------------------------------


def test_resume_does_again_what_belongs_to_a_changed_file(data):
    command = ["in/images", "-o", "out/images", *CALIBRATED, *along("labels", "points")]
    assert rectify(*command).exit_code == 0
    assert "2 of 2 files were done before" in rectify(*command, "--resume").stdout
    os.utime("in/labels/0.png", ns=(0, 10**18))
    os.unlink("out/points/b/1.csv")
    again = rectify(*command, "--resume")
    assert again.stdout.count("focal") == 2
    os.utime("in/points/0.csv", ns=(0, 10**18))
    again = rectify(*command, "--resume")
    assert again.stdout.count("focal") == 1
    assert "1 of 2 files were done before" in again.stdout
    assert "2 of 2 files were done before" in rectify(*command[:-3], "--resume").stdout  # fewer were asked for
    assert rectify(*command, *along("mask"), "--resume").stdout.count("focal") == 2
    entry = json.loads(Path("out/images/manifest.jsonl").read_text().splitlines()[-1])
    assert [companion["kind"] for companion in entry["companions"]] == ["labels", "mask", "points"]


def test_a_dry_run_names_every_file(data, coco):
    before = files()
    result = rectify(
        "in/images",
        "-o",
        "out/images",
        *CALIBRATED,
        *along("labels", "points"),
        "--annotations",
        "in/coco.json",
        "o.json",
        "--dry-run",
    )
    assert result.stdout.splitlines() == [
        "in/images/0.png -> out/images/0.png",
        "in/labels/0.png -> out/labels/0.png",
        "in/points/0.csv -> out/points/0.csv",
        "in/images/b/1.png -> out/images/b/1.png",
        "in/labels/b/1.png -> out/labels/b/1.png",
        "in/points/b/1.csv -> out/points/b/1.csv",
        "in/coco.json -> o.json",
    ]
    assert files() == before


# What is done to a companion -> what is said of its picture.
FAILURES = {
    "missing": ("labels", lambda path: path.unlink(), r"in/labels/b/1\.png: No such file"),
    "another_size": ("labels", lambda path: write_raster(path, Raster(np.zeros((64, 48), np.uint8))), r"expected in/labels/b/1\.png in the size of its picture, 64x48, got 48x64"),
    "no_raster": ("labels", lambda path: path.write_text("?"), r"expected a raster, got in/labels/b/1\.png of an unknown format"),
    "truncated": ("depth", lambda path: path.write_bytes(path.read_bytes()[:-900]), r"expected a complete raster, got in/depth/b/1\.png that is broken"),
    "no_array": ("distance", lambda path: path.write_text("?"), r"expected a NumPy array, got in/distance/b/1\.npy"),
    "array_of_words": ("distance", lambda path: np.save(path, np.full(SIZE, "a")), r"expected numbers of shape \(H, W\)"),
    "depth_in_colour": ("depth", lambda path: write_raster(path, Raster(np.zeros((*SIZE, 3), np.uint8))), r"in/depth/b/1\.png: .*sample\.depth of shape \(H, W\)"),
    "no_x": ("points", lambda path: path.write_text("a,y\n1,2\n"), r"expected in/points/b/1\.csv with a header that names x and y once, got 'a,y'"),
    "empty": ("points", lambda path: path.write_text(""), r"names x and y once, got ''"),
    "short_line": ("points", lambda path: path.write_text("x,y,n\n1,2,3\n1,2\n"), r"in/points/b/1\.csv, line 3: expected 3 cells as in the header, got 2"),
    "word": ("points", lambda path: path.write_text("x,y\n1,2\n1,two\n"), r"in/points/b/1\.csv, line 3: expected x and y as numbers, got '1' and 'two'"),
    "latin": ("points", lambda path: path.write_bytes(b"x,y,n\xe4me\n"), r"as CSV in UTF-8"),
}  # fmt: skip


@pytest.mark.parametrize(("kind", "spoil", "message"), FAILURES.values(), ids=FAILURES)
def test_a_companion_that_is_amiss_fails_its_picture_alone(data, kind, spoil, message):
    spoil(next(Path(f"in/{kind}/b").iterdir()))
    result = rectify("in/images", "-o", "out/images", *CALIBRATED, *along(*KINDS))
    assert result.exit_code == 1
    said, last = result.stderr.splitlines()
    assert said.startswith("fisheyerec rectify: ")
    assert re.search(message, said), said
    assert last == "fisheyerec rectify: 1 of 2 files failed"
    made = {path.relative_to("out").with_suffix("").as_posix() for path in Path("out").rglob("*") if path.is_file()}
    assert made == {f"{kind}/0" for kind in ("images", *KINDS)} | {"images/manifest"}


REFUSED = {
    "file_for_several": (["in/images", "-o", "out", "--labels", "in/labels/0.png", "l"], "expected a folder of labels for 2 files, got in/labels/0.png"),
    "lossy": (["in/images/0.png", "-o", "o.png", "--labels", "in/labels/0.png", "l.jpg"], r"expected labels in a file with a suffix such as \.png, got l\.jpg"),
    "points_as_json": (["in/images/0.png", "-o", "o.png", "--points", "in/points/0.csv", "p.json"], r"suffix such as \.csv, got p\.json"),
    "onto_itself": (["in/images", "-o", "out", "--labels", "in/labels", "in/labels"], "expected an output other than the picture itself"),
    "two_to_one": (["in/images", "-o", "out", "--labels", "in/labels", "l", "--depth", "in/depth", "l"], "expected an output for each input, got l/0.png"),
    "two_of_one": (["in/images", "-o", "out", "--labels", "in/mask", "l"], r"expected one companion of in/images/0\.png, got in/mask/0\.bmp and in/mask/0\.npy"),
    "there": (["in/images", "-o", "out", "--labels", "in/labels", "there"], "expected a new file, or --overwrite, got there/b/1.png"),
    "video": (["clip.mp4", "-o", "o.mp4", "--labels", "in/labels", "l"], r"expected pictures with --antialias, --interpolation nearest and what moves along, got clip\.mp4"),
    "video_nearest": (["clip.mp4", "-o", "o.mp4", "--interpolation", "nearest"], r"expected pictures with .* nearest"),
    "video_averaged": (["clip.mp4", "-o", "o.mp4", "--antialias"], r"expected pictures with --antialias"),
    "labels_averaged": (["in/images", "-o", "out", "--antialias", "--interpolation", "nearest"], "interpolation 'bilinear' for antialias, got 'nearest'"),
    "no_coco": (["in/images", "-o", "out", "--annotations", "in/none.json", "c.json"], r"in/none\.json: No such file"),
    "coco_onto_itself": (["in/images", "-o", "out", "--annotations", "in/coco.json", "in"], "expected an output other than the COCO file itself"),
    "coco_of_others": (["other.png", "-o", "o.png", "--annotations", "in/coco.json", "c.json"], r"expected other\.png among the images of in/coco\.json, got no such file_name"),
}  # fmt: skip


@pytest.mark.parametrize(("arguments", "message"), REFUSED.values(), ids=REFUSED)
def test_what_cannot_go_well_is_refused_before_anything_is_written(data, coco, arguments, message):
    write_raster("in/mask/0.npy", Raster(data["0"]["mask"]))
    Path("there/b").mkdir(parents=True)
    Path("there/b/1.png").touch()
    Path("clip.mp4").touch()
    write_picture("other.png", Picture(data["0"]["image"]))
    before = files()
    result = rectify(*arguments, *CALIBRATED)
    assert result.exit_code == 2
    assert len(result.stderr.splitlines()) == 1
    assert re.search(message, result.stderr), result.stderr
    assert files() == before


# --- Rasters --------------------------------------------------------------------------------------

LIMITS = [(bool, (0, 1)), (np.uint8, (0, 255)), (np.uint16, (0, 65535)), (np.int32, (-(2**31), 2**31 - 1))]


@pytest.mark.parametrize("suffix", [".png", ".tif", ".bmp", ".npy"])
@pytest.mark.parametrize(("dtype", "limits"), [*LIMITS, (np.float32, (-1e-30, 1e30)), (np.float64, (0.1, 1e300))])
def test_numbers_are_kept_or_refused(tmp_path, suffix, dtype, limits):
    values, path = np.resize(np.array(limits, dtype), (5, 7)), tmp_path / f"raster{suffix}"
    held = {".png": "bool uint8 uint16", ".bmp": "bool uint8", ".tif": "bool uint8 uint16 int32 float32"}.get(suffix)
    if held is not None and values.dtype.name not in held.split():
        with pytest.raises(ValueError, match=rf"expected values that \{suffix} can hold, got {values.dtype} \(5, 7\)"):
            write_raster(path, Raster(values))
        assert not path.exists()
        return
    write_raster(path, Raster(values))
    found = read_raster(path).values
    np.testing.assert_array_equal(found, 255 * values.astype(int) if dtype is bool and suffix != ".npy" else values)


def test_pictures_whose_numbers_would_change_are_refused(tmp_path):
    import cv2

    cv2.imwrite(str(tmp_path / "deep.png"), np.full((4, 5, 3), 1000, np.uint16))
    Image.new("CMYK", (5, 4)).save(tmp_path / "cmyk.tif")
    for name, kind in {"deep.png": "16 bit colour", "cmyk.tif": "mode CMYK"}.items():
        with pytest.raises(ValueError, match=rf"expected a raster of 8 bits or of one channel, got .*{name} of {kind}"):
            read_raster(tmp_path / name)


# --- COCO -----------------------------------------------------------------------------------------


def box_of(polygon):
    x, y = np.reshape(polygon, (-1, 2)).T
    return [x.min(), y.min(), x.max() - x.min(), y.max() - y.min()]


@pytest.fixture
def coco(data):
    """in/coco.json: of 0.png an object, a crowd, one that the view does not show and a caption; of b/1.png a box."""
    triangle = [20.0, 10, 50, 15, 30, 40]
    crowd = np.zeros(SIZE, bool)
    crowd[10:30, 20:45] = True
    crowd[15:20, 25:30] = False
    content = {
        "info": {"year": 2018},
        "categories": [{"id": 3, "name": "fish"}],
        "images": [
            {"id": 7, "file_name": "0.png", "width": 64, "height": 48, "license": 2},
            {"id": 8, "file_name": "images/b/1.png", "width": 64, "height": 48},
            {"id": 9, "file_name": "elsewhere.png", "width": 64, "height": 48},
        ],
        "annotations": [
            {"id": 1, "image_id": 7, "category_id": 3, "iscrowd": 0, "area": 1.0, "bbox": box_of(triangle), "segmentation": [triangle],
             "keypoints": [30, 20, 2, 0, 0, 0, 1, 1, 1], "num_keypoints": 2, "score": 0.5},
            {"id": 2, "image_id": 7, "category_id": 3, "iscrowd": 1, "area": 475, "bbox": [20, 10, 25, 20],
             "segmentation": {"size": list(SIZE), "counts": rle.encode(crowd, as_text=True)}},
            {"id": 3, "image_id": 7, "category_id": 3, "bbox": [0, 0, 2, 2], "area": 4, "segmentation": []},
            {"id": 4, "image_id": 7, "caption": "a fish"},
            {"id": 5, "image_id": 8, "category_id": 3, "bbox": [10, 10, 20, 15], "area": 300, "segmentation": [[1, 2, 3, 4]]},
            {"id": 6, "image_id": 9, "category_id": 3, "bbox": [10, 10, 20, 15], "area": 300},
        ],
    }  # fmt: skip
    Path("in/coco.json").write_text(json.dumps(content))
    return content


COCO = ["--annotations", "in/coco.json", "out/coco.json"]


def test_a_coco_file_tells_of_the_rectified_pictures(data, coco):
    result = rectify("in/images", "-o", "out/images", *CALIBRATED, *COCO)
    assert (result.exit_code, result.stderr) == (0, "")
    assert (
        "out/coco.json: 4 annotations in 2 images, 1 not seen and dropped, 1 images not rectified and left out"
        in result.stdout
    )
    made = json.loads(Path("out/coco.json").read_text())
    assert made.keys() == coco.keys()
    assert (made["info"], made["categories"]) == (coco["info"], coco["categories"])
    assert made["images"] == [
        {"id": 7, "file_name": "0.png", "width": 50, "height": 40, "license": 2},
        {"id": 8, "file_name": "b/1.png", "width": 50, "height": 40},
    ]
    fish, crowd, caption, box = made["annotations"]
    assert caption == coco["annotations"][3]

    # Boxes contain what they are about, to the cents that are written, and no more.
    given = coco["annotations"][0]
    outline = np.reshape(given["segmentation"][0], (-1, 2)) - 0.5
    points = np.array([[30.0, 20], [1, 1]])
    expected = fr.rectify_sample(fr.Sample(polygons=[outline], points=points), CAMERA, VIEW)
    np.testing.assert_allclose(np.reshape(fish["segmentation"][0], (-1, 2)), expected.polygons[0] + 0.5, atol=0.006)
    np.testing.assert_allclose(fish["bbox"], box_of(fish["segmentation"][0]), atol=0.02)
    x, y = expected.polygons[0].T
    assert fish["area"] == pytest.approx(abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2, abs=0.01)
    assert expected.points_valid.tolist() == [True, False]
    np.testing.assert_allclose(fish["keypoints"], [*expected.points[0], 2, 0, 0, 0, 0, 0, 0], atol=0.006)
    assert (fish["num_keypoints"], fish["score"], fish["id"], fish["category_id"]) == (1, 0.5, 1, 3)
    assert (fish["visible"], crowd["visible"]) == (1, 1)

    mask = rle.decode(coco["annotations"][1]["segmentation"]["counts"], SIZE)
    shown = fr.rectify_sample(fr.Sample(mask=mask), CAMERA, VIEW).mask
    assert crowd["segmentation"]["size"] == list(VIEW_SIZE)
    np.testing.assert_array_equal(rle.decode(crowd["segmentation"]["counts"], VIEW_SIZE), shown)
    assert crowd["area"] == shown.sum()
    rows, columns = np.nonzero(shown)
    assert crowd["bbox"] == [columns.min(), rows.min(), np.ptp(columns) + 1, np.ptp(rows) + 1]

    corners = fr.rectify_sample(fr.Sample(boxes=[[9.5, 9.5, 29.5, 24.5]]), CAMERA, VIEW).boxes[0]
    np.testing.assert_allclose(box["bbox"], [*corners[:2] + 0.5, *corners[2:] - corners[:2]], atol=0.006)
    assert box["segmentation"] == []
    assert box["area"] == pytest.approx(box["bbox"][2] * box["bbox"][3], rel=0.01)


def test_a_rectified_coco_file_can_be_moved_back(data, coco):
    """Outlines to the tolerance of their chords and the cents that are written."""
    assert rectify("in/images", "-o", "out/images", *CALIBRATED, *COCO).exit_code == 0
    made = json.loads(Path("out/coco.json").read_text())["annotations"][0]
    outline = np.reshape(made["segmentation"][0], (-1, 2)) - 0.5
    back = fr.distort_sample(fr.Sample(polygons=[outline]), VIEW, CAMERA).polygons[0] + 0.5
    for corner in np.reshape(coco["annotations"][0]["segmentation"][0], (-1, 2)):
        assert np.linalg.norm(back - corner, axis=-1).min() < 0.05


def test_what_a_coco_file_does_not_tell_of_a_picture_is_said(data, coco):
    coco["images"][0]["width"] = 65
    coco["images"] = (
        coco["images"][:1] + coco["images"][2:] + [{"id": 10, "file_name": "1.png", "width": 64, "height": 48}]
    )
    coco["annotations"] = coco["annotations"][2:4]
    Path("in/coco.json").write_text(json.dumps(coco))
    write_picture("in/images/b/2.png", Picture(data["0"]["image"]))
    Path("in/images/c").mkdir()
    write_picture("in/images/c/1.png", Picture(data["0"]["image"]))
    result = rectify("in/images", "-o", "out/images", *CALIBRATED, *COCO)
    assert result.exit_code == 1
    assert result.stderr.splitlines() == [
        "fisheyerec rectify: expected in/images/0.png of 65x48 as in in/coco.json, got 64x48",
        "fisheyerec rectify: expected in/images/b/2.png among the images of in/coco.json, got no such file_name",
        "fisheyerec rectify: expected one picture called '1.png', got in/images/c/1.png as well",
    ]
    assert [image["file_name"] for image in json.loads(Path("out/coco.json").read_text())["images"]] == ["b/1.png"]


def test_pictures_that_failed_are_not_in_the_coco_file(data, coco):
    Path("in/images/0.png").write_text("?")
    result = rectify("in/images", "-o", "out/images", *CALIBRATED, *COCO)
    assert result.exit_code == 1
    assert [image["id"] for image in json.loads(Path("out/coco.json").read_text())["images"]] == [8]


IMAGES = [{"id": 1, "file_name": "0.png", "width": 64, "height": 48}]
NO_COCO = {
    "no_json": ("{", "as a COCO file, got no JSON"),
    "list": ([], "as a COCO file, got no lists of images and annotations"),
    "no_images": ({"annotations": []}, "got no lists of images and annotations"),
    "no_id": ({"images": [{"file_name": "0.png", "width": 64, "height": 48}], "annotations": []}, r"images\[0\] with an id, got"),
    "no_height": ({"images": [{"id": 1, "file_name": "0.png", "width": 64}], "annotations": []}, r"images\[0\] with a height in pixels"),
    "names_twice": ({"images": 2 * IMAGES, "annotations": []}, r"images\[1\] with a file_name of its own"),
    "ids_twice": ({"images": [*IMAGES, IMAGES[0] | {"file_name": "2.png"}], "annotations": []}, "images with an id each, got 1 ids"),
    "of_no_image": ({"images": IMAGES, "annotations": [{"id": 1, "image_id": 2}]}, r"annotations\[0\] of an image, got"),
    "box_of_3": ({"images": IMAGES, "annotations": [{"image_id": 1, "bbox": [1, 2, 3]}]}, r"annotations\[0\] as COCO has them"),
    "negative": ({"images": IMAGES, "annotations": [{"image_id": 1, "bbox": [1, 2, -3, 3]}]}, "negative size"),
    "odd_polygon": ({"images": IMAGES, "annotations": [{"image_id": 1, "segmentation": [[1, 2, 3, 4, 5, 6, 7]]}]}, r"annotations\[0\]"),
    "polygon_of_words": ({"images": IMAGES, "annotations": [{"image_id": 1, "segmentation": [["a", "b"]]}]}, r"annotations\[0\]"),
    "words": ({"images": IMAGES, "annotations": [{"image_id": 1, "keypoints": ["a", 1, 2]}]}, r"annotations\[0\]"),
    "mask_of_another_size": ({"images": IMAGES, "annotations": [{"image_id": 1, "segmentation": {"size": [2, 2], "counts": [4]}}]}, r"a mask of size \[2, 2\] in an image of \[48, 64\]"),
    "short_runs": ({"images": IMAGES, "annotations": [{"image_id": 1, "segmentation": {"size": [48, 64], "counts": [4]}}]}, "expected runs of 48 x 64 pixels in all, got 4"),
    "no_runs": ({"images": IMAGES, "annotations": [{"image_id": 1, "segmentation": {"size": [48, 64], "counts": "p?"}}]}, "expected characters from '0' to 'o' in runs, got 'p'"),
}  # fmt: skip


@pytest.mark.parametrize(("content", "message"), NO_COCO.values(), ids=NO_COCO)
def test_bad_coco_files_are_told_in_one_line_with_the_place(data, content, message):
    Path("in/coco.json").write_text(content if isinstance(content, str) else json.dumps(content))
    before = files()
    result = rectify("in/images/0.png", "-o", "o.png", *CALIBRATED, "--annotations", "in/coco.json", "c.json")
    assert result.exit_code == 2
    assert len(result.stderr.splitlines()) == 1
    assert "in/coco.json" in result.stderr
    assert re.search(message, result.stderr), result.stderr
    assert files() == before


def test_runs_are_those_of_pycocotools():
    """Two texts that pycocotools 2.0.11 made."""
    small = "g034NM03200<"
    assert rle.encode(rle.decode(small, (7, 9)), as_text=False) == [23, 3, 4, 1, 1, 1, 4, 3, 4, 3, 16]
    y, x = np.mgrid[:60, :90]
    ring = ((x - 44) ** 2 / 900 + (y - 30) ** 2 / 400 < 1) & ((x - 50) ** 2 + (y - 25) ** 2 >= 40)
    text = (
        "ml0;_14M2N2M4N0O2N2N2O0O2O0O2O0O2O0O2O00000O2O0000000000000000VO^O:b0DB:>ED:<EF::FF::EH:8FH:8FH:8GF::FF:;FC:>G@:`0H"
        "\\O:d0?1N101N101N101N101N2N2N102L3N2N3LYm0"
    )
    assert rle.encode(ring, as_text=True) == text
    np.testing.assert_array_equal(rle.decode(text, ring.shape), ring)


def test_masks_come_back_from_their_runs():
    rng = np.random.default_rng(0)
    for share in (0, 0.01, 0.5, 0.99, 1):
        mask = rng.random((211, 307)) < share
        for as_text in (True, False):
            np.testing.assert_array_equal(rle.decode(rle.encode(mask, as_text=as_text), mask.shape), mask)
