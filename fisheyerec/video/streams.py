"""The streams of the file that is written: the picture, encoded, and what is taken over from the source."""

from __future__ import annotations

import contextlib
import io
from collections import Counter
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import av

from ..cameras import Camera
from .frames import BT709, FULL_RANGE, LIMITED_RANGE, has_full_range, planar_format

_BROADCAST = {"h264", "hevc", "mpeg2video", "aac", "mp2", "mp3", "ac3", "eac3", "opus", "dvb_subtitle", "dvb_teletext"}
_OF_THE_SCENE = {"title", "language", "creation_time", "timecode"}


class _Encoder(NamedTuple):
    codec: str
    library: str
    depth: int
    worst: int
    """The constant rate factor of the lowest quality."""
    options: dict[str, str]


_X265 = {"preset": "veryfast", "x265-params": "log-level=none"}
_ENCODERS = (
    _Encoder("h264", "libx264", 8, 51, {"preset": "veryfast"}),
    _Encoder("hevc", "libx265", 10, 51, _X265),  # before H.264 of 10 bits, which few devices play
    _Encoder("hevc", "libx265", 12, 51, _X265),
    _Encoder("h264", "libx264", 10, 51, {"preset": "veryfast"}),
    _Encoder("vp9", "libvpx-vp9", 8, 63, {"deadline": "realtime", "cpu-used": "7", "row-mt": "1"}),
)


@contextlib.contextmanager
def create(path: Path) -> Iterator[Any]:
    """Open a video file to write; raises ValueError for a suffix of no container, OSError if it cannot be written."""
    path.touch()  # PyAV does not say which file it could not write
    try:
        out = av.open(str(path), "w")
    except ValueError as error:
        raise ValueError(f"expected a video file with a suffix such as .mp4, got {path.suffix!r}") from error
    with out:
        yield out


def add_encoder(out: Any, video: Any, view: Camera, quality: int) -> tuple[Any, int, int]:
    """Add a stream for the rectified picture; give it, its depth and how many bits it has less than the source.

    Raises:
        ValueError: the container holds no codec of these.
    """
    seen, context_depth = video.codec_context, max(part.bits for part in video.codec_context.format.components)
    usable = [encoder for encoder in _ENCODERS if _holds_codec(out, encoder.codec) and _is_installed(encoder)]
    if not usable:
        codecs = ", ".join(dict.fromkeys(encoder.codec for encoder in _ENCODERS))
        raise ValueError(f"expected a container that holds one of {codecs}, got {out.format.name}")
    # The shallowest that is deep enough, else the deepest.
    chosen = min(usable, key=lambda encoder: (encoder.depth < context_depth, abs(encoder.depth - context_depth)))
    rate = video.average_rate or video.guessed_rate or Fraction(30)
    options = {**chosen.options, "crf": str(round(chosen.worst * (1 - quality / 100)))}
    # AVI numbers its frames in the order of decoding, so that none may wait for a later one.
    has_times = out.format.name != "avi"
    if not has_times:
        rate, options["bf"] = video.guessed_rate or rate, "0"
    stream = out.add_stream(chosen.library, rate=rate, options=options)
    stream.height, stream.width = view.image_size
    stream.pix_fmt, stream.bit_rate = planar_format(chosen.depth), 0
    stream.metadata.update({key: text for key, text in video.metadata.items() if key.lower() in _OF_THE_SCENE})
    context = stream.codec_context
    if chosen.codec == "hevc" and out.format.name in ("mp4", "mov"):
        context.codec_tag = "hvc1"  # the one that Apple's players know
    context.time_base = video.time_base if has_times else 1 / rate
    fx, fy = (float(focal) for focal in view.numpy().params[:2])
    context.sample_aspect_ratio = Fraction(fy / fx).limit_denominator(255)
    context.color_primaries, context.color_trc = seen.color_primaries, seen.color_trc
    if seen.format.is_rgb:
        context.color_range, context.colorspace = LIMITED_RANGE, BT709
    else:
        context.color_range = FULL_RANGE if has_full_range(seen) else LIMITED_RANGE
        context.colorspace = seen.colorspace
    return stream, chosen.depth, max(context_depth - chosen.depth, 0)


class CopiedStreams:
    """Streams that are taken over packet by packet, with chapters and what the file says about itself.

    Args:
        clip: the file they come from.
        out: the file they go to, of which they are those that its container can hold.
        remade: the picture, where that is made anew; other pictures are left out then, but for covers.
    """

    def __init__(self, clip: Any, out: Any, *, remade: Any = None) -> None:
        out.metadata.update(clip.metadata)
        out.set_chapters(clip.chapters())
        self._out = out
        self._made: dict[int, tuple[Any, Clock]] = {}
        self._left_out: Counter[str] = Counter()
        for stream in clip.streams:
            is_remade = remade is not None and stream.index == remade.index
            if is_remade or _is_written_by_container(stream, clip):
                continue
            is_fisheye = stream.type == "video" and not stream.disposition & av.stream.Disposition.attached_pic
            if (is_fisheye and remade is not None) or not _holds(out, stream):
                self._left_out[stream.type] += 1
                continue
            made = out.add_stream_from_template(stream, opaque=True)
            made.metadata.update(stream.metadata)
            made.disposition = stream.disposition
            if stream.type == "video":
                made.codec_context.framerate = stream.average_rate or 0  # time codes are counted in frames
                made.codec_context.sample_aspect_ratio = stream.sample_aspect_ratio or 0
            self._made[stream.index] = (made, Clock())

    def holds(self, stream: Any) -> bool:
        """Tell whether a stream of the source is taken over."""
        return stream.index in self._made

    def left_out(self) -> list[str]:
        """Say what is not: "1 data stream"."""
        return [f"{count} {kind} stream{'' if count == 1 else 's'}" for kind, count in self._left_out.items()]

    def mux(self, packet: Any) -> None:
        """Write a packet of the source, if it is of a stream that is taken over."""
        if not packet.size or packet.stream.index not in self._made:
            return
        packet.stream, clock = self._made[packet.stream.index]
        packet.dts = clock.next(packet.dts, packet.duration or 1)
        packet.pts = packet.dts if packet.pts is None else max(packet.pts, packet.dts)
        self._out.mux(packet)


class Clock:
    """Time stamps that rise, whatever the file says: encoders and containers accept no others."""

    def __init__(self) -> None:
        self._last: int | None = None
        self._follows = 0

    def next(self, stamp: int | None, duration: int = 1) -> int:
        """Give the time stamp of what lasts so long; where it is missing or does not rise, the end of the last one."""
        if stamp is None or (self._last is not None and stamp <= self._last):
            stamp = self._follows
        self._last, self._follows = stamp, stamp + duration
        return stamp


class FrameTimes:
    """Puts frames on the ticks of an encoder, which are those of the source but where a container only counts frames.

    Args:
        tick: in seconds.
    """

    def __init__(self, tick: Fraction) -> None:
        self.are_kept = True
        """Whether every frame lies where it did, to a tick of the source."""
        self._tick, self._clock = tick, Clock()

    def stamp(self, frame: Any) -> None:
        """Put a frame on the nearest tick after that of the frame before."""
        at = None if frame.pts is None else frame.pts * frame.time_base / self._tick
        stamp = self._clock.next(None if at is None else round(at))
        if at is not None and abs(stamp - at) * self._tick > frame.time_base:
            self.are_kept = False
        frame.pts, frame.time_base = stamp, self._tick


def _is_written_by_container(stream: Any, clip: Any) -> bool:
    """Tell whether a stream holds what its container makes a stream of: chapters or a time code.

    FFmpeg gives the chapter track of MP4 either as subtitles of QuickTime's kind or as data that it does not read.
    """
    if stream.type == "data":
        return stream.discard == av.stream.Discard.all or "timecode" in stream.metadata
    return stream.type == "subtitle" and bool(clip.chapters()) and stream.codec_context.codec_tag == "text"


def _holds(container: Any, stream: Any) -> bool:
    """Tell whether a container takes the packets of a stream."""
    if stream.codec_context is not None:
        return _holds_codec(container, stream.codec_context.codec.canonical_name)
    # What FFmpeg does not decode: a trial tells. AVI takes data that nobody reads.
    if stream.type not in ("data", "attachment") or container.format.name == "avi":
        return False
    try:
        with av.open(io.BytesIO(), "w", format=container.format.name) as trial:
            trial.add_stream_from_template(stream)
            trial.start_encoding()
    except (av.error.FFmpegError, ValueError):
        return False
    return True


def _holds_codec(container: Any, codec: str) -> bool:
    """Tell whether a container takes a codec; of MPEG-TS, which takes what television does, FFmpeg gives no list."""
    known: set[str] = container.supported_codecs
    return codec in known or (container.format.name == "mpegts" and codec in _BROADCAST)


def _is_installed(encoder: _Encoder) -> bool:
    """Tell whether FFmpeg was built with an encoder for pixels of its depth."""
    if encoder.library not in av.codec.codecs_available:
        return False
    formats = av.codec.Codec(encoder.library, "w").video_formats or []
    return any(each.name == planar_format(encoder.depth) for each in formats)
