"""Many files at once: what is worked on, where it goes, what is written down, and what an early end leaves behind."""

import contextlib
import functools
import json
import os
import pickle
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import fisheyerec as fr
from fisheyerec import bulk
from fisheyerec.file_rectifiers import SUFFIXES, CalibratedRectifier, FileReport, ViewOptions, target_suffix
from fisheyerec.folders import Plan, Task, plan
from fisheyerec.manifest import Manifest
from fisheyerec.pictures import Picture, read_picture, write_picture
from fisheyerec.replacement import remove_leftovers, replacement

SIZE = (48, 64)
BEGINNING = r"(\n|\x1b\[2K)"  # of a line, on a terminal


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def touch(*names):
    for name in names:
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        Path(name).write_bytes(name.encode())


def planned(*inputs, output="out", picture_suffix=None):
    suffix_of = functools.partial(target_suffix, picture_suffix=picture_suffix, video_suffix=None)
    return plan([Path(i) for i in inputs], Path(output), suffixes=SUFFIXES, target_suffix=suffix_of)


def targets(found: Plan):
    return {str(task.source): task.target.as_posix() for task in found.tasks}


# --- What goes where ------------------------------------------------------------------------------


def test_a_folder_is_made_again_below_the_output(here):
    touch("in/1.jpg", "in/b/2.PNG", "in/b/c/3.mp4", "in/notes.txt", "in/.hidden.jpg", "in/.git/4.jpg")
    found = planned("in")
    assert targets(found) == {"in/1.jpg": "out/1.jpg", "in/b/2.PNG": "out/b/2.PNG", "in/b/c/3.mp4": "out/b/c/3.mp4"}
    assert found.folder == Path("out")


@pytest.mark.parametrize(
    ("inputs", "expected"),
    [
        (["a/1.jpg", "b/1.png"], {"a/1.jpg": "out/a/1.jpg", "b/1.png": "out/b/1.png"}),
        (["a", "b"], {"a/1.jpg": "out/a/1.jpg", "b/1.png": "out/b/1.png"}),
        (["a"], {"a/1.jpg": "out/1.jpg"}),
        (["*/1.*"], {"a/1.jpg": "out/a/1.jpg", "b/1.png": "out/b/1.png"}),
        (["**/*.jpg"], {"a/1.jpg": "out/a/1.jpg"}),
        (["a", "a/1.jpg", "./a/*"], {"a/1.jpg": "out/1.jpg"}),
        (["a/1.jpg", "none.jpg"], {"a/1.jpg": "out/a/1.jpg", "none.jpg": "out/none.jpg"}),
    ],
)
def test_several_inputs_keep_their_paths_below_what_they_have_in_common(here, inputs, expected):
    touch("a/1.jpg", "b/1.png")
    assert targets(planned(*inputs)) == expected


def test_one_file_goes_to_a_file_or_into_a_folder(here):
    touch("a/1.jpg", "there/x.txt")
    assert planned("a/1.jpg", output="b.png") == Plan([Task(Path("a/1.jpg"), Path("b.png"))], None)
    assert planned("a/1.jpg", output="there") == Plan([Task(Path("a/1.jpg"), Path("there/1.jpg"))], Path("there"))


def test_a_name_with_brackets_that_exists_is_no_pattern(here):
    touch("a[1].jpg", "a1.jpg")
    assert targets(planned("a[1].jpg", output="b.jpg")) == {"a[1].jpg": "b.jpg"}


def test_another_format_changes_the_suffix_and_keeps_names_apart(here):
    touch("in/1.jpg", "in/1.png", "in/2.jpg", "in/odd.psd", "in/clip.mts")
    assert targets(planned("in", picture_suffix=".webp")) == {
        "in/1.jpg": "out/1.jpg.webp",
        "in/1.png": "out/1.png.webp",
        "in/2.jpg": "out/2.webp",
        "in/clip.mts": "out/clip.mp4",
    }
    assert targets(planned("in/1.jpg", "in/odd.psd"))["in/odd.psd"] == "out/odd.png"


def test_what_was_made_is_not_taken_for_an_input(here):
    touch("in/1.jpg", "in/out/1.jpg")
    assert targets(planned("in", output="in/out")) == {"in/1.jpg": "in/out/1.jpg"}
    assert targets(planned("in/**/*.jpg", output="in/out")) == {"in/1.jpg": "in/out/1.jpg"}


def test_links_to_files_are_followed_and_links_to_folders_are_not(here):
    touch("in/1.jpg", "elsewhere/2.jpg")
    os.symlink(here / "elsewhere" / "2.jpg", "in/2.jpg")
    os.symlink(here / "in", "in/loop")
    os.symlink("nowhere", "in/3.jpg")
    assert list(targets(planned("in"))) == ["in/1.jpg", "in/2.jpg", "in/3.jpg"]
    assert list(targets(planned("in/loop"))) == ["in/loop/1.jpg", "in/loop/2.jpg", "in/loop/3.jpg"]


@pytest.mark.parametrize(
    ("inputs", "output", "message"),
    [
        (["empty"], "out", r"expected files to work on, got none in empty"),
        (["*.webp", "*.png"], "out", r"got none in \*\.webp, \*\.png"),
        (["in/1.jpg"], "in/1.jpg", r"an output other than the picture itself, got in/1\.jpg"),
        (["in"], "in", r"an output other than the picture itself"),
        (["in/1.jpg"], "link.jpg", r"an output other than the picture itself"),
        (["in/1.jpg"], "hard.jpg", r"an output other than the picture itself"),
        (["in/1.jpg", "in/2.jpg"], "in", r"an output other than the picture itself"),
    ],
)
def test_plans_that_would_do_harm_or_nothing_are_refused(here, inputs, output, message):
    touch("in/1.jpg", "in/2.jpg", "empty/notes.txt")
    os.symlink("in/1.jpg", "link.jpg")
    os.link("in/1.jpg", "hard.jpg")
    with pytest.raises(ValueError, match=message):
        planned(*inputs, output=output)


def test_names_that_cannot_be_kept_apart_are_refused(here):
    touch("in/1.jpg", "in/1.png", "in/1.png.tif")
    with pytest.raises(ValueError, match=r"an output for each input, got out/1\.png\.webp for in/1\.png"):
        planned("in", picture_suffix=".webp")


# --- What is written down -------------------------------------------------------------------------


@pytest.fixture
def manifest(here):
    touch("in/1.jpg", "out/1.jpg")
    return Manifest(Path("out"))


TASK = Task(Path("in/1.jpg"), Path("out/1.jpg"))


def test_what_is_done_is_known_to_the_next_run(manifest):
    assert not manifest.is_done(TASK, {"fov_deg": 90.0})
    manifest.add(TASK, {"fov_deg": 90.0}, seconds=1.5)
    for known in (manifest, Manifest(Path("out"))):
        assert known.is_done(TASK, {"fov_deg": 90.0})
        assert not known.is_done(TASK, {"fov_deg": 91.0})
        assert not known.is_done(Task(TASK.source, Path("out/2.jpg")), {"fov_deg": 90.0})


@pytest.mark.parametrize("change", ["output", "content", "time", "error"])
def test_what_changed_is_not_done(manifest, change):
    manifest.add(TASK, {}, seconds=1)
    if change == "output":
        os.unlink("out/1.jpg")
    elif change == "content":
        Path("in/1.jpg").write_text("something longer")
    elif change == "time":
        os.utime("in/1.jpg", ns=(0, 10**18))
    else:
        manifest.add(TASK, {}, seconds=1, error="it broke")
    assert not Manifest(Path("out")).is_done(TASK, {})


def test_a_line_that_was_cut_off_is_forgotten(manifest):
    manifest.add(TASK, {}, seconds=1)
    whole = manifest.path.read_text()
    manifest.path.write_text(whole + whole[:40])
    again = Manifest(Path("out"))
    assert again.is_done(TASK, {})
    again.add(TASK, {}, seconds=2)
    assert [json.loads(line)["seconds"] for line in manifest.path.read_text().splitlines()] == [1, 2]


@pytest.mark.parametrize("text", ["not JSON\n", "[1]\n", '{"fisheye": "a.png"}\n'])
def test_another_manifest_is_refused(manifest, text):
    manifest.path.write_text(text)
    with pytest.raises(ValueError, match=r"a manifest of rectified files, got out/manifest\.jsonl, line 1"):
        Manifest(Path("out"))


# --- Whole or not at all --------------------------------------------------------------------------


def test_a_replacement_that_fails_leaves_the_old_file(here):
    touch("a.txt")

    def interrupted():
        with replacement("a.txt") as temporary:
            temporary.write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert [p.name for p in here.iterdir()] == ["a.txt"]
    assert Path("a.txt").read_text() == "a.txt"


def test_leftovers_of_the_same_targets_are_removed(here):
    left = []
    for name in ("a.txt", "b.txt", "x" * 200 + ".txt"):
        with replacement(name) as temporary:
            temporary.touch()
            left.append(temporary.name)
            Path(name).touch()
        os.replace(name, temporary)  # as if it had been killed
    remove_leftovers([Path("a.txt"), Path("x" * 200 + ".txt"), Path("nowhere/a.txt")])
    assert os.listdir() == [left[1]]


# --- Several at a time ----------------------------------------------------------------------------


def test_whatever_a_file_raises_the_rest_is_done():
    camera = fr.FisheyeCamera.from_projection("equidistant", 120, SIZE)

    def rectifier(task, *, on_frame):
        if task.source.name == "2":
            raise ZeroDivisionError("bad\nfile")
        return FileReport(camera, camera, "")

    tasks = [Task(Path(str(number)), Path(f"out/{number}")) for number in range(20)]
    outcomes = {outcome.task.source.name: outcome for outcome in bulk.run(tasks, rectifier, jobs=3)}
    assert list(map(int, sorted(outcomes, key=int))) == list(range(20))
    assert outcomes["2"].error == "ZeroDivisionError: bad file"
    assert [name for name, outcome in outcomes.items() if outcome.error is not None] == ["2"]


def test_a_run_that_is_given_up_breaks_off_videos_and_begins_nothing_new():
    begun = []

    def rectifier(task, *, on_frame):
        begun.append(task.source)
        while True:
            on_frame(1, None)
            time.sleep(0.001)

    def ended(task, *, on_frame):
        return FileReport(None, None, "") if task.source.name == "0" else rectifier(task, on_frame=on_frame)

    outcomes = bulk.run([Task(Path(str(n)), Path(f"out/{n}")) for n in range(20)], ended, jobs=2)
    assert next(outcomes).task.source.name == "0"
    outcomes.close()
    assert len(begun) <= 3


# --- The command line -----------------------------------------------------------------------------


def command(*arguments):
    return [sys.executable, "-P", "-m", "fisheyerec.cli", "rectify", *map(str, arguments)]


def run(*arguments, **options):
    return subprocess.run(command(*arguments), capture_output=True, text=True, timeout=300, check=False, **options)


@pytest.fixture
def photos(here):
    """in/0.png, in/1.png, in/b/2.png, and their lens file."""
    rng = np.random.default_rng(0)
    Path("in/b").mkdir(parents=True)
    for name in ("0", "1", "b/2"):
        write_picture(f"in/{name}.png", Picture(rng.integers(0, 256, (*SIZE, 3), dtype=np.uint8)))
    fr.FisheyeCamera.from_projection("equidistant", 120, SIZE).save("lens.json")
    return ["--camera", "lens.json"]


def entries():
    return [json.loads(line) for line in Path("out/manifest.jsonl").read_text().splitlines()]


@pytest.mark.parametrize("jobs", [1, 3])
def test_a_folder_end_to_end(photos, jobs):
    touch("in/broken.png")
    result = run("in", "-o", "out", *photos, "--jobs", jobs)
    assert result.returncode == 1
    first, last = result.stderr.splitlines()
    assert "broken.png" in first
    assert last == "fisheyerec rectify: 1 of 4 files failed"
    camera = fr.FisheyeCamera.load("lens.json")
    view = fr.PinholeCamera.edge_matched(camera, SIZE)
    for name in ("0", "1", "b/2"):
        expected = fr.numpy.rectify(read_picture(f"in/{name}.png").pixels, camera, view).image
        np.testing.assert_array_equal(read_picture(f"out/{name}.png").pixels, expected)
    written = {entry["output"]: entry for entry in entries()}
    assert sorted(written) == ["0.png", "1.png", "b/2.png", "broken.png"]
    assert "of an unknown format" in written["broken.png"]["error"]
    entry = written["b/2.png"]
    assert (entry["input"], entry["error"]) == ("in/b/2.png", None)
    assert entry["view"]["fx"] == float(view.params[0])
    assert entry["camera"]["k1"] == float(camera.params[4])
    assert entry["seconds"] > 0


def test_resume_makes_what_is_missing_or_changed_and_nothing_else(photos):
    assert run("in", "-o", "out", *photos).returncode == 0
    times = {path: path.stat().st_mtime_ns for path in Path("out").rglob("*.png")}
    os.unlink("out/b/2.png")
    os.utime("in/1.png", ns=(0, 10**18))
    touch("in/3.png")
    result = run("in", "-o", "out", *photos, "--resume")
    assert result.returncode == 1  # 3.png is no picture
    assert "out: 1 of 4 files were done before" in result.stdout
    changed = {path.name for path, made in times.items() if path.stat().st_mtime_ns != made}
    assert changed == {"1.png", "2.png"}
    assert run("in", "-o", "out", *photos, "--resume", "--fov-deg", "90").stdout.count("focal") == 3


def test_files_that_are_there_are_replaced_only_if_told_to(photos):
    touch("out/0.png", "out/b/2.png")
    before = {path: path.read_bytes() for path in Path().rglob("*") if path.is_file()}
    result = run("in", "-o", "out", *photos)
    assert (result.returncode, len(result.stderr.splitlines())) == (2, 1)
    assert "expected a new file, or --overwrite, got out/0.png and 1 others" in result.stderr
    assert {path: path.read_bytes() for path in Path().rglob("*") if path.is_file()} == before
    assert run("in", "-o", "out", *photos, "--overwrite").returncode == 0
    assert read_picture("out/0.png").pixels.shape == (*SIZE, 3)


def test_a_dry_run_writes_nothing(photos):
    before = sorted(Path().rglob("*"))
    result = run("in", "-o", "out", *photos, "--dry-run", "--format", "jpg")
    assert (result.returncode, result.stderr) == (0, "")
    assert result.stdout.splitlines() == [f"in/{name}.png -> out/{name}.jpg" for name in ("0", "1", "b/2")]
    assert sorted(Path().rglob("*")) == before


def test_format_and_quality(photos):
    for quality in (5, 90):
        assert run("in", "-o", f"out{quality}", *photos, "--format", "JPG", "--quality", quality).returncode == 0
        with Image.open(f"out{quality}/0.jpg") as image:
            assert image.format == "JPEG"
    assert Path("out5/0.jpg").stat().st_size < Path("out90/0.jpg").stat().st_size / 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nothing/*.jpg", "-o", "out"], r"expected files to work on, got none in nothing/\*.jpg"),
        (["in", "-o", "in"], r"an output other than the picture itself"),
        (["in/0.png", "-o", "a.png", "--resume"], r"a folder as --output with --resume and --format, got a file"),
        (["in", "-o", "out", "--format", "doc"], r"--format such as jpg, png or mp4, got 'doc'"),
        (["in", "-o", "lens.json"], r"lens\.json: (File exists|Not a directory)"),
    ],
)
def test_bad_use_is_one_line_and_leaves_nothing(photos, arguments, message):
    before = {path: path.read_bytes() for path in Path().rglob("*") if path.is_file()}
    result = run(*arguments, *photos)
    assert (result.returncode, len(result.stderr.splitlines())) == (2, 1), result.stderr
    assert re.search(message, result.stderr), result.stderr
    assert {path: path.read_bytes() for path in Path().rglob("*") if path.is_file()} == before


@pytest.mark.skipif(os.name != "posix", reason="terminals of POSIX")
@pytest.mark.parametrize("stdout_too", [True, False])
def test_bars_are_shown_on_a_terminal_and_lines_go_where_they_belong(photos, stdout_too):
    touch("in/broken.png")
    mine, terminal = os.openpty()
    stdout = terminal if stdout_too else subprocess.PIPE
    process = subprocess.Popen(command("in", "-o", "out", *photos), stdout=stdout, stderr=terminal, text=True)
    os.close(terminal)
    shown, lines = b"", ""
    with contextlib.suppress(OSError):  # the end of a terminal
        while chunk := os.read(mine, 4096):
            shown += chunk
    os.close(mine)
    if not stdout_too:
        lines = process.stdout.read()
    assert process.wait(timeout=300) == 1
    assert "4/4" in shown.decode()
    assert re.search(rf"{BEGINNING}fisheyerec rectify: read_picture.*broken\.png", shown.decode())
    assert (shown if stdout_too else lines.encode()).count(b"focal") == 3


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_an_early_end_leaves_whole_files_and_resume_does_the_rest(photos, number, hears_ctrl_c):
    large = Picture(np.random.default_rng(0).integers(0, 256, (960, 1280, 3), dtype=np.uint8))
    write_picture("in/0.png", large)
    for copy in range(3, 40):
        os.symlink("0.png", f"in/{copy}.png")
    process = subprocess.Popen(
        command("in", "-o", "out", *photos), stderr=subprocess.PIPE, text=True, preexec_fn=hears_ctrl_c
    )
    while len([path for path in Path("out").glob("*.png") if not path.name.startswith(".")]) < 3:
        assert process.poll() is None
        time.sleep(0.01)
    process.send_signal(number)
    _, said = process.communicate(timeout=300)
    finished = [path for path in Path("out").rglob("*.png") if not path.name.startswith(".")]
    assert 3 <= len(finished) < 40
    for path in finished:
        read_picture(path)
    if number == signal.SIGINT:
        assert process.returncode == 130
        assert said.startswith("fisheyerec rectify: interrupted after ")
        assert len(said.splitlines()) == 1
        assert not list(Path("out").rglob("*.part*"))
    else:
        assert process.returncode == -signal.SIGKILL
    result = run("in", "-o", "out", *photos, "--resume")
    assert result.returncode == 0, result.stderr
    assert len(list(Path("out").rglob("*.png"))) == 40
    assert not list(Path("out").rglob("*.part*"))
    assert result.stdout.count("focal") <= 40 - 3 + 2  # at most what was in progress is made again


def test_a_picture_of_another_scale_keeps_its_size(here):
    camera = fr.FisheyeCamera.from_projection("equidistant", 120, SIZE)
    rectifier = CalibratedRectifier(camera, ViewOptions())
    large = np.random.default_rng(0).integers(0, 256, (2 * SIZE[0], 2 * SIZE[1], 3), dtype=np.uint8)
    write_picture("a.png", Picture(large))
    report = rectifier(Task(Path("a.png"), Path("b.png")), on_frame=lambda done, total: None)
    twice = camera.resize(large.shape[:2])
    expected = fr.numpy.rectify(large, twice, fr.PinholeCamera.edge_matched(twice, large.shape[:2])).image
    np.testing.assert_array_equal(read_picture("b.png").pixels, expected)
    assert report.view.image_size == large.shape[:2]


def test_rectifiers_can_be_sent_to_other_processes(here):
    camera = fr.FisheyeCamera.from_projection("equidistant", 120, SIZE)
    rectifier = CalibratedRectifier(camera, ViewOptions())
    write_picture("a.png", Picture(np.zeros(SIZE, np.uint8)))
    pickle.loads(pickle.dumps(rectifier))(Task(Path("a.png"), Path("b.png")), on_frame=lambda done, total: None)
    assert read_picture("b.png").pixels.shape == SIZE
    json.dumps(rectifier.settings())
