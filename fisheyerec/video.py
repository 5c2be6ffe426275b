"""Video files, rectified frame by frame; sound and subtitles are taken over as they are.

    file -> packets -> frames -> rectified frames -> packets -> file
         demux, decode        op                encode, mux
         a thread             a thread          the caller's

Luma and chroma are resampled as they are stored, each plane by its own camera, so that no colour is converted. Chroma
is taken to lie where H.264 and MPEG-2 put it if nothing is said ("left"): level with every other luma sample of a row,
half-way between two rows. Cameras and views refer to frames as players show them, turned as the file says, and the
result is stored upright: OpenCV and ffmpeg give such frames, so that lenses are calibrated on them.
"""

from __future__ import annotations

import contextlib
import math
import os
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

try:
    import av
except ModuleNotFoundError as error:
    raise ModuleNotFoundError("PyAV is missing: pip install 'fisheyerec[video]'", name="av") from error

from . import numpy as door
from .cameras import Camera, FisheyeCamera
from .replacement import replacement

T = TypeVar("T")

DEFAULT_QUALITY = 60
"""A constant rate factor of 20 for H.264."""

SAMPLED_FRAMES = 9
"""How many frames a camera is estimated from."""

_PLANAR_BYTES = {"yuv420p", "yuvj420p", "yuv422p", "yuvj422p", "yuv444p", "yuvj444p"}
_LIMITED_RANGE, _FULL_RANGE, _BT709 = 1, 2, 1  # AVCOL_RANGE_MPEG, AVCOL_RANGE_JPEG, AVCOL_SPC_BT709
_LEFT_SITING = 1 / 4  # chroma samples, from the middle of the luma samples that one stands for
_AHEAD = 4  # frames
_SLACK = 1 / 4  # s, by which a complete file may end before its header says
_BROADCAST = {"h264", "hevc", "mpeg2video", "aac", "mp2", "mp3", "ac3", "eac3", "opus"}
# Encoder, what its constant rate factor is at the lowest quality, and options for speed.
_ENCODERS = {
    "h264": ("libx264", 51, {"preset": "veryfast"}),
    "vp9": ("libvpx-vp9", 63, {"deadline": "realtime", "cpu-used": "7", "row-mt": "1"}),
}


class VideoReport(NamedTuple):
    """What became of a video."""

    frames: int
    seconds: float
    summary: str
    complaint: str | None
    """What is wrong with the input; None if nothing is."""


@dataclass
class _Damage:
    """What a reader finds wrong with a file."""

    lost_packets: int = 0
    reached: float = 0.0  # s
    broke_off: bool = False

    def complaint(self, source: str | os.PathLike[str], duration: float | None) -> str | None:
        """Say what is wrong, given how long the file should be in seconds."""
        found = []
        if duration is not None and self.reached < duration - _SLACK:
            found.append(f"ends after {self.reached:.2f} of {duration:.2f} s")
        elif self.broke_off:
            found.append(f"breaks off after {self.reached:.2f} s")
        if self.lost_packets:
            found.append(f"has {_counted(self.lost_packets, 'packet')} that cannot be decoded")
        return f"{os.fspath(source)}: {' and '.join(found)}; what is there was written" if found else None


def _counted(count: int, noun: str) -> str:
    return f"{count} {noun}{'' if count == 1 else 's'}"


def rectify_video(
    source: str | os.PathLike[str],
    target: str | os.PathLike[str],
    camera: FisheyeCamera,
    view: Camera,
    *,
    rotation: np.ndarray | None = None,
    quality: int | None = None,
    on_frame: Callable[[int, int | None], None] = lambda done, total: None,
) -> VideoReport:
    """Rectify the first video stream of a file, with time stamps as they are, variable frame rates included.

    Written as H.264 with 8 bits in 4:2:0, in WebM as VP9. What is left of a broken file is written, and told.

    Args:
        source: the file.
        target: the file to write; the suffix names the container.
        camera: the fisheye camera, for frames as players show them.
        view: the view to make, of even height and width.
        rotation: (3, 3) camera_from_view; None for none.
        quality: from 1 to 100; None for 60. The encoder's constant rate factor falls from 51 (VP9: 63) to 0.
        on_frame: called with the frames that are done and, if known, how many there will be; what it raises ends the
            work, and nothing is written.

    Raises:
        ValueError: source is no video, or not one frame can be decoded; a camera of another size; a view of odd size;
            a container that is unknown or holds neither codec.
        OSError: a file cannot be read or written.
    """
    if view.image_size[0] % 2 or view.image_size[1] % 2:
        height, width = view.image_size
        raise ValueError(f"rectify_video(): expected a view of even width and height, got {width}x{height}")
    if quality is not None and not 1 <= quality <= 100:
        raise ValueError(f"rectify_video(): expected quality in [1, 100], got {quality}")
    start, frames, damage = time.perf_counter(), 0, _Damage()
    with _open(source) as clip, replacement(target) as temporary, _create(temporary) as out:
        video = clip.streams.video[0]
        copied = _copied_streams(clip, out)
        encoder = _encoder(out, video, view, quality or DEFAULT_QUALITY)
        total = video.frames or None
        read = _ahead(_read(clip, video, [stream for stream, _ in copied.values()], damage))
        with contextlib.closing(_ahead(_rectified(read, camera, view, rotation))) as rectified:
            for item in rectified:
                if isinstance(item, av.Packet):
                    item.stream = copied[item.stream.index][1]
                    out.mux(item)
                    continue
                out.mux(encoder.encode(item))
                frames += 1
                on_frame(frames, total)
        if not frames:
            raise ValueError(f"rectify_video(): expected a video with frames, got {os.fspath(source)!r} without")
        out.mux(encoder.encode(None))
        duration = None if clip.duration is None else clip.duration / av.time_base
        dropped = len(clip.streams) - len(copied) - 1
    seconds = time.perf_counter() - start
    summary = f"{frames} frames, {frames / seconds:.1f} a second"
    if dropped:
        summary += f", without {_counted(dropped, 'stream')} of data, pictures or kinds that the container cannot hold"
    return VideoReport(frames, seconds, summary, damage.complaint(source, duration))


def copy_video(source: str | os.PathLike[str], target: str | os.PathLike[str]) -> None:
    """Copy what a video file holds into another container, or the same, without decoding it.

    Raises:
        ValueError: source is no video, or the container cannot hold its picture.
        OSError: a file cannot be read or written.
    """
    with _open(source) as clip, replacement(target) as temporary, _create(temporary) as out:
        copied = _copied_streams(clip, out, kinds=("video", "audio", "subtitle"))
        if not any(stream.type == "video" for stream, _ in copied.values()):
            raise ValueError(f"copy_video(): expected a container that holds {clip.streams.video[0].name}")
        for packet in clip.demux([stream for stream, _ in copied.values()]):
            if packet.dts is not None:
                packet.stream = copied[packet.stream.index][1]
                out.mux(packet)


def frame_size(source: str | os.PathLike[str]) -> tuple[int, int]:
    """Give the (height, width) of a video's frames as players show them.

    Raises:
        ValueError: source is no video.
        OSError: it cannot be read.
    """
    with _open(source) as clip:
        frame = next(_frames(clip), None)
        if frame is None:
            raise ValueError(f"frame_size(): expected a video with frames, got {os.fspath(source)!r} without")
        return (frame.height, frame.width) if _quarter_turns(frame) % 2 == 0 else (frame.width, frame.height)


def sample_frames(source: str | os.PathLike[str], count: int = SAMPLED_FRAMES) -> list[np.ndarray]:
    """Decode frames that lie evenly over a video, as players show them: (H, W, 3) uint8 RGB.

    Raises:
        ValueError: source is no video, or not one frame can be decoded.
        OSError: it cannot be read.
    """
    sampled: dict[Any, np.ndarray] = {}
    with _open(source) as clip:
        for number in range(count):
            wanted = (clip.start_time or 0) / av.time_base
            if clip.duration is not None:
                wanted += clip.duration / av.time_base * (2 * number + 1) / (2 * count)
                with contextlib.suppress(av.error.FFmpegError):  # what cannot be sought is read on
                    clip.seek(int(wanted * av.time_base))
            frame = None
            for frame in _frames(clip):
                if frame.time is None or frame.time >= wanted:
                    break
            if frame is not None and frame.pts not in sampled:
                rgb = frame.to_ndarray(format="rgb24")
                sampled[frame.pts] = np.ascontiguousarray(np.rot90(rgb, _quarter_turns(frame)))
    if not sampled:
        raise ValueError(f"sample_frames(): expected a video with frames, got {os.fspath(source)!r} without")
    return list(sampled.values())


# --- Reading --------------------------------------------------------------------------------------


@contextlib.contextmanager
def _open(source: str | os.PathLike[str]) -> Iterator[Any]:
    try:
        clip = av.open(os.fspath(source), metadata_errors="replace")
    except av.error.InvalidDataError as error:
        raise ValueError(f"expected a video, got {os.fspath(source)!r} of an unknown format, or broken") from error
    with clip:
        if not clip.streams.video:
            raise ValueError(f"expected a video, got {os.fspath(source)!r} without a picture")
        clip.streams.video[0].thread_type = "AUTO"
        yield clip


def _frames(clip: Any) -> Generator[Any, None, None]:
    """Decode until the file ends or breaks."""
    video = clip.streams.video[0]
    return (item for item in _read(clip, video, [], _Damage()))


def _read(clip: Any, video: Any, copied: list[Any], damage: _Damage) -> Generator[Any, None, None]:
    """Give the frames of the video, and the packets of streams to copy."""
    start = (clip.start_time or 0) / av.time_base
    packets = clip.demux([video, *copied])
    while True:
        try:
            packet = next(packets)
        except StopIteration:
            return
        except av.error.FFmpegError:
            damage.broke_off = True
            with contextlib.suppress(av.error.FFmpegError):
                yield from video.decode(None)
            return
        if packet.pts is not None:
            end = float((packet.pts + (packet.duration or 0)) * packet.time_base) - start
            damage.reached = max(damage.reached, end)
        if packet.stream.index != video.index:
            if packet.dts is not None:
                yield packet
            continue
        try:
            frames = packet.decode()
        except av.error.InvalidDataError:
            damage.lost_packets += 1
            continue
        yield from frames


def _ahead(items: Generator[T, None, None]) -> Generator[T, None, None]:
    """Compute items in a thread of their own, a few more than have been taken."""
    end: Any = object()
    thread = ThreadPoolExecutor(1)
    waiting = deque(thread.submit(next, items, end) for _ in range(_AHEAD))
    try:
        while (item := waiting.popleft().result()) is not end:
            waiting.append(thread.submit(next, items, end))
            yield item
    finally:
        thread.shutdown(cancel_futures=True)
        items.close()


# --- Resampling -----------------------------------------------------------------------------------


def _quarter_turns(frame: Any) -> int:
    """How many times a player turns the frame by 90 degrees, counter-clockwise."""
    turns: int = round(frame.rotation / 90) % 4
    return turns


def _rectified(
    items: Generator[Any, None, None], camera: FisheyeCamera, view: Camera, rotation: np.ndarray | None
) -> Generator[Any, None, None]:
    """Rectify frames, and let packets pass."""
    planes: list[_Plane] = []
    clock = _Clock()
    with contextlib.closing(items):
        for item in items:
            if isinstance(item, av.Packet):
                yield item
                continue
            frame = _planar(item)
            if not planes:
                turns = _quarter_turns(frame)
                size = (frame.height, frame.width) if turns % 2 == 0 else (frame.width, frame.height)
                if size != camera.image_size:
                    (height, width), (got_height, got_width) = camera.image_size, size
                    raise ValueError(
                        f"rectify_video(): expected frames of the camera's size {width}x{height}, "
                        f"got {got_width}x{got_height}"
                    )
                black = 0 if _has_full_range(frame) else 16
                planes = [_Plane(plane, frame, camera, view, rotation, black) for plane in range(3)]
            height, width = view.image_size
            out = av.VideoFrame(width, height, "yuv420p")
            for number, plane in enumerate(planes):
                _pixels(out.planes[number])[:] = plane.rectify(_pixels(frame.planes[number]))
            out.pts, out.time_base = clock.time_of(item), item.time_base
            yield out


def _planar(frame: Any) -> Any:
    """Give a frame in 8 bit planes of luma and chroma; it is the same where it has such."""
    if frame.format.name in _PLANAR_BYTES:
        return frame
    if frame.format.is_rgb:
        return frame.reformat(format="yuv420p", dst_colorspace=_BT709, dst_color_range=_LIMITED_RANGE)
    return frame.reformat(format="yuv420p", dst_color_range=_FULL_RANGE if _has_full_range(frame) else _LIMITED_RANGE)


def _has_full_range(frame: Any) -> bool:
    """Tell whether black is 0, not 16, in a frame or a stream."""
    return bool(frame.color_range == _FULL_RANGE or frame.format.name.startswith("yuvj"))


def _pixels(plane: Any) -> np.ndarray:
    """The pixels (height, width) of a plane, in its own memory."""
    return np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)[: plane.height, : plane.width]


class _Plane:
    """Rectifies one plane of every frame: 0 is luma, 1 and 2 are chroma."""

    def __init__(
        self,
        number: int,
        frame: Any,
        camera: FisheyeCamera,
        view: Camera,
        rotation: np.ndarray | None,
        black: int,
    ) -> None:
        self.turns = _quarter_turns(frame)
        plane = frame.planes[number]
        steps = (math.ceil(frame.height / plane.height), math.ceil(frame.width / plane.width))
        # One thread: the others decode and encode. Beyond the edge, zero would be green.
        self.plan = door.Plan(
            _plane_camera(camera, steps, self.turns),
            _plane_camera(view, (1, 1) if number == 0 else (2, 2), 0),
            source_from_target=rotation,
            padding="border",
            threads=1,
        )
        self.empty = black if number == 0 else 128
        self.invalid = np.flatnonzero(~self.plan.valid)

    def rectify(self, pixels: np.ndarray) -> np.ndarray:
        image = self.plan(np.rot90(pixels, self.turns)).image
        image.reshape(-1)[self.invalid] = self.empty
        return image


def _plane_camera(camera: Any, steps: tuple[int, int], turns: int) -> Any:
    """Give the camera of a plane that has one sample for so many rows and columns of the stored frame.

    Args:
        camera: the camera of the frame, upright.
        steps: rows and columns, each 1 or 2.
        turns: from the stored frame to the upright one, in quarters and counter-clockwise.
    """
    left = _LEFT_SITING if steps[1] == 2 else 0.0
    if turns % 2:
        steps = (steps[1], steps[0])
    height, width = (math.ceil(side / step) for side, step in zip(camera.image_size, steps, strict=True))
    small = camera.crop(0, 0, (height * steps[0], width * steps[1])).resize((height, width))
    to_the_right, downwards = ((1, 0), (0, -1), (-1, 0), (0, 1))[turns]
    return small.crop(-left * to_the_right, -left * downwards, (height, width))


class _Clock:
    """Time stamps that rise, whatever the file says: encoders accept no others."""

    def __init__(self) -> None:
        self.last: int | None = None

    def time_of(self, frame: Any) -> int:
        earliest = 0 if self.last is None else self.last + 1
        pts = earliest if frame.pts is None else frame.pts
        pts = int(pts if self.last is None else max(pts, earliest))
        self.last = pts
        return pts


# --- Writing --------------------------------------------------------------------------------------


@contextlib.contextmanager
def _create(path: Path) -> Iterator[Any]:
    path.touch()  # PyAV does not say which file it could not write
    try:
        out = av.open(str(path), "w")
    except ValueError as error:
        raise ValueError(f"expected a video file with a suffix such as .mp4, got {path.suffix!r}") from error
    with out:
        yield out


def _copied_streams(clip: Any, out: Any, kinds: tuple[str, ...] = ("audio", "subtitle")) -> dict[int, tuple[Any, Any]]:
    """Give the streams whose packets are taken over, with those they become, by their index."""
    out.metadata.update(clip.metadata)
    copied = {}
    for stream in clip.streams:
        if stream.type in kinds and _holds(out, stream.codec_context.codec.canonical_name):
            made = out.add_stream_from_template(stream)
            made.metadata.update(stream.metadata)
            copied[stream.index] = (stream, made)
    return copied


def _holds(container: Any, codec: str) -> bool:
    """Tell whether a container takes a codec; of MPEG-TS, which takes what television does, FFmpeg gives no list."""
    known: set[str] = container.supported_codecs
    return codec in known or (container.format.name == "mpegts" and codec in _BROADCAST)


def _encoder(out: Any, video: Any, view: Camera, quality: int) -> Any:
    codec = next((name for name in _ENCODERS if _holds(out, name)), None)
    if codec is None:
        raise ValueError(f"expected a container that holds {' or '.join(_ENCODERS)}, got {out.format.name}")
    name, worst, options = _ENCODERS[codec]
    rate = video.average_rate or video.guessed_rate or Fraction(30)
    crf = round(worst * (1 - quality / 100))
    encoder = out.add_stream(name, rate=rate, options={**options, "crf": str(crf)})
    encoder.height, encoder.width = view.image_size
    encoder.pix_fmt, encoder.bit_rate = "yuv420p", 0
    context, seen = encoder.codec_context, video.codec_context
    context.time_base = video.time_base
    context.color_primaries, context.color_trc = seen.color_primaries, seen.color_trc
    if seen.format.is_rgb:
        context.color_range, context.colorspace = _LIMITED_RANGE, _BT709
    else:
        context.color_range = _FULL_RANGE if _has_full_range(seen) else _LIMITED_RANGE
        context.colorspace = seen.colorspace
    return encoder
