"""Where the time of rectifying a video goes: decoding, rectification and encoding alone, then the command as a whole.

    python benchmarks/bench_video.py --seconds 10

The clip is drawn: a street seen through a wide fisheye that pans. Decoding and encoding use all cores there are;
rectification is that of one thread, as in the pipeline, for frames as planes and, for comparison, as RGB.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from contextlib import closing
from pathlib import Path

import av
import numpy as np

import fisheyerec as fr
from fisheyerec import video
from fisheyerec.video.frames import rectified
from fisheyerec.video.streams import add_encoder

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples"))

import scenes

RATE = 30


def draw(path: Path, size: tuple[int, int], count: int) -> fr.FisheyeCamera:
    """Write a clip and give its camera."""
    height, _ = size
    all_round = fr.FisheyeCamera.from_projection("equidistant", 200, (height * 3 // 2, height * 3 // 2))
    street = scenes.render_camera(scenes.street(seed=2), all_round.unproject, all_round.image_size, supersample=1).image
    camera = fr.FisheyeCamera.from_projection("equisolid", 140, size)
    with av.open(str(path), "w") as out:
        stream = out.add_stream("libx264", rate=RATE, options={"crf": "20", "preset": "fast"})
        stream.height, stream.width = size
        stream.pix_fmt = "yuv420p"
        for number in range(count):
            a = np.radians(8 * np.sin(number / 20))
            rotation = [[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]]
            picture = fr.numpy.resample(street, all_round, camera, source_from_target=rotation).image
            out.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        out.mux(stream.encode(None))
    return camera


def decode(path: Path) -> Iterable[av.VideoFrame]:
    """Decode as the pipeline does."""
    with av.open(str(path)) as clip:
        clip.streams.video[0].thread_type = "AUTO"
        yield from clip.decode(video=0)


def rectify_rgb(frame: av.VideoFrame, camera: fr.FisheyeCamera, view: fr.PinholeCamera) -> av.VideoFrame:
    """Rectify by way of RGB: what the planes save."""
    image = fr.numpy.rectify(frame.to_ndarray(format="rgb24"), camera, view, threads=1).image
    return av.VideoFrame.from_ndarray(image, format="rgb24").reformat(format="yuv420p")


def report(name: str, count: int, work: Callable[[], object]) -> None:
    """Print how long a frame takes, on the clock and of all cores together."""
    wall, cpu = time.perf_counter(), time.process_time()
    work()
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    print(f"{name:<28}{count / wall:8.1f} frames/s{wall / count * 1e3:8.2f} ms{cpu / count * 1e3:8.2f} ms of processor")


def main() -> None:
    """Draw, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=int, default=10)
    parser.add_argument("--height", type=int, default=1080)
    options = parser.parse_args()
    size, count = (options.height, options.height * 16 // 9), options.seconds * RATE
    with tempfile.TemporaryDirectory() as folder:
        clip, result = Path(folder, "clip.mp4"), Path(folder, "out.mp4")
        camera = draw(clip, size, count)
        view = fr.PinholeCamera.edge_matched(camera, size)
        some = [frame for frame, _ in zip(decode(clip), range(RATE), strict=False)]
        again = (some * options.seconds)[:count]
        with closing(rectified((frame for frame in some), camera, view, None, 8)) as made:
            straight = list(made)

        def encode() -> None:
            with av.open(str(clip)) as source, av.open(str(result), "w") as out:
                stream, *_ = add_encoder(out, source.streams.video[0], view, video.DEFAULT_QUALITY)
                step = int(1 / (RATE * source.streams.video[0].time_base))
                for number in range(count):
                    frame = straight[number % len(straight)]
                    frame.pts = number * step
                    out.mux(stream.encode(frame))
                out.mux(stream.encode(None))

        print(f"{size[1]}x{size[0]}, {count} frames, {clip.stat().st_size * 8 / options.seconds / 1e6:.1f} Mbit/s")
        report("decoding", count, lambda: sum(1 for _ in decode(clip)))
        report("rectification", count, lambda: sum(1 for _ in rectified((f for f in again), camera, view, None, 8)))
        report("rectification through RGB", count, lambda: [rectify_rgb(frame, camera, view) for frame in again][:0])
        report("encoding", count, encode)
        report("the command", count, lambda: video.rectify_video(clip, result, camera, view))


if __name__ == "__main__":
    main()
