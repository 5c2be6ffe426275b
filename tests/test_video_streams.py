"""What a video holds beside its picture: sound, subtitles, data, chapters, words about itself, and time."""

from fractions import Fraction

import numpy as np
import pytest

av = pytest.importorskip("av", reason="PyAV is not installed")

from clips import CAMERA, VIEW, decoded, make_clip, packet, packets_of, psnr, times_of  # noqa: E402

import fisheyerec as fr  # noqa: E402
from fisheyerec import video  # noqa: E402
from fisheyerec.video import streams  # noqa: E402


@pytest.mark.parametrize("suffix", [".mp4", ".mov", ".mkv", ".avi", ".ts"])
def test_containers(clip, tmp_path, suffix):
    report = video.rectify_video(clip, tmp_path / f"out{suffix}", CAMERA, VIEW)
    assert len(decoded(tmp_path / f"out{suffix}")) == report.frames == 24
    assert len(packets_of(tmp_path / f"out{suffix}", "audio")) > 40


def test_webm_is_vp9_and_leaves_out_what_it_cannot_hold(clip, tmp_path):
    report = video.rectify_video(clip, tmp_path / "out.webm", CAMERA, VIEW)
    assert report.summary.endswith(", without 1 audio stream")
    with av.open(str(tmp_path / "out.webm")) as out:
        assert [stream.codec_context.name for stream in out.streams] == ["vp9"]
    assert len(decoded(tmp_path / "out.webm")) == 24


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


@pytest.mark.parametrize("source", [".mp4", ".mkv"])  # whose ticks are fine, and milliseconds
def test_avi_keeps_a_constant_rate_and_the_order_of_frames(tmp_path, source):
    make_clip(tmp_path / f"in{source}")
    report = video.rectify_video(tmp_path / f"in{source}", tmp_path / "out.avi", CAMERA, VIEW)
    assert "without" not in report.summary
    np.testing.assert_allclose(np.diff(times_of(tmp_path / "out.avi")), 1 / 24, atol=1e-6)
    for before, after in zip(decoded(tmp_path / f"in{source}"), decoded(tmp_path / "out.avi"), strict=True):
        expected = fr.numpy.rectify(before, CAMERA, VIEW)
        assert psnr(after[expected.valid], expected.image[expected.valid]) > 30


def test_avi_puts_a_variable_rate_on_a_grid_and_says_so(tmp_path):
    times = np.cumsum([0, 0.04, 0.04, 0.5, 0.01, 0.033, 0.2, 1.0, 0.04, 0.04])
    make_clip(tmp_path / "in.mkv", times=times)
    report = video.rectify_video(tmp_path / "in.mkv", tmp_path / "out.avi", CAMERA, VIEW)
    assert (report.frames, report.summary.endswith(", without frame times")) == (10, True)
    found = times_of(tmp_path / "out.avi")
    assert len(found) == 10
    assert (np.diff(found) > 0).all()
    assert found[-1] - found[0] == pytest.approx(times[-1], abs=2 / 24)


def test_time_stamps_rise_whatever_the_file_says():
    clock = streams.Clock()
    assert [clock.next(stamp) for stamp in (None, None, 7, 7, 3, None, 20)] == [0, 1, 7, 8, 9, 10, 20]
    assert [clock.next(stamp, 4) for stamp in (21, 2, 6, 30)] == [21, 25, 29, 30]


# --- Data, subtitles, covers ----------------------------------------------------------------------


def telemetry(out):
    """Packets such as action cameras write beside the picture."""
    stream = out.add_data_stream("bin_data" if out.format.name == "mp4" else "klv")
    stream.time_base = Fraction(1, 1000)
    return [packet(stream, b"GPS%d" % number, number * 100) for number in range(10)]


def subtitles(out):
    """A line that stays for two seconds longer than the picture."""
    stream = out.add_stream("subrip")
    stream.time_base = Fraction(1, 1000)
    stream.codec_context.subtitle_header = b"[Script Info]\n"
    return [packet(stream, b"hello", 100, 2900)]


@pytest.mark.parametrize("suffix", [".mp4", ".ts"])
def test_data_is_taken_over_packet_by_packet(tmp_path, suffix):
    source, target = tmp_path / f"in{suffix}", tmp_path / f"out{suffix}"
    make_clip(source, add=telemetry)
    report = video.rectify_video(source, target, CAMERA, VIEW)
    assert "without" not in report.summary
    before, after = packets_of(source, "data"), packets_of(target, "data")
    assert len(after) == 10
    assert [data for _, data in before] == [data for _, data in after]
    np.testing.assert_allclose([t for t, _ in after], [t for t, _ in before], atol=1e-4)


@pytest.mark.parametrize("suffix", [".mkv", ".avi"])
def test_data_that_the_container_cannot_hold_is_told(tmp_path, suffix):
    make_clip(tmp_path / "in.mp4", add=telemetry)
    report = video.rectify_video(tmp_path / "in.mp4", tmp_path / f"out{suffix}", CAMERA, VIEW)
    assert report.summary.endswith(", without 1 data stream")
    with av.open(str(tmp_path / f"out{suffix}")) as out:
        assert [stream.type for stream in out.streams] == ["video", "audio"]


def test_subtitles_and_what_becomes_of_them(tmp_path):
    make_clip(tmp_path / "in.mkv", add=subtitles)
    report = video.rectify_video(tmp_path / "in.mkv", tmp_path / "out.mkv", CAMERA, VIEW)
    assert "without" not in report.summary
    assert [data for _, data in packets_of(tmp_path / "out.mkv", "subtitle")] == [b"hello"]
    report = video.rectify_video(tmp_path / "in.mkv", tmp_path / "out.mp4", CAMERA, VIEW)
    assert report.summary.endswith(", without 1 subtitle stream")
    assert report.complaint is None  # the file is whole, though its picture ends before its subtitles


def cover(out):
    """A picture of the film, as shops add it, that is no part of it."""
    stream = out.add_stream("mjpeg", rate=1)
    stream.height, stream.width, stream.pix_fmt = 32, 32, "yuvj420p"
    stream.disposition = av.stream.Disposition.attached_pic
    return stream.encode(av.VideoFrame(32, 32, "yuvj420p")) + stream.encode(None)


def test_a_cover_stays_a_cover(tmp_path):
    make_clip(tmp_path / "in.mp4", add=cover)
    report = video.rectify_video(tmp_path / "in.mp4", tmp_path / "out.mp4", CAMERA, VIEW)
    assert (report.frames, "without" in report.summary) == (24, False)
    with av.open(str(tmp_path / "out.mp4")) as out:
        assert sorted(bool(stream.disposition & 1024) for stream in out.streams.video) == [False, True]


def second_picture(out):
    """Another fisheye picture, as cameras with two lenses write them."""
    stream = out.add_stream("libx264", rate=24)
    stream.height, stream.width = 64, 64
    return stream.encode(av.VideoFrame(64, 64, "yuv420p")) + stream.encode(None)


def test_a_second_picture_is_left_out_rather_than_left_crooked(tmp_path):
    make_clip(tmp_path / "in.mp4", add=second_picture)
    report = video.rectify_video(tmp_path / "in.mp4", tmp_path / "out.mp4", CAMERA, VIEW)
    assert report.summary.endswith(", without 1 video stream")
    video.copy_video(tmp_path / "in.mp4", tmp_path / "copy.mp4")
    with av.open(str(tmp_path / "copy.mp4")) as copy:
        assert len(copy.streams.video) == 2


def test_sound_that_nobody_decodes_is_left_out(clip, tmp_path):
    """Phones write spatial sound in codecs that FFmpeg does not know."""
    (tmp_path / "in.mp4").write_bytes(clip.read_bytes().replace(b"mp4a", b"apac").replace(b"esds", b"free"))
    report = video.rectify_video(tmp_path / "in.mp4", tmp_path / "out.mp4", CAMERA, VIEW)
    assert report.summary.endswith(", without 1 audio stream")
    assert report.complaint is None
    video.copy_video(tmp_path / "in.mp4", tmp_path / "copy.mp4")


def test_a_picture_that_nobody_decodes_is_told(clip, tmp_path):
    (tmp_path / "in.mp4").write_bytes(clip.read_bytes().replace(b"avc1", b"xxxx").replace(b"avcC", b"free"))
    for work in (video.frame_size, video.sample_frames, lambda path: video.copy_video(path, tmp_path / "out.mp4")):
        with pytest.raises(ValueError, match="without a picture that can be decoded"):
            work(tmp_path / "in.mp4")
    assert not (tmp_path / "out.mp4").exists()


def test_time_stamps_of_sound_rise_too(tmp_path):
    """Matroska takes packets of one time, MP4 does not."""

    def stuttering(out):
        stream = out.add_stream("pcm_s16le", rate=8000)
        return [packet(stream, bytes(1600), stamp) for stamp in (0, 100, 100, 200, 200)]

    make_clip(tmp_path / "in.mkv", sound=None, add=stuttering)
    video.rectify_video(tmp_path / "in.mkv", tmp_path / "out.mov", CAMERA, VIEW)
    assert b"".join(data for _, data in packets_of(tmp_path / "out.mov", "audio")) == bytes(5 * 1600)


# --- What a file says about itself ----------------------------------------------------------------

CREATED = "2020-01-02T03:04:05.000000Z"


def described(out):
    out.metadata.update({"title": "a room", "creation_time": CREATED, "comment": "drawn"})
    for stream in out.streams:
        stream.metadata.update({"language": "ger", "creation_time": CREATED})
    out.streams.video[0].metadata["timecode"] = "01:00:00:00"
    out.set_chapters(
        [
            {"id": n, "start": 500 * n, "end": 500 * (n + 1), "time_base": Fraction(1, 1000), "metadata": {"title": t}}
            for n, t in enumerate(("to the left", "to the right"))
        ]
    )
    return []


@pytest.mark.parametrize("copy", [False, True])
@pytest.mark.parametrize("target", [".mp4", ".mov", ".mkv"])
@pytest.mark.parametrize("source", [".mp4", ".mov", ".mkv"])
def test_chapters_title_language_time_code_and_date_are_kept(tmp_path, source, target, copy):
    source, target = tmp_path / f"in{source}", tmp_path / f"out{target}"
    make_clip(source, add=described, times=np.arange(24) / 24)
    if copy:
        video.copy_video(source, target)
    else:
        assert "without" not in video.rectify_video(source, target, CAMERA, VIEW).summary
    with av.open(str(target)) as out:
        told = {key.lower(): value for key, value in out.metadata.items()}
        assert (told["title"], told["creation_time"], told["comment"]) == ("a room", CREATED, "drawn")
        picture = {key.lower(): value for key, value in out.streams.video[0].metadata.items()}
        assert (picture["language"], picture["timecode"]) == ("ger", "01:00:00:00")
        assert out.streams.audio[0].language == "ger"
        chapters = [(float(c["start"] * c["time_base"]), c["metadata"]["title"]) for c in out.chapters()]
        assert chapters == [(0, "to the left"), (0.5, "to the right")]
        # MP4 makes streams of chapters and of the time code: once.
        assert len(out.streams) == (2 if target.suffix == ".mkv" else 4)


def test_statistics_of_the_old_picture_are_not_told_of_the_new_one(tmp_path):
    def counted(out):
        out.streams.video[0].metadata.update({"BPS": "123456", "title": "left lens"})
        return []

    make_clip(tmp_path / "in.mkv", add=counted)
    video.rectify_video(tmp_path / "in.mkv", tmp_path / "out.mkv", CAMERA, VIEW)
    with av.open(str(tmp_path / "out.mkv")) as out:
        found = out.streams.video[0].metadata
    assert ("BPS" in found, found["title"]) == (False, "left lens")
