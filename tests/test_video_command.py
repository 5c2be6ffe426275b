"""Videos on the command line: broken files, bad input, early ends."""

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

import fisheyerec as fr
from fisheyerec.pictures import Picture, read_picture, write_picture

av = pytest.importorskip("av", reason="PyAV is not installed")

from clips import CAMERA, SIZE, VIEW, decoded, drawn, make_clip, packets_of, psnr, turned  # noqa: E402

from fisheyerec import video  # noqa: E402


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
    "picture": (["clip.mp4", "-o", "out.jpg"], r"expected a container that holds one of h264, hevc, vp9"),
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
