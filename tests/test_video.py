"""Videos: what is seen, heard and when; what broken files and early ends leave behind; one camera from many frames."""

import functools
import json
import os
import signal
import struct
import subprocess
import sys
import time
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
import torch

import fisheyerec as fr
from fisheyerec import file_rectifiers, views
from fisheyerec.file_rectifiers import BlindRectifier, CalibratedRectifier, ViewOptions
from fisheyerec.folders import Task
from fisheyerec.lens_chart import camera_from_chart, chart_of
from fisheyerec.pictures import Picture, read_picture, write_picture
from fisheyerec.pooling import pool, robust_mean
from fisheyerec.rectifier import PhotoEstimate

av = pytest.importorskip("av", reason="PyAV is not installed")

from fisheyerec import video  # noqa: E402

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples"))

import scenes  # noqa: E402

SIZE = (180, 240)
CAMERA = fr.FisheyeCamera.from_projection("equisolid", fov_deg=150, image_size=SIZE)
VIEW = fr.PinholeCamera.edge_matched(CAMERA, SIZE)
TICKS = 90_000  # a second


@functools.cache
def drawn():
    return scenes.render_camera(scenes.room(seed=1), CAMERA.unproject, SIZE, supersample=1).image


def turned(angle_deg):
    """The drawn scene after the camera has panned."""
    a = np.radians(angle_deg)
    rotation = [[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]]
    return fr.numpy.resample(drawn(), CAMERA, CAMERA, source_from_target=rotation, padding="border").image


def make_clip(
    path, *, times=None, codec="libx264", pix_fmt="yuv420p", sound="aac", container_options=None, frames=None
):
    """A clip of the drawn scene, panning, at these times in seconds, with a tone."""
    times = np.arange(24) / 24 if times is None else times
    with av.open(str(path), "w", container_options=container_options or {}) as out:
        options = {"libx264": {"crf": "8", "g": "12"}}.get(codec, {})
        picture = out.add_stream(codec, rate=24, options=options)
        picture.height, picture.width = SIZE if frames is None else frames[0].shape[:2]
        picture.pix_fmt = pix_fmt
        picture.codec_context.time_base = Fraction(1, TICKS)
        tone = out.add_stream(sound, rate=48_000) if sound else None
        samples = 0
        for number, seconds in enumerate(times):
            image = turned(number / 4) if frames is None else frames[number]
            frame = av.VideoFrame.from_ndarray(image, format="rgb24").reformat(format=pix_fmt)
            frame.pts, frame.time_base = round(seconds * TICKS), Fraction(1, TICKS)
            out.mux(picture.encode(frame))
            while tone is not None and samples < seconds * 48_000:
                wave = np.sin(2 * np.pi * 440 * (samples + np.arange(1024)) / 48_000).astype(np.float32)
                block = av.AudioFrame.from_ndarray(wave[None], format="fltp", layout="mono")
                block.sample_rate, block.pts, block.time_base = 48_000, samples, Fraction(1, 48_000)
                out.mux(tone.encode(block))
                samples += 1024
        out.mux(picture.encode(None))
        if tone is not None:
            out.mux(tone.encode(None))


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    path = tmp_path_factory.mktemp("clips") / "clip.mp4"
    make_clip(path)
    return path


def decoded(path, *, format="rgb24"):
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format=format) for frame in container.decode(video=0)]


def times_of(path):
    with av.open(str(path)) as container:
        return [float(frame.pts * frame.time_base) for frame in container.decode(video=0)]


def packets_of(path, kind):
    with av.open(str(path)) as container:
        stream = next(stream for stream in container.streams if stream.type == kind)
        return [(float(p.pts * p.time_base), bytes(p)) for p in container.demux(stream) if p.dts is not None and p.size]


def psnr(one, two):
    return 10 * np.log10(255**2 / np.square(one.astype(float) - two).mean())


# --- What is seen ---------------------------------------------------------------------------------


def test_frames_are_what_the_op_makes_of_them(clip, tmp_path):
    report = video.rectify_video(clip, tmp_path / "out.mp4", CAMERA, VIEW, quality=90)
    assert (report.frames, report.complaint) == (24, None)
    before, after = decoded(clip), decoded(tmp_path / "out.mp4")
    assert len(after) == 24
    for source, made in zip(before, after, strict=True):
        assert psnr(made, fr.numpy.rectify(source, CAMERA, VIEW, padding="border").image) > 34


@pytest.mark.parametrize(
    ("codec", "pix_fmt"),
    [
        ("libx264", "yuv422p"),
        ("libx264", "yuv444p"),
        ("mjpeg", "yuvj420p"),
        ("libx264", "yuv420p10le"),
        ("ffv1", "gray"),
        ("ffv1", "bgr0"),
        ("png", "rgb24"),
    ],
)
def test_pixels_of_every_kind(tmp_path, codec, pix_fmt):
    source = tmp_path / ("in.mov" if codec == "png" else "in.mkv")
    make_clip(source, codec=codec, pix_fmt=pix_fmt, times=np.arange(4) / 24)
    video.rectify_video(source, tmp_path / "out.mkv", CAMERA, VIEW, quality=90)
    source, made = decoded(source)[2], decoded(tmp_path / "out.mkv")[2]
    assert psnr(made, fr.numpy.rectify(source, CAMERA, VIEW, padding="border").image) > 32


@pytest.mark.parametrize("turns", range(4))
def test_chroma_lies_level_with_every_other_luma_sample_and_between_two_rows(turns):
    """A chroma sample (i, j) of the stored frame lies at (2 i, 2 j + 1/2): where the camera of its plane sees it."""
    stored = SIZE if turns % 2 == 0 else SIZE[::-1]
    y, x = np.mgrid[: stored[0] // 2, : stored[1] // 2]
    luma = np.stack([2.0 * x, 2.0 * y + 1 / 2], -1)
    to_upright = {
        0: lambda p: p,
        1: lambda p: np.stack([p[..., 1], stored[1] - 1 - p[..., 0]], -1),
        2: lambda p: np.array([stored[1] - 1, stored[0] - 1]) - p,
        3: lambda p: np.stack([stored[0] - 1 - p[..., 1], p[..., 0]], -1),
    }[turns]
    # numpy is the judge of what a turn is
    index = np.stack(np.meshgrid(np.arange(stored[1]), np.arange(stored[0])), -1)
    np.testing.assert_array_equal(
        to_upright(np.rot90(index, turns)), np.stack(np.meshgrid(np.arange(SIZE[1]), np.arange(SIZE[0])), -1)
    )
    rays, _ = CAMERA.unproject(np.rot90(to_upright(luma), turns))
    found, _ = video._plane_camera(CAMERA, (2, 2), turns).project(rays)
    expected = np.stack(np.meshgrid(np.arange(SIZE[1] // 2), np.arange(SIZE[0] // 2)), -1)
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_planes_of_odd_frames_hold_the_half_sample_at_the_edge():
    camera = fr.FisheyeCamera([100, 100, 60, 40, 0, 0, 0, 0], (81, 121))
    plane = video._plane_camera(camera, (2, 2), 0)
    assert plane.image_size == (41, 61)
    np.testing.assert_allclose(plane.params[:4], [50, 50, 30, 19.75])


def test_what_the_lens_cannot_see_is_black(clip, tmp_path):
    view = views.keep_all(CAMERA, SIZE)
    video.rectify_video(clip, tmp_path / "out.mp4", CAMERA, view, quality=95)
    made = decoded(tmp_path / "out.mp4")[0]
    valid = fr.numpy.rectify(np.zeros(SIZE, np.uint8), CAMERA, view).valid
    surely = ~valid
    for axis in (0, 1):
        surely = surely & np.roll(surely, 4, axis) & np.roll(surely, -4, axis)
    assert surely.mean() > 0.05
    assert made[surely].mean() < 3


def turn_on_its_side(source, target, turns):
    """Write into the track's header how players are to turn the picture, clockwise quarters."""
    data = bytearray(source.read_bytes())
    one = 1 << 16
    matrix = {1: (0, one, 0, -one, 0, 0), 2: (-one, 0, 0, 0, -one, 0), 3: (0, -one, 0, one, 0, 0)}[turns]
    at = data.index(b"tkhd") + 4 + 40  # the picture's track is the first
    data[at : at + 24] = struct.pack(">6i", *matrix)
    target.write_bytes(data)


@pytest.mark.parametrize("clockwise", [1, 2, 3])
def test_a_clip_that_was_taken_on_its_side_is_turned_as_players_do(tmp_path, clockwise):
    stored = [np.ascontiguousarray(np.rot90(turned(n), clockwise)) for n in range(3)]
    make_clip(tmp_path / "plain.mp4", frames=stored, times=np.arange(3) / 24)
    turn_on_its_side(tmp_path / "plain.mp4", tmp_path / "in.mp4", clockwise)
    assert video.frame_size(tmp_path / "in.mp4") == SIZE
    assert psnr(video.sample_frames(tmp_path / "in.mp4", 1)[0], turned(2)) > 30
    video.rectify_video(tmp_path / "in.mp4", tmp_path / "out.mp4", CAMERA, VIEW, quality=90)
    made = decoded(tmp_path / "out.mp4")
    for number in range(3):
        assert psnr(made[number], fr.numpy.rectify(turned(number), CAMERA, VIEW, padding="border").image) > 30


@pytest.mark.parametrize("suffix", [".mp4", ".mov", ".mkv", ".avi", ".ts"])
def test_containers(clip, tmp_path, suffix):
    report = video.rectify_video(clip, tmp_path / f"out{suffix}", CAMERA, VIEW)
    assert len(decoded(tmp_path / f"out{suffix}")) == report.frames == 24
    assert len(packets_of(tmp_path / f"out{suffix}", "audio")) > 40


def test_webm_is_vp9_and_leaves_out_what_it_cannot_hold(clip, tmp_path):
    report = video.rectify_video(clip, tmp_path / "out.webm", CAMERA, VIEW)
    assert "without 1 stream of" in report.summary
    with av.open(str(tmp_path / "out.webm")) as out:
        assert [stream.codec_context.name for stream in out.streams] == ["vp9"]
    assert len(decoded(tmp_path / "out.webm")) == 24


def test_quality_is_a_matter_of_size(clip, tmp_path):
    sizes = []
    for quality in (20, 90):
        video.rectify_video(clip, tmp_path / "out.mp4", CAMERA, VIEW, quality=quality)
        sizes.append((tmp_path / "out.mp4").stat().st_size)
    assert sizes[0] < sizes[1] / 2


# --- What is heard, and when ----------------------------------------------------------------------


def test_sound_is_taken_over_packet_by_packet(clip, tmp_path):
    video.rectify_video(clip, tmp_path / "out.mp4", CAMERA, VIEW)
    before, after = packets_of(clip, "audio"), packets_of(tmp_path / "out.mp4", "audio")
    assert [data for _, data in before] == [data for _, data in after]
    np.testing.assert_allclose([t for t, _ in after], [t for t, _ in before], atol=1e-4)


@pytest.mark.parametrize("suffix", [".mp4", ".mkv"])
def test_a_variable_frame_rate_is_kept(tmp_path, suffix):
    times = np.cumsum([0, 0.04, 0.04, 0.5, 0.01, 0.033, 0.2, 1.0, 0.04, 0.04])
    make_clip(tmp_path / f"in{suffix}", times=times)
    video.rectify_video(tmp_path / f"in{suffix}", tmp_path / f"out{suffix}", CAMERA, VIEW)
    np.testing.assert_allclose(times_of(tmp_path / f"in{suffix}"), times, atol=1e-3)
    assert times_of(tmp_path / f"out{suffix}") == times_of(tmp_path / f"in{suffix}")


def test_time_stamps_rise_whatever_the_file_says():
    class Frame:
        def __init__(self, pts):
            self.pts = pts

    clock = video._Clock()
    assert [clock.time_of(Frame(pts)) for pts in (None, None, 7, 7, 3, None, 20)] == [0, 1, 7, 8, 9, 10, 20]


# --- Broken files and early ends ------------------------------------------------------------------


def command(*arguments):
    return [sys.executable, "-P", "-m", "fisheyerec.cli", "rectify", *map(str, arguments)]


def run(*arguments, **options):
    return subprocess.run(command(*arguments), capture_output=True, text=True, timeout=300, check=False, **options)


@pytest.fixture
def lens(tmp_path):
    CAMERA.save(tmp_path / "lens.json")
    return ["--camera", tmp_path / "lens.json"]


@pytest.mark.parametrize(("suffix", "options"), [(".mkv", {}), (".mp4", {"movflags": "faststart"})])
def test_a_broken_tail_leaves_a_playable_file_and_a_message(tmp_path, lens, suffix, options):
    source = tmp_path / f"in{suffix}"
    make_clip(source, times=np.arange(72) / 24, container_options=options)
    data, before = source.read_bytes(), decoded(source)
    source.write_bytes(data[: len(data) * 2 // 3])
    result = run(source, "-o", tmp_path / "out.mp4", *lens)
    assert result.returncode == 1
    assert len(result.stderr.splitlines()) == 1
    assert f"fisheyerec rectify: {source}: ends after" in result.stderr
    assert "of 3.0" in result.stderr
    made = decoded(tmp_path / "out.mp4")
    assert 20 < len(made) < 70
    assert psnr(made[10], fr.numpy.rectify(before[10], CAMERA, VIEW, padding="border").image) > 28
    assert packets_of(tmp_path / "out.mp4", "audio")


def test_damage_in_the_middle_is_told_and_the_rest_written(tmp_path, lens):
    source = tmp_path / "in.mov"
    make_clip(source, times=np.arange(48) / 24, codec="png", pix_fmt="rgb24")
    data = bytearray(source.read_bytes())
    middle = data.index(b"\x89PNG", len(data) // 2)
    data[middle : middle + 64] = bytes(64)
    source.write_bytes(data)
    result = run(source, "-o", tmp_path / "out.mp4", *lens)
    assert (result.returncode, len(result.stderr.splitlines())) == (1, 1), result.stderr
    assert "1 packet" in result.stderr
    assert len(decoded(tmp_path / "out.mp4")) == 47


BAD = {
    "no index": (["headless.mp4", "-o", "out.mp4"], r"expected a video, got 'headless.mp4' of an unknown format, or"),
    "no video": (["notes.mp4", "-o", "out.mp4"], r"expected a video, got 'notes.mp4' of an unknown format"),
    "sound alone": (["sound.mp4", "-o", "out.mp4"], r"expected a video, got 'sound.mp4' without a picture"),
    "missing": (["none.mp4", "-o", "out.mp4"], r"none.mp4: No such file"),
    "odd size": (["clip.mp4", "-o", "out.mp4", "--size", "101x80"], r"even width and height, got 101x80"),
    "container": (["clip.mp4", "-o", "out.xyz"], r"a video file with a suffix such as .mp4, got '.xyz'"),
    "picture": (["clip.mp4", "-o", "out.jpg"], r"expected a container that holds h264 or vp9"),
    "no folder": (["clip.mp4", "-o", "none/out.mp4"], r"none/out.mp4: No such file"),
    "itself": (["clip.mp4", "-o", "clip.mp4"], r"an output other than the picture itself"),
    "shape": (["square.mp4", "-o", "out.mp4"], r"in the shape of its lens file, 240x180, got 180x180"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_one_line_and_leaves_nothing(clip, lens, tmp_path, case):
    data = clip.read_bytes()
    (tmp_path / "clip.mp4").write_bytes(data)
    (tmp_path / "headless.mp4").write_bytes(data[: len(data) // 2])
    (tmp_path / "notes.mp4").write_text("no video")
    with av.open(str(tmp_path / "sound.mp4"), "w") as out:
        tone = out.add_stream("aac", rate=48_000)
        silence = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
        silence.sample_rate = 48_000
        out.mux(tone.encode(silence))
        out.mux(tone.encode(None))
    make_clip(tmp_path / "square.mp4", frames=[np.zeros((180, 180, 3), np.uint8)], times=[0])
    before = sorted(path.name for path in tmp_path.iterdir())
    arguments, message = BAD[case]
    result = run(*arguments, *lens, cwd=tmp_path)
    assert (result.returncode, len(result.stderr.splitlines())) == (2, 1), result.stderr
    assert message in result.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == before


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_an_early_end_leaves_no_clip_and_the_next_run_no_trace_of_it(clip, lens, tmp_path, number, hears_ctrl_c):
    (tmp_path / "in").mkdir()
    long = tmp_path / "in" / "long.mp4"
    make_clip(long, times=np.arange(300) / 24, frames=[turned(0)] * 300, sound=None)
    out = tmp_path / "out"
    process = subprocess.Popen(
        command(tmp_path / "in", "-o", out, *lens), stderr=subprocess.PIPE, text=True, preexec_fn=hears_ctrl_c
    )
    while not (out.exists() and any(path.stat().st_size for path in out.glob(".long.mp4.*"))):
        assert process.poll() is None
        time.sleep(0.01)
    process.send_signal(number)
    _, said = process.communicate(timeout=300)
    left = [path.name for path in out.iterdir()]
    if number == signal.SIGINT:
        assert (process.returncode, left) == (130, [])
        assert said == "fisheyerec rectify: interrupted after 0 of 1 files\n"
    else:
        assert "long.mp4" not in left
    assert run(tmp_path / "in", "-o", out, *lens, "--resume").returncode == 0
    assert sorted(path.name for path in out.iterdir()) == ["long.mp4", "manifest.jsonl"]


def test_what_the_caller_raises_ends_the_work(clip, tmp_path):
    def stop(done, total):
        assert total == 24
        if done == 3:
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        video.rectify_video(clip, tmp_path / "out.mp4", CAMERA, VIEW, on_frame=stop)
    assert not list(tmp_path.iterdir())


def test_pyav_is_asked_for_where_it_is_missing(run_python, clip, lens, tmp_path):
    lines = "import sys; sys.modules['av'] = None; from fisheyerec.cli import app; app(sys.argv[1:])"
    arguments = ["rectify", str(clip), "-o", str(tmp_path / "out.mp4"), *map(str, lens)]
    result = run_python(f"import sys; sys.argv = ['', *{arguments}]\n{lines}")
    assert result.returncode == 2
    assert (
        result.stderr == "fisheyerec rectify: ModuleNotFoundError: PyAV is missing: pip install 'fisheyerec[video]'\n"
    )


def test_a_calibrated_clip_never_imports_torch(run_python, clip, lens, tmp_path):
    arguments = ["rectify", str(clip), "-o", str(tmp_path / "out.mp4"), *map(str, lens)]
    result = run_python(
        f"import sys\nfrom fisheyerec.cli import app\napp({arguments}, standalone_mode=False)\n"
        "print('torch' in sys.modules)"
    )
    assert result.stdout.splitlines()[-1] == "False", result.stderr


def test_pictures_and_clips_of_one_folder(clip, lens, tmp_path):
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "clip.mp4").write_bytes(clip.read_bytes())
    write_picture(tmp_path / "in" / "photo.png", Picture(drawn()))
    result = run(tmp_path / "in", "-o", tmp_path / "out", *lens, "--format", "mkv")
    assert result.returncode == 0, result.stderr
    assert len(decoded(tmp_path / "out" / "clip.mkv")) == 24
    assert read_picture(tmp_path / "out" / "photo.png").pixels.shape == (*SIZE, 3)


# --- One camera from many frames ------------------------------------------------------------------


def told(camera, confidence=0.5, distorted=True, sigma=0.01):
    return PhotoEstimate(camera, confidence, distorted, 1.0, 0.1, True, sigma**2 * np.eye(8), None)


def shifted(amount):
    chart = chart_of(CAMERA)
    chart[4] += amount
    return fr.FisheyeCamera(camera_from_chart(torch.from_numpy(chart), SIZE).numpy(), SIZE)


def test_the_robust_mean_of_what_agrees_is_the_product_of_gaussians():
    rng = np.random.default_rng(0)
    roots = rng.standard_normal((3, 2, 2))
    covariances = roots @ roots.transpose(0, 2, 1)
    mean, covariance = robust_mean(np.tile([1.0, -2.0], (3, 1)), covariances)
    np.testing.assert_allclose(mean, [1, -2])
    weight = (4 + 2) / 4  # of a value that is where the mean is
    np.testing.assert_allclose(covariance, np.linalg.inv(weight * np.linalg.inv(covariances).sum(0)), rtol=1e-5)
    unsure = np.array([np.eye(1), 4 * np.eye(1)])
    near, _ = robust_mean(np.array([[0.0], [0.01]]), unsure)
    np.testing.assert_allclose(near, 0.01 / 5, rtol=1e-3)


def test_frames_that_are_wrong_hardly_move_the_camera():
    good = [told(shifted(amount)) for amount in (-0.01, 0.0, 0.01)]
    wild = [told(shifted(0.4)), told(shifted(0.5), 0.1, sigma=0.1), told(shifted(0.5), 0.1, distorted=False)]
    found = pool(good + wild)
    assert found.distorted
    np.testing.assert_allclose(chart_of(found.camera), chart_of(shifted(0)), atol=0.02)


def test_whether_a_camera_distorts_is_voted_on():
    estimates = [told(CAMERA, 0.4), told(CAMERA, 0.4), told(CAMERA, 0.9, distorted=False)]
    assert not pool(estimates).distorted
    assert pool([*estimates, told(CAMERA, 0.4)]).distorted


def test_pictures_of_different_sizes_are_not_pooled():
    with pytest.raises(ValueError, match="of one size"):
        pool([told(CAMERA, 0.4), told(CAMERA.scale(2), 0.4)])
    with pytest.raises(ValueError, match="of one size"):
        pool([])


class Told:
    """Stands for a Rectifier."""

    distorted = True
    frames: list

    def estimate(self, photo, *, refine):
        assert photo.shape == (*SIZE, 3)
        self.frames.append(photo)
        return told(CAMERA, 0.9, self.distorted)


@pytest.fixture
def network(monkeypatch):
    network = Told()
    network.frames = []
    monkeypatch.setattr(file_rectifiers, "_load", lambda weights: network)
    return network


def test_a_clip_of_an_unknown_camera(clip, network, tmp_path):
    rectifier = BlindRectifier(ViewOptions(fov_deg=90), quality=90)
    report = rectifier(Task(clip, tmp_path / "out.mp4"), on_frame=lambda done, total: None)
    assert len(network.frames) == video.SAMPLED_FRAMES
    assert all(psnr(frame, turned(0)) < 60 for frame in network.frames[1:])  # they differ
    view = fr.PinholeCamera.from_fov(90, SIZE)
    np.testing.assert_allclose(chart_of(report.camera), chart_of(CAMERA), atol=1e-3)
    expected = fr.numpy.rectify(decoded(clip)[5], report.camera, view, padding="border").image
    assert psnr(decoded(tmp_path / "out.mp4")[5], expected) > 34


def test_a_clip_without_distortion_is_taken_over_as_it_is(clip, network, tmp_path):
    network.distorted = False
    turn_on_its_side(clip, tmp_path / "in.mp4", 2)
    report = BlindRectifier(ViewOptions())(
        Task(tmp_path / "in.mp4", tmp_path / "out.mp4"), on_frame=lambda done, total: None
    )
    assert report.summary.startswith("as it was")
    for kind in ("video", "audio"):
        before, after = packets_of(clip, kind), packets_of(tmp_path / "out.mp4", kind)
        assert [data for _, data in before] == [data for _, data in after]
    with av.open(str(tmp_path / "out.mp4")) as out:
        assert abs(next(out.decode(video=0)).rotation) == 180


def test_samples_lie_evenly(clip):
    found = video.sample_frames(clip, 4)
    expected = [turned(number / 4) for number in (3, 9, 15, 21)]
    for frame, scene in zip(found, expected, strict=True):
        assert psnr(frame, scene) > 30


def test_settings_can_be_written_down():
    for rectifier in (CalibratedRectifier(CAMERA, VIEW), BlindRectifier(ViewOptions(), weights=Path("a"))):
        json.dumps(rectifier.settings())
