"""The picture of a video: what is seen, in which colours, depth and proportions."""

from fractions import Fraction

import numpy as np
import pytest

import fisheyerec as fr
from fisheyerec import views

av = pytest.importorskip("av", reason="PyAV is not installed")

from clips import CAMERA, SIZE, VIEW, decoded, make_clip, psnr, times_of, turn_on_its_side, turned  # noqa: E402

from fisheyerec import video  # noqa: E402
from fisheyerec.video import frames  # noqa: E402


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
    found, _ = frames._plane_camera(CAMERA, (2, 2), turns).project(rays)
    expected = np.stack(np.meshgrid(np.arange(SIZE[1] // 2), np.arange(SIZE[0] // 2)), -1)
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_planes_of_odd_frames_hold_the_half_sample_at_the_edge():
    camera = fr.FisheyeCamera([100, 100, 60, 40, 0, 0, 0, 0], (81, 121))
    plane = frames._plane_camera(camera, (2, 2), 0)
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


@pytest.mark.parametrize(("codec", "pix_fmt", "suffix"), [("libx264", "yuv420p", ".mp4"), ("png", "rgb24", ".mov")])
@pytest.mark.parametrize("clockwise", [1, 2, 3])
def test_a_clip_that_was_taken_on_its_side_is_turned_as_players_do(tmp_path, clockwise, codec, pix_fmt, suffix):
    source = tmp_path / f"in{suffix}"
    stored = [np.ascontiguousarray(np.rot90(turned(n), clockwise)) for n in range(3)]
    make_clip(source, codec=codec, pix_fmt=pix_fmt, frames=stored, times=np.arange(3) / 24)
    turn_on_its_side(source, source, clockwise)
    assert video.frame_size(source) == SIZE
    assert psnr(video.sample_frames(source, 1)[0], turned(2)) > 30
    video.rectify_video(source, tmp_path / "out.mp4", CAMERA, VIEW, quality=90)
    made = decoded(tmp_path / "out.mp4")
    for number in range(3):
        assert psnr(made[number], fr.numpy.rectify(turned(number), CAMERA, VIEW, padding="border").image) > 30


def test_frames_of_another_size_half_way_are_told(tmp_path):
    parts = [tmp_path / "one.ts", tmp_path / "two.ts"]
    make_clip(parts[0], times=np.arange(12) / 24)
    make_clip(parts[1], times=np.arange(12, 24) / 24, frames=[np.zeros((90, 120, 3), np.uint8)] * 12)
    (tmp_path / "in.ts").write_bytes(b"".join(part.read_bytes() for part in parts))
    with pytest.raises(ValueError, match="frames of the camera's size 240x180, got 120x90"):
        video.rectify_video(tmp_path / "in.ts", tmp_path / "out.mp4", CAMERA, VIEW)
    assert not (tmp_path / "out.mp4").exists()


def test_pixels_of_another_kind_half_way_are_taken(tmp_path):
    parts = [tmp_path / "one.ts", tmp_path / "two.ts"]
    make_clip(parts[0], times=np.arange(12) / 24)
    make_clip(parts[1], times=np.arange(12, 24) / 24, pix_fmt="yuv444p")
    (tmp_path / "in.ts").write_bytes(b"".join(part.read_bytes() for part in parts))
    video.rectify_video(tmp_path / "in.ts", tmp_path / "out.mp4", CAMERA, VIEW, quality=90)
    before, after = decoded(tmp_path / "in.ts"), decoded(tmp_path / "out.mp4")
    assert len(after) == len(before) == 24
    for source, made in zip(before, after, strict=True):
        assert psnr(made, fr.numpy.rectify(source, CAMERA, VIEW, padding="border").image) > 32


# --- Depth and colours ----------------------------------------------------------------------------

DEEP = [
    ("libx265", "yuv420p10le", ".mp4", ("hevc", "yuv420p10le")),
    ("libx264", "yuv422p10le", ".mkv", ("hevc", "yuv420p10le")),
    ("prores_ks", "yuv422p10le", ".mov", ("hevc", "yuv420p10le")),
    ("ffv1", "yuv444p12le", ".mkv", ("hevc", "yuv420p12le")),
    ("ffv1", "gray16le", ".mkv", ("hevc", "yuv420p12le")),
    ("libx265", "yuv420p10le", ".avi", ("h264", "yuv420p10le")),
]


@pytest.mark.parametrize(("codec", "pix_fmt", "suffix", "expected"), DEEP)
def test_depth_is_kept(tmp_path, codec, pix_fmt, suffix, expected):
    """Of a slow ramp, 8 bits would be off by 1.15 levels of 10 bits RMS, and look banded."""
    x = np.linspace(0.3, 0.5, SIZE[1])
    ramp = np.broadcast_to((x * 65535).astype(np.uint16)[:, None], (*SIZE, 3)).copy()
    source = tmp_path / ("in.mov" if codec == "prores_ks" else "in.mkv")
    make_clip(source, codec=codec, pix_fmt=pix_fmt, frames=[ramp] * 3, times=np.arange(3) / 24)
    report = video.rectify_video(source, tmp_path / f"out{suffix}", CAMERA, VIEW, quality=100)
    with av.open(str(tmp_path / f"out{suffix}")) as out:
        found = out.streams.video[0].codec_context
        assert (found.codec.canonical_name, found.pix_fmt) == expected
        if suffix in (".mp4", ".mov"):
            assert found.codec_tag == "hvc1"
    before, made = (decoded(path, format="gray16le")[1] / 64.0 for path in (source, tmp_path / f"out{suffix}"))
    straight = fr.numpy.rectify(before.astype(np.float32), CAMERA, VIEW, padding="border").image
    assert np.sqrt(np.square(made - straight).mean()) < 0.5
    assert "bits" not in report.summary or pix_fmt == "gray16le"


@pytest.mark.parametrize("count", [1, 2, 3, 4])
@pytest.mark.parametrize("pix_fmt", ["yuv420p", "yuv420p10le"])
def test_the_shortest_clips(tmp_path, count, pix_fmt):
    make_clip(tmp_path / "in.mkv", codec="ffv1", pix_fmt=pix_fmt, times=np.arange(count) / 24, sound=None)
    video.rectify_video(tmp_path / "in.mkv", tmp_path / "out.mp4", CAMERA, VIEW)
    np.testing.assert_allclose(times_of(tmp_path / "out.mp4"), np.arange(count) / 24, atol=1e-3)


def test_depth_that_is_lost_is_told(tmp_path):
    make_clip(tmp_path / "in.mkv", codec="libx265", pix_fmt="yuv420p10le", times=np.arange(3) / 24, sound=None)
    report = video.rectify_video(tmp_path / "in.mkv", tmp_path / "out.webm", CAMERA, VIEW)
    assert report.summary.endswith(", without 2 of 10 bits")


@pytest.mark.parametrize("suffix", [".mp4", ".mkv"])
@pytest.mark.parametrize("color_range", [1, 2])
@pytest.mark.parametrize(("pix_fmt", "codec"), [("yuv420p", "libx264"), ("yuv420p10le", "libx265")])
def test_colours_mean_what_they_meant(tmp_path, pix_fmt, codec, color_range, suffix):
    """BT.2020, of the transfer of BT.2100 PQ; where the lens sees nothing, black is 0 or 16."""
    colours = {"color_range": color_range, "color_primaries": 9, "color_trc": 16, "colorspace": 9}
    make_clip(tmp_path / "in.mkv", codec=codec, pix_fmt=pix_fmt, times=np.arange(3) / 24, context=colours)
    view = views.keep_all(CAMERA, SIZE)
    video.rectify_video(tmp_path / "in.mkv", tmp_path / f"out{suffix}", CAMERA, view, quality=95)
    with av.open(str(tmp_path / f"out{suffix}")) as out:
        frame = next(out.decode(video=0))
    assert {name: int(getattr(frame, name)) for name in colours} == colours
    y, x = np.argwhere(~fr.numpy.rectify(np.zeros(SIZE, np.uint8), CAMERA, view).valid)[0]
    depth = 10 if "10" in pix_fmt else 8
    assert abs(frame.to_ndarray()[y, x] / 2 ** (depth - 8) - (16 if color_range == 1 else 0)) < 2


# --- Proportions ----------------------------------------------------------------------------------


def test_pixels_are_square_where_the_focal_lengths_of_the_view_agree(tmp_path):
    """A lens file describes pixels as they are stored, whatever players make of them."""
    make_clip(tmp_path / "in.mkv", times=np.arange(2) / 24, context={"sample_aspect_ratio": Fraction(4, 3)})
    assert video.frame_size(tmp_path / "in.mkv") == SIZE
    narrow = fr.PinholeCamera(VIEW.params * [1, 2, 1, 1], SIZE)
    for view, expected in ((VIEW, 1), (narrow, 2)):
        video.rectify_video(tmp_path / "in.mkv", tmp_path / "out.mp4", CAMERA, view, quality=90)
        with av.open(str(tmp_path / "out.mp4")) as out:
            assert out.streams.video[0].sample_aspect_ratio == expected
        before, made = decoded(tmp_path / "in.mkv")[1], decoded(tmp_path / "out.mp4")[1]
        assert psnr(made, fr.numpy.rectify(before, CAMERA, view, padding="border").image) > 32


@pytest.mark.parametrize("turns", [0, 1])
def test_sampled_frames_have_square_pixels(tmp_path, turns):
    make_clip(tmp_path / "in.mp4", times=np.arange(2) / 24, context={"sample_aspect_ratio": Fraction(4, 3)})
    if turns:
        turn_on_its_side(tmp_path / "in.mp4", tmp_path / "in.mp4", 1)
    assert video.sample_frames(tmp_path / "in.mp4", 1)[0].shape == ((180, 320, 3), (320, 180, 3))[turns]
    assert video.frame_size(tmp_path / "in.mp4") == (SIZE, SIZE[::-1])[turns]


def test_quality_is_a_matter_of_size(clip, tmp_path):
    sizes = []
    for quality in (20, 90):
        video.rectify_video(clip, tmp_path / "out.mp4", CAMERA, VIEW, quality=quality)
        sizes.append((tmp_path / "out.mp4").stat().st_size)
    assert sizes[0] < sizes[1] / 2
